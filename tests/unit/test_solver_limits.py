"""The far ends of what one may film: each is solved, doubted or refused, and never answered with confidence and wrongly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF
from wallmirror.captures import CaptureSet
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.solve import solve
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import Card, Observer
from wallmirror.transport import radiance, transport_matrix

from .helpers import assert_undetermined, lobes, refused, thesis_card, thesis_observer

Array = NDArray[np.float64]


class Box(AngleSumBRDF):
    """Reflects everything within 30 deg of the mirror direction alike, and nothing beyond: no spline follows its edges."""

    def of_sum(self, u: Any) -> Array:
        return np.where(np.abs(np.asarray(u)) < math.radians(30), 1.0, 0.0)


def patterns(elements: int, realisations: int = 20) -> Array:
    return np.random.default_rng(0).random((elements, realisations))


def answered(
    brdf: AngleSumBRDF, *, observer: Observer | None = None, card: Card | None = None
) -> tuple[Solution | None, float]:
    """The solution of noiseless films with its true error, or None where it is refused."""
    observer, card = observer or thesis_observer(), card or thesis_card()
    source = patterns(card.elements)
    films = radiance(transport_matrix(observer, card, brdf, weights="cosine"), source)
    captures = CaptureSet(observer=observer, card=card, transport="cosine", radiance=films)
    try:
        found = solve(captures)
    except UndeterminedError:
        return None, math.inf
    return found, scale_free_error(found.source, source)


def honest(found: Solution | None, error: float) -> bool:
    """Refused, doubted, or within five of the error bars and rounding."""
    return found is None or found.verdict == "doubtful" or error <= 5 * found.predicted_error + 1e-6


# Pixels stand .1 deg apart: lobes of .03 deg are seen by a few of them in each view, those of .01 deg by hardly one.
@pytest.mark.parametrize(("sigma_deg", "most"), [(0.1, 1e-6), (0.03, 1e-3), (0.01, math.inf)])
def test_lobes_as_narrow_as_the_pixels_are_a_limit_that_is_told(sigma_deg: float, most: float) -> None:
    observer = thesis_observer(views=20 if sigma_deg > 0.01 else 4)
    found, error = answered(lobes(sigma_deg=sigma_deg), observer=observer)
    assert honest(found, error)
    assert error < most or most == math.inf


def test_a_card_that_touches_the_wall_is_a_limit_that_is_told() -> None:
    found, error = answered(lobes(), card=thesis_card(y=-0.01))
    assert honest(found, error)


def test_edges_that_no_spline_follows_show_in_the_error_bars() -> None:
    found, error = answered(Box())
    assert found is not None
    assert honest(found, error)
    assert error < 1e-3  # splines of a third degree were seen to reach 6e-4


def test_views_along_the_wall_are_fine_up_to_the_horizon_and_refused_beyond() -> None:
    def along(edge_deg: float) -> Observer:
        half = math.radians(30)
        views = tuple(np.linspace(-1, 1, 10) * (math.radians(edge_deg) - half))
        return Observer(position=(0.0, -5.0), fov=2 * half, view_angles=views, pixels=300, pixels_at="edges")

    found, error = answered(lobes(sigma_deg=4.0), observer=along(89.9))
    assert found is not None
    assert found.verdict == "good"
    assert error < 1e-8
    assert "90" in str(refused(lambda: along(90.0)))


def test_one_element_is_a_profile_and_a_list_of_levels() -> None:
    # Rank one, and every pixel's value of rho is read off: only its scale is free.
    found, error = answered(lobes(sigma_deg=5.0), observer=thesis_observer(100, 4), card=thesis_card(1))
    assert found is not None
    assert honest(found, error)
    assert error < 1e-6


@pytest.mark.parametrize(("pixels", "views"), [(2, 1), (2, 2)])
def test_the_smallest_scenes_are_refused(pixels: int, views: int) -> None:
    observer, card = thesis_observer(pixels, views), thesis_card(2)
    films = radiance(transport_matrix(observer, card, lobes(sigma_deg=5.0)), patterns(2, 2))
    captures = CaptureSet(observer=observer, card=card, radiance=films)
    assert_undetermined(lambda: solve(captures))
