"""The estimates of memory against measured peaks, and refusals that come before any allocation."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from wallmirror import memory
from wallmirror.brdf import Mirror
from wallmirror.captures import CaptureSet
from wallmirror.derendering import preparing, splines
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.solve import solve
from wallmirror.geometry import Card, Observer
from wallmirror.pathtracing.filming import render_captures, render_one_hot
from wallmirror.scene import load_scene
from wallmirror.transport import build_kernel, radiance, transport_matrix

from .helpers import lobes, refused, space_within, thesis_card, thesis_observer

LOBES = lobes()
WIDE = thesis_observer(2000, 10, "centres")


def peak(work: Callable[[], object]) -> int:
    """Bytes that NumPy and Python held at most during a call, beyond those before it."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def films(observer: Observer, realisations: int, noise: float = 0.0) -> CaptureSet:
    card = thesis_card()
    source = np.random.default_rng(0).random((card.elements, realisations))
    clean = radiance(transport_matrix(observer, card, LOBES, weights="cosine"), source)
    noisy = clean + noise * np.random.default_rng(1).standard_normal(clean.shape)
    variance = np.full(clean.shape, noise**2) if noise else None
    return CaptureSet(observer=observer, card=card, transport="cosine", radiance=noisy, variance=variance)


# -- estimates ----------------------------------------------------------------------------------------------------

# An estimate below the peak would let a process be killed; one several times above it would refuse what fits. Which of
# the temporary arrays live together depends on NumPy, so a factor of two of room is left above.
ROOM = 2.0


@pytest.mark.parametrize("orders", [(2, 3), (4, 6)])
def test_a_kernel_takes_what_is_foretold(orders: tuple[int, int]) -> None:
    card = thesis_card(width=0.02)
    foretold = memory.kernel_bytes(10, 2000, card.elements, orders[0] * orders[1])
    used = peak(lambda: build_kernel(WIDE, card, orders=orders).apply(LOBES))
    assert used <= foretold <= ROOM * used


def test_a_transport_matrix_takes_what_is_foretold_whatever_its_quadrature() -> None:
    card = thesis_card(elements=16, width=0.02)
    foretold = memory.transport_bytes(10, 2000, 16)
    for tolerance in (1e-3, 1e-9):
        used = peak(lambda tolerance=tolerance: transport_matrix(WIDE, card, LOBES, tolerance=tolerance))
        assert used <= foretold <= ROOM * used


def test_a_transport_matrix_of_known_orders_takes_half_of_that() -> None:
    foretold = memory.transport_bytes(10, 2000, 16, compared=False)
    used = peak(lambda: transport_matrix(WIDE, thesis_card(elements=16, width=0.02), LOBES, orders=(2, 4)))
    assert used <= foretold <= ROOM * used


def test_one_wide_view_takes_no_more_than_its_share() -> None:
    # Whatever is looked for before F, such as the widest turn in one pixel, goes through the pixels in blocks as well.
    observer, card = thesis_observer(40_000, 1, "centres"), thesis_card(elements=16, width=0.02)
    used = peak(lambda: transport_matrix(observer, card, LOBES, tolerance=1e-3))
    assert used <= memory.transport_bytes(1, 40_000, 16)


def test_preparing_captures_takes_what_is_foretold() -> None:
    captures = films(thesis_observer(500, 20), 60, noise=0.01)
    foretold = memory.film_bytes(20, 500, 60)
    used = peak(lambda: prepare(captures))
    assert used <= foretold <= ROOM * used


@pytest.mark.parametrize("step_deg", [0.25, 1.0])
def test_design_matrices_take_what_is_foretold(step_deg: float) -> None:
    card = thesis_card(width=0.02)
    kernel = build_kernel(WIDE, card, orders=(2, 4))
    grid = splines.grid_for(kernel, step=np.radians(step_deg), degree=3)
    foretold = memory.design_bytes(*kernel.weight.shape, degree=3, knots=0)  # the fit comes later
    used = peak(lambda: splines.design_matrices(kernel, grid))
    assert used <= foretold <= ROOM * used


@pytest.mark.parametrize(("pixels", "elements", "realisations"), [(2000, 4, 20), (200, 4, 300), (200, 24, 30)])
def test_a_whole_solution_takes_what_is_foretold(pixels: int, elements: int, realisations: int) -> None:
    observer, card = thesis_observer(pixels, 20), thesis_card(elements)
    rng = np.random.default_rng(0)
    films = radiance(transport_matrix(observer, card, LOBES, weights="cosine"), rng.random((elements, realisations)))
    noisy = films + 1e-3 * rng.standard_normal(films.shape)
    captures = CaptureSet(
        observer=observer, card=card, transport="cosine", radiance=noisy, variance=np.full(films.shape, 1e-6)
    )
    told: list[float] = []
    with pytest.MonkeyPatch.context() as spy:
        spy.setattr("wallmirror.derendering.moments.require_memory", lambda needed, what: told.append(needed))
        used = peak(lambda: solve(captures, method="maximum_likelihood", step_deg=0.5))
    foretold = memory.solution_bytes(20, pixels, elements, realisations) + max(told)
    # The part that does not grow is an allowance for what a process takes beside its arrays, which this peak leaves out.
    assert used <= foretold <= 20e6 + ROOM * used


