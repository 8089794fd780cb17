"""Rendering as a convolution (section 3.1), each form with what it needs and how far off it is.

- `spherical_convolution` (eq. 3.5): one convolution for each wall point, of which one value is read. Needs
  Hypothesis 8 alone and is Algorithm 1 up to the sampling of the half circle.
- `angle_convolution`: Q (rho * L_mirror) over theta_o + theta_c. Needs Hypothesis 7 as well; its error falls as 1 / y_s.
- `wall_convolution` (eq. 3.7): Q (rho_wall * L_mirror) along the wall. Needs, besides, a card and lobes at angles so
  small that tangents add, and does not converge otherwise.

`convolution_errors` measures them against Algorithm 1, `best_angle_sum` what Hypothesis 8 costs a BRDF, and
`as_published` holds the thesis's own sampling for comparison.
"""

from wallmirror.convolution.angle import (
    angle_convolution,
    convolution_variable,
    cosine_factor,
    mirror_directions,
    mirror_points,
    resample,
)
from wallmirror.convolution.half_circle import HalfCircle
from wallmirror.convolution.hypotheses import AngleSumFit, best_angle_sum, convolution_errors, relative_error
from wallmirror.convolution.spherical import outgoing_light, spherical_convolution
from wallmirror.convolution.wall import (
    convolve_centred,
    mirror_render,
    projected_brdf,
    wall_convolution,
    wall_kernel,
)

__all__ = [
    "AngleSumFit",
    "HalfCircle",
    "angle_convolution",
    "best_angle_sum",
    "convolution_errors",
    "convolution_variable",
    "convolve_centred",
    "cosine_factor",
    "mirror_directions",
    "mirror_points",
    "mirror_render",
    "outgoing_light",
    "projected_brdf",
    "relative_error",
    "resample",
    "spherical_convolution",
    "wall_convolution",
    "wall_kernel",
]
