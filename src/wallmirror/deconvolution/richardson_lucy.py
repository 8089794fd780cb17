"""Richardson-Lucy deconvolution for any linear operator (eq. 3.14), with a stopping rule and acceleration.

    f_{i+1} = f_i / (H^T 1) * H^T ( g / (H f_i + b) )

converges on the maximum likelihood for Poisson data of mean H f + b. Eq. 3.14 leaves out H^T 1, which is 1 only where all
light of a sample arrives and the kernel sums to 1; without it the border of a cropped picture is wrong.

References
----------
W. H. Richardson, "Bayesian-based iterative method of image restoration", J. Opt. Soc. Am. 62, 55-59 (1972),
doi:10.1364/JOSA.62.000055. L. B. Lucy, "An iterative technique for the rectification of observed distributions",
Astron. J. 79, 745-754 (1974), doi:10.1086/111605. D. S. C. Biggs, M. Andrews, "Acceleration of iterative image
restoration algorithms", Appl. Opt. 36, 1766-1775 (1997), doi:10.1364/AO.36.001766. J. M. Bardsley, J. Goldes,
"Regularization parameter selection methods for ill-posed Poisson maximum likelihood estimation", Inverse Problems 25,
095005 (2009), doi:10.1088/0266-5611/25/9/095005.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.linalg import LinearOperator, aslinearoperator
from scipy.special import kl_div

from wallmirror.arithmetic import power_of_two, rescaled
from wallmirror.deconvolution.checking import ROUNDING, Array, count, in_unit, nonnegative_samples, one_of, positive
from wallmirror.errors import InputError

Acceleration = Literal["none", "biggs-andrews"]
#: Why an iteration ended.
StoppedBy = Literal["iterations", "relative change", "discrepancy"]

_PLAIN = 1e-100  # scales from here to its reciprocal need no unit


@dataclass(frozen=True, kw_only=True)
class RichardsonLucy:
    """Where the iteration ended.

    Parameters
    ----------
    signal:
        f.
    iterations:
        How many were made.
    stopped_by:
        "iterations" (the limit), "relative change" or "discrepancy".
    misfit:
        Before each iteration, of the prediction p = H f + b, shape (iterations,): the deviance 2 sum g log(g / p) - g + p
        where the noise was said to be "poisson", |g - p| otherwise. The deviance is what falls in every plain step.
    change:
        |f_{i+1} - f_i| / |f_i| in each iteration, shape (iterations,).
    """

    signal: Array = field(repr=False)
    iterations: int
    stopped_by: StoppedBy
    misfit: Array = field(repr=False)
    change: Array = field(repr=False)

    @property
    def status(self) -> str:
        """A sentence that says how it ended and what to do."""
        if self.stopped_by == "discrepancy":
            return f"The misfit reached the noise after {self.iterations} iterations."
        if self.stopped_by == "relative change":
            return f"The estimate settled after {self.iterations} iterations; with noise it may have settled on noise."
        return (
            f"Stopped at the limit of {self.iterations} iterations, which decides how smooth the estimate is: state the "
            "noise, or look at other limits."
        )


def richardson_lucy(
    operator: Any,
    data: ArrayLike,
    *,
    iterations: int = 50,
    start: ArrayLike | None = None,
    background: float = 0.0,
    acceleration: Acceleration = "none",
    noise: Literal["unknown", "poisson"] | float = "unknown",
    relative_change: float = 0.0,
) -> RichardsonLucy:
    """Maximum likelihood for Poisson data by multiplicative steps, stopped before it fits the noise.

    Parameters
    ----------
    operator:
        H >= 0, shape (m, n): a `Convolution`, or what SciPy's `aslinearoperator` takes, with an adjoint.
    data:
        g >= 0, m samples of any shape.
    iterations:
        At most so many, >= 1.
    start:
        f_0 >= 0, n samples; what starts at zero stays there. Left out: constant, with the light of the data.
    background:
        b >= 0, known light in every datum that does not come from f.
    acceleration:
        "biggs-andrews": extrapolate along the last two steps; the same fixed point in fewer iterations.
    noise:
        "poisson": data are counts; stop when the deviance falls to the number of data. A number > 0: stop when
        |g - H f - b| falls to it (sigma sqrt(m) for white noise). "unknown": neither.
    relative_change:
        Stop when |f_{i+1} - f_i| <= relative_change |f_i|.

    Raises
    ------
    InputError
        For data, start, background or operator below zero or not finite, data that H cannot reach from the start, a start
        more than 1e100 times brighter or darker than the data, or a result outside the range of float64. Nothing is clipped.

    Notes
    -----
    Samples of f that no datum sees (H^T 1 = 0) keep their start. Where FFTs leave H f or f below zero by rounding they are
    set to it.

    Examples
    --------
    >>> from wallmirror.deconvolution import Convolution
    >>> blur = Convolution([0.25, 0.5, 0.25], (5,))
    >>> result = richardson_lucy(blur, blur.apply([0, 0, 1.0, 0, 0]), iterations=500)
    >>> np.round(result.signal, 3).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0]
    """
    step = RichardsonLucyStep(operator, data, background=background)
    count(iterations, "iterations")
    one_of(acceleration, get_args(Acceleration), "acceleration")
    target = _target(noise, step.data.size, step.unit)
    if not 0 <= relative_change < math.inf:
        raise InputError(f"is {relative_change:g}; give a finite number >= 0", field="relative_change")
    f = step.constant_start() if start is None else step.checked_start(start)
    previous = f
    moves: list[Array] = []
    misfits, changes = [], []
    stopped_by: StoppedBy = "iterations"
    for _ in range(iterations):
        origin = f
        if acceleration == "biggs-andrews" and len(moves) == 2:
            # y_k = f_k + alpha_k (f_k - f_{k-1}), alpha_k from the moves g_{k-1} and g_{k-2} of the last two steps.
            size = float(moves[0] @ moves[0])
            along = min(max(float(moves[1] @ moves[0]) / size, 0.0), 1.0) if size > 0 else 0.0
            origin = np.maximum(f + along * (f - previous), 0.0)
        prediction = step.predict(origin)
        misfit = step.deviance(prediction) if noise == "poisson" else float(np.linalg.norm(step.data - prediction))
        if target is not None and misfit <= target:
            f, stopped_by = origin, "discrepancy"
            break
        misfits.append(misfit)
        previous, f = f, step.update(origin, prediction)
        if acceleration == "biggs-andrews":
            moves = [*moves[-1:], f - origin]
        size = float(np.linalg.norm(previous))
        changes.append(float(np.linalg.norm(f - previous)) / size if size > 0 else 0.0)
        if changes[-1] <= relative_change:
            stopped_by = "relative change"
            break
    return RichardsonLucy(
        signal=step.in_units(f).reshape(step.signal_shape if start is None else np.shape(start)),
        iterations=len(changes),
        stopped_by=stopped_by,
        misfit=rescaled(np.array(misfits), step.unit, field="data"),
        change=np.array(changes),
    )


class RichardsonLucyStep:
    """What every iteration on the same operator and data shares; vectors are flat.

    Data and background are held in units of a power of two, `unit`, and the signal in units of `unit` over another where the
    operator's scale is extreme, so that neither quotients nor norms leave the range of float64.

    Parameters
    ----------
    operator, data, background:
        As for `richardson_lucy`.
    """

    def __init__(self, operator: Any, data: ArrayLike, *, background: float = 0.0) -> None:
        self._operator: LinearOperator = aslinearoperator(operator)
        self.data, self.unit = in_unit(nonnegative_samples(data, "data").ravel())
        if not (math.isfinite(background) and background >= 0):
            raise InputError(f"is {background:g}; give a finite number >= 0", field="background")
        self.background = float(background) / self.unit
        if self._operator.shape[0] != self.data.size:
            raise InputError(
                f"has {self.data.size} samples where the operator gives {self._operator.shape[0]}", field="data"
            )
        if not getattr(operator, "nonnegative", True) or (isinstance(operator, np.ndarray) and operator.min() < 0):
            raise InputError("has entries below zero; Richardson-Lucy takes an operator >= 0", field="operator")
        self.signal_shape: tuple[int, ...] = getattr(operator, "signal_shape", (self._operator.shape[1],))
        with np.errstate(over="ignore", invalid="ignore"):
            reached = np.asarray(self._operator.rmatvec(np.ones(self.data.size)), dtype=np.float64)
        if not np.all(np.isfinite(reached)):
            raise InputError("holds a value that is not finite, or a sum of them is not", field="operator")
        largest = float(reached.max())
        if largest <= 0:
            raise InputError("sends no light to the data: all of it is zero, or some below zero", field="operator")
        unit = power_of_two(reached)
        self._reach = unit if not _PLAIN <= unit <= 1 / _PLAIN else 1.0
        if self._reach != 1:
            reached, largest = reached / self._reach, largest / self._reach
        unseen = reached <= ROUNDING * largest
        self._reached = np.where(unseen, 1.0, reached)
        self._unseen = unseen if unseen.any() else None
        self._light = float(np.sum(reached))

    def constant_start(self) -> Array:
        """The same in every sample, with as much light as the data have beyond the background."""
        light = max(float(np.sum(self.data - self.background)), 0.0)
        return np.full(self._reached.size, light / self._light)

    def checked_start(self, start: ArrayLike) -> Array:
        """The given start, flat, where it can explain the data."""
        f = nonnegative_samples(start, "start").ravel()
        relative = float(f.max()) / self.unit * self._reach
        if relative > 0 and not _PLAIN <= relative <= 1 / _PLAIN:
            raise InputError(
                f"peaks at {f.max():.3g}, out of all proportion to the data; give a start of about their light",
                field="start",
            )
        f = f / self.unit * self._reach
        if f.size != self._reached.size:
            raise InputError(f"has {f.size} samples where the operator takes {self._reached.size}", field="start")
        prediction = self.predict(f)
        dark = prediction <= ROUNDING * float(prediction.max())
        if np.any(self.data[dark] > ROUNDING * float(self.data.max())):
            raise InputError(
                "is zero wherever the light of some datum could come from, and zeros stay zero; start above zero there, "
                "or give a background",
                field="start",
            )
        return f

    def predict(self, f: Array) -> Array:
        """H f + b."""
        prediction: Array = np.asarray(self._operator.matvec(f))
        if self._reach != 1:
            prediction = prediction / self._reach
        return prediction + self.background if self.background > 0 else prediction

    def update(self, f: Array, prediction: Array) -> Array:
        """f / (H^T 1) * H^T (g / prediction)."""
        factor = np.array(self._operator.rmatvec(self.data / self._above_rounding(prediction)))
        if self._reach != 1:
            factor /= self._reach
        np.maximum(factor, 0.0, out=factor)
        factor /= self._reached
        if self._unseen is not None:
            factor[self._unseen] = 1.0
        factor *= f
        return factor

    def deviance(self, prediction: Array) -> float:
        """2 sum g log(g / p) - g + p over `unit`: twice what the Poisson log likelihood is short of its largest value."""
        return 2 * float(np.sum(kl_div(self.data, self._above_rounding(prediction))))

    def in_units(self, f: Array) -> Array:
        """A signal of the iteration in the units of data and operator."""
        return rescaled(f, self.unit, 1 / self._reach, field="data")

    def _above_rounding(self, prediction: Array) -> Array:
        return np.maximum(prediction, max(ROUNDING * float(prediction.max()), np.finfo(np.float64).tiny))


def _target(noise: str | float, samples: int, unit: float) -> float | None:
    """The misfit that the noise explains, over the unit of the data."""
    if isinstance(noise, str):
        one_of(noise, ("unknown", "poisson"), "noise")
        return samples / unit if noise == "poisson" else None
    return positive(noise, "noise") / unit
