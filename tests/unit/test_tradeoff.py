"""What `wallmirror tradeoff` makes of its runs: fronts, slopes, seconds to an error, verdicts; and one panel end to end."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from wallmirror.derendering.estimate import scale_free_error
from wallmirror.jobs import trading
from wallmirror.report.tradeoffs import panel_figures
from wallmirror.scene import load_scene
from wallmirror.tradeoff import (
    budget_words,
    forward,
    forward_analytic,
    forward_task,
    forward_words,
    growth,
    inverse,
    scaling,
    split_runs,
    splits,
    transcendental,
)
from wallmirror.tradeoff.pareto import (
    falls,
    fit_line,
    pareto_front,
    reach_along_line,
    reach_by_run,
    short_seconds,
    tail_line,
)
from wallmirror.tradeoff.reference import brute_force, points_in_extended_precision
from wallmirror.tradeoff.runs import Panel, Run, Statement, by_method, to_csv
from wallmirror.tradeoff.single_precision import transport_in_single_precision
from wallmirror.transport import radiance, transport_matrix

from .helpers import lobes, refused, same_examples, thesis_card, thesis_observer


def a_run(seconds: float, error: float, *, method: str = "m", group: str = "g", work: float = math.nan) -> Run:
    return Run(group=group, method=method, knobs={"k": 1}, seconds=seconds, error=error, work=work)


def a_failure(seconds: float) -> Run:
    return Run(group="g", method="m", knobs={}, seconds=seconds, failure="it did not work")


def monte_carlo(
    counts: Sequence[float],
    *,
    at_one: float,
    slope: float = -0.5,
    start: float = 0.0,
    price: float = 1e-3,
    method: str = "m",
) -> list[Run]:
    """Runs that obey error = at_one n^slope and seconds = start + price n exactly."""
    return [
        a_run(start + price * n, at_one * n**slope, method=method, group=forward_task.IMAGE, work=n) for n in counts
    ]


# -- front and lines ----------------------------------------------------------------------------------------------

#: Positive figures of any size, few enough different ones that ties occur.
FIGURES = st.sampled_from([1e-6, 1e-3, 0.5, 1.0, 2.0, 1e4])


@given(st.lists(st.tuples(FIGURES, FIGURES), max_size=12))
@same_examples
def test_the_front_is_what_nothing_beats(pairs: list[tuple[float, float]]) -> None:
    runs = [a_run(*pair) for pair in pairs] + [a_failure(1e-9)]
    front = {(run.seconds, run.error) for run in pareto_front(runs)}

    def beaten(pair: tuple[float, float]) -> bool:
        return any(s <= pair[0] and e <= pair[1] and (s, e) != pair for s, e in pairs)

    assert front == {pair for pair in pairs if not beaten(pair)}


def test_a_failure_that_took_no_time_is_on_no_front() -> None:
    assert pareto_front([a_failure(0.0), a_run(1.0, 0.5)]) == (a_run(1.0, 0.5),)


def test_a_fitted_line_is_that_of_an_independent_regression() -> None:
    rng = np.random.default_rng(0)
    x = np.geomspace(1, 1e4, 7)
    y = 3 * x**-0.7 * np.exp(0.1 * rng.standard_normal(7))
    ours = fit_line(x, y)
    theirs = scipy.stats.linregress(np.log(x), np.log(y))
    # Both are a few sums of seven numbers of order ten.
    assert ours.slope == pytest.approx(theirs.slope, rel=1e-12)
    assert ours.standard_error == pytest.approx(theirs.stderr, rel=1e-11)
    assert math.log(ours.factor) == pytest.approx(theirs.intercept, rel=1e-11)
    assert ours.half_width() == pytest.approx(2.5705818 * theirs.stderr, rel=1e-6)  # t of 5 degrees of freedom, tables


def test_two_points_give_a_slope_that_nobody_trusts() -> None:
    line = fit_line([1, 10], [1, 0.1])
    assert line.slope == pytest.approx(-1)
    assert math.isinf(line.half_width())
    assert not falls(line)


# -- seconds to an error ------------------------------------------------------------------------------------------


def test_beyond_the_runs_the_measured_slope_counts_and_it_is_said() -> None:
    runs = monte_carlo([16, 64, 256, 1024, 4096], at_one=1.0)
    reach = reach_along_line(runs, 1e-3)  # at a million samples
    assert reach is not None
    assert reach.how == "extrapolated"
    assert reach.seconds == pytest.approx(1e6 * 1e-3, rel=1e-9)
    assert reach.factor == pytest.approx(1e6 / 4096, rel=1e-9)
    assert "extrapolated" in reach.words
    assert "-0.50" in reach.words


def test_a_start_that_costs_as_much_as_many_samples_does_not_bend_the_extrapolation() -> None:
    # The twin: over seconds such runs seem to fall far faster than with the root of the samples.
    runs = monte_carlo([16, 64, 256, 1024], at_one=1.0, start=1.0)
    reach = reach_along_line(runs, 1e-3)
    assert reach is not None
    assert reach.seconds == pytest.approx(1.0 + 1e6 * 1e-3, rel=1e-9)
    over_seconds = fit_line([run.seconds for run in runs], [run.error for run in runs])
    assert over_seconds.where(1e-3) < 0.01 * reach.seconds


def test_between_two_runs_nothing_is_extrapolated() -> None:
    runs = monte_carlo([16, 64, 256], at_one=1.0)
    reach = reach_along_line(runs, 1 / math.sqrt(128))
    assert reach is not None
    assert reach.how == "interpolated"
    assert reach.seconds == pytest.approx(0.128, rel=1e-9)
    # Above the first run's error that run is the answer, as it stands.
    first = reach_along_line(runs, 0.9)
    assert first is not None
    assert (first.how, first.seconds) == ("measured", runs[0].seconds)


def test_what_does_not_fall_or_would_fall_below_its_floor_is_not_extrapolated() -> None:
    flat = [a_run(n * 1e-3, 0.02 * (1 + 0.3 * (-1) ** i), work=n) for i, n in enumerate([16, 64, 256, 1024, 4096])]
    assert not falls(tail_line(flat))
    assert reach_along_line(flat, 1e-3) is None
    falling = monte_carlo([16, 64, 256, 1024], at_one=1.0)
    assert reach_along_line(falling, 1e-5, floor=1e-4) is None
    assert reach_along_line(falling, 1e-3, floor=1e-4) is not None
    assert reach_along_line(falling[:2], 1e-3) is None


def test_seconds_of_the_analytic_model_are_those_of_a_run() -> None:
    runs = [a_run(1.0, 1e-2), a_run(3.0, 1e-4), a_run(2.0, 1e-3), a_failure(0.1)]
    reach = reach_by_run(runs, 1e-3)
    assert reach is not None
    assert reach.seconds == 2.0
    assert reach_by_run(runs, 1e-5) is None


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(2.5e-6, "2.5 µs"), (0.00316, "3.16 ms"), (12.3, "12.3 s"), (1800.0, "30 min"), (9000.0, "2.5 h")],
)
def test_seconds_are_told_in_a_unit_that_fits(seconds: float, text: str) -> None:
    assert short_seconds(seconds) == text


# -- verdicts: each with a twin that fails ------------------------------------------------------------------------


def image_runs(best: float, independent: float) -> list[Run]:
    """The analytic model takes 1 ms to 1e-3; the samplers `best` and `independent` times as long, on their lines."""
    ours = [a_run(1e-3, 9e-4, method=forward_analytic.PHYSICAL, group=forward_task.IMAGE)]
    counts = [16.0, 64.0, 256.0, 1024.0]
    # error = n^-1/2: 1e-3 at a million samples.
    lines = {"Mitsuba, orthogonal": best, "Mitsuba, independent": independent}
    return ours + [
        run
        for method, times in lines.items()
        for run in monte_carlo(counts, at_one=1.0, price=times * 1e-3 / 1e6, method=method)
    ]


@pytest.mark.parametrize(
    ("best", "independent", "met"), [(150, 6000, True), (90, 6000, False), (150, 4000, False), (90, 4000, False)]
)
def test_the_analytic_model_is_as_much_faster_as_asked_or_it_is_not(best: float, independent: float, met: bool) -> None:
    statements = forward_words.conclude(image_runs(best, independent), floor=1e-6)
    (asked,) = [s for s in statements if s.met is not None and "0.001" in s.text]
    assert asked.met is met
    assert f"{best:g} times faster than Mitsuba's best sampler here, orthogonal" in asked.text
    assert f"{independent:,g} times faster than independent samples" in asked.text
    assert asked.text.count("extrapolated") == 2


def test_a_model_that_never_comes_there_fails() -> None:
    runs = [
        replace(run, error=0.5) if run.method == forward_analytic.PHYSICAL else run for run in image_runs(150, 6000)
    ]
    assert all(s.met is False for s in forward_words.conclude(runs, floor=1e-6))


def growing(exponent: float, sweep: growth.Sweep) -> growth.Law:
    sizes = np.array([1.0, 2.0, 4.0, 8.0])
    return growth.Law(sweep, fit_line(sizes, 1e-3 * sizes**exponent), fit_line(sizes, 1e6 * sizes), 8.0)


@pytest.mark.parametrize(("exponent", "met"), [(1.0, True), (1.09, True), (1.2, False), (0.8, False)])
def test_linear_growth_is_told_from_other_growth(exponent: float, met: bool) -> None:
    laws = [growing(1.0, scaling.SWEEPS[0]), growing(exponent, scaling.SWEEPS[1])]
    statement = growth.conclude(laws)[0]
    assert statement.met is met
    # 1e6 bytes a size: 16 GB hold 16,000 times the thesis's 500 pixels.
    assert "8e+06 pixels (physical model)" in growth.conclude(laws)[-1].text


def test_three_times_the_transcendental_functions_is_the_limit() -> None:
    assert transcendental.of_ratio(2.9, 0.1, 1000).met is True
    assert transcendental.of_ratio(3.1, 0.1, 1000).met is False


def split_run(a: int, b: int, error: float, *, foretold: float | None = None, draw: int = 0) -> Run:
    method = split_runs.FORETOLD if foretold is None else split_runs.DRAWN
    knobs = {"views": a, "realisations": b, "each": 1.0} | ({} if foretold is None else {"draw": draw})
    extra = {} if foretold is None else {"foretold": foretold}
    return Run(group="g", method=method, knobs=knobs, seconds=1.0, error=error, extra=extra)


@pytest.mark.parametrize(("ratio", "met"), [(1.1, True), (0.8, True), (1.6, False), (0.6, False)])
def test_a_forecast_is_confirmed_by_what_is_measured_or_not(ratio: float, met: bool) -> None:
    found = [split_run(5, 4, 0.01), split_run(20, 20, 0.02), split_run(2, 40, 0.04)]
    measured = [split_run(5, 4, 0.01 * ratio, foretold=0.01, draw=d) for d in range(4)]
    first, second = budget_words.conclude("g", found, measured)
    assert "best is A 5 B 4, 1 % off" in first.text
    assert "the thesis's split, A 20 and B 20, 2.00 times that" in first.text
    assert "worst is A 2 B 40, 4 times" in first.text
    assert second.met is met
    assert f"A 5 B 4 {ratio:.2f}" in second.text
    # Fewer draws than four are no verdict.
    assert budget_words.conclude("g", found, measured[:3])[1].met is None


def test_a_refusal_of_the_solver_is_told() -> None:
    failed = Run(
        group="g", method=split_runs.DRAWN, knobs={"views": 5, "realisations": 4}, seconds=1.0, failure="too dark"
    )
    statement = budget_words.conclude("g", [split_run(5, 4, 0.01)], [failed])[-1]
    assert "refuses A 5 B 4" in statement.text
    assert "too dark" in statement.text


def test_what_a_render_may_take_is_what_its_seconds_pay_for() -> None:
    costs = splits.Costs(start=0.01, sample=1e-4, scatter=1.0, doubt=0.1)

    def price(samples: int) -> float:
        return math.ceil(samples / splits.PASS) * costs.start + samples * costs.sample

    for seconds in (0.0101, 0.05, 0.1124, 0.13, 1.0):
        samples = splits.affordable(seconds, costs)
        # One more sample, or one more pass of one sample, would cost too much.
        assert price(samples) <= seconds * (1 + 1e-12)
        assert price(samples + 1) > seconds * (1 - 1e-12)
    assert splits.affordable(0.0099, costs) == 0


def solver_run(method: str, seconds: float, ratio: float) -> Run:
    return Run(
        group="20 dB", method=method, knobs={"k": seconds}, seconds=seconds, error=ratio * 0.01, extra={"bound": 0.01}
    )


def test_a_solver_arrives_when_it_is_near_the_bound() -> None:
    near, far = inverse.ARRIVED * 0.9, inverse.ARRIVED * 1.1
    runs = [solver_run("slow", 5.0, 1.0), solver_run("quick", 1.0, far), solver_run("quick", 2.0, near)]
    runs.append(solver_run("never", 0.1, 50.0))
    (statement,) = inverse.conclude(runs, {"20 dB": 0.01})
    assert "quick, 2 s; then slow (2.5 x)" in statement.text
    assert "Never: never (50 x the bound)" in statement.text


# -- references ---------------------------------------------------------------------------------------------------


def test_brute_force_and_the_model_agree_and_other_weights_do_not() -> None:
    scene = load_scene("flat_wall_lobes")
    observer = replace(scene.observer, view_angles=(0.2,))
    matrix = transport_matrix(observer, scene.card, scene.wall.brdf, tolerance=1e-12)
    place = np.unravel_index(np.argmax(matrix), matrix.shape)
    exact = brute_force(observer, scene.card, scene.wall.brdf, place)
    # 24 nodes for a strip of 1.1 lobe widths leave rounding alone.
    assert float(matrix[place]) == pytest.approx(exact, rel=1e-11)
    other = transport_matrix(observer, scene.card, scene.wall.brdf, weights="cosine")
    area = scene.card.element_width * scene.card.element_height
    assert abs(float(other[place]) * area / exact - 1) > 1e-2


def test_algorithm_1_in_extended_precision_is_that_of_the_library() -> None:
    observer, card, brdf = thesis_observer(60, 3), thesis_card(), lobes()
    pattern = np.array([0.2, 0.4, 0.7, 1.0])
    ours = radiance(transport_matrix(observer, card, brdf, weights="cosine"), pattern)
    extended = points_in_extended_precision(observer, card, brdf, pattern)
    # An angle of order one, rounded, is 1e-16 / sigma = 1e-14 of a lobe's slope off.
    np.testing.assert_allclose(ours, np.asarray(extended, dtype=np.float64), rtol=0, atol=1e-13)


def test_single_precision_is_the_same_model_to_single_precision() -> None:
    observer, card, brdf = thesis_observer(60, 3, "centres"), thesis_card(width=0.02), lobes()
    double = transport_matrix(observer, card, brdf, orders=(2, 4))
    single = transport_in_single_precision(observer, card, brdf, orders=(2, 4))
    assert single.dtype == np.float32
    error = float(np.linalg.norm(single - double) / np.linalg.norm(double))
    # An angle of order one rounded to 6e-8, over sigma 0.0175, times a few operations; and it is not float64.
    assert 1e-8 < error < 2e-5


# -- runs, worker and page ----------------------------------------------------------------------------------------


def test_a_failed_run_has_no_error() -> None:
    assert refused(lambda: Run(group="g", method="m", knobs={}, seconds=1.0, error=0.1, failure="no")).field == "error"


def test_every_run_is_a_line_of_the_csv_failures_too() -> None:
    runs = [a_run(1.5, 0.25), a_failure(2.0)]
    rows = list(csv.DictReader(io.StringIO(to_csv(runs))))
    assert [row["error"] for row in rows] == ["0.25", "nan"]
    assert rows[1]["failure"] == "it did not work"
    assert json.loads(rows[0]["knobs"]) == {"k": 1}


def test_a_point_of_the_scaling_panel_is_measured_or_refused_in_its_own_process() -> None:
    spec = {"kind": "transport", "pixels": 4000, "elements": 16}
    answer = scaling.ask(spec)
    # F has 4000 x 20 x 16 entries of 8 bytes, and little else is alive.
    assert not answer["failure"]
    assert 10e6 < answer["bytes"] < 40e6
    told = scaling.ask(spec, limit_gb=0.005)
    assert "needs 14.2 MB of memory" in told["failure"]
    assert told["bytes"] < 5e6
    assert scaling._of_refusal("F", told).met is True
    # Twins: a call that was done, and a process that died.
    assert scaling._of_refusal("F", answer).met is False
    assert scaling._of_refusal("F", {"exit": -9, "failure": "Killed", "bytes": 0.0}).met is False


def test_an_unknown_panel_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    error = refused(lambda: trading.measure_tradeoffs(["forward", "sideways"], tmp_path))
    assert "sideways" in str(error)
    assert not list(tmp_path.iterdir())


def test_a_panel_becomes_a_page_with_all_runs_and_its_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def without_mitsuba(*, quick: bool, seed: int, progress: forward.Advance) -> Panel:
        return forward.forward(quick=quick, seed=seed, progress=progress, mitsuba=False)

    monkeypatch.setitem(trading.PANELS, "forward", without_mitsuba)
    traded = trading.measure_tradeoffs(["forward"], tmp_path, quick=True)
    (panel,) = traded.panels
    lines = by_method(panel.runs)
    # More nodes, less error, down to what 4 x 8 nodes reach at a strip of 1.1 lobe widths.
    errors = [run.error for run in lines[forward_analytic.PHYSICAL]]
    assert errors[0] > 1e-2
    assert errors[-1] < 1e-7
    assert lines["Algorithm 1, float64"][0].error < 1e-13
    assert panel.numbers["reference_against_brute_force"] < 1e-11
    assert any(o.what == "Mitsuba" for o in panel.omissions)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "forward.csv").read_text())))
    assert len(rows) == len(panel.runs)
    page = (tmp_path / "tradeoff.html").read_text()
    assert "brute force in four dimensions" in page
    assert "Left out: Mitsuba" in page
    assert json.loads((tmp_path / "results.json").read_text())["panels"][0]["runs"] == len(rows)


def test_a_missed_figure_fails_the_whole() -> None:
    panel = Panel(
        name="inverse",
        title="t",
        question="q",
        setting="s",
        runs=(),
        conclusions=(Statement("no", False), Statement("-")),
    )
    assert not trading.Traded((panel,), 1.0, "m", (1.0,), True).passed
    good = replace(panel, conclusions=(Statement("yes", True), Statement("-")))
    assert trading.Traded((good,), 1.0, "m", (1.0,), True).passed


def test_failures_are_crosses_above_all_errors() -> None:
    runs = (a_run(1.0, 0.5), a_run(2.0, 0.1), a_failure(1.5))
    panel = Panel(name="forward", title="t", question="q", setting="s", runs=runs, conclusions=())
    ((figure, caption),) = panel_figures(panel)
    assert "1 of which failed" in caption
    offsets = [tuple(float(v) for v in p) for c in figure.axes[0].collections for p in np.ma.getdata(c.get_offsets())]
    assert (1.5, 2.0) in offsets  # four times the largest error


def test_the_thesiss_elements_are_put_in_order_before_they_are_judged() -> None:
    film = inverse._film(100, 40, (0, 0))
    found = inverse._alternation(film.captures, film.source, 3, 1e-3)
    shuffled = scale_free_error(found[::-1], film.source)
    assert scale_free_error(found, film.source) <= shuffled


def worker_of(monkeypatch: pytest.MonkeyPatch, bytes_a_pixel: float, *, guarded: bool = True) -> None:
    """A worker that takes so many bytes a pixel, and refuses what is beyond its limit unless it is not guarded."""

    def ask(spec: dict[str, Any], *, limit_gb: float | None = None) -> dict[str, Any]:
        needed = bytes_a_pixel * spec["pixels"]
        refused = guarded and limit_gb is not None and needed > 1e9 * limit_gb
        failure = "memory: F needs 99 GB of memory and 16 GB are left" if refused else ""
        taken = 0.0 if refused else needed
        return {"seconds": 1e-6 * spec["pixels"], "wall": 0.0, "bytes": taken, "failure": failure}

    monkeypatch.setattr(scaling, "ask", ask)


def test_a_sweep_goes_on_to_the_largest_size_that_the_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = scaling.SWEEPS[0]
    worker_of(monkeypatch, 1000.0)  # 16 million pixels fit
    quick = scaling._swept(sweep, 6.0, factor=2)
    assert [run.knobs["pixels"] for run in quick[:3]] == [500, 1000, 2000]
    filled = scaling._filled(sweep, quick)
    done = [run.knobs["pixels"] for run in filled if not run.failure]
    # Refused runs are kept, and the largest that was done lies within a third of the limit.
    assert any(run.failure for run in filled)
    assert 16e6 / 1.5 < max(done) <= 16e6
    assert scaling._of_the_largest([*quick, *filled]).met is True
    # The planted fault: a worker that takes more than it was given is told.
    worker_of(monkeypatch, 1000.0, guarded=False)
    beyond = scaling._run(sweep, 20_000_000, limit_gb=16.0)
    assert scaling._of_the_largest([*quick, beyond]).met is False


def test_full_sizes_are_for_the_panel_of_sizes(tmp_path: Path) -> None:
    for names, quick in ((["forward"], False), (["scaling"], True)):
        error = refused(lambda n=names, q=quick: trading.measure_tradeoffs(n, tmp_path, quick=q, full=True))
        assert error.field == "full"
    assert not list(tmp_path.iterdir())
