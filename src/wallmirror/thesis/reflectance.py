"""Section 1.2: the BRDF as a quotient that is measured, the models' lobes, and which of them can be a wall."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Wedge
from numpy.typing import NDArray

from wallmirror.brdf import (
    BRDF,
    Audit,
    Blinn,
    CookTorrance,
    Diffuse,
    Fresnel,
    GaussianTrain,
    Mirror,
    Phong,
    PhongIllumination,
    Schlick,
    audit,
    directional_albedo,
    directional_albedos,
)
from wallmirror.brdf.audits import GRAZING
from wallmirror.geometry import Card, Observer
from wallmirror.report.style import CYCLE, FAINT, INK, OURS, PALE, WARM, clean, new_figure
from wallmirror.thesis.figure import Claim, ThesisFigure
from wallmirror.transport import transport_matrix

Array = NDArray[np.float64]

_ALUMINIUM = Fresnel(eta=1.1, k=6.6)
_ROUGH = CookTorrance(alpha=0.3, fresnel=_ALUMINIUM)
_GOOD = "#2e8b57"


# -- Fig. 1.3 ---------------------------------------------------------------------------------------------------


def quotient(seed: int) -> ThesisFigure:
    """Fig. 1.3: radiance over irradiance of a wall point, for a light that shrinks, and with light and camera swapped."""
    light, camera = math.radians(-50), math.radians(25)
    widths = np.logspace(0, -3, 13)  # of the light, in metres, at a distance of 2 m from the wall
    there = np.array([_measured(light, camera, w) for w in widths])
    back = np.array([_measured(camera, light, w) for w in widths])
    rho = float(_ROUGH(light, camera))
    extent = np.degrees(widths * math.cos(light) ** 2 / 2)
    error = np.abs(there / rho - 1)
    slope = float(np.polyfit(np.log(widths[4:9]), np.log(error[4:9]), 1)[0])
    swapped = float(abs(back[-1] / there[-1] - 1))
    figure = new_figure(10, 3.9)
    diagram, axes = figure.subplots(1, 2, width_ratios=(1, 1.15))
    _two_cones(diagram, light, camera)
    axes.semilogx(extent, there, "o-", color=OURS, markersize=4, label="light at -50°, camera at 25°")
    axes.semilogx(extent, back, "s-", color=WARM, markersize=4, label="swapped")
    axes.axhline(rho, color=INK, linewidth=1, linestyle="--")
    axes.annotate("ρ of the model", (extent[-1], rho), (0, 6), textcoords="offset points", fontsize=9, color=INK)
    axes.set_xlabel("width of the light, seen from the wall (deg)")
    axes.set_ylabel("dL / dE (1/sr)")
    axes.legend(frameon=False, fontsize=9, loc="best")
    clean(axes)
    return ThesisFigure(
        id="1.3",
        title="The BRDF, measured as radiance over irradiance",
        about="The wall is rough aluminium (Cook-Torrance, alpha = 0.3). Its radiance by the one-bounce transport, divided by "
        "the irradiance that a white diffuse wall in its place shows, for square lights of decreasing size at 2 m.",
        figure=figure,
        columns={"width of the light (deg)": extent, "dL/dE (1/sr)": there, "dL/dE swapped (1/sr)": back},
        numbers={
            "rho of the model (1/sr)": rho,
            "dL/dE with the smallest light (1/sr)": float(there[-1]),
            "order in which the light's size matters": slope,
            "difference after swapping light and camera": swapped,
        },
        claims=(
            Claim(
                thesis="The BRDF is the ratio of infinitesimal reflected radiance to infinitesimal irradiance (eqs. 1.7, 1.8).",
                outcome="confirmed" if error[-1] < 1e-5 else "refuted",
                measured=f"The quotient tends to the model's {rho:.4g} / sr, as the size of the light to the power "
                f"{slope:.2f}, and is {error[-1]:.1g} off for the smallest.",
            ),
            Claim(
                thesis="Reciprocity: incident and reflected direction can be exchanged without changing what is reflected.",
                outcome="confirmed" if swapped < 1e-5 else "refuted",
                measured=f"With light and camera swapped the measured quotient changes by {swapped:.1g} of itself.",
            ),
        ),
    )


def _measured(light: float, camera: float, width: float) -> float:
    """L / E at the wall's origin for a square light in direction `light`, seen from direction `camera`."""
    # Three samples across the field, of which the middle one looks at the origin.
    observer = Observer(
        position=(3 * math.tan(camera), -3.0), fov=0.01, view_angles=(camera,), pixels=3, pixels_at="edges"
    )
    card = Card(elements_x=(2 * math.tan(light),), y=-2.0, element_width=width, element_height=width)
    seen, white = (float(transport_matrix(observer, card, b)[0, 1, 0]) for b in (_ROUGH, Diffuse(albedo=1.0)))
    return seen / (math.pi * white)


