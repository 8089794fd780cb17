"""What Hypotheses 7 (far field) and 8 (BRDF of the angle sum) cost, measured against Algorithm 1."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import power_of_two, rescaled
from wallmirror.brdf import BRDF, AngleSumBRDF, AngleSumTable, Mirror
from wallmirror.brdf.tables import MOST_ANGLE_NODES
from wallmirror.convolution.angle import Variable, angle_convolution
from wallmirror.convolution.spherical import PointWeights, checked_source, cosines, spherical_convolution
from wallmirror.convolution.wall import wall_convolution
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.geometry import Card, Observer
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

_MOST_ROUNDS = 500


def relative_error(render: ArrayLike, reference: ArrayLike) -> float:
    """||render - reference|| / ||reference|| over all entries.

    Raises
    ------
    InputError
        For renders of other shapes, or that are not finite, at least in units of the reference.
    UndeterminedError
        If the reference is zero.
    """
    found, reference = np.asarray(render, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if found.shape != reference.shape:
        raise InputError(f"has shape {found.shape} where the reference has {reference.shape}", field="render")
    if not np.any(reference):
        raise UndeterminedError("the reference render is dark, so no error can be relative to it")
    unit = power_of_two(reference)
    with np.errstate(over="ignore", invalid="ignore"):
        reference = reference / unit
        apart = float(np.linalg.norm(found / unit - reference))
    if not math.isfinite(apart):
        raise InputError("or the reference holds a value that is not finite, or one too large for it", field="render")
    return apart / float(np.linalg.norm(reference))


def convolution_errors(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    source: ArrayLike,
    *,
    weights: PointWeights = "thesis",
    samples: int = 1000,
    order: int = 5,
) -> dict[str, float]:
    """Relative error against Algorithm 1 of every form of rendering by convolution.

    Parameters
    ----------
    source:
        (M,) or (M, B).
    samples, order:
        Of the half circle.

    Returns
    -------
    dict
        "spherical" (needs Hypothesis 8 alone), "angle sum" and "outgoing angle" (Hypothesis 7 on the directions),
        "wall" and "wall, both distances" (Hypothesis 7 and that tangents add).

    Examples
    --------
    >>> from wallmirror.brdf import GaussianTrain
    >>> observer = Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=1000, pixels_at="edges")
    >>> errors = convolution_errors(observer, Card(elements_x=(-5.0, 5.0), y=-50), GaussianTrain.of_the_text(), [0.5, 1])
    >>> {name: f"{error:.2g}" for name, error in errors.items() if name != "spherical"}
    {'wall': '1.1', 'wall, both distances': '0.55', 'angle sum': '0.013', 'outgoing angle': '1.1'}
    """
    source = checked_source(card, source)
    reference = radiance(transport_matrix(observer, card, brdf, weights=weights), source)
    renders = {
        "spherical": spherical_convolution(observer, card, brdf, source, samples=samples, order=order, weights=weights),
        "wall": wall_convolution(observer, card, brdf, source, weights=weights),
        "wall, both distances": wall_convolution(observer, card, brdf, source, projected_from="both", weights=weights),
    }
    variables: tuple[tuple[str, Variable], ...] = (("angle sum", "sum"), ("outgoing angle", "outgoing"))
    for name, variable in variables:
        renders[name] = angle_convolution(
            observer, card, brdf, source, variable=variable, samples=samples, order=order, weights=weights
        )
    return {name: relative_error(render, reference) for name, render in renders.items()}


@dataclass(frozen=True, kw_only=True)
class AngleSumFit:
    """The product q(theta_o) r(theta_s + theta_o) nearest to a BRDF, and how near it is.

    Parameters
    ----------
    brdf:
        r as a table over the angle sum.
    theta_o, factor:
        q at these outgoing angles, both (K,); 1 throughout unless it was asked for.
    residual:
        Relative L2 distance over the square of both angles, from 0 to 1.
    """

    brdf: AngleSumTable
    theta_o: Array = field(repr=False)
    factor: Array = field(repr=False)
    residual: float

    def of_angles(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """q(theta_o) r(theta_s + theta_o), broadcast, in radians."""
        theta_o = np.asarray(theta_o, dtype=np.float64)
        product: Array = np.interp(theta_o, self.theta_o, self.factor) * self.brdf(theta_s, theta_o)
        return product


def best_angle_sum(
    brdf: BRDF,
    *,
    limit: float = math.radians(80),
    samples: int = 401,
    weights: PointWeights = "thesis",
    outgoing_factor: bool = False,
) -> AngleSumFit:
    """The least-squares approximation of a BRDF by a function of the angle sum (Hypothesis 8).

    Over the square |theta_s|, |theta_o| <= limit it is the mean along the lines of constant sum. With a factor of the
    outgoing angle, which a convolution admits as part of Q, the two are found in turn until the residual stands still.

    Parameters
    ----------
    limit:
        Largest angle of either kind in radians, below pi / 2.
    samples:
        Uniform angles of either kind.
    weights:
        "thesis" fits rho, "cosine" fits rho cos theta_s.
    outgoing_factor:
        Whether to fit q(theta_o) as well; it is 1 in the mean.

    Raises
    ------
    InputError
        For a mirror, which has no values, or settings out of range.
    UndeterminedError
        For a BRDF that is zero throughout.

    Examples
    --------
    >>> from wallmirror.brdf import GaussianTrain, Table
    >>> bool(best_angle_sum(GaussianTrain.of_the_text()).residual < 1e-12)
    True
    >>> theta = np.linspace(-np.pi / 2, np.pi / 2, 181)
    >>> round(best_angle_sum(Table(values=1 + np.cos(theta[:, None] - theta))).residual, 2)
    0.28
    """
    if isinstance(brdf, Mirror):
        raise InputError("is a mirror, a delta without values; it is a function of the angle sum", field="wall.brdf")
    if not 0 < limit < math.pi / 2:
        raise InputError(f"is {math.degrees(limit):g} deg; give an angle between 0 and 90 deg", field="limit")
    if not isinstance(samples, (int, np.integer)) or not 2 <= samples <= MOST_ANGLE_NODES:
        raise InputError(f"needs two angles at least and {MOST_ANGLE_NODES} at most, not {samples}", field="samples")
    theta = np.linspace(-limit, limit, samples)
    target = np.asarray(brdf(theta[:, None], theta), dtype=np.float64) * cosines(theta[:, None], weights)
    if not np.any(target):
        raise UndeterminedError("the BRDF is zero throughout, so no approximation can be near it in relative terms")
    unit = power_of_two(target)
    target /= unit
    size = float(np.linalg.norm(target))
    line = np.add.outer(np.arange(samples), np.arange(samples))
    factor = np.ones(samples)
    before = math.inf
    for _ in range(_MOST_ROUNDS):
        weight = np.broadcast_to(factor, target.shape)
        power = np.bincount(line.ravel(), (weight**2).ravel())
        r = np.bincount(line.ravel(), (weight * target).ravel()) / np.where(power > 0, power, 1.0)
        values = r[line]
        residual = float(np.linalg.norm(target - factor * values)) / size
        if not outgoing_factor or before - residual <= 1e-6 * residual:
            break
        before = residual
        power_o = np.sum(values**2, axis=0)
        factor = np.sum(values * target, axis=0) / np.where(power_o > 0, power_o, 1.0)
        factor /= factor.mean()
    table = AngleSumTable(start=-2 * limit, stop=2 * limit, values=rescaled(r, unit, field="wall.brdf"))
    return AngleSumFit(brdf=table, theta_o=theta, factor=factor, residual=residual)
