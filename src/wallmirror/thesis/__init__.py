"""The thesis's figures and claims, computed again: one module a section, each figure with the numbers behind it."""

from wallmirror.thesis.catalogue import figure_ids, make_figure
from wallmirror.thesis.figure import Claim, ThesisFigure

__all__ = ["Claim", "ThesisFigure", "figure_ids", "make_figure"]
