"""`wallmirror validate`: is the one-bounce model what a path tracer renders, and how small a fault would show?"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, AngleSumBRDF, GaussianTrain, Mirror, Sum
from wallmirror.comparison import Comparison, compare
from wallmirror.console import Advance
from wallmirror.files import write_atomically
from wallmirror.geometry import Card, Observer
from wallmirror.pathtracing.building import wall_as_rendered
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.report.figures import radiance_maps, scene_plan, score_histogram
from wallmirror.scene import Scene
from wallmirror.transport import build_kernel, mirror_matrix, radiance

Array = NDArray[np.float64]

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
    """

    scene: Scene
    views: tuple[int, ...]
    reference: Array
    mean: Array
    comparison: Comparison
    spp: int
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the model was not rejected."""
        return self.comparison.passed

    def summary(self) -> dict[str, Any]:
        """The scene's part of results.json."""
        return {
            "scene": self.scene.name,
            "views": list(self.views),
            "seeds": SEEDS,
            "spp_per_seed": self.spp,
            "seconds": self.seconds,
            **self.comparison.summary(),
        }


def validate_scene(
    scene: Scene,
    *,
    views: int = 5,
    spp: int = 256,
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
    chosen = tuple(int(v) for v in np.unique(np.linspace(0, scene.observer.views - 1, views).round().astype(int)))
    pattern = scene.source[:, realisation]
    observer = replace(scene.observer, view_angles=tuple(scene.observer.view_angles[v] for v in chosen))
    brdf = wall_as_rendered(scene)

    def analytic(model: BRDF) -> Array:
        return radiance(_transport(observer, scene.card, model), pattern[:, None])[..., 0]

    reference = analytic(brdf)
    edges = None
    if isinstance(brdf, Mirror):
        # Pixels that see a strip's border: there the share of the pixel, not the transport, is what is compared.
        share = mirror_matrix(observer, scene.card, brdf)
        edges = np.any((share > 0) & (share < share.max() * (1 - 1e-9)), axis=-1)
        edges |= _beside(edges)
    seeds = np.empty((SEEDS, len(chosen), observer.pixels))
    renderer = Renderer(scene, variant=variant)
    roots = spread_seeds(seed, len(chosen) * SEEDS)
    for a, view in enumerate(chosen):
        mine = roots[a * SEEDS : (a + 1) * SEEDS]
        render = renderer.render(view, pattern, spp=spp, seeds=mine, max_depth=2, sampler="multijitter", method="seeds")
        seeds[:, a] = render.per_seed
        if progress is not None:
            progress(a + 1, len(chosen))
    comparison = compare(seeds, reference, templates=_templates(scene, analytic), edges=edges)
    return Validation(
        scene, chosen, reference, seeds.mean(axis=0), comparison, spp, seconds=time.perf_counter() - started
    )


def _transport(observer: Observer, card: Card, brdf: BRDF) -> Array:
    """F to about 1e-5 of its peak and 3e-7 in the gain.

    The kinks of an interpolated table keep a quadrature from converging further, so no tolerance is pursued here.
    """
    if isinstance(brdf, Mirror):
        return mirror_matrix(observer, card, brdf)
    return build_kernel(observer, card, resolution=brdf.angular_scale / 8, tolerance=1e-9).apply(brdf)


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
    views: int = 5,
    spp: int = 256,
    seed: int = 0,
    progress: Advance | None = None,
) -> list[Validation]:
    """Validate several scenes; leaves results.json and report.html in a folder."""
    results = []
    for number, scene in enumerate(scenes):
        results.append(validate_scene(scene, views=views, spp=spp, seed=seed))
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


def verdict(result: Validation) -> Verdict:
    """One sentence on one scene."""
    gain = result.comparison.gain
    if result.comparison.exact:
        text = f"{result.scene.name}: agrees to {result.comparison.relative_rms:.1e} of the brightest pixel"
    elif result.passed:
        text = (
            f"{result.scene.name}: model and Mitsuba are not told apart; gain - 1 = {gain.estimate:+.1e} ± "
            f"{gain.standard_error:.0e}, and a gain error of {gain.detectable:.0e} would have been caught"
        )
    else:
        text = f"{result.scene.name}: REJECTED; gain - 1 = {gain.estimate:+.1e} ± {gain.standard_error:.0e}"
    return Verdict(result.passed, text)


def section(result: Validation) -> Section:
    """The report's section on one scene: prose, plan, maps, numbers."""
    scene, c = result.scene, result.comparison
    return Section(
        scene.title,
        (
            scene.about,
            verdict(result),
            FigureBlock(
                scene_plan(scene.observer, scene.card, half_width=scene.wall.half_width, room=scene.room),
                "The scene from above, to scale.",
            ),
            FigureBlock(
                radiance_maps(result.reference, result.mean, c),
                f"Views {', '.join(str(v + 1) for v in result.views)}: analytic and path-traced radiance on one scale, and "
                "their difference in standard errors. Noise alone gives no structure.",
            ),
            *(() if c.exact else (FigureBlock(score_histogram(c), "The same differences against the normal curve."),)),
            numbers(result),
        ),
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
    rows.append(("cost", f"{result.seconds:.1f} s", f"{SEEDS} seeds", f"{result.spp} spp each", ""))
    return TableBlock(("test", "found", "standard error", "p-value", "would be caught from"), tuple(rows))
