"""The thesis's figures and claims, computed again: one module a section, each figure with the numbers behind it."""

from wallmirror.thesis.catalogue import figure_ids, make_figure
from wallmirror.thesis.figure import Claim, ThesisFigure
from wallmirror.thesis.gallery import Made, make_figures

__all__ = ["Claim", "Made", "ThesisFigure", "figure_ids", "make_figure", "make_figures"]
