"""The thesis's hypotheses and its simplifications, each with the error that it makes in this scene's films.

Nothing here is rendered: every formula is evaluated beside the physical one-bounce model (`sketch`) and the films are
compared. Formulas without a scale of their own (G = 1, the cosine alone, the convolution) are compared after the best
global scale, which a blind solution cannot know anyway.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, AngleSumBRDF, AngleSumTable, Mirror
from wallmirror.geometry import incident_angles, outgoing_angles, wall_points
from wallmirror.planning.sketch import Sketch
from wallmirror.transport import Kernel, build_kernel, mirror_matrix, radiance, strip_factor

Array = NDArray[np.float64]

Key = Literal[
    "one bounce",
    "passive wall",
    "uniform wall",
    "isotropic source",
    "parallel camera",
    "far field",
    "convolution",
    "angle sum",
    "thin strips",
    "narrow strips",
    "pixels as points",
    "two dimensions",
    "cosine",
    "no weight",
    "one colour",
]


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One simplification and what it costs here.

    Parameters
    ----------
    key:
        Its name.
    label:
        Its number in the thesis, or its place; empty where it is ours.
    says:
        What is assumed, in a few words.
    error:
        Relative L2 error of the films; nan where it has no meaning for this wall.
    scaled:
        Whether the error is that after the best global scale.
    why:
        What the number rests on, in a few words.
    """

    key: Key
    label: str
    says: str
    error: float
    scaled: bool = False
    why: str = ""

    def holds(self, tolerance: float) -> bool:
        """Whether it costs no more than the tolerance by itself."""
        return self.error <= tolerance

    def summary(self, tolerance: float) -> dict[str, Any]:
        """The hypothesis as part of a JSON document."""
        return {
            "key": self.key,
            "label": self.label,
            "says": self.says,
            "holds": None if math.isnan(self.error) else self.holds(tolerance),
            "error": self.error if math.isfinite(self.error) else None,
            "after_best_scale": self.scaled,
            "why": self.why,
        }


def one_bounce_hypothesis(error: float, why: str) -> Hypothesis:
    """Hypothesis 2 with its measured cost."""
    return Hypothesis(key="one bounce", label="Hyp. 2", says="light reflected once is all light", error=error, why=why)


def simplifications(sketch: Sketch) -> tuple[Hypothesis, ...]:
    """Hypotheses 3 to 8 and the simplifications of the formula, with the error of each in this scene's films."""
    of_the_format = (
        Hypothesis(
            key="passive wall", label="Hyp. 3", says="the wall itself is dark", error=0.0, why="no scene can say else"
        ),
        Hypothesis(
            key="uniform wall",
            label="Hyp. 4",
            says="one BRDF all over the wall",
            error=0.0,
            why="no scene can say else",
        ),
        Hypothesis(
            key="isotropic source",
            label="Hyp. 5",
            says="strips look equally bright from everywhere",
            error=0.0,
            why="no scene can say else",
        ),
        Hypothesis(
            key="one colour",
            label="",
            says="mono instead of RGB",
            error=0.0,
            why="wall, card and room are grey, so the channels would be equal",
        ),
    )
    if sketch.kernel is None:
        assert isinstance(sketch.brdf, Mirror)
        return (*of_the_format, *_of_a_mirror(sketch, sketch.brdf))
    return (*of_the_format, *_of_the_geometry(sketch, sketch.kernel), *_of_the_weight(sketch, sketch.kernel))


def _of_a_mirror(sketch: Sketch, mirror: Mirror) -> tuple[Hypothesis, ...]:
    bare = mirror_matrix(sketch.observer, sketch.card, mirror, weights="thesis")
    return (
        Hypothesis(
            key="angle sum",
            label="Hyp. 8",
            says="the BRDF depends on theta_s + theta_o",
            error=0.0,
            why="a mirror does",
        ),
        Hypothesis(
            key="no weight",
            label="eq. 2.14",
            says="each element lights one pixel",
            error=sketch.error(bare, scaled=True),
            scaled=True,
        ),
    )


def _of_the_geometry(sketch: Sketch, kernel: Kernel) -> tuple[Hypothesis, ...]:
    """Hypotheses 6, 7 and 8."""
    return (
        Hypothesis(
            key="parallel camera",
            label="Hyp. 6",
            says="pixels see evenly spaced wall points",
            error=_parallel_camera(sketch),
            why="the views are turned",
        ),
        Hypothesis(
            key="far field",
            label="Hyp. 7",
            says="all elements share one cosine and distance",
            error=sketch.error(_far_field(sketch, kernel)),
        ),
        Hypothesis(
            key="convolution",
            label="eq. 3.7",
            says="the film is BRDF * mirror image",
            error=sketch.error(_convolution(sketch), scaled=True),
            scaled=True,
        ),
        Hypothesis(
            key="angle sum",
            label="Hyp. 8",
            says="the BRDF depends on theta_s + theta_o",
            error=sketch.error(_angle_sum(sketch.brdf, kernel)),
        ),
    )


