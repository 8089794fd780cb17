"""Section 3.1: what Hypotheses 7 (far field) and 8 (BRDF of the angle sum) cost, over distance, width and angle."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF, CookTorrance, Schlick
from wallmirror.convolution import angle_convolution, best_angle_sum, convolution_errors, relative_error
from wallmirror.convolution.spherical import scene_angles
from wallmirror.geometry import Card
from wallmirror.report.style import CYCLE, FAINT, INK, OURS, PALE, WARM, clean, new_figure
from wallmirror.thesis import setting
from wallmirror.thesis.figure import Claim, ThesisFigure
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

_PIXELS = 1000
_SPREAD = 0.2  # width of the card over its distance, where its angular width is kept
_LOOKS = {
    "wall": (PALE, "-", "along the wall (thesis)"),
    "wall, both distances": (WARM, "-", "along the wall, both distances"),
    "outgoing angle": (CYCLE[2], "-", "over θo"),
    "angle sum": (OURS, "-", "over θo + θc"),
    "spherical": (INK, ":", "half circle"),
}
_LIMIT = math.radians(60)  # of both angles for Hypothesis 8, about what the view and the card at 5 m span
_Errors = dict[str, Array]


def distance(seed: int) -> ThesisFigure:
    """Error against distance, at a fixed angular width and at a fixed width."""
    brdf = setting.lobes(*setting.LOBES["text"])
    distances = np.geomspace(10, 1e6, 16)
    at_angle = [setting.card(float(d), width=_SPREAD * float(d)) for d in distances]
    at_width = [setting.card(float(d)) for d in distances]
    angle, width = (_sweep(cards, brdf) for cards in (at_angle, at_width))
    bare = np.array([_bare_factor(card, brdf) for card in at_angle])
    figure = new_figure(10.5, 4.0)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, errors, title in zip(
        panels,
        (angle, width),
        (f"card {math.degrees(2 * math.atan(_SPREAD / 2)):.0f}° wide", "card 10 m wide"),
        strict=True,
    ):
        _curves(axes, distances, errors)
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_xlabel("distance of the card (m)")
    panels[0].loglog(distances, bare, color=OURS, linestyle="--", linewidth=1.2, label="over θo + θc, cos θ as one Q")
    panels[0].set_ylabel("relative error")
    panels[0].set_ylim(1e-13, 30)
    figure.legend(*panels[0].get_legend_handles_labels(), frameon=False, fontsize=9, loc="outside upper left", ncols=3)
    far = (distances >= 1e3) & (distances <= 1e6)
    slopes = {name: _slope(distances[far], angle[name][far]) for name in ("angle sum", "outgoing angle")}
    steep = distances >= 100
    narrow = _slope(
        distances[steep & (width["angle sum"] > 1e-11)], width["angle sum"][steep & (width["angle sum"] > 1e-11)]
    )
    theta = np.array(
        [float(np.max(np.ptp(scene_angles(setting.observer(_PIXELS), card)[0], axis=-1))) for card in at_width]
    )
    difference = _slope(distances[far], theta[far])
    plateau = float(angle["wall"][-1])
    return ThesisFigure(
        id="3.1-far-field",
        title="Which convolution converges with distance",
        about="Relative error against Algorithm 1 of every form of rendering by convolution, lobes at ±15° and ±30°, 1,000 "
        "wall points. Left the card keeps its angular width, so that its mirror image keeps its size; right it keeps its "
        "width and shrinks to one point in the mirror. Dashed: with the cosine of eq. 2.12 all put into Q(θo).",
        figure=figure,
        columns={
            "distance (m)": distances,
            **{f"{name}, fixed angular width": values for name, values in angle.items()},
            "angle sum with the cosine as one Q, fixed angular width": bare,
            **{f"{name}, 10 m wide": values for name, values in width.items()},
        },
        numbers={
            "slope over the angle sum, fixed angular width, 1e3 to 1e6 m": slopes["angle sum"],
            "slope over the outgoing angle, fixed angular width, 1e3 to 1e6 m": slopes["outgoing angle"],
            "slope over the angle sum, fixed width": narrow,
            "error along the wall at 1e6 m, fixed angular width": plateau,
            "error over the angle sum at 1e6 m, fixed angular width": float(angle["angle sum"][-1]),
            "error with the cosine as one Q at 1e6 m, fixed angular width": float(bare[-1]),
        },
        claims=(
            Claim(
                thesis="The difference between the angles to two source points falls as 1 / y_s (eq. 3.3).",
                outcome="confirmed" if abs(difference + 1) < 0.05 else "refuted",
                measured=f"At a fixed width its logarithm falls with slope {difference:.3f} from 1e3 to 1e6 m.",
            ),
            Claim(
                thesis="In the far field rendering is one convolution of rho_wall with the mirror's render (eq. 3.7).",
                outcome="confirmed" if plateau < 0.05 else "corrected",
                measured=f"Along the wall only because the mirror image shrinks to a point: at a fixed angular width the error "
                f"stays at {plateau:.2f}, since tan(a + u) is not tan a + tan u. Over the angle sum the error falls as "
                f"1 / y_s (slope {slopes['angle sum']:.3f}).",
            ),
            Claim(
                thesis="The cosine can be taken out of the sum as a factor Q(theta_o).",
                outcome="confirmed" if bare[-1] < 2 * angle["angle sum"][-1] else "corrected",
                measured=f"At a fixed angular width Q alone leaves {bare[-1]:.1g} at any distance: a constant "
                "for each element, which can go to the source.",
            ),
        ),
    )


def far_field(seed: int) -> ThesisFigure:
    """Hypothesis 7 over distance, width of the card and angle of the lobe, about the thesis's setting at 50 m."""
    lobe = setting.lobes(-30, 30)
    distances = np.geomspace(5, 5000, 13)
    widths = np.geomspace(0.05, 50, 13)
    centres = np.linspace(0, 60, 13)
    by_distance = _sweep([setting.card(float(d)) for d in distances], lobe)
    by_width = _sweep([setting.card(50.0, width=float(w)) for w in widths], lobe)
    by_angle = _stack([_errors(setting.card(50.0), setting.lobes(-c, c)) for c in centres])
    figure = new_figure(10.5, 3.8)
    panels = figure.subplots(1, 3, sharey=True)
    _curves(panels[0], distances, by_distance)
    _curves(panels[1], widths, by_width)
    _curves(panels[2], centres, by_angle)
    panels[2].set_xscale("linear")
    panels[0].set_ylabel("relative error")
    panels[0].set_ylim(1e-13, 10)
    for axes, label in zip(
        panels, ("distance of the card (m)", "width of the card (m)", "angle of the lobes (± °)"), strict=True
    ):
        axes.set_xlabel(label)
    figure.legend(*panels[0].get_legend_handles_labels(), frameon=False, fontsize=9, loc="outside upper left", ncols=5)
    small = float(by_width["wall"][0])
    small_ours = float(by_width["angle sum"][0])
    wall_mirror = float(by_angle["wall, both distances"][0])
    return ThesisFigure(
        id="3.1-hypothesis-7",
        title="Hypothesis 7 over distance, width and angle",
        about="Relative error against Algorithm 1 about one setting: the card 50 m away and 10 m wide, lobes at ±30°, 1° wide. "
        "Each panel varies one of the three.",
        figure=figure,
        columns={
            "distance (m)": distances,
            **{f"{name} over distance": values for name, values in by_distance.items()},
            "width (m)": widths,
            **{f"{name} over width": values for name, values in by_width.items()},
            "lobe angle (deg)": centres,
            **{f"{name} over lobe angle": values for name, values in by_angle.items()},
        },
        numbers={
            "along the wall, card 0.05 m wide": small,
            "over the angle sum, card 0.05 m wide": small_ours,
            "over the angle sum, card 10 m wide at 50 m": float(np.interp(50, distances, by_distance["angle sum"])),
            "along the wall, both distances, lobe at 0 deg": wall_mirror,
            "along the wall, both distances, lobe at 60 deg": float(by_angle["wall, both distances"][-1]),
        },
        claims=(
            Claim(
                thesis="A narrower source makes the far-field approximation better, as a greater distance does.",
                outcome="confirmed" if small < 0.1 else "corrected",
                measured=f"Over the angle sum it does ({small_ours:.1g} for a card 5 cm wide at 50 m). Along the wall it "
                f"stays at {small:.2f}, because the projection of the BRDF leaves out the distance of the card; with both "
                f"distances at {float(by_width['wall, both distances'][0]):.2f}, because tangents do not add.",
            ),
        ),
    )