def _two_cones(axes: Axes, light: float, camera: float) -> None:
    axes.plot([-1.1, 1.1], [0, 0], color=INK, linewidth=2)
    axes.annotate("", (0, 1.0), (0, 0), arrowprops={"arrowstyle": "-|>", "color": FAINT})
    axes.text(0.03, 1.0, "n", color=FAINT, fontsize=12)
    for angle, colour, name, sign in ((light, WARM, "$d\\omega_i$", "θᵢ"), (camera, OURS, "$d\\omega_r$", "θᵣ")):
        middle = 90 - math.degrees(angle)
        axes.add_patch(Wedge((0, 0), 1.15, middle - 4, middle + 4, color=colour, alpha=0.3, linewidth=0))
        axes.text(
            1.33 * math.sin(angle), 1.28 * math.cos(angle), name, color=colour, fontsize=13, ha="center", va="center"
        )
        turn = np.linspace(0, angle, 30)
        axes.plot(0.42 * np.sin(turn), 0.42 * np.cos(turn), color=colour, linewidth=1.2)
        axes.text(0.53 * math.sin(angle / 2), 0.53 * math.cos(angle / 2), sign, color=colour, fontsize=12, ha="center")
    axes.text(-0.72, 0.22, "$L_i$", color=WARM, fontsize=13)
    axes.text(0.6, 0.62, "$dL_r$", color=OURS, fontsize=13)
    axes.set(xlim=(-1.3, 1.3), ylim=(-0.1, 1.3), aspect="equal")
    axes.set_axis_off()


# -- Fig. 1.4 ---------------------------------------------------------------------------------------------------


def lobes(seed: int) -> ThesisFigure:
    """Fig. 1.4: the lobe of every model in the plane for light from 40 deg, with its albedo and its audit."""
    light = math.radians(-40)
    theta = np.linspace(GRAZING - math.pi / 2, math.pi / 2 - GRAZING, 3601)
    models: dict[str, BRDF] = {
        "Diffuse": Diffuse(albedo=0.5),
        "Phong, with its formula of 1975": PhongIllumination(exponent=20, specular=0.5),
        "Phong, energy-conserving": Phong(exponent=20, reflectance=0.5),
        "Blinn, energy-conserving": Blinn(exponent=80, reflectance=0.5),
        "Cook-Torrance, rough metal": _ROUGH,
        "Cook-Torrance, rough glaze": CookTorrance(alpha=0.3, fresnel=Fresnel(eta=1.5)),
        "Test BRDF (eq. 2.15)": GaussianTrain.of_the_text(),
        "Mirror": Mirror(),
    }
    found = {name: audit(model) for name, model in models.items()}
    albedos = {name: directional_albedo(model, light) for name, model in models.items()}
    figure = new_figure(12, 5.7)
    columns: dict[str, Array] = {"theta_o (deg)": np.degrees(theta)}
    for axes, (name, model) in zip(figure.subplots(2, 4).ravel(), models.items(), strict=True):
        values = None if isinstance(model, Mirror) else model(light, theta)
        if values is not None:
            columns[f"{name} (1/sr)"] = values
        _lobe(axes, light, theta, values)
        verdict = found[name].violated
        axes.set_title(name, fontsize=10.5)
        axes.text(0, -0.14, f"albedo {albedos[name]:.3f}", ha="center", fontsize=9.5, color=INK)
        says = "can be a wall" if not verdict else "violates " + "\nand ".join(verdict)
        axes.text(0, -0.24, says, ha="center", va="top", fontsize=9.5, color=_GOOD if not verdict else WARM)
    return ThesisFigure(
        id="1.4",
        title="Lobes of the reflectance models",
        about="Light from 40° on the left (arrow), each lobe scaled to its own largest value; the number is the share of that "
        "light that comes back. In the plane the models are functions of two angles, and constant along the wall's height.",
        figure=figure,
        columns=columns,
        numbers={f"albedo at 40 deg, {name}": albedo for name, albedo in albedos.items()},
        claims=(_examples(found),),
    )


