"""Section 3.2.4, the first reason: the identity of interferometry on the wall."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wallmirror.convolution import convolution_variable, mirror_directions, mirror_render, projected_brdf, resample
from wallmirror.deconvolution.channels import convolve_channels
from wallmirror.deconvolution.interferometry import identity_error
from wallmirror.geometry import Card, wall_points
from wallmirror.report.style import INK, OURS, WARM, clean, new_figure
from wallmirror.thesis import setting
from wallmirror.thesis.figure import Claim, ThesisFigure
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

_CARD_DEG = (-4.0, -2.0, 0.0, 2.0, 4.0)  # of the elements seen from the wall


def identity(seed: int) -> ThesisFigure:
    """g_ij = f_a * h_ij: exact for convolutions, and what becomes of it with the quantities of eq. 3.7."""
    rng = np.random.default_rng(seed)
    distances = np.geomspace(5, 1e5, 14)
    patterns = rng.random((len(_CARD_DEG), 4))
    tangents = np.tan(np.radians(_CARD_DEG))
    cards = [Card(elements_x=tuple(float(d) * tangents), y=-float(d)) for d in distances]
    exact, wall = np.array([_along_the_wall(card, patterns) for card in cards]).T
    angle = np.array([_over_the_angle(card, patterns) for card in cards])
    thesis_exact, thesis_wall = _along_the_wall(setting.card(50.0), rng.random((2, 4)))
    figure = new_figure(10.5, 4.0)
    axes = figure.subplots()
    axes.loglog(distances, wall, color=WARM, label="renders and the quantities of eq. 3.7, along the wall")
    axes.loglog(distances, angle, color=OURS, label="renders over θo + θc, with the BRDF and deltas there")
    axes.loglog(distances, exact, color=INK, linestyle=":", label="convolution of the quantities of eq. 3.7")
    axes.set_xlabel("distance of the card (m)")
    axes.set_ylabel("|g_ij − f_a * h_ij| / |g_ij|")
    axes.set_ylim(1e-17, 5)
    figure.legend(*axes.get_legend_handles_labels(), frameon=False, fontsize=9, loc="outside upper left", ncols=3)
    clean(axes)
    slope = float(np.polyfit(np.log(distances[-6:]), np.log(angle[-6:]), 1)[0])
    holds = float(exact.max()) < 1e-12
    return ThesisFigure(
        id="3.2-fbd-identity",
        title="The interferometric identity on the wall",
        about="Cross-correlations of the renders of four random patterns against what the auto-correlation of the BRDF and the "
        "cross-correlations of the mirror's renders predict, at the best scale. Five elements 2° apart as seen from the "
        "wall, lobes at ±15° and ±30°, 501 pixels.",
        figure=figure,
        columns={
            "distance (m)": distances,
            "convolution": exact,
            "renders along the wall (eq. 3.7)": wall,
            "renders over the angle sum": angle,
        },
        numbers={
            "largest error for a convolution": float(exact.max()),
            "error at the thesis's 50 m, two elements 10 m apart, eq. 3.7": thesis_wall,
            "smallest error along the wall": float(wall.min()),
            "error over the angle sum at 50 m": float(
                np.exp(np.interp(math.log(50), np.log(distances), np.log(angle)))
            ),
            "slope of the error over the angle sum": slope,
        },
        claims=(
            Claim(
                thesis="The identity g_ij = f_a * h_ij could be verified for a theoretical 1-D convolution.",
                outcome="confirmed" if holds and thesis_exact < 1e-12 else "refuted",
                measured=f"It holds to {max(float(exact.max()), thesis_exact):.0e}, rounding.",
            ),
            Claim(
                thesis="With the quantities of eq. 3.7 it does not give good results.",
                outcome="confirmed" if thesis_wall > 0.1 and wall.min() > 0.1 else "refuted",
                measured=f"Off by {thesis_wall:.2f} at the thesis's 50 m and by {wall.min():.2f} at best, at any distance. "
                f"Over the angle sum it converges: {angle[-1]:.0e} at 1e5 m, slope {slope:.2f}.",
            ),
        ),
    )


def _along_the_wall(card: Card, patterns: Array) -> tuple[float, float]:
    """The identity's error for rho_wall * L_mirror itself, and for Algorithm 1's renders in its place."""
    observer, brdf = setting.observer(501), setting.lobes(*setting.LOBES["text"])
    f = projected_brdf(observer, card, brdf, wall_points(observer)[0])
    h = mirror_render(observer, card, patterns)[0].T
    full = convolve_channels(f, h)
    render = radiance(transport_matrix(observer, card, brdf, weights="thesis"), patterns)[0].T
    edge = (full.shape[1] - render.shape[1]) // 2
    padded = np.pad(render, ((0, 0), (edge, edge)))
    return identity_error(full, f, h), identity_error(padded, f, h, free_scale=True)


def _over_the_angle(card: Card, patterns: Array) -> float:
    """The same for renders put onto a uniform grid of theta_o + theta_c, on which the elements fall."""
    observer, brdf = setting.observer(2001), setting.lobes(*setting.LOBES["text"])
    variable = convolution_variable(observer, card)[0]
    mirrored = np.sort(mirror_directions(observer, card))
    between = 16
    step = float(mirrored[-1] - mirrored[0]) / (mirrored.size - 1) / between
    half = math.floor(float(min(variable.max(), -variable.min())) / step)
    angles = step * np.arange(-half, half + 1)
    films = radiance(transport_matrix(observer, card, brdf, weights="thesis"), patterns)[0]
    render = resample(films, variable, angles, order=5).T
    h = np.zeros((patterns.shape[1], (mirrored.size - 1) * between + 1))
    h[:, ::between] = patterns[np.argsort(mirror_directions(observer, card))].T
    edge = (h.shape[1] - 1) // 2
    return identity_error(np.pad(render, ((0, 0), (edge, edge))), brdf.of_sum(angles), h, free_scale=True)


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"3.2-fbd-identity": identity}
