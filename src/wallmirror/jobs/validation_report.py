"""What `validate` says of a scene: a verdict, a section of the page, a table of its tests."""

from __future__ import annotations

from wallmirror.jobs.validating_one import SEEDS, Validation
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict
from wallmirror.report.figures import radiance_maps, scene_plan, score_histogram


def verdict(result: Validation) -> Verdict:
    """One sentence on one scene."""
    gain = result.comparison.gain
    if result.comparison.kept == 0 or not result.reference.any():
        text = f"{result.scene.name}: NOTHING COMPARED; no pixel away from the strips' edges is lit"
    elif result.comparison.exact and result.passed:
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
