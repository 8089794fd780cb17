"""Blind de-rendering on the spherical convolution: the conclusion's open door, and what `solve` does in its terms.

Seen from the wall point w, pattern b is a map of light over the half circle,

    E_wb(theta) = sum_i V_ib delta(theta - theta_s,i(w)),

and the camera reads one value of its convolution with rho, the one towards theta_o(w) (eq. 3.5, `convolution.spherical`):

    L_b(w) = sum_theta rho(theta_o(w) + theta) E_wb(theta).

The light V and the BRDF are the same for every w. What differs is where they stand on the circle, theta_s,i(w) and theta_o(w),
and that the geometry predicts, as the thesis's conclusion notes. Each wall point thus sees the same two unknowns up to a known
turn. With rho in a basis of the circle, of coefficients c, the turn is a sparse matrix that reads both angles,

    L_b(w) = sum_i V_ib (T_i c)(w),    T_i[w, k] = sum of beta_s(theta_s,i(w)) beta_o(theta_o(w)) over nodes s + o = k,

linear in c and linear in V. One value of each convolution is "only a fraction" of it, but the turns differ from point to point,
so that the fractions complete each other: the columns T_i c must span the space of the captures, which determines c
(`derendering.subspace`). `solve` does this with T_i in which the two readings are one, a spline in
theta_s,i(w) + theta_o(w); here they are the two of the discrete convolution, on its own grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.convolution.half_circle import HalfCircle
from wallmirror.convolution.spherical import cosines, scene_angles
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.subspace import ClosedForm, closed_form
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.geometry import Card, Observer

Array = NDArray[np.float64]

_NEAR = 0.3  # error bound of the closed form above which its answer is none


@dataclass(frozen=True)
class BlindSpherical:
    """Result of `solve_spherical`, up to one scale.

    Parameters
    ----------
    source:
        V, shape (M, B).
    angles, brdf:
        rho at the nodes of the circle that the captures see, both (K,), in radians.
    closed:
        The closed form with its certificates.
    """

    source: Array
    angles: Array
    brdf: Array
    closed: ClosedForm


def spherical_designs(
    observer: Observer, card: Card, grid: HalfCircle, *, weights: str = "thesis"
) -> list[sp.csr_array]:
    """T_1 .. T_M, each (A N, 2K): the spherical convolution as a matrix on the coefficients of rho.

    Column k stands for the node (k - K) pi / K of the angle sum.

    Parameters
    ----------
    weights:
        "thesis" or "cosine".

    Examples
    --------
    >>> from wallmirror.brdf import GaussianTrain
    >>> from wallmirror.convolution import spherical_convolution
    >>> observer = Observer(position=(0, -5), fov=np.radians(60), view_angles=(0,), pixels=50)
    >>> card, lobe = Card(elements_x=(-1.0, 2.0), y=-4), GaussianTrain(centres=(0.2,), sigma=0.1)
    >>> grid = HalfCircle(samples=200, order=3)
    >>> designs = spherical_designs(observer, card, grid)
    >>> c = np.roll(grid.coefficients(lobe), grid.samples)
    >>> render = spherical_convolution(observer, card, lobe, [0.5, 1.0], samples=200, order=3)
    >>> bool(np.allclose(0.5 * (designs[0] @ c) + designs[1] @ c, render.ravel(), rtol=0, atol=1e-12))
    True
    """
    if weights not in ("thesis", "cosine"):
        raise InputError(f'is "{weights}"; the convolution is written for "thesis" and "cosine"', field="transport")
    theta_s, theta_o = scene_angles(observer, card)
    factor = cosines(theta_s, "cosine" if weights == "cosine" else "thesis").reshape(-1, card.elements)
    nodes_o, values_o = (part.reshape(grid.order + 1, -1) for part in grid.weights(theta_o))
    width, rows = 2 * grid.order + 1, theta_o.size
    designs = []
    for i in range(card.elements):
        nodes_s, values_s = (part.reshape(grid.order + 1, -1) for part in grid.weights(theta_s[..., i]))
        values = np.zeros((rows, width))
        for s in range(grid.order + 1):
            for o in range(grid.order + 1):
                values[:, s + o] += values_s[s] * values_o[o]
        first = (nodes_s[0] + nodes_o[0] + grid.samples) % (2 * grid.samples)
        columns = first[:, None] + np.arange(width)
        if columns.max() >= 2 * grid.samples:
            raise InputError("reach round the circle; views or card come too near to the wall's plane", field="angles")
        pointers = width * np.arange(rows + 1)
        data = (values * factor[:, i : i + 1]).ravel()
        designs.append(sp.csr_array((data, columns.ravel(), pointers), shape=(rows, 2 * grid.samples)))
    return designs


def solve_spherical(captures: CaptureSet, *, samples: int = 1000, order: int = 5) -> BlindSpherical:
    """Recover pattern and BRDF from captures on the spherical convolution's own grid, in closed form.

    A demonstration: `solve` chooses its grid by the data, and treats noise, finite strips and pixels, and few captures.

    Parameters
    ----------
    captures:
        "thesis" or "cosine" weights, B >= M realisations, little noise.
    samples, order:
        Of the `HalfCircle`.

    Raises
    ------
    UndeterminedError
        As `solve`: too few or too similar patterns; or a grid on which the closed form cannot single out an answer.

    Examples
    --------
    >>> from wallmirror.brdf import GaussianTrain
    >>> from wallmirror.derendering.estimate import scale_free_error
    >>> from wallmirror.transport import radiance, transport_matrix
    >>> observer = Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=500)
    >>> card, v = Card(elements_x=(-3.0, 1.0, 2.0), y=-4), np.random.default_rng(0).random((3, 5))
    >>> films = radiance(transport_matrix(observer, card, GaussianTrain.of_the_text(), weights="thesis"), v)
    >>> found = solve_spherical(CaptureSet(observer=observer, card=card, radiance=films, transport="thesis"), samples=700)
    >>> scale_free_error(found.source, v) < 1e-6
    True
    """
    grid = HalfCircle(samples=samples, order=order)
    designs = spherical_designs(captures.observer, captures.card, grid, weights=captures.transport)
    problem, space = prepare(captures)
    seen = np.flatnonzero(np.sum([abs(t).sum(axis=0) for t in designs], axis=0) > 0)
    low, high = int(seen[0]), int(seen[-1]) + 1
    closed = closed_form(problem.data, [sp.csr_array(t[:, low:high]) for t in designs], space)
    if not closed.error <= _NEAR:
        raise UndeterminedError(
            f"on a grid of {math.degrees(grid.step):.2g} deg the captures single out no BRDF (error bound {closed.error:.1g}); "
            "take another number of samples, or use `solve`"
        )
    coefficients = np.zeros(2 * samples)
    coefficients[low:high] = closed.coefficients
    # The inverse of the two prefilters: what the coefficients of a sampled BRDF were divided by.
    spread = np.zeros(2 * samples)
    nodes, values = grid.weights(np.zeros(()))
    np.add.at(spread, nodes, values)
    rho: Array = np.fft.irfft(np.fft.rfft(coefficients) * np.fft.rfft(spread) ** 2, 2 * samples).astype(np.float64)
    angles: Array = grid.step * np.arange(-samples, samples, dtype=np.float64)
    inner = slice(low + order, high - order)
    return BlindSpherical(closed.source * problem.scale, angles[inner], rho[inner], closed)
