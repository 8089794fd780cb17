"""Inverse: how much error of the pattern a second buys, for every solver over its own knob, with the Cramér-Rao bound."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import GaussianTrain
from wallmirror.captures import CaptureSet
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.few_captures import few_captures
from wallmirror.derendering.foresight import foresee
from wallmirror.derendering.likelihood import maximise, moments
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.solve import solve
from wallmirror.derendering.subspace import closed_form
from wallmirror.derendering.unstructured import de_render_unstructured
from wallmirror.geometry import Card, Observer, scan_angles
from wallmirror.tradeoff.pareto import short_seconds
from wallmirror.tradeoff.runs import Omission, Panel, Run, Statement, by_method
from wallmirror.tradeoff.timed_runs import solved_run
from wallmirror.transport import Weights, radiance, transport_matrix

Array = NDArray[np.float64]

Advance = Callable[[int, int], None]

#: Noise in decibels below the captures' root mean square.
LEVELS = (40, 20)
#: An error within this factor of the bound counts as arrived: one draw of the noise scatters by less.
ARRIVED = 1.5

_WEIGHTS: Weights = "cosine"
_ELEMENTS = 4
_BACKGROUND = 1.0  # counts
_STEP_DEG = 0.5  # of the bound, and of the solvers whose knob is another


@dataclass(frozen=True)
class _Film:
    """Captures of the thesis's scene with noise, and what they were made from."""

    captures: CaptureSet
    source: Array
    sigma: float
    bound: float

    def of(self, realisations: int) -> _Film:
        """The first captures alone."""
        whole = self.captures
        assert whole.variance is not None
        some = CaptureSet(
            observer=whole.observer,
            card=whole.card,
            transport=whole.transport,
            radiance=whole.radiance[..., :realisations],
            variance=whole.variance[..., :realisations],
        )
        source = self.source[:, :realisations]
        return _Film(some, source, self.sigma, _bound(some, source, self.sigma))


def _bound(captures: CaptureSet, source: Array, sigma: float | Array) -> float:
    brdf = GaussianTrain.of_the_code()
    return foresee(
        captures.observer, captures.card, brdf, source, noise=sigma, weights=_WEIGHTS, step_deg=_STEP_DEG
    ).source_error


def inverse(*, quick: bool = False, seed: int = 0, progress: Advance | None = None) -> Panel:
    """Measure the panel; `quick` takes fewer pixels, settings and draws of the noise."""
    pixels, draws = (150, 1) if quick else (500, 3)
    runs: list[Run] = []
    floors: dict[str, float] = {}
    total = len(LEVELS) * draws
    for number, (level, draw) in enumerate((level, draw) for level in LEVELS for draw in range(draws)):
        film = _film(pixels, level, (seed, draw))
        group = f"{level} dB"
        floors[group] = film.bound
        for method, knobs, work, on in _settings(film, quick=quick):
            runs.append(solved_run(group, method, {**knobs, "draw": draw}, work, on.source, bound=on.bound))
        if progress is not None:
            progress(number + 1, total)
    return Panel(
        name="inverse",
        title="Inverse: error of the pattern against seconds of a solution",
        question="What does each solver's own knob buy, and how far from the bound does it end?",
        setting=(
            f"The thesis's scene: {pixels} pixels, 20 views, 20 realisations, 4 elements, four lobes of sigma 1°, weights "
            f'"{_WEIGHTS}", normal noise {LEVELS[0]} and {LEVELS[1]} dB below the captures, stated to the solvers, {draws} '
            "draw(s). Error: of the pattern, relative, after the best global scale. The bound is that of all captures on knots "
            f"every {_STEP_DEG:g}°, in the table that of the captures used; estimates kept >= 0 may lie below it."
        ),
        runs=tuple(runs),
        conclusions=tuple(conclude(runs, floors)),
        omissions=(
            Omission("a BRDF that is no function of the angle sum", "needs a moving camera, which is another data set"),
            Omission("calibration", "finds the card's place, which is known here"),
            Omission("peers of other kinds", "benchmarks/peers.py runs them beside these, with a page of its own"),
        ),
        floors=floors,
        numbers={"table": _rows(runs)},
        tables=(
            (
                f"Each method at its best setting, median over the draws; arrived: within {ARRIVED:g} times the bound",
                ("noise", "method", "best setting", "error", "over the bound", "seconds", "failed", "arrived"),
                tuple(tuple(row.values()) for row in _rows(runs)),
            ),
        ),
    )


