"""One bounce of light from the card over the wall to the observer: Algorithm 1 and its physical form.

The radiance that view a, pixel j receives is linear in the pattern, L = F V (eq. 4.11), and F is linear in
the BRDF,

    F[a, j, i] = sum_q  G[a, j, i, q] rho(theta_s[a, j, i, q], theta_o[a, j, i, q]).

`Kernel` holds the right-hand side without rho; the solvers turn it into sparse matrices, `transport_matrix`
applies it to a known BRDF. The weight G is

- "thesis":   1, what the thesis's code computes (the cosine absorbed in rho', eq. 4.8);
- "cosine":   cos theta_s, what its Algorithm 1 says (eq. 2.12);
- "physical": the reflection equation (1.14) integrated over strip and pixel, cos theta_s cos theta_l / r^2 dA.
"""

from wallmirror.transport.kernel import Kernel, build_kernel, quadrature_orders
from wallmirror.transport.matrix import brdf_matrices, radiance, transport_matrix
from wallmirror.transport.mirror import mirror_matrix
from wallmirror.transport.nodes import Weights
from wallmirror.transport.strips import strip_factor

__all__ = [
    "Kernel",
    "Weights",
    "brdf_matrices",
    "build_kernel",
    "mirror_matrix",
    "quadrature_orders",
    "radiance",
    "strip_factor",
    "transport_matrix",
]
