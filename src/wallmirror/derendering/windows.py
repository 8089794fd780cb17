"""Sums over pixels by dense products: rows that look at nearly the same columns share a small dense block.

A row of T_i is a run of few neighbouring columns (`splines`). Sorted by where their runs begin, a few dozen rows together
look through a window of a few columns more in each T_i, as the wall's points lie on one line and all angle sums grow along
it. Products of such blocks take matrices over the pixels to matrices over the coefficients faster than sparse ones do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from wallmirror.derendering.subspace import run_length

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Rows of a block at most, columns that the begins of its runs may be spread over, and how many times the rows blocks may hold.
_ROWS = 32
_SPREAD = 4
_EMPTY = 4


@dataclass(frozen=True)
class Windows:
    """T_1 .. T_M cut into dense blocks.

    Parameters
    ----------
    blocks:
        Shape (n, c, M, W): of each of n blocks c rows, seen through windows of W columns; rows that are none are 0.
    begin:
        First column of each window, shape (n, M).
    slot:
        Place of each row among the n c, shape (P,).
    size:
        K.
    """

    blocks: Array
    begin: Indices
    slot: Indices
    size: int

    @classmethod
    def of(cls, designs: list[sp.csr_array]) -> Windows | None:
        """The blocks of matrices whose rows are runs, each matrix's of one length; None for others."""
        lengths = [run_length(t) for t in designs]
        if 0 in lengths:
            return None
        rows, size = designs[0].shape
        longest = max(lengths)
        runs = np.stack([t.indices[::length] for t, length in zip(designs, lengths, strict=True)]).astype(np.intp)
        order = np.argsort(runs.sum(axis=0), kind="stable")
        cuts = _cuts(runs[:, order])
        block = np.repeat(np.arange(cuts.size), np.diff(cuts, append=rows))
        height = int(np.diff(cuts, append=rows).max())
        slot = np.empty(rows, dtype=np.intp)
        slot[order] = block * height + np.arange(rows) - cuts[block]
        first, last = _range(runs[:, order], cuts)
        width = min(size, longest + int((last - first).max()))
        first = np.minimum(first, size - width)
        blocks = np.zeros((cuts.size, height, len(designs), width))
        # One row after the other in a line, each run is a piece of it.
        line = blocks.reshape(-1)
        for i, (t, length) in enumerate(zip(designs, lengths, strict=True)):
            place = (slot * len(designs) + i) * width + runs[i] - first[i, slot // height]
            sliding_window_view(line, length, writeable=True)[place] = t.data.reshape(rows, length)
        return cls(blocks, np.ascontiguousarray(first.T), slot, size)

    def cut(self, films: Array) -> Array:
        """Columns over the pixels (P, n') in the blocks' order, (n, c, n')."""
        count, height = self.blocks.shape[:2]
        placed = np.zeros((count * height, films.shape[1]))
        placed[self.slot] = films
        return placed.reshape(count, height, -1)

    @cached_property
    def most_entries(self) -> int:
        """Entries that `grams` will find at most, without a look at a value: rows of N_ij reach as far as the windows of j do
        where those of i cover the row."""
        elements, total = self.begin.shape[1], 0
        for i in range(elements):
            low, high = self._reach(i)
            total += int(np.sum(np.maximum(high - low, 0)))
        return total

    def _reach(self, i: int) -> tuple[Indices, Indices]:
        """First column, and the one after the last, that windows of elements i, i + 1, .. reach to in each row of N_ij, shape
        (K, M - i): where those of i cover the row; K and 0 where none does."""
        width, begin = self.blocks.shape[3], self.begin
        low = np.full((self.size, begin.shape[1] - i), self.size)
        high = np.zeros_like(low)
        np.minimum.at(low, begin[:, i], begin[:, i:])
        np.maximum.at(high, begin[:, i], begin[:, i:] + width)
        # A row lies in windows that begin up to a width before it.
        low = minimum_filter1d(low, width, axis=0, origin=(width - 1) // 2, mode="constant", cval=self.size)
        high = maximum_filter1d(high, width, axis=0, origin=(width - 1) // 2, mode="constant", cval=0)
        return low, high

    def grams(self, weight: Array) -> sp.csr_array:
        """N_ij = T_i^T W T_j for i <= j, along the diagonal in the order (0, 0), (0, 1), ..., (0, M - 1), (1, 1), ...

        The entries that are not 0 of all these (K, K) matrices, for w of shape (P,).
        """
        count, height, elements, width = self.blocks.shape
        weights = self.cut(weight[:, None])
        ahead = np.arange(width)
        # Room for every element's products: the system takes as long to clear it anew as these take to multiply.
        left = np.empty((count, height, width))
        products = np.empty(count * width * elements * width)
        places = np.empty(products.size, dtype=np.intp)
        order, most = elements * (elements + 1) // 2 * self.size, self.most_entries
        narrow = np.int32 if max(order, most) < np.iinfo(np.int32).max else np.int64
        columns, values, pointers = np.empty(most, narrow), np.empty(most), np.zeros(order + 1, narrow)
        rows = known = 0
        for i in range(elements):
            np.multiply(weights, self.blocks[:, :, i], out=left)
            right = self.blocks[:, :, i:].reshape(count, height, -1)
            entries = count * width * (elements - i) * width
            product, place = products[:entries], places[:entries]
            np.matmul(left.transpose(0, 2, 1), right, out=product.reshape(count, width, -1))
            # Rows of N_ij reach from `low` up to `high`: one such stretch after the other, a small table sums the blocks up.
            row = (self.begin[:, i, None] + ahead)[:, :, None] + self.size * np.arange(elements - i)
            low, high = (reach.T.ravel() for reach in self._reach(i))
            reach = np.maximum(high - low, 0)
            end = np.cumsum(reach)
            shift = end - reach - low
            np.add((shift[row] + self.begin[:, None, i:])[..., None], ahead, out=place.reshape(*row.shape, width))
            table = np.bincount(place, weights=product, minlength=int(end[-1]))
            filled = np.flatnonzero(table)
            until = np.searchsorted(filled, end)
            # Each matrix begins on the diagonal where its rows do.
            aside = shift - np.repeat(np.arange(rows, rows + end.size, self.size), self.size)
            found = slice(known, known + filled.size)
            np.subtract(filled, np.repeat(aside, np.diff(until, prepend=0)), out=columns[found], casting="same_kind")
            np.take(table, filled, out=values[found])
            pointers[rows + 1 : rows + 1 + end.size] = known + until
            rows, known = rows + end.size, known + filled.size
        return sp.csr_array((values[:known], columns[:known], pointers), shape=(order, order))


def _cuts(runs: Indices) -> Indices:
    """Where blocks begin in sorted rows: every few dozen rows, and in their midst where their runs are spread too far."""
    rows = runs.shape[1]
    height = _ROWS
    while True:
        cuts = np.arange(0, rows, height)
        while True:
            first, last = _range(runs, cuts)
            sizes = np.diff(cuts, append=rows)
            torn = np.any(last - first > _SPREAD, axis=0) & (sizes > 1)
            if not np.any(torn):
                break
            cuts = np.sort(np.concatenate([cuts, cuts[torn] + sizes[torn] // 2]))
        if height == 1 or cuts.size * height <= _EMPTY * rows:
            return cuts
        height //= _EMPTY


def _range(runs: Indices, cuts: Indices) -> tuple[Indices, Indices]:
    """First and last begin of the runs of each block, (M, n) each."""
    return np.minimum.reduceat(runs, cuts, axis=1), np.maximum.reduceat(runs, cuts, axis=1)
