"""The picture of Figs. 3.4 to 3.8, 3.10 and 3.11: drawn by formulas, blurred, and what is measured on restored ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from wallmirror.deconvolution import Convolution

Array = NDArray[np.float64]

SIZE = 256
_BLUR = 2.5  # standard deviation of the point spread function, in pixels
_REACH = 12  # of the point spread function to each side
_GREYS = 255  # the picture is stored in 8 bits, which is all the noise that it has


@dataclass(frozen=True)
class Blurred:
    """A picture, its point spread function, and what a camera stores of their convolution: uncropped, and cropped."""

    picture: Array
    psf: Array
    uncropped: Array
    cropped: Array


def blurred_picture(size: int = SIZE) -> Blurred:
    """The test picture blurred and rounded to 8 bits; the cropped one is as large as the picture itself."""
    picture = drawn_picture(size)
    x = np.arange(-_REACH, _REACH + 1)
    line = np.exp(-0.5 * (x / _BLUR) ** 2)
    psf = np.outer(line, line) / line.sum() ** 2
    uncropped = np.round(_GREYS * Convolution(psf, picture.shape).apply(picture)) / _GREYS
    return Blurred(picture, psf, uncropped, uncropped[_REACH:-_REACH, _REACH:-_REACH])


def drawn_picture(size: int = SIZE) -> Array:
    """Grey values in [0, 1], shape (size, size): a shaded disc, a star of spokes, bars, a grid of dots, and a frame."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    picture = 0.35 + 0.25 * x - 0.15 * y
    picture[(x + 0.25 * np.sin(6 * x)) > 2.4 * y] += 0.12

    def at(cx: float, cy: float) -> tuple[Array, Array]:
        return np.hypot(x - cx, y - cy), np.arctan2(y - cy, x - cx)

    radius, _ = at(0.28, 0.3)
    ball = radius < 0.18
    shade = np.sqrt(np.maximum(1 - (radius / 0.18) ** 2, 0))
    picture[ball] = (0.15 + 0.8 * np.maximum(0.6 * shade + 0.4 * (0.3 - x + 0.3 - y) / 0.18, 0))[ball]
    radius, angle = at(0.7, 0.32)
    star = radius < 0.2
    picture[star] = np.where(np.sin(18 * angle) > 0, 0.95, 0.05)[star]
    # Bars of falling width: the finest, one pixel of 256 each, is finer than the blur.
    for row, period in enumerate((16, 8, 4, 2)):
        bars = (x > 0.1) & (x < 0.5) & (y > 0.58 + 0.09 * row) & (y < 0.65 + 0.09 * row)
        picture[bars] = np.where((x * 256 % period) < period / 2, 0.9, 0.1)[bars]
    dots = (x > 0.58) & (x < 0.92) & (y > 0.6) & (y < 0.92)
    picture[dots] = np.where(np.hypot(x * 16 % 1 - 0.5, y * 16 % 1 - 0.5) < 0.25, 1.0, 0.1)[dots]
    edge = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    picture[(edge > 0.02) & (edge < 0.03)] = 0.0
    return np.asarray(np.clip(picture, 0, 1), dtype=np.float64)


def psnr(estimate: Array, truth: Array) -> float:
    """Peak signal-to-noise ratio in dB, for grey values in [0, 1]."""
    return float(-10 * np.log10(np.mean((estimate - truth) ** 2)))


def ssim(estimate: Array, truth: Array) -> float:
    """Structural similarity of grey values in [0, 1] (Wang, Bovik, Sheikh, Simoncelli 2004), Gaussian window of sigma 1.5."""

    def mean(values: Array) -> Array:
        return np.asarray(gaussian_filter(values, 1.5, truncate=3.5))

    c1, c2 = 0.01**2, 0.03**2
    e, t = mean(estimate), mean(truth)
    variance = mean(estimate**2) - e * e + mean(truth**2) - t * t
    covariance = mean(estimate * truth) - e * t
    similar = (2 * e * t + c1) * (2 * covariance + c2) / ((e * e + t * t + c1) * (variance + c2))
    return float(similar[5:-5, 5:-5].mean())  # where the window lies inside the picture


def sharpness(estimate: Array, truth: Array) -> float:
    """Energy of the differences between neighbours over that of the truth, once both have the same contrast."""

    def ratio(values: Array) -> float:
        centred = values - values.mean()
        steps = sum(float(np.sum(np.diff(values, axis=axis) ** 2)) for axis in (0, 1))
        return steps / float(np.sum(centred**2))

    return ratio(estimate) / ratio(truth)


def show(axes: Axes, picture: Array, title: str, *, full_scale: bool = True) -> None:
    """Draw a picture in grey: black 0 and white 1, or stretched to its own range."""
    limits = (0.0, 1.0) if full_scale else (float(picture.min()), float(picture.max()))
    axes.imshow(picture, cmap="gray", vmin=limits[0], vmax=limits[1], interpolation="nearest")
    axes.set_title(title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])


def middle_row(picture: Array) -> Array:
    """Grey values along the row through the ball and the star."""
    return np.asarray(picture[round(0.31 * picture.shape[0])])
