"""Section 1.1 and 1.4: spherical coordinates, solid angles, and the Neumann series of a small room."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from wallmirror.radiosity import Box, Face, NeumannSeries, neumann_series, transport_operator
from wallmirror.report.style import CYCLE, FAINT, INK, OURS, PALE, WARM, clean, new_figure
from wallmirror.thesis.figure import Claim, ThesisFigure

Array = NDArray[np.float64]

_DIRECTIONS = 100_000
_ROOM = (4.0, 5.0, 3.0)  # metres
_LAMP: Face = "z1"
_ALBEDOS = (0.2, 0.5, 0.8, 0.95)
_TERMS = 40


def spherical_coordinates(seed: int) -> ThesisFigure:
    """Fig. 1.1: the coordinates (r, theta, phi), their element of solid angle, and whether they come back."""
    cells = 2 ** np.arange(2, 11)
    sums = np.array([_sum_of_elements(int(n)) for n in cells])
    error = np.abs(sums / (4 * math.pi) - 1)
    w = np.random.default_rng(seed).standard_normal((_DIRECTIONS, 3))
    w /= np.linalg.norm(w, axis=1)[:, None]
    theta = np.arccos(w[:, 2])

    def back(phi: Array) -> float:
        again = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
        return float(np.mean(np.linalg.norm(again - w, axis=1) < 1e-6))

    by_text, by_quadrant = back(np.arctan(w[:, 1] / w[:, 0])), back(np.arctan2(w[:, 1], w[:, 0]))
    slope = float(np.polyfit(np.log(cells[-4:]), np.log(error[-4:]), 1)[0])
    figure = new_figure(10, 4.4)
    grid = figure.add_gridspec(1, 2, width_ratios=(1.15, 1))
    _coordinates(figure.add_subplot(grid[0]))
    axes = figure.add_subplot(grid[1])
    axes.loglog(cells, error, "o-", color=OURS, markersize=4)
    axes.set_xlabel("steps of θ from 0 to π, and of φ from 0 to 2π")
    axes.set_ylabel("relative error of the sum")
    axes.set_title("Σ sin θ Δθ Δφ against 4π", fontsize=11)
    clean(axes)
    return ThesisFigure(
        id="1.1",
        title="Spherical coordinates",
        about="Left: a point by its distance r, polar angle θ and azimuth φ, and the surface element r dθ by r sin θ dφ. "
        "Right: elements sin θ Δθ Δφ (eq. 1.1) at the middles of a grid add up to the whole sphere.",
        figure=figure,
        columns={"steps": cells, "sum of solid angles (sr)": sums, "relative error": error},
        numbers={
            "sum over 1024 x 1024 steps / 4 pi - 1": float(sums[-1] / (4 * math.pi) - 1),
            "order of its error": -slope,
            "directions that come back with phi = arctan(y/x)": by_text,
            "with the quadrant of (x, y)": by_quadrant,
        },
        claims=(
            Claim(
                thesis="A surface element of the sphere subtends dω = sin θ dθ dφ (eq. 1.1).",
                outcome="confirmed" if error[-1] < 1e-6 and abs(slope + 2) < 0.05 else "refuted",
                measured=f"Over the sphere the elements add up to 4π within {error[-1]:.1g}, and the rest falls with the "
                f"step to the power {-slope:.2f}, as a midpoint rule's does.",
            ),
            Claim(
                thesis="The azimuth of a point is φ = arctan(y/x), from 0 to 2π.",
                outcome="confirmed" if by_text > 0.999 else "corrected",
                measured=f"{100 * by_text:.0f} % of random directions come back: the arctangent of a quotient does not know "
                f"x > 0 from x < 0. With the quadrant of (x, y) {100 * by_quadrant:.0f} % do.",
            ),
        ),
    )


def _sum_of_elements(steps: int) -> float:
    theta = (np.arange(steps) + 0.5) * math.pi / steps
    return float(np.sum(np.sin(theta)) * math.pi / steps * 2 * math.pi)


def _on_sphere(theta: Array | float, phi: Array | float) -> Array:
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def _patch(theta: tuple[float, float], phi: tuple[float, float], nodes: int = 20) -> Array:
    """The rim of a patch of the unit sphere between two polar angles and two azimuths, (points, 3)."""
    t, p = np.linspace(*theta, nodes), np.linspace(*phi, nodes)
    rim = [_on_sphere(t, phi[0]), _on_sphere(theta[1], p), _on_sphere(t[::-1], phi[1]), _on_sphere(theta[0], p[::-1])]
    return np.concatenate(rim, axis=1).T


def _flat(points: Array) -> Array:
    """Orthographic picture of points (3, n): x to the lower left, y to the right, z up; shape (2, n)."""
    azimuth, elevation = math.radians(28), math.radians(20)
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    back = np.array([-math.cos(azimuth), -math.sin(azimuth), 0.0])
    up = math.sin(elevation) * back + math.cos(elevation) * np.array([0.0, 0.0, 1.0])
    return np.stack([right, up]) @ points


def _draw(axes: Axes, points: Array, **style: Any) -> None:
    axes.plot(*_flat(points), **style)


def _name(axes: Axes, point: Array, text: str, **style: Any) -> None:
    x, y = _flat(point)
    axes.text(x, y, text, **{"ha": "center", "va": "center", "fontsize": 13, **style})


def _eighth_of_a_sphere(axes: Axes) -> None:
    for end, name in zip(1.2 * np.eye(3), "xyz", strict=True):
        _draw(axes, np.stack([np.zeros(3), end], axis=1), color=INK, linewidth=1)
        _name(axes, 1.07 * end, name, color=INK)
    quarter = np.linspace(0, math.pi / 2, 60)
    for arc in (_on_sphere(quarter, 0.0), _on_sphere(quarter, math.pi / 2), _on_sphere(math.pi / 2, quarter)):
        _draw(axes, arc, color=PALE, linewidth=1.2)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _coordinates(axes: Axes) -> None:
    _eighth_of_a_sphere(axes)
    theta, phi, step = math.radians(45), math.radians(58), math.radians(12)
    point = _on_sphere(theta, phi)
    origin = np.zeros(3)
    _draw(
        axes, np.stack([point, point * np.array([1, 1, 0]), origin], axis=1), color=FAINT, linewidth=1, linestyle="--"
    )
    _draw(axes, np.stack([origin, point], axis=1), color=OURS, linewidth=2)
    _draw(axes, 0.4 * _on_sphere(np.linspace(0, theta, 30), phi), color=WARM, linewidth=1.8)
    _draw(axes, 0.4 * _on_sphere(math.pi / 2, np.linspace(0, phi, 30)), color=CYCLE[2], linewidth=1.8)
    _name(axes, 0.49 * _on_sphere(theta / 2, phi), "θ", color=WARM)
    _name(axes, 0.54 * _on_sphere(math.pi / 2, phi / 2), "φ", color=CYCLE[2])
    _name(axes, 0.72 * _on_sphere(theta - 0.12, phi), "r", color=OURS)
    axes.fill(*_flat(_patch((theta, theta + step), (phi, phi + step)).T), color=OURS, alpha=0.35, linewidth=0)
    _draw(axes, _patch((theta, theta + step), (phi, phi + step)).T, color=OURS, linewidth=1.2)
    _name(axes, _on_sphere(theta + step / 2, phi + step), "  r dθ", ha="left", fontsize=11, color=INK)
    _name(axes, 1.02 * _on_sphere(theta + 1.55 * step, phi + 0.6 * step), "r sin θ dφ", fontsize=11, color=INK)


def solid_angle(seed: int) -> ThesisFigure:
    """Fig. 1.2: dS / r^2 against the exact solid angle of finite surface elements as they shrink."""
    size = np.logspace(0, -3, 25)  # side over distance
    theta = math.radians(60)
    elements = {
        "on the sphere, at θ = 60°": (_sphere_element(size, theta), size**2 * math.sin(theta)),
        "flat, facing the point": (_flat_element(size, 0.0), size**2),
        "flat, tilted by 60°, dS cos α / r²": (_flat_element(size, theta), size**2 * math.cos(theta)),
        "flat, tilted by 60°, dS / r²": (_flat_element(size, theta), size**2),
    }
    errors = {name: np.abs(estimate / exact - 1) for name, (exact, estimate) in elements.items()}
    slopes = {name: float(np.polyfit(np.log(size[6:16]), np.log(e[6:16]), 1)[0]) for name, e in errors.items()}
    first, facing, cosine, plain = errors
    figure = new_figure(10, 4.4)
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 1.25))
    view = figure.add_subplot(grid[0])
    _eighth_of_a_sphere(view)
    near, far = math.radians(42), math.radians(62)
    rim = _patch((near, far), (math.radians(50), math.radians(74)), nodes=21).T
    for corner in rim[:, ::21].T:
        _draw(view, np.stack([np.zeros(3), corner], axis=1), color=OURS, linewidth=1)
    for scale, alpha in ((1.0, 0.35), (0.35, 0.55)):
        view.fill(*_flat(scale * rim), color=OURS if scale == 1 else WARM, alpha=alpha, linewidth=0)
    _name(view, rim.mean(axis=1), "dS", color=INK)
    _name(view, 0.35 * _on_sphere(near - 0.25, math.radians(50)), "dω", color=WARM)
    axes = figure.add_subplot(grid[1])
    styles = ("o-", "s-", "^-", "v--")
    for (name, error), colour, style in zip(errors.items(), (*CYCLE[:3], FAINT), styles, strict=True):
        axes.loglog(size, np.maximum(error, 1e-16), style, color=colour, markersize=3.5, linewidth=1.2, label=name)
    axes.set_xlabel("side of the element / distance")
    axes.set_ylabel("relative error against the exact solid angle")
    axes.set_ylim(1e-9, 9)
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    clean(axes)
    left = float(errors[plain][-1])
    return ThesisFigure(
        id="1.2",
        title="Solid angle of a surface element",
        about="Exact: ΔΦ (cos θ₁ - cos θ₂) for an element of the sphere, and the triangle formula of Van Oosterom and Strackee "
        "(1983) for flat squares.",
        figure=figure,
        columns={"side / distance": size, **{f"error, {name}": error for name, error in errors.items()}},
        numbers={
            "order of the error on the sphere": slopes[first],
            "order, flat and facing": slopes[facing],
            "order, tilted with the cosine": slopes[cosine],
            "error left, tilted without it": left,
        },
        claims=(
            Claim(
                thesis="The solid angle of a small element of the sphere is its area over the squared distance (eq. 1.1).",
                outcome="confirmed" if errors[first][-1] < 1e-6 and abs(slopes[first] - 2) < 0.1 else "refuted",
                measured=f"The error falls as the side to the power {slopes[first]:.2f}, to {errors[first][-1]:.1g} at a "
                "thousandth of the distance.",
            ),
            Claim(
                thesis="The solid angle of an infinitesimal surface element, seen from a given point, is its area divided by "
                "the square of its distance.",
                outcome="confirmed" if left < 1e-2 else "corrected",
                measured="That holds if the element faces the point, as on a sphere about it. Tilted by 60° it is "
                f"{100 * left:.0f} % too large however small the element is, and right with the cosine of the tilt.",
            ),
        ),
    )


def _sphere_element(size: Array, theta: float) -> Array:
    """Solid angle between theta -+ size / 2 and azimuths `size` apart: ΔΦ (cos θ₁ - cos θ₂), without cancellation."""
    return np.asarray(size * 2 * math.sin(theta) * np.sin(size / 2), dtype=np.float64)


def _flat_element(size: Array, tilt: float) -> Array:
    """Solid angles of squares at distance 1, turned about a side's direction by `tilt`, as two triangles each."""
    solid = np.empty(size.size)
    for k, a in enumerate(size):
        across = a / 2 * np.array([math.cos(tilt), 0.0, math.sin(tilt)])
        up, centre = np.array([0.0, a / 2, 0.0]), np.array([0.0, 0.0, 1.0])
        corners = [centre + i * across + j * up for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        solid[k] = sum(_triangle(corners[0], corners[m], corners[m + 1]) for m in (1, 2))
    return solid


def _triangle(a: Array, b: Array, c: Array) -> float:
    """Solid angle of a triangle seen from the origin (Van Oosterom and Strackee 1983)."""
    la, lb, lc = (float(np.linalg.norm(v)) for v in (a, b, c))
    # The triple product by the edges, which small triangles do not cancel in.
    volume = abs(float(a @ np.cross(b - a, c - a)))
    return 2 * math.atan2(volume, la * lb * lc + float(a @ b) * lc + float(a @ c) * lb + float(b @ c) * la)


def neumann(seed: int) -> ThesisFigure:
    """Section 1.4: partial sums of the Neumann series, its convergence ratio, and the norm of T."""
    box = Box(size=_ROOM, cells=6)
    factors, emitted = box.form_factors(), box.on(_LAMP)
    rooms = {a: neumann_series(transport_operator(factors, a), emitted, _TERMS) for a in _ALBEDOS}
    # Energy conservation as eq. 1.9 has it allows an albedo of 1.
    white = _radius(transport_operator(factors, 1.0))
    open_box = Box(size=_ROOM, cells=6, open_faces=("y1",))
    open_white = _radius(transport_operator(open_box.form_factors(), 1.0))
    floor = box.on("z0") == 1
    figure = new_figure(12, 3.9)
    sums, errors, radii = figure.subplots(1, 3)
    count = np.arange(_TERMS + 1)
    columns: dict[str, Array] = {"reflections k": count.astype(np.float64)}
    for (rho, series), colour in zip(rooms.items(), CYCLE, strict=True):
        share = series.partial_sums[:, floor].mean(axis=1) / series.exact[floor].mean()
        sums.plot(count[:21], share[:21], "o-", color=colour, markersize=3, linewidth=1.2, label=f"albedo {rho:g}")
        errors.semilogy(count, np.maximum(series.errors, 1e-16), color=colour, linewidth=3, alpha=0.45)
        errors.semilogy(
            count, series.errors[10] * series.spectral_radius ** (count - 10.0), color=INK, linewidth=1.1, linestyle=":"
        )
        columns[f"share of the floor's light, albedo {rho:g}"] = share
        columns[f"largest relative error, albedo {rho:g}"] = series.errors
    sums.set_xlabel("reflections k")
    sums.set_ylabel("partial sum / (1 - T)⁻¹ Lₑ, on the floor")
    sums.legend(frameon=False, fontsize=9, loc="lower right")
    errors.set_xlabel("reflections k")
    errors.set_ylabel("largest error / largest radiance")
    errors.set_ylim(1e-14, 3)
    sums.set_title("What k reflections bring", fontsize=11)
    errors.set_title("What they lack; dotted: (spectral radius)ᵏ", fontsize=11)
    radii.set_title("Where the series has a sum", fontsize=11)
    sums.set_xticks(range(0, 21, 5))
    albedo = np.linspace(0, 1.2, 25)
    radii.plot(albedo, albedo * white, color=INK, label="closed room")
    radii.plot(albedo, albedo * open_white, color=OURS, label="one wall missing")
    radii.axhline(1, color=WARM, linewidth=1, linestyle="--")
    radii.text(0.02, 1.03, "beyond: no sum", color=WARM, fontsize=9)
    radii.set_xlabel("albedo of every wall")
    radii.set_ylabel("spectral radius of T")
    radii.legend(frameon=False, fontsize=9, loc="lower right")
    for axes in (sums, errors, radii):
        clean(axes)
    columns |= {
        "albedo": albedo,
        "spectral radius, closed": albedo * white,
        "spectral radius, open": albedo * open_white,
    }
    return ThesisFigure(
        id="1.4-neumann",
        title="The Neumann series of a room",
        about=f"A diffuse box of {_ROOM[0]:g} x {_ROOM[1]:g} x {_ROOM[2]:g} m, its ceiling the light, {box.face.size} patches "
        "with closed form factors. Partial sums of eq. 1.20 against the solution of eq. 1.21.",
        figure=figure,
        columns=columns,
        numbers={
            "rows of F sum to 1 within": float(np.abs(factors.sum(axis=1) - 1).max()),
            "ratio at albedo 0.8": rooms[0.8].ratio,
            "spectral radius at 0.8": rooms[0.8].spectral_radius,
            "norm of T at 0.8": rooms[0.8].largest_factor,
            "error after 40 reflections at 0.5": float(rooms[0.5].errors[-1]),
            "error after 40 reflections at 0.95": float(rooms[0.95].errors[-1]),
            "spectral radius of a white closed room": white,
            "of a white room with one wall missing": open_white,
        },
        claims=_series_claims(rooms, white, open_white),
    )


def _radius(operator: Array) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(operator))))


