"""Capture sets: what the cameras saw, where everything stood, and how that lies on disk."""

from wallmirror.captures.capture_set import CaptureSet, Truth
from wallmirror.captures.reading import read_captures, read_truth
from wallmirror.captures.writing import write_captures

__all__ = ["CaptureSet", "Truth", "read_captures", "read_truth", "write_captures"]
