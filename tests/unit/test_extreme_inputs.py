"""What extremes found: lost light, counts, several positions, comparisons, files, laws of cost; each with a twin that fails."""

from __future__ import annotations

import importlib
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import wallmirror as wm
from wallmirror.cli import main
from wallmirror.comparison import compare
from wallmirror.derendering import bounds, counting, poisson, preparing
from wallmirror.derendering.calibration import moved
from wallmirror.derendering.general import solve_general
from wallmirror.derendering.likelihood import moments
from wallmirror.jobs.advising import advise
from wallmirror.jobs.bouncing import spread
from wallmirror.jobs.solving import judge
from wallmirror.planning.plan import Term, total_error
from wallmirror.planning.sampling import NoiseLevel, cheapest_sampling
from wallmirror.table_files import read_table
from wallmirror.tradeoff.pareto import fit_line, reach_along_line
from wallmirror.tradeoff.runs import Run
from wallmirror.tradeoff.splits import Costs, affordable

from .helpers import assert_undetermined, refused

_VALIDATION = Path(__file__).parents[2] / "validation"


def _topic(name: str) -> ModuleType:
    sys.path.insert(0, str(_VALIDATION))
    try:
        return importlib.import_module(f"extreme_cases.{name}")
    finally:
        sys.path.remove(str(_VALIDATION))


harness, scenes, inverse, moving_camera, commands = map(
    _topic, ("harness", "scenes", "inverse", "moving_camera", "commands")
)
QUICK = ("alternating", "bounds", "calibrating", "capture_sets", "comparing", "scene_files", "single_files")


@pytest.mark.parametrize("name", QUICK)
def test_no_quick_cell_is_a_fault(name):
    cells = [harness.run(case) for case in _topic(name).cases()]
    assert [(c.entry, c.quantity, c.value, c.words) for c in cells if c.outcome == "fault"] == []
    assert {c.outcome for c in cells} == {"right", "refused"}


def test_no_law_of_cost_is_a_fault():
    planning = _topic("planning")
    cells = [harness.run(case) for case in (*planning.sampling_cases(), *planning.law_cases())]
    assert [(c.entry, c.quantity, c.value, c.words) for c in cells if c.outcome == "fault"] == []


# -- lost light -------------------------------------------------------------------------------------------------------


def with_noise(**changes):
    """Noisy films with their stated noise, and their truth."""
    captures, source = scenes.films(noise=1e-3, **changes)
    variance = np.full(captures.radiance.shape, (1e-3 * float(captures.radiance.max())) ** 2)
    return replace(captures, variance=variance), source


def spoilt(captures, at, *, radiance=None, variance=None):
    arrays = {"radiance": captures.radiance.copy(), "variance": captures.variance.copy()}
    for name, value in (("radiance", radiance), ("variance", variance)):
        if value is not None:
            arrays[name][at] = value
    return replace(captures, **arrays)


@pytest.mark.parametrize("held", [1e300, -1e300, 0.0])
def test_what_a_lost_pixel_holds_changes_nothing(held):
    captures, _ = with_noise()
    plain = wm.solve(spoilt(captures, (1, 100, 1), variance=np.inf))
    other = wm.solve(spoilt(captures, (1, 100, 1), radiance=held, variance=np.inf))
    assert wm.scale_free_error(other.source, plain.source) < 1e-9


@pytest.mark.parametrize("variance", [1e30, 1e300])
def test_a_pixel_drowned_in_noise_is_as_one_without_weight(variance, monkeypatch):
    captures, source = with_noise()
    plain = wm.solve(spoilt(captures, (1, 100, 1), variance=np.inf))
    drowned = spoilt(captures, (1, 100, 1), variance=variance)
    found = wm.solve(drowned)
    assert wm.scale_free_error(found.source, plain.source) < 1e-9
    assert found.verdict == "good"
    assert wm.scale_free_error(found.source, source) < 5 * found.predicted_error
    # The twin: let such noise count, and its floor takes all others.
    monkeypatch.setattr(preparing, "_DEAF", math.inf)
    monkeypatch.setattr(preparing.np, "median", lambda _: math.inf)
    assert_undetermined(lambda: wm.solve(drowned))