def _film(pixels: int, level: float, seed: tuple[int, int]) -> _Film:
    fov = math.radians(60)
    observer = Observer(
        position=(0.0, -5.0),
        fov=fov,
        view_angles=scan_angles(20, scan=math.radians(90), fov=fov),
        pixels=pixels,
        pixels_at="edges",
    )
    card = Card(elements_x=tuple(map(float, np.linspace(-2.5, 2.5, _ELEMENTS))), y=-1.0)
    brdf = GaussianTrain.of_the_code()
    rng = np.random.default_rng((31, *seed))
    source = rng.random((_ELEMENTS, 20))
    clean = radiance(transport_matrix(observer, card, brdf, weights=_WEIGHTS), source)
    sigma = float(np.sqrt(np.mean(clean**2))) * 10 ** (-level / 20)
    captures = CaptureSet(
        observer=observer,
        card=card,
        transport=_WEIGHTS,
        radiance=clean + sigma * rng.standard_normal(clean.shape),
        variance=np.full(clean.shape, sigma**2),
    )
    return _Film(captures, source, sigma, _bound(captures, source, sigma))


_Setting = tuple[str, dict[str, Any], Callable[[], Array], _Film]


def _settings(film: _Film, *, quick: bool) -> list[_Setting]:
    """Every method over its own knob: name, knobs, the call that gives a pattern, and the pattern that is true."""
    captures = film.captures
    settings: list[_Setting] = []

    def add(method: str, work: Callable[[], Array], on: _Film = film, **knobs: Any) -> None:
        settings.append((method, knobs, work, on))

    def solved(on: _Film = film, **options: Any) -> Array:
        return solve(on.captures, **options).source

    add("solve, as it is", solved)
    for step in (0.5, 1.0, 2.0) if quick else (0.125, 0.25, 0.5, 1.0, 2.0, 4.0):
        add("closed form, knots", partial(solved, method="closed_form", step_deg=step), step_deg=step)
        add("maximum likelihood, knots", partial(solved, method="maximum_likelihood", step_deg=step), step_deg=step)
    for steps in (1, 2, 8) if quick else (1, 2, 3, 5, 10, 30):
        add("maximum likelihood, Newton steps", partial(_newton, captures, steps), steps=steps)
    for realisations in (4, 10) if quick else (4, 5, 7, 10, 14):
        some = film.of(realisations)
        add(
            "maximum likelihood, captures",
            partial(solved, some, method="maximum_likelihood", step_deg=_STEP_DEG),
            some,
            captures=realisations,
        )
    few = film.of(3)
    for starts in (2,) if quick else (2, 6, 12, 24):
        add("few captures (3), starts", partial(_few, few.captures, starts), few, starts=starts)
    for cap in (3, 30) if quick else (1, 3, 10, 30, 100):
        for tolerance in (1e-3,) if quick else (1e-1, 1e-3, 1e-6):
            add(
                "thesis's alternation, cap and tolerance",
                partial(_alternation, captures, film.source, cap, tolerance),
                cap=cap,
                tolerance=tolerance,
            )
    counts = 1 / film.sigma**2 * float(np.mean(captures.radiance))
    poisson = _counted(film, counts)
    for step in (1.0,) if quick else (0.5, 1.0, 2.0):
        add(
            "photon counts, knots",
            partial(
                solved, poisson, method="poisson", counts_per_radiance=counts, background=_BACKGROUND, step_deg=step
            ),
            poisson,
            step_deg=step,
        )
    return settings


def _newton(captures: CaptureSet, steps: int) -> Array:
    """The likelihood's climb cut short, from the closed form on the same knots."""
    problem, space = prepare(captures)
    _, designs = problem.designs(_STEP_DEG, degree=3, tolerance=1e-5)
    weights = problem.inverse_variance
    assert weights is not None
    start = closed_form(problem.weighted_data, problem.weighted(designs), space)
    summed = moments(problem.data, designs, weights)
    return maximise(summed, start.coefficients, max_iterations=steps).source


def _few(captures: CaptureSet, starts: int) -> Array:
    problem, _ = prepare(captures, few_captures=True)
    return few_captures(problem, starts=starts).source


def _alternation(captures: CaptureSet, truth: Array, cap: int, tolerance: float) -> Array:
    """The thesis's method, its elements put in the order that fits best, since it may confuse them.

    Its alpha is not relative: 4.64 is the best for the thesis's 500 pixels.
    """
    alpha = 4.64 * captures.observer.pixels / 500
    found = de_render_unstructured(captures, alpha=alpha, cap=cap, tolerance=tolerance).source
    orders = (list(order) for order in itertools.permutations(range(len(found))))
    return min((np.asarray(found[order]) for order in orders), key=lambda source: scale_free_error(source, truth))


