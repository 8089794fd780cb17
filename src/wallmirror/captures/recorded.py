"""The thesis's recorded run: its renders, pattern, BRDF and estimates from its MATLAB file, checked before use."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, scan_angles
from wallmirror.matfile import read_matrices

Array = NDArray[np.float64]

_CARD_WIDTH, _CARD_Y = 5.0, -1.0  # table 4.3; the file does not say


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedRun:
    """A run of the thesis's code: A views x N pixels x B realisations of M elements.

    Parameters
    ----------
    radiance:
        Its renders, shape (A, N, B).
    source, source_estimate:
        True pattern and the thesis's own estimate, shape (M, B).
    brdf, brdf_estimate:
        True weighted BRDF and the thesis's own estimate, shape (A, N, M).
    wall_x:
        Wall point of each pixel in metres, shape (A, N).
    observer, card:
        Its geometry.
    """

    observer: Observer
    card: Card
    radiance: Array = field(repr=False)
    source: Array = field(repr=False)
    source_estimate: Array = field(repr=False)
    brdf: Array = field(repr=False)
    brdf_estimate: Array = field(repr=False)
    wall_x: Array = field(repr=False)


def read_recorded_run(path: str | Path) -> RecordedRun:
    """Read a run that the thesis's code left as a MATLAB file: g, s, s_est, brdf_mat, brdf_est, x_axis and obs.

    Raises
    ------
    InputError
        For a file that `read_matrices` refuses, and for arrays whose shapes disagree or that are not finite, with
        file and name.

    Examples
    --------
    >>> read_recorded_run("thesis_recorded_run.mat").radiance.shape  # doctest: +SKIP
    (20, 500, 20)
    """
    path = Path(path)
    matrices = read_matrices(path, ("g", "s", "s_est", "brdf_mat", "brdf_est", "x_axis", "obs"))
    renders, source, obs = matrices["g"], matrices["s"], matrices["obs"]
    if renders.ndim != 3 or source.ndim != 2:
        raise InputError(
            f"has shape {renders.shape}, and s {source.shape}; they need three axes and two", file=path, field="g"
        )
    pixels, realisations, views = renders.shape
    elements = source.shape[0]
    expected = {
        "s": (elements, realisations),
        "s_est": (elements, realisations),
        "brdf_mat": (pixels, elements, views),
        "brdf_est": (pixels, elements, views),
        "x_axis": (views, pixels),
        "obs": (1, 8),
    }
    for name, shape in expected.items():
        if matrices[name].shape != shape:
            raise InputError(f"has shape {matrices[name].shape}; beside g it needs {shape}", file=path, field=name)
    for name, values in matrices.items():
        if not np.all(np.isfinite(values)):
            raise InputError("holds a value that is not finite", file=path, field=name)
    x, y, start, end, stated_views, _, fov, _ = obs.ravel().tolist()
    if stated_views != views:
        raise InputError(f"states {stated_views:g} views, but g has {views}", file=path, field="obs")
    try:
        observer = Observer(
            position=(x, y),
            fov=math.radians(fov),
            view_angles=scan_angles(views, scan=math.radians(start - end), fov=math.radians(fov)),
            pixels=pixels,
            pixels_at="edges",
        )
        places = np.linspace(-_CARD_WIDTH / 2, _CARD_WIDTH / 2, elements)
        card = Card(elements_x=tuple(places.tolist()), y=_CARD_Y)
    except InputError as error:
        raise InputError(str(error), file=path, field="obs") from None
    return RecordedRun(
        observer=observer,
        card=card,
        radiance=renders.transpose(2, 0, 1),
        source=source,
        source_estimate=matrices["s_est"],
        brdf=matrices["brdf_mat"].transpose(2, 0, 1),
        brdf_estimate=matrices["brdf_est"].transpose(2, 0, 1),
        wall_x=matrices["x_axis"],
    )
