"""Section 2.1: the geometrical configuration in space and in the plane (Figs. 2.1, 2.8, 2.9), with eqs. 2.2 to 2.5."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc
from numpy.typing import NDArray

from wallmirror.convolution.spherical import scene_angles
from wallmirror.geometry import Card, Observer, wall_points
from wallmirror.report.figures import scene_plan
from wallmirror.report.style import CYCLE, FAINT, INK, OURS, WARM, new_figure
from wallmirror.thesis.figure import Claim, ThesisFigure

Array = NDArray[np.float64]

_NORMAL = np.array([0.0, -1.0, 0.0])
_OBSERVER = np.array([0.0, -5.0, 0.0])
_SOURCE = np.array([2.4, -3.0, 1.2])  # a point of the card in Fig. 2.1
_WALL = np.array([-1.5, 0.0, 0.8])


def in_space(seed: int) -> ThesisFigure:
    """Fig. 2.1: a wall point, the directions to observer and source, and their angles to the normal."""
    to_observer, to_source = _unit(_OBSERVER - _WALL), _unit(_SOURCE - _WALL)
    recovered = _OBSERVER - to_observer * abs(_OBSERVER[1]) / (to_observer @ _NORMAL)  # eq. 2.4
    source = _WALL + to_source * abs(_SOURCE[1]) / (to_source @ _NORMAL)  # eq. 2.5
    off = max(float(np.max(np.abs(recovered - _WALL))), float(np.max(np.abs(source - _SOURCE))))
    # The normal as the text writes it, (x, -1, z) of the wall point.
    written = np.array([_WALL[0], -1.0, _WALL[2]])
    tilt = math.degrees(math.acos(_unit(written) @ _NORMAL))
    figure = new_figure(6.6, 4.6)
    axes = figure.add_subplot(projection="3d")
    # Drawn as (x, y, z) with the wall at the back and z up.
    edge = np.array([[-4, 0, -2], [4, 0, -2], [4, 0, 2.6], [-4, 0, 2.6], [-4, 0, -2]], dtype=np.float64)
    axes.plot(*edge.T, color=INK, linewidth=1.2)
    card = _SOURCE + np.array([[-0.6, 0, -0.9], [0.6, 0, -0.9], [0.6, 0, 0.9], [-0.6, 0, 0.9], [-0.6, 0, -0.9]])
    axes.plot(*card.T, color=WARM, linewidth=1.2)
    for start, end, colour, name in (
        (_WALL, _WALL + 2.4 * _NORMAL, INK, "n"),
        (_WALL, _OBSERVER, OURS, r"$\omega_o$"),
        (_WALL, _SOURCE, WARM, r"$\omega_s$"),
    ):
        axes.plot(*np.array([start, end]).T, color=colour, linewidth=1.4)
        axes.text(*(0.55 * end + 0.45 * start + np.array([0.15, 0, 0.2])), name, color=colour, fontsize=11)
    for point, name, colour in ((_WALL, "w", INK), (_OBSERVER, "observer o", OURS), (_SOURCE, "source s", WARM)):
        axes.scatter(*point, color=colour, s=26)
        axes.text(*(point + np.array([0.0, 0, 0.3 if name == "w" else -0.6])), name, color=colour, fontsize=10)
    axes.text(2.6, 0, 2.75, "wall", color=INK, fontsize=10)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_zlabel("z (m)")
    axes.view_init(elev=24, azim=-62)
    axes.set_box_aspect((8, 5, 4.6), zoom=1.15)
    axes.tick_params(labelsize=8)
    return ThesisFigure(
        id="2.1",
        title="Geometrical configuration",
        about="A wall point w, seen by the observer at (0, -5, 0), and a point of the source. y_o and y_s of eqs. 2.4 and 2.5 "
        "are distances from the wall.",
        figure=figure,
        columns={
            "observer o (m)": _OBSERVER,
            "wall point w (m)": _WALL,
            "source point s (m)": _SOURCE,
            "omega_o": to_observer,
            "omega_s": to_source,
        },
        numbers={
            "theta_o (deg)": math.degrees(math.acos(to_observer @ _NORMAL)),
            "theta_s (deg)": math.degrees(math.acos(to_source @ _NORMAL)),
            "w and s from eqs. 2.4 and 2.5, off by (m)": off,
            "(x, -1, z) off the normal (deg)": tilt,
        },
        claims=(
            Claim(
                thesis="A direction towards the observer and the wall's normal determine the wall point, and with y_s the "
                "source point (eqs. 2.4, 2.5).",
                outcome="confirmed" if off < 1e-12 else "refuted",
                measured=f"Both points come back to {off:.1g} m.",
            ),
            Claim(
                thesis="The wall's normal is (x, -1, z).",
                outcome="confirmed" if tilt < 1e-6 else "corrected",
                measured=f"That is the tip of the normal drawn from the wall point. As a vector it would be {tilt:.0f}° off "
                "for this one; eqs. 2.3 to 2.5 need the unit vector (0, -1, 0).",
            ),
        ),
    )


def in_the_plane(seed: int) -> ThesisFigure:
    """Fig. 2.8: the same from above, with the signed angles."""
    observer = _observer(5)
    card = Card(elements_x=tuple(float(x) for x in np.linspace(1.5, 3.5, 41)), y=-3.0)
    return _plan("2.8", "Geometrical configuration in the plane", observer, card, chosen=1, shown=(20,))


def discrete(seed: int) -> ThesisFigure:
    """Fig. 2.9: the wall as N points and the source as M."""
    card = Card(elements_x=tuple(float(x) for x in np.linspace(1.5, 3.5, 4)), y=-3.0)
    return _plan(
        "2.9", "Geometrical configuration in the plane, discrete", _observer(9), card, chosen=2, shown=(0, 1, 2, 3)
    )


def _observer(pixels: int) -> Observer:
    return Observer(position=(0.0, -5.0), fov=math.radians(90), view_angles=(0.0,), pixels=pixels, pixels_at="edges")


def _plan(
    number: str, title: str, observer: Observer, card: Card, *, chosen: int, shown: tuple[int, ...]
) -> ThesisFigure:
    x = wall_points(observer)[0]
    theta_s, theta_o = (angles[0] for angles in scene_angles(observer, card))
    w = float(x[chosen])
    figure: Figure = scene_plan(observer, card, half_width=6.0)
    (axes,) = figure.axes
    if number == "2.9":
        axes.scatter(x, np.zeros(x.size), color=INK, s=22, zorder=4)
    axes.plot([w, w], [0, -1.9], color=INK, linewidth=1.2)
    axes.annotate("normal", (w, -1.9), (-4, -12), textcoords="offset points", fontsize=9, color=INK, ha="center")
    axes.plot([w, observer.position[0]], [0, observer.position[1]], color=OURS, linewidth=1.4)
    for element in shown:
        axes.plot([w, card.elements_x[element]], [0, card.y], color=WARM, linewidth=1.2)
    axes.scatter([w], [0], color=INK, s=36, zorder=5)
    axes.annotate("w", (w, 0), (-10, -12), textcoords="offset points", fontsize=10, color=INK)
    _arc(axes, (w, 0.0), 1.1, -90.0, float(np.degrees(theta_o[chosen])), OURS, "θo")
    element = shown[len(shown) // 2]
    _arc(axes, (w, 0.0), 1.6, -90.0, float(np.degrees(theta_s[chosen, element])), WARM, "θs", along=0.75)
    axes.plot([0, 0], [observer.position[1], observer.position[1] + 1.9], color=FAINT, linewidth=1.0, linestyle=":")
    half = math.degrees(observer.fov / 2)
    for side, name in ((-1, "α₁"), (1, "αₙ")):  # positive angles look towards -x (eq. 2.13)
        _arc(axes, observer.position, 1.2, 90.0, side * half, CYCLE[2], name, along=0.9)
    specular = float(np.max(np.abs(_unsigned(observer, card, x) - np.abs(theta_o))))
    ends = -observer.position[1] * math.tan(observer.fov / 2)
    return ThesisFigure(
        id=number,
        title=title,
        about="From above, to scale: the observer at (0, -5) with a field of 90°, the source parallel to the wall 3 m away. "
        "Angles are signed from the normal, towards +x positive, so that a mirror has θs + θo = 0.",
        figure=figure,
        columns={
            "wall points (m)": x,
            "theta_o (rad)": theta_o,
            "source points (m)": card.elements_x,
            "theta_s at the wall point w (rad)": theta_s[chosen],
        },
        numbers={
            "wall point w (m)": w,
            "theta_o at w (deg)": float(np.degrees(theta_o[chosen])),
            "theta_s at w (deg)": float(np.degrees(theta_s[chosen, element])),
            "end of the view (m)": float(x[-1]),
            "|theta_o| against eq. 2.3, off by (rad)": specular,
        },
        claims=(
            Claim(
                thesis="The view ends at y_o tan(alpha) on the wall (eq. 2.13).",
                outcome="confirmed" if max(abs(x[-1] - ends), abs(x[0] + ends)) < 1e-12 else "refuted",
                measured=f"It covers {x[0]:.4g} to {x[-1]:.4g} m; y_o tan 45° is {ends:.4g} m.",
            ),
        ),
    )


def _unsigned(observer: Observer, card: Card, x: Array) -> Array:
    """Angle between normal and direction to the observer from their dot product (eqs. 2.2, 2.3), in radians."""
    towards = np.stack([observer.position[0] - x, np.full(x.size, observer.position[1])])
    towards /= np.linalg.norm(towards, axis=0)
    return np.asarray(np.arccos(np.clip(_NORMAL[:2] @ towards, -1.0, 1.0)), dtype=np.float64)


def _arc(
    axes: Axes,
    centre: tuple[float, float],
    radius: float,
    from_deg: float,
    turn: float,
    colour: str,
    name: str,
    *,
    along: float = 0.5,
) -> None:
    """An angle of `turn` degrees, positive towards +x, between a vertical and a ray, with its name a part `along` it."""
    to = from_deg + (turn if from_deg < 0 else -turn)
    low, high = sorted((from_deg, to))
    axes.add_patch(Arc(centre, 2 * radius, 2 * radius, theta1=low, theta2=high, color=colour, linewidth=1.4))
    middle = math.radians((1 - along) * from_deg + along * to)
    place = (centre[0] + 1.22 * radius * math.cos(middle), centre[1] + 1.22 * radius * math.sin(middle))
    axes.annotate(name, place, ha="center", va="center", fontsize=10, color=colour)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"2.1": in_space, "2.8": in_the_plane, "2.9": discrete}