def angle_sum(seed: int) -> ThesisFigure:
    """Hypothesis 8: how near the best function of the angle sum comes to a rough metal, over its roughness."""
    roughness = np.geomspace(0.05, 1.0, 14)
    names = ("ρ of the sum", "ρ cos θs of the sum", "q(θo) times one of the sum")
    residuals = {name: np.empty(roughness.size) for name in names}
    for k, alpha in enumerate(roughness):
        metal = _rough_metal(float(alpha))
        residuals[names[0]][k] = best_angle_sum(metal, limit=_LIMIT).residual
        residuals[names[1]][k] = best_angle_sum(metal, limit=_LIMIT, weights="cosine").residual
        residuals[names[2]][k] = best_angle_sum(metal, limit=_LIMIT, weights="cosine", outgoing_factor=True).residual
    metal = _rough_metal(0.3)
    observer, card = setting.observer(_PIXELS), setting.card()
    exact = radiance(transport_matrix(observer, card, metal, weights="cosine"), setting.SOURCE)[0]
    theta_s, theta_o = scene_angles(observer, card)
    renders = {}
    for name, factor in ((names[1], False), (names[2], True)):
        fit = best_angle_sum(metal, limit=_LIMIT, weights="cosine", outgoing_factor=factor)
        renders[name] = (fit.of_angles(theta_s, theta_o[..., None]) @ setting.SOURCE)[0]
    x = np.linspace(-5, 5, _PIXELS)
    figure = new_figure(10.5, 3.8)
    error_axes, render_axes = figure.subplots(1, 2)
    for (name, values), colour in zip(residuals.items(), (FAINT, WARM, OURS), strict=True):
        error_axes.loglog(roughness, values, "o-", color=colour, markersize=3.5, linewidth=1.2, label=name)
    error_axes.set_xlabel("roughness α")
    error_axes.set_ylabel("relative error over ±60°")
    error_axes.set_xticks([0.05, 0.1, 0.2, 0.5, 1], ["0.05", "0.1", "0.2", "0.5", "1"])
    error_axes.minorticks_off()
    error_axes.legend(frameon=False, fontsize=9, loc="lower right")
    render_axes.plot(x, exact, color=PALE, linewidth=4, label="Algorithm 1, α = 0.3")
    for (name, curve), colour in zip(renders.items(), (WARM, OURS), strict=True):
        render_axes.plot(x, curve, color=colour, linewidth=1.2, linestyle="--" if colour == OURS else "-", label=name)
    render_axes.set_xlim(-5, 5)
    render_axes.set_ylim(0, 1.4 * float(exact.max()))
    render_axes.set_xlabel("x (m)")
    render_axes.set_ylabel("radiance")
    render_axes.legend(frameon=False, fontsize=9, loc="upper left")
    for axes in (error_axes, render_axes):
        clean(axes)
    errors = {name: relative_error(curve, exact) for name, curve in renders.items()}
    glossy = float(residuals[names[0]][0])
    return ThesisFigure(
        id="3.1-hypothesis-8",
        title="Hypothesis 8 for a rough metal",
        about="Cook-Torrance in the plane (GGX normals, Smith's masking, Schlick's Fresnel term with 0.9 at normal "
        "incidence). Left: the distance from the best function of the angle sum. With sharp lobes the microfacets' normals "
        "make it a function of the sum; masking, Fresnel and 1 / (4 cos θs cos θo) do not. Right: the source of Fig. 3.1, "
        "5 m away, with the best approximations in place of the metal.",
        figure=figure,
        columns={
            "roughness": roughness,
            **{f"residual, {name}": values for name, values in residuals.items()},
            "x (m)": x,
            "Algorithm 1": exact,
            **{f"render, {name}": curve for name, curve in renders.items()},
        },
        numbers={
            f"{names[0]}, roughness 0.05": glossy,
            f"{names[0]}, roughness 1": float(residuals[names[0]][-1]),
            f"{names[2]}, roughness 0.05": float(residuals[names[2]][0]),
            f"{names[2]}, roughness 1": float(residuals[names[2]][-1]),
            **{f"render at roughness 0.3, {name}": error for name, error in errors.items()},
        },
        claims=(
            Claim(
                thesis="Specular and glossy reflectors satisfy Hypothesis 8.",
                outcome="confirmed" if glossy < 0.05 else "corrected",
                measured=f"At roughness 0.05 the best function of the angle sum is {100 * glossy:.0f} % off over ±60°, for the "
                "lobe grows towards grazing angles as 1 / (cos θs cos θo). With the cosine of eq. 2.12 and a factor of θo, "
                f"which a convolution admits as part of Q, it is {100 * residuals[names[2]][0]:.1g} % off.",
            ),
        ),
    )


