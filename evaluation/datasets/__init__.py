"""Readers of data sets, one file per layout; `open_scenes` opens all of them."""

from evaluation.datasets.opening import LAYOUTS, layout_of, open_scenes
from evaluation.datasets.options import DataOptions

__all__ = ["LAYOUTS", "DataOptions", "layout_of", "open_scenes"]
