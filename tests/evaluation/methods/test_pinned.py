"""Pinned estimates of all methods for a few small images."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.gray_pixels import GraynessIndex, LocalGraynessIndex, MeanShiftedGrayPixel
from evaluation.methods.method import LocalMethod, Method
from evaluation.methods.pca import BrightDark
from evaluation.methods.retinex import ColorSparrow, ImprovedWhitePatch, SurfaceReflectance
from evaluation.methods.standard import local_methods, standard_methods
from evaluation.methods.wrapped import PatchwiseMethod, ResizedMethod, fill_unknown
from tests.pinned import Pinned

# Intermediate results are pinned too, because estimates may not depend on all of them.

pytestmark = pytest.mark.slow

Image = npt.NDArray[Any]
Case = tuple[Image, float | None, npt.NDArray[np.bool_] | None]


def tiles(height: int, width: int, seed: int) -> npt.NDArray[np.float64]:
    """Return coloured tiles with texture (H, W, 3), 20 … 3500, the lower third darker and bluer."""
    random = np.random.default_rng(seed)
    rough = random.uniform(0.1, 1, (height // 7 + 1, width // 9 + 1, 3)).repeat(7, axis=0).repeat(9, axis=1)
    image = 20 + 3000 * rough[:height, :width] * random.uniform(0.6, 1, (height, width, 1)) * [0.5, 1.0, 0.7]
    image[2 * height // 3 :] *= [0.3, 0.5, 0.8]
    return image


def cases() -> dict[str, Case]:
    """Return images of unusual sizes in each dtype, some masked, some with values at the saturation."""
    limit = tiles(37, 53, 2).astype(np.float32)
    limit[5, 7], limit[5, 8], limit[36, 52], limit[20, 30] = 2500, (2499, 90, 90), (9000, 1, 1), (10, 2500, 0)
    masked = tiles(40, 131, 3)
    mask = np.random.default_rng(1).random((40, 131)) < 0.2
    mask[:, 100:] = True
    far = tiles(30, 40, 4) * 2.0**-70
    far[3, 3:9] = 0
    return {
        "whole": (tiles(72, 90, 1).astype(np.uint16), None, None),
        "whole at the limit": (np.minimum(tiles(66, 70, 6), 2200).astype(np.uint16), 2200.0, None),
        "single at the limit": (limit, 2500.0, None),
        "double masked": (masked, 3400.0, mask),
        "tiny values": (far, None, None),
        "five by seven": (tiles(5, 7, 5), None, None),
        "one row": (tiles(1, 9, 6).astype(np.uint16), None, None),
        "one column": (tiles(19, 1, 6).astype(np.float32), 3000.0, None),
    }


def large_image(seed: int = 8) -> Image:
    """Return an image (300, 311, 3) uint16 that is large enough for sampling, with large groups of equal pixels."""
    image = tiles(300, 311, seed)
    image[:20] = image[0, 0]
    image[140:200] = np.rint(image[140:200] / 500) * 500
    return image.astype(np.uint16)


CASES = cases()

VARIANTS: dict[str, Method] = {
    "p 1.5": GrayEdge("", 0, 1.5, 0),
    "p 16": GrayEdge("", 0, 16, 0),
    "p 17": GrayEdge("", 0, 17, 0),
    "p 64": GrayEdge("", 0, 64, 1),
    "p 65": GrayEdge("", 1, 65, 0.5),
    "border 2": GrayEdge("", 0, 3, 0, border=2),
    "border 0": GrayEdge("", 2, 3, 2, border=0),
    "norm of edges": GrayEdge("", 1, np.inf, 1.2),
    "large scale": GrayEdge("", 2, 2, 4.5),
    "pca all": BrightDark(share=0.5),
    "pca a fifth": BrightDark(share=0.2),
    "grayness a twentieth": GraynessIndex(share=0.05),
    "mean shift a fifth": MeanShiftedGrayPixel(share=0.2),
    "sparrow": ColorSparrow(spray=20, step=4, kernel=3, seed=5),
    "white patch": ImprovedWhitePatch(pixels=5, samples=7, seed=2),
    "reflectance": SurfaceReflectance(patches=3),
    "shrunk": ResizedMethod(GrayEdge("", 1, 2, 1), 21),
    "by patches": PatchwiseMethod(GrayEdge("", 0, 2, 0), 3),
}


@pytest.mark.parametrize("case", CASES)
def test_estimates(case: str, pinned: Pinned) -> None:
    image, saturation, mask = CASES[case]
    methods = {**standard_methods(), **VARIANTS}
    pinned(
        f"estimates of an image, {case}",
        {name: method.estimate(image, saturation, mask) for name, method in methods.items()},
        same=1e-5,
        nothing=1e-7,
    )


def test_estimates_of_many_pixels(pinned: Pinned) -> None:
    image = large_image()
    mask = np.zeros(image.shape[:2], bool)
    mask[::3, 50:120] = True
    methods = {
        **{name: standard_methods()[name] for name in ("pca", "gray-edge-1", "general-gray-world", "grayness-index")},
        **{f"pca {share}": BrightDark(share=share) for share in (0.0001, 0.01, 0.1, 0.3, 0.4999)},
        "mean shift": MeanShiftedGrayPixel(share=0.03),
        "local": LocalGraynessIndex(),
    }
    estimates = {name: [m.estimate(image), m.estimate(image, 2900.0, mask)] for name, m in methods.items()}
    pinned("estimates of many pixels", estimates, same=1e-5, nothing=1e-7)


def test_maps_of_lights(pinned: Pinned) -> None:
    methods: dict[str, LocalMethod] = {
        **local_methods(),
        "3 patches": PatchwiseMethod(GrayEdge("", 0, 2, 0), 3),
        "1 patch": PatchwiseMethod(GrayEdge("", 0, 1, 0), 1),
        "3 lights": LocalGraynessIndex(share=0.3, lights=3),
        "5 lights": LocalGraynessIndex(share=0.02, lights=5),
    }
    estimates = {
        case: {name: np.asarray(method.estimate_map(*arguments)) for name, method in methods.items()}
        for case, arguments in CASES.items()
    }
    pinned("maps of lights by every local method", estimates, same=1e-5, nothing=1e-6)
    unknown = tiles(5, 4, 9)
    unknown[0, 1:3] = unknown[2, 2] = unknown[4] = np.nan
    pinned(
        "lights of patches where some are unknown", [fill_unknown(unknown), fill_unknown(np.full((2, 2, 3), np.nan))]
    )
