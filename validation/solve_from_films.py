"""How good is the pattern that is solved from films, and do its error bars tell?

    python validation/solve_from_films.py

Films the scenes with Mitsuba (20 views x 4 patterns, every one of the 80 films with random numbers of its own, 1024
samples per pixel), writes them as EXR capture sets, reads these back and solves them: `flat_wall_lobes` at one bounce
with several root seeds, `cornell_lobes` and `reflective_card` at one bounce and at full depth. Leaves
results/solve_from_films.json beside this file and prints the table. Leaves with 1 if the one-bounce error is above 1 %
or above 1.2 times what the error bars predict (root mean square over the seeds).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from wallmirror import load_scene
from wallmirror.brdf import directional_albedo
from wallmirror.console import Terminal
from wallmirror.files import write_atomically
from wallmirror.jobs.capturing import capture_scene
from wallmirror.jobs.solving import solve_directory

RESULTS = Path(__file__).parent / "results" / "solve_from_films.json"


def film_and_solve(name: str, depth: int, seed: int, spp: int, terminal: Terminal) -> dict[str, object]:
    """One capture set from Mitsuba to solution, over files."""
    scene = load_scene(name)
    with tempfile.TemporaryDirectory() as folder:
        films, out = Path(folder) / "films", Path(folder) / "out"
        with terminal.progress(f"{name}, depth {depth}, seed {seed}") as advance:
            capture_scene(scene, films, spp=spp, seed=seed, max_depth=depth, progress=advance)
        solved = solve_directory(films, out, wall_albedo=directional_albedo(scene.wall.brdf))
    solution, judgement = solved.solution, solved.judgement
    assert judgement is not None
    return {
        "scene": name,
        "max_depth": depth,
        "seed": seed,
        "source_error": judgement.source_error,
        "predicted_error": solution.predicted_error,
        "brdf_error": judgement.brdf_error,
        "chi_squared": solution.chi_squared,
        "foretold_share": solution.one_bounce.share if solution.one_bounce else 0.0,
        "foretold_bias": solution.one_bounce.bias if solution.one_bounce else 0.0,
        "verdict": solution.verdict,
        "seconds": solution.seconds,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8, help="root seeds of flat_wall_lobes")
    parser.add_argument("--spp", type=int, default=1024)
    arguments = parser.parse_args()
    terminal = Terminal()
    runs = [film_and_solve("flat_wall_lobes", 2, seed, arguments.spp, terminal) for seed in range(arguments.seeds)]
    for name in ("cornell_lobes", "reflective_card"):
        runs.extend(film_and_solve(name, depth, 0, arguments.spp, terminal) for depth in (2, 50))
    terminal.table(
        [
            "scene",
            "depth",
            "seed",
            "pattern off by",
            "error bars say",
            "BRDF off by",
            "chi^2",
            "bias foretold",
            "verdict",
        ],
        [
            [
                str(r["scene"]),
                str(r["max_depth"]),
                str(r["seed"]),
                f"{100 * r['source_error']:.3f} %",
                f"{100 * r['predicted_error']:.3f} %",
                f"{100 * r['brdf_error']:.2f} %",
                f"{r['chi_squared']:.3f}",
                f"{100 * r['foretold_bias']:.2f} %",
                str(r["verdict"]),
            ]
            for r in runs
        ],
    )
    flat = [r for r in runs if r["scene"] == "flat_wall_lobes"]
    error = float(np.sqrt(np.mean([r["source_error"] ** 2 for r in flat])))
    ratio = error / float(np.sqrt(np.mean([r["predicted_error"] ** 2 for r in flat])))
    passed = error <= 0.01 and ratio <= 1.2
    terminal.say(f"flat_wall_lobes, rms over {len(flat)} seeds: {100 * error:.3f} %, {ratio:.2f} times the error bars")
    terminal.say("PASSED" if passed else "FAILED")
    result = {"spp": arguments.spp, "rms_error": error, "rms_over_predicted": ratio, "passed": passed, "runs": runs}
    write_atomically(RESULTS, json.dumps(result, indent=2) + "\n")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