def test_a_bright_pixel_whose_noise_is_brighter_does_not_set_the_scale():
    captures, source = with_noise()
    found = wm.solve(spoilt(captures, (1, 100, 1), radiance=1e100, variance=1e200))
    assert wm.scale_free_error(found.source, source) < 5 * found.predicted_error


@pytest.mark.parametrize("variance", [0.0, 1e-320, 1e-300])
def test_variances_below_rounding_say_no_more_than_none(variance):
    captures, source = scenes.films(noise=1e-3)
    plain = wm.solve(captures)
    found = wm.solve(replace(captures, variance=np.full(captures.radiance.shape, variance)))
    assert found.predicted_error == pytest.approx(plain.predicted_error, rel=1e-6)
    assert wm.scale_free_error(found.source, source) < 5 * found.predicted_error


def test_a_film_without_pixels_is_named():
    captures, _ = with_noise()
    told = assert_undetermined(lambda: wm.solve(spoilt(captures, np.s_[:, :, 1], variance=np.inf)))
    assert "realisation 1 has 0 pixel(s)" in told
    assert "leave it out" in told
    # One pixel less than elements is too few, as many are let through.
    for left, enough in ((2, False), (3, True)):
        some = captures.variance.copy()
        some[:, :, 1] = np.inf
        some[0, 40 : 40 + left, 1] = captures.variance[0, 40 : 40 + left, 1]
        told = assert_undetermined(lambda v=some: wm.solve(replace(captures, variance=v)))
        assert ("realisation 1 has" in told) != enough


# -- counts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_counts_know_no_unit_of_radiance(scale):
    captures, source, options = inverse.made_for("poisson")
    _, _, scaled = inverse.made_for("poisson", scale=scale)
    plain = wm.solve(captures, **options)
    found = wm.solve(replace(captures, radiance=captures.radiance * scale), **scaled)
    assert found.verdict == plain.verdict == "good"
    assert wm.scale_free_error(found.source, plain.source) < 1e-6
    assert float(np.max(found.source) / np.max(plain.source)) == pytest.approx(scale, rel=1e-6)
    assert wm.scale_free_error(found.source, source) < 5 * found.predicted_error


def test_more_counts_than_float64_tells_apart_are_refused():
    captures, _, options = inverse.made_for("poisson")
    error = refused(lambda: wm.solve(captures, **{**options, "counts_per_radiance": 1e300}))
    assert error.field == "counts_per_radiance"
    assert "counts of the brightest pixel" in str(error)


def test_true_counts_before_a_dark_background_are_believed_and_smooth_ones_are_not():
    captures, _, options = inverse.made_for("poisson")
    found = wm.solve(captures, **options)
    # Two thirds of the pixels are dark here, and 1200 counted ones know their scatter to 4 %.
    assert np.mean(captures.radiance < 1e-3 * captures.radiance.max()) > 0.5
    assert found.chi_squared == pytest.approx(1.0, abs=0.2)
    assert found.verdict == "good"
    smooth, _ = scenes.films()
    told = wm.solve(smooth, **options)
    assert told.verdict == "doubtful"
    assert "scatter only" in told.warnings[0]


# -- several positions ------------------------------------------------------------------------------------------------


def test_few_pixels_that_any_knots_fit_widen_the_error():
    sets, source = moving_camera.positions(pixels=2)
    rng = np.random.default_rng(0)
    z = []
    for _ in range(8):  # films that differ in their last digit, as they do from one processor to the next
        last_digits = [1 + 2.0**-52 * rng.integers(-2, 3, each.radiance.shape) for each in sets]
        rounded = [replace(each, radiance=each.radiance * digit) for each, digit in zip(sets, last_digits, strict=True)]
        found = solve_general(rounded)
        off = wm.scale_free_error(found.source, source)
        assert off < 5 * found.predicted_error
        z.append(off * found.gap / math.sqrt(found.mismatch))
    # The twin: the bound of the closed form alone, which knows of rounding, does not cover them; if it did, their squares
    # would sum to chi^2 of 8, beyond 45 once in a million times.
    assert np.sum(np.square(z)) > 45


