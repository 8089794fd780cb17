"""One point of the scaling panel in a process of its own, so that its peak memory is its own.

    python -m wallmirror.tradeoff.worker '{"kind": "transport", "pixels": 500, "views": 20, "elements": 4}' [BYTES]

Beyond so many bytes the system refuses the process its memory. Prints one line of JSON: processor seconds, bytes taken
beyond what stood before, and the refusal if there was one. The peak is VmHWM where Linux tells it:
getrusage's ru_maxrss is inherited from the process that started this one.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wallmirror.brdf import GaussianTrain
from wallmirror.captures import CaptureSet
from wallmirror.derendering.solve import solve
from wallmirror.errors import WallmirrorError
from wallmirror.geometry import Card, Observer, scan_angles
from wallmirror.scene import load_scene
from wallmirror.transport import Weights, radiance, transport_matrix

#: The thesis's size of each knob.
BASE = {"pixels": 500, "views": 20, "elements": 4, "realisations": 20, "pixel nodes": 2, "strip nodes": 4}


def work_of(spec: Mapping[str, Any]) -> Callable[[], object]:
    """The call that is measured; what it needs is made here, before the clock starts.

    Parameters
    ----------
    spec:
        "kind" ("transport", "solve", "capture" or "picture") and the knobs that differ from `BASE`.
    """
    size = {**BASE, **spec}
    kind = spec["kind"]
    fov = math.radians(60)
    physical = kind != "solve"
    observer = Observer(
        position=(0.0, -5.0),
        fov=fov,
        view_angles=scan_angles(size["views"], scan=math.radians(90), fov=fov),
        pixels=size["pixels"],
        pixels_at="centres" if physical else "edges",
    )
    elements = size["elements"]
    width = min(0.02, 2.5 / elements) if physical else 0.0
    places = np.linspace(-2.5, 2.5, elements) if elements > 1 else np.zeros(1)
    card = Card(elements_x=tuple(map(float, places)), y=-1.0, element_width=width, element_height=width)
    brdf = GaussianTrain.of_the_code()
    if kind == "transport":
        orders = size["pixel nodes"], size["strip nodes"]
        return lambda: transport_matrix(observer, card, brdf, orders=orders)
    if kind == "solve":
        captures = _captures(observer, card, brdf, size["realisations"])
        return lambda: solve(captures, method="maximum_likelihood", step_deg=0.5)
    scene = load_scene("flat_wall_lobes")
    if kind == "capture":
        from wallmirror.pathtracing.filming import render_captures

        # The truth's size is that of the pattern alone; the films are what is large.
        asked = dataclasses.replace(scene, observer=observer)
        return lambda: render_captures(asked, spp=16)
    from wallmirror.pathtracing.rendering import picture

    picture(scene, 16, 16, spp=1)  # compiles
    return lambda: picture(scene, size["width"], size["width"], spp=16)


def _captures(observer: Observer, card: Card, brdf: GaussianTrain, realisations: int) -> CaptureSet:
    weights: Weights = "cosine"
    rng = np.random.default_rng(3)
    films = radiance(transport_matrix(observer, card, brdf, weights=weights), rng.random((card.elements, realisations)))
    sigma = 0.01 * float(films.max())
    films += sigma * rng.standard_normal(films.shape)
    return CaptureSet(
        observer=observer, card=card, transport=weights, radiance=films, variance=np.full(films.shape, sigma**2)
    )


def measure(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds and bytes of one call, or why it was refused."""
    work = work_of(spec)
    before = _resident("VmRSS")
    a, b = time.process_time(), time.perf_counter()
    failure = ""
    try:
        work()
    except WallmirrorError as refusal:
        failure = str(refusal)
    except MemoryError as end:
        failure = f"MemoryError: {end}"
    seconds, wall = time.process_time() - a, time.perf_counter() - b
    return {"seconds": seconds, "wall": wall, "bytes": max(0.0, _resident("VmHWM") - before), "failure": failure}


def _resident(name: str) -> float:
    """Bytes of memory that this process holds (VmRSS) or held at most (VmHWM)."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{name}:"):
                return 1024.0 * float(line.split()[1])
    except OSError:
        pass
    import resource

    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _limit(most: int) -> None:
    """Let allocations beyond so many bytes fail, where the system can."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    except (ImportError, AttributeError, ValueError, OSError):
        sys.stderr.write("no limit on memory on this system\n")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        _limit(int(sys.argv[2]))
    sys.stdout.write(json.dumps(measure(json.loads(sys.argv[1]))) + "\n")
