"""How far may the thesis's formulas be used? Each against the physical one-bounce transport, without a path tracer.

    python validation/simplifications.py [--out validation]

The thesis's formulas are points with weight 1 ("thesis"), with cos theta_s ("cosine"), with the solid angle of a point
("points": cos theta_s cos theta_l / r^2), and the tall strip in two dimensions ("tall": pi/2 integral rho cos). For
strips of many widths, heights and distances, relative L2 errors over the picture of the thesis's observer, lit by four
equal strips, are written: after the best global scale, which a blind solution never knows, and without it where scale
has meaning ("points" times the strip's area, "tall" as it is). The wall has the four lobes of sigma 1 deg, or is
diffuse. The card's strips span 5 m, and the observer stands 4 m behind it, whatever its distance.

Leaves results/simplifications.csv and .json and figures/simplifications.png.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from wallmirror.brdf import AngleSumBRDF, Diffuse, GaussianTrain
from wallmirror.geometry import Card, Observer
from wallmirror.transport import build_kernel, strip_factor

WIDTHS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
HEIGHTS = (0.01, 0.02, 0.1, 0.5, 1.0, 2.0, 5.0, 20.0, 50.0)
DISTANCES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
MODELS = ("thesis", "cosine", "points", "tall")
WALLS: dict[str, AngleSumBRDF] = {"lobes": GaussianTrain.of_the_code(), "diffuse": Diffuse(albedo=0.5)}
#: The strip that is varied in one of its three lengths at a time, in metres: that of the shipped scenes.
USUAL = {"width": 0.02, "height": 0.02, "distance": 1.0}
PIXELS = 200
#: Half-heights of the limits that an early prototype measured, at distance 1, straight below the strip's middle.
HALF_HEIGHTS = {0.5: 0.94, 10.0: 5.6e-4, 50.0: 6.6e-6}


def scene(width: float, height: float, distance: float) -> tuple[Observer, Card]:
    """Four strips across 5 m and an observer 4 m behind the card, straight ahead with 60 deg, pixels as points."""
    observer = Observer(
        position=(0.0, -(distance + 4.0)),
        fov=math.radians(60),
        view_angles=(0.0,),
        pixels=PIXELS,
        pixels_at="edges",
    )
    card = Card(elements_x=(-2.5, -2.5 / 3, 2.5 / 3, 2.5), y=-distance, element_width=width, element_height=height)
    return observer, card


def physical(observer: Observer, card: Card, brdf: AngleSumBRDF) -> np.ndarray:
    """F of the reflection equation, shape (N, M), in steradians times the BRDF."""
    return build_kernel(observer, card, resolution=brdf.angular_scale, tolerance=1e-9).apply(brdf)[0]


def simplified(model: str, observer: Observer, card: Card, brdf: AngleSumBRDF) -> np.ndarray:
    """F of one of the thesis's formulas, shape (N, M)."""
    if model == "tall":
        # The physical kernel with the height integral at its limit: exact where that integral is.
        kernel = build_kernel(observer, card, resolution=brdf.angular_scale, tolerance=1e-9)
        dx = card.distance * np.tan(kernel.theta_s)
        half = card.element_height / 2
        limit = math.pi / 2 * np.cos(kernel.theta_s) ** 3 / card.distance
        share = limit / strip_factor(card.distance, dx, -half, half)
        return replace(kernel, weight=kernel.weight * share).apply(brdf)[0]
    if model == "points":
        bare = replace(card, element_width=0.0, element_height=0.0)
        area = card.element_width * card.element_height
        return build_kernel(observer, bare, weights="physical").apply(brdf)[0] * area
    weights = "thesis" if model == "thesis" else "cosine"
    return build_kernel(observer, card, weights=weights).apply(brdf)[0]


def relative_error(approximation: np.ndarray, truth: np.ndarray) -> float:
    """Relative L2 error, with the scale as it is."""
    return float(np.linalg.norm(approximation - truth) / np.linalg.norm(truth))


def shape_error(approximation: np.ndarray, truth: np.ndarray) -> float:
    """Relative L2 error after the best global scale."""
    squared = float(np.sum(approximation**2))
    return 1.0 if squared == 0 else relative_error(approximation * np.sum(approximation * truth) / squared, truth)


