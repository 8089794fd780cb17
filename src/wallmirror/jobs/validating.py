"""`wallmirror validate`: is the one-bounce model what a path tracer renders, and how small a fault would show?"""

from __future__ import annotations

import json
import math
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, AngleSumBRDF, GaussianTrain, Mirror, Sum
from wallmirror.comparison import Comparison, compare, cross_weights
from wallmirror.console import Advance
from wallmirror.files import write_atomically
from wallmirror.geometry import Card, Observer, pixel_half_width, pixel_tangents, wall_points
from wallmirror.pathtracing.building import wall_as_rendered
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.report.figures import radiance_maps, scene_plan, score_histogram
from wallmirror.scene import Scene
from wallmirror.transport import Kernel, build_kernel, mirror_matrix, radiance

Array = NDArray[np.float64]

#: From observer, card and BRDF to F, shape (A, N, M).
Transport = Callable[[Observer, Card, BRDF], Array]

#: Views and samples per pixel of each seed, by default and in a hurry.
VIEWS, SPP = 8, 256
QUICK_VIEWS, QUICK_SPP = 3, 64

#: Seeds of one comparison: enough to know their scatter to 13 %.
SEEDS = 32
_SHIFT = math.radians(1e-3)


@dataclass(frozen=True)
class Validation:
    """One scene's render against its analytic reference, at one bounce.

    Parameters
    ----------
    reference, mean:
        Analytic and path-traced radiance of the views compared, (A, N).
    views:
        Indices of those views.
    interpolation:
        How far the table that Mitsuba holds is from the wall's model after transport: the largest difference of two
        analytic radiances over the largest radiance. The comparison is with the table and does not contain it.
    same_as:
        Name of the scene whose render this is, where two differ in nothing that one bounce meets; else empty.
    tolerance:
        Gain error that the run was to see, if one was asked for.
    """

    scene: Scene
    views: tuple[int, ...]
    reference: Array
    mean: Array
    comparison: Comparison
    spp: int
    seconds: float
    interpolation: float
    same_as: str = ""
    tolerance: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the model was not rejected, by a run that would have seen a gain error of the tolerance, if one is set."""
        return self.comparison.passed and self.fine_enough

    @property
    def fine_enough(self) -> bool:
        """Whether a gain error of the tolerance would have shown; True where none is set."""
        return self.tolerance is None or self.comparison.gain.detectable <= self.tolerance

    def summary(self) -> dict[str, Any]:
        """The scene's part of results.json."""
        return {
            "scene": self.scene.name,
            "views": list(self.views),
            "seeds": SEEDS,
            "spp_per_seed": self.spp,
            "same_as": self.same_as or None,
            "tolerance": self.tolerance,
            "seconds": self.seconds,
            "table_interpolation": self.interpolation,
            **self.comparison.summary(),
        }


