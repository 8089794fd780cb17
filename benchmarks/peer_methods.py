"""The peers of `peers.py`: other ways to find F and V from D = F V, each with its trace of errors against seconds.

Without noise or bounds all of them minimise

    f(r, V) = |D - F(r) V|^2,      F(r) = [T_1 r .. T_M r],

but for matrix factorisation, which leaves F free, and for the renderer, which knows F by path tracing only. f is
evaluated in coefficient space (`likelihood.moments`), so that no iteration touches the pixels.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment, minimize

from wallmirror import CaptureSet, scale_free_error
from wallmirror.derendering.box_qp import solve_box_qps
from wallmirror.derendering.likelihood import Moments, best_nonnegative, moments
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.unstructured import de_render_unstructured

Array = NDArray[np.float64]

# Between two records of a trace lies at least this ratio of times.
_SPACING = 1.2
_RIDGE = 1e-13
_ENDLESS = {"maxiter": 10**7, "maxfun": 10**7}
# The best of 1, 4, 16 and 64 without noise; with noise all are quick.
_BALANCE = 16.0
#: Share of |D|^2 below which f is evaluated over the pixels.
NEARLY_EXACT = 1e-10
# Of V in units of the data's largest entry, where only V >= 0 is asked.
_NO_BOUND = 1e9


class OutOfTime(Exception):
    """The seconds that a run may take are spent."""


@dataclass
class Recorder:
    """A stopwatch that stands still while errors are measured.

    Parameters
    ----------
    judge:
        Relative errors of V and of F for an estimate of both, V (M, B) and F (A N, M).
    budget:
        Seconds after which a call raises `OutOfTime`.
    offset:
        Seconds that the run has spent before: on preparations that several runs share.
    """

    judge: Callable[[Array, Array], tuple[float, float]]
    budget: float = math.inf
    offset: float = 0.0
    points: list[tuple[float, float, float]] = field(default_factory=list)
    iterations: int = 0
    residual: float | None = None  # |D - F V| / |D|, where a method tells it

    def __post_init__(self) -> None:
        self._spent, self._since = self.offset, time.perf_counter()
        self._last: tuple[float, Array, Callable[[], Array]] | None = None

    def __call__(self, source: Array, transport: Callable[[], Array]) -> None:
        """Take note of an iterate; F is asked for only where it is recorded."""
        now = self._spent + time.perf_counter() - self._since
        self.iterations += 1
        over = now >= self.budget
        if over or not self.points or now >= _SPACING * self.points[-1][0]:
            self.points.append((now, *self.judge(source, transport())))
            self._last = None
        else:
            self._last = now, source.copy(), transport
        self._spent, self._since = now, time.perf_counter()
        if over:
            raise OutOfTime

    @property
    def share(self) -> float:
        """How much of the budget was spent at the last call."""
        return self._spent / self.budget

    def finish(self) -> None:
        """Record the last iterate, if it is not yet."""
        if self._last is not None:
            now, source, transport = self._last
            self.points.append((now, *self.judge(source, transport())))
            self._last = None


def record(recorder: Recorder, work: Callable[[Recorder], str]) -> str:
    """Run a method to its end; how it ended, in words."""
    try:
        ended = work(recorder)
    except OutOfTime:
        ended = "out of time"
    recorder.finish()
    return ended


# ------------------------------------------------------------------------------------------------------------- judging


def structured_errors(source: Array, transport: Array, truth: tuple[Array, Array]) -> tuple[float, float]:
    """Errors of V and F after the best global scale of each: for methods that know which element is which."""
    return scale_free_error(source, truth[0]), scale_free_error(transport, truth[1])


def permuted_errors(source: Array, transport: Array, truth: tuple[Array, Array]) -> tuple[float, float]:
    """Errors after the best global scale and the best order of the elements for V, the same order for F."""
    orders = [list(order) for order in permutations(range(len(source)))]
    errors = [scale_free_error(source[order], truth[0]) for order in orders]
    best = orders[int(np.argmin(errors))]
    return min(errors), scale_free_error(transport[:, best], truth[1])


def factor_errors(source: Array, transport: Array, truth: tuple[Array, Array]) -> tuple[float, float]:
    """Errors after the best order and, for each element, the best scale of its own: all that D = F V leaves open."""

    def rescaled(estimate: Array, target: Array) -> Array:
        power = np.sum(estimate**2, axis=1)
        scale = np.divide(
            estimate @ target.T, power[:, None], out=np.zeros((len(power),) * 2), where=power[:, None] > 0
        )
        return np.asarray(np.sum((scale[..., None] * estimate[:, None] - target[None]) ** 2, axis=2))

    missed = rescaled(source, truth[0])
    rows, columns = linear_sum_assignment(missed)
    of_transport = rescaled(transport.T, truth[1].T)[rows, columns].sum()
    return (
        float(np.sqrt(missed[rows, columns].sum()) / np.linalg.norm(truth[0])),
        float(np.sqrt(of_transport) / np.linalg.norm(truth[1])),
    )


# -------------------------------------------------------------------------------------------------- structured methods


@dataclass(frozen=True)
class Bilinear:
    """D = [T_1 r .. T_M r] V in coefficient space.

    Parameters
    ----------
    summed:
        N_ij = T_i^T T_j and X_i = T_i^T D.
    designs:
        T_1 .. T_M.
    preparation:
        Seconds that it took to make them.
    """

    summed: Moments
    designs: list[sp.csr_array]
    preparation: float
    scale: Array  # of r, so that all its entries are seen alike
    data: Array  # D / its largest entry, (P, B)
    tall: sp.csr_array  # T_1 .. T_M on top of each other, (M P, K)

    @classmethod
    def of(cls, captures: CaptureSet, *, step_deg: float, degree: int) -> Bilinear:
        """Normalise a capture set and sum it up over a spline grid."""
        started = time.perf_counter()
        problem, _ = prepare(captures)
        _, designs = problem.designs(step_deg, degree=degree, tolerance=1e-5)
        return cls.over(problem.data, designs, started)

    @classmethod
    def over(cls, data: Array, designs: list[sp.csr_array], started: float) -> Bilinear:
        """Sum data (P, B) up over design matrices."""
        summed = moments(data, designs)
        # Unseen coefficients change nothing, whatever their scale.
        scale = 1 / np.sqrt(np.maximum(summed.exposure, 1e-6))
        tall = sp.csr_array(sp.vstack(designs, format="csr"))
        return cls(summed, designs, time.perf_counter() - started, scale, data, tall)

    @property
    def shape(self) -> tuple[int, int, int]:
        """K, M, B."""
        return self.summed.size, self.summed.elements, len(self.summed.energy)

    def transport(self, coefficients: Array) -> Array:
        """F(r), shape (P, M)."""
        return np.stack([t @ coefficients for t in self.designs], axis=1)

    def objective(self, coefficients: Array, source: Array) -> tuple[float, Array, Array]:
        """f, its gradient in r (K,) and its gradient in V (M, B)."""
        pair = self.summed.pairs[0].times(coefficients)
        normal, moment = pair @ coefficients, (self.summed.cross @ coefficients).T
        pull = normal @ source
        value = float(np.sum(self.summed.energy)) + float(np.sum(source * (pull - 2 * moment)))
        along = np.tensordot(source @ source.T, pair, axes=2) - np.tensordot(source.T, self.summed.cross, axes=2)
        return value, 2 * along, 2 * (pull - moment)

    def objective_over_pixels(self, coefficients: Array, source: Array) -> tuple[float, Array, Array]:
        """The same from the residual itself: slower, but exact where next to nothing of D is left."""
        transport = (self.tall @ coefficients).reshape(len(source), -1)
        residual = transport.T @ source - self.data
        along = self.tall.T @ (source @ residual.T).ravel()
        return float(np.sum(residual * residual)), 2 * along, 2 * (transport @ residual)

    def best_coefficients(self, source: Array, *, nonnegative: bool) -> Array:
        """The r that minimises f for a given V: one linear system, or a convex quadratic programme for r >= 0."""
        if nonnegative:
            return best_nonnegative(self.summed, source)
        size = self.summed.size
        gram = self.summed.pairs[0].mixed(source @ source.T)
        gram[np.diag_indices(size)] += _RIDGE * float(np.trace(gram)) / size
        right = np.tensordot(source.T, self.summed.cross, axes=2)
        return np.asarray(sl.cho_solve(sl.cho_factor(gram, check_finite=False), right, check_finite=False))

    def best_source(self, coefficients: Array, *, nonnegative: bool) -> Array:
        """The V that minimises f for a given r, shape (M, B): small least squares problems with one matrix."""
        _, elements, realisations = self.shape
        normal = self.summed.pairs[0].times(coefficients) @ coefficients
        moment = self.summed.cross @ coefficients
        if nonnegative:
            upper = np.full((realisations, elements), _NO_BOUND)
            return solve_box_qps(normal, moment, upper, np.zeros_like(upper)).T
        return np.linalg.solve(normal + _RIDGE * np.trace(normal) * np.eye(elements), moment.T)


def random_start(problem: Bilinear, rng: np.random.Generator) -> tuple[Array, Array]:
    """Uniform random r and V, with the scale of r that explains most of D."""
    size, elements, realisations = problem.shape
    source, coefficients = rng.random((elements, realisations)), rng.random(size)
    value, _, gradient = problem.objective(coefficients, source)
    # f = e - 2 b + a and V df/dV = 2 (a - b) tell a = |F V|^2 and b = D F V; the best scale is b / a.
    half = 0.5 * float(np.sum(source * gradient))
    overlap = float(np.sum(problem.summed.energy)) + half - value
    return coefficients * overlap / (overlap + half), source


def alternate(problem: Bilinear, rng: np.random.Generator, recorder: Recorder, *, nonnegative: bool) -> str:
    """Least squares for r and for V in turn, from a random V, until f does not fall any more."""
    _, source = random_start(problem, rng)
    energy = float(np.sum(problem.summed.energy))
    last, idle = math.inf, 0
    while idle < 20:
        coefficients = problem.best_coefficients(source, nonnegative=nonnegative)
        source = problem.best_source(coefficients, nonnegative=nonnegative)
        value = problem.objective(coefficients, source)[0]
        recorder(source, lambda r=coefficients: problem.transport(r))
        # f is known to rounding of |D|^2; a decrease below that says nothing, and many in a row that it is over.
        idle = idle + 1 if last - value <= max(1e-9 * value, 1e-15 * energy) else 0
        last = value
    return "converged"


def descend(problem: Bilinear, rng: np.random.Generator, recorder: Recorder, *, nonnegative: bool = True) -> str:
    """L-BFGS-B over r and V together, with r scaled so that all its entries are seen alike."""
    size, elements, realisations = problem.shape
    coefficients, source = random_start(problem, rng)
    energy = float(np.sum(problem.summed.energy))
    # Entries of r start smaller than those of V by _BALANCE, whatever the units of D and of the weight.
    unit = _BALANCE * problem.scale * math.sqrt(np.mean((coefficients / problem.scale) ** 2) / np.mean(source**2))

    def split(x: Array) -> tuple[Array, Array]:
        return unit * x[:size], x[size:].reshape(elements, realisations)

    def callback(x: Array) -> None:
        r, v = split(x)
        recorder(v, lambda: problem.transport(r))

    x = np.concatenate([coefficients / unit, source.ravel()])
    for work in (problem.objective, problem.objective_over_pixels):

        def objective(x: Array, work: Callable[..., tuple[float, Array, Array]] = work) -> tuple[float, Array]:
            value, along_r, along_v = work(*split(x))
            return value / energy, np.concatenate([unit * along_r, along_v.ravel()]) / energy

        found = minimize(
            objective,
            x,
            jac=True,
            method="L-BFGS-B",
            bounds=[(0.0 if nonnegative else None, None)] * x.size,
            callback=callback,
            options={"maxcor": 30, "ftol": 0.0 if work != problem.objective else 1e-15, "gtol": 0.0, **_ENDLESS},
        )
        x = found.x
        # Only where next to nothing is left of D does the rounding of its square matter.
        if found.fun > NEARLY_EXACT:
            break
    return "converged" if found.success else f"stopped by its line search ({found.message.strip(': ')})"


# ------------------------------------------------------------------------------------------------------- other methods


def thesis(captures: CaptureSet, seed: int, recorder: Recorder, *, alpha: float, caps: tuple[int, ...]) -> str:
    """The thesis's algorithm, stopped ever later: it shows no iterates, so that each point is a run of its own."""
    for cap in caps:
        started = time.perf_counter()
        found = de_render_unstructured(captures, alpha=alpha, tolerance=0.0, cap=cap, rng=seed)
        seconds = time.perf_counter() - started
        transport = found.brdf.reshape(-1, captures.card.elements)
        recorder.points.append((seconds, *recorder.judge(found.source, transport)))
        recorder.iterations = found.alternations
    # Where a longer run happened to take less time, the shorter one could have as well.
    times = np.minimum.accumulate([point[0] for point in recorder.points][::-1])[::-1]
    recorder.points = [(float(t), *point[1:]) for t, point in zip(times, recorder.points)]
    return f"cap of {caps[-1]} alternations" if found.stopped_by == "cap" else "converged"


def factorise(captures: CaptureSet, seed: int, recorder: Recorder) -> str:
    """scikit-learn's non-negative matrix factorisation by coordinate descent, continued until D - F V stands still."""
    from sklearn.decomposition import non_negative_factorization
    from sklearn.exceptions import ConvergenceWarning

    data = np.maximum(captures.radiance.reshape(-1, captures.radiance.shape[2]), 0.0)
    rng = np.random.default_rng(seed)
    elements = captures.card.elements
    level, energy = math.sqrt(float(data.mean()) / elements), float(np.sum(data * data))
    transport, source = level * rng.random((len(data), elements)), level * rng.random((elements, data.shape[1]))
    step, last = 1, math.inf
    options: dict[str, Any] = {"n_components": elements, "init": "custom", "solver": "cd", "tol": 0.0}
    while True:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            transport, source, _ = non_negative_factorization(data, transport, source, max_iter=step, **options)
        recorder(source, lambda f=transport: f)
        value = float(np.sum((data - transport @ source) ** 2))
        recorder.residual = math.sqrt(value / energy)
        if last - value <= 1e-7 * step * value:
            return "converged"
        last, step = value, min(2 * step, 32)
