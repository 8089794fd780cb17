"""Is the weakest pattern of a fit noise? What noise makes of one, and what the error bars are where that is open."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering import noisy
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.patterns import free_coefficients, standing_out
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.solve import solve
from wallmirror.derendering.subspace import CERTAIN, LIKELY, POSSIBLE, noise_edge
from wallmirror.errors import UndeterminedError
from wallmirror.transport import radiance, transport_matrix

from .helpers import assert_undetermined, lobes, thesis_card, thesis_observer

Array = NDArray[np.float64]

ELEMENTS, REALISATIONS = 3, 7
LEFT = REALISATIONS - ELEMENTS + 1  # realisations beside two patterns


@functools.cache
def transport() -> Array:
    return transport_matrix(thesis_observer(60, 4), thesis_card(ELEMENTS), lobes(sigma_deg=4.0), weights="cosine")


def captures(source: Array, noise: float, seed: int) -> CaptureSet:
    """Films with noise in units of their root mean square, stated."""
    films = radiance(transport(), source)
    sigma = noise * float(np.sqrt(np.mean(films**2)))
    return CaptureSet(
        observer=thesis_observer(60, 4),
        card=thesis_card(ELEMENTS),
        transport="cosine",
        radiance=films + sigma * np.random.default_rng([seed, 1]).standard_normal(films.shape),
        variance=np.full(films.shape, sigma**2),
    )


def fitted(films: CaptureSet) -> Solution:
    return solve(films, method="maximum_likelihood", step_deg=2.0, nonnegative=False)


def weakest(source: Array, seed: int, monkeypatch: pytest.MonkeyPatch, noise: float = 0.05) -> tuple[float, int]:
    """Strength of the last pattern in units of the noise, and how many coefficients would be free beside it."""
    told: list[int] = []

    def spy(problem: Any, level: Any, transport: Any, source: Array, *, sigma: float, bound: Any, bound_at: Any) -> Any:
        del transport, bound_at
        told.append(free_coefficients(problem, level, source))
        return bound, ()

    monkeypatch.setattr(noisy, "trusted_bound", spy)
    monkeypatch.setattr(noisy, "doubts_of_borrowing", lambda *_: ())
    films = captures(source, noise, seed)
    solution = fitted(films)
    assert films.variance is not None
    fit = solution.transport.reshape(-1, ELEMENTS) @ solution.source
    return float(np.linalg.svd(fit, compute_uv=False)[ELEMENTS - 1] / math.sqrt(films.variance[0, 0, 0])), told[0]


def two_patterns(seed: int, kind: str) -> Array:
    """V of rank two: an element that mixes the others, or that is dark."""
    source = np.random.default_rng(seed).random((ELEMENTS, REALISATIONS))
    source[1 if kind == "mixed" else 0] = 0.5 * (source[0] + source[2]) if kind == "mixed" else 0.0
    return source


def test_a_false_pattern_is_the_noise_that_two_patterns_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    found = np.array([weakest(two_patterns(seed, "mixed"), seed, monkeypatch)[0] for seed in range(40)])
    # One direction within the span of F times five realisations: chi with five degrees of freedom.
    assert scipy.stats.kstest(found, scipy.stats.chi(LEFT).cdf).pvalue > 1e-3
    # Its square on average, to three standard errors, which leaves no room for the planted faults: realisations that the
    # two patterns already explain (7), or a second direction (more than 10).
    assert abs(np.mean(found**2) - LEFT) < 3 * math.sqrt(2 * LEFT / found.size) < REALISATIONS - LEFT
    assert np.all(found < noise_edge(1, LEFT))


def test_beside_a_dark_element_at_the_end_coefficients_that_it_alone_shows_follow_the_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    draws = [weakest(two_patterns(seed, "dark"), seed, monkeypatch) for seed in range(40)]
    found, free = (np.array(each) for each in zip(*draws, strict=True))
    assert np.all(free >= 1)
    # More than noise alone between the patterns, which is the fault of leaving those coefficients out ...
    assert scipy.stats.kstest(found, scipy.stats.chi(LEFT).cdf).pvalue < 1e-3
    # ... and less than a matrix with a row for each of them has at its edge, once in ten thousand times.
    assert np.all(found < [noise_edge(1 + int(count), LEFT) for count in free])


def test_patterns_are_counted_one_after_the_other() -> None:
    elements, realisations, rows = 4, 9, 60
    edges = np.array([noise_edge(elements - k, realisations - k) for k in range(elements)])
    assert standing_out(1.02 * edges, rows, realisations, 0) == 4
    # The planted faults: one pattern just below its own edge, the last, the third, the first.
    for low, count in ((3, 3), (2, 2), (0, 0)):
        strength = 1.02 * edges
        strength[low:] = 0.98 * edges[low:]
        assert standing_out(strength, rows, realisations, 0) == count
    # Free coefficients raise the edges, but no further than the films have rows.
    assert standing_out(1.02 * edges, rows, realisations, 3) == 0
    assert standing_out(1.02 * edges, elements, realisations, 3) == 4
    # What noise makes once in a hundred times passes the lower edge alone.
    between = np.array([50.0, 40.0, 30.0, 0.5 * (noise_edge(1, 6) + noise_edge(1, 6, LIKELY))])
    assert standing_out(between, rows, realisations, 0, CERTAIN) == 3
    assert standing_out(between, rows, realisations, 0, LIKELY) == 4


@pytest.mark.parametrize(("units", "share"), [(CERTAIN, 1e-4), (LIKELY, 1e-2), (POSSIBLE, 1e-1)])
@pytest.mark.parametrize("columns", [1, 2, 11])
def test_the_edge_of_a_single_row_is_that_of_chi(columns: int, units: float, share: float) -> None:
    # The law of Tracy and Widom is one of large matrices; of a single row the exact chance is known: at most a fifth more,
    # and for a single number, where one expects the law to be worst, a quarter of it.
    assert 0.2 * share < scipy.stats.chi(columns).sf(noise_edge(1, columns, units)) < 1.2 * share


def faint(contrast: float, seed: int) -> Array:
    """Patterns of which the third is nearly a mixture of the two others."""
    source = two_patterns(seed, "mixed")
    source[1] += contrast * (np.random.default_rng([seed, 2]).random(REALISATIONS) - 0.5)
    return source


def strength_of(contrast: float) -> float:
    """The third pattern's strength without noise, in units of the noise, root mean square over forty draws."""
    strengths = []
    for seed in range(40):
        films = transport().reshape(-1, ELEMENTS) @ faint(contrast, seed)
        strengths.append(np.linalg.svd(films, compute_uv=False)[2] / (0.05 * np.sqrt(np.mean(films**2))))
    return float(np.sqrt(np.mean(np.square(strengths))))


