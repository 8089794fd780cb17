"""The thesis's performance analysis (section 4.2.3), with the exact solver beside the thesis's own algorithm.

    python validation/performance_analysis.py [--quick] [--only SWEEP] [--jobs N | --dask ADDRESS] [--page]

Mean square errors of pattern and BRDF, the thesis's measures, and relative errors after the best global scale against N,
A, B, A x B, M, the lobes' width, the view angle, alpha and the share of B_diff that is kept: ten values of each, 96
repetitions for `wallmirror.solve`, 32 for Algorithm 3 (`de_render_unstructured`) with the text's alpha 0.1, and 16 for
the same with the recorded run's alpha 10. The solver has no alpha and no support, so it is not run against those.
Captures that its closed form refuses are counted and shown as such; its search for few captures tries them 4 times.

Every finished piece of work goes to a file of its cell at once (--work), so that a run that was stopped goes on where it
stopped; when the code that made them changes, they count no more. A repetition has its own seed: neither the number of
workers nor the order of their work changes a result. --jobs works on this machine, --dask on the cluster of a Dask
scheduler, whose workers need wallmirror and joblib only.

Leaves results/performance_analysis.json, PERFORMANCE_ANALYSIS.md and figures/performance_*.png under --out; --page makes
page and figures anew from the results. --quick (a minute) takes 4 values and 4 repetitions and writes under out/.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from performance_page import write
from performance_runs import REPETITIONS, analyse, chosen, merged, sweeps

HERE = Path(__file__).parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="4 values and 4 repetitions, written under out/")
    parser.add_argument("--only", action="append", choices=list(sweeps()), help="this sweep only (repeatable)")
    parser.add_argument("--repetitions", type=int, help="at most so many of each cell, to see something sooner")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; all processors if left out")
    parser.add_argument("--dask", metavar="ADDRESS", help="of a Dask scheduler, to work on its cluster instead")
    parser.add_argument("--page", action="store_true", help="make page and figures anew from the results, run nothing")
    parser.add_argument("--out", type=Path, help="of results, figures and page")
    parser.add_argument("--work", type=Path, help="where the cells' files lie")
    arguments = parser.parse_args()
    spare = HERE.parent / "out" / f"performance_analysis{'_quick' if arguments.quick else ''}"
    out = arguments.out or (spare if arguments.quick else HERE)
    path = out / "results" / "performance_analysis.json"
    if not arguments.page:
        work = arguments.work or spare / "cells"
        most = arguments.repetitions or (4 if arguments.quick else max(REPETITIONS.values()))
        repetitions = {method: min(most, usual) for method, usual in REPETITIONS.items()}
        places = chosen(arguments.only, quick=arguments.quick)
        document = analyse(places, work, repetitions, jobs=arguments.jobs, dask=arguments.dask)
        if path.exists():
            document = merged(json.loads(path.read_text()), document, whole=arguments.only is None)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document, separators=(",", ":")) + "\n")
    print(f"Wrote {write(json.loads(path.read_text()), out)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
