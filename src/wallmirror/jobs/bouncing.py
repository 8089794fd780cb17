"""Hypothesis 2 measured: which bounce carries how much light, and what leaving bounces out costs a solution.

Light that the camera receives after k reflections is T^k L_e, one term of the Neumann series. A path tracer of depth
k + 1 sums the terms up to k, so that two depths differ by single terms; with the same random numbers for both, the
difference scatters far less than either.

A card and a plane wall cannot light themselves, so that in an open scene only odd terms carry light: strips - wall -
camera (k = 1), strips - wall - card - wall - camera (k = 3), and so on. Successive terms are therefore compared over
two steps, in every scene: q_k = T^(k+2) L_e / T^k L_e.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from wallmirror.brdf import AngleSumBRDF
from wallmirror.console import Advance
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.solve import solve
from wallmirror.errors import InputError
from wallmirror.interreflection import directional_albedo
from wallmirror.jobs.capturing import truth_of
from wallmirror.jobs.solving import judge
from wallmirror.pathtracing.rendering import Renderer, render_captures, spread_seeds
from wallmirror.scene import Scene, load_scene

Array = NDArray[np.float64]

#: Shares of the one-bounce image up to which light beyond one bounce may be left out.
TOLERANCES = (1e-3, 1e-2, 5e-2)
#: Depth that stands for all bounces.
DEEP = 50
#: Terms measured one by one: k = 1 to this.
TERMS = 7
#: Depths at which a solution's price is asked.
PRICE_DEPTHS = (2, 3, 4, 6, DEEP)
_RR_DEPTH = 5
_PIXELS = 128
_ROUNDING = 1e-7  # of the one-bounce light: a term below it is the film's float32
_CONFIDENCE = 0.99

WALLS = ("diffuse", "lobes", "mirror")
SETTINGS = ("black", "card_far", "card_near", "box", "box_card")

Answer = Literal["holds", "fails", "undecided"]


def bounces_scene(wall: str, setting: str) -> Scene:
    """One cell of the table of bounces: a wall of WALLS with surroundings of SETTINGS.

    Card and board have an albedo of 0.8 where they are not black, and stand 1 m ("far") or 0.25 m ("near") from the
    wall; the box is that of `cornell_lobes`. Cells that come with wallmirror keep their names there.
    """
    base = load_scene(f"flat_wall_{wall}")
    if setting == "black":
        return base
    box = load_scene("cornell_lobes")
    if (wall, setting) == ("lobes", "box"):
        return box
    card, room, extent = base.card, None, base.wall
    if setting != "box":
        white = load_scene("reflective_card").card
        card = replace(card, albedo=white.albedo, board_width=white.board_width, board_height=white.board_height)
    if setting == "card_near":
        card = replace(card, y=-0.25)
    if setting in ("box", "box_card"):
        room = box.room
        extent = replace(base.wall, half_width=box.wall.half_width, half_height=box.wall.half_height)
    return replace(
        base,
        name=f"bounces_{wall}_{setting}",
        title=f"{base.title}: {setting.replace('_', ', ')}",
        card=card,
        wall=extent,
        room=room,
        render=replace(base.render, max_depth=DEEP, rr_depth=_RR_DEPTH),
    )


@dataclass(frozen=True)
class Measured:
    """A number with its standard error over seeds and the ends of its 99 % confidence interval."""

    value: float
    error: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Bounces:
    """The Neumann series of one scene as the camera sees it, in units of its one-bounce image.

    Parameters
    ----------
    scene:
        Its name.
    terms:
        T^k L_e for k = 2, 3, ..., TERMS, mean over views and pixels.
    rest:
        All of depth DEEP beyond the last of `terms`.
    beyond:
        All of depth DEEP beyond one bounce.
    ratios:
        q_k for k = 1, 2, ...; nan where T^k L_e is zero.
    tail_bound:
        Bound on everything beyond the last term from the terms alone: geometric, with the upper limit of the last
        ratios plus their last growth. It rests on the ratios growing no more than that again; `rest` is the check.
    exact:
        Whether depth DEEP and one bounce give the same picture to the bit.
    """

    scene: str
    terms: tuple[Measured, ...]
    rest: Measured
    beyond: Measured
    ratios: tuple[Measured, ...]
    tail_bound: float
    exact: bool

    def verdict(self, tolerance: float) -> Answer:
        """Whether one bounce is enough within a share of the light: both ends of the interval must agree."""
        if self.exact or self.beyond.high + self._beyond_deep < tolerance:
            return "holds"
        return "fails" if self.beyond.low > tolerance else "undecided"

    @property
    def _beyond_deep(self) -> float:
        """Bound on what depth DEEP still leaves out."""
        ratio = _largest_ratio(self.ratios)
        return 0.0 if self.exact else float(self.tail_bound * ratio ** ((DEEP - 1 - TERMS) // 2))


def measure_bounces(
    scene: Scene,
    *,
    views: int = 3,
    spp: int = 256,
    seeds: int = 16,
    seed: int = 0,
    realisation: int = 0,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> Bounces:
    """Measure the terms of a scene's Neumann series by depth differences with common random numbers.

    Parameters
    ----------
    views, realisation:
        How many of the scene's views to look at, spread evenly, and under which pattern.
    spp, seeds, seed:
        Samples per pixel of each seed, number of seeds, and their root.
    """
    # Only means over pixels are asked for. Powers of two of pixels and samples render alike to the bit, others may not.
    scene = replace(scene, observer=replace(scene.observer, pixels=min(_PIXELS, scene.observer.pixels)))
    pattern = scene.source[:, realisation]
    chosen = _spread(scene.observer.views, views)
    depths = (*range(2, TERMS + 2), DEEP)
    light = np.zeros((seeds, len(depths)))
    renderer = Renderer(scene, variant=variant)
    roots = spread_seeds(seed, len(chosen) * seeds)
    exact = True
    for a, view in enumerate(chosen):
        images = [
            renderer.render(
                view,
                pattern,
                spp=spp,
                seeds=roots[a * seeds : (a + 1) * seeds],
                max_depth=depth,
                rr_depth=_RR_DEPTH,
                sampler="multijitter",
                method="seeds",
            ).per_seed
            for depth in depths
        ]
        light += np.stack([image.mean(axis=1) for image in images], axis=1) / len(chosen)
        exact = exact and bool(np.array_equal(images[0], images[-1]))
        if progress is not None:
            progress(a + 1, len(chosen))
    return series_of(scene.name, light, exact=exact)


def series_of(scene: str, light: Array, *, exact: bool) -> Bounces:
    """The series from the light of each seed at depths 2, 3, ..., TERMS + 1 and DEEP, shape (S, TERMS + 1).

    Raises
    ------
    InputError
        For fewer than four seeds, or where one bounce brings no light.
    """
    if light.shape[0] < 4:
        raise InputError(f"{light.shape[0]} seeds are too few to know their scatter; render at least 4", field="seeds")
    if not light[:, 0].mean() > 0:
        raise InputError("one bounce brings no light to the camera, so that nothing can be compared with it")
    terms = np.diff(light, axis=1, prepend=0.0)  # k = 1, ..., TERMS, and the rest
    one = terms[:, 0]
    ratios = tuple(_ratio(terms[:, k + 2], terms[:, k], _ROUNDING * float(one.mean())) for k in range(TERMS - 2))
    ratio = _largest_ratio(ratios)
    last = _ratio(terms[:, TERMS - 2] + terms[:, TERMS - 1], one).high
    return Bounces(
        scene=scene,
        terms=tuple(_ratio(terms[:, k], one) for k in range(1, TERMS)),
        rest=_ratio(terms[:, -1], one),
        beyond=_ratio(light[:, -1] - light[:, 0], one),
        ratios=ratios,
        tail_bound=0.0 if exact else last * ratio / (1 - ratio) if ratio < 1 else math.inf,
        exact=exact,
    )


def _largest_ratio(ratios: tuple[Measured, ...]) -> float:
    """Bound on the ratios beyond the last: its upper limit, and once more what it grew by in the last round trip.

    The first ratios still depend on where the strips stand; the later ones climb, ever more slowly, to the largest
    eigenvalue of the round trip.
    """
    late = [r for r in ratios[-2:] if math.isfinite(r.value)]
    growth = ratios[-1].value - ratios[-3].value
    return max((r.high for r in late), default=0.0) + (max(0.0, growth) if math.isfinite(growth) else 0.0)


def _ratio(above: Array, below: Array, rounding: float = 0.0) -> Measured:
    """Ratio of two means over seeds, its error by the jackknife; nan where the denominator is but rounding."""
    count = above.size
    if np.all(np.abs(below) <= rounding):
        return Measured(math.nan, math.nan, math.nan, math.nan)
    value = float(above.sum() / below.sum())
    without = (above.sum() - above) / (below.sum() - below)
    error = float(np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2)))
    half = float(stats.t.ppf(0.5 + _CONFIDENCE / 2, count - 1)) * error
    return Measured(value, error, value - half, value + half)


def _spread(available: int, wanted: int) -> tuple[int, ...]:
    return tuple(int(v) for v in np.unique(np.linspace(0, available - 1, wanted).round().astype(int)))


@dataclass(frozen=True, kw_only=True)
class DepthPrice:
    """Solutions of captures of one depth by the one-bounce solver, averaged over the sets of random numbers.

    Parameters
    ----------
    depth:
        Of the captures; 2 is one bounce, the control.
    source_error, brdf_error:
        Relative errors against the truth (root mean square over the sets).
    predicted_error, chi_squared:
        The solver's own error bars and misfit.
    bias, bias_error:
        Relative distance of the pattern from the control's with the same random numbers, with the noise taken out:
        the root of the product of the distances of two sets. Its error is half the distance of the two.
    predicted_bias, predicted_share:
        What `Solution.one_bounce` said beforehand; nan where it does not apply.
    verdict:
        "good" only if every solution said so.
    """

    depth: int
    source_error: float
    brdf_error: float
    predicted_error: float
    chi_squared: float
    bias: float
    bias_error: float
    predicted_bias: float
    predicted_share: float
    verdict: str


@dataclass(frozen=True, kw_only=True)
class Price:
    """What Hypothesis 2 costs the solution of one scene, depth by depth."""

    scene: str
    wall_albedo: float
    depths: tuple[DepthPrice, ...]

    @property
    def foretold(self) -> float:
        """Predicted over measured bias at the greatest depth."""
        deep = self.depths[-1]
        return deep.predicted_bias / deep.bias if deep.bias > 0 else math.nan


def price_of_one_bounce(
    scene: Scene,
    *,
    views: int = 10,
    spp: int = 512,
    sets: int = 2,
    seed: int = 0,
    variant: str = "llvm_ad_mono",
    progress: Callable[[str], None] | None = None,
) -> Price:
    """Solve captures of growing depth with the one-bounce solver and compare with what it foretold.

    Parameters
    ----------
    scene:
        With a BRDF of the angle sum; a mirror has none, so that neither solver nor prediction apply to it.
    views, spp:
        Views kept, spread evenly, and samples per pixel.
    sets:
        Independent sets of captures, at least 2.
    """
    if not isinstance(scene.wall.brdf, AngleSumBRDF):
        raise InputError("a mirror has no BRDF of the angle sum to solve for", field="wall.brdf")
    if sets < 2:
        raise InputError(f"is {sets}; noise is told from bias by at least two sets", field="sets")
    angles = scene.observer.view_angles
    thinned = replace(
        scene,
        observer=replace(scene.observer, view_angles=tuple(angles[v] for v in _spread(len(angles), views))),
    )
    truth = truth_of(thinned)
    albedo = directional_albedo(scene.wall.brdf)
    prices = []
    controls: list[Array] = []
    for depth in PRICE_DEPTHS:
        solutions = []
        for number, root in enumerate(spread_seeds(seed, sets)):
            captures = render_captures(
                thinned, spp=spp, seed=root, max_depth=depth, rr_depth=_RR_DEPTH, variant=variant
            )
            solutions.append(solve(captures, wall_albedo=albedo))
            if progress is not None:
                progress(f"{scene.name}, depth {depth}, set {number + 1} of {sets}")
        controls = controls or [_unit(s.source) for s in solutions]
        shifts = [_moved(s.source, control) for s, control in zip(solutions, controls, strict=True)]
        bias, bias_error = _common(shifts)
        judged = [j for j in (judge(s, truth) for s in solutions) if j is not None]
        checks = [s.one_bounce for s in solutions if s.one_bounce is not None]
        prices.append(
            DepthPrice(
                depth=depth,
                source_error=_rms([j.source_error for j in judged]),
                brdf_error=_rms([j.brdf_error for j in judged]),
                predicted_error=_rms([s.predicted_error for s in solutions]),
                chi_squared=float(np.mean([s.chi_squared for s in solutions])),
                bias=bias,
                bias_error=bias_error,
                predicted_bias=_rms([c.bias for c in checks]),
                predicted_share=float(np.mean([c.share for c in checks])) if checks else math.nan,
                verdict="good" if all(s.verdict == "good" for s in solutions) else "doubtful",
            )
        )
    return Price(scene=scene.name, wall_albedo=albedo, depths=tuple(prices))


def _unit(source: Array) -> Array:
    return np.asarray(source / np.linalg.norm(source), dtype=np.float64)


def _moved(source: Array, control: Array) -> Array:
    """Change of a pattern against a control of norm 1, after the best scale; its norm is their scale_free_error."""
    moved = np.asarray(np.sum(source * control) / np.sum(source * source) * source - control, dtype=np.float64)
    assert math.isclose(float(np.linalg.norm(moved)), scale_free_error(source, control), abs_tol=1e-9)
    return moved


def _common(shifts: list[Array]) -> tuple[float, float]:
    """Length of what independent shifts have in common, and the error of that."""
    count = len(shifts)
    mean = np.mean(shifts, axis=0)
    noise = sum(float(np.sum((s - mean) ** 2)) for s in shifts) / (count - 1) / count
    return math.sqrt(max(0.0, float(np.sum(mean * mean)) - noise)), math.sqrt(noise)


def _rms(values: list[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if values else math.nan


def summary(result: Bounces | Price) -> dict[str, Any]:
    """A result as a JSON document; numbers that are not finite become null."""
    if isinstance(result, Bounces):
        return {
            "scene": result.scene,
            "exact": result.exact,
            "beyond": _json(result.beyond),
            "terms": {str(k): _json(term) for k, term in enumerate(result.terms, start=2)},
            "rest": _json(result.rest),
            "ratios": {str(k): _json(ratio) for k, ratio in enumerate(result.ratios, start=1)},
            "tail_bound": _json(result.tail_bound),
            "verdicts": {f"{tolerance:g}": result.verdict(tolerance) for tolerance in TOLERANCES},
        }
    return {
        "scene": result.scene,
        "wall_albedo": result.wall_albedo,
        "foretold": _json(result.foretold),
        "depths": [_json(depth) for depth in result.depths],
    }


def _json(value: Any) -> Any:
    if isinstance(value, Measured | DepthPrice):
        return {name: _json(entry) for name, entry in vars(value).items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