def _counted(film: _Film, counts: float) -> _Film:
    """The same films as photon counts over a background of 1; their variance is that of the normal noise on average."""
    model = transport_matrix(film.captures.observer, film.captures.card, GaussianTrain.of_the_code(), weights=_WEIGHTS)
    expected = counts * radiance(model, film.source) + _BACKGROUND
    photons = np.random.default_rng(int(counts) % 2**32).poisson(expected)
    captures = CaptureSet(
        observer=film.captures.observer,
        card=film.captures.card,
        transport=_WEIGHTS,
        radiance=np.asarray((photons - _BACKGROUND) / counts, dtype=np.float64),
    )
    return _Film(captures, film.source, film.sigma, _bound(captures, film.source, np.sqrt(expected) / counts))


def _by_setting(runs: Sequence[Run]) -> dict[str, tuple[Run, ...]]:
    """Runs of one setting together, whatever their draw."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        name = ", ".join(f"{k} {v:g}" for k, v in run.knobs.items() if k != "draw")
        groups.setdefault(name, []).append(run)
    return {name: tuple(group) for name, group in groups.items()}


def _rows(runs: Sequence[Run]) -> list[dict[str, str]]:
    """A row for each method and level: its best setting, by the median error over the draws."""
    rows = []
    for level in dict.fromkeys(run.group for run in runs):
        for method, line in by_method([run for run in runs if run.group == level]).items():
            settings = {
                name: (float(np.median([r.error if not r.failure else math.inf for r in rs])), rs)
                for name, rs in _by_setting(line).items()
            }
            best = min(settings, key=lambda name: settings[name][0])
            error, at = settings[best]
            failed = sum(1 for run in line if run.failure)
            good = math.isfinite(error)
            floor = float(np.median([run.extra["bound"] for run in at]))
            rows.append(
                {
                    "noise": level,
                    "method": method,
                    "setting": best or "-",
                    "error": f"{100 * error:.3g} %" if good else "-",
                    "over the bound": f"{error / floor:.3g}" if good else "-",
                    "seconds": short_seconds(float(np.median([run.seconds for run in at]))),
                    "failed": f"{failed} of {len(line)}",
                    "arrived": "yes" if good and error <= ARRIVED * floor else "no",
                }
            )
    return rows


def conclude(runs: Sequence[Run], floors: dict[str, float]) -> list[Statement]:
    """Who comes to the bound first, what a knob costs beyond it, and who never comes there."""
    statements = []
    for level in dict.fromkeys(run.group for run in runs):
        here = [run for run in runs if run.group == level]
        lines = by_method(here)
        arrived = {m: r for m, r in ((m, _arrival(line)) for m, line in lines.items()) if r is not None}
        text = f"At {level} the bound is {floors[level]:.2e}. "
        if arrived:
            first = min(arrived, key=lambda m: arrived[m])
            text += (
                f"First within {ARRIVED:g} times the bound of its captures: {first}, {short_seconds(arrived[first])}"
            )
            others = [f"{m} ({seconds / arrived[first]:.2g} x)" for m, seconds in arrived.items() if m != first]
            text += f"; then {', '.join(others)}. " if others else ". "
        else:
            text += f"No solver comes within {ARRIVED:g} times it. "
        never = []
        for method, line in lines.items():
            if method not in arrived:
                best = min((run.error / run.extra["bound"] for run in line if not run.failure), default=math.nan)
                never.append(f"{method} ({best:.3g} x the bound)" if math.isfinite(best) else f"{method} (refused)")
        text += f"Never: {', '.join(never)}." if never else "All arrive."
        statements.append(Statement(text))
        statements += _of_captures(level, lines.get("maximum likelihood, captures", ()))
    return statements


def _arrival(line: Sequence[Run]) -> float | None:
    """Median seconds of the quickest setting that arrives in most draws."""
    seconds = []
    for runs in _by_setting(line).values():
        ratios = [math.inf if run.failure else run.error / run.extra["bound"] for run in runs]
        if float(np.median(ratios)) <= ARRIVED:
            seconds.append(float(np.median([run.seconds for run in runs])))
    return min(seconds, default=None)


def _of_captures(level: str, line: Sequence[Run]) -> list[Statement]:
    """What fewer captures cost, measured and foretold."""
    groups = _by_setting([run for run in line if not run.failure])
    if len(groups) < 2:
        return []
    parts = []
    for rs in groups.values():
        error, bound = (float(np.median(values)) for values in ([r.error for r in rs], [r.extra["bound"] for r in rs]))
        parts.append(f"{rs[0].knobs['captures']} captures {error:.2e} ({error / bound:.2f} x their own bound)")
    return [
        Statement(
            f"Fewer captures at {level}: {', '.join(parts)}. Each capture brings a pattern of its own to find, so that more of "
            "them help only to know the BRDF."
        )
    ]
