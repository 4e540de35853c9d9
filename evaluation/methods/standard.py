"""Statistics-based methods with the usual constants of the field.

Sources::

    method              source                                                  n, p, σ of the Gray-Edge framework
    White-Patch         B. Funt, L. Shi, "The rehabilitation of MaxRGB", 2010   0, ∞, 0
    Gray-world          G. Buchsbaum, "A spatial processor model for object     0, 1, 0
                        colour perception", 1980
    Shades-of-Gray      G. Finlayson, E. Trezzi, "Shades of gray and colour     0, 2, 0
                        constancy", 2004
    General Gray-world  J. van de Weijer et al., 2007; see `gray_edge.py`       0, 9, 9
    Gray-Edge, order 1  as General Gray-world                                   1, 1, 6
    Gray-Edge, order 2  as General Gray-world                                   2, 1, 1
    PCA                 D. Cheng et al., 2014; see `pca.py`                     -

Further methods: improved White-Patch, Color Sparrow, Local Surface Reflectance (`retinex`), grayness index and
mean-shifted gray pixel (`gray_pixels`), and Gray-world of OpenCV (`OpenCvGrayWorld`).

The CroP paper (`experiments.paper.published`) uses the first three methods, with p = 2 for Shades-of-Gray. Other
constants are from the tables of the NUS data set. Methods of the Gray-Edge framework apply only its equation.
Preprocessing steps of the papers are omitted, for example the median filter before White-Patch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.gray_pixels import GraynessIndex, LocalGraynessIndex, MeanShiftedGrayPixel
from evaluation.methods.method import LocalMethod, Method
from evaluation.methods.pca import BrightDark
from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod, unit
from evaluation.methods.retinex import ColorSparrow, ImprovedWhitePatch, SurfaceReflectance
from evaluation.methods.wrapped import PatchwiseMethod

_WHITE = 16383  # white in the input of OpenCV: a quarter of uint16, so that factors up to 4 do not clip

_STRIP_ROWS = 256  # rows that are scaled together, to avoid a float64 copy of a large image


@dataclass(frozen=True)
class OpenCvGrayWorld(PreparedMethod):
    """Gray-world of OpenCV's xphoto, which ignores strongly coloured pixels.

    `GrayworldWB` corrects an image. The estimate of a channel is the ratio of its sums before and after correction.
    Masked and saturated pixels are passed as black.

    - `name`: name in tables.

    Examples
    --------
    >>> image = np.random.default_rng(0).uniform(0.1, 1, (40, 60, 1)) * [0.5, 1.0, 0.7]
    >>> OpenCvGrayWorld().estimate(image).round(2)
    array([0.38, 0.76, 0.53])
    """

    name: str = "Gray-world (OpenCV)"

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        # Two other methods of xphoto are not offered. `SimpleWB` also adds an offset to each channel, so it does not
        # estimate an illuminant. `LearningBasedWB` (D. Cheng et al., CVPR 2015) of OpenCV 5.0 is not reproducible: its
        # estimates for the same image differ by degrees.
        import cv2

        xphoto: Any = cv2.xphoto
        usable = prepared.usable(0)
        peak = float(prepared.moments()[2].max())
        if not peak:
            return GREY
        input_image = np.zeros(prepared.image.shape, dtype=np.uint16)
        for top in range(0, prepared.height, _STRIP_ROWS):
            rows = np.s_[top : top + _STRIP_ROWS]
            strip = np.where(usable[rows][..., None], prepared.image[rows], 0)[..., ::-1]
            input_image[rows] = np.rint(strip / peak * _WHITE)
        corrected = np.asarray(xphoto.createGrayworldWB().balanceWhite(input_image))
        sums_after = corrected.reshape(-1, 3).sum(axis=0, dtype=np.float64)
        sums_before = input_image.reshape(-1, 3).sum(axis=0, dtype=np.float64)
        return unit(np.divide(sums_before, sums_after, out=np.zeros(3), where=sums_after > 0)[::-1])


# Methods in most published tables. The other methods may take seconds for a large image.
STANDARD = ("white-patch", "gray-world", "shades-of-gray", "general-gray-world", "gray-edge-1", "gray-edge-2", "pca")


def standard_methods() -> Mapping[str, Method]:
    """Return all methods by their names on the command line, in the order of the module docstring.

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
    """Return the methods that estimate an illuminant map, by their names on the command line.

    Examples
    --------
    >>> list(local_methods())
    ['gray-world-by-patches', 'grayness-index-local']
    """
    return {
        "gray-world-by-patches": PatchwiseMethod(GrayEdge("Gray-world", 0, 1, 0)),
        "grayness-index-local": LocalGraynessIndex(),
    }
