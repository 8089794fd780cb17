"""Focused blind deconvolution of several channels with one unknown source (section 3.2.4 of the thesis).

After Bharadwaj, Demanet and Fournier, "Focused blind deconvolution", IEEE Trans. Signal Processing 67(12), 2019. Two stages:
the interferometric fit finds the source's auto-correlation and the channels' cross-correlations with the channels as white as
the outputs allow (`interferometric_fit`), phase retrieval finds the channels themselves with the nearest one as
front-loaded as they allow (`phase_retrieval`). The source is then a linear least-squares fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.channels import checked_outputs
from wallmirror.deconvolution.cross_relation import rival_channels
from wallmirror.deconvolution.interferometric_fit import InterferometricFit, fit_interferometric
from wallmirror.deconvolution.least_squares_blind import least_squares_blind
from wallmirror.deconvolution.phase_retrieval import RetrievedChannels, retrieve_channels

Array = NDArray[np.float64]

_TRUSTED = 0.1  # predicted relative error of the channels up to which an answer passes for one


@dataclass(frozen=True)
class FocusedBlind:
    """Result of `focused_blind`; only the product of the scales of source and channels is known.

    Parameters
    ----------
    source, channels:
        f (S,) and h (K, n), |h| = 1.
    interferometric, retrieval:
        What the two stages found, in units of a power of two near the outputs' largest value.
    misfit:
        |g - f * h| / |g| of the end.
    predicted_error:
        Relative error of h that the misfit can hide, to first order; above 1 the outputs determine nothing.
    rivals:
        Dimension of the family of channels of n taps that fit the outputs equally (`rival_channels`); above 1 focusing,
        not the outputs, has chosen among them.
    """

    source: Array
    channels: Array
    interferometric: InterferometricFit
    retrieval: RetrievedChannels
    misfit: float
    predicted_error: float
    rivals: int

    @property
    def is_determined(self) -> bool:
        """Whether the outputs leave no room for another answer, near or far."""
        return self.predicted_error <= _TRUSTED and self.rivals == 1

    @property
    def status(self) -> str:
        """What to make of the result, in a sentence."""
        if self.is_determined:
            return f"source and channels found; the outputs leave {self.predicted_error:.1e} of the channels open"
        taps = self.channels.shape[1]
        if self.rivals > 1:
            return (
                f"the whitest and most front-loaded of a family: channels of {taps} taps leave {self.rivals - 1} factor(s) "
                f"open between source and channels; give {taps - self.rivals + 1} taps if they are that short"
            )
        return (
            f"no answer: the outputs are missed by {self.misfit:.1e}, behind which any error of the channels can hide; the "
            "nearest channel may not be front-loaded (`identify_channels` does not need it), or there is too much noise"
        )


def focused_blind(
    outputs: ArrayLike,
    taps: int,
    *,
    white_weights: Sequence[float] = (np.inf, 0.0),
    nearest: int | None = None,
    front_weights: Sequence[float] = (0.0,),
    refine: bool = False,
    steps: int = 300,
) -> FocusedBlind:
    """Recover one source and the channels through which it was recorded from the records alone.

    Parameters
    ----------
    outputs:
        g, shape (K, L): full records g_i = f * h_i of K >= 2 channels, L = S + n - 1.
    taps:
        n, the largest number of taps of a channel.
    white_weights:
        alpha of `fit_interferometric`.
    nearest, front_weights:
        Of `retrieve_channels`.
    refine:
        Let `least_squares_blind` finish what the two stages began; not part of the published method.
    steps:
        Largest number of alternations of the first stage.

    Raises
    ------
    InputError
        For outputs that are no finite (K, L) array, or channels longer than the record.
    UndeterminedError
        For one output, darkness, outputs that are multiples of one, or a first stage that leaves no channel any energy.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import aligned_error, convolve_channels
    >>> rng = np.random.default_rng(0)
    >>> f, h = rng.standard_normal(100), rng.standard_normal((5, 4)) * [2, 1, 0.5, 0.25]
    >>> found = focused_blind(convolve_channels(f, h), 4)
    >>> aligned_error(found.channels, h) < 1e-6, aligned_error(found.source, f) < 1e-6
    (True, True)
    """
    g, scale = checked_outputs(outputs, taps)
    first = fit_interferometric(g, taps, weights=white_weights, steps=steps)
    second = retrieve_channels(first.correlations, g.shape[0], nearest=nearest, weights=front_weights)
    # No descent: how far the outputs are missed here, and what that misfit can hide.
    fit = least_squares_blind(g, taps, start=second.channels, steps=100 if refine else 0)
    return FocusedBlind(
        source=rescaled(fit.source, scale, field="outputs"),
        channels=fit.channels,
        interferometric=first,
        retrieval=second,
        misfit=fit.misfit,
        predicted_error=fit.predicted_error,
        rivals=rival_channels(g, taps),
    )