# -- refusals -----------------------------------------------------------------------------------------------------


def too_large(monkeypatch: pytest.MonkeyPatch, gigabytes: str = "0.002") -> None:
    monkeypatch.setenv(memory.LIMIT_VARIABLE, gigabytes)


REFUSED: dict[str, Callable[[], object]] = {
    "kernel": lambda: build_kernel(WIDE, thesis_card(width=0.02), orders=(4, 4)),
    "transport": lambda: transport_matrix(WIDE, thesis_card(elements=64), LOBES, weights="cosine"),
    "mirror": lambda: transport_matrix(WIDE, thesis_card(elements=64, width=0.02), Mirror()),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_before_it_is_allocated(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    too_large(monkeypatch)
    used = peak(lambda: refused(REFUSED[name]))
    # The quadrature rules, positions of the pixels and the error itself, far below the 20 MB of the first array.
    assert used < 2e6
    message = str(refused(REFUSED[name]))
    assert message.startswith("memory: ")
    assert "2 MB are left" in message
    assert memory.LIMIT_VARIABLE in message


@pytest.mark.parametrize("name", REFUSED)
def test_without_the_guard_the_same_call_takes_more_than_the_limit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The twin: the calls above are refused for a reason.
    too_large(monkeypatch)
    for module in ("kernel", "matrix"):
        monkeypatch.setattr(f"wallmirror.transport.{module}.require_memory", lambda needed, what: None)
    assert peak(REFUSED[name]) > 0.002e9


def test_captures_too_large_to_solve_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    captures = films(thesis_observer(500, 4), 20)
    too_large(monkeypatch, "0.001")
    assert "2000" not in str(refused(lambda: prepare(captures)))
    assert "a solution from 4 views x 500 pixels x 20 realisations needs 24.3 MB" in str(
        refused(lambda: prepare(captures))
    )
    monkeypatch.setattr(preparing, "require_memory", lambda needed, what: None)
    prepare(captures)  # the twin


@pytest.mark.parametrize("elements", [4, 40])
def test_a_span_takes_what_is_foretold_or_is_refused(elements: int, monkeypatch: pytest.MonkeyPatch) -> None:
    card = Card(elements_x=tuple(np.linspace(-2.5, 2.5, elements)), y=-1.0)
    kernel = build_kernel(thesis_observer(100, 8), card, weights="cosine")
    designs = splines.design_matrices(kernel, splines.grid_for(kernel, step=np.radians(1), degree=3))
    data = np.random.default_rng(0).random((800, elements))
    needed: list[float] = []
    with monkeypatch.context() as watched:
        for module in ("moments", "span"):
            watched.setattr(f"wallmirror.derendering.{module}.require_memory", lambda needs, what: needed.append(needs))
        used = peak(lambda: space_within(data, designs, elements, noise=1.0))
    pairs, *spans = needed
    films_and_designs = 3 * data.nbytes + 5 * sum(t.data.nbytes for t in designs)
    assert used <= pairs + max(spans) + films_and_designs
    # A factor of two, see above, and the share of entries that a bound on them counts too many.
    assert pairs + max(spans) <= 1.25 * ROOM * used
    # The first guard refuses before there are pairs, the second before there is a Gram matrix.
    for left, what, share in [(pairs / 2, "a fit", 0.5), ((pairs + spans[0]) / 2, "the span", 0.9)]:
        too_large(monkeypatch, f"{left / 1e9:g}")
        assert f"{what} of {elements} elements" in str(
            refused(lambda: space_within(data, designs, elements, noise=1.0))
        )
        assert peak(lambda: refused(lambda: space_within(data, designs, elements, noise=1.0))) < share * used


def test_too_many_knots_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = build_kernel(thesis_observer(50, 2), thesis_card(), weights="cosine")
    grid = splines.grid_for(kernel, step=np.radians(0.01), degree=3)
    too_large(monkeypatch, "0.1")
    assert f"{grid.size} knots" in str(refused(lambda: splines.design_matrices(kernel, grid)))


def test_a_capture_set_too_large_is_refused_before_a_path_tracer_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("flat_wall_lobes")
    large = dataclasses.replace(scene, observer=dataclasses.replace(scene.observer, pixels=1_000_000))
    too_large(monkeypatch, "1")
    monkeypatch.setattr("wallmirror.pathtracing.filming.Renderer", None)  # would raise TypeError
    assert "20 views x 1000000 pixels x 4 realisations needs 3.84 GB" in str(refused(lambda: render_captures(large)))
    assert "needs 1.28 GB" in str(refused(lambda: render_one_hot(large)))


@pytest.mark.parametrize("value", ["none", "-1", "nan", "0", ""])
def test_a_limit_that_is_none_is_refused(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    too_large(monkeypatch, value)
    assert refused(memory.memory_limit).field == memory.LIMIT_VARIABLE


def test_the_limit_is_what_the_system_has_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(memory.LIMIT_VARIABLE, raising=False)
    # Between 10 MB and 100 TB on any machine that runs this test.
    assert 1e7 < memory.memory_limit() < 1e14
    memory.require_memory(1e5, "hardly anything")
    assert "1 EB of memory" in str(refused(lambda: memory.require_memory(1e18, "everything")))
