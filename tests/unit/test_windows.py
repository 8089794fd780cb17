"""Sums over pixels by dense blocks, against the products of dense matrices that they stand for."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.moments import Pairs
from wallmirror.derendering.splines import design_matrices, grid_for
from wallmirror.derendering.windows import Windows
from wallmirror.transport import build_kernel

from .helpers import EPS, thesis_card, thesis_observer

Array = NDArray[np.float64]


def designs(pixels: int, views: int, step_deg: float, *, width: float, elements: int = 3) -> list[sp.csr_array]:
    """T_1 .. T_M of a scene; strips and pixels of some width make runs of different lengths."""
    observer = thesis_observer(pixels, views, pixels_at="centres" if width else "edges")
    weights = "physical" if width else "cosine"
    kernel = build_kernel(observer, thesis_card(elements, width=width), weights=weights, resolution=0.1)
    return design_matrices(kernel, grid_for(kernel, step=math.radians(step_deg), degree=5))


# Many rows in a window, hardly any, fewer than columns, one; runs of one length and of several.
SCENES = {
    "many pixels": (60, 6, 8.0, 0.0),
    "few pixels": (5, 2, 1.0, 0.0),
    "two pixels": (2, 1, 0.5, 0.0),
    "strips": (40, 3, 2.0, 0.4),
}


def dense(windows: Windows, weight: Array, elements: int) -> list[Array]:
    """All N_ij for i <= j out of the windows' sums."""
    whole, size = windows.grams(weight).toarray(), windows.size
    pairs = range(elements * (elements + 1) // 2)
    assert whole.shape == (len(pairs) * size, len(pairs) * size)
    blocks = [whole[k * size : (k + 1) * size, k * size : (k + 1) * size] for k in pairs]
    assert np.count_nonzero(whole) == sum(np.count_nonzero(block) for block in blocks)  # and none beside the diagonal
    return blocks


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_grams_are_those_of_the_dense_matrices(scene: tuple[int, int, float, float]) -> None:
    pixels, views, step_deg, width = scene
    some = designs(pixels, views, step_deg, width=width)
    full = [t.toarray() for t in some]
    weight = np.random.default_rng(0).uniform(0, 2, full[0].shape[0])
    weight[0] = 0
    windows = Windows.of(some)
    assert windows is not None
    expected = [full[i].T @ (weight[:, None] * full[j]) for i in range(3) for j in range(i, 3)]
    for found, product in zip(dense(windows, weight, 3), expected, strict=True):
        # Sums of up to 360 rows.
        np.testing.assert_allclose(found, product, rtol=0, atol=100 * EPS * max(1.0, np.max(np.abs(product))))
    # The planted fault: a window that begins one column early.
    moved = windows.begin.copy()
    moved[:, 1] = np.where(moved[:, 1] > 0, moved[:, 1] - 1, 1)
    wrong = dense(dataclasses.replace(windows, begin=moved), weight, 3)[1]
    assert np.max(np.abs(wrong - expected[1])) > 1e-3 * np.max(np.abs(expected[1]))


def test_blocks_stay_narrow_and_full_where_there_are_many_pixels() -> None:
    windows = Windows.of(designs(400, 8, 1.0, width=0.0))
    assert windows is not None
    count, height, _, width = windows.blocks.shape
    assert width <= 6 + 4  # a run, and what the runs of a block may be spread over
    assert count * height < 4 * 3200


def test_rows_that_are_no_runs_are_summed_up_all_the_same() -> None:
    rng = np.random.default_rng(0)
    scattered = [sp.csr_array(sp.random_array((40, 9), density=0.3, rng=rng)) for _ in range(3)]
    assert Windows.of(scattered) is None
    weight, r = rng.uniform(0.5, 2, 40), rng.standard_normal(9)
    pairs = Pairs.of(scattered, None, weight)
    full = np.stack([t.toarray() for t in scattered])
    grams = np.einsum("ipk,p,jpl->ijkl", full, weight, full)
    np.testing.assert_allclose(pairs.times(r), grams @ r, rtol=0, atol=1e-13)  # sums of 40 products of order one
    side_by_side = np.concatenate(full, axis=1)
    whole = side_by_side.T @ (weight[:, None] * side_by_side)
    np.testing.assert_allclose(pairs.whole().toarray(), whole, rtol=0, atol=1e-13)
    mixture = rng.standard_normal((3, 3))
    mixture = mixture + mixture.T
    np.testing.assert_allclose(pairs.mixed(mixture), np.einsum("ij,ijkl->kl", mixture, grams), rtol=0, atol=1e-13)
    both = np.einsum("iikl->kl", grams)
    for d, row in enumerate(pairs.band):
        np.testing.assert_allclose(row[: 9 - d], np.diagonal(both, -d), rtol=0, atol=1e-13)
    assert np.all(np.triu(both.T, pairs.band.shape[0]) == 0)  # and nothing lies beyond the band