def test_where_a_pattern_may_be_noise_the_bars_do_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    # About 4.5 times the noise, between 3.5 (once in ten times), 4.2 (in a hundred) and 5.2 (in ten thousand).
    contrast = 0.024
    assert 3.5 < strength_of(contrast) < 5.5
    errors, bars, refused, doubted = [], [], 0, 0
    trusting = []
    for seed in range(40):
        films = captures(faint(contrast, seed), 0.05, seed)
        try:
            solution = fitted(films)
        except UndeterminedError:
            refused += 1
            continue
        errors.append(scale_free_error(solution.source, faint(contrast, seed)))
        bars.append(solution.predicted_error)
        doubted += any("noise alone makes once in ten" in warning for warning in solution.warnings)
        with monkeypatch.context() as planted:
            planted.setattr(noisy, "trusted_bound", lambda *_, bound, **__: (bound, ()))
            trusting.append(fitted(films).predicted_error)
    assert 0 < refused < 20
    assert 0 < doubted < 20
    ratio = np.array(errors) / np.array(bars)
    assert np.sqrt(np.mean(ratio**2)) < 1.3
    assert np.all(np.array(bars) >= np.array(trusting) * (1 - 1e-9))
    assert np.any(np.array(bars) > np.array(trusting) * (1 + 1e-6))


def test_a_dark_element_is_refused_with_the_number_of_patterns() -> None:
    message = assert_undetermined(lambda: fitted(captures(two_patterns(0, "dark"), 0.05, 0)))
    assert "only 2 independent pattern(s)" in message
