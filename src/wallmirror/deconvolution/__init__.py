"""Deconvolution of renders (section 3.2): non-blind, single-channel blind and multi-channel blind."""
