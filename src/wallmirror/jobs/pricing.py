"""What leaving bounces out costs a solution: captures of growing depth, solved as if one bounce were all.

A mirror hides nothing: its pattern is read off by least squares with the known transport, and the forecast is the glow
that card and mirror send to and fro. Every other wall is solved blindly, and the forecast is the solver's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF, Mirror, directional_albedo
from wallmirror.captures import CaptureSet
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.solve import solve
from wallmirror.errors import InputError
from wallmirror.interreflection import glow_in_mirror
from wallmirror.jobs.bouncing import DEEP, RR_DEPTH, json_of, spread
from wallmirror.jobs.capturing import truth_of
from wallmirror.jobs.solved import judge
from wallmirror.pathtracing.filming import render_captures
from wallmirror.pathtracing.rendering import spread_seeds
from wallmirror.scene import Scene
from wallmirror.transport import mirror_matrix

Array = NDArray[np.float64]

#: Depths at which a solution's price is asked; 2 is one bounce, the control.
PRICE_DEPTHS = (2, 3, 4, 6, DEEP)
_ROUNDS = 5


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One capture set's pattern with its doubts, from the blind solver or, for a mirror, from least squares.

    Parameters
    ----------
    source:
        V, shape (M, B).
    source_error, brdf_error:
        Relative errors against the truth; nan for the BRDF of a mirror.
    predicted_error, chi_squared:
        The answer's own error bars and misfit.
    predicted_bias, predicted_share:
        What light beyond one bounce was foretold to do, and its share of the light; nan where nothing was foretold.
    verdict:
        "good", "doubtful", or "known" where the BRDF was not sought.
    """

    source: Array
    source_error: float
    brdf_error: float
    predicted_error: float
    chi_squared: float
    predicted_bias: float
    predicted_share: float
    verdict: str


