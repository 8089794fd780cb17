"""Mitsuba 3 as judge and camera: its runtime, the tabulated BRDF, scenes and renders.

The only part of wallmirror that imports mitsuba, and only when something is asked of it: `runtime.activate` first.
"""