def validate_scene(
    scene: Scene,
    *,
    views: int = VIEWS,
    spp: int = SPP,
    seed: int = 0,
    realisation: int = 0,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> Validation:
    """Render a scene at one bounce with many seeds and test it against the physical model.

    Parameters
    ----------
    views:
        How many of the scene's views to compare, spread evenly.
    spp:
        Samples per pixel of each of the 32 seeds.
    realisation:
        Which of the scene's patterns lights the card.

    Notes
    -----
    At one bounce a room or a reflective card adds nothing, so every scene can be compared; what further bounces add is
    another question. Stratified samples are used, as the statistics rest on the scatter between seeds alone.
    """
    started = time.perf_counter()
    sample = render_seeds(
        scene, views=views, spp=spp, seed=seed, realisation=realisation, variant=variant, progress=progress
    )
    expectation = expect(scene, sample.views, realisation=realisation)
    return Validation(
        scene,
        sample.views,
        expectation.reference,
        sample.seeds.mean(axis=0),
        judge(sample, expectation),
        spp,
        seconds=time.perf_counter() - started,
        interpolation=expectation.interpolation,
    )


@dataclass(frozen=True)
class Sample:
    """The rendered side of a comparison: independent one-bounce renders of some views, `seeds` of shape (S, A, N)."""

    views: tuple[int, ...]
    seeds: Array


@dataclass(frozen=True)
class Expectation:
    """The analytic side of a comparison.

    Parameters
    ----------
    reference:
        One-bounce radiance, shape (A, N).
    templates:
        For each (name, unit) of a bias its change of the reference per unit, shape (A, N).
    edges:
        Pixels that are left out, shape (A, N).
    interpolation:
        As for `Validation`.
    """

    reference: Array
    templates: dict[tuple[str, str], Array]
    edges: NDArray[np.bool_]
    interpolation: float


def render_seeds(
    scene: Scene,
    *,
    views: int,
    spp: int,
    seed: int = 0,
    realisation: int = 0,
    count: int = SEEDS,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> Sample:
    """The rendered side, with parameters as for `validate_scene`, and `count` seeds."""
    last = scene.observer.views - 1
    chosen = tuple(int(v) for v in np.unique(np.linspace(0, last, views).round().astype(int)))
    # Looking through a board displaces what is seen by a hundredth of a pixel (see `building`), which this test would
    # notice. At one bounce the board has no other effect, so it is taken away.
    bare = replace(scene, card=replace(scene.card, board_width=0.0, board_height=0.0))
    renderer = Renderer(bare, variant=variant)
    roots = spread_seeds(seed, len(chosen) * count)
    seeds = np.empty((count, len(chosen), scene.observer.pixels))
    for a, view in enumerate(chosen):
        mine = roots[a * count : (a + 1) * count]
        pattern = scene.source[:, realisation]
        render = renderer.render(view, pattern, spp=spp, seeds=mine, max_depth=2, sampler="multijitter", method="seeds")
        seeds[:, a] = render.per_seed
        if progress is not None:
            progress(a + 1, len(chosen))
    return Sample(chosen, seeds)


def expect(
    scene: Scene, views: tuple[int, ...], *, realisation: int = 0, transport: Transport | None = None
) -> Expectation:
    """The analytic side of chosen views; a `transport` of one's own shows what a wrong one would do."""
    observer = replace(scene.observer, view_angles=tuple(scene.observer.view_angles[v] for v in views))
    pattern = scene.source[:, realisation]
    brdf = wall_as_rendered(scene)
    kernels: dict[float, Kernel] = {}  # the templates share the scene's angular scale, and with it the kernel

    def analytic(model: BRDF) -> Array:
        if transport is not None:
            matrix = transport(observer, scene.card, model)
        elif isinstance(model, Mirror):
            matrix = mirror_matrix(observer, scene.card, model)
        else:
            scale = model.angular_scale
            kernels[scale] = kernels.get(scale) or physical_kernel(observer, scene.card, scale)
            matrix = kernels[scale].apply(model)
        return radiance(matrix, pattern[:, None])[..., 0]

    if isinstance(brdf, Mirror):
        # Pixels that see a strip's border: there the share of the pixel, not the transport, is what is compared.
        share = mirror_matrix(observer, scene.card, brdf)
        edges = np.any((share > 0) & (share < share.max() * (1 - 1e-9)), axis=-1)
        edges |= _beside(edges)
    else:
        edges = _behind_strips(observer, scene.card)
    reference = analytic(brdf)
    off = float(np.max(np.abs(reference - analytic(scene.wall.brdf)), initial=0.0))
    return Expectation(
        reference,
        _templates(scene, analytic),
        edges,
        interpolation=off / max(float(reference.max(initial=0.0)), 1e-300),
    )


def judge(sample: Sample, expectation: Expectation) -> Comparison:
    """The verdict of `validate` on two sides, whatever they are."""
    return compare(
        sample.seeds,
        expectation.reference,
        templates=expectation.templates,
        edges=expectation.edges,
        weights=cross_weights(sample.seeds, expectation.reference),
    )


def physical_transport(observer: Observer, card: Card, brdf: BRDF) -> Array:
    """F to about 1e-5 of its peak and 3e-7 in the gain."""
    if isinstance(brdf, Mirror):
        return mirror_matrix(observer, card, brdf)
    return physical_kernel(observer, card, brdf.angular_scale).apply(brdf)


def physical_kernel(observer: Observer, card: Card, angular_scale: float) -> Kernel:
    """The kernel that `validate` compares with, for BRDFs of an angular scale in radians.

    The kinks of an interpolated table keep a quadrature from converging further, so no tolerance is pursued here.
    """
    return build_kernel(observer, card, resolution=angular_scale / 8, tolerance=1e-9)


def _behind_strips(observer: Observer, card: Card) -> NDArray[np.bool_]:
    """Pixels, shape (A, N), that may see the wall through a strip, which displaces the rays (see `building`)."""
    if observer.distance <= card.distance:
        return np.zeros((observer.views, observer.pixels), dtype=bool)
    half = pixel_half_width(observer)
    ends = wall_points(observer, pixel_tangents(observer)[:, None] + 2 * half * np.array([-1.0, 1.0]))
    x_o = observer.position[0]
    at_card = x_o + (ends - x_o) * (1 - card.distance / observer.distance)
    low, high = at_card.min(axis=-1)[..., None], at_card.max(axis=-1)[..., None]
    centres = np.asarray(card.elements_x)
    through = (low < centres + card.element_width / 2) & (high > centres - card.element_width / 2)
    return np.asarray(through.any(axis=-1))


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The neighbours of marked pixels, which a sample at the very border can reach."""
    wide = np.pad(mask, ((0, 0), (1, 1)))
    return np.asarray(wide[:, :-2] | wide[:, 2:])


def _templates(scene: Scene, analytic: Callable[[BRDF], Array]) -> dict[tuple[str, str], Array]:
    """What a shift of all lobes and the loss of each single lobe would do to the picture."""
    brdf = scene.wall.brdf
    if isinstance(brdf, Mirror) or not isinstance(brdf, AngleSumBRDF):
        return {}
    train = next((b for b in (brdf.parts if isinstance(brdf, Sum) else (brdf,)) if isinstance(b, GaussianTrain)), None)
    if train is None:
        return {}
    shifted = replace(train, centres=tuple(c + _SHIFT for c in train.centres))
    templates = {("lobe shift", "deg"): (analytic(shifted) - analytic(train)) / math.degrees(_SHIFT)}
    for centre in train.centres:
        name = f"lobe at {math.degrees(centre):+.0f} deg"
        templates[(name, "of 1")] = analytic(replace(train, centres=(centre,)))
    return templates


def validate_scenes(
    scenes: list[Scene],
    out: Path,
    *,
    views: int | None = None,
    spp: int | None = None,
    tolerance: float | None = None,
    effort: Callable[[Scene], tuple[int, int]] = lambda _: (VIEWS, SPP),
    seed: int = 0,
    progress: Advance | None = None,
) -> list[Validation]:
    """Validate several scenes; leaves results.json and report.html in a folder.

    Scenes that one bounce cannot tell apart (a white card or a black one) are rendered once.

    Parameters
    ----------
    views, spp:
        As for `validate_scene`; those of `effort` where left out.
    tolerance:
        Gain error that each run must be able to see, or else does not pass.
    effort:
        Views and samples per pixel for a scene, such as a plan's.
    """
    results: list[Validation] = []
    rendered: dict[bytes, Validation] = {}
    for number, scene in enumerate(scenes):
        met = _met_at_one_bounce(scene)
        earlier = rendered.get(met)
        if earlier is None:
            planned = effort(scene) if views is None or spp is None else (views, spp)
            found = validate_scene(scene, views=views or planned[0], spp=spp or planned[1], seed=seed)
            rendered[met] = replace(found, tolerance=tolerance)
            results.append(rendered[met])
        else:
            results.append(replace(earlier, scene=scene, seconds=0.0, same_as=earlier.scene.name))
        if progress is not None:
            progress(number + 1, len(scenes))
    write_page(
        out / "report.html",
        title="Does the model hold? Analytic one-bounce transport against Mitsuba 3",
        lead="Every scene is rendered by a path tracer that shares no code with the model, with independent seeds, and "
        "compared pixel by pixel. A pass says what bias would have been caught, not only that none was.",
        verdicts=[verdict(r) for r in results],
        sections=[section(r) for r in results],
    )
    write_atomically(out / "results.json", json.dumps([r.summary() for r in results], indent=2, allow_nan=False) + "\n")
    return results


def _met_at_one_bounce(scene: Scene) -> bytes:
    """All of a scene that paths of one bounce meet: the card's board and albedo are not of it."""
    card = replace(scene.card, albedo=0.0, board_width=0.0, board_height=0.0)
    return pickle.dumps((scene.observer, card, scene.wall, scene.room, scene.source.tolist()))


def verdict(result: Validation) -> Verdict:
    """One sentence on one scene."""
    gain = result.comparison.gain
    if result.comparison.exact and result.fine_enough:
        text = f"{result.scene.name}: agrees to {result.comparison.relative_rms:.1e} of the brightest pixel"
    elif result.passed:
        text = (
            f"{result.scene.name}: model and Mitsuba are not told apart; gain - 1 = {gain.estimate:+.1e} ± "
            f"{gain.standard_error:.0e}, and a gain error of {gain.detectable:.0e} would have been caught"
        )
    elif result.comparison.passed:
        text = (
            f"{result.scene.name}: TOO COARSE; not told apart, but only a gain error of {gain.detectable:.1e} would have been "
            f"caught, not {result.tolerance:g}; take more views or samples"
        )
    else:
        text = f"{result.scene.name}: REJECTED; gain - 1 = {gain.estimate:+.1e} ± {gain.standard_error:.0e}"
    return Verdict(result.passed, text)


def section(result: Validation) -> Section:
    """The report's section on one scene: prose, plan, maps, numbers."""
    scene = result.scene
    return Section(
        scene.title,
        (
            scene.about,
            verdict(result),
            FigureBlock(
                scene_plan(scene.observer, scene.card, half_width=scene.wall.half_width, room=scene.room),
                "The scene from above, to scale.",
            ),
            *(_comparison(result) if not result.same_as else (_same(result),)),
        ),
    )


def _comparison(result: Validation) -> tuple[FigureBlock | TableBlock, ...]:
    c = result.comparison
    return (
        FigureBlock(
            radiance_maps(result.reference, result.mean, c),
            f"Views {', '.join(str(v + 1) for v in result.views)}: analytic and path-traced radiance on one scale, and "
            "their difference in standard errors. Noise alone gives no structure.",
        ),
        *(() if c.exact else (FigureBlock(score_histogram(c), "The same differences against the normal curve."),)),
        numbers(result),
    )


def _same(result: Validation) -> str:
    return (
        f"Nothing that one bounce meets tells this scene from {result.same_as}, so that render, its maps and its numbers are "
        "this scene's too. What further bounces add here, `wallmirror validate --bounces` measures."
    )


def numbers(result: Validation) -> TableBlock:
    """The tests of one scene in a table."""
    c = result.comparison
    rows = [
        (
            b.name,
            f"{b.estimate:+.2e} {b.unit}",
            f"± {b.standard_error:.1e}",
            f"{b.p_value:.3g}",
            f"{b.detectable:.1e} {b.unit}",
        )
        for b in c.biases
    ]
    rows.append(("z scores", f"mean {c.z_mean:+.3f}, std {c.z_std:.3f}", "", "", "0 and 1 expected"))
    rows.append(("largest |z|", f"{c.largest_z:.2f}", "", f"{c.largest_p:.3g}", "Sidak-corrected"))
    rows.append(("p-values of tiles uniform", "", "", f"{c.uniformity_p:.3g}", "Kolmogorov-Smirnov"))
    rows.append(("pixels", f"{c.kept} kept", f"{c.starved} starved", f"{c.edges} at edges", ""))
    rows.append(
        ("table interpolation", f"{result.interpolation:.1e} of the brightest pixel", "", "", "not in the test")
    )
    rows.append(("cost", f"{result.seconds:.1f} s", f"{SEEDS} seeds", f"{result.spp} spp each", ""))
    return TableBlock(("test", "found", "standard error", "p-value", "would be caught from"), tuple(rows))
