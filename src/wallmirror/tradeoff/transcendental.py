"""Is the physical model as quick as NumPy lets it be: its seconds over those of its transcendental functions alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wallmirror.brdf import GaussianTrain
from wallmirror.geometry import incident_angles, outgoing_angles, wall_points
from wallmirror.scene import load_scene
from wallmirror.tradeoff.runs import Statement
from wallmirror.transport import transport_matrix

#: Times the seconds of the needed transcendental functions alone that the physical model may take.
ASKED_TRANSCENDENTAL = 3.0


def transcendental_ratio(*, repeats: int = 9) -> tuple[float, float, int]:
    """Seconds of the physical model over those of its transcendental functions alone, in pairs.

    The functions are those that its formulas name, once a node: an exp for each lobe, arctan of theta_s, and of the strip's
    mean a square root and two arctan2; on the arguments that they have there, in place, and in blocks of the same size.

    Returns
    -------
    Median ratio, half the distance of its quartiles, and the number of nodes.
    """
    scene = load_scene("flat_wall_lobes")
    observer, card = scene.observer, scene.card
    brdf = scene.wall.brdf
    assert isinstance(brdf, GaussianTrain)
    orders = (2, 6)
    nodes = observer.views * observer.pixels * card.elements * orders[0] * orders[1]
    # One block: as many pixels as `transport_matrix` takes at a time.
    some = replace(observer, view_angles=observer.view_angles[:8])
    wall_x = wall_points(some)
    slope = (np.asarray(card.elements_x)[:, None, None] - wall_x) / card.distance
    u = incident_angles(np.asarray(card.elements_x)[:, None, None], card.distance, wall_x) + outgoing_angles(
        some, wall_x
    )
    square = 1 + slope * slope
    ends = [np.sqrt(square) * (length / card.distance) for length in (0.01, card.element_height)]
    exponents = [np.maximum(-0.5 * ((u - centre) / brdf.sigma) ** 2, -703.0) for centre in brdf.centres]
    out = np.empty_like(slope)
    blocks = nodes / slope.size

    def functions() -> None:
        np.arctan(slope, out=out)
        np.sqrt(square, out=out)
        for end in ends:
            np.arctan2(end, square, out=out)
        for exponent in exponents:
            np.exp(exponent, out=out)

    def seconds(work: Callable[[], object], times: int) -> float:
        started = time.process_time()
        for _ in range(times):
            work()
        return (time.process_time() - started) / times

    ratios = []
    for _ in range(repeats + 1):
        model = seconds(lambda: transport_matrix(observer, card, brdf, orders=orders), 3)
        ratios.append(model / (blocks * seconds(functions, max(3, round(2 * blocks)))))
    low, middle, high = np.quantile(ratios[1:], [0.25, 0.5, 0.75])
    return float(middle), float(high - low) / 2, nodes


def of_ratio(ratio: float, spread: float, nodes: int) -> Statement:
    """Whether the model is as quick as its transcendental functions let it be."""
    return Statement(
        f"The physical model takes {ratio:.2f} ± {spread:.2f} times as long as its transcendental functions alone would in "
        f"NumPy, over {nodes:,} nodes (asked: {ASKED_TRANSCENDENTAL:g} times).",
        ratio <= ASKED_TRANSCENDENTAL,
    )
