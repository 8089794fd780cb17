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
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from wallmirror import Scene, load_scene, scene_names
from wallmirror.files import write_atomically
from wallmirror.jobs.bouncing import DEEP, SETTINGS, WALLS, Measured, bounces_scene, measure_bounces
from wallmirror.jobs.picturing import WHOLE, RegionBounces, measure_picture_bounces
from wallmirror.pathtracing.picturing import PictureRenderer
from wallmirror.pathtracing.rendering import picture
from wallmirror.picture_reading import load_picture
from wallmirror.picture_scene import PictureScene

SCENES = (
    "thesis_spheres",
    "thesis_field",
    "thesis_box_diffuse",
    "thesis_box_mirror",
    "thesis_test_wall",
    "thesis_tilted_mirrors",
)
OPEN = SCENES[4:]
PASS_SPP = 4
WALL_PASS_SPP = 16
BOUNCES = Path(__file__).parent / "results" / "hypothesis_2.json"
FULL = {"width": 400, "passes": 36, "measured_width": 240, "seeds": 8, "spp": 4, "wall_width": 240, "wall_passes": 12}
QUICK = {"width": 160, "passes": 9, "measured_width": 160, "seeds": 4, "spp": 1, "wall_width": 160, "wall_passes": 4}
#: A pass beyond this many times the pixel's median plus this share of white is cut there, in pictures alone.
SPARK = (2.0, 0.2)
NO_CLAIM = "The thesis makes no claim about bounces here; it shows what its first path tracer can do."
Claims = list[tuple[str, str, str]]


# -- pictures ---------------------------------------------------------------------------------------------------


def renders(scene: PictureScene, width: int, passes: int) -> list[np.ndarray]:
    """One bounce and all, by pass: two arrays (passes, height, width, 3) with common random numbers."""
    height = round(width * scene.render.height / scene.render.width)
    renderer = PictureRenderer(scene, width=width, height=height)
    return [renderer.render(depth, spp=PASS_SPP, seeds=range(passes)).per_seed for depth in (2, DEEP)]


def white_of(image: np.ndarray) -> float:
    light = image.mean(axis=-1) if image.ndim == 3 else image
    return float(np.quantile(light[light > 0], 0.97))


def without_sparks(per_pass: np.ndarray, white: float) -> np.ndarray:
    """Mean over the passes, after cutting what a rare bright path left in one of them."""
    return np.minimum(per_pass, SPARK[0] * np.median(per_pass, axis=0) + SPARK[1] * white).mean(axis=0)