def study() -> list[dict[str, object]]:
    """Errors of all formulas for one length varied at a time, and for width, height and distance together."""
    cases = [("width", {**USUAL, "width": w}) for w in WIDTHS]
    cases += [("height", {**USUAL, "height": h}) for h in HEIGHTS]
    cases += [("distance", {**USUAL, "distance": z}) for z in DISTANCES]
    cases += [("distance of tall strips", {**USUAL, "height": 50.0, "distance": z}) for z in DISTANCES]
    cases += [
        ("all", {"width": w, "height": h, "distance": z})
        for w in (0.005, 0.05, 0.5)
        for h in (0.01, 1.0, 50.0)
        for z in (0.1, 1.0, 10.0, 100.0)
    ]
    rows: list[dict[str, object]] = []
    for wall, brdf in WALLS.items():
        for varied, lengths in cases:
            observer, card = scene(**lengths)
            truth = physical(observer, card, brdf)
            for model in MODELS:
                guess = simplified(model, observer, card, brdf)
                # Of the picture (four equal strips) and of the whole matrix, where strips do not average out.
                rows.append(
                    {
                        "wall": wall,
                        "varied": varied,
                        **lengths,
                        "model": model,
                        "picture_after_scale": shape_error(guess.sum(axis=1), truth.sum(axis=1)),
                        "matrix_after_scale": shape_error(guess, truth),
                        "matrix_as_is": relative_error(guess, truth) if model in ("points", "tall") else None,
                    }
                )
    return rows


def limits() -> dict[str, dict[str, float]]:
    """The tall-strip limit against the strip's closed form at distance 1, both ways of stating how far off it is."""
    result = {}
    for half, recorded in HALF_HEIGHTS.items():
        true = float(strip_factor(1.0, 0.0, -half, half))
        limit = math.pi / 2
        result[f"{half:g}"] = {
            "of_the_truth": limit / true - 1,
            "of_the_limit": 1 - true / limit,
            "half_height_is_height": limit / float(strip_factor(1.0, 0.0, -half / 2, half / 2)) - 1,
            "recorded": recorded,
        }
    return result


def figure(rows: list[dict[str, object]], path: Path) -> None:
    """Errors after the best scale over width, height and distance, one row of axes for each wall."""
    chart, axes = plt.subplots(2, 4, figsize=(12, 5.6), sharey=True, layout="constrained")
    styles = {"thesis": "o-", "cosine": "s--", "points": "^-.", "tall": "v:"}
    for line, wall in zip(axes, WALLS):
        for axis, varied in zip(line, ("width", "height", "distance", "distance of tall strips")):
            length = varied.split(" ")[0]
            for model in MODELS:
                mine = [r for r in rows if (r["wall"], r["varied"], r["model"]) == (wall, varied, model)]
                x, y = [r[length] for r in mine], [r["matrix_after_scale"] for r in mine]
                axis.loglog(x, np.maximum(np.array(y, dtype=float), 1e-12), styles[model], label=model, markersize=4)
            axis.set_xlabel(f"{length} in m" + (" (strips 50 m high)" if "tall" in varied else ""))
            axis.grid(alpha=0.3)
            axis.set_ylim(1e-7, 2)
        line[0].set_ylabel(f"{wall} wall: relative L2 error")
    axes[0, 0].legend(fontsize=8)
    chart.suptitle("The thesis's formulas against the physical transport, after the best global scale")
    chart.savefig(path, dpi=90)
    plt.close(chart)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    out = parser.parse_args().out
    rows = study()
    for folder in ("results", "figures"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    with (out / "results" / "simplifications.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {k: f"{v:.4e}" if isinstance(v, float) and k.startswith(("p", "ma")) else v for k, v in row.items()}
            )
    document = {"usual": USUAL, "pixels": PIXELS, "limits": limits(), "rows": rows}
    (out / "results" / "simplifications.json").write_text(json.dumps(document, indent=1) + "\n")
    figure(rows, out / "figures" / "simplifications.png")
    for wall in WALLS:
        for varied in ("width", "height", "distance", "distance of tall strips"):
            length = varied.split(" ")[0]
            print(f"\n{wall} wall, {varied} varied: error of the matrix after the best scale (as it is)")
            print(f"{length:>9} " + "".join(f"{m:>20}" for m in MODELS))
            mine = [r for r in rows if (r["wall"], r["varied"]) == (wall, varied)]
            for k in range(0, len(mine), len(MODELS)):
                cells = [
                    f"{r['matrix_after_scale']:.1e}"
                    + (f" ({r['matrix_as_is']:.1e})" if r["matrix_as_is"] is not None else "")
                    for r in mine[k : k + len(MODELS)]
                ]
                print(f"{mine[k][length]:>9g} " + "".join(f"{c:>20}" for c in cells))
    print("\ntall-strip limit at distance 1:", json.dumps(limits(), indent=1))


if __name__ == "__main__":
    main()
