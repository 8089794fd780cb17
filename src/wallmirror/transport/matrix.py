"""F for a BRDF that is known, and what it renders: Algorithm 1."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.brdf import BRDF, Mirror
from wallmirror.errors import InputError
from wallmirror.geometry import Array, Card, Observer
from wallmirror.memory import require_memory, transport_bytes
from wallmirror.quadrature import MAX_ORDER
from wallmirror.transport.mirror import mirror_matrix
from wallmirror.transport.nodes import Nodes, Weights


def transport_matrix(
    observer: Observer,
    card: Card,
    brdf: BRDF,
    *,
    weights: Weights = "physical",
    tolerance: float = 1e-9,
    orders: tuple[int, int] | None = None,
) -> Array:
    """F of section 4.1.2 for a known BRDF, shape (A, N, M).

    Parameters
    ----------
    weights:
        "thesis", "cosine" or "physical".
    tolerance:
        Quadrature error wanted, relative to the largest entry: the orders grow until F moves by less.
    orders:
        Nodes across a pixel and across a strip, to evaluate F once with these whatever the error; see `build_kernel`.

    Raises
    ------
    InputError
        If more than 256 nodes would be needed, or F is larger than the memory.

    Examples
    --------
    >>> from wallmirror.scene import load_scene
    >>> scene = load_scene("flat_wall_diffuse")
    >>> transport_matrix(scene.observer, scene.card, scene.wall.brdf).shape
    (20, 500, 4)
    """
    require_memory(
        transport_bytes(observer.views, observer.pixels, card.elements, compared=orders is None),
        f"F of {observer.views} views x {observer.pixels} pixels x {card.elements} elements",
    )
    if isinstance(brdf, Mirror):
        return mirror_matrix(observer, card, brdf, weights=weights)
    nodes = Nodes.of(observer, card, weights)
    if orders is not None:
        return nodes.transport(nodes.checked(orders), brdf)
    orders = nodes.orders(brdf.angular_scale, tolerance)
    coarse = nodes.transport(orders, brdf)
    # The orders are those for Gaussian lobes; half as many again must agree on this BRDF and this geometry.
    while nodes.half_pixel > 0 or nodes.half_strip > 0:
        orders = _more(orders[0], nodes.half_pixel), _more(orders[1], nodes.half_strip)
        if max(orders) > MAX_ORDER:
            raise InputError(
                f"a strip or pixel needs more than {MAX_ORDER} quadrature nodes to reach {tolerance:g}; narrow the "
                "strips, use more pixels or accept a larger tolerance",
                field="card.element_width",
            )
        fine = nodes.transport(orders, brdf)
        largest = max(float(fine.max(initial=0.0)), -float(fine.min(initial=0.0)))
        np.subtract(coarse, fine, out=coarse)
        if np.max(np.abs(coarse, out=coarse), initial=0.0) <= tolerance * largest:
            return fine
        coarse = fine
    return coarse


def _more(order: int, half_width: float) -> int:
    return order + max(2, order // 2) if half_width > 0 else 1


def radiance(transport: ArrayLike, source: ArrayLike) -> Array:
    """Render L_r = F V: (A, N, M) and (M, B) to (A, N, B), or (M,) to (A, N) (eqs. 4.10 to 4.12).

    Raises
    ------
    InputError
        For another number of elements, and where a value of F, V or their product is not finite.
    """
    f, v = np.asarray(transport, dtype=np.float64), np.asarray(source, dtype=np.float64)
    if f.ndim < 2 or v.ndim not in (1, 2) or f.shape[-1] != v.shape[0]:
        raise InputError(f"has shape {v.shape}, F {f.shape}; give a radiance for each element", field="source")
    with np.errstate(over="ignore", invalid="ignore"):
        rendered: Array = f @ v
    if not np.all(np.isfinite(rendered)):
        raise InputError("or F holds a value that is not finite, or F V leaves the range of float64", field="source")
    return rendered


def brdf_matrices(transport: ArrayLike) -> tuple[Array, ...]:
    """The A matrices B_a of section 4.1.2, each (N, M), of F (A, N, M), finite; B is `np.hstack` of them."""
    matrices = np.asarray(transport, dtype=np.float64)
    if matrices.ndim != 3 or not np.all(np.isfinite(matrices)):
        raise InputError(f"has shape {matrices.shape}; give a finite F, (A, N, M)", field="transport")
    return tuple(matrices)
