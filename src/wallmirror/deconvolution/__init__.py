"""Deconvolution (section 3.2): Tikhonov, Richardson-Lucy, and both factors from their convolution alone."""

from wallmirror.deconvolution.ambiguity import Aligned, align
from wallmirror.deconvolution.blind import BlindEstimate
from wallmirror.deconvolution.blind_richardson_lucy import blind_richardson_lucy
from wallmirror.deconvolution.iterative_blind import corner_support, iterative_blind
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
    "RichardsonLucy",
    "Spectrum",
    "adjoint_mismatch",
    "align",
    "blind_richardson_lucy",
    "convolution_spectrum",
    "corner_support",
    "discrepancy_alpha",
    "gcv",
    "gcv_alpha",
    "iterative_blind",
    "l_curve_alpha",
    "l_curve_curvature",
    "matrix_spectrum",
    "richardson_lucy",
    "tikhonov_dense",
    "tikhonov_fft",
    "tikhonov_lsmr",
    "toeplitz_matrix",
]
