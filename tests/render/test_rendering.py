"""Renders against the analytic one-bounce model, with twins that carry a fault and must be rejected by the same check.

Seeds are fixed, so verdicts repeat; limits are those of a fresh seed all the same, at chances of 1e-4 or less.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from wallmirror.brdf import BRDF, AngleSumTable, Diffuse, GaussianTrain, Mirror, Phong, Sum, Table
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer
from wallmirror.pathtracing import building, filming, rendering
from wallmirror.pathtracing.rendering import FILM_ROUNDING, Render, Renderer
from wallmirror.scene import RenderSettings, Room, Scene, Wall
from wallmirror.transport import build_kernel, mirror_matrix

Array = NDArray[np.float64]

pytestmark = pytest.mark.usefixtures("mi")

#: Four standard errors: a chance of 6e-5 for one statistic.
LIMIT = 4.0
PATTERN = np.array([3.0, 1.0, 2.0])
#: No symmetry in u: a mirrored angle, axis or picture shows.
LOPSIDED = Sum(
    parts=(
        GaussianTrain(centres=(math.radians(-25), math.radians(10)), sigma=math.radians(5)),
        Diffuse(albedo=0.3),
    )
)


def scene(
    brdf: BRDF,
    *,
    pixels: int = 64,
    size: float = 1.0,
    room: Room | None = None,
    views: tuple[float, ...] = (20.0, 0.0, -25.0),
    **card: Any,
) -> Scene:
    """An off-centre observer, views to both sides, three strips without symmetry; all lengths times `size`."""
    observer = Observer(
        position=(0.7 * size, -4.0 * size),
        fov=math.radians(50),
        view_angles=tuple(math.radians(view) for view in views),
        pixels=pixels,
    )
    lengths = {"y": -1.5, "element_width": 0.1, "element_height": 0.3, **card}
    albedo = lengths.pop("albedo", 0.0)
    elements = lengths.pop("elements_x", (-0.8, 0.1, 1.2))
    scaled = {name: length * size for name, length in lengths.items()}
    return Scene(
        name="test",
        title="",
        about="",
        observer=observer,
        card=Card(elements_x=tuple(x * size for x in elements), albedo=albedo, **scaled),
        wall=Wall(brdf=brdf, half_width=20 * size, half_height=20 * size),
        source=PATTERN[: len(elements), None] * [1.0, 0.5],
        room=room,
        render=RenderSettings(max_depth=2, spp=256),
    )


def analytic(case: Scene) -> Array:
    """F of one bounce with the BRDF as rendered, shape (A, N, M); an InputError would tell of too wide strips."""
    brdf = building.wall_as_rendered(case)
    if isinstance(brdf, Mirror):
        return mirror_matrix(case.observer, case.card, brdf)
    # Half the scale: Gauss-Legendre for Gaussian lobes, also good for tables made of them.
    scale = min(brdf.angular_scale / 2, math.radians(2.5))
    return build_kernel(case.observer, case.card, resolution=scale, tolerance=1e-7).apply(brdf)


@dataclass(frozen=True)
class Check:
    """Pooled gain and pixelwise z scores of some renders against what is expected."""

    gain: float
    gain_error: float
    z_mean: float
    z_std: float
    pixels: int

    @property
    def passed(self) -> bool:
        """Gain and mean within LIMIT standard errors, and a spread that its chi-square law allows."""
        low, high = stats.chi2.ppf([3e-5, 1 - 3e-5], self.pixels) / self.pixels
        return (
            abs(self.gain) <= LIMIT * self.gain_error
            and abs(self.z_mean) <= LIMIT / math.sqrt(self.pixels)
            and low <= self.z_std**2 <= high
        )


def check(renders: list[Render], expected: Array) -> Check:
    """Compare with `expected`, shape (A, N).

    Pixels below 1 % of the brightest are left out: there so few samples find light that their mean is skewed.
    """
    mean = np.array([render.mean for render in renders])
    variance = np.array([render.variance for render in renders])
    lit = expected > 0.01 * expected.max()
    mean, variance, expected = mean[lit], variance[lit], expected[lit]
    with np.errstate(divide="ignore"):  # dark pixels that should be lit: infinitely wrong
        z = np.clip((mean - expected) / np.sqrt(variance), -1e6, 1e6)
    return Check(
        gain=mean.sum() / expected.sum() - 1,
        gain_error=math.sqrt(variance.sum()) / expected.sum(),
        z_mean=float(z.mean()),
        z_std=float(z.std()),
        pixels=z.size,
    )


def renders_of(case: Scene, **settings: Any) -> list[Render]:
    """All views, 4 seeds of 1024 samples each by default; views share no seed."""
    renderer = Renderer(case)
    settings = {"spp": 1024, **settings}
    count = settings.pop("count", 4)
    return [
        renderer.render(view, PATTERN, seeds=range(100 * view, 100 * view + count), **settings)
        for view in range(case.observer.views)
    ]


def asymmetric_table() -> Table:
    s, o = np.linspace(-1, 1, 61)[:, None], np.linspace(-1, 1, 91)
    return Table(values=0.05 * (1.2 + s) + np.exp(-((s - 0.2 + 0.4 * o) ** 2) / 0.05))


CASES: dict[str, Scene] = {
    "diffuse": scene(Diffuse(albedo=0.5)),
    "lopsided lobes": scene(LOPSIDED),
    "phong": scene(Phong(exponent=50.0)),
    "table": scene(asymmetric_table()),
    "board": scene(LOPSIDED, albedo=0.8, board_width=2.4, board_height=1.0),
    # The ray epsilon would take 2 % of the light, were the scene not rendered in larger units.
    "tiny": scene(LOPSIDED, size=1e-3),
}


@pytest.mark.parametrize("name", CASES)
def test_one_bounce_agrees(name: str) -> None:
    case = CASES[name]
    result = check(renders_of(case), analytic(case) @ PATTERN)
    assert result.passed, result


@pytest.mark.parametrize("name", ["diffuse", "lopsided lobes"])
def test_one_bounce_agrees_closely_with_jittered_samples(name: str) -> None:
    """The gain alone, by the scatter of 32 seeds: single pixels' means are still too skewed for normal z scores."""
    case = CASES[name]
    expected = (analytic(case) @ PATTERN).sum()
    renders = renders_of(case, sampler="multijitter", spp=256, count=32)
    gain = np.sum([render.per_seed.sum(axis=1) for render in renders], axis=0) / expected - 1
    error = gain.std(ddof=1) / math.sqrt(gain.size)
    assert error < 4e-4
    # Student's t with 31 degrees of freedom at a chance of 1e-4.
    assert abs(gain.mean()) < stats.t.ppf(1 - 5e-5, gain.size - 1) * error