def test_a_recovered_table_is_nan_of_nan_alone():
    cells = [harness.run(case) for case in moving_camera.table_cases()]
    assert [c.outcome for c in cells] == ["right"] * len(cells)


def test_a_fit_that_misses_the_stated_noise_is_doubted():
    sets, source = moving_camera.positions(4, noise=1e-3)
    stated = [replace(c, variance=np.full(c.radiance.shape, (1e-3 * float(c.radiance.max())) ** 2)) for c in sets]
    sound = solve_general(stated)
    assert sound.verdict == "good"
    assert wm.scale_free_error(sound.source, source) < 5 * sound.predicted_error
    quiet = [replace(c, variance=c.variance / 100) for c in stated]
    found = solve_general(quiet)
    assert found.verdict == "doubtful"
    assert "times the stated noise" in found.status


def test_the_set_that_cannot_be_used_is_named():
    sets, _ = moving_camera.positions(noise=1e-3)
    dark = [*sets[:2], replace(sets[2], radiance=np.zeros(sets[2].radiance.shape)), *sets[3:]]
    assert assert_undetermined(lambda: solve_general(dark)).startswith("capture set 3 of 5: every capture is dark")


@pytest.mark.parametrize(("name", "factors"), [("distance", (0.0, 1.0)), ("width", (1.0, 0.0)), ("width", (1.0, -1.0))])
def test_a_card_is_neither_flattened_nor_mirrored(name, factors):
    points = scenes.card(element_width=0.0, element_height=0.0)
    assert refused(lambda: moved(points, 0.0, *factors)).field == name
    assert moved(points, 0.5, 2.0, 1.0).y == 2 * points.y


# -- bounds and comparisons -------------------------------------------------------------------------------------------


def test_a_bound_of_what_no_float_can_square_is_refused():
    problem = _topic("bounds").small_problem()
    designs, r, v, gauge = problem
    summed = moments(np.zeros((designs[0].shape[0], v.shape[1])), designs, None)
    for light in (1e-300, 1e300):
        assert refused(lambda x=light: bounds.cramer_rao(summed, r, x * v, gauge=gauge)).field == "source"
        assert refused(lambda x=light: poisson.poisson_bound(designs, r, x * v, gauge=gauge)).field == "source"


def test_one_pixel_of_no_noise_does_not_decide_a_forecast():
    eye, strips = scenes.observer(), scenes.card(element_width=0.0, element_height=0.0)
    noise = np.full((3, 60, 3), 1e-3)
    plain = wm.foresee(eye, strips, scenes.lobes(), np.eye(3), noise=noise, weights="cosine")
    for value in (1e-300, 1e300):
        noise[1, 30, 1] = value
        found = wm.foresee(eye, strips, scenes.lobes(), np.eye(3), noise=noise, weights="cosine")
        assert found.source_error == pytest.approx(plain.source_error, rel=0.05)


@pytest.mark.parametrize(
    ("field", "options"),
    [
        ("weights", {"weights": np.full((2, 40), -1.0)}),
        ("weights", {"weights": np.full((2, 40), math.nan)}),
        ("weights", {"weights": np.ones((3, 40))}),
        ("templates lobe", {"templates": {("lobe", "of 1"): np.full((2, 40), math.nan)}}),
        ("templates lobe", {"templates": {("lobe", "of 1"): np.full((2, 40), 1e200)}}),
        ("templates lobe", {"templates": {("lobe", "of 1"): np.ones((2, 41))}}),
        ("edges", {"edges": np.ones((2, 41), dtype=bool)}),
        ("edges", {"edges": np.ones((2, 40))}),
    ],
)
def test_what_no_comparison_can_take_is_refused_by_name(field, options):
    seeds, reference = _topic("comparing").pictures()
    assert compare(seeds, reference).passed
    assert refused(lambda: compare(seeds, reference, **options)).field == field


