"""Angles of the wall, and the order of a quadrature."""

from __future__ import annotations

from collections.abc import Iterator

import mpmath
import numpy as np

from wallmirror.geometry import incident_angles
from wallmirror.quadrature import quadrature_order

from .harness import DIGITS, EPS, Case


def cases() -> Iterator[Case]:
    """Single formulas; the tolerance is a few eps, as they have no cancellation left."""
    for distance in (1e-100, 1e-6, 1.0, 1e8, 1e100):

        def angle(z: float = distance) -> tuple[float, float]:
            x = np.array([0.0, 1e-300, 1e-6, 1.0, 1e8, 1e300])
            found = incident_angles(x, z, 0.0)
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.atan2(mpmath.mpf(float(v)), mpmath.mpf(z))) for v in x]
            return float(np.max(np.abs(found - exact))), 2 * EPS

        yield Case("incident_angles", "distance", f"{distance:g} m", angle)
    for width in (0.0, 1e-12, 1.0, 60.0, 400.0, 1e6):
        yield Case("quadrature_order", "span in lobe widths", f"{width:g}", lambda w=width: (
            0.0 if 1 <= quadrature_order(w, 1e-9) <= 256 else 1.0, 0.5))  # fmt: skip