@pytest.fixture(scope="module")
def lopsided() -> list[Render]:
    return renders_of(CASES["lopsided lobes"])


def mirrored(case: Scene) -> Array:
    table = building.wall_as_rendered(case)
    assert isinstance(table, AngleSumTable)
    flipped = AngleSumTable(start=table.start, stop=table.stop, values=table.values[::-1])
    return build_kernel(case.observer, case.card, resolution=math.radians(2.5)).apply(flipped)


def without_emitter_cosine(case: Scene) -> Array:
    kernel = build_kernel(case.observer, case.card, resolution=math.radians(2.5))
    # Card and wall are parallel: the emitter's cosine is that of theta_s.
    return replace(kernel, weight=kernel.weight / np.cos(kernel.theta_s)).apply(building.wall_as_rendered(case))


FAULTS = {
    "card 2 % off": lambda case: analytic(replace(case, card=replace(case.card, y=1.02 * case.card.y))),
    "BRDF mirrored in u": mirrored,
    "no emitter cosine": without_emitter_cosine,
    "picture mirrored": lambda case: analytic(case)[:, ::-1],
    "view angles negated": lambda case: analytic(
        replace(case, observer=replace(case.observer, view_angles=tuple(-angle for angle in case.observer.view_angles)))
    ),
    "elements reversed": lambda case: analytic(case)[:, :, ::-1],
    "1.5 % too bright": lambda case: 1.015 * analytic(case),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_rejected(lopsided: list[Render], fault: str) -> None:
    wrong = FAULTS[fault](CASES["lopsided lobes"]) @ PATTERN
    assert not check(lopsided, wrong).passed


def test_the_check_sees_wrong_error_bars(lopsided: list[Render]) -> None:
    expected = analytic(CASES["lopsided lobes"]) @ PATTERN
    assert check(lopsided, expected).passed
    for factor in (0.4, 2.5):
        assert not check([replace(r, moment_variance=factor * r.moment_variance) for r in lopsided], expected).passed


def test_mirror_shows_the_strips() -> None:
    """Inside a strip only the film's rounding is left, outside nothing; pixels on an edge share by chance."""
    case = scene(Mirror(reflectance=0.9), element_width=0.6, elements_x=(-0.9, 0.1, 1.2))
    share = analytic(case) / np.float32(0.9)
    # Rays leave the wall 9e-5 (1 + |p|) in front of it, which moves edges by less than one pixel: leave out its
    # neighbours too.
    whole = np.round(share)
    still = np.pad(np.abs(share - whole) < 1e-12, ((0, 0), (1, 1), (0, 0)), mode="edge")
    still = np.all(still[:, :-2] & still[:, 1:-1] & still[:, 2:], axis=-1)
    expected = analytic(case) @ PATTERN
    assert np.sum(still & (expected > 0)) >= 20
    for view, render in enumerate(renders_of(case)):
        kept = still[view]
        np.testing.assert_allclose(render.mean[kept], expected[view, kept], rtol=FILM_ROUNDING, atol=0)
        assert np.all(np.abs(render.mean - expected[view])[~kept] <= PATTERN.max())
        # The moments' difference is lost in rounding there; the variance must not say that the pixel is exact.
        inside = kept & (expected[view] > 0)
        assert np.all(render.variance[inside] >= FILM_ROUNDING * expected[view, inside] ** 2 / 4096)


@pytest.mark.parametrize("brdf", [Diffuse(albedo=0.5), LOPSIDED, Mirror()])
def test_nothing_but_the_wall_reflects_in_an_open_scene_with_a_black_card(brdf: BRDF) -> None:
    renderer = Renderer(scene(brdf, board_width=2.4, board_height=1.0))
    one, many = (renderer.render(0, PATTERN, seeds=[3], max_depth=depth).mean for depth in (2, 50))
    assert one.max() > 0
    np.testing.assert_array_equal(many, one)


def test_a_black_board_changes_nothing_in_the_open() -> None:
    """The camera looks through it, and it takes no samples from the strips.

    Passing it, Mitsuba moves a ray by 9e-5 (1 + |p|) < 3.5e-4 along the board's normal, so by as much sideways at
    45 deg: u by less than 5e-4, and a lobe of sigma 5 deg by 0.61 / sigma times that, 3.5e-3 of its peak.
    """
    bare, boarded = scene(LOPSIDED), scene(LOPSIDED, board_width=2.4, board_height=1.0)
    first, second = (Renderer(case).render(0, PATTERN, seeds=[3]).mean for case in (bare, boarded))
    np.testing.assert_allclose(second, first, atol=3.5e-3 * first.max(), rtol=0)


@pytest.mark.parametrize("what", ["card", "room"])
def test_more_bounces_bring_light_where_something_reflects(what: str) -> None:
    """The twin of the test above: an albedo must show, and can only add."""
    if what == "card":
        case = scene(Diffuse(albedo=0.5), albedo=0.8, board_width=2.4, board_height=1.0)
    else:
        case = scene(Diffuse(albedo=0.5), room=Room(half_width=5.0, half_height=3.0, depth=6.0, albedo=0.8))
    renderer = Renderer(case)
    one, many = (renderer.render(1, PATTERN, seeds=[3], max_depth=depth).mean for depth in (2, 50))
    assert np.all(many >= one)
    assert 0.01 < many.sum() / one.sum() - 1 < 1


def test_the_same_call_renders_the_same_bits() -> None:
    """Also after other calls in between, and on another Renderer."""
    case = scene(LOPSIDED, albedo=0.5)
    first, second = Renderer(case), Renderer(case)
    settings: dict[str, Any] = {"seeds": [7], "max_depth": 5}
    image = first.render(1, PATTERN, **settings).mean
    first.render(2, PATTERN[::-1], seeds=[1])
    for again in (first, second):
        np.testing.assert_array_equal(again.render(1, PATTERN, **settings).mean, image)
    assert np.any(first.render(1, PATTERN, seeds=[8], max_depth=5).mean != image)


def test_seeds_and_passes_add_up() -> None:
    """2500 samples are three passes; the mean is theirs, each weighted with its samples."""
    renderer = Renderer(scene(LOPSIDED, pixels=8))
    sizes = (1024, 1024, 452)
    whole = renderer.render(0, PATTERN, spp=2500, seeds=[5])
    parts = np.random.SeedSequence(5).generate_state(3)
    passes = [renderer.render(0, PATTERN, spp=n, seeds=[s]).mean for n, s in zip(sizes, parts, strict=True)]
    np.testing.assert_allclose(whole.mean, np.average(passes, axis=0, weights=sizes), rtol=FILM_ROUNDING)
    two = renderer.render(0, PATTERN, spp=64, seeds=[5, 6])
    assert two.per_seed.shape == (2, 8)
    np.testing.assert_array_equal(two.per_seed[1], renderer.render(0, PATTERN, spp=64, seeds=[6]).per_seed[0])


def test_brightness_of_any_size_renders_alike() -> None:
    """Float32 squares would overflow beyond 1e19 and vanish below 1e-19; the scaling by powers of two is exact."""
    renderer = Renderer(scene(LOPSIDED, pixels=16))
    plain = renderer.render(0, PATTERN, spp=64)
    for power in (-300, -100, 100, 300):
        scaled = renderer.render(0, PATTERN * 2.0**power, spp=64)
        np.testing.assert_array_equal(scaled.mean, plain.mean * 2.0**power)
        np.testing.assert_array_equal(scaled.variance, plain.variance * 4.0**power)
    dark = renderer.render(0, np.zeros(3), spp=64)
    assert not dark.mean.any()
    assert not dark.variance.any()


def test_moments_tell_the_same_variance_as_seeds() -> None:
    """Their ratio, averaged over P pixels, scatters like chi-square with 31 P degrees of freedom.

    64 diffuse samples average to almost a normal number; the moments' own noise, from 2048 samples, is 20 times less.
    """
    case = scene(Diffuse(albedo=0.5), views=(0.0,))
    render = Renderer(case).render(0, PATTERN, spp=64, seeds=range(32))
    seeds, moments = render.seed_variance, render.moment_variance
    assert seeds is not None
    assert moments is not None
    freedom = 31 * seeds.size
    low, high = stats.chi2.ppf([3e-5, 1 - 3e-5], freedom) / freedom
    assert low < np.mean(seeds / moments) < high
    assert render.method == "moments"
    np.testing.assert_array_equal(render.variance, moments)


def test_jittered_samples_scatter_less_than_their_moments_say() -> None:
    """Why moments are refused for them: the variance would be several times too large."""
    case = scene(Diffuse(albedo=0.5), views=(0.0,))
    renderer = Renderer(case)
    independent = renderer.render(0, PATTERN, spp=64, seeds=range(16))
    jittered = renderer.render(0, PATTERN, spp=64, seeds=range(16), sampler="multijitter")
    assert jittered.method == "seeds"
    assert jittered.moment_variance is None
    assert jittered.variance.sum() < 0.5 * independent.variance.sum()


def test_captures_carry_independent_noise() -> None:
    """Every capture agrees with the model, and no two share their noise."""
    case = scene(LOPSIDED, views=(20.0, -25.0))
    done: list[tuple[int, int]] = []
    captures = filming.render_captures(case, spp=1024, seed=11, progress=lambda *step: done.append(step))
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert captures.radiance.shape == (2, 64, 2)
    assert captures.variance is not None
    assert captures.provenance["spp"] == "1024"
    expected = analytic(case) @ case.source
    lit = np.all(expected > 0.01 * expected.max(axis=(0, 1)), axis=(0, 2))
    z = (captures.radiance - expected)[:, lit] / np.sqrt(captures.variance[:, lit])
    noise = z.transpose(0, 2, 1).reshape(4, -1)
    low, high = stats.chi2.ppf([3e-5, 1 - 3e-5], noise.size) / noise.size
    assert low < np.mean(noise**2) < high
    # A correlation of n pairs has standard error 1 / sqrt(n); equal seeds would give nearly 1 (same view).
    correlation = np.corrcoef(noise)[np.triu_indices(4, 1)]
    assert np.abs(correlation).max() < 4.5 / math.sqrt(noise.shape[1])
    again = filming.render_captures(case, spp=1024, seed=11)
    np.testing.assert_array_equal(again.radiance, captures.radiance)


def test_one_hot_renders_mix_linearly() -> None:
    """Same random numbers, so a mixture differs from its render by float32 rounding only."""
    case = scene(LOPSIDED, pixels=32, albedo=0.6, board_width=2.4, board_height=1.0)
    settings: dict[str, Any] = {"spp": 128, "max_depth": 8}
    transport = filming.render_one_hot(case, seed=4, **settings)
    assert transport.shape == (3, 32, 3)
    renderer = Renderer(case)
    for view, seed in enumerate(rendering.spread_seeds(4, 3)):
        mixture = renderer.render(view, PATTERN, seeds=[seed], **settings).mean
        np.testing.assert_allclose(transport[view] @ PATTERN, mixture, atol=1e-6 * mixture.max(), rtol=0)


def test_what_cannot_be_is_refused() -> None:
    renderer = Renderer(scene(LOPSIDED, pixels=8))
    refused: list[tuple[dict[str, Any], str]] = [
        ({"view": 3}, "view"),
        ({"radiances": [1.0, 2.0]}, "radiances"),
        ({"radiances": [1.0, -2.0, 0.0]}, "radiances"),
        ({"radiances": [1.0, math.nan, 0.0]}, "radiances"),
        ({"seeds": []}, "seeds"),
        ({"seeds": [2**32]}, "seeds"),
        ({"seeds": [3, 3]}, "seeds"),
        ({"spp": 0}, "spp"),
        ({"spp": 1}, "spp.*two samples"),
        ({"max_depth": 0}, "max_depth"),
        ({"sampler": "multijitter", "seeds": [1]}, "seeds.*two"),
        ({"sampler": "multijitter", "seeds": [1, 2], "method": "moments"}, "method"),
        ({"sampler": "multijitter", "seeds": [1, 2], "spp": 1000}, "spp.*1023 can"),
        ({"sampler": "halton", "seeds": [1, 2]}, "sampler"),
    ]
    for change, message in refused:
        with pytest.raises(InputError, match=message):
            renderer.render(**{"view": 0, "radiances": PATTERN, "seeds": [1], **change})
    with pytest.raises(InputError, match="seed"):
        rendering.spread_seeds(-1, 3)


def test_spread_seeds_are_distinct_and_follow_the_root() -> None:
    seeds = rendering.spread_seeds(9, 5000)
    assert len(set(seeds)) == 5000
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert rendering.spread_seeds(9, 3) == seeds[:3]
    assert not set(seeds) & set(rendering.spread_seeds(10, 5000))


def test_picture_shows_card_and_wall() -> None:
    case = scene(LOPSIDED, albedo=0.8, board_width=2.4, board_height=1.0)
    image = rendering.picture(case, 32, 18, spp=64)
    assert image.shape == (18, 32)
    # The card's back is black and stands before a lit wall.
    middle = image[6:12, 12:20]
    assert middle.min() == 0
    assert image.max() > 0


@pytest.fixture
def restored_variant(mi: Any) -> Iterator[None]:
    yield
    importlib.import_module("mitsuba").set_variant("llvm_ad_mono")


@pytest.mark.usefixtures("restored_variant")
def test_without_llvm_a_small_job_renders_the_same() -> None:
    """The scalar colour variant: grey light keeps its value, and one bounce agrees."""
    bright = scene(Mirror(), pixels=4, elements_x=(-6.0, 0.7, 7.4), element_width=6.6, element_height=6.0)
    scalar = Renderer(bright, variant="scalar_rgb")
    assert scalar.runtime.variant == "scalar_rgb"
    np.testing.assert_allclose(scalar.render(1, np.ones(3), spp=16).mean[1:3], 1.0, rtol=1e-6)

    case = scene(LOPSIDED, pixels=8, views=(0.0,))
    render = Renderer(case, variant="scalar_rgb").render(0, PATTERN, spp=128)
    result = check([render], analytic(case) @ PATTERN)
    assert abs(result.gain) <= LIMIT * result.gain_error
    assert result.gain_error < 0.1
    # Two variants alive at once do not disturb each other.
    fast = Renderer(case)
    before = fast.render(0, PATTERN).mean
    scalar.render(0, PATTERN, spp=2)
    np.testing.assert_array_equal(fast.render(0, PATTERN).mean, before)
