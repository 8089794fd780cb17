"""wallmirror: turn a wall into a mirror.

From light that a wall sends back, recover the wall's BRDF and the pattern of the hidden card that lights it.
The core (this namespace) needs NumPy and SciPy; `wallmirror.pathtracing` adds Mitsuba 3 as camera and judge.
"""

from wallmirror.brdf import (
    BRDF,
    AngleSumBRDF,
    AngleSumTable,
    Audit,
    Blinn,
    CookTorrance,
    Diffuse,
    Finding,
    Fresnel,
    GaussianTrain,
    GeneralSum,
    Mirror,
    Phong,
    PhongIllumination,
    Schlick,
    Sum,
    Table,
    Tabulated,
    audit,
    directional_albedo,
    tabulate,
    tabulate_to,
)
from wallmirror.captures import CaptureSet, Truth, read_captures, read_truth, write_captures
from wallmirror.comparison import BiasTest, Comparison, compare
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.foresight import Forecast, foresee
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.solve import solve
from wallmirror.errors import InputError, MissingRuntimeError, UndeterminedError, WallmirrorError
from wallmirror.geometry import Card, Observer, scan_angles, wall_points
from wallmirror.planning import Hypothesis, Plan
from wallmirror.scene import RenderSettings, Room, Scene, Wall, load_scene, scene_names
from wallmirror.transport import (
    Kernel,
    brdf_matrices,
    build_kernel,
    mirror_matrix,
    radiance,
    transport_matrix,
)

__version__ = "0.1.0"

__all__ = [
    "BRDF",
    "AngleSumBRDF",
    "AngleSumTable",
    "Audit",
    "BiasTest",
    "Blinn",
    "CaptureSet",
    "Card",
    "Comparison",
    "CookTorrance",
    "Diffuse",
    "Finding",
    "Forecast",
    "Fresnel",
    "GaussianTrain",
    "GeneralSum",
    "Hypothesis",
    "InputError",
    "Kernel",
    "Mirror",
    "MissingRuntimeError",
    "Observer",
    "Phong",
    "PhongIllumination",
    "Plan",
    "RenderSettings",
    "Room",
    "Scene",
    "Schlick",
    "Solution",
    "Sum",
    "Table",
    "Tabulated",
    "Truth",
    "UndeterminedError",
    "Wall",
    "WallmirrorError",
    "audit",
    "brdf_matrices",
    "build_kernel",
    "compare",
    "directional_albedo",
    "foresee",
    "load_scene",
    "mirror_matrix",
    "radiance",
    "read_captures",
    "read_truth",
    "scale_free_error",
    "scan_angles",
    "scene_names",
    "solve",
    "tabulate",
    "tabulate_to",
    "transport_matrix",
    "wall_points",
    "write_captures",
]
