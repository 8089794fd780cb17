"""The conclusion's first open door: blind de-rendering on the spherical convolution of section 3.1.1."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.convolution import relative_error, spherical_convolution
from wallmirror.convolution.spherical import scene_angles
from wallmirror.deconvolution.blind_spherical import solve_spherical
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.solve import solve
from wallmirror.geometry import Card, wall_points
from wallmirror.report.style import CYCLE, FAINT, INK, OURS, WARM, clean, new_figure
from wallmirror.thesis import setting
from wallmirror.thesis.figure import Claim, Outcome, ThesisFigure
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

_ELEMENTS, _REALISATIONS = 4, 8
_SAMPLES = np.array([180, 250, 350, 500, 700, 1000])
_ORDER = 5


def blind_spherical(seed: int) -> ThesisFigure:
    """The same light and BRDF at every wall point up to a turn that the geometry predicts, and both recovered from it."""
    observer, brdf = setting.observer(500), setting.lobes(*setting.LOBES["text"])
    card = Card(elements_x=tuple(np.linspace(-setting.WIDTH / 2, setting.WIDTH / 2, _ELEMENTS)), y=-5.0)
    source = np.random.default_rng(seed).random((_ELEMENTS, _REALISATIONS))
    exact = radiance(transport_matrix(observer, card, brdf, weights="thesis"), source)
    captures = CaptureSet(observer=observer, card=card, radiance=exact, transport="thesis")
    own, solver, render = (np.zeros(_SAMPLES.size) for _ in range(3))
    for k, samples in enumerate(_SAMPLES.tolist()):
        found = solve_spherical(captures, samples=samples, order=_ORDER)
        own[k] = scale_free_error(found.source, source)
        films = spherical_convolution(observer, card, brdf, source, samples=samples, order=_ORDER)
        render[k] = relative_error(films, exact)
        spherical = CaptureSet(observer=observer, card=card, radiance=films, transport="thesis")
        solution = solve(spherical, method="closed_form")
        solver[k] = scale_free_error(solution.source, source)
    truth = brdf.of_sum(found.angles)
    scale = float(np.sum(found.brdf * truth) / np.sum(found.brdf**2))
    reflectance = scale_free_error(found.brdf, truth)
    table = scale_free_error(solution.brdf, brdf.of_sum(solution.angle_sum))

    figure = new_figure(10.5, 4.0)
    maps, errors, rho = figure.subplots(1, 3)
    x = wall_points(observer)[0]
    theta_s, theta_o = (part[0] for part in scene_angles(observer, card))
    for j, colour in zip((60, 250, 440), CYCLE, strict=False):
        maps.vlines(
            np.degrees(theta_s[j]), 0, source[:, 0], color=colour, linewidth=2.2, label=f"wall point x = {x[j]:.1f} m"
        )
        maps.plot([-np.degrees(theta_o[j])], [-0.06], marker="^", color=colour, ms=6, linestyle="none", clip_on=False)
    maps.set_xlabel("direction θs (°); ▲: mirror of θo")
    maps.set_ylabel("radiance of the element")
    maps.set_xlim(-90, 90)
    maps.set_ylim(-0.12, 1.5)
    maps.legend(frameon=False, fontsize=8, loc="upper center")
    maps.set_title("one pattern, turned", fontsize=10, loc="left")
    errors.loglog(_SAMPLES, own, color=OURS, marker="o", ms=4, label="pattern, on the half circle")
    errors.loglog(_SAMPLES, solver, color=WARM, marker="o", ms=4, label="pattern, solve on its renders")
    errors.loglog(_SAMPLES, render, color=FAINT, linestyle=":", label="the render itself")
    errors.set_xticks(_SAMPLES, [str(s) for s in _SAMPLES])
    errors.minorticks_off()
    errors.set_xlabel("directions on the half circle")
    errors.set_ylabel("relative error")
    errors.set_ylim(1e-10, 1e2)
    errors.legend(frameon=False, fontsize=8, loc="upper right")
    errors.set_title("error against the grid", fontsize=10, loc="left")
    rho.plot(np.degrees(found.angles), truth, color=INK, linewidth=2.4, label="true BRDF")
    rho.plot(np.degrees(found.angles), scale * found.brdf, color=WARM, linewidth=1.0, label="recovered")
    rho.set_xlim(-50, 50)
    rho.set_ylim(-0.1, 1.5)
    rho.set_xlabel("angle sum θs + θo (°)")
    rho.set_ylabel("BRDF (peak 1)")
    rho.legend(frameon=False, fontsize=8, loc="upper center", ncols=2)
    rho.set_title(f"{_SAMPLES[-1]:,} directions", fontsize=10, loc="left")
    for axes in (maps, errors, rho):
        clean(axes)
    works: Outcome = "confirmed" if max(own[-1], solver[-1], reflectance, table) < 1e-4 else "refuted"
    nonblind = math.log(own[0] / own[-1]) / math.log(_SAMPLES[-1] / _SAMPLES[0])
    return ThesisFigure(
        id="3.1-blind-spherical",
        title="Blind de-rendering on the spherical convolution",
        about=f"{_ELEMENTS} elements over 10 m at 5 m, where the far field does not hold; {_REALISATIONS} random patterns, "
        "lobes at ±15° and ±30°, one view of 500 wall points. Each wall point sees the same light and BRDF turned by angles "
        "that the geometry gives; Algorithm 1's renders are solved on the half circle's own grid, and the spherical "
        "convolution's renders by `solve`.",
        figure=figure,
        columns={
            "directions": _SAMPLES,
            "error of the pattern, on the half circle": own,
            "error of the pattern, solve on its renders": solver,
            "error of the render": render,
            "angle sum (deg)": np.degrees(found.angles),
            "true BRDF": truth,
            "recovered BRDF": scale * found.brdf,
        },
        numbers={
            "error of the pattern on the half circle, 1,000 directions": float(own[-1]),
            "error of the BRDF on the half circle, 1,000 directions": reflectance,
            "error of the pattern by solve on the spherical convolution's renders": float(solver[-1]),
            "error of the BRDF by solve on the spherical convolution's renders": table,
            "order of convergence of the pattern": nonblind,
            "1 - lambda_1 on the half circle": found.closed.mismatch,
            "1 - lambda_2 on the half circle": found.closed.gap,
        },
        claims=(
            Claim(
                thesis="Light and BRDF are alike for all wall points up to a turn that can be predicted, so that the "
                "convolution on the sphere could be inverted as well.",
                outcome=works,
                measured=f"Pattern to {own[-1]:.0e} and BRDF to {reflectance:.0e} on the half circle; {solver[-1]:.0e} and "
                f"{table:.0e} by `solve` on renders of the spherical convolution.",
            ),
            Claim(
                thesis="One value of each spherical convolution is too small a fraction to solve for both (section 3.1.2).",
                outcome="corrected" if works == "confirmed" else "undecided",
                measured=f"With {_REALISATIONS} patterns 500 such values each determine {_ELEMENTS} elements and the "
                f"BRDF (1 - lambda_2 = {found.closed.gap:.2f}): their turns differ, so the fractions complete each other.",
            ),
        ),
    )


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"3.1-blind-spherical": blind_spherical}
