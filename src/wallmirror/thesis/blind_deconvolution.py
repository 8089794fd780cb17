"""Section 3.2.3: iterative blind deconvolution of the picture (Figs. 3.10, 3.11) and of the wall (Figs. 3.12 to 3.14)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wallmirror.convolution.wall import wall_kernel
from wallmirror.deconvolution import (
    BlindEstimate,
    Convolution,
    align,
    blind_richardson_lucy,
    corner_support,
    iterative_blind,
    tikhonov_fft,
)
from wallmirror.report.style import FAINT, INK, OURS, PALE, WARM, clean, new_figure
from wallmirror.thesis import setting
from wallmirror.thesis.figure import Claim, Outcome, ThesisFigure
from wallmirror.thesis.picture_restoration import blurred_picture, middle_row, show
from wallmirror.thesis.wall_deconvolution import PIXELS, Wall, far_wall

Array = NDArray[np.float64]

_ALPHA, _ITERATIONS = 10.0, 100  # of Figs. 3.10 and 3.11
_CLOSE = 0.5  # relative error, after the best shift and scale, beyond which an estimate is not even close
_SLIGHTLY = 1.5  # ratio of errors up to which one estimate is slightly worse than another


def picture(seed: int) -> ThesisFigure:
    """Fig. 3.10: the picture from IBD, beside Tikhonov's that knows the point spread function."""
    b = blurred_picture()
    estimate = _blind_picture()
    signal = estimate.signal[: b.picture.shape[0], : b.picture.shape[1]]
    aligned = align(signal, b.picture)
    known = tikhonov_fft(b.uncropped, b.psf, 1e-4)
    tikhonov = align(known, b.picture).error
    figure = new_figure(8.6, 4.6)
    left, right = figure.subplots(1, 2)
    show(left, aligned.scale * signal, f"IBD, alpha = {_ALPHA:g}, {_ITERATIONS} iterations")
    show(right, known, "Tikhonov, kernel known")
    return ThesisFigure(
        id="3.10",
        title="The picture by iterative blind deconvolution",
        about=f"The picture of Fig. 3.5, alpha = {_ALPHA:g}, {_ITERATIONS} iterations, supports known exactly, started from "
        "the blurred picture and a delta in the middle of the kernel's support as the thesis says. Brought to the "
        "original's scale, not shifted.",
        figure=figure,
        columns={
            "pixel": np.arange(b.picture.shape[1]),
            "original along the row": middle_row(b.picture),
            "IBD along the row": aligned.scale * middle_row(signal),
            "residual after each iteration": estimate.residual,
        },
        numbers={
            "relative error after the best shift and scale": aligned.error,
            "Tikhonov's, kernel known": tikhonov,
            "shift down (pixels)": -float(aligned.shift[0]),
            "shift right (pixels)": -float(aligned.shift[1]),
            "residual at the end": float(estimate.residual[-1]),
            "least residual on the way": float(estimate.residual.min()),
        },
        claims=(
            Claim(
                thesis="The results are slightly worse than Tikhonov's, with more artefacts.",
                outcome=_slightly_worse(aligned.error, tikhonov),
                measured=f"After the best shift and scale the relative error is {aligned.error:.2f}, "
                f"{aligned.error / tikhonov:.1f} times Tikhonov's {tikhonov:.2f}.",
            ),
        ),
    )


def point_spread(seed: int) -> ThesisFigure:
    """Fig. 3.11: the point spread function from IBD."""
    b = blurred_picture()
    kernel = _blind_picture().kernel[: b.psf.shape[0], : b.psf.shape[1]]
    aligned = align(kernel, b.psf)
    down, right = -aligned.shift[0], -aligned.shift[1]
    figure = new_figure(7.2, 3.8)
    panels = figure.subplots(1, 2)
    show(panels[0], b.psf, "true point spread function", full_scale=False)
    show(panels[1], kernel, "IBD's estimate", full_scale=False)
    middle = b.psf.shape[0] // 2
    return ThesisFigure(
        id="3.11",
        title="The point spread function by iterative blind deconvolution",
        about="From the run of Fig. 3.10. Each is drawn from black to its own largest value.",
        figure=figure,
        columns={
            "pixel": np.arange(b.psf.shape[0]) - middle,
            "true, sum over rows": b.psf.sum(axis=0),
            "IBD, sum over rows": kernel.sum(axis=0),
        },
        numbers={
            "relative error after the best shift and scale": aligned.error,
            "shift down (pixels)": float(down),
            "shift right (pixels)": float(right),
        },
        claims=(
            Claim(
                thesis="The estimated point spread function is slightly shifted to the left.",
                outcome=_left(right, b.psf.shape[1]),
                measured=f"It is shifted by {abs(right)} pixels to the {'left' if right < 0 else 'right'} and {abs(down)} "
                f"{'up' if down < 0 else 'down'}, of 25, and the picture the other way: a shift that the data cannot tell, "
                f"and the start decides. What is left after the best shift is an error of {aligned.error:.2f}.",
            ),
        ),
    )


