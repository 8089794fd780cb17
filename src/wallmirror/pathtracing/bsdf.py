"""The tabulated BRDF as two Mitsuba plugins, `wallmirror_angle_sum` and `wallmirror_table`.

Both know directions by their signed in-plane angle alone: theta = atan2(w.x, w.z) in the shading frame, the angle of
the projection on the (s, n) plane. Out of that plane they are therefore "cylindrical", constant along t, like every
model of `wallmirror.brdf`. Both are one-sided and black for directions at or below the surface.

=====================  ================================  ===================================================
plugin                 BRDF in 1/sr                      nodes
=====================  ================================  ===================================================
wallmirror_angle_sum   rho(theta_s + theta_o), linear    K, uniform over [-pi, pi]
wallmirror_table       rho(theta_s, theta_o), bilinear   K_s x K_o, uniform over [-pi/2, pi/2]^2
=====================  ================================  ===================================================

theta_s points towards the light and theta_o towards the camera: the angles of `wo` and `si.wi` where radiance is
transported, the other way round where importance is.

Parameters, exactly one of them:

- `table`: a `mi.TensorXf` of shape (K,) or (K_s, K_o). Mitsuba cannot write it to XML;
- `values`: the same as text (`tables.table_text`), for XML;
- `filename`: a .npy file of the same, found by Mitsuba's file resolver.

`mi.traverse(scene)[...".table"]` may be given new values of the same shape at no recompilation, or of another shape.

Sampling is exact for either table. With y the out-of-plane sine, w = (sin(theta) c, y, cos(theta) c) and
c = sqrt(1 - y^2), the solid angle is d omega = d theta dy; theta is drawn from the tabulated row by inverting its
piecewise quadratic cumulative distribution, y as a coordinate of a point uniform on the unit disk, so that
pdf(w) = p(theta) (2 / pi) c with p = rho / (integral of rho over theta), and the weight rho cos / pdf is
(integral of rho) (pi / 2) cos(theta): bounded, and without the table's structure. Angles and cumulative sums are in
double precision: float32 `atan2` errs by 7e-7 rad, and float32 sums by 6e-8 of the whole in every cell.

Mitsuba's base classes belong to a variant, so the plugins are made for one variant by `register`, once it is set.
"""

from __future__ import annotations

import functools
import importlib
import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.errors import MissingRuntimeError
from wallmirror.pathtracing.tables import UniformNodes, checked_table, cumulative, given_table

#: Plugin names, as in the `type` of a scene dictionary.
ANGLE_SUM = "wallmirror_angle_sum"
TABLE = "wallmirror_table"


def register() -> None:
    """Make both plugins known to the Mitsuba variant that is set; further calls for it do nothing.

    Raises
    ------
    MissingRuntimeError
        If no variant is set yet (`runtime.activate` sets one and registers).
    """
    mi: Any = importlib.import_module("mitsuba")
    variant = mi.variant()
    if variant is None:
        raise MissingRuntimeError("no Mitsuba variant is set; call wallmirror.pathtracing.runtime.activate() first")
    _register(variant)


def declare(state: Any) -> Any:
    """The same `mi.parser.ParserState` with our plugins marked as BSDFs, so that it can be written to XML.

    Mitsuba knows the kind of its own plugins only, and refuses to write a node of unknown kind.
    """
    mi: Any = importlib.import_module("mitsuba")
    for index, node in enumerate(state.nodes):
        if node.props.plugin_name() in (ANGLE_SUM, TABLE):
            node.type = mi.ObjectType.BSDF
            state.nodes[index] = node
    return state


@functools.cache
def _register(variant: str) -> None:
    """Register for the variant that is set, which the argument names for the cache only."""
    mi: Any = importlib.import_module("mitsuba")
    for name, plugin in _plugins(mi, importlib.import_module("drjit")).items():
        mi.register_bsdf(name, plugin)


