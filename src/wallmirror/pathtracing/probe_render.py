"""A diffuse wall under a sky of radiance 1: the smallest render whose right answer is known, and the LLVM probe.

Run as a script this is the child process of `llvm.probe`: an unfit LLVM does not raise, it aborts the whole process at
the first kernel that holds an instruction which it cannot translate, so only a sacrificial process can ask it.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

#: Albedo of the wall, and the radiance that it sends back from a sky of radiance 1.
ALBEDO = 0.5


def wall_radiance(mi: Any, spp: int) -> Any:
    """Radiance of a diffuse wall of albedo 0.5 under a constant sky of radiance 1, shape (4, 4, 1).

    Every sample is a cosine-weighted direction that meets the sky, hence 0.5 up to rounding: no noise.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 4,
                    "height": 4,
                    "pixel_format": "luminance",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
            },
            "sky": {"type": "constant", "radiance": 1.0},
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([10, 10, 1]),
                "bsdf": {"type": "diffuse", "reflectance": ALBEDO},
            },
        }
    )
    return mi.render(scene, spp=spp, seed=0).numpy()


def main() -> None:
    """Render with the LLVM that DRJIT_LIBLLVM_PATH names and print what came out as one line of JSON."""
    if sys.platform != "win32":
        resource = importlib.import_module("resource")
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # an abort is expected: leave no core file
    mi: Any = importlib.import_module("mitsuba")
    dr: Any = importlib.import_module("drjit")
    dr.set_thread_count(1)
    mi.set_variant("llvm_ad_mono")
    # The instructions that LLVM 15 and 16 cannot translate on x86-64.
    clamped = dr.minimum(dr.maximum(mi.Float([-1.0, 0.25, 2.0]), 0.0), 1.0)
    report = {
        "llvm": ".".join(str(part) for part in dr.detail.llvm_version()),
        "clamped": clamped.numpy().tolist(),
        "radiance": float(wall_radiance(mi, spp=16).mean()),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
