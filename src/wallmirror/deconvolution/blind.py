"""What the blind methods share: their result."""

from __future__ import annotations

from dataclasses import dataclass, field

from wallmirror.deconvolution.checking import Array


@dataclass(frozen=True, kw_only=True)
class BlindEstimate:
    """Signal and kernel from their convolution alone; their common scale, shift and order are a matter of convention.

    Parameters
    ----------
    signal, kernel:
        f and h.
    iterations:
        How many were made.
    residual:
        |g - f * h| / |g| after each iteration, shape (iterations,). A small residual does not make the pair the true one:
        so does (g, delta).
    """

    signal: Array = field(repr=False)
    kernel: Array = field(repr=False)
    iterations: int
    residual: Array = field(repr=False)
