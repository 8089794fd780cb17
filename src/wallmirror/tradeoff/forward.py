"""Forward: how much error a second buys, for the analytic model, its cheaper forms, and a path tracer.

All against ONE reference, the physical model at a quadrature tolerance of 1e-12, which a brute-force integral of the
reflection equation checks. The convolutions of section 3.1 render points, so they have a group of their own, against
Algorithm 1 in extended precision.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, GaussianTrain, tabulate
from wallmirror.convolution import angle_convolution, spherical_convolution, wall_convolution
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer
from wallmirror.scene import Scene, load_scene
from wallmirror.tradeoff.clock import Timing, once, timed
from wallmirror.tradeoff.pareto import Reach, falls, fit_line, reach_along_line, reach_by_run, short_seconds, tail_line
from wallmirror.tradeoff.reference import brute_force, points_in_extended_precision
from wallmirror.tradeoff.runs import Omission, Panel, Run, Statement, by_method
from wallmirror.tradeoff.single_precision import transport_in_single_precision
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]
Advance = Callable[[int, int], None]

IMAGE = "image of a lobed wall (sigma 1°)"
#: Groups of the convolutions, and how many times as far the card then stands.
POINTS = {"convolutions, card at 1 m": 1.0, "convolutions, card at 500 m": 500.0}
BY_TOLERANCE = "physical model, to a tolerance"
PHYSICAL, SINGLE = "physical model, float64", "physical model, float32"
ALGORITHM_1 = "Algorithm 1, points (free scale)"
TABLED = "physical model, BRDF table"
TARGETS = (1e-2, 1e-3, 1e-4)
#: What was asked for at an error of 1e-3: how many times faster than the best sampler, and than independent samples.
ASKED_AT, ASKED_BEST, ASKED_INDEPENDENT = 1e-3, 100.0, 5000.0

_SAMPLERS: tuple[tuple[Any, tuple[int, ...]], ...] = (
    ("independent", (16, 64, 256, 1024, 4096, 16384)),
    ("stratified", (16, 64, 256, 1024, 4096, 16384)),
    ("multijitter", (16, 64, 256, 1024, 4096, 16384)),
    ("orthogonal", (25, 49, 289, 1369, 4489, 17161)),
    ("ldsampler", (16, 64, 256, 1024, 4096, 16384)),
)
_QUICK_SPP = 2000  # samples per pixel up to which the quick run goes
_QUICK_SAMPLERS = ("independent", "multijitter", "orthogonal")
# Nodes of the path tracer's table: fine enough that a linear interpolation does not end its lines early.
_TABLE_NODES = 57_601
_SEEDS = 2


@dataclass(frozen=True)
class _Task:
    """The image that everybody renders, with its reference."""

    scene: Scene
    pattern: Array
    reference: Array
    tolerance: float

    @property
    def parts(self) -> tuple[Observer, Card, GaussianTrain]:
        brdf = self.scene.wall.brdf
        assert isinstance(brdf, GaussianTrain)
        return self.scene.observer, self.scene.card, brdf

    def error(self, films: Array) -> float:
        """Relative error over all views and pixels."""
        return float(np.linalg.norm(films - self.reference) / np.linalg.norm(self.reference))


def forward(*, quick: bool = False, seed: int = 0, mitsuba: bool = True, progress: Advance | None = None) -> Panel:
    """Measure the panel.

    Parameters
    ----------
    quick:
        Two views instead of four, fewer settings and samples.
    mitsuba:
        Whether the path tracer takes part; without it nothing imports it.
    """
    task = _task(views=2 if quick else 4)
    steps: list[Callable[[], list[Run]]] = [
        partial(_analytic, task, quick=quick),
        *(partial(_convolutions, group, quick=quick) for group in POINTS),
    ]
    omissions = [
        Omission(
            "double precision in Mitsuba",
            "its Linux wheels have no double variant, so its own floor (float32 film and table) stays in its runs",
        )
    ]
    if mitsuba:
        steps += _path_tracing(task, quick=quick, seed=seed)
        if quick:
            omissions.append(Omission("stratified, ldsampler, depth 8, rgb and scalar", "left to the full run"))
    else:
        omissions.append(Omission("Mitsuba", "left out on request"))
    runs: list[Run] = []
    for number, step in enumerate(steps, 1):
        runs += step()
        if progress is not None:
            progress(number, len(steps))
    check = _check(task, entries=4 if quick else 12)
    floor = task.error(_films(task, tabulate(task.parts[2], _TABLE_NODES), (8, 12))) if mitsuba else 0.0
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
        conclusions=(*conclude(image, floor=floor), *_forms(runs), check[0]),
        omissions=tuple(omissions),
        numbers={
            "reference_tolerance": task.tolerance,
            "reference_against_brute_force": check[1],
            "path_tracer_floor": floor,
            "slopes": _slopes(image),
        },
        tables=(_table(image, floor),),
    )


# -- the task and its reference ---------------------------------------------------------------------------------------


def _task(views: int) -> _Task:
    scene = load_scene("flat_wall_lobes")
    angles = scene.observer.view_angles
    chosen = tuple(angles[i] for i in np.linspace(0, len(angles) - 1, views).round().astype(int))
    scene = replace(scene, observer=replace(scene.observer, view_angles=chosen))
    pattern = scene.source[:, :1]
    tolerance = 1e-12
    reference = radiance(transport_matrix(scene.observer, scene.card, scene.wall.brdf, tolerance=tolerance), pattern)
    return _Task(scene, pattern, reference, tolerance)


def _check(task: _Task, entries: int) -> tuple[Statement, float]:
    """The reference against an integral that shares no formula with it."""
    observer, card, brdf = task.parts
    transport = transport_matrix(observer, card, brdf, tolerance=task.tolerance)
    order = np.argsort(transport, axis=None)[::-1]
    # From the brightest entry down to a hundredth of it, evenly in rank.
    bright = order[: int(np.count_nonzero(transport > 0.01 * transport.max()))]
    picked = bright[np.linspace(0, bright.size - 1, entries).astype(int)]
    worst = 0.0
    for flat in picked:
        place = np.unravel_index(flat, transport.shape)
        worst = max(worst, abs(brute_force(observer, card, brdf, place) / float(transport[place]) - 1))
    return (
        Statement(
            f"The reference is right to {worst:.0e}: {entries} of its entries, from the brightest down to a hundredth of it, "
            "against the reflection equation integrated by brute force in four dimensions.",
            worst < 1e-9,
        ),
        worst,
    )


# -- the analytic model and its forms ---------------------------------------------------------------------------------


def _analytic(task: _Task, *, quick: bool) -> list[Run]:
    observer, card, brdf = task.parts
    orders = ((1, 1), (1, 2), (1, 3), (2, 4), (2, 6), (4, 8)) if quick else tuple(
        (p, s) for p in (1, 2, 3, 4, 6) for s in (1, 2, 3, 4, 5, 6, 8, 10, 12)
    )  # fmt: skip
    repeats = 3 if quick else 5

    def run(method: str, knobs: dict[str, Any], work: Callable[[], Array], *, free_scale: bool = False) -> Run:
        films, timing = timed(work, repeats=repeats)
        error = scale_free_error(films, task.reference) if free_scale else task.error(films)
        return _run(IMAGE, method, knobs, timing, error)

    runs = []
    for p, s in orders:
        knobs = {"pixel nodes": p, "strip nodes": s}
        runs.append(run(PHYSICAL, knobs, partial(_films, task, brdf, (p, s))))
        runs.append(run(SINGLE, knobs, partial(_single_films, task, (p, s))))
    for tolerance in (1e-2, 1e-4, 1e-8) if quick else (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10):
        work = partial(_to_tolerance, task, tolerance)
        runs.append(run(BY_TOLERANCE, {"tolerance": tolerance}, work))
    for nodes in (361, 1801, 7201) if quick else (181, 361, 721, 1801, 3601, 7201, 14401, 28801):
        table = tabulate(brdf, nodes)
        runs.append(run(TABLED, {"table nodes": nodes}, partial(_films, task, table, (4, 10))))
    for points in (1, 2, 4) if quick else (1, 2, 4, 8, 16):
        cut = _as_points(card, points)
        pattern = np.repeat(task.pattern, points, axis=0) / points
        runs.append(
            run(
                ALGORITHM_1,
                {"points per strip": points},
                partial(_algorithm_1, observer, cut, brdf, pattern),
                free_scale=True,
            )
        )
    return runs


def _films(task: _Task, brdf: BRDF, orders: tuple[int, int]) -> Array:
    return radiance(transport_matrix(task.scene.observer, task.scene.card, brdf, orders=orders), task.pattern)


def _to_tolerance(task: _Task, tolerance: float) -> Array:
    """What a user does, who does not know the orders: they grow until F moves by less than the tolerance."""
    return radiance(transport_matrix(*task.parts, tolerance=tolerance), task.pattern)


def _single_films(task: _Task, orders: tuple[int, int]) -> NDArray[Any]:
    return transport_in_single_precision(*task.parts, orders=orders) @ task.pattern.astype(np.float32)


def _algorithm_1(observer: Observer, card: Card, brdf: BRDF, pattern: Array) -> Array:
    return radiance(transport_matrix(observer, card, brdf, weights="cosine"), pattern)


def _as_points(card: Card, points: int) -> Card:
    """Each strip as so many points, evenly spread over its width."""
    offsets = ((np.arange(points) + 0.5) / points - 0.5) * card.element_width
    places = (np.asarray(card.elements_x)[:, None] + offsets).ravel()
    return Card(elements_x=tuple(map(float, places)), y=card.y)


def _convolutions(group: str, *, quick: bool) -> list[Run]:
    """The forms of section 3.1 against Algorithm 1, all with points and cos theta_s; a far card is as much larger."""
    scene = load_scene("flat_wall_lobes")
    brdf = scene.wall.brdf
    assert isinstance(brdf, GaussianTrain)
    angles = scene.observer.view_angles[:: 10 if quick else 5]
    observer = replace(scene.observer, view_angles=angles, pixels_at="edges")
    places = tuple(x * POINTS[group] for x in scene.card.elements_x)
    card = Card(elements_x=places, y=scene.card.y * POINTS[group])
    pattern = scene.source[:, 0]
    reference = points_in_extended_precision(observer, card, brdf, pattern)

    def run(method: str, knobs: dict[str, Any], work: Callable[[], Any]) -> Run:
        started = time.process_time()
        try:
            films, timing = timed(work, repeats=3)
        except InputError as refusal:
            seconds = time.process_time() - started
            return Run(group=group, method=method, knobs=knobs, seconds=seconds, failure=str(refusal))
        error = float(np.linalg.norm(np.asarray(films - reference, dtype=np.float64)) / np.linalg.norm(reference))
        return _run(group, method, knobs, timing, error)

    runs = [run("Algorithm 1, float64", {}, partial(_algorithm_1, observer, card, brdf, pattern))]
    samples = (250, 500, 1000, 2000) if quick else (125, 250, 500, 1000, 2000, 4000, 8000, 16000)
    for order in (3, 5):
        for k in samples:
            knobs = {"directions": k, "spline order": order}
            runs.append(
                run(
                    f"one convolution a wall point (eq. 3.5), order {order}",
                    knobs,
                    partial(
                        spherical_convolution, observer, card, brdf, pattern, samples=k, order=order, weights="cosine"
                    ),
                )
            )
    runs += [
        run(
            "one convolution over the angle sum",
            {"directions": k},
            partial(angle_convolution, observer, card, brdf, pattern, samples=k, weights="cosine"),
        )
        for k in samples
    ]
    projections: tuple[Literal["observer", "both"], ...] = ("observer", "both")
    runs += [
        run(
            "one convolution along the wall (eq. 3.7)",
            {"projected from": where},
            partial(wall_convolution, observer, card, brdf, pattern, projected_from=where, weights="cosine"),
        )
        for where in projections
    ]
    return runs


def _run(
    group: str,
    method: str,
    knobs: dict[str, Any],
    timing: Timing,
    error: float,
    *,
    work: float = math.nan,
    **extra: float,
) -> Run:
    return Run(
        group=group,
        method=method,
        knobs=knobs,
        seconds=timing.seconds,
        wall_seconds=timing.wall_seconds,
        error=error,
        work=work,
        extra=extra,
    )


# -- the path tracer --------------------------------------------------------------------------------------------------


def _path_tracing(task: _Task, *, quick: bool, seed: int) -> list[Callable[[], list[Run]]]:
    """One step for each line of the path tracer, so that progress can be told."""
    steps: list[Callable[[], list[Run]]] = [
        partial(
            _rendered, task, f"Mitsuba, {sampler}", tuple(n for n in counts if not quick or n < _QUICK_SPP), seed=seed,
            sampler=sampler,
        )
        for sampler, counts in _SAMPLERS if not quick or sampler in _QUICK_SAMPLERS
    ]  # fmt: skip
    if quick:
        steps.append(
            partial(
                _rendered, task, "Mitsuba, depth 50, roulette from 5", (64, 1024), seed=seed, max_depth=50, rr_depth=5
            )
        )
        return steps
    some = (64, 256, 1024, 4096)
    variations: tuple[tuple[str, dict[str, Any]], ...] = (
        ("Mitsuba, depth 8", {"max_depth": 8}),
        ("Mitsuba, depth 50, roulette from 5", {"max_depth": 50, "rr_depth": 5}),
        ("Mitsuba, rgb", {"variant": "llvm_ad_rgb"}),
    )
    steps += [partial(_rendered, task, name, some, seed=seed, **options) for name, options in variations]
    steps.append(partial(_rendered, task, "Mitsuba, scalar", (4,), seed=seed, variant="scalar_rgb", seeds=1))
    return steps


def _rendered(
    task: _Task,
    method: str,
    counts: Sequence[int],
    *,
    seed: int,
    sampler: Any = "independent",
    max_depth: int = 2,
    rr_depth: int = 1000,
    variant: str = "llvm_ad_mono",
    seeds: int = _SEEDS,
) -> list[Run]:
    from wallmirror.pathtracing.rendering import Renderer, spread_seeds

    scene = replace(task.scene, wall=replace(task.scene.wall, brdf=tabulate(task.parts[2], _TABLE_NODES)))
    renderer = Renderer(scene, variant=variant, pass_samples=max(counts))

    def image(spp: int, number: int, views: range) -> Array:
        # Where the samples are not independent, two seeds are what a variance needs; both are kept, each its own image.
        render = partial(
            renderer.render,
            radiances=task.pattern[:, 0],
            spp=spp,
            max_depth=max_depth,
            rr_depth=rr_depth,
            sampler=sampler,
        )
        return np.stack([render(view, seeds=spread_seeds(number, seeds), method="seeds" if seeds > 1 else None).per_seed
                         for view in views], axis=1)  # fmt: skip

    runs = []
    for spp in counts:
        image(spp, seed, range(1))  # compiles
        films, timing = once(partial(image, spp, seed + 1, range(scene.observer.views)))
        error = math.sqrt(float(np.mean([task.error(films[s][..., None]) ** 2 for s in range(seeds)])))
        knobs = {"spp": spp, "sampler": sampler, "max depth": max_depth, "roulette from": rr_depth, "variant": variant}
        share = Timing(timing.seconds / seeds, timing.wall_seconds / seeds, seeds)
        runs.append(_run(IMAGE, method, knobs, share, error, work=float(spp), images=float(seeds)))
    return runs


# -- what follows -----------------------------------------------------------------------------------------------------


def conclude(runs: Sequence[Run], *, floor: float) -> list[Statement]:
    """How many times faster the analytic model is at equal error, from the runs of one image.

    Parameters
    ----------
    floor:
        Error that the path tracer keeps however long it runs: nothing is extrapolated to or below it.
    """
    lines = by_method(runs)
    statements = []
    for target in TARGETS:
        ours = reach_by_run(lines.get(PHYSICAL, ()), target)
        if ours is None:
            statements.append(Statement(f"No run of the analytic model comes to {target:g}.", False))
            continue
        tracers = {m: reach_along_line(rs, target, floor=floor) for m, rs in lines.items() if _is_sampler(m)}
        reached = {m: r for m, r in tracers.items() if r is not None}
        if not reached:
            continue
        best = min(reached, key=lambda m: reached[m].seconds)
        independent = reached.get("Mitsuba, independent")
        ratio = reached[best].seconds / ours.seconds
        text = (
            f"At an error of {target:g} the analytic model takes {short_seconds(ours.seconds)}: "
            f"{_times(ratio)} faster than Mitsuba's best sampler here, {_name(best)}, {reached[best].words}"
        )
        met = ratio >= ASKED_BEST if target == ASKED_AT else None
        if independent is not None:
            slower = independent.seconds / ours.seconds
            text += f"; {_times(slower)} faster than independent samples, {independent.words}"
            if target == ASKED_AT:
                met = bool(met) and slower >= ASKED_INDEPENDENT
        if target == ASKED_AT:
            text += f" (asked: {ASKED_BEST:g} and {ASKED_INDEPENDENT:g} times)"
        statements.append(Statement(text + ".", met))
    return statements


def _forms(runs: Sequence[Run]) -> list[Statement]:
    """What float32, tables, Algorithm 1 and the convolutions make of it."""
    lines = by_method(runs)
    best = {m: min(r.error for r in rs if not r.failure) for m, rs in lines.items() if any(not r.failure for r in rs)}
    statements = []
    single = reach_by_run(lines[SINGLE], ASKED_AT)
    double = reach_by_run(lines[PHYSICAL], ASKED_AT)
    if single is not None and double is not None:
        statements.append(
            Statement(
                f"float32 comes to {ASKED_AT:g} {double.seconds / single.seconds:.2g} times as fast as float64 and ends at "
                f"{best[SINGLE]:.0e}; float64 ends at {best[PHYSICAL]:.0e}."
            )
        )
    asked = reach_by_run(lines[BY_TOLERANCE], ASKED_AT)
    if asked is not None and double is not None:
        statements.append(
            Statement(
                "Asked for a tolerance instead of known orders, as a user would, the model takes "
                f"{short_seconds(asked.seconds)} to {ASKED_AT:g}, {asked.seconds / double.seconds:.2g} times as long: it looks "
                "for the orders, and proves them."
            )
        )
    tables = [run for run in lines[TABLED] if not run.failure]
    if len(tables) > 2:
        coarse = [run for run in tables if run.error > 3 * best[TABLED]]
        slope = (
            fit_line([r.knobs["table nodes"] for r in coarse], [r.error for r in coarse]).slope
            if len(coarse) > 2
            else math.nan
        )
        fall = f"its error falls as nodes^{slope:.1f} and ends at" if math.isfinite(slope) else "the best is"
        statements.append(Statement(f"A BRDF table instead of the formula: {fall} {best[TABLED]:.0e}."))
    statements.append(
        Statement(
            f"Algorithm 1 is {100 * best[ALGORITHM_1]:.2g} % off the physical model at best, with the scale given to it: more "
            "points do not help, since what it lacks is the second cosine and the squared distance."
        )
    )
    statements += [_of_convolutions([run for run in runs if run.group == group]) for group in POINTS]
    for method, line in lines.items():
        if _is_sampler(method) and len(line) > 4 and not falls(tail_line(line)):
            statements.append(
                Statement(
                    f"{_name(method)} does not converge here: the slope of its slower half is not told from 0, so nothing is "
                    "extrapolated along it."
                )
            )
    return statements


def _of_convolutions(runs: Sequence[Run]) -> Statement:
    """The convolutions beside Algorithm 1: which are right, and which are quicker."""
    lines = by_method(runs)
    ours = lines.pop("Algorithm 1, float64")[0]
    parts = []
    for method, line in lines.items():
        good = [run for run in line if not run.failure]
        if not good:
            parts.append(f"{method} is refused")
            continue
        best = min(good, key=lambda run: run.error)
        parts.append(f"{method}: {best.error:.1e} off at best, in {best.seconds / ours.seconds:.2g} times the seconds")
    return Statement(
        f"{runs[0].group.capitalize()}: Algorithm 1 itself takes {short_seconds(ours.seconds)} and is {ours.error:.0e} off; "
        + "; ".join(parts)
        + "."
    )


def _slopes(runs: Sequence[Run]) -> dict[str, list[float]]:
    """Slope of log error over log samples and its standard error, for each line of the path tracer, over its slower half."""
    slopes = {}
    for method, line in by_method(runs).items():
        if method.startswith("Mitsuba") and len(line) > 2:
            fit = tail_line(line)
            slopes[method] = [fit.slope, fit.standard_error]
    return slopes


def _table(runs: Sequence[Run], floor: float) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Processor seconds to each error, method by method, and the ratio to the analytic model."""
    lines = by_method(runs)
    ours = {t: reach_by_run(lines[PHYSICAL], t) for t in TARGETS}
    rows = []
    for method, line in lines.items():
        if len(line) < 3 or method == ALGORITHM_1:
            continue
        cells = []
        for target in TARGETS:
            reach: Reach | None = (
                reach_along_line(line, target, floor=floor)
                if method.startswith("Mitsuba")
                else reach_by_run(line, target)
            )
            own = ours[target]
            if reach is None or own is None:
                cells.append("not reached")
            else:
                mark = "*" if reach.how == "extrapolated" else ""
                cells.append(f"{short_seconds(reach.seconds)}{mark} ({reach.seconds / own.seconds:.3g} x)")
        rows.append((method, *cells))
    title = "Processor seconds to an error, and how many times those of the physical model in float64; * extrapolated"
    return title, ("method", *(f"{t:g}" for t in TARGETS)), tuple(rows)


def _is_sampler(method: str) -> bool:
    return method in {f"Mitsuba, {sampler}" for sampler, _ in _SAMPLERS}


def _name(method: str) -> str:
    return method.removeprefix("Mitsuba, ")


def _times(ratio: float) -> str:
    return f"{float(f'{ratio:.2g}'):,.0f} times" if ratio >= 10 else f"{ratio:.2g} times"
