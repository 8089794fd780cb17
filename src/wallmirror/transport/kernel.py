"""The transport before the BRDF is known, which the solvers take apart and `validate` applies to several BRDFs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from wallmirror.brdf import BRDF, AngleSumBRDF
from wallmirror.geometry import Array, Card, Observer
from wallmirror.memory import kernel_bytes, require_memory
from wallmirror.transport.nodes import Nodes, Weights


@dataclass(frozen=True)
class Kernel:
    """The transport from M elements to A x N pixels before the BRDF is known.

    Parameters
    ----------
    theta_s, theta_o:
        Angles at the Q quadrature nodes in radians, broadcastable to (A, N, M, Q).
    weight:
        G at the nodes, shape (A, N, M, Q); in steradians for "physical".
    """

    theta_s: Array
    theta_o: Array
    weight: Array

    @property
    def angle_sum(self) -> Array:
        """u = theta_s + theta_o, shape (A, N, M, Q), in radians."""
        return np.broadcast_to(self.theta_s + self.theta_o, self.weight.shape)

    def apply(self, brdf: BRDF) -> Array:
        """F for a BRDF with finite values, shape (A, N, M)."""
        rho = brdf.of_sum(self.angle_sum) if isinstance(brdf, AngleSumBRDF) else brdf(self.theta_s, self.theta_o)
        transport: Array = np.sum(self.weight * rho, axis=-1)
        return transport


def build_kernel(
    observer: Observer,
    card: Card,
    *,
    weights: Weights = "physical",
    resolution: float = math.pi / 4,
    tolerance: float = 1e-6,
    orders: tuple[int, int] | None = None,
) -> Kernel:
    """The kernel of one bounce, with quadrature orders that resolve a BRDF of the given angular scale.

    Parameters
    ----------
    weights:
        "thesis", "cosine" or "physical"; the first two take elements and pixels as points.
    resolution:
        Smallest angular scale of the BRDF (standard deviation of its narrowest lobe) in radians.
    tolerance:
        Largest error wanted, relative to a lobe's peak.
    orders:
        Gauss-Legendre nodes across a pixel and across a strip, where they are known; they follow from `resolution` and
        `tolerance` if left out. One node is the middle: a pixel or strip taken as a line.

    Raises
    ------
    InputError
        If the strips or pixels are so wide against `resolution` that more than 256 nodes would be needed, or the kernel
        is larger than the memory.
    """
    nodes = Nodes.of(observer, card, weights)
    orders = nodes.orders(resolution, tolerance) if orders is None else nodes.checked(orders)
    require_memory(
        kernel_bytes(observer.views, observer.pixels, card.elements, orders[0] * orders[1]),
        f"the kernel of {observer.views} views x {observer.pixels} pixels x {card.elements} elements x "
        f"{orders[0] * orders[1]} nodes",
    )
    return Kernel(*nodes.all_at_once(orders))


def quadrature_orders(
    observer: Observer,
    card: Card,
    *,
    weights: Weights = "physical",
    resolution: float = math.pi / 4,
    tolerance: float = 1e-6,
) -> tuple[int, int]:
    """Nodes across a pixel and across a strip that `build_kernel` takes, with its parameters."""
    return Nodes.of(observer, card, weights).orders(resolution, tolerance)