@dataclass(frozen=True, kw_only=True)
class DepthPrice:
    """Answers to captures of one depth by a one-bounce model, averaged over the sets of random numbers.

    Parameters
    ----------
    depth:
        Of the captures; 2 is one bounce, the control.
    source_error, brdf_error, predicted_error, chi_squared, predicted_bias, predicted_share:
        As in `Answer`: root mean squares over the sets (means for the misfit and the share).
    bias, bias_error:
        Relative distance of the pattern from the control's with the same random numbers, with the noise taken out:
        the root of the product of the distances of two sets. Its error is half the distance of the two.
    verdict:
        The answers' own where they agree, else "doubtful".
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
        """Predicted over measured bias at the greatest depth; nan where the bias does not stand out of the noise."""
        deep = self.depths[-1]
        return deep.predicted_bias / deep.bias if deep.bias > 2 * deep.bias_error else math.nan

    def summary(self) -> dict[str, Any]:
        """The price as a JSON document; numbers that are not finite become null."""
        return {
            "scene": self.scene,
            "wall_albedo": self.wall_albedo,
            "foretold": json_of(self.foretold),
            "depths": [json_of(depth) for depth in self.depths],
        }


def price_of_one_bounce(
    scene: Scene,
    *,
    views: int = 10,
    spp: int = 512,
    sets: int = 2,
    depths: tuple[int, ...] = PRICE_DEPTHS,
    seed: int = 0,
    variant: str = "llvm_ad_mono",
    progress: Callable[[str], None] | None = None,
) -> Price:
    """Solve captures of growing depth with a one-bounce model and compare with what was foretold.

    Parameters
    ----------
    scene:
        With a BRDF of the angle sum, or a mirror.
    views, spp:
        Views kept, spread evenly, and samples per pixel.
    sets:
        Independent sets of captures, at least 2.
    depths:
        Of the captures, ascending from 2.
    """
    wall = scene.wall.brdf
    if not isinstance(wall, AngleSumBRDF | Mirror):
        raise InputError("is no BRDF of the angle sum, so that there is nothing to solve for", field="wall.brdf")
    if sets < 2:
        raise InputError(f"is {sets}; noise is told from bias by at least two sets", field="sets")
    if len(depths) < 2 or depths[0] != 2:
        raise InputError(f"are {depths}; give several, from 2 (one bounce) up", field="depths")
    angles = scene.observer.view_angles
    thinned = replace(
        scene,
        observer=replace(scene.observer, view_angles=tuple(angles[v] for v in spread(len(angles), views))),
    )
    albedo = wall.reflectance if isinstance(wall, Mirror) else directional_albedo(wall)
    prices: list[DepthPrice] = []
    controls: list[Array] = []
    for depth in depths:
        answers = []
        for number, root in enumerate(spread_seeds(seed, sets)):
            captures = render_captures(thinned, spp=spp, seed=root, max_depth=depth, rr_depth=RR_DEPTH, variant=variant)
            answers.append(
                _read_mirror(captures, thinned, wall) if isinstance(wall, Mirror) else _blind(captures, thinned)
            )
            if progress is not None:
                progress(f"{scene.name}, depth {depth}, set {number + 1} of {sets}")
        controls = controls or [a.source / np.linalg.norm(a.source) for a in answers]
        prices.append(_averaged(depth, answers, controls))
    return Price(scene=scene.name, wall_albedo=albedo, depths=tuple(prices))


def _blind(captures: CaptureSet, scene: Scene) -> Answer:
    """The solver's answer, told the wall's true albedo so that the forecast is not charged with a wrong one."""
    assert isinstance(scene.wall.brdf, AngleSumBRDF)
    solution = solve(captures, wall_albedo=directional_albedo(scene.wall.brdf))
    judged, check = judge(solution, truth_of(scene)), solution.one_bounce
    assert judged is not None
    return Answer(
        source=solution.source,
        source_error=judged.source_error,
        brdf_error=judged.brdf_error,
        predicted_error=solution.predicted_error,
        chi_squared=solution.chi_squared,
        predicted_bias=math.nan if check is None else check.bias,
        predicted_share=math.nan if check is None else check.share,
        verdict=solution.verdict,
    )


def _read_mirror(captures: CaptureSet, scene: Scene, mirror: Mirror) -> Answer:
    """The pattern that a known mirror shows, by least squares over the pixels that see a strip."""
    transport = mirror_matrix(captures.observer, captures.card, mirror).reshape(-1, captures.card.elements)
    data = captures.radiance.reshape(transport.shape[0], -1)
    inverse = np.linalg.pinv(transport)
    source = inverse @ data
    # What was read holds the glow already, so the pattern that makes both is found by iteration.
    freed, glow = source, np.zeros_like(source)
    for _ in range(_ROUNDS):
        glow = glow_in_mirror(captures.card, mirror, freed)
        freed = source - glow
    spread_of = 0.0 if captures.variance is None else float(np.sum(inverse**2 @ captures.variance.reshape(data.shape)))
    return Answer(
        source=source,
        source_error=scale_free_error(source, scene.source),
        brdf_error=math.nan,
        predicted_error=math.sqrt(spread_of / float(np.sum(source**2))),
        chi_squared=math.nan,
        predicted_bias=scale_free_error(source, freed),
        predicted_share=float(np.sum(glow) / np.sum(freed)),
        verdict="known",
    )


def _averaged(depth: int, answers: list[Answer], controls: list[Array]) -> DepthPrice:
    shifts = [_moved(a.source, control) for a, control in zip(answers, controls, strict=True)]
    bias, bias_error = _common(shifts)
    verdicts = {a.verdict for a in answers}
    return DepthPrice(
        depth=depth,
        source_error=_rms([a.source_error for a in answers]),
        brdf_error=_rms([a.brdf_error for a in answers]),
        predicted_error=_rms([a.predicted_error for a in answers]),
        chi_squared=float(np.mean([a.chi_squared for a in answers])),
        bias=bias,
        bias_error=bias_error,
        predicted_bias=_rms([a.predicted_bias for a in answers]),
        predicted_share=float(np.mean([a.predicted_share for a in answers])),
        verdict=verdicts.pop() if len(verdicts) == 1 else "doubtful",
    )


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
    return math.sqrt(float(np.mean(np.square(values))))
