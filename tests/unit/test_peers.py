"""The peers' own mathematics: the objective's gradient, the halves of the alternation, and what the judges grant."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from wallmirror import CaptureSet, radiance, transport_matrix

from .helpers import EPS, lobes, thesis_card, thesis_observer

Array = NDArray[np.float64]

_PATH = Path(__file__).parents[2] / "benchmarks" / "peer_methods.py"


@pytest.fixture(scope="module")
def peers() -> ModuleType:
    spec = importlib.util.spec_from_file_location("peer_methods", _PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def problem(peers: ModuleType) -> Any:
    observer, card = thesis_observer(40, 5), thesis_card(3)
    rng = np.random.default_rng(0)
    films = radiance(transport_matrix(observer, card, lobes(sigma_deg=6.0), weights="thesis"), rng.random((3, 5)))
    films += 0.01 * rng.standard_normal(films.shape)
    captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=films)
    return peers.Bilinear.of(captures, step_deg=6.0, degree=3)


def point(problem: Any) -> tuple[Array, Array]:
    size, elements, realisations = problem.shape
    rng = np.random.default_rng(1)
    return rng.random(size), rng.random((elements, realisations))


def test_the_gradient_is_that_of_finite_differences(problem: Any) -> None:
    r, v = point(problem)
    residual = problem.transport(r) @ v - problem.data
    truth = float(np.sum(residual**2))

    def flat(x: Array) -> float:
        return float(np.sum((problem.transport(x[: r.size]) @ x[r.size :].reshape(v.shape) - problem.data) ** 2))

    # Central differences of a quartic: rounding eps f / h and the third derivative h^2 balance at h = eps^(1/3).
    x, step = np.concatenate([r, v.ravel()]), EPS ** (1 / 3)
    differences = 0.5 * (approx_fprime(x, flat, step) + approx_fprime(x, flat, -step))
    for evaluate in (problem.objective, problem.objective_over_pixels):
        value, along_r, along_v = evaluate(r, v)
        assert value == pytest.approx(truth, rel=1e-12)
        gradient = np.concatenate([along_r, along_v.ravel()])
        tolerance = 10 * EPS ** (2 / 3) * max(truth, float(np.abs(gradient).max()))
        assert np.abs(gradient - differences).max() < tolerance
        # Planted: the factor 2 lost in one block of the gradient.
        assert np.abs(np.concatenate([along_r, along_v.ravel() / 2]) - differences).max() > 100 * tolerance


@pytest.mark.parametrize("nonnegative", [False, True])
def test_neither_half_of_the_alternation_increases_the_objective(problem: Any, nonnegative: bool) -> None:
    r, v = point(problem)
    values = [problem.objective(r, v)[0]]
    for _ in range(6):
        r = problem.best_coefficients(v, nonnegative=nonnegative)
        values.append(problem.objective(r, v)[0])
        v = problem.best_source(r, nonnegative=nonnegative)
        values.append(problem.objective(r, v)[0])
    rounding = 1e-12 * float(np.sum(problem.summed.energy))
    assert np.all(np.diff(values) <= rounding)
    assert values[-1] < 0.1 * values[1]
    # Each half is the minimum of its block: the gradient there is zero, or (>= 0) points out of the bounds.
    _, _, along_v = problem.objective(r, v)
    scale = 1e-8 * float(np.abs(problem.objective(r, 0 * v)[2]).max())
    pushed = np.where(v > 0, np.abs(along_v), np.maximum(-along_v, 0.0)) if nonnegative else np.abs(along_v)
    assert pushed.max() < scale
    # Planted: a half step that overshoots to where the objective is the same again, and a bit further.
    further = v + 2.2 * (v - point(problem)[1])
    assert problem.objective(r, further)[0] > values[-1] + rounding


def test_descent_and_alternation_meet(peers: ModuleType, problem: Any) -> None:
    ends = []
    for work in (peers.alternate, peers.descend):
        recorder = peers.Recorder(lambda v, f: ends.append(f @ v) or (0.0, 0.0), budget=10.0)
        peers.record(recorder, lambda r, w=work: w(problem, np.random.default_rng(2), r, nonnegative=False))
    recorded = [e for e in ends if e.shape == problem.data.shape]
    misfit = np.array([float(np.sum((e - problem.data) ** 2)) for e in recorded])
    # One minimum of f, which both find to the rounding of |D|^2 where they stop.
    assert np.sort(misfit)[1] == pytest.approx(misfit.min(), rel=1e-6)


def test_judges_grant_what_a_method_cannot_know_and_no_more(peers: ModuleType) -> None:
    rng = np.random.default_rng(3)
    v, f = rng.random((3, 5)), rng.random((30, 3))
    order, scale = [2, 0, 1], np.array([0.3, 2.0, 5.0])
    shuffled = (v[order], f[:, order])
    assert max(peers.permuted_errors(*shuffled, (v, f))) < 10 * EPS
    mixed = (scale[:, None] * v[order], f[:, order] / scale)
    assert max(peers.factor_errors(*mixed, (v, f))) < 10 * EPS
    # Planted: an order for the one that knows it, scales for the one that has but one, a mixture for all.
    assert min(peers.structured_errors(*shuffled, (v, f))) > 0.1
    assert min(peers.permuted_errors(*mixed, (v, f))) > 0.1
    turn = np.eye(3) + 0.5 * rng.random((3, 3))
    assert min(peers.factor_errors(turn @ v, f @ np.linalg.inv(turn), (v, f))) > 0.01
