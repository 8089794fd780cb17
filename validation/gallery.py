"""The gallery: the thesis's rendered scenes rebuilt, its claims about them as numbers, and every wall scene.

    python validation/gallery.py [--quick] [--out FOLDER]

Renders each picture scene at one bounce and at all, measures which share of its light one bounce leaves out, and adds a
small picture of every wall scene. Leaves GALLERY.md and gallery/*.png in the folder (docs; with --quick, out/gallery)
and gallery/gallery.json. Shares of the wall scenes are those of results/hypothesis_2.json where it has them; leaves with
1 if a card that cannot reflect does not give exactly one bounce.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from wallmirror import Scene, load_scene, scene_names
from wallmirror.files import write_atomically
from wallmirror.jobs.bouncing import DEEP, SETTINGS, WALLS, Measured, bounces_scene, measure_bounces
from wallmirror.jobs.picturing import WHOLE, RegionBounces
from wallmirror.pathtracing.rendering import picture
from wallmirror.picture_reading import load_picture
from wallmirror.picture_scene import PictureScene
from wallmirror.thesis import Claim
from wallmirror.thesis.picture_claims import judge
from wallmirror.thesis.studies import SPARK, Effort, study, white_of, without_sparks

SCENES = (
    "thesis_spheres",
    "thesis_field",
    "thesis_box_diffuse",
    "thesis_box_mirror",
    "thesis_test_wall",
    "thesis_tilted_mirrors",
)
OPEN = SCENES[4:]
WALL_PASS_SPP = 16
BOUNCES = Path(__file__).parent / "results" / "hypothesis_2.json"
FULL = {"width": 400, "passes": 36, "measured_width": 240, "seeds": 8, "spp": 4, "wall_width": 240, "wall_passes": 12}
QUICK = {"width": 160, "passes": 9, "measured_width": 160, "seeds": 4, "spp": 1, "wall_width": 160, "wall_passes": 4}
NO_CLAIM = "The thesis makes no claim about bounces here; it shows what its first path tracer can do."


# -- pictures ---------------------------------------------------------------------------------------------------


def side_by_side(images: Sequence[np.ndarray], names: Sequence[str]) -> bytes:
    """Pictures in one tone scale beside each other, as a PNG file."""
    height, width = images[0].shape[:2]
    figure = Figure(figsize=(len(images) * (width + 8) / 100, (height + 26) / 100), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for place, image, name in zip(figure.subplots(1, len(images), squeeze=False)[0], images, names, strict=True):
        place.imshow(np.clip(image, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        if name:
            place.set_title(name, fontsize=8)
        place.set_axis_off()
    canvas.draw()
    return as_png(np.asarray(canvas.buffer_rgba())[..., :3])


def as_png(pixels: np.ndarray) -> bytes:
    """A PNG file of 256 colours: tracing noise does not compress."""
    # Colours that are rare, as those of small sources, must not drown in the walls': each counts once more for itself.
    each = np.unique(pixels.reshape(-1, 3) // 16 * 16 + 8, axis=0)
    whole = pixels.shape[0] * pixels.shape[1]
    weighted = np.concatenate([pixels.reshape(-1, 3), np.repeat(each, 1 + whole // (4 * len(each)), axis=0)])
    palette = Image.fromarray(weighted[None].astype(np.uint8)).quantize(256, Image.Quantize.MEDIANCUT)
    stream = io.BytesIO()
    Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(
        stream, "PNG", optimize=True
    )
    return stream.getvalue()


def thumbnail(scene: Scene, width: int, passes: int) -> bytes:
    height = width * 9 // 16
    per_pass = np.array([picture(scene, width, height, spp=WALL_PASS_SPP, seed=seed) for seed in range(passes)])
    white = white_of(per_pass.mean(axis=0))
    grey = np.clip(without_sparks(per_pass, white) / white, 0, 1) ** (1 / 2.2)
    return as_png(np.repeat((255 * grey).round().astype(np.uint8)[..., None], 3, axis=2))


def table(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *rows])


def effort(name: str, settings: dict[str, int]) -> Effort:
    """What the picture of that name costs; where one bounce is all there is, exact zeros need no statistics."""
    spent = {key: settings[key] for key in ("width", "passes", "measured_width", "seeds", "spp")}
    return Effort(**spent | ({"measured_width": 80, "seeds": 4} if name in OPEN else {}))


def studied(name: str, settings: dict[str, int]) -> tuple[bytes, dict[str, RegionBounces], tuple[Claim, ...]]:
    """Picture, numbers and judged claims of one scene."""
    spent = effort(name, settings)
    found = study(load_picture(name), spent)
    images, names = found.images, ["one bounce", f"{DEEP - 1} bounces"]
    if found.found[WHOLE].exact:
        images, names = images[1:], [f"one bounce = {DEEP - 1} bounces"]
    return side_by_side(images, names), found.found, judge(found, spent)


# -- the page ---------------------------------------------------------------------------------------------------


def section(scene: PictureScene, found: dict[str, RegionBounces], claims: tuple[Claim, ...]) -> str:
    rows = []
    for region, bounces in found.items():
        series = bounces.series
        terms = ["dark", "–", "–"] if series is None else [f"{t.value:.3f}" for t in series.terms[:3]]
        rows.append([region, bounces.missing.percent, *terms])
    numbers = table(["region", "missing with one bounce", "k = 2", "k = 3", "k = 4"], rows)
    if found[WHOLE].exact:
        numbers = "Missing with one bounce: 0, exactly."
    judged = table(["the thesis", "verdict", "measured"], [[c.thesis, f"**{c.outcome}**", c.measured] for c in claims])
    return f"""## {scene.title}