def _plugins(mi: Any, dr: Any) -> dict[str, Any]:
    """The plugin classes by name, derived from the base classes of the variant that is set."""
    # Mitsuba's names change with the variant: the classes below keep this variant's.
    Float, Float64, UInt32 = mi.Float, mi.Float64, mi.UInt32
    DISK = 2 / math.pi  # density of the disk coordinate y at 0

    def angle(w: Any) -> Any:
        return dr.atan2(Float64(w.x), Float64(w.z))

    def gather(dtype: Any, source: Any, index: Any) -> Any:
        # Dr.Jit gathers from scalar arrays only by their own indexing.
        return dr.gather(dtype, source, UInt32(index)) if dr.is_jit_v(source) else source[int(index)]

    class Row(ABC):
        """rho as a function of theta alone, the other direction being given; angles and sums in double precision.

        A subclass sets `start` and `total`, the cumulative sum where theta begins and its gain up to where theta
        ends, in units of `step` (radians), and `last`, the largest index of a node.
        """

        start: Any
        total: Any
        step: float
        last: int

        @abstractmethod
        def locate(self, theta: Any) -> tuple[Any, Any]:
            """Cell and fraction of an angle."""

        @abstractmethod
        def theta(self, index: Any, fraction: Any) -> Any:
            """Angle at a cell and fraction."""

        @abstractmethod
        def ends(self, index: Any) -> tuple[Any, Any]:
            """rho at both ends of a cell, differentiable with respect to the table."""

        @abstractmethod
        def cumulated(self, node: Any) -> Any:
            """Cumulative sum at a node."""

        def value(self, index: Any, fraction: Any) -> Any:
            """rho inside a cell."""
            first, second = self.ends(index)
            return dr.fma(dr.detach(Float(fraction)), second - first, first)

        def density(self, rho: Any) -> Any:
            """Probability of theta per radian where the BRDF is rho; 0 in a row without light."""
            lit = self.total > 0
            return dr.select(lit, Float(dr.detach(rho) / dr.select(lit, self.total * self.step, 1)), 0)

        def draw(self, uniform: Any) -> tuple[Any, Any, Any]:
            """Cell, fraction and angle where the cumulative sum reaches a uniform number's share of the total."""
            target = self.start + uniform * self.total
            # The first node beyond the target: the cell below it has light, whatever empty cells lie around.
            beyond = dr.binary_search(0, self.last, lambda node: self.cumulated(node) <= target)
            index = UInt32(dr.maximum(beyond, 1) - 1)
            first, second = (Float64(dr.detach(value)) for value in self.ends(index))
            rest = target - self.cumulated(index)
            # first f + (second - first) f^2 / 2 = rest, by the form of the root that does not cancel.
            root = dr.safe_sqrt(dr.fma(2 * (second - first), rest, first * first))
            lit = first + root > 0
            fraction = dr.select(lit, dr.clip(2 * rest / dr.select(lit, first + root, 1), 0, 1), 0)
            return index, fraction, self.theta(index, fraction)

    class AngleSumRow(Row):
        """The window of pi that theta cuts out of the table of u."""

        def __init__(self, bsdf: Any, theta_i: Any) -> None:
            self.nodes: UniformNodes = bsdf.nodes
            self.table, self.sums, self.theta_i = bsdf.table.array, bsdf.sums.array, theta_i
            self.step, self.last = self.nodes.step, self.nodes.count - 1
            self.start = self.integral(theta_i - math.pi / 2)
            self.total = self.integral(theta_i + math.pi / 2) - self.start

        def integral(self, u: Any) -> Any:
            """Cumulative sum at any u, exact inside cells too."""
            index, fraction = self.nodes.cell(u)
            first, second = (Float64(dr.detach(value)) for value in self.ends(index))
            return self.cumulated(index) + fraction * dr.fma(fraction * 0.5, second - first, first)

        def locate(self, theta: Any) -> tuple[Any, Any]:
            return self.nodes.cell(theta + self.theta_i)

        def theta(self, index: Any, fraction: Any) -> Any:
            return (Float64(index) + fraction) * self.step - math.pi - self.theta_i

        def ends(self, index: Any) -> tuple[Any, Any]:
            return gather(Float, self.table, index), gather(Float, self.table, index + 1)

        def cumulated(self, node: Any) -> Any:
            return gather(Float64, self.sums, node)

    class TableRow(Row):
        """The linear mixture of the two rows of nodes around the given direction.

        The mixture of their cumulative distributions is its cumulative distribution exactly.
        """

        def __init__(self, bsdf: Any, theta_i: Any, *, to_camera: bool) -> None:
            nodes_s, nodes_o = bsdf.nodes
            # The table is flat, theta_o fastest; a row runs over theta_s where theta_o, to the camera, is given.
            if to_camera:
                given, free, sums, strides = nodes_o, nodes_s, bsdf.sums_over_s, (1, nodes_o.count)
            else:
                given, free, sums, strides = nodes_s, nodes_o, bsdf.sums_over_o, (nodes_o.count, 1)
            self.row_stride, self.node_stride = strides
            self.nodes: UniformNodes = free
            self.step, self.last = free.step, free.count - 1
            self.table, self.sums = bsdf.table.array, sums.array
            row, mix = given.cell(theta_i)
            self.row, self.mix = UInt32(row), mix
            self.start, self.total = Float64(0), self.cumulated(self.last)

        def locate(self, theta: Any) -> tuple[Any, Any]:
            return self.nodes.cell(theta)

        def theta(self, index: Any, fraction: Any) -> Any:
            return (Float64(index) + fraction) * self.step - math.pi / 2

        def ends(self, index: Any) -> tuple[Any, Any]:
            corner = self.row * self.row_stride + UInt32(index) * self.node_stride
            mix = dr.detach(Float(self.mix))

            def mixed(corner: Any) -> Any:
                first = gather(Float, self.table, corner)
                return dr.fma(mix, gather(Float, self.table, corner + self.row_stride) - first, first)

            return mixed(corner), mixed(corner + self.node_stride)

        def cumulated(self, node: Any) -> Any:
            index = self.row * self.nodes.count + UInt32(node)
            first = gather(Float64, self.sums, index)
            return dr.fma(self.mix, gather(Float64, self.sums, index + self.nodes.count) - first, first)

    class Tabulated(mi.BSDF):  # type: ignore[misc]
        """What both plugins share; a subclass derives cumulative sums and gives rows."""

        name: str
        dimensions: int

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.Anisotropic
            self.m_components = [self.m_flags]
            self.checked = given_table(mi, props, self.dimensions)
            self.table = mi.TensorXf(self.checked)
            self.derive(self.checked)

        @abstractmethod
        def derive(self, table: NDArray[np.float32]) -> None:
            """Set nodes and cumulative sums from a checked table."""

        @abstractmethod
        def row(self, ctx: Any, theta_i: Any) -> Any:
            """The row for one direction given."""

        def traverse(self, callback: Any) -> None:
            callback.put("table", self.table, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            try:
                self.checked = checked_table(dr.detach(self.table).numpy(), self.dimensions)
            except ValueError:
                # Whoever catches this must not render with half of an update.
                mi.set_property(self.table, mi.TensorXf(self.checked))
                raise
            dr.make_opaque(self.table)  # a literal would be compiled in
            self.derive(self.checked)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            row = self.row(ctx, angle(si.wi))
            rho = row.value(*row.locate(angle(wo)))
            # Length of the projection, rather than sqrt(1 - y^2), which cancels for directions almost along t.
            c = dr.sqrt(dr.fma(wo.x, wo.x, dr.square(wo.z)))
            active = active & (si.wi.z > 0) & (wo.z > 0)
            value = dr.select(active, rho * wo.z, 0)
            pdf = dr.select(active, row.density(rho) * DISK * c, 0)
            return mi.depolarizer(mi.UnpolarizedSpectrum(value)), pdf

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            """Direction drawn by rho in its angle and by a disk across the plane, and its weight eval / pdf."""
            row = self.row(ctx, angle(si.wi))
            index, fraction, theta = row.draw(Float64(sample1))
            rho = row.value(index, fraction)
            y = mi.warp.square_to_uniform_disk_concentric(sample2).y
            c = dr.safe_sqrt(dr.fma(-y, y, 1))
            sine, cosine = dr.sincos(theta)
            wo = mi.Vector3f(Float(sine) * c, y, Float(cosine) * c)
            pdf = row.density(rho) * DISK * c
            # No density: a row without light, where rho / pdf would be 0 / 0.
            active = active & (si.wi.z > 0) & (wo.z > 0) & (pdf > 0)

            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = wo
            bs.pdf = dr.select(active, pdf, 0)
            bs.eta = 1.0
            bs.sampled_type = UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = UInt32(0)
            weight = dr.select(active, rho * wo.z / dr.select(active, pdf, 1), 0)
            return bs, mi.depolarizer(mi.UnpolarizedSpectrum(weight))

        def to_string(self) -> str:
            shape = " x ".join(str(size) for size in self.checked.shape)
            return f"{self.name}[nodes = {shape}, largest value = {self.checked.max():.6g} / sr]"

    class AngleSum(Tabulated):
        name, dimensions = ANGLE_SUM, 1

        def derive(self, table: NDArray[np.float32]) -> None:
            self.nodes = UniformNodes(math.pi, table.size)
            self.sums = mi.TensorXf64(cumulative(table))

        def row(self, ctx: Any, theta_i: Any) -> Any:
            return AngleSumRow(self, theta_i)

    class Table(Tabulated):
        name, dimensions = TABLE, 2

        def derive(self, table: NDArray[np.float32]) -> None:
            self.nodes = tuple(UniformNodes(math.pi / 2, count) for count in table.shape)
            self.sums_over_s = mi.TensorXf64(cumulative(np.ascontiguousarray(table.T)))
            self.sums_over_o = mi.TensorXf64(cumulative(table))

        def row(self, ctx: Any, theta_i: Any) -> Any:
            return TableRow(self, theta_i, to_camera=ctx.mode == mi.TransportMode.Radiance)

    return {ANGLE_SUM: AngleSum, TABLE: Table}