def side_by_side(images: Sequence[np.ndarray], names: Sequence[str], white: float) -> bytes:
    """Pictures in one tone scale beside each other, as a PNG file."""
    height, width = images[0].shape[:2]
    figure = Figure(figsize=(len(images) * (width + 8) / 100, (height + 26) / 100), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for place, image, name in zip(figure.subplots(1, len(images), squeeze=False)[0], images, names, strict=True):
        place.imshow(np.clip(image / white, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
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


# -- numbers ----------------------------------------------------------------------------------------------------


def difference_of_shape(one: np.ndarray, deep: np.ndarray, mask: np.ndarray, block: int = 8) -> float:
    """Relative difference of two pictures over a mask after the best common factor, noise taken out.

    The pictures are averaged over blocks of pixels that lie inside the mask; two halves of the passes have independent
    noise, so that the product of their differences has none on average.
    """
    height, width = (size // block * block for size in mask.shape)

    def blocks(image: np.ndarray) -> np.ndarray:
        cut = image[:height, :width].reshape(height // block, block, width // block, block, -1).mean(axis=(1, 3))
        inside = mask[:height, :width].reshape(height // block, block, width // block, block).all(axis=(1, 3))
        return cut[inside]

    halves = []
    for half in (slice(0, None, 2), slice(1, None, 2)):
        a, b = blocks(one[half].mean(axis=0)), blocks(deep[half].mean(axis=0))
        halves.append((np.sum(a * b) / np.sum(a * a) * a - b, b))
    product = float(np.sum(halves[0][0] * halves[1][0]) / np.sum(halves[0][1] * halves[1][1]))
    return math.sqrt(max(0.0, product))


def angle_sums(scene: PictureScene, image: np.ndarray) -> list[float]:
    """Angle sums in degrees at which a card beside the axis shows in the columns of a picture, from left to right."""
    eye, card = scene.camera.position, scene.shape("card").geometry.centre
    height, width = image.shape[:2]
    half = math.tan(scene.camera.fov / 2) * width / height
    x = -eye[1] * half * ((np.arange(width) + 0.5) / width * 2 - 1)
    u = np.degrees(np.arctan2(card[0] - x, -card[1]) + np.arctan2(eye[0] - x, -eye[1]))
    light = image.mean(axis=(0, 2))
    found = []
    for side in (x < 0, x > 0):
        share = np.cumsum(light[side]) / light[side].sum()
        between = np.flatnonzero((share > 0.3) & (share < 0.7))
        smooth = np.convolve(light[side], np.ones(5) / 5, "same")
        cut = between[np.argmin(smooth[between])]
        for part in (slice(0, cut), slice(cut, None)):
            found.append(float(np.average(u[side][part], weights=light[side][part])))
    return found


def percent(measured: Measured) -> str:
    error = 100 * measured.error
    if error <= 0:
        return f"{100 * measured.value:.3g} %, exactly"
    digits = max(0, min(6, 1 - math.floor(math.log10(error))))
    return f"{100 * measured.value:.{digits}f} ± {error:.{digits}f} %"


def table(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *rows])


# -- the thesis's claims ----------------------------------------------------------------------------------------


def claims_of_the_field(found: dict[str, RegionBounces]) -> Claims:
    missing = {name: region.missing for name, region in found.items()}
    glass, metal, ground = missing["glass sphere"], missing["metal sphere"], missing["ground"]
    lower, upper = (missing[f"diffuse sphere, {half} half"] for half in ("lower", "upper"))
    below = missing["metal sphere, lower half"]
    most = glass.low > max(other.high for other in (metal, ground, lower, upper))
    return [
        (
            "Glass suffers the most.",
            "confirmed" if most else "refuted",
            f"The glass sphere lacks {percent(glass)} of its light, the metal sphere {percent(metal)}.",
        ),
        (
            "Mirrors tell sky from geometry, but lose the geometry's colour.",
            "confirmed" if below.low > metal.high else "refuted",
            f"The lower half of the metal sphere, where it shows the ground, lacks {percent(below)}: not a colour but black.",
        ),
        (
            "Diffuse materials are rendered fine, except for the lower part of spheres.",
            "corrected"
            if lower.low > upper.high and upper.low > 0.05
            else "confirmed"
            if upper.high < 0.05
            else "refuted",
            f"The lower half of the diffuse sphere lacks {percent(lower)}, but the upper half {percent(upper)} as well; the "
            f"ground {percent(ground)}.",
        ),
    ]


def claims_of_the_box(
    found: dict[str, RegionBounces],
    alone: dict[str, RegionBounces],
    uncovered: dict[str, RegionBounces],
    shape: float,
) -> Claims:
    wall, source, spot = (measured["back wall"].missing for measured in (found, alone, uncovered))
    verdict = "confirmed" if wall.high < 0.05 else "corrected" if shape < 0.1 else "refuted"
    return [
        (
            "The back wall with one bounce is really similar to the one with fifty.",
            verdict,
            f"It lacks {percent(wall)} of its light. After the best common factor, blocks of 8 x 8 pixels still differ by "
            f"{100 * shape:.1f} % in shape and colour: an eye that adapts sees little of it, a measurement all of it.",
        ),
        (
            "For a source before a diffuse wall, the first two terms are very close.",
            "confirmed" if max(spot.high, source.high) < 0.05 else "corrected" if spot.high < 0.05 else "refuted",
            f"With the background dark the wall lacks {percent(spot)} if the camera looks through the source at the spot "
            f"that it lights, and {percent(source)} if the source covers that spot, as it does in the thesis.",
        ),
    ]


def claims_of_the_mirror(found: dict[str, RegionBounces]) -> Claims:
    source, floor = found["sources in the mirror"], found["floor in the mirror"].missing
    return [
        (
            "The entirety of the source is reflected with one bounce.",
            "confirmed" if source.exact else "refuted",
            "The sources' image in the mirror is the same at one bounce and at "
            f"{DEEP - 1}{', to the bit' if source.exact else f' but for {percent(source.missing)}'}.",
        ),
        (
            "Nothing else than what shines is reflected properly.",
            "confirmed" if floor.low > 0.5 else "refuted",
            f"The floor in the mirror lacks {percent(floor)}; the whole back wall {percent(found['back wall'].missing)}, "
            f"and the diffuse floor itself {percent(found['floor'].missing)}.",
        ),
    ]


def claims_of_the_lobes(found: dict[str, RegionBounces], sums: list[float]) -> Claims:
    right = max(abs(s - e) for s, e in zip(sums, (30, 15, -15, -30), strict=True)) < 1.5
    return [
        (
            "The BRDF copies and blurs the light source four times.",
            "corrected" if right else "refuted",
            f"There are four copies, at angle sums of {', '.join(f'{s:.1f}°' for s in sums)}. But they keep the card's "
            "columns only: eq. 2.15 says nothing about the vertical, and constant along it the rows are smeared out."
            + (" One bounce is all there is, to the bit." if found[WHOLE].exact else ""),
        )
    ]


def claims_of_the_mirrors(found: dict[str, RegionBounces], sums: list[float]) -> Claims:
    twice = max(abs(s - e) for s, e in zip(sums, (60, 30, -30, -60), strict=True)) < 1.5
    return [
        (
            "Fig. 2.11 is a real-world render of the test BRDF.",
            "refuted" if twice else "confirmed",
            f"Mirrors tilted by 15° and 30° show the card at angle sums of {', '.join(f'{s:.1f}°' for s in sums)}, twice those "
            "of eq. 2.15, and sharp." + (" One bounce is all there is, to the bit." if found[WHOLE].exact else ""),
        )
    ]


def studied(name: str, settings: dict[str, int]) -> tuple[bytes, dict[str, RegionBounces], Claims]:
    """Picture, numbers and judged claims of one scene."""
    scene = load_picture(name)
    one, deep = renders(scene, settings["width"], settings["passes"])
    measure = {"width": settings["measured_width"], "spp": settings["spp"], "seeds": settings["seeds"]}
    if name in OPEN:
        measure |= {"width": 80, "seeds": 4}  # exact zeros need no statistics
    found = measure_picture_bounces(scene, **measure)
    white = white_of(deep.mean(axis=0))
    images = [without_sparks(image, white) for image in (one, deep)]
    names = ["one bounce", f"{DEEP - 1} bounces"]
    if found[WHOLE].exact:
        images, names = images[1:], [f"one bounce = {DEEP - 1} bounces"]
    claims: Claims = []
    match name:
        case "thesis_field":
            claims = claims_of_the_field(found)
        case "thesis_box_diffuse":
            walls = tuple(r for r in scene.regions if r.shape == "back wall")
            dark = replace(scene, background=None, regions=walls)
            through = replace(dark, render=replace(scene.render, hide_emitters=True))
            alone, uncovered = (measure_picture_bounces(variant, **measure) for variant in (dark, through))
            mask = PictureRenderer(scene, width=one.shape[2], height=one.shape[1]).regions()["back wall"]
            claims = claims_of_the_box(found, alone, uncovered, difference_of_shape(one, deep, mask))
        case "thesis_box_mirror":
            claims = claims_of_the_mirror(found)
        case "thesis_test_wall":
            claims = claims_of_the_lobes(found, angle_sums(scene, deep.mean(axis=0)))
        case "thesis_tilted_mirrors":
            claims = claims_of_the_mirrors(found, angle_sums(scene, deep.mean(axis=0)))
    return side_by_side(images, names, white), found, claims


# -- the page ---------------------------------------------------------------------------------------------------


def section(scene: PictureScene, found: dict[str, RegionBounces], claims: Claims) -> str:
    rows = []
    for region, bounces in found.items():
        series = bounces.series
        terms = ["dark", "–", "–"] if series is None else [f"{t.value:.3f}" for t in series.terms[:3]]
        rows.append([region, percent(bounces.missing), *terms])
    numbers = table(["region", "missing with one bounce", "k = 2", "k = 3", "k = 4"], rows)
    if found[WHOLE].exact:
        numbers = "Missing with one bounce: 0, exactly."
    judged = table(["the thesis", "verdict", "measured"], [[c, f"**{v}**", text] for c, v, text in claims])
    return f"""## {scene.title}

![{scene.title}](gallery/{scene.name}.png)

{" ".join(scene.about.split())} (`{scene.name}`)

{numbers}

{judged if claims else NO_CLAIM}
"""


def page(studies: dict[str, tuple[dict[str, RegionBounces], Claims]], walls: list[tuple[str, str, str]]) -> str:
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
        b["scene"]: "0, exactly" if b["exact"] else percent(Measured(**b["beyond"]))
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
    studies: dict[str, tuple[dict[str, RegionBounces], Claims]] = {}
    for name in SCENES:
        image, found, claims = studied(name, settings)
        studies[name] = found, claims
        write_atomically(out / "gallery" / f"{name}.png", image)
        verdicts = ", ".join(verdict for _, verdict, _ in claims)
        print(f"{name:<32} missing {percent(found[WHOLE].missing)}; {verdicts}", flush=True)
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
            share = "0, exactly" if bounces.exact else percent(bounces.beyond)
        walls.append((scene.name, scene.title, share))
        print(f"{scene.name:<32} {share}", flush=True)
    document = {
        "settings": settings,
        "seconds": time.perf_counter() - started,
        "pictures": {
            name: {
                "missing": {region: vars(bounces.missing) for region, bounces in found.items()},
                "claims": [{"claim": c, "verdict": v, "measured": text} for c, v, text in claims],
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
