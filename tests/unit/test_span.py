"""The span of very many elements: an orthonormal basis from a band, whose pivoting must see as far as the band reaches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering import splines
from wallmirror.derendering.moments import moments
from wallmirror.derendering.span import Span, _Basis
from wallmirror.geometry import Card
from wallmirror.transport import build_kernel

from .helpers import thesis_observer

ELEMENTS, PIXELS, VIEWS = 100, 60, 6


def stretched(columns: NDArray[np.float64], basis: _Basis) -> NDArray[np.float64]:
    """|Q x| / |x| of the basis Q for some x."""
    dimensions = sum(kept.size for kept, *_ in basis.pieces)
    x = np.random.default_rng(0).standard_normal((dimensions, 4))
    made = columns @ basis.combined(x)
    return np.asarray(np.linalg.norm(made, axis=0) / np.linalg.norm(x, axis=0))


def test_a_hundred_elements_span_all_films_of_few_pixels() -> None:
    card = Card(elements_x=tuple(np.linspace(-2.5, 2.5, ELEMENTS)), y=-1.0)
    kernel = build_kernel(thesis_observer(PIXELS, VIEWS), card, weights="cosine")
    designs = splines.design_matrices(kernel, splines.grid_for(kernel, step=np.radians(2), degree=3))
    span = Span.of(moments(np.ones((PIXELS * VIEWS, 1)), designs), PIXELS * VIEWS)
    basis = _Basis.of(span.gram)
    # As NumPy's singular values have it, at the root of the share of a square at which a column spans nothing new.
    columns = np.concatenate([t.toarray() for t in designs], axis=1)
    rank = np.linalg.matrix_rank(columns, tol=1e-5 * float(np.max(np.linalg.norm(columns, axis=0))))
    assert rank == PIXELS * VIEWS
    assert sum(kept.size for kept, *_ in basis.pieces) == rank
    # The weakest columns kept are known to 1e-16 / 1e-10.
    assert np.max(np.abs(stretched(columns, basis) - 1)) < 1e-6
    # The planted fault: among 64 columns stand few angles, from which all further ones are extrapolated.
    assert np.max(np.abs(stretched(columns, _Basis.of(span.gram, 64)) - 1)) > 1
