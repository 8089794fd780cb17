"""The table [wall] of a scene: every model by name, tables from files beside it, and the sentence for each fault."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from wallmirror.brdf import (
    BRDF,
    AngleSumTable,
    Blinn,
    CookTorrance,
    Diffuse,
    Fresnel,
    GeneralSum,
    Phong,
    Schlick,
    Sum,
    Table,
)
from wallmirror.fields import read_toml
from wallmirror.wall_reading import read_brdf

from .helpers import refused


def wall(folder: Path, text: str) -> BRDF:
    path = folder / "scene.toml"
    path.write_text(f"[wall]\n{text}\n", encoding="utf-8")
    fields = read_toml(path).table("wall")
    brdf = read_brdf(fields)
    fields.finish()
    return brdf


@pytest.mark.parametrize(
    ("text", "brdf"),
    [
        ('brdf = "phong"\nexponent = 3\nform = "plain"', Phong(exponent=3, form="plain")),
        ('brdf = "blinn"\nexponent = 9', Blinn(exponent=9, reflectance=0.5)),
        ('brdf = "blinn"\nexponent = 9\nreflectance = 0.1\nform = "plain"', Blinn(exponent=9, reflectance=0.1, form="plain")),
        ('brdf = "cook_torrance"\nalpha = 0.3', CookTorrance(alpha=0.3, fresnel=Fresnel(eta=1.5))),
        (
            'brdf = "cook_torrance"\nalpha = 0.3\neta = 0.2\nk = 3.9\ndistribution = "beckmann"\nfacets = "isotropic"',
            CookTorrance(
                alpha=0.3, distribution="beckmann", fresnel=Fresnel(eta=0.2, k=3.9), facets="isotropic"
            ),
        ),
        ('brdf = "cook_torrance"\nalpha = 0.3\nf0 = 0.9', CookTorrance(alpha=0.3, fresnel=Schlick(f0=0.9))),
        (
            'brdf = "blinn"\nexponent = 9\ndiffuse_albedo = 0.2',
            Sum(parts=(Blinn(exponent=9), Diffuse(albedo=0.2))),
        ),
        (
            'brdf = "cook_torrance"\nalpha = 0.3\ndiffuse_albedo = 0.2',
            GeneralSum(parts=(CookTorrance(alpha=0.3), Diffuse(albedo=0.2))),
        ),
    ],
)  # fmt: skip
def test_a_model_is_what_its_fields_say(tmp_path: Path, text: str, brdf: BRDF) -> None:
    assert wall(tmp_path, text) == brdf


@pytest.mark.parametrize("suffix", ["npy", "csv"])
def test_a_table_of_both_angles_comes_from_a_file_beside_the_scene(tmp_path: Path, suffix: str) -> None:
    values = np.random.default_rng(0).random((4, 5))
    if suffix == "npy":
        np.save(tmp_path / "wall.npy", values.astype(np.float32))
    else:
        np.savetxt(tmp_path / "wall.csv", values, delimiter=",")
    brdf = wall(tmp_path, f'brdf = "table"\nfile = "wall.{suffix}"')
    assert isinstance(brdf, Table)
    np.testing.assert_allclose(brdf.values, values, rtol=1e-7)
    coated = wall(tmp_path, f'brdf = "table"\nfile = "wall.{suffix}"\ndiffuse_albedo = 0.5')
    assert isinstance(coated, Table)
    np.testing.assert_allclose(coated.values, values + 0.5 / math.pi, rtol=1e-7)


@pytest.mark.parametrize("shape", [(7,), (7, 1), (1, 7)])
def test_a_table_of_one_column_or_row_is_of_the_angle_sum(tmp_path: Path, shape: tuple[int, ...]) -> None:
    values = np.arange(7.0).reshape(shape)
    np.save(tmp_path / "wall.npy", values)
    brdf = wall(tmp_path, 'brdf = "table"\nfile = "wall.npy"')
    assert isinstance(brdf, AngleSumTable)
    assert (brdf.start, brdf.stop) == (-math.pi, math.pi)
    np.testing.assert_array_equal(brdf.values, np.arange(7.0))
    if len(shape) > 1:
        np.savetxt(tmp_path / "wall.csv", values, delimiter=",")
        narrow = wall(tmp_path, 'brdf = "table"\nfile = "wall.csv"\nstart_deg = -60\nstop_deg = 60')
        assert isinstance(narrow, AngleSumTable)
        assert narrow.stop == math.radians(60)
        assert narrow.of_sum(0.0) == 3.0


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ('brdf = "velvet"', "wall.brdf"),
        ('brdf = "blinn"', "wall.exponent"),
        ('brdf = "blinn"\nexponent = -1', "wall.exponent"),
        ('brdf = "blinn"\nexponent = 3\nform = "white"', "wall.form"),
        ('brdf = "blinn"\nexponent = 3\nalpha = 0.2', "wall.alpha"),
        ('brdf = "cook_torrance"\nalpha = 0', "wall.alpha"),
        ('brdf = "cook_torrance"\nalpha = 0.2\nf0 = 0.5\neta = 1.5', "wall.eta"),
        ('brdf = "cook_torrance"\nalpha = 0.2\nf0 = 2', "wall.f0"),
        ('brdf = "cook_torrance"\nalpha = 0.2\ndistribution = "gauss"', "wall.distribution"),
        ('brdf = "cook_torrance"\nalpha = 0.2\nfacets = "flat"', "wall.facets"),
        ('brdf = "table"', "wall.file"),
        ('brdf = "table"\nfile = "none.npy"', "wall.file"),
        ('brdf = "table"\nfile = "../outside.npy"', "wall.file"),
        ('brdf = "table"\nfile = "link.npy"', "wall.file"),
        ('brdf = "table"\nfile = ""', "wall.file"),
        ('brdf = "table"\nfile = "scene.toml"', "wall.file"),
        ('brdf = "table"\nfile = "text.csv"', "wall.file"),
        ('brdf = "table"\nfile = "ragged.csv"', "wall.file"),
        ('brdf = "table"\nfile = "empty.csv"', "wall.file"),
        ('brdf = "table"\nfile = "text.npy"', "wall.file"),
        ('brdf = "table"\nfile = "pickle.npy"', "wall.file"),
        ('brdf = "table"\nfile = "complex.npy"', "wall.file"),
        ('brdf = "table"\nfile = "deep.npy"', "wall.file"),
        ('brdf = "table"\nfile = "negative.npy"', "wall.file"),
        ('brdf = "table"\nfile = "nan.csv"', "wall.file"),
        ('brdf = "table"\nfile = "one.csv"', "wall.file"),
        ('brdf = "table"\nfile = "good.csv"\nstart_deg = 10\nstop_deg = -10', "wall.file"),
        ('brdf = "table"\nfile = "good.csv"\nstart_deg = 1000', "wall.start_deg"),
        ('brdf = "table"\nfile = "square.npy"\nstart_deg = -90', "wall.start_deg"),
    ],
)
def test_faults_are_refused_with_their_field(tmp_path: Path, text: str, field: str) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    np.save(tmp_path / "outside.npy", np.ones((3, 3)))
    (folder / "link.npy").symlink_to(tmp_path / "outside.npy")
    (folder / "text.csv").write_text("a,b\nc,d\n")
    (folder / "ragged.csv").write_text("1,2\n3\n")
    (folder / "empty.csv").write_text("")
    (folder / "text.npy").write_text("1 2 3")
    np.save(folder / "pickle.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.save(folder / "complex.npy", np.ones((3, 3), dtype=complex))
    np.save(folder / "deep.npy", np.ones((3, 3, 3)))
    np.save(folder / "negative.npy", np.array([[0.1, 0.2], [0.1, -0.2]]))
    np.save(folder / "square.npy", np.ones((3, 3)))
    (folder / "nan.csv").write_text("1,nan,2\n")
    (folder / "one.csv").write_text("1\n")
    (folder / "good.csv").write_text("1,2,1\n")
    assert refused(lambda: wall(folder, text)).field == field