def _rough_metal(alpha: float) -> CookTorrance:
    return CookTorrance(alpha=alpha, fresnel=Schlick(f0=0.9), facets="isotropic")


def _errors(card: Card, brdf: AngleSumBRDF) -> dict[str, float]:
    return convolution_errors(setting.observer(_PIXELS), card, brdf, setting.SOURCE, samples=2000, order=7)


def _sweep(cards: list[Card], brdf: AngleSumBRDF) -> _Errors:
    return _stack([_errors(card, brdf) for card in cards])


def _stack(errors: list[dict[str, float]]) -> _Errors:
    return {name: np.array([one[name] for one in errors]) for name in _LOOKS}


def _bare_factor(card: Card, brdf: AngleSumBRDF) -> float:
    """Error over the angle sum with the cosine of eq. 2.12 put into Q alone."""
    observer = setting.observer(_PIXELS)
    exact = radiance(transport_matrix(observer, card, brdf, weights="cosine"), setting.SOURCE)
    ours = angle_convolution(
        observer, card, brdf, setting.SOURCE, weights="cosine", per_element=False, samples=2000, order=7
    )  # fmt: skip
    return relative_error(ours, exact)


def _curves(axes: Axes, at: Array, errors: _Errors) -> None:
    for name, (colour, style, label) in _LOOKS.items():
        width = 4.5 if colour == PALE else 1.4  # others lie upon it
        axes.loglog(at, errors[name], color=colour, linestyle=style, linewidth=width, label=label)
    clean(axes)


def _slope(at: Array, errors: Array) -> float:
    return float(np.polyfit(np.log(at), np.log(errors), 1)[0])


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {
    "3.1-far-field": distance,
    "3.1-hypothesis-7": far_field,
    "3.1-hypothesis-8": angle_sum,
}