def _examples(found: dict[str, Audit]) -> Claim:
    bad = {name: audited for name, audited in found.items() if not audited.passed}
    told = "; ".join(f"{name}: {' and '.join(audited.violated)}" for name, audited in bad.items())
    return Claim(
        thesis="Mirror, diffuse, and empirical or physical models such as Phong's or Cook-Torrance are practical examples of "
        "BRDFs.",
        outcome="confirmed" if not bad else "corrected" if len(bad) < len(found) / 2 else "refuted",
        measured=f"{len(found) - len(bad)} of {len(found)} keep non-negativity, reciprocity and energy conservation. "
        + (f"Violated by {told}." if bad else ""),
    )


def _lobe(axes: Axes, light: float, theta: Array, values: Array | None) -> None:
    axes.plot([-1.08, 1.08], [0, 0], color=INK, linewidth=1.6)
    rim = np.linspace(-math.pi / 2, math.pi / 2, 100)
    axes.plot(np.sin(rim), np.cos(rim), color=PALE, linewidth=0.8)
    start = np.array([math.sin(light), math.cos(light)])
    axes.annotate("", (0, 0), tuple(1.08 * start), arrowprops={"arrowstyle": "-|>", "color": WARM, "linewidth": 1.4})
    if values is None:
        axes.annotate(
            "", (-start[0], start[1]), (0, 0), arrowprops={"arrowstyle": "-|>", "color": OURS, "linewidth": 2.2}
        )
    else:
        radius = values / values.max()
        axes.fill(radius * np.sin(theta), radius * np.cos(theta), color=OURS, alpha=0.3, linewidth=0)
        axes.plot(radius * np.sin(theta), radius * np.cos(theta), color=OURS, linewidth=1.4)
    axes.set(xlim=(-1.15, 1.15), ylim=(-0.45, 1.12), aspect="equal")
    axes.set_axis_off()


# -- audits -----------------------------------------------------------------------------------------------------


@cache
def audited() -> dict[str, tuple[BRDF, Audit]]:
    """The models of the table with what their audits found."""
    text, code = GaussianTrain.of_the_text(), GaussianTrain.of_the_code()
    literal = replace(text, sigma=1.0, height="per_radian")
    metal = CookTorrance(alpha=0.2, fresnel=_ALUMINIUM)
    models: dict[str, BRDF] = {
        "Mirror": Mirror(),
        "Diffuse, white": Diffuse(albedo=1.0),
        "Phong, energy-conserving": Phong(exponent=20, reflectance=1.0),
        "Phong, plain, n = 2": Phong(exponent=2, reflectance=1.0, form="plain"),
        "Phong, formula of 1975": PhongIllumination(exponent=20, specular=0.5),
        "Blinn, energy-conserving": Blinn(exponent=80, reflectance=1.0),
        "Cook-Torrance, grooves": replace(metal, fresnel=Schlick(f0=1.0)),
        "Cook-Torrance, isotropic facets": replace(metal, facets="isotropic"),
        "Test BRDF, unit area per degree": text,
        "Test BRDF, unit area per radian": replace(text, height="per_radian"),
        "Test BRDF, σ = 1 rad, as printed": literal,
        "Test BRDF of the code, peak 1": code,
        "Test BRDF of the code, per radian": replace(code, height="per_radian"),
    }
    return {name: (model, audit(model)) for name, model in models.items()}


