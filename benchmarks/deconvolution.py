"""Deconvolution of pictures beside scikit-image, on the same data in one process.

    python benchmarks/deconvolution.py [--size 1024] [--rounds 3] [--cpu]

Prints a table of seconds, their ratio and the largest difference of the results. Rounds alternate between the two, and the
least time of each counts. The picture has a dark margin as wide as the kernel, where both do the same thing.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import numpy as np
import skimage
from skimage.restoration import richardson_lucy as skimage_richardson_lucy
from skimage.restoration import wiener

from wallmirror.deconvolution import Convolution, richardson_lucy, tikhonov_fft

Array = np.ndarray


def picture(size: int, kernel: Array, *, seed: int = 0) -> Array:
    """A blurred random pattern of blocks with light noise, >= 0, dark at the border."""
    rng = np.random.default_rng(seed)
    margin = 2 * kernel.shape[0]
    blocks = np.kron(rng.random((size // 16 + 1, size // 16 + 1)), np.ones((16, 16)))[:size, :size]
    inside = np.zeros((size, size))
    inside[margin:-margin, margin:-margin] = blocks[margin:-margin, margin:-margin]
    blurred = Convolution(kernel, inside.shape, mode="periodic").apply(inside)
    lit = blurred > 1e-6
    return np.where(lit, np.maximum(blurred + 1e-3 * rng.standard_normal(blurred.shape), 0), 0)


def gaussian(width: int, sigma: float) -> Array:
    x = np.arange(width) - width // 2
    line = np.exp(-0.5 * (x / sigma) ** 2)
    kernel = np.outer(line, line)
    return kernel / kernel.sum()


def side_by_side(
    ours: Callable[[], Array], theirs: Callable[[], Array], rounds: int, clock: Callable[[], float]
) -> tuple[float, float, float]:
    """Least seconds of both, and the largest difference of what they return."""
    times: tuple[list[float], list[float]] = ([], [])
    results: list[Array] = []
    for round_ in range(rounds + 1):  # the first warms up
        results = []
        for run, kept in zip((ours, theirs), times, strict=True):
            started = clock()
            results.append(run())
            if round_:
                kept.append(clock() - started)
    return min(times[0]), min(times[1]), float(np.abs(results[0] - results[1]).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--cpu", action="store_true", help="count processor seconds, for a machine that others use too")
    chosen = parser.parse_args()
    size, iterations = chosen.size, chosen.iterations
    clock = time.process_time if chosen.cpu else time.perf_counter
    kernel = gaussian(31, 4.0)
    data = picture(size, kernel)
    alpha = 1e-3
    # Their filter looks for the kernel's middle where ours does; with a delta for `reg` the penalty is |f|^2 as in eq. 3.12.
    delta = np.ones((1, 1))
    full = Convolution(kernel, (size - 30, size - 30)).apply(data[15 : size - 15, 15 : size - 15])
    same = Convolution(kernel, data.shape, mode="same")
    start = np.full(data.shape, 0.5)
    rows = [
        (
            f"Tikhonov, periodic, {size} x {size}",
            lambda: tikhonov_fft(data, kernel, alpha, mode="periodic"),
            lambda: wiener(data, kernel, alpha, reg=delta, clip=False),
        ),
        (
            f"Tikhonov, uncropped, {size} x {size}",
            lambda: tikhonov_fft(full, kernel, alpha),
            lambda: np.roll(wiener(full, kernel, alpha, reg=delta, clip=False), (-15, -15), (0, 1))[:-30, :-30],
        ),
        (
            f"Richardson-Lucy, {iterations} iterations, {size} x {size}",
            lambda: richardson_lucy(same, data, iterations=iterations, start=start, background=1e-12).signal,
            lambda: skimage_richardson_lucy(data, kernel, iterations, clip=False),
        ),
    ]
    print(
        f"scikit-image {skimage.__version__}, {os.cpu_count()} processors, kernel {kernel.shape[0]} x {kernel.shape[1]}"
    )
    print("| what | seconds | scikit-image | ratio | largest difference |\n|---|---|---|---|---|")
    for name, ours, theirs in rows:
        own, other, difference = side_by_side(ours, theirs, chosen.rounds, clock)
        print(f"| {name} | {own:.3f} | {other:.3f} | {own / other:.2f} | {difference:.1e} |")


if __name__ == "__main__":
    main()
