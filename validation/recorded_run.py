"""The thesis's recorded run: is our forward model its forward model, and how well is its data solved?

    python validation/recorded_run.py PATH/TO/thesis_recorded_run.mat

The file holds the renders `g` (N, B, A), the true pattern `s` (M, B) and weighted BRDF `brdf_mat` (N, M, A), the
thesis's own estimates of both, and its geometry. Prints a table (or, with --json, one JSON document) and leaves with
1 if the forward model differs by more than 1e-12 or an estimate misses a mean square error of 1e-24.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from wallmirror import CaptureSet, GaussianTrain, InputError, radiance, solve, transport_matrix, wall_points
from wallmirror.captures.recorded import RecordedRun, read_recorded_run


def scaled_errors(source: np.ndarray, brdf: np.ndarray, recorded: RecordedRun) -> tuple[float, float]:
    """Mean square errors of pattern and BRDF after the one global scale that no method can know."""
    scale = np.sum(source * recorded.source) / np.sum(source**2)
    source_error = np.mean((scale * source - recorded.source) ** 2)
    return float(source_error), float(np.mean((brdf / scale - recorded.brdf) ** 2))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    try:
        recorded = read_recorded_run(arguments.path)
    except InputError as error:
        sys.exit(str(error))
    observer, card = recorded.observer, recorded.card

    model = transport_matrix(observer, card, GaussianTrain.of_the_code(), weights="thesis")
    forward = {
        "wall points": float(np.max(np.abs(wall_points(observer) - recorded.wall_x))),
        "weighted BRDF": float(np.max(np.abs(model - recorded.brdf))),
        "renders": float(np.max(np.abs(radiance(model, recorded.source) - recorded.radiance))),
    }
    captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=recorded.radiance)
    seconds = []
    for _ in range(5):  # the first call also pays for imports inside SciPy
        started = time.perf_counter()
        solution = solve(captures)
        seconds.append(time.perf_counter() - started)
    ours = scaled_errors(solution.source, solution.transport, recorded)
    plain = (
        float(np.mean((recorded.source_estimate - recorded.source) ** 2)),
        float(np.mean((recorded.brdf_estimate - recorded.brdf) ** 2)),
    )
    scaled = scaled_errors(recorded.source_estimate, recorded.brdf_estimate, recorded)
    passed = max(forward.values()) <= 1e-12 and max(ours) <= 1e-24
    result = {
        "forward_max_difference": forward,
        "mse": {
            "wallmirror": {"source": ours[0], "brdf": ours[1]},
            "thesis, as recorded": {"source": plain[0], "brdf": plain[1]},
            "thesis, best scale": {"source": scaled[0], "brdf": scaled[1]},
        },
        "method": solution.method,
        "mismatch": solution.mismatch,
        "seconds": {"median": float(np.median(seconds)), "runs": seconds},
        "passed": passed,
    }
    if arguments.json:
        print(json.dumps(result, indent=2))
        return 0 if passed else 1
    print("forward model against the recorded arrays (largest difference)")
    for name, difference in forward.items():
        print(f"  {name:<16} {difference:.1e}")
    print("blind solution of the recorded renders (mean square error)")
    print(f"  {'':<22} {'pattern':>10} {'BRDF':>10}")
    for name, errors in result["mse"].items():
        print(f"  {name:<22} {errors['source']:>10.1e} {errors['brdf']:>10.1e}")
    print(f"  solved in {1e3 * np.median(seconds):.0f} ms (median of {len(seconds)}), {solution.status}")
    print("PASSED" if passed else "FAILED")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
