"""What the thesis says about its rendered pictures (section 2.1.2, Fig. 2.11), judged by the numbers of a study."""

from __future__ import annotations

from dataclasses import replace

from wallmirror.jobs.bouncing import DEEP, Measured
from wallmirror.jobs.picturing import WHOLE, RegionBounces
from wallmirror.pathtracing.picturing import PictureRenderer
from wallmirror.thesis.figure import Claim, Outcome
from wallmirror.thesis.studies import Effort, PictureStudy, angle_sums, difference_of_shape, measure


def judge(studied: PictureStudy, effort: Effort) -> tuple[Claim, ...]:
    """The thesis's claims about one of its pictures; none for Fig. 1.5, which shows what a path tracer can do."""
    scene, found = studied.scene, studied.found
    match scene.name:
        case "thesis_field":
            return _of_the_field(found)
        case "thesis_box_diffuse":
            walls = tuple(r for r in scene.regions if r.shape == "back wall")
            dark = replace(scene, background=None, regions=walls)
            through = replace(dark, render=replace(scene.render, hide_emitters=True))
            longer = replace(effort, spp=4 * effort.spp)  # with the background dark little light is left
            alone, uncovered = (measure(variant, longer) for variant in (dark, through))
            _, height, width, _ = studied.one.shape
            mask = PictureRenderer(scene, width=width, height=height).regions()["back wall"]
            shape = difference_of_shape(studied.one, studied.deep, mask)
            return _of_the_box(found, alone, uncovered, shape)
        case "thesis_box_mirror":
            return _of_the_mirror(found)
        case "thesis_test_wall":
            return _of_the_lobes(found, angle_sums(scene, studied.deep.mean(axis=0)))
        case "thesis_tilted_mirrors":
            return _of_the_mirrors(found, angle_sums(scene, studied.deep.mean(axis=0)))
        case _:
            return ()


def _of_the_field(found: dict[str, RegionBounces]) -> tuple[Claim, ...]:
    missing = {name: region.missing for name, region in found.items()}
    glass, metal, ground = missing["glass sphere"], missing["metal sphere"], missing["ground"]
    lower, upper = (missing[f"diffuse sphere, {half} half"] for half in ("lower", "upper"))
    below = missing["metal sphere, lower half"]
    others = (metal, ground, lower, upper)
    fine: Outcome = _below(upper, 0.05)
    if fine == "refuted":  # the upper half is not fine either, but what the thesis saw of the lower is there
        fine = "corrected" if lower.low > upper.high else "refuted" if lower.high < upper.low else "undecided"
    return (
        Claim(
            thesis="Glass suffers the most.",
            outcome="confirmed"
            if glass.low > max(other.high for other in others)
            else "refuted"
            if glass.high < max(other.low for other in others)
            else "undecided",
            measured=f"The glass sphere lacks {glass.percent} of its light, the metal sphere {metal.percent}.",
        ),
        Claim(
            thesis="Mirrors tell sky from geometry, but lose the geometry's colour.",
            outcome="confirmed" if below.low > metal.high else "refuted" if below.high < metal.low else "undecided",
            measured=f"The lower half of the metal sphere, where it shows the ground, lacks {below.percent}: "
            "not a colour but black.",
        ),
        Claim(
            thesis="Diffuse materials are rendered fine, except for the lower part of spheres.",
            outcome=fine,
            measured=f"The lower half of the diffuse sphere lacks {lower.percent}, but the upper half "
            f"{upper.percent} as well; the ground {ground.percent}.",
        ),
    )


def _of_the_box(
    found: dict[str, RegionBounces],
    alone: dict[str, RegionBounces],
    uncovered: dict[str, RegionBounces],
    shape: float,
) -> tuple[Claim, ...]:
    wall, source, spot = (measured["back wall"].missing for measured in (found, alone, uncovered))
    similar = _below(wall, 0.05)
    if similar == "refuted" and shape < 0.1:
        similar = "corrected"
    close = _below(spot, 0.05)
    if close == "confirmed" and _below(source, 0.05) != "confirmed":
        close = "corrected" if _below(source, 0.05) == "refuted" else "undecided"
    return (
        Claim(
            thesis="The back wall with one bounce is really similar to the one with fifty.",
            outcome=similar,
            measured=f"It lacks {wall.percent} of its light. After the best common factor, blocks of 8 x 8 "
            f"pixels still differ by {100 * shape:.1f} % in shape and colour: an eye that adapts sees little of it, a "
            "measurement all of it.",
        ),
        Claim(
            thesis="For a source before a diffuse wall, the first two terms are very close.",
            outcome=close,
            measured=f"With the background dark the wall lacks {spot.percent} if the camera looks through the "
            f"source at the spot that it lights, and {source.percent} if the source covers that spot, as it does in "
            "the thesis.",
        ),
    )


def _of_the_mirror(found: dict[str, RegionBounces]) -> tuple[Claim, ...]:
    source, floor = found["sources in the mirror"], found["floor in the mirror"].missing
    return (
        Claim(
            thesis="The entirety of the source is reflected with one bounce.",
            outcome="confirmed" if source.exact else "refuted",
            measured="The sources' image in the mirror is the same at one bounce and at "
            f"{DEEP - 1}{', to the bit' if source.exact else f' but for {source.missing.percent}'}.",
        ),
        Claim(
            thesis="Nothing else than what shines is reflected properly.",
            outcome="confirmed" if floor.low > 0.5 else "refuted" if floor.high < 0.5 else "undecided",
            measured=f"The floor in the mirror lacks {floor.percent}; the whole back wall "
            f"{found['back wall'].missing.percent}, and the diffuse floor itself {found['floor'].missing.percent}.",
        ),
    )


def _of_the_lobes(found: dict[str, RegionBounces], sums: list[float]) -> tuple[Claim, ...]:
    right = max(abs(s - e) for s, e in zip(sums, (30, 15, -15, -30), strict=True)) < 1.5
    copies = Claim(
        thesis="The BRDF copies and blurs the light source four times.",
        outcome="corrected" if right else "refuted",
        measured=f"There are four copies, at angle sums of {_degrees(sums)}. But they keep the card's columns only: "
        "eq. 2.15 says nothing about the vertical, and constant along it the rows are smeared out."
        + _all_there_is(found),
    )
    return (copies,)


def _of_the_mirrors(found: dict[str, RegionBounces], sums: list[float]) -> tuple[Claim, ...]:
    twice = max(abs(s - e) for s, e in zip(sums, (60, 30, -30, -60), strict=True)) < 1.5
    real = Claim(
        thesis="Fig. 2.11 is a real-world render of the test BRDF.",
        outcome="refuted" if twice else "confirmed",
        measured=f"Mirrors tilted by 15° and 30° show the card at angle sums of {_degrees(sums)}, twice those of "
        "eq. 2.15, and sharp." + _all_there_is(found),
    )
    return (real,)


def _below(share: Measured, limit: float) -> Outcome:
    """Whether a share lies below a limit, as far as its interval tells."""
    return "confirmed" if share.high < limit else "refuted" if share.low > limit else "undecided"


def _degrees(angles: list[float]) -> str:
    return ", ".join(f"{angle:.1f}°" for angle in angles)


def _all_there_is(found: dict[str, RegionBounces]) -> str:
    return " One bounce is all there is, to the bit." if found[WHOLE].exact else ""