def _of_the_weight(sketch: Sketch, kernel: Kernel) -> tuple[Hypothesis, ...]:
    """Points for strips and pixels, two dimensions, and the weights of Algorithm 1."""
    across, along = sketch.orders
    rows = [
        Hypothesis(
            key="pixels as points",
            label="",
            says="pixels see points, not footprints",
            error=sketch.error(sketch.with_kernel(orders=(1, along))),
        )
    ]
    if not sketch.card.is_points:
        rows += [
            Hypothesis(
                key="narrow strips",
                label="",
                says="strips are lines: no width",
                error=sketch.error(sketch.with_kernel(orders=(across, 1))),
            ),
            Hypothesis(
                key="thin strips",
                label="",
                says="strips are points: cos cos / r^2",
                error=sketch.error(sketch.with_kernel(orders=(across, 1), points=True)),
            ),
            Hypothesis(
                key="two dimensions",
                label="eq. 2.11",
                says="strips are endlessly tall",
                error=sketch.error(_tall(sketch, kernel)),
            ),
        ]
    for key, label, weights, says in (
        ("cosine", "Alg. 1", "cosine", "cos theta_s is all of the weight"),
        ("no weight", "eq. 4.8", "thesis", "no weight at all, G = 1"),
    ):
        transport = build_kernel(sketch.observer, sketch.card, weights=weights).apply(sketch.brdf)  # type: ignore[arg-type]
        error = sketch.error(transport, scaled=True)
        rows.append(Hypothesis(key=key, label=label, says=says, error=error, scaled=True))  # type: ignore[arg-type]
    return tuple(rows)


def _parallel_camera(sketch: Sketch) -> float:
    """What evenly spaced wall points between each view's ends change, with pixels and strips as points."""
    true = wall_points(sketch.observer)
    share = np.linspace(0.0, 1.0, true.shape[1])
    even = true[:, :1] + share * (true[:, -1:] - true[:, :1])
    films = [radiance(_points_at(sketch, x), sketch.source) for x in (even, true)]
    return relative_to(films[0] - films[1], films[1])


def relative_to(difference: Array, whole: Array) -> float:
    """|difference| / |whole| in the L2 norm; inf where the whole is dark."""
    norm = float(np.linalg.norm(whole))
    return float(np.linalg.norm(difference)) / norm if norm > 0 else math.inf


def _points_at(sketch: Sketch, wall_x: Array) -> Array:
    """F of points for strips, seen at given places on the wall (A', N), shape (A', N, M)."""
    theta_s = incident_angles(np.asarray(sketch.card.elements_x), sketch.card.distance, wall_x[..., None])
    theta_o = outgoing_angles(sketch.observer, wall_x)[..., None]
    return np.asarray(np.cos(theta_s) ** 4 * sketch.brdf(theta_s, np.broadcast_to(theta_o, theta_s.shape)))


def _far_field(sketch: Sketch, kernel: Kernel) -> Array:
    """F with the weight of an element in the card's middle for every element: Q(theta_o) of eq. 3.4."""
    middle = replace(sketch.card, elements_x=(sketch.card.middle,))
    common = build_kernel(sketch.observer, middle, orders=sketch.orders).weight
    return replace(kernel, weight=np.broadcast_to(common, kernel.weight.shape)).apply(sketch.brdf)


def _convolution(sketch: Sketch) -> Array:
    """F of eq. 3.7: the BRDF, laid out on the wall by theta_o, about the place where a mirror shows the element."""
    observer, card = sketch.observer, sketch.card
    y_o, z, x_o = observer.distance, card.distance, observer.position[0]
    image = (np.asarray(card.elements_x) * y_o + x_o * z) / (y_o + z)
    x = wall_points(observer)[..., None]
    middle = np.cos(incident_angles(card.middle, z, x)) ** 4
    zero = np.zeros((*x.shape[:2], card.elements))
    return np.asarray(middle * sketch.brdf(zero, np.arctan2(image - x, y_o)))


def _angle_sum(brdf: BRDF, kernel: Kernel) -> Array:
    """F of the BRDF of the angle sum that is nearest in the mean over the kernel's angles, in cells of its own scale."""
    if isinstance(brdf, AngleSumBRDF):
        return kernel.apply(brdf)
    u = kernel.angle_sum
    rho = np.broadcast_to(brdf(kernel.theta_s, kernel.theta_o), u.shape)
    cells = max(2, math.ceil(float(np.ptp(u)) / (brdf.angular_scale / 4)))
    place = np.clip(((u - u.min()) / max(float(np.ptp(u)), 1e-300) * cells).astype(np.intp), 0, cells - 1)
    total = np.bincount(place.ravel(), weights=rho.ravel(), minlength=cells)
    count = np.bincount(place.ravel(), minlength=cells)
    mean = total / np.maximum(count, 1)
    return np.asarray(np.sum(kernel.weight * mean[place], axis=-1))


def _tall(sketch: Sketch, kernel: Kernel) -> Array:
    """F of eq. 2.11, pi/2 int rho cos theta_s d theta_s: strips without end, the physical kernel at its limit."""
    z, half = sketch.card.distance, sketch.card.element_height / 2
    limit = math.pi / 2 * np.cos(kernel.theta_s) ** 3 / z
    share = limit / strip_factor(z, z * np.tan(kernel.theta_s), -half, half)
    return replace(kernel, weight=kernel.weight * share).apply(sketch.brdf)


def table_error(sketch: Sketch, nodes: int) -> float:
    """Relative L2 error of the films with the BRDF tabulated on `nodes` angle sums over [-pi, pi], linear in between."""
    if sketch.kernel is None or not isinstance(sketch.brdf, AngleSumBRDF):
        return 0.0
    # Float64 as it is: rounding to float32 makes 3e-8, which no film would show.
    u = np.linspace(-math.pi, math.pi, nodes)
    return stand_in_error(sketch, AngleSumTable(start=-math.pi, stop=math.pi, values=sketch.brdf.of_sum(u)))


def stand_in_error(sketch: Sketch, brdf: BRDF) -> float:
    """Relative L2 error of the films with another BRDF in the place of the scene's."""
    return 0.0 if sketch.kernel is None else sketch.error(sketch.kernel.apply(brdf))
