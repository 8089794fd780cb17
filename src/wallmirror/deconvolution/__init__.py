"""Deconvolution of renders (section 3.2): non-blind, and both factors from one convolution or from several channels."""

from wallmirror.deconvolution.ambiguity import Aligned, align
from wallmirror.deconvolution.blind import BlindEstimate
from wallmirror.deconvolution.blind_richardson_lucy import blind_richardson_lucy
from wallmirror.deconvolution.channels import aligned_error, convolve_channels
from wallmirror.deconvolution.cross_relation import IdentifiedChannels, identify_channels, rival_channels
from wallmirror.deconvolution.focused_blind import FocusedBlind, focused_blind
from wallmirror.deconvolution.iterative_blind import corner_support, iterative_blind
from wallmirror.deconvolution.least_squares_blind import least_squares_blind
from wallmirror.deconvolution.operators import Convolution, adjoint_mismatch, toeplitz_matrix
from wallmirror.deconvolution.parameter_choice import (
    discrepancy_alpha,
    gcv,
    gcv_alpha,
    l_curve_alpha,
    l_curve_curvature,
)
from wallmirror.deconvolution.richardson_lucy import RichardsonLucy, richardson_lucy
from wallmirror.deconvolution.spectrum import Spectrum, convolution_spectrum, matrix_spectrum
from wallmirror.deconvolution.tikhonov import tikhonov_dense, tikhonov_fft, tikhonov_lsmr

__all__ = [
    "Aligned",
    "BlindEstimate",
    "Convolution",
    "FocusedBlind",
    "IdentifiedChannels",
    "RichardsonLucy",
    "Spectrum",
    "adjoint_mismatch",
    "align",
    "aligned_error",
    "blind_richardson_lucy",
    "convolution_spectrum",
    "convolve_channels",
    "corner_support",
    "discrepancy_alpha",
    "focused_blind",
    "gcv",
    "gcv_alpha",
    "identify_channels",
    "iterative_blind",
    "l_curve_alpha",
    "l_curve_curvature",
    "least_squares_blind",
    "matrix_spectrum",
    "richardson_lucy",
    "rival_channels",
    "tikhonov_dense",
    "tikhonov_fft",
    "tikhonov_lsmr",
    "toeplitz_matrix",
]
