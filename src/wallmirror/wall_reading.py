"""The wall's reflectance from the table [wall] of a scene, by its `brdf`.

================  =====================================================================================================
`brdf`            fields (degrees for angles; those with a value may be left out)
================  =====================================================================================================
"diffuse"         albedo
"mirror"          reflectance = 1
"phong"           exponent, reflectance = 0.5, form = "conserving" or "plain"
"blinn"           exponent, reflectance = 0.5, form = "conserving" or "plain"
"cook_torrance"   alpha, distribution = "ggx" or "beckmann", facets = "grooves" or "isotropic", and the Fresnel reflectance
                  by eta = 1.5 and k = 0, or by f0 (Schlick)
"gaussian_train"  centres_deg, sigma_deg, height = "peak", "per_degree" or "per_radian", scale = 1
"table"           file: a .npy or .csv file beside the scene; start_deg = -180, stop_deg = 180 for one of the angle sum
================  =====================================================================================================

All but "diffuse" and "mirror" take a `diffuse_albedo` that is added. A table of one row or column holds values at uniform
nodes of theta_s + theta_o, any other one values in 1/sr at uniform nodes of both angles from -90 to 90 deg: rows theta_s,
columns theta_o.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import get_args

from wallmirror.brdf import (
    BRDF,
    AngleSumBRDF,
    AngleSumTable,
    Blinn,
    CookTorrance,
    Diffuse,
    FacetDistribution,
    Facets,
    Fresnel,
    GaussianTrain,
    GeneralSum,
    LobeForm,
    LobeHeight,
    Mirror,
    Phong,
    Schlick,
    Sum,
    Table,
)
from wallmirror.errors import InputError
from wallmirror.fields import Fields
from wallmirror.table_files import read_table


def read_brdf(fields: Fields) -> BRDF:
    """The BRDF that a table [wall] describes; the caller handles extra fields.

    Raises
    ------
    InputError
        For every missing or out-of-range field, and for a table's file that is missing, outside the scene's folder, no
        table of numbers, negative or not finite.
    """
    kind = fields.choice("brdf", tuple(_MODELS))
    brdf = _MODELS[kind](fields)
    if isinstance(brdf, Diffuse | Mirror) or not fields.has("diffuse_albedo"):
        return brdf
    coat = Diffuse(albedo=fields.number("diffuse_albedo", low=0.0, high=1.0))
    if isinstance(brdf, Table):
        return Table(values=brdf.values + coat.albedo / math.pi)
    return Sum(parts=(brdf, coat)) if isinstance(brdf, AngleSumBRDF) else GeneralSum(parts=(brdf, coat))


def _phong(fields: Fields) -> Phong:
    return Phong(
        exponent=fields.number("exponent"),
        reflectance=fields.number("reflectance", 0.5),
        form=fields.one_of("form", get_args(LobeForm), "conserving"),
    )


def _blinn(fields: Fields) -> Blinn:
    return Blinn(
        exponent=fields.number("exponent"),
        reflectance=fields.number("reflectance", 0.5),
        form=fields.one_of("form", get_args(LobeForm), "conserving"),
    )


def _cook_torrance(fields: Fields) -> CookTorrance:
    fresnel: Fresnel | Schlick
    if fields.has("f0"):
        fresnel = Schlick(f0=fields.number("f0"))
    else:
        fresnel = Fresnel(eta=fields.number("eta", 1.5), k=fields.number("k", 0.0))
    return CookTorrance(
        alpha=fields.number("alpha"),
        distribution=fields.one_of("distribution", get_args(FacetDistribution), "ggx"),
        fresnel=fresnel,
        facets=fields.one_of("facets", get_args(Facets), "grooves"),
    )


def _gaussian_train(fields: Fields) -> GaussianTrain:
    return GaussianTrain(
        centres=tuple(math.radians(c) for c in fields.numbers("centres_deg")),
        sigma=math.radians(fields.number("sigma_deg")),
        height=fields.one_of("height", get_args(LobeHeight), "peak"),
        scale=fields.number("scale", 1.0),
    )


def _table(fields: Fields) -> AngleSumTable | Table:
    path = fields.inside("file", "scene's")
    try:
        values = read_table(path)
        if values.ndim == 2 and min(values.shape) > 1:
            return Table(values=values)
        return AngleSumTable(
            start=math.radians(fields.number("start_deg", -180.0, low=-360.0, high=360.0)),
            stop=math.radians(fields.number("stop_deg", 180.0, low=-360.0, high=360.0)),
            values=values.ravel(),
        )
    except InputError as error:
        if error.field not in (None, "wall.table"):
            raise
        raise fields.error("file", f'"{path.name}" {error.message}') from None


_MODELS: dict[str, Callable[[Fields], BRDF]] = {
    "diffuse": lambda f: Diffuse(albedo=f.number("albedo")),
    "mirror": lambda f: Mirror(reflectance=f.number("reflectance", 1.0)),
    "phong": _phong,
    "blinn": _blinn,
    "cook_torrance": _cook_torrance,
    "gaussian_train": _gaussian_train,
    "table": _table,
}