def test_renders_that_dwarf_their_reference_are_refused():
    seeds, reference = _topic("comparing").pictures()
    seeds[:, 0, 3] = 1e300
    assert refused(lambda: compare(seeds, reference)).field == "seeds"
    seeds[:, 0, 3] = 1e50
    assert not compare(seeds, reference).passed


def test_an_error_relative_to_nothing_is_infinite_and_one_of_nan_is_none():
    one = np.ones((2, 3))
    assert wm.scale_free_error(one, 0 * one) == math.inf
    assert wm.scale_free_error(one, one, ((0,), (1,))) == 0
    # A group that is dark in truth has no error of its own, where NaN stood before.
    assert wm.scale_free_error(one, one * [[1.0], [0.0]], ((0,), (1,))) == 0
    for estimate in (math.nan * one, math.inf * one, np.ones((2, 4))):
        assert refused(lambda e=estimate: wm.scale_free_error(e, one)).field == "estimate"


def test_a_truth_without_light_judges_nothing():
    captures, source = scenes.films(noise=1e-3)
    solution = wm.solve(captures)
    u = np.zeros(1)
    truth = wm.Truth(source=source, theta_s=u, theta_o=u, brdf=u)
    judgement = judge(solution, truth)
    assert judgement is not None
    assert judgement.source_error < 5 * solution.predicted_error
    assert judge(solution, replace(truth, source=0 * source)) is None


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "radiance", "variance"),
    [("radiance", 1e-40, None), ("variance", 1e-20, 1e-46), ("variance", 1e-20, 1e-40)],
)
def test_what_float32_would_round_away_is_not_written(tmp_path, field, radiance, variance):
    films = np.full((3, 60, 2), radiance)
    captures = wm.CaptureSet(
        observer=scenes.observer(),
        card=scenes.card(),
        radiance=films,
        variance=None if variance is None else np.full(films.shape, variance),
    )
    error = refused(lambda: wm.write_captures(tmp_path / "set", captures))
    assert error.field == field
    assert "choose a smaller unit" in str(error)
    assert list(tmp_path.iterdir()) == []
    # A faint pixel beside a bright one may lose what it holds.
    films[0, 0] = 1.0
    wm.write_captures(tmp_path / "set", replace(captures, radiance=films, variance=None))


def test_a_table_longer_than_its_file_is_refused_before_it_is_allocated(tmp_path):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**40}, {2**20}), }}".encode().ljust(117) + b"\n"
    path = tmp_path / "vast.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 32)
    assert "its header states" in str(refused(lambda: read_table(path)))
    np.save(path, np.ones((2, 3)))
    assert read_table(path).shape == (2, 3)


# -- laws of cost -----------------------------------------------------------------------------------------------------


def test_noise_that_no_number_of_samples_gives_is_refused():
    pilot = NoiseLevel(sampler="multijitter", spp=64, noise=0.04, seconds=0.01)
    assert refused(lambda: cheapest_sampling([pilot], noise=1e-300)).field == "noise"
    assert refused(lambda: cheapest_sampling([pilot], noise=math.inf)).field == "noise"
    assert refused(lambda: cheapest_sampling([replace(pilot, noise=math.nan)], noise=1e-2)).field == "pilot"
    assert cheapest_sampling([pilot], noise=0.01).seeds == 16


def test_errors_add_at_any_size():
    for size in (1e-300, 1.0, 1e300):
        terms = (Term(name="a", error=3 * size, kind="bias"), Term(name="b", error=4 * size, kind="noise"))
        assert total_error(terms) == pytest.approx(5 * size, rel=1e-15)


