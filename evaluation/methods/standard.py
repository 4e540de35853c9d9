"""The methods that the command offers, with the constants that are usual in the field.

Where they come from::

    method              source                                                  n, p, σ of the Gray-Edge framework
    White-Patch         B. Funt, L. Shi, "The rehabilitation of MaxRGB", 2010   0, ∞, 0
    Gray-world          G. Buchsbaum, "A spatial processor model for object     0, 1, 0
                        colour perception", 1980
    Shades-of-Gray      G. Finlayson, E. Trezzi, "Shades of gray and colour     0, 2, 0
                        constancy", 2004
    General Gray-world  J. van de Weijer et al., 2007; see `gray_edge.py`       0, 9, 9
    Gray-Edge, order 1  the same                                                1, 1, 6
    Gray-Edge, order 2  the same                                                2, 1, 1
    PCA                 D. Cheng et al., 2014; see `pca.py`                     -

and, each in its own file with its source and constants: improved White-Patch, Color Sparrow, Local Surface Reflectance
(`retinex`), grayness index and mean-shifted gray pixel (`gray_pixels`), and what OpenCV offers (`opencv.py`).

The paper's tables have the first three, Shades-of-Gray with p = 2 as here. The other constants are those with which the
methods stand in the tables of the NUS dataset. Every method of the framework is built from its equation alone, without
the preprocessing that a source may add (for White-Patch: no median filter).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.gray_pixels.grayness import GraynessIndex
from evaluation.methods.gray_pixels.local_grayness import LocalGraynessIndex
from evaluation.methods.gray_pixels.mean_shifted import MeanShiftedGrayPixel
from evaluation.methods.method import LocalMethod, Method
from evaluation.methods.opencv import OpenCvGrayWorld
from evaluation.methods.patchwise import PatchwiseMethod
from evaluation.methods.pca import BrightDark
from evaluation.methods.retinex.color_sparrow import ColorSparrow
from evaluation.methods.retinex.improved_white_patch import ImprovedWhitePatch
from evaluation.methods.retinex.surface_reflectance import SurfaceReflectance

STANDARD = ("white-patch", "gray-world", "shades-of-gray", "general-gray-world", "gray-edge-1", "gray-edge-2", "pca")
"""Names of the methods that stand in most tables of the field; the others may take seconds on a large image."""


def standard_methods() -> Mapping[str, Method]:
    """Return the methods by their short names on the command line; the paper's three first.

    Examples
    --------
    >>> list(standard_methods())[:7] == list(STANDARD)
    True
    >>> list(standard_methods())[7:12]
    ['improved-white-patch', 'color-sparrow', 'local-surface-reflectance', 'grayness-index', 'mean-shifted-gray-pixel']
    >>> list(standard_methods())[12:]
    ['opencv-grayworld']
    >>> standard_methods()["gray-edge-1"].name
    '1st-order Gray-Edge'
    """
    return {
        "white-patch": GrayEdge("White-Patch", 0, np.inf, 0),
        "gray-world": GrayEdge("Gray-world", 0, 1, 0),
        "shades-of-gray": GrayEdge("Shades-of-Gray (p=2)", 0, 2, 0),
        "general-gray-world": GrayEdge("General Gray-world", 0, 9, 9),
        "gray-edge-1": GrayEdge("1st-order Gray-Edge", 1, 1, 6),
        "gray-edge-2": GrayEdge("2nd-order Gray-Edge", 2, 1, 1),
        "pca": BrightDark(),
        "improved-white-patch": ImprovedWhitePatch(),
        "color-sparrow": ColorSparrow(),
        "local-surface-reflectance": SurfaceReflectance(),
        "grayness-index": GraynessIndex(),
        "mean-shifted-gray-pixel": MeanShiftedGrayPixel(),
        "opencv-grayworld": OpenCvGrayWorld(),
    }


def local_methods() -> Mapping[str, LocalMethod]:
    """Return methods that give a map of lights by their short names; for images under several lights only.

    Examples
    --------
    >>> list(local_methods())
    ['gray-world-by-patches', 'grayness-index-local']
    """
    return {
        "gray-world-by-patches": PatchwiseMethod(GrayEdge("Gray-world", 0, 1, 0)),
        "grayness-index-local": LocalGraynessIndex(),
    }
