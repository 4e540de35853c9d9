"""Readers of data sets, one file a layout, behind one door: `open_scenes`."""

from evaluation.datasets.opening import LAYOUTS, open_scenes

__all__ = ["LAYOUTS", "open_scenes"]
