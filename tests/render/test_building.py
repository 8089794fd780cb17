"""What Mitsuba is told: the geometry that rays meet, the camera's directions, the BRDF held, the XML file."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wallmirror.brdf import (
    BRDF,
    AngleSumTable,
    CookTorrance,
    Diffuse,
    GaussianTrain,
    Mirror,
    Phong,
    Table,
    tables,
)
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, pixel_tangents, wall_points
from wallmirror.pathtracing import building, cameras
from wallmirror.scene import Room, Scene, Wall, load_scene

#: Float32 carries lengths of up to 20 m and unit vectors through half a dozen operations.
CLOSE = 1e-5


def scene(brdf: BRDF | None = None, *, room: Room | None = None, **card: Any) -> Scene:
    observer = Observer(
        position=(0.7, -4.0), fov=math.radians(50), view_angles=(math.radians(20), math.radians(-30)), pixels=16
    )
    settings = {"elements_x": (-0.8, 0.1, 1.2), "y": -1.5, "element_width": 0.2, "element_height": 0.3, **card}
    return Scene(
        name="test",
        title="",
        about="",
        observer=observer,
        card=Card(**settings),
        wall=Wall(brdf=brdf or Diffuse(albedo=0.5)),
        source=np.ones((len(settings["elements_x"]), 1)),
        room=room,
    )


def load(mi: Any, scene: Scene, view: int | None = None) -> Any:
    return mi.load_dict(building.mitsuba_dict(scene, view), optimize=False)


def hit(mi: Any, loaded: Any, origin: tuple[float, ...], direction: tuple[float, ...]) -> Any:
    return loaded.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))


def numbers(vector: Any) -> np.ndarray:
    return np.array(vector).ravel()


@pytest.mark.parametrize("view", [0, 1])
def test_pixels_look_where_geometry_says(mi: Any, view: int) -> None:
    """Through the centre of every pixel: x on the wall as `wall_points` has it, growing with the pixel."""
    case = scene()
    sensor = mi.load_dict(cameras.sensor_dict(case, view))
    places = (np.arange(16) + 0.5) / 16
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(mi.Float(places), 0.5), mi.Point2f(0.5))
    d = np.array(ray.d).reshape(3, -1)
    angle = case.observer.view_angles[view] - np.arctan(pixel_tangents(case.observer))
    np.testing.assert_allclose(d, [-np.sin(angle), np.cos(angle), 0 * angle], atol=1e-6)
    x = case.observer.position[0] + case.observer.distance * d[0] / d[1]
    np.testing.assert_allclose(x, wall_points(case.observer)[view], rtol=CLOSE)
    assert np.all(np.diff(x) > 0)


def test_pixels_are_square(mi: Any) -> None:
    sensor = mi.load_dict(cameras.sensor_dict(scene(), 0))
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5, mi.Float([0.0, 1.0])), mi.Point2f(0.5))
    d = np.array(ray.d).reshape(3, -1)
    up = d[2] / np.hypot(d[0], d[1])
    np.testing.assert_allclose(up, np.tan(math.radians(25)) / 16 * np.array([1, -1]), rtol=CLOSE)


def test_wall_frame_carries_our_signed_angle(mi: Any) -> None:
    """atan2(w.x, w.z) of the shading frame is atan2(dx, -dy): s = +x, t = +z, n = -y, and no mirroring."""
    si = hit(mi, load(mi, scene()), (3.0, -2.0, 0.0), (-0.6, 0.8, 0.0))
    np.testing.assert_allclose(numbers(si.p), [1.5, 0.0, 0.0], atol=CLOSE)
    frame = si.sh_frame
    np.testing.assert_allclose([numbers(v) for v in (frame.s, frame.t, frame.n)], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    wi = numbers(si.wi)
    assert math.atan2(wi[0], wi[2]) == pytest.approx(math.atan2(1.5, 2.0), abs=1e-6)


def test_strips_shine_at_the_wall_only(mi: Any) -> None:
    case = scene(albedo=0.3)
    loaded = load(mi, case)
    for x in case.card.elements_x:
        front = hit(mi, loaded, (x, -0.5, 0.1), (0.0, -1.0, 0.0))
        assert float(front.t[0]) == pytest.approx(1.0, rel=CLOSE)
        np.testing.assert_allclose(numbers(front.sh_frame.n), [0, 1, 0])
        back = hit(mi, loaded, (x, -2.5, 0.1), (0.0, 1.0, 0.0))
        shine = [float(s.emitter(loaded).eval(s)[0][0]) for s in (front, back)]
        assert shine == [1.0, 0.0]
    # Just inside and just outside of a strip's corner.
    for x, z, there in ((1.299, 0.149, True), (1.301, 0.149, False), (1.299, 0.151, False)):
        assert bool(hit(mi, loaded, (x, -0.5, z), (0.0, -1.0, 0.0)).is_valid()[0]) is there


def test_board_stands_dark_behind_the_strips(mi: Any) -> None:
    loaded = load(mi, scene(albedo=0.3, board_width=3.0, board_height=1.0))
    si = hit(mi, loaded, (0.6, -0.5, 0.0), (0.0, -1.0, 0.0))
    assert float(si.t[0]) == pytest.approx(1.0 + 1.5e-3, rel=CLOSE)
    assert float(si.emitter(loaded).eval(si)[0][0]) == 0
    np.testing.assert_allclose(numbers(si.sh_frame.n), [0, 1, 0])


def test_room_faces_inwards_and_is_open_behind(mi: Any) -> None:
    loaded = load(mi, scene(room=Room(half_width=3.0, half_height=2.0, depth=6.0, albedo=0.8)))
    for direction, distance in (((1, 0, 0), 3.0), ((-1, 0, 0), 3.0), ((0, 0, 1), 2.0), ((0, 0, -1), 2.0)):
        si = hit(mi, loaded, (0.0, -3.0, 0.0), direction)
        assert float(si.t[0]) == pytest.approx(distance, rel=CLOSE)
        np.testing.assert_allclose(numbers(si.sh_frame.n), -np.array(direction), atol=CLOSE)
    assert not hit(mi, loaded, (0.0, -3.0, 0.0), (0.0, -1.0, 0.0)).is_valid()[0]


def test_the_wall_as_rendered_is_what_the_plugin_holds(mi: Any) -> None:
    lobes = GaussianTrain(centres=(0.2,), sigma=0.05)
    rendered = building.wall_as_rendered(scene(lobes))
    assert isinstance(rendered, AngleSumTable)
    assert rendered.angular_scale == 0.05
    held = mi.traverse(load(mi, scene(lobes)))["wall.bsdf.table"]
    np.testing.assert_array_equal(np.array(held), rendered.values)

    facets = CookTorrance(alpha=0.3)
    rendered = building.wall_as_rendered(scene(facets))
    assert isinstance(rendered, building.RenderedGrid)
    assert rendered.angular_scale == facets.angular_scale
    held = mi.traverse(load(mi, scene(facets)))["wall.bsdf.table"]
    np.testing.assert_array_equal(np.array(held), rendered.values)

    grid = Table(values=np.arange(12.0).reshape(3, 4) / 7)
    rendered = building.wall_as_rendered(scene(grid))
    assert isinstance(rendered, Table)
    held = mi.traverse(load(mi, scene(grid)))["wall.bsdf.table"]
    np.testing.assert_array_equal(np.array(held), rendered.values)


def test_the_wall_as_rendered_keeps_what_can_be_kept() -> None:
    assert building.wall_as_rendered(scene(Diffuse(albedo=0.5))) == Diffuse(albedo=0.5)
    assert building.wall_as_rendered(scene(Mirror(reflectance=0.7))) == Mirror(reflectance=float(np.float32(0.7)))
    own = AngleSumTable(start=-math.pi, stop=math.pi, values=np.linspace(0, 1, 9))
    rendered = building.wall_as_rendered(scene(own))
    assert isinstance(rendered, AngleSumTable)
    np.testing.assert_array_equal(rendered.values, own.values.astype(np.float32))
    # Nodes over another range have to be sampled anew, as smooth models are.
    narrow = building.wall_as_rendered(scene(AngleSumTable(start=-1.0, stop=1.0, values=np.ones(5))))
    phong = building.wall_as_rendered(scene(Phong(exponent=20.0)))
    for table in (narrow, phong):
        assert isinstance(table, AngleSumTable)
        assert table.values.size == 7201
    sharp = building.wall_as_rendered(scene(GaussianTrain(centres=(0.0,), sigma=math.radians(0.1))))
    assert isinstance(sharp, AngleSumTable)
    assert sharp.values.size == 72001
    with pytest.raises(InputError, match=r"wall\.brdf.*BRDF cannot be rendered"):
        building.wall_as_rendered(scene(BRDF()))


def test_a_narrow_lobe_of_both_angles_gets_a_coarser_table_rather_than_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "MOST_ANGLE_NODES", 600)  # 2881 take seconds
    narrow = CookTorrance(alpha=0.19)
    rendered = building.wall_as_rendered(scene(narrow))
    assert isinstance(rendered, building.RenderedGrid)
    theta = np.linspace(-1.57, 1.57, 1000)
    error = np.max(np.abs(rendered(theta[:, None], theta) - narrow(theta[:, None], theta))) / rendered.values.max()
    assert building.GRID_TOLERANCE < error < 1.2 * building.NARROW_TOLERANCE
    with pytest.raises(InputError, match="is left"):
        building.wall_as_rendered(scene(CookTorrance(alpha=0.02)))


@pytest.mark.parametrize(
    ("distance", "unit"), [(1.0, 1.0), (5.0, 1.0), (1e3, 1.0), (0.75, 0.5), (1.5e-3, 2.0**-10), (3000.0, 2048.0)]
)
def test_unit_brings_the_card_away_from_the_ray_epsilon(distance: float, unit: float) -> None:
    assert cameras.metres_per_unit(scene(y=-distance)) == unit


def test_points_and_wrong_numbers_are_refused(mi: Any) -> None:
    case = scene()
    with pytest.raises(InputError, match=r"card\.element_width.*points"):
        building.mitsuba_dict(scene(element_width=0.0, element_height=0.0), 0)
    edges = replace(case, observer=replace(case.observer, pixels_at="edges"))
    with pytest.raises(InputError, match=r"observer\.pixels_at"):
        building.mitsuba_dict(edges, 0)
    for view in (2, -1):
        with pytest.raises(InputError, match=r"view.*0 to 1"):
            building.mitsuba_dict(case, view)
    with pytest.raises(InputError, match=r"radiances.*3 strips"):
        building.mitsuba_dict(case, 0, radiances=[1.0])
    with pytest.raises(InputError, match="sampler"):
        building.mitsuba_dict(case, 0, sampler="halton")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="realisation"):
        building.export_xml(case, "never.xml", realisation=1)


@pytest.mark.parametrize("name", ["flat_wall_lobes", "reflective_card", "cornell_lobes", "flat_wall_diffuse"])
def test_xml_renders_alike(mi: Any, tmp_path: Path, name: str) -> None:
    """XML keeps rotations as angles, so directions come back up to float32's 3e-7 rad.

    A lobe of sigma 1 deg changes by at most 0.61 / sigma = 35 per radian of its peak: 1e-5 of the brightest pixel.
    """
    case = load_scene(name)
    path = tmp_path / "scene.xml"
    building.export_xml(case, path, view=3, realisation=1)
    there = mi.load_dict(building.mitsuba_dict(case, 3, radiances=case.source[:, 1]), optimize=False)
    back = mi.load_file(str(path), optimize=False)
    first, second = (np.array(mi.render(s, spp=64, seed=5)) for s in (there, back))
    assert first.max() > 0
    np.testing.assert_allclose(second, first, atol=5e-5 * first.max(), rtol=0)


def test_loads_are_reproducible_unoptimised(mi: Any) -> None:
    """Optimised loads draw other samples each time; ours must give the same bits."""
    case = load_scene("reflective_card")
    images = {np.array(mi.render(load(mi, case, 3), spp=4, seed=1)).tobytes() for _ in range(6)}
    assert len(images) == 1


def test_import_leaves_mitsuba_alone() -> None:
    """The LLVM must be chosen before the first import of drjit, so ours may not cause it."""
    code = "import sys, wallmirror.pathtracing.filming; sys.exit('mitsuba' in sys.modules or 'drjit' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
