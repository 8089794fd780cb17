"""The study of the thesis's simplifications: its two limits, and how far off the formulas are elsewhere."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest

from wallmirror.transport import strip_factor

_PATH = Path(__file__).parents[2] / "validation" / "simplifications.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("simplifications", _PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def error(study, model, wall="diffuse", **lengths):
    observer, card = study.scene(**{**study.USUAL, **lengths})
    brdf = study.WALLS[wall]
    return study.relative_error(study.simplified(model, observer, card, brdf), study.physical(observer, card, brdf))


def test_small_strips_are_points_to_second_order(study):
    errors = [error(study, "points", width=w, height=w) for w in (0.04, 0.02)]
    # Strip and point differ by a multiple of the area: half the size, a quarter of the error.
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)
    assert errors[1] < 2e-4
    # The twin: cos theta_l / r^2 is needed for the limit, the cosine alone stays off however small the strip.
    observer, card = study.scene(width=0.001, height=0.001, distance=1.0)
    truth = study.physical(observer, card, study.WALLS["diffuse"])
    assert study.shape_error(study.simplified("cosine", observer, card, study.WALLS["diffuse"]), truth) > 0.1


@pytest.mark.parametrize("wall", ["diffuse", "lobes"])
def test_tall_strips_are_two_dimensional_to_third_order(study, wall):
    errors = [error(study, "tall", wall, height=h) for h in (200.0, 400.0)]
    # What is missing falls with (offset / half-height)^3.
    assert errors[0] / errors[1] == pytest.approx(8.0, rel=0.02)
    assert errors[1] < 1e-6
    assert error(study, "tall", wall, height=1.0) > 0.5


def test_the_limits_at_one_point_are_those_of_the_closed_form(study):
    for half, found in study.limits().items():
        a = float(half)
        # z = a = 1: the whole integral over height is h / (1 + h^2) + atan h, against pi / 2.
        truth = a / (1 + a * a) + math.atan(a)
        assert float(strip_factor(1.0, 0.0, -a, a)) == pytest.approx(truth, rel=1e-14)
        assert found["of_the_truth"] == pytest.approx(math.pi / 2 / truth - 1, rel=1e-9)
