"""The rendering equation on a small discretised scene: a box of diffuse patches, and its Neumann series (section 1.4).

On diffuse patches of constant radiance eq. 1.16 is a system of linear equations, L = L_e + T L with

    T = diag(albedo) F,     F[i, j] = 1/(pi A_i) int int cos cos / r^2 dA_j dA_i,

F_ij being the share of the light from patch i that meets patch j, or, by A_i F_ij = A_j F_ji, what radiance 1 of patch
j gives patch i in units of an irradiance pi. Its solution is (1 - T)^-1 L_e (eq. 1.21), its series the sum of T^k L_e (eq.
1.20), whose k-th term has been reflected k times.

Patches are rectangles with sides along the axes, for which F has closed forms without quadrature. With p, q the
differences of coordinates along shared axes and the integrals over them as sums over 16 pairs of corners,

    parallel at distance z:   q s atan(q/s) + p t atan(p/t) - z^2/2 log(p^2 + q^2 + z^2),   s^2 = p^2 + z^2, t^2 = q^2 + z^2,
                              over 2 pi;
    at right angles:          (q^2 - w^2)/2 log(q^2 + w^2) + 2 w q atan(q/w),   w^2 = x^2 + y^2 from the shared edge's line,
                              over 4 pi

(catalogue of radiation configuration factors, Howell, C-13 and C-15, there in other forms).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import xlogy

from wallmirror.brdf.base import require_range
from wallmirror.errors import InputError

Array = NDArray[np.float64]

#: The faces of a box, by axis and end: x, y and z at 0 and at its size.
FACES = ("x0", "x1", "y0", "y1", "z0", "z1")
Face = Literal["x0", "x1", "y0", "y1", "z0", "z1"]
_MOST_PATCHES = 3000
_MOST_SLENDER = 100
_MOST_TERMS = 10**5


@dataclass(frozen=True, kw_only=True)
class Box:
    """A closed or open box, each face cut into `cells` x `cells` patches, all of them diffuse and facing inwards.

    Parameters
    ----------
    size:
        Lengths along x, y, z.
    cells:
        n; patches are numbered face by face in the order of `FACES`, P = 6 n^2 of them.
    open_faces:
        Faces that are not there: light that meets them is lost.

    Raises
    ------
    InputError
        For lengths beyond 1e-6 to 1e6 or more than a hundred times one another, fewer than 1 or more than 3000 patches, or a
        box whose faces are all open.

    Examples
    --------
    >>> room = Box(size=(2.0, 3.0, 1.0), cells=2)
    >>> room.form_factors().sum(axis=1).round(12).tolist() == [1.0] * 24
    True
    """

    size: tuple[float, float, float]
    cells: int = 4
    open_faces: tuple[Face, ...] = ()
    low: Array = field(init=False, repr=False)
    high: Array = field(init=False, repr=False)
    face: NDArray[np.intp] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.size) != 3:
            raise InputError(f"is {self.size}; give three lengths", field="size")
        for length in self.size:
            require_range("size", length, 1e-6, 1e6)
        if max(self.size) > _MOST_SLENDER * min(self.size):
            raise InputError(
                f"is {self.size}; give lengths at most {_MOST_SLENDER} times one another, since the closed forms cancel in "
                "boxes more slender than that",
                field="size",
            )
        present = [k for k, name in enumerate(FACES) if name not in self.open_faces]
        if len(present) + len(set(self.open_faces)) != len(FACES) or not present:
            raise InputError(f"are {self.open_faces}; name faces among {', '.join(FACES)}, not all", field="open_faces")
        if int(self.cells) != self.cells or self.cells < 1 or len(present) * self.cells**2 > _MOST_PATCHES:
            raise InputError(f"is {self.cells}; give 1 to {int((_MOST_PATCHES / 6) ** 0.5)}", field="cells")
        low, high, face = [], [], []
        i, j = (g.ravel() for g in np.meshgrid(*(np.arange(self.cells),) * 2, indexing="ij"))
        for k in present:
            axis, end = divmod(k, 2)
            corner = np.zeros((2, i.size, 3))
            corner[:, :, axis] = end * self.size[axis]
            for along, index in zip(_others(axis), (i, j), strict=True):
                corner[:, :, along] = np.stack([index, index + 1]) / self.cells * self.size[along]
            low.append(corner[0])
            high.append(corner[1])
            face.append(np.full(i.size, k))
        object.__setattr__(self, "low", np.concatenate(low))
        object.__setattr__(self, "high", np.concatenate(high))
        object.__setattr__(self, "face", np.concatenate(face))

    @property
    def areas(self) -> Array:
        """Areas of the patches, shape (P,)."""
        sides = self.high - self.low
        axis = self.face // 2
        along = np.array([_others(a) for a in range(3)])[axis]
        rows = np.arange(axis.size)
        return np.asarray(sides[rows, along[:, 0]] * sides[rows, along[:, 1]], dtype=np.float64)

    def on(self, face: Face, inside: float = 1.0, outside: float = 0.0) -> Array:
        """A value for the patches of one face and another for all others, shape (P,)."""
        return np.where(self.face == FACES.index(face), inside, outside)

    def form_factors(self) -> Array:
        """F, shape (P, P): the share of the light from each patch (row) that meets each other patch (column).

        Known to a few eps times the square of cells times slenderness, what cancels in the closed forms.
        """
        exchange = np.zeros((self.face.size, self.face.size))
        for k in np.unique(self.face):
            for m in np.unique(self.face):
                if k < m:
                    rows, columns = np.flatnonzero(self.face == k), np.flatnonzero(self.face == m)
                    block = self._exchange(rows, columns, k // 2, m // 2)
                    exchange[np.ix_(rows, columns)] = block
                    exchange[np.ix_(columns, rows)] = block.T
        return np.maximum(exchange, 0.0) / self.areas[:, None]

    def _exchange(self, rows: NDArray[np.intp], columns: NDArray[np.intp], k: int, m: int) -> Array:
        """A_i F_ij between the patches of two faces across the axes k and m."""

        def ends(patches: NDArray[np.intp], axis: int) -> tuple[Array, Array]:
            return self.low[patches, axis], self.high[patches, axis]

        total = np.zeros((rows.size, columns.size))
        if k == m:
            one, two = _others(k)
            for sign_p, p in _differences(ends(rows, one), ends(columns, one)):
                for sign_q, q in _differences(ends(rows, two), ends(columns, two)):
                    total += sign_p * sign_q * _parallel(p, q, self.size[k])
            return total
        shared = 3 - k - m
        # Distances from the shared edge's line: along m on the first face, along k on the second.
        first = [np.abs(end - self.low[columns[0], m]) for end in ends(rows, m)]
        second = [np.abs(end - self.low[rows[0], k]) for end in ends(columns, k)]
        for a, x in enumerate(first):
            for b, y in enumerate(second):
                # Towards the corner or away from it: the order of the ends decides the sign, and so does a flip.
                sign_w = (1 if a == b else -1) * _towards(first) * _towards(second)
                w = np.hypot(x[:, None], y)
                for sign_q, q in _differences(ends(rows, shared), ends(columns, shared)):
                    total -= sign_w * sign_q * _upright(w, q)
        return total


def transport_operator(form_factors: ArrayLike, albedo: ArrayLike) -> Array:
    """T = diag(albedo) F, shape (P, P), of one albedo or one for each patch.

    Raises
    ------
    InputError
        For form factors or albedos that are negative, not finite or of another shape; an albedo above 1 is allowed, to show
        what it does.
    """
    factors = np.asarray(form_factors, dtype=np.float64)
    albedos = np.asarray(albedo, dtype=np.float64)
    for name, values in (("form_factors", factors), ("albedo", albedos)):
        if not np.all(np.isfinite(values)) or values.min(initial=0.0) < 0:
            raise InputError("holds a value that is negative or not finite", field=name)
    if factors.ndim != 2 or albedos.shape not in ((), factors.shape[:1]):
        raise InputError(
            f"has shape {albedos.shape}; give one, or one for each row of F {factors.shape}", field="albedo"
        )
    albedos = np.broadcast_to(albedos, factors.shape[:1])
    return np.asarray(albedos[:, None] * factors, dtype=np.float64)


@dataclass(frozen=True)
class NeumannSeries:
    """The series of eq. 1.20 beside its limit.

    Parameters
    ----------
    partial_sums:
        L_e + T L_e + ... + T^k L_e for k = 0 to K, shape (K + 1, P).
    exact:
        (1 - T)^-1 L_e, shape (P,); the limit only where the spectral radius is below 1.
    largest_factor:
        The norm of T that energy bounds: its largest row sum, |T| in the norm of the largest radiance.
    spectral_radius:
        Largest modulus of an eigenvalue of T: the ratio in which the error falls in the end.
    """

    partial_sums: Array
    exact: Array
    largest_factor: float
    spectral_radius: float

    @property
    def errors(self) -> Array:
        """Largest error of each partial sum over the largest radiance, shape (K + 1,); 0 in the dark."""
        apart = np.abs(self.partial_sums - self.exact).max(axis=1)
        return np.asarray(apart / (np.abs(self.exact).max() or 1.0), dtype=np.float64)

    @property
    def ratio(self) -> float:
        """How much of the error each further term leaves, from the last terms above 1e-12 of the whole."""
        errors = self.errors[self.errors > 1e-12]
        steps = min(5, errors.size - 1)
        return float((errors[-1] / errors[-1 - steps]) ** (1 / steps)) if steps > 0 else 0.0


def neumann_series(operator: ArrayLike, emitted: ArrayLike, terms: int) -> NeumannSeries:
    """Sum the series of a transport operator term by term, and solve for its limit.

    Parameters
    ----------
    operator:
        T, shape (P, P), finite and >= 0.
    emitted:
        L_e, shape (P,).
    terms:
        K, the largest number of reflections.

    Raises
    ------
    InputError
        If a matrix of another shape or values that are not finite are given, or 1 - T is singular: then light has no steady
        state.

    Examples
    --------
    >>> room = Box(size=(1.0, 1.0, 1.0), cells=1)
    >>> T = transport_operator(room.form_factors(), 0.5)
    >>> series = neumann_series(T, np.ones(6), 20)
    >>> series.exact.round(12).tolist(), round(series.ratio, 6)
    ([2.0, 2.0, 2.0, 2.0, 2.0, 2.0], 0.5)
    """
    matrix, source = np.asarray(operator, dtype=np.float64), np.asarray(emitted, dtype=np.float64)
    if matrix.shape != (source.size, source.size) or source.ndim != 1 or source.size == 0:
        raise InputError(f"has shape {matrix.shape}; give one row and column a patch", field="operator")
    if not (isinstance(terms, (int, np.integer)) and 0 <= terms <= _MOST_TERMS):
        raise InputError(f"is {terms}; give a whole number from 0 to {_MOST_TERMS}", field="terms")
    if not np.all(np.isfinite(matrix)) or matrix.min() < 0:
        raise InputError("holds a value that is negative or not finite", field="operator")
    radius = float(np.max(np.abs(np.linalg.eigvals(matrix))))
    system = np.eye(source.size) - matrix
    if np.linalg.cond(system) > 1e14:
        raise InputError(
            f"keeps all of the light (spectral radius {radius:.12g}): the sum has no limit; let some of it be absorbed",
            field="operator",
        )
    if not np.all(np.isfinite(source)):
        raise InputError("holds a value that is not finite", field="emitted")
    sums = np.empty((terms + 1, source.size))
    term = sums[0] = source
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, terms + 1):
            term = matrix @ term
            sums[k] = sums[k - 1] + term
    limit = np.asarray(np.linalg.solve(system, source), dtype=np.float64)
    if not (np.all(np.isfinite(limit)) and np.all(np.isfinite(sums))):
        raise InputError("holds a value whose sum leaves the range of float64; use other units", field="emitted")
    return NeumannSeries(sums, limit, float(matrix.sum(axis=1).max()), radius)


def _others(axis: int) -> tuple[int, int]:
    """The two axes along a face across the given one."""
    one, two = (a for a in range(3) if a != axis)
    return one, two


def _towards(ends: list[Array]) -> int:
    """+1 if distances grow with the coordinate, else -1."""
    return 1 if ends[1][0] > ends[0][0] else -1


def _differences(first: tuple[Array, Array], second: tuple[Array, Array]) -> list[tuple[int, Array]]:
    """Differences of the ends of two intervals with the sign that an integral over both gives each."""
    return [(-1 if a == b else 1, one[:, None] - two) for a, one in enumerate(first) for b, two in enumerate(second)]


def _parallel(p: Array, q: Array, z: float) -> Array:
    """An antiderivative of z^2 / (pi (z^2 + p^2 + q^2)^2), twice in p and twice in q."""
    s, t = np.hypot(p, z), np.hypot(q, z)
    square = p**2 + q**2 + z**2
    value = q * s * np.arctan(q / s) + p * t * np.arctan(p / t) - z**2 / 2 * np.log(square)
    return np.asarray(value / (2 * np.pi), dtype=np.float64)


def _upright(w: Array, q: Array) -> Array:
    """An antiderivative of x y / (pi (x^2 + y^2 + q^2)^2), w^2 = x^2 + y^2: once in x and y, and twice, negated, in q."""
    value = xlogy(q**2 - w**2, q**2 + w**2) / 2 + 2 * w * q * np.arctan2(q, w)
    return np.asarray(value / (4 * np.pi), dtype=np.float64)