@dataclass(frozen=True)
class BlindWall:
    """The wall of Fig. 3.9 as the blind methods get it: kernel (N,), and their convolution cropped to the wall (N,)."""

    wall: Wall
    kernel: Array
    data: Array


def blind_wall() -> BlindWall:
    """Four lobes, source at 50 m; the kernel's middle is its sample N // 2."""
    observer, card = setting.observer(PIXELS), setting.card(50.0)
    brdf = setting.lobes(*setting.LOBES["text"])
    wall = far_wall(brdf)
    middle = PIXELS - 1
    kernel = wall_kernel(observer, card, brdf)[middle - PIXELS // 2 : middle + PIXELS - PIXELS // 2]
    data = np.maximum(Convolution(kernel, (PIXELS,), mode="same").apply(wall.mirror), 0.0)
    return BlindWall(wall, kernel, data)


def wanted(seed: int) -> ThesisFigure:
    """Fig. 3.12: what blind de-rendering is to find."""
    w = blind_wall()
    figure = new_figure(10.5, 2.8)
    panels = figure.subplots(1, 3)
    for axes, (name, values) in zip(
        panels, {"mirror's render": w.wall.mirror, "projected BRDF": w.kernel, "their convolution": w.data}.items(),
        strict=True,
    ):  # fmt: skip
        axes.plot(w.wall.x, values, color=INK, linewidth=1.1)
        axes.set_title(name, fontsize=10, loc="left")
        axes.set_xlabel("x (m)")
        clean(axes)
    return ThesisFigure(
        id="3.12",
        title="What blind de-rendering is to find",
        about="The setting of Fig. 3.9: the two factors, and the convolution from which both are wanted.",
        figure=figure,
        columns={
            "x (m)": w.wall.x,
            "mirror's render": w.wall.mirror,
            "projected BRDF": w.kernel,
            "convolution": w.data,
        },
        numbers={
            "right mirror point (m)": float(w.wall.x[int(np.argmax(w.wall.mirror))]),
            "samples of each": float(PIXELS),
        },
    )


def by_filters(seed: int) -> ThesisFigure:
    """Fig. 3.13: IBD, 5 iterations, alpha = 0.001."""
    w = blind_wall()
    everywhere = np.ones(PIXELS, dtype=np.bool_)
    runs = {
        name: iterative_blind(data, signal_support=everywhere, kernel_support=everywhere, alpha=1e-3, iterations=5)
        for name, data in {"the convolution": w.data, "the real render": w.wall.render}.items()
    }
    figure, columns = _pairs(w, runs)
    errors = {name: _errors(run, w) for name, run in runs.items()}
    least = min(min(e.values()) for e in errors.values())
    return ThesisFigure(
        id="3.13",
        title="Blind de-rendering by IBD (5 iterations, alpha = 0.001)",
        about="From the convolution of Fig. 3.12 (top) and from the real render (bottom), each estimate scaled to its truth's "
        "peak, in grey. No support is known, as in the thesis.",
        figure=figure,
        columns=columns,
        numbers={f"{what}, from {name}": e for name, es in errors.items() for what, e in es.items()},
        claims=(
            Claim(
                thesis="IBD does not get even close to visually acceptable results.",
                outcome="confirmed" if least > _CLOSE else "refuted",
                measured=f"After the best shift, scale and exchange of the two, no error is below {least:.2f}, where 1 is "
                "what a zero would have.",
            ),
        ),
    )


def by_richardson_lucy(seed: int) -> ThesisFigure:
    """Fig. 3.14: alternating Richardson-Lucy, 100 iterations."""
    w = blind_wall()
    runs = {
        name: blind_richardson_lucy(
            data, signal_start=data + 1e-9 * data.max(), kernel_start=np.ones(PIXELS), mode="same", iterations=100
        )
        for name, data in {"the convolution": w.data, "the real render": w.wall.render}.items()
    }
    figure, columns = _pairs(w, runs)
    errors = {name: _errors(run, w) for name, run in runs.items()}
    own = errors["the convolution"]
    swapped = own["signal against the BRDF"] + own["kernel against the mirror"] < (
        own["signal against the mirror"] + own["kernel against the BRDF"]
    )
    kernel = runs["the convolution"].kernel
    at = setting.peaks(w.wall.x, kernel, least=0.02)
    heights = np.interp(at, w.wall.x, kernel)
    order = np.argsort(heights)[::-1]
    ratio = float(heights[order[1]] / heights[order[0]])
    third = float(heights[order[2]] / heights[order[1]]) if order.size > 2 else 0.0
    apart = float(abs(at[order[0]] - at[order[1]]))
    return ThesisFigure(
        id="3.14",
        title="Blind de-rendering by alternating Richardson-Lucy (100 iterations)",
        about="As Fig. 3.13; the signal starts from the data, the kernel from a constant.",
        figure=figure,
        columns=columns,
        numbers={f"{what}, from {name}": e for name, es in errors.items() for what, e in es.items()}
        | {
            "second over first peak of the kernel": ratio,
            "third over second": third,
            "they are apart by (m)": apart,
            "residual": float(runs["the convolution"].residual[-1]),
        },
        claims=(
            Claim(
                thesis="IRL estimates the relative intensity correctly, but the peaks are shifted and appear as the BRDF.",
                outcome=_exchanged(swapped, abs(ratio - 0.5) <= 0.1 and third <= 0.5),
                measured=f"The two are {'' if swapped else 'not '}exchanged: the signal resembles the BRDF (error "
                f"{own['signal against the BRDF']:.2f}) {'more' if swapped else 'less'} than the mirror "
                f"({own['signal against the mirror']:.2f}). The kernel's two highest peaks stand in the ratio {ratio:.2f} "
                f"(truth 0.5), {apart:.2f} m apart (truth 0.91), and a third has {third:.2f} of the second. The fit is good "
                f"(residual {runs['the convolution'].residual[-1]:.3f}), the answer is not.",
            ),
        ),
    )


def _blind_picture() -> BlindEstimate:
    b = blurred_picture()
    shape = b.uncropped.shape
    return iterative_blind(
        b.uncropped,
        signal_support=corner_support(shape, b.picture.shape),
        kernel_support=corner_support(shape, b.psf.shape),
        alpha=_ALPHA,
        iterations=_ITERATIONS,
    )


def _errors(run: BlindEstimate, w: BlindWall) -> dict[str, float]:
    """Relative errors after the best shift and scale, of each estimate against each truth."""
    return {
        "signal against the mirror": align(run.signal, w.wall.mirror).error,
        "kernel against the BRDF": align(run.kernel, w.kernel).error,
        "signal against the BRDF": align(run.signal, w.kernel).error,
        "kernel against the mirror": align(run.kernel, w.wall.mirror).error,
    }


def _pairs(w: BlindWall, runs: dict[str, BlindEstimate]) -> tuple[Figure, dict[str, Array]]:
    """One row for each input: signal and kernel over their truths, all scaled to a peak of 1."""
    figure = new_figure(10.5, 4.8)
    grid = figure.subplots(len(runs), 2, sharex=True)
    columns: dict[str, Array] = {"x (m)": w.wall.x}
    for panels, (name, run) in zip(grid, runs.items(), strict=True):
        for axes, what, truth, estimate in zip(
            panels,
            ("mirror's render", "projected BRDF"),
            (w.wall.mirror, w.kernel),
            (run.signal, run.kernel),
            strict=True,
        ):
            axes.plot(w.wall.x, truth / truth.max(), color=PALE if what != "mirror's render" else FAINT, linewidth=2.5)
            colour = OURS if what == "mirror's render" else WARM
            axes.plot(w.wall.x, estimate / estimate.max(), color=colour, linewidth=1.0)
            axes.set_title(f"{what}, from {name}", fontsize=9, loc="left")
            axes.set_xlim(-5, 5)
            clean(axes)
            columns[f"{what}, from {name}"] = estimate
    for axes in grid[-1]:
        axes.set_xlabel("x (m)")
    return figure, columns


def _slightly_worse(error: float, reference: float) -> Outcome:
    if error <= reference:
        return "refuted"
    return "confirmed" if error <= _SLIGHTLY * reference else "corrected"


def _left(right: int, width: int) -> Outcome:
    """Confirmed for a shift to the left of at most a tenth of the width, corrected for a larger one."""
    if right >= 0:
        return "refuted"
    return "confirmed" if -right <= width / 10 else "corrected"


def _exchanged(swapped: bool, intensity: bool) -> Outcome:
    if swapped and intensity:
        return "confirmed"
    return "corrected" if swapped or intensity else "refuted"


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {
    "3.10": picture,
    "3.11": point_spread,
    "3.12": wanted,
    "3.13": by_filters,
    "3.14": by_richardson_lucy,
}
