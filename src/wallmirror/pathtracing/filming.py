"""Filming a Scene: all its captures, and the transport matrix by linearity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.captures import CaptureSet
from wallmirror.memory import film_bytes, require_memory, transport_bytes
from wallmirror.pathtracing.cameras import Sampler
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.scene import Scene

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

# Neighbours whose scatter steadies that of a pixel, and how many seeds their mean is worth.
_NEIGHBOURS = 5
_PRIOR_SEEDS = 20


class Store(Protocol):
    """Where captures are kept as they come, such as `wallmirror.captures.unfinished.UnfinishedSet`."""

    def load(self, view: int, realisation: int) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Radiance and variance of a capture that is there, shape (N,) each."""

    def save(
        self, view: int, realisation: int, radiance: ArrayLike, variance: ArrayLike
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Keep a capture; what comes back is what was kept."""


def render_captures(
    scene: Scene,
    *,
    spp: int | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    rr_depth: int | None = None,
    sampler: Sampler = "independent",
    seeds: int = 1,
    variant: str = "llvm_ad_mono",
    progress: Progress | None = None,
    open_store: Callable[[dict[str, str]], Store] | None = None,
) -> CaptureSet:
    """Render each view of each realisation on its own, with random numbers of its own.

    Parameters
    ----------
    spp, max_depth, rr_depth:
        Samples per pixel of each seed, and the depths; the scene's own where left out.
    seed:
        Root of all seeds, any integer >= 0.
    sampler, seeds:
        How samples are drawn, and how many seeds are averaged in each capture. Stratified samples need several, from
        whose scatter, steadied by that of the neighbouring pixels, their variance is known.
    progress:
        Called with (captures done, captures in all).
    open_store:
        Given the provenance, makes the place where captures are kept; those that are there are not rendered again.

    Returns
    -------
    Radiance and variance, both (A, N, B), with the geometry; the variance is that of `Render.moment_variance` for
    independent samples. With a store they are what it keeps.

    Raises
    ------
    InputError
        If the scene cannot be rendered, or the memory does not hold the captures.
    """
    views, pixels, realisations = scene.observer.views, scene.observer.pixels, scene.source.shape[1]
    require_memory(
        film_bytes(views, pixels, realisations),
        f"a capture set of {views} views x {pixels} pixels x {realisations} realisations",
    )
    renderer = Renderer(scene, variant=variant)
    settings = scene.render
    spp = settings.spp if spp is None else spp
    max_depth = settings.max_depth if max_depth is None else max_depth
    rr_depth = settings.rr_depth if rr_depth is None else rr_depth
    radiance, variance = np.empty((2, views, pixels, realisations))
    runtime = renderer.runtime
    provenance = {
        "scene": scene.name,
        "renderer": f"mitsuba {runtime.mitsuba_version} {runtime.variant}",
        "spp": str(spp * seeds),
        **({} if sampler == "independent" else {"sampler": sampler}),
        **({} if seeds == 1 else {"seeds": str(seeds)}),
        "max_depth": str(max_depth),
        "rr_depth": str(rr_depth),
        "seed": str(seed),
    }
    store = None if open_store is None else open_store(provenance)
    roots = spread_seeds(seed, views * realisations * seeds)
    for done in range(views * realisations):
        view, realisation = divmod(done, realisations)
        kept = None if store is None else store.load(view, realisation)
        if kept is None:
            render = renderer.render(
                view,
                scene.source[:, realisation],
                spp=spp,
                seeds=roots[done * seeds : (done + 1) * seeds],
                max_depth=max_depth,
                rr_depth=rr_depth,
                sampler=sampler,
            )
            known = render.method == "moments"
            kept = render.mean, render.variance if known else steadied(render.variance, seeds)
            if store is not None:
                kept = store.save(view, realisation, *kept)
        radiance[view, :, realisation], variance[view, :, realisation] = kept
        if progress is not None:
            progress(done + 1, views * realisations)
    return CaptureSet(
        observer=scene.observer,
        card=scene.card,
        room=scene.room,
        radiance=radiance,
        variance=variance,
        provenance=provenance,
    )


def steadied(variance: Array, seeds: int) -> Array:
    """The seeds' variance, shape (N,), drawn towards the mean of the neighbours: a few seeds know it but roughly."""
    wide = np.pad(variance, _NEIGHBOURS // 2, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(wide, _NEIGHBOURS).mean(axis=-1)
    return np.asarray(((seeds - 1) * variance + _PRIOR_SEEDS * around) / (seeds - 1 + _PRIOR_SEEDS))


def render_one_hot(
    scene: Scene,
    *,
    spp: int | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    rr_depth: int | None = None,
    variant: str = "llvm_ad_mono",
    progress: Progress | None = None,
) -> Array:
    """The transport matrix by Monte Carlo, shape (A, N, M): what each strip alone sends to each pixel.

    The M columns of one view share their random numbers, so that any mixture of them is, up to rounding, what
    rendering the mixture with the same seed would give. Parameters are those of `render_captures`.
    """
    require_memory(
        transport_bytes(scene.observer.views, scene.observer.pixels, scene.card.elements),
        f"F of {scene.observer.views} views x {scene.observer.pixels} pixels x {scene.card.elements} elements",
    )
    renderer = Renderer(scene, variant=variant)
    views, pixels, elements = scene.observer.views, scene.observer.pixels, scene.card.elements
    transport = np.empty((views, pixels, elements))
    for view, view_seed in enumerate(spread_seeds(seed, views)):
        for element, pattern in enumerate(np.eye(elements)):
            render = renderer.render(view, pattern, spp=spp, seeds=(view_seed,), max_depth=max_depth, rr_depth=rr_depth)
            transport[view, :, element] = render.mean
            if progress is not None:
                progress(view * elements + element + 1, views * elements)
    return transport
