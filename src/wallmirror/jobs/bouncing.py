"""Hypothesis 2 measured: which bounce carries how much light.

Light that the camera receives after k reflections is T^k L_e, one term of the Neumann series. A path tracer of depth
k + 1 sums the terms up to k, so that two depths differ by single terms; with the same random numbers for both, the
difference scatters far less than either.

A card and a plane wall cannot light themselves, so that in an open scene only odd terms carry light: strips - wall -
camera (k = 1), strips - wall - card - wall - camera (k = 3), and so on. Successive terms are therefore compared over
two steps, in every scene: q_k = T^(k+2) L_e / T^k L_e.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from wallmirror.console import Advance
from wallmirror.errors import InputError
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.scene import Scene, load_scene

Array = NDArray[np.float64]

#: Shares of the one-bounce image up to which light beyond one bounce may be left out.
TOLERANCES = (1e-3, 1e-2, 5e-2)
#: Depth that stands for all bounces.
DEEP = 50
#: Terms measured one by one: k = 1 to this.
TERMS = 7
#: Where Russian roulette starts in renders of many bounces.
RR_DEPTH = 5
_PIXELS = 128
_ROUNDING = 1e-7  # of the one-bounce light: a term below it is the film's float32
_CONFIDENCE = 0.99

WALLS = ("diffuse", "lobes", "mirror")
SETTINGS = ("black", "card_far", "card_near", "box", "box_card")

Answer = Literal["holds", "fails", "undecided"]


def bounces_scene(wall: str, setting: str) -> Scene:
    """One cell of the table of bounces: a wall of WALLS with surroundings of SETTINGS.

    Card and board have an albedo of 0.8 where they are not black, and stand 1 m ("far") or 0.25 m ("near") from the
    wall; the box is white (0.8) as well.
    """
    known_elsewhere = {("lobes", "box"): "cornell_lobes", **{(w, "black"): f"flat_wall_{w}" for w in WALLS}}
    return load_scene(known_elsewhere.get((wall, setting), f"bounces_{wall}_{setting}"))


@dataclass(frozen=True)
class Measured:
    """A number with its standard error over seeds and the ends of its 99 % confidence interval."""

    value: float
    error: float
    low: float
    high: float

    @property
    def percent(self) -> str:
        """A share in per cent with its standard error, as many digits as the error bears."""
        if math.isnan(self.value):
            return "–"
        error = 100 * self.error
        if error <= 0:
            return f"{100 * self.value:.3g} %, exactly"
        digits = max(0, min(6, 1 - math.floor(math.log10(error))))
        return f"{100 * self.value:.{digits}f} ± {error:.{digits}f} %"


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
    largest_ratio:
        Bound on the ratios beyond the last: the upper limit of the last ones plus their last growth, or what card and
        room can send back at most if that is less.
    tail_bound:
        Bound on everything beyond the last term: geometric, with `largest_ratio`. It rests on the ratios growing no
        more than they did last; `rest` is the check.
    exact:
        Whether depth DEEP and one bounce give the same picture to the bit.
    """

    scene: str
    terms: tuple[Measured, ...]
    rest: Measured
    beyond: Measured
    ratios: tuple[Measured, ...]
    largest_ratio: float
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
        return 0.0 if self.exact else float(self.tail_bound * self.largest_ratio ** ((DEEP - 1 - TERMS) // 2))


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
    chosen = spread(scene.observer.views, views)
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
                rr_depth=RR_DEPTH,
                sampler="multijitter",
                method="seeds",
            ).per_seed
            for depth in depths
        ]
        light += np.stack([image.mean(axis=1) for image in images], axis=1) / len(chosen)
        exact = exact and bool(np.array_equal(images[0], images[-1]))
        if progress is not None:
            progress(a + 1, len(chosen))
    # The wall does not light itself, so that of two successive reflections one is on card or room.
    sent_back = max(scene.card.albedo, scene.room.albedo if scene.room else 0.0)
    return series_of(scene.name, light, exact=exact, sent_back=sent_back)


def series_of(scene: str, light: Array, *, exact: bool, sent_back: float = 1.0) -> Bounces:
    """The series from the light of each seed at depths 2, 3, ..., TERMS + 1 and DEEP, shape (S, TERMS + 1).

    Parameters
    ----------
    sent_back:
        What two successive reflections keep of the power at most; 1 where nothing is known.

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
    ratio = min(_largest_ratio(ratios), sent_back)
    last = _ratio(terms[:, TERMS - 2] + terms[:, TERMS - 1], one).high
    return Bounces(
        scene=scene,
        terms=tuple(_ratio(terms[:, k], one) for k in range(1, TERMS)),
        rest=_ratio(terms[:, -1], one),
        beyond=_ratio(light[:, -1] - light[:, 0], one),
        ratios=ratios,
        largest_ratio=ratio,
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


def spread(available: int, wanted: int) -> tuple[int, ...]:
    """Indices of `wanted` out of `available` things, spread evenly over them; all where more are wanted."""
    if wanted >= available:
        return tuple(range(available))
    return tuple(int(v) for v in np.unique(np.linspace(0, available - 1, wanted).round().astype(int)))


def summary(result: Bounces) -> dict[str, Any]:
    """A result as a JSON document; numbers that are not finite become null."""
    return {
        "scene": result.scene,
        "exact": result.exact,
        "beyond": json_of(result.beyond),
        "terms": {str(k): json_of(term) for k, term in enumerate(result.terms, start=2)},
        "rest": json_of(result.rest),
        "ratios": {str(k): json_of(ratio) for k, ratio in enumerate(result.ratios, start=1)},
        "largest_ratio": json_of(result.largest_ratio),
        "tail_bound": json_of(result.tail_bound),
        "verdicts": {f"{tolerance:g}": result.verdict(tolerance) for tolerance in TOLERANCES},
    }


def json_of(value: Any) -> Any:
    """A number or a dataclass of numbers for JSON; numbers that are not finite become null."""
    if is_dataclass(value):
        return {name: json_of(entry) for name, entry in vars(value).items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
