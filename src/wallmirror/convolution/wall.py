"""Rendering as one convolution along the wall (section 3.1.2, eq. 3.7): L_r = Q (rho_wall * L_mirror).

L_mirror is what a mirror in place of the wall would show and rho_wall the BRDF projected onto the wall: at the offset s
from a mirror image, rho_wall(s) = rho(-atan(s / y)). The thesis takes y = y_o, which is right for a card infinitely
far away; near a mirror image the angle sum really turns as if y were y_o y_s / (y_o + y_s) ("both"). Neither
converges at fixed angles: the lobe at angle u of an element mirrored at angle a lands at y_o tan(a + u), and the
convolution puts it at y_o (tan a + tan u). `wallmirror.convolution.angle` has the variable in which angles add.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import scipy.signal
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import power_of_two, rescaled
from wallmirror.brdf import AngleSumBRDF, Mirror
from wallmirror.convolution.angle import cosine_factor, mirror_points
from wallmirror.convolution.half_circle import require_angle_sum
from wallmirror.convolution.spherical import PointWeights, checked_source, source_in_unit
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, wall_points
from wallmirror.transport import mirror_matrix, radiance

Array = NDArray[np.float64]

#: The distance through which the BRDF is projected: the observer's, or the one that the two distances make together.
ProjectedFrom = Literal["observer", "both"]


def wall_convolution(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    source: ArrayLike,
    *,
    projected_from: ProjectedFrom = "observer",
    weights: PointWeights = "thesis",
) -> Array:
    """Render by eq. 3.7 without any sampling: a copy of rho_wall about each element's exact mirror image.

    A mirror's render is a sum of deltas, so its convolution is a sum of shifted copies; no pixel has to catch a delta,
    and mirror images outside the view count as well.

    Parameters
    ----------
    source:
        Radiance of the M elements, (M,) or (M, B).
    projected_from:
        "observer" (the thesis) or "both".
    weights:
        "thesis", or "cosine" for Q = cos theta_c.

    Returns
    -------
    Array
        Radiance, (A, N) or (A, N, B).

    Examples
    --------
    >>> from wallmirror.brdf import GaussianTrain
    >>> observer = Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=1000, pixels_at="edges")
    >>> card, lobe = Card(elements_x=(5.0,), y=-50), GaussianTrain(centres=(np.radians(-30),), sigma=np.radians(1))
    >>> x = wall_points(observer)[0]
    >>> round(float(x[wall_convolution(observer, card, lobe, [1.0]).argmax()]), 2)  # Algorithm 1 has it at 3.14
    3.34
    """
    source, unit = source_in_unit(card, source)
    offsets = wall_points(observer)[..., None] - mirror_points(observer, card, card.elements_x)
    copies = projected_brdf(observer, card, brdf, offsets, projected_from=projected_from)
    factor = cosine_factor(observer, card, weights=weights)
    return rescaled((factor[..., None] * copies) @ source, unit, field="source")


def projected_brdf(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    offsets: ArrayLike,
    *,
    projected_from: ProjectedFrom = "observer",
) -> Array:
    """rho_wall at offsets from a mirror image along the wall, same shape: in metres to 1/sr; no holes."""
    require_angle_sum(brdf)
    if projected_from not in get_args(ProjectedFrom):
        raise InputError(
            f'is "{projected_from}"; choose one of {", ".join(get_args(ProjectedFrom))}', field="projected_from"
        )
    y = observer.distance
    if projected_from == "both":
        y = 1 / (1 / y + 1 / card.distance)
    offsets = np.asarray(offsets, dtype=np.float64)
    if not np.all(np.isfinite(offsets)):
        raise InputError("hold a value that is not finite", field="offsets")
    with np.errstate(over="ignore"):  # beyond float64 the angle is 90 deg
        return brdf.of_sum(-np.arctan(offsets / y))


def mirror_render(observer: Observer, card: Card, source: ArrayLike) -> Array:
    """L_mirror as Algorithm 1 samples it, (A, N) or (A, N, B): each element in the one pixel that shows it, exactly."""
    return radiance(mirror_matrix(observer, card, Mirror(), weights="thesis"), checked_source(card, source))


def wall_kernel(
    observer: Observer, card: Card, brdf: AngleSumBRDF, *, projected_from: ProjectedFrom = "observer"
) -> Array:
    """rho_wall at all offsets between two pixels of a view parallel to the wall, (2N - 1,), offset 0 in the middle.

    With it `convolve_centred(mirror_render(...), wall_kernel(...))` is eq. 3.7 as a convolution of arrays, up to the
    half pixel by which a mirror image misses its pixel.
    """
    x = parallel_view(observer)
    offsets = np.concatenate([x[0] - x[:0:-1], x - x[0]])
    return projected_brdf(observer, card, brdf, offsets, projected_from=projected_from)


def convolve_centred(signal: ArrayLike, kernel: ArrayLike) -> Array:
    """Convolution that keeps the signal's samples: out[n] = sum_m signal[m] kernel[c + n - m], c the kernel's middle.

    By FFT where that is faster. The kernel may be longer than the signal, where "same" convolutions of common
    libraries answer with the kernel's length.

    Parameters
    ----------
    signal:
        (N,) or (N, B), one column at a time.
    kernel:
        (K,), K odd, so that its middle is a sample.

    Raises
    ------
    InputError
        For an even or empty kernel, an empty signal, values that are not finite, or a product outside float64's range.

    Examples
    --------
    >>> convolve_centred([0, 1, 0], [1, 2, 3, 4, 5, 6, 7]).round(9).tolist()
    [3.0, 4.0, 5.0]
    """
    signal = np.asarray(signal, dtype=np.float64)
    kernel = np.asarray(kernel, dtype=np.float64)
    if signal.ndim not in (1, 2) or signal.shape[0] == 0:
        raise InputError(f"has shape {signal.shape}; give at least one sample, (N,) or (N, B)", field="signal")
    if kernel.ndim != 1 or kernel.size % 2 == 0:
        raise InputError(
            f"has shape {kernel.shape}; give an odd number of samples, so that the middle is one", field="kernel"
        )
    for name, array in (("signal", signal), ("kernel", kernel)):
        if not np.all(np.isfinite(array)):
            raise InputError("holds a value that is not finite", field=name)
    units = power_of_two(signal), power_of_two(kernel)
    signal, kernel = signal / units[0], kernel / units[1]
    columns = signal.reshape(signal.shape[0], -1)
    shaped = kernel[:, None]
    method = scipy.signal.choose_conv_method(columns[:, :1], shaped, mode="full")
    half, n = kernel.size // 2, signal.shape[0]
    full = [scipy.signal.convolve(column, kernel, mode="full", method=method) for column in columns.T]
    return rescaled(np.stack(full, axis=-1)[half : half + n].reshape(signal.shape), *units, field="signal")


def parallel_view(observer: Observer) -> Array:
    """x of the pixels of the one view whose camera plane is parallel to the wall, (N,), uniform (Hypothesis 6)."""
    if observer.views != 1 or observer.view_angles[0] != 0:
        raise InputError(
            "a convolution along the wall needs one view straight at it (Hypothesis 6); in a turned camera the pixels are "
            "not uniform along the wall",
            field="observer.view_angles_deg",
        )
    x: Array = wall_points(observer)[0]
    return x
