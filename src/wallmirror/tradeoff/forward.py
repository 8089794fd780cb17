"""Forward: how much error a second buys, for the analytic model, its cheaper forms, and a path tracer.

All against ONE reference, the physical model at a quadrature tolerance of 1e-12, which a brute-force integral of the
reflection equation checks. The convolutions of section 3.1 render points, so they have a group of their own, against
Algorithm 1 in extended precision.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from wallmirror.brdf import tabulate
from wallmirror.tradeoff.forward_analytic import POINTS, analytic_runs, convolution_runs, films_of
from wallmirror.tradeoff.forward_task import IMAGE, check_reference, image_task
from wallmirror.tradeoff.forward_tracing import TABLE_NODES, path_tracing_steps
from wallmirror.tradeoff.forward_words import conclude, of_forms, slopes_of, table_of
from wallmirror.tradeoff.runs import Omission, Panel, Run

Advance = Callable[[int, int], None]


def forward(*, quick: bool = False, seed: int = 0, mitsuba: bool = True, progress: Advance | None = None) -> Panel:
    """Measure the panel.

    Parameters
    ----------
    quick:
        Two views instead of four, fewer settings and samples.
    mitsuba:
        Whether the path tracer takes part; without it nothing imports it.
    """
    task = image_task(views=2 if quick else 4)
    steps: list[Callable[[], list[Run]]] = [
        partial(analytic_runs, task, quick=quick),
        *(partial(convolution_runs, group, quick=quick) for group in POINTS),
    ]
    omissions = [
        Omission(
            "double precision in Mitsuba",
            "its Linux wheels have no double variant, so its own floor (float32 film and table) stays in its runs",
        )
    ]
    if mitsuba:
        steps += path_tracing_steps(task, quick=quick, seed=seed)
        if quick:
            omissions.append(Omission("stratified, ldsampler, depth 8, rgb and scalar", "left to the full run"))
    else:
        omissions.append(Omission("Mitsuba", "left out on request"))
    runs: list[Run] = []
    for number, step in enumerate(steps, 1):
        runs += step()
        if progress is not None:
            progress(number, len(steps))
    check = check_reference(task, entries=4 if quick else 12)
    floor = task.error(films_of(task, tabulate(task.parts[2], TABLE_NODES), (8, 12))) if mitsuba else 0.0
    image = tuple(run for run in runs if run.group == IMAGE)
    observer, card, _ = task.parts
    return Panel(
        name="forward",
        title="Forward: error against seconds of one image",
        question="How many times faster is the analytic model at equal error?",
        setting=(
            f"{observer.views} views x {observer.pixels} pixels of one pattern of {card.elements} strips on a wall of four "
            "lobes of sigma 1°, one bounce. Error: root mean square over all pixels, relative to that of the reference. "
            "Seconds: processor time of all threads together. Mitsuba's scenes are loaded and compiled before the clock "
            "starts, and one clocked call of the analytic model does everything from the scene's numbers to the image. On "
            "the wall clock Mitsuba divides its seconds among its threads; the analytic model has one."
        ),
        runs=tuple(runs),
        conclusions=(*conclude(image, floor=floor), *of_forms(runs), check[0]),
        omissions=tuple(omissions),
        numbers={
            "reference_tolerance": task.tolerance,
            "reference_against_brute_force": check[1],
            "path_tracer_floor": floor,
            "slopes": slopes_of(image),
        },
        tables=(table_of(image, floor),),
    )
