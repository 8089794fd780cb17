"""What several test modules share: the thesis's scene, small scenes, and the check of a refusal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import settings
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF, GaussianTrain
from wallmirror.derendering.moments import moments
from wallmirror.derendering.span import Span
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import SignalSpace
from wallmirror.errors import InputError, UndeterminedError, WallmirrorError
from wallmirror.geometry import Card, Observer, PixelPlacement, scan_angles

Array = NDArray[np.float64]

EPS = float(np.finfo(np.float64).eps)

#: Hypothesis that tries the same examples on every machine, whatever its speed.
same_examples = settings(derandomize=True, database=None, deadline=None, max_examples=100)


def thesis_observer(pixels: int = 500, views: int = 20, pixels_at: PixelPlacement = "edges") -> Observer:
    """The thesis's camera: at (0, -5), field 60 deg, scan 90 deg, samples from edge to edge."""
    return Observer(
        position=(0.0, -5.0),
        fov=math.radians(60),
        view_angles=scan_angles(views, scan=math.radians(90), fov=math.radians(60)),
        pixels=pixels,
        pixels_at=pixels_at,
    )


def thesis_card(elements: int = 4, y: float = -1.0, width: float = 0.0) -> Card:
    """The thesis's source: M points (or square strips of the given width) spread over five metres."""
    places = np.linspace(-2.5, 2.5, elements) if elements > 1 else np.zeros(1)
    return Card(elements_x=tuple(map(float, places)), y=y, element_width=width, element_height=width)


def lobes(*centres_deg: float, sigma_deg: float = 1.0) -> GaussianTrain:
    """A train of lobes of height 1; the thesis's four when no centre is given."""
    centres = centres_deg or (-35.0, -15.0, 15.0, 35.0)
    return GaussianTrain(centres=tuple(map(math.radians, centres)), sigma=math.radians(sigma_deg))


class SplineBRDF(AngleSumBRDF):
    """A reflectance that is one of the solver's splines, so that the solver's model holds exactly."""

    def __init__(self, grid: SplineGrid, coefficients: Array) -> None:
        self.grid, self.coefficients = grid, coefficients

    def of_sum(self, u: Any) -> Array:
        return self.grid.evaluate(self.coefficients, u)


def refused(call: Callable[[], object]) -> InputError:
    """The InputError that a call raises, after checking that it is one sentence with exit code 2."""
    with pytest.raises(InputError) as caught:
        call()
    _check_sentence(caught.value, exit_code=2)
    return caught.value


def assert_undetermined(call: Callable[[], object]) -> str:
    """The sentence of the UndeterminedError that a call raises, exit code 3."""
    with pytest.raises(UndeterminedError) as caught:
        call()
    _check_sentence(caught.value, exit_code=3)
    return str(caught.value)


def _check_sentence(error: WallmirrorError, *, exit_code: int) -> None:
    text = str(error)
    assert error.exit_code == exit_code
    assert text
    assert "\n" not in text
    assert "Traceback" not in text
    assert "array(" not in text
    assert "np." not in text


def up_to_scale(estimate: Array, truth: Array) -> float:
    """Relative Frobenius error after the best global scale, safe for values of any size."""
    e, t = estimate / np.max(np.abs(estimate)), truth / np.max(np.abs(truth))
    return float(np.linalg.norm(e * (np.sum(e * t) / np.sum(e * e)) - t) / np.linalg.norm(t))


def far_apart() -> tuple[Observer, Card]:
    """Two elements 250 m apart at 50 m: their angle sums have no value in common, so each has a scale of its own."""
    return thesis_observer(), Card(elements_x=(-125.0, 125.0), y=-50.0)


def space_within(data: Array, designs: list[sp.csr_array], elements: int, *, noise: float | None) -> SignalSpace:
    """U from the films' projection onto the span of their designs, see `Span`."""
    projected = Span.of(moments(data, designs), data.shape[0]).projected(elements, noise=noise)
    return projected.space(designs, np.ones((data.shape[0], 1)), sp.eye_array(designs[0].shape[1], format="csr"))