![{scene.title}](gallery/{scene.name}.png)

{" ".join(scene.about.split())} (`{scene.name}`)

{numbers}

{judged if claims else NO_CLAIM}
"""


def page(
    studies: dict[str, tuple[dict[str, RegionBounces], tuple[Claim, ...]]], walls: list[tuple[str, str, str]]
) -> str:
    sections = "\n".join(section(load_picture(name), *study) for name, study in studies.items())
    cells = [f"![{title}](gallery/{name}.png)<br>`{name}`<br>{share}" for name, title, share in walls]
    rows = [cells[i : i + 3] for i in range(0, len(cells), 3)]
    rows[-1] += [""] * (3 - len(rows[-1]))
    return f"""# Gallery

The scenes that the thesis rendered, rebuilt (`src/wallmirror/scenes/pictures`), and every wall scene. Pictures of a pair
share one tone scale. "Missing" is the share of all the reflected light that one bounce leaves out; what shines directly
into the camera does not count. k = 2, 3, 4 are the light of that many reflections in units of the one-bounce light of
the region; errors are standard errors over seeds. A claim of closeness is confirmed where less than 5 % is missing.

{sections}
## The wall scenes

One tone scale to each picture. A visitor stands behind the card, whose back is the black rectangle. The number is light
beyond one bounce over light of one bounce, as the wall's observer sees it (`validation/HYPOTHESIS_2.md`). In an open mirror
nothing shows but the strips, and from here the board hides them.

{table(["", "", ""], rows)}

Made by `python validation/gallery.py`. In the pictures, not in the numbers, what a rare path leaves in a single pass over a
pixel is cut at {SPARK[0]:g} times the median of the passes and {SPARK[1]:g} of white: light that glass focuses reaches a
diffuse wall by chance hits of the lamp alone, and would leave white dots all over.
"""


def wall_scenes() -> list[Scene]:
    scenes = {name: load_scene(name) for name in scene_names()}
    for setting in SETTINGS:
        for wall in WALLS:
            scene = bounces_scene(wall, setting)
            scenes.setdefault(scene.name, scene)
    return list(scenes.values())


def measured_before() -> dict[str, str]:
    """Light beyond one bounce by scene, where `hypothesis_2.py` has measured it."""
    if not BOUNCES.exists():
        return {}
    return {
        b["scene"]: "0, exactly" if b["exact"] else Measured(**b["beyond"]).percent
        for b in json.loads(BOUNCES.read_text())["bounces"]
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small pictures and few samples, in about a minute")
    parser.add_argument("--out", type=Path, help="folder to write to")
    arguments = parser.parse_args()
    settings = QUICK if arguments.quick else FULL
    out = arguments.out or (Path("out/gallery") if arguments.quick else Path(__file__).parent.parent / "docs")
    started = time.perf_counter()
    studies: dict[str, tuple[dict[str, RegionBounces], tuple[Claim, ...]]] = {}
    for name in SCENES:
        image, found, claims = studied(name, settings)
        studies[name] = found, claims
        write_atomically(out / "gallery" / f"{name}.png", image)
        verdicts = ", ".join(claim.outcome for claim in claims)
        print(f"{name:<32} missing {found[WHOLE].missing.percent}; {verdicts}", flush=True)
    walls = []
    exact = True
    known = measured_before()
    for scene in wall_scenes():
        write_atomically(
            out / "gallery" / f"{scene.name}.png", thumbnail(scene, settings["wall_width"], settings["wall_passes"])
        )
        if scene.name in known:
            share = known[scene.name]
        else:
            bounces = measure_bounces(scene, seeds=settings["seeds"])
            exact = exact and bounces.exact == scene.is_one_bounce
            share = "0, exactly" if bounces.exact else bounces.beyond.percent
        walls.append((scene.name, scene.title, share))
        print(f"{scene.name:<32} {share}", flush=True)
    document = {
        "settings": settings,
        "seconds": time.perf_counter() - started,
        "pictures": {
            name: {
                "missing": {region: vars(bounces.missing) for region, bounces in found.items()},
                "claims": [{"claim": c.thesis, "verdict": c.outcome, "measured": c.measured} for c in claims],
            }
            for name, (found, claims) in studies.items()
        },
        "walls": {name: share for name, _, share in walls},
    }
    write_atomically(out / "gallery" / "gallery.json", json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_atomically(out / "GALLERY.md", page(studies, walls))
    print("PASSED" if exact else "FAILED")
    return 0 if exact else 1


if __name__ == "__main__":
    sys.exit(main())
