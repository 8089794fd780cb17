"""How exact is the closed form without noise, and how long does it take, at the thesis's defaults?

    python benchmarks/noiseless_defaults.py

N 500, A 20, B 20, M 4, the four-lobed wall of the thesis's code (table 4.3), each of the three weights. Prints relative
errors after the global scale, and the median time of `solve` beside a fixed reference workload (the QR factorisation
of a 10,000 x 20 matrix), so that machines can be compared.
"""

from __future__ import annotations

import math
import time

import numpy as np

from wallmirror import (
    CaptureSet,
    Card,
    GaussianTrain,
    Observer,
    radiance,
    scale_free_error,
    scan_angles,
    solve,
    transport_matrix,
)
from wallmirror.console import Terminal


def median_seconds(work, repeats: int = 9) -> float:
    """Median wall time of a call, after one that is not counted."""
    work()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))


def main() -> None:
    rng = np.random.default_rng(0)
    source = rng.random((4, 20))
    fov = math.radians(60)
    angles = scan_angles(20, scan=math.radians(90), fov=fov)
    reference = median_seconds(lambda: np.linalg.qr(rng.standard_normal((10_000, 20))))
    rows = []
    for weights in ("thesis", "cosine", "physical"):
        physical = weights == "physical"
        size = 0.02 if physical else 0.0
        observer = Observer(
            position=(0.0, -5.0), fov=fov, view_angles=angles, pixels=500, pixels_at="centres" if physical else "edges"
        )
        card = Card(elements_x=tuple(np.linspace(-2.5, 2.5, 4)), y=-1.0, element_width=size, element_height=size)
        transport = transport_matrix(observer, card, GaussianTrain.of_the_code(), weights=weights, tolerance=1e-13)
        captures = CaptureSet(observer=observer, card=card, transport=weights, radiance=radiance(transport, source))
        solution = solve(captures)
        seconds = median_seconds(lambda films=captures: solve(films), repeats=3 if physical else 9)
        rows.append(
            [
                weights,
                f"{scale_free_error(solution.source, source):.1e}",
                f"{scale_free_error(solution.transport, transport):.1e}",
                f"{solution.predicted_error:.1e}",
                f"{solution.step_deg:g}",
                f"{1e3 * seconds:.0f} ms",
                f"{seconds / reference:.0f} x",
            ]
        )
    terminal = Terminal()
    terminal.table(["weights", "V off by", "F off by", "bound says", "knots (deg)", "solve", "over reference"], rows)
    terminal.say(f"reference workload: {1e3 * reference:.1f} ms")


if __name__ == "__main__":
    main()
