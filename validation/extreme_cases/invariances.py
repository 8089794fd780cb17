"""What must not change: exactness under powers of two, orders and the mirror image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import wallmirror as wm

from .harness import Case
from .scenes import films, lobes


def cases() -> Iterator[Case]:
    """What must not change: exactness under powers of two, orders and the mirror image."""

    def base() -> tuple[wm.CaptureSet, wm.Solution, np.ndarray]:
        captures, source = films()
        return captures, wm.solve(captures), source

    def scaled() -> tuple[float, float]:
        captures, found, _ = base()
        other = wm.solve(replace(captures, radiance=np.ldexp(captures.radiance, 200)))
        return float(np.max(np.abs(np.ldexp(other.source, -200) - found.source))), 0.0

    yield Case("solve", "radiance x 2^200", "exact", scaled)

    def gauge() -> tuple[float, float]:
        captures, found, source = base()
        brdf = replace(lobes(), scale=7.0)
        other = wm.radiance(wm.transport_matrix(captures.observer, captures.card, brdf, weights="cosine"), source / 7.0)
        again = wm.solve(replace(captures, radiance=other))
        # Another rounding of the same films: eps, magnified by the condition of the problem.
        return wm.scale_free_error(again.source, found.source), 1e-9

    yield Case("solve", "(7 rho, V / 7)", "the same", gauge)

    def mirrored() -> tuple[float, float]:
        captures, found, _ = base()
        flipped = replace(
            captures,
            observer=replace(captures.observer, view_angles=tuple(-a for a in captures.observer.view_angles)),
            card=replace(captures.card, elements_x=tuple(-x for x in captures.card.elements_x)),
            radiance=captures.radiance[:, ::-1],
        )
        other = wm.solve(flipped)
        return wm.scale_free_error(other.source, found.source), 1e-9

    yield Case("solve", "mirror image", "the same", mirrored)

    def shuffled(kind: str) -> tuple[float, float]:
        captures, found, _ = base()
        order = np.array([2, 0, 1])
        if kind == "views":
            angles = tuple(captures.observer.view_angles[i] for i in order)
            other = wm.solve(
                replace(
                    captures, observer=replace(captures.observer, view_angles=angles), radiance=captures.radiance[order]
                )
            )
            return wm.scale_free_error(other.source, found.source), 1e-9
        places = tuple(captures.card.elements_x[i] for i in order)
        other = wm.solve(replace(captures, card=replace(captures.card, elements_x=places)))
        return wm.scale_free_error(other.source, found.source[order]), 1e-9

    for kind in ("views", "elements"):
        yield Case("solve", f"order of {kind}", "the same", lambda k=kind: shuffled(k))