def _series_claims(rooms: dict[float, NeumannSeries], white: float, open_white: float) -> tuple[Claim, ...]:
    off = max(abs(series.ratio / series.spectral_radius - 1) for series in rooms.values())
    below = all(series.spectral_radius <= series.largest_factor * (1 + 1e-12) < 1 for series in rooms.values())
    return (
        Claim(
            thesis="The series L_e + T L_e + T² L_e + ... converges to (1 - T)⁻¹ L_e if |T| < 1 (eqs. 1.20, 1.21).",
            outcome="confirmed" if below and off < 0.02 else "refuted",
            measured=f"At albedos from {min(rooms):g} to {max(rooms):g} each further reflection leaves the share of the error "
            f"that the spectral radius of T says, to {100 * off:.2g} %. At {max(rooms):g} forty reflections still lack "
            f"{100 * rooms[max(rooms)].errors[-1]:.0f} %.",
        ),
        Claim(
            thesis="|T| < 1 is the case here, by conservation of energy.",
            outcome="confirmed" if white < 1 - 1e-9 else "corrected",
            measured=f"Energy conservation (eq. 1.9) allows walls that lose nothing, and in a closed room of them the spectral "
            f"radius is {white:.6f}: the series grows without end. Some light must be absorbed or leave; with one wall missing "
            f"it is {open_white:.3f}.",
        ),
    )


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {
    "1.1": spherical_coordinates,
    "1.2": solid_angle,
    "1.4-neumann": neumann,
}