def test_costs_that_are_none_are_refused():
    for start, sample in ((-1.0, 1.0), (0.0, 0.0), (math.nan, 1.0), (0.0, math.inf)):
        assert refused(lambda a=start, b=sample: Costs(start=a, sample=b, scatter=1.0, doubt=0.0)).field == "costs"
    costs = Costs(start=0.5, sample=0.25, scatter=1.0, doubt=0.0)
    for seconds in (-1.0, math.nan, math.inf):
        assert refused(lambda s=seconds: affordable(s, costs)).field == "seconds"
    assert affordable(1.5, costs) == 4


def test_a_line_through_what_has_no_logarithm_is_refused():
    for x, y in (([1.0], [1.0]), ([1.0, 1.0], [1.0, 2.0]), ([1.0, 2.0], [0.0, 1.0]), ([1.0, 2.0], [1.0, math.nan])):
        assert refused(lambda a=x, b=y: fit_line(a, b)).field == "line"
    line = fit_line([1.0, 10.0], [1.0, 0.1])
    assert line.where(1e-300) == pytest.approx(1e300, rel=1e-9)
    assert refused(lambda: line.where(0.0)).field == "line"
    assert refused(lambda: fit_line([1.0, 10.0], [1.0, 1.0]).where(2.0)).field == "line"
    assert fit_line([1.0, 10.0], [1.0, 10**-0.1]).where(1e-300) == math.inf


def test_a_run_without_error_is_reached_by_itself():
    runs = [
        Run(group="g", method="m", knobs={}, seconds=float(s), error=error, work=float(s))
        for s, error in ((1, 1.0), (2, 0.5), (3, 0.0))
    ]
    reach = reach_along_line(runs, 0.1)
    assert reach is not None
    assert (reach.seconds, reach.how) == (3.0, "measured")


def test_advice_knows_no_unit_of_light():
    scene = _topic("planning").in_the_open()
    scene = replace(scene, observer=replace(scene.observer, pixels_at="edges"))  # nothing to render
    plain = advise(scene, 1e-2, parts=("forward",)).forward
    assert plain is not None
    for power in (-1000, 1000):
        other = advise(replace(scene, source=np.ldexp(scene.source, power)), 1e-2, parts=("forward",)).forward
        assert other is not None
        assert other.error == plain.error


def test_as_many_views_are_taken_as_there_are():
    assert spread(3, 10**30) == (0, 1, 2)
    assert spread(5, 2) == (0, 4)


# -- the command line -------------------------------------------------------------------------------------------------


def test_a_command_that_is_misused_says_so_in_json_too(capsys):
    with pytest.raises(SystemExit) as end:
        main(["validate", "flat_wall_lobes", "--spp", "0", "--json"])
    assert end.value.code == 2
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert document["exit_code"] == 2
    assert "--spp" in document["error"]
    assert "--spp" in told.err
    with pytest.raises(SystemExit):
        main(["validate", "flat_wall_lobes", "--spp", "0"])
    assert capsys.readouterr().out == ""


def test_a_tolerance_that_no_samples_reach_is_told():
    left = commands.left_by(["solve", "set", "-o", "out", "--tolerance", "1e-300"], commands.capture_set)
    assert left.code == 1
    assert "no number of samples would do" in left.out


def test_the_command_line_cells_catch_a_file_left_behind_and_a_traceback(monkeypatch):
    with pytest.raises(RuntimeError, match="left with 0"):
        commands.refused_well(["solve", "set", "-o", "out"])

    def crash(*_: object, **__: object) -> None:
        raise ValueError("planted")

    monkeypatch.setattr(counting, "prepare_counts", crash)
    monkeypatch.setattr("wallmirror.derendering.stages.prepare_counts", crash)
    with pytest.raises(ValueError, match="planted"):
        commands.refused_well(["solve", "set", "-o", "out", "--method", "poisson", "--counts", "1e6"])