def audits(seed: int) -> ThesisFigure:
    """Section 1.2: which model violates which property, by how much, and in which direction."""
    found = audited()
    incidence = np.linspace(GRAZING - math.pi / 2, math.pi / 2 - GRAZING, 181)
    shown = (
        "Phong, formula of 1975",
        "Cook-Torrance, isotropic facets",
        "Test BRDF, unit area per radian",
        "Test BRDF, unit area per degree",
        "Cook-Torrance, grooves",
    )
    curves = {name: directional_albedos(found[name][0], incidence) for name in shown}
    figure = new_figure(13, 5.2)
    table, axes = figure.subplots(1, 2, width_ratios=(1.7, 1))
    _table(table, {name: audited for name, (_, audited) in found.items()})
    for (name, curve), colour in zip(curves.items(), (WARM, "#8250b4", CYCLE[2], INK, OURS), strict=True):
        axes.semilogy(np.degrees(incidence), curve, color=colour, linewidth=1.5, label=name)
    axes.axhline(1, color=INK, linewidth=1, linestyle="--")
    axes.text(0, 1.12, "above: more than came in", fontsize=9, color=INK, ha="center")
    axes.set_xlabel("θₛ, direction of the light (deg)")
    axes.set_ylabel("share of the light that comes back")
    axes.set_ylim(0.05, 3000)
    axes.set_xticks(range(-90, 91, 45))
    axes.legend(frameon=False, fontsize=9, loc="upper center")
    clean(axes)
    text, radian, literal = (
        found[f"Test BRDF, {name}"][1].energy
        for name in ("unit area per degree", "unit area per radian", "σ = 1 rad, as printed")
    )
    return ThesisFigure(
        id="1.2-audits",
        title="Which reflectance can be a wall",
        about="Each model's worst direction, on a grid of both angles up to 1e-4 rad from grazing. All are continued along the "
        "wall's height, so that the share that comes back is (π/2) ∫ ρ cos θₒ dθₒ (eq. 1.9); facets that tilt every way are "
        "the usual Cook-Torrance, whose streak is then too bright.",
        figure=figure,
        columns={
            "largest share": np.array([a.energy.value for _, a in found.values()]),
            "from theta_s (deg)": np.array([math.degrees(a.energy.where[0]) for _, a in found.values()]),
            "asymmetry": np.array([a.reciprocity.value for _, a in found.values()]),
            "smallest value (1/sr)": np.array([a.non_negativity.value for _, a in found.values()]),
            "theta_s (deg)": np.degrees(incidence),
            **{f"share, {name}": curve for name, curve in curves.items()},
        },
        numbers={
            "largest share, test BRDF per degree": text.value,
            "per radian": radian.value,
            "with sigma 1 rad": literal.value,
            "models audited": float(len(found)),
            "models that violate something": float(sum(not a.passed for _, a in found.values())),
        },
        claims=_test_brdf_claims({name: audited for name, (_, audited) in found.items()}),
    )


def _test_brdf_claims(found: dict[str, Audit]) -> tuple[Claim, ...]:
    trains = {name: a for name, a in found.items() if name.startswith("Test BRDF")}
    reciprocal = all(a.reciprocity.passed and a.non_negativity.passed for a in trains.values())
    kept = [name for name, a in trains.items() if a.energy.passed]
    degree, radian = (trains[f"Test BRDF, unit area per {unit}"].energy.value for unit in ("degree", "radian"))
    literal = trains["Test BRDF, σ = 1 rad, as printed"].energy.value
    return (
        Claim(
            thesis="A BRDF should be non-negative and reciprocal; the test BRDF of eq. 2.15 is used as one.",
            outcome="confirmed" if reciprocal else "refuted",
            measured="A function of θₛ + θₒ alone does not know which angle is which, so every variant is reciprocal; none is "
            "negative.",
        ),
        Claim(
            thesis="A BRDF should conserve energy (eq. 1.9); the test BRDF is a sum of four normalised Gaussians with σ = 1.",
            outcome="confirmed" if len(kept) == len(trains) else "corrected" if kept else "refuted",
            measured=f"It depends on the unit, which the text leaves open: with σ = 1° and unit area per degree {degree:.3f} "
            f"of the light comes back, per radian {radian:.2f} times as much as came in. Read as printed, with σ = 1 rad "
            f"beside means in radians, it is {literal:.2f} times. {len(kept)} of {len(trains)} readings conserve energy.",
        ),
    )


def _table(axes: Axes, found: dict[str, Audit]) -> None:
    """A row to each model: property by property a mark, and the worst amount and direction."""
    heads = ("non-negative", "reciprocal", "energy: largest share back")
    places = (0.37, 0.53, 0.67)
    rows = len(found)
    for x, head in zip(places, heads, strict=True):
        axes.text(x, rows + 0.2, head, fontsize=9.5, color=INK, ha="left", fontweight="bold")
    for k, (name, a) in enumerate(found.items()):
        y = rows - 1 - k
        if k % 2 == 0:
            axes.axhspan(y - 0.35, y + 0.65, color=PALE, alpha=0.25, linewidth=0)
        axes.text(0.0, y, name, fontsize=9.5, color=INK)
        asymmetry = "yes" if a.reciprocity.passed else f"no: {a.reciprocity.value:.2g}"
        share = f"{a.energy.value:.3g} at {math.degrees(a.energy.where[0]) + 0.0:.0f}°"
        cells = (
            (a.non_negativity.passed, "yes" if a.non_negativity.passed else f"no: {a.non_negativity.value:.2g}"),
            (a.reciprocity.passed, asymmetry),
            (a.energy.passed, share if a.energy.passed else f"violated: {share}"),
        )
        for x, (passed, words) in zip(places, cells, strict=True):
            axes.text(x, y, words, fontsize=9.5, color=_GOOD if passed else WARM)
    axes.set(xlim=(0, 1.02), ylim=(-0.6, rows + 0.9))
    axes.set_axis_off()


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"1.2-audits": audits, "1.3": quotient, "1.4": lobes}
