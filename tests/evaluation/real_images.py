"""Collections of real images with their ground truth, to compare figures of methods with.

The photographs of a ColorChecker that the repository ships are cut in parts: the light of each is measured on the grey
patch "neutral 8", and the row of grey patches is masked. The thumbnails of NUS are a collection where they are found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import read_raw
from tests.data_files import available, shipped


@dataclass(frozen=True)
class Image:
    """A linear raw image, an `evaluation.datasets.Scene`; masked pixels are exactly zero.

    Attributes
    ----------
    name
        What it is called in tables.
    truth
        (3,) float64, linear camera RGB of the light.
    image
        (H, W, 3) float32, linear camera RGB, black at zero.
    saturation
        Always None: nothing is left out as saturated.
    """

    name: str
    truth: npt.NDArray[np.float64]
    image: npt.NDArray[np.float32]
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """Return the image and (H, W) bool, True where it is masked."""
        return self.image, (self.image == 0).all(axis=2)


@dataclass(frozen=True)
class Collection:
    """Images whose figures are known under the collection's name."""

    name: str
    scenes: list[Image]


Span = tuple[slice, slice]
"""Rows and columns in the half-size picture."""

GREY_PLACES: dict[str, tuple[Span, Span]] = {
    "canon_eos_550d_colorchart.dng": (np.s_[452:476, 394:418], np.s_[435:490, 322:655]),
    "canon_powershot_g2.crw": (np.s_[620:690, 290:360], np.s_[570:735, 80:1080]),
}
"""Where neutral 8 and the row of grey patches are on each photograph."""


def photographs() -> Collection:
    """Return 4 × 6 parts of each shipped photograph, as linear RGB at half size."""
    scenes: list[Image] = []
    for name, (patch, row) in GREY_PLACES.items():
        picture = _half_size(shipped(f"raw/{name}"))
        truth = picture[patch].mean(axis=(0, 1), dtype=np.float64)
        picture[row] = 0
        height, width = picture.shape[0] // 4, picture.shape[1] // 6
        for top in range(0, 4 * height, height):
            for left in range(0, 6 * width, width):
                part = picture[top : top + height, left : left + width]
                scenes.append(Image(f"{name} {top} {left}", truth, part))
    return Collection("photographs", scenes)


def _half_size(path: Path) -> npt.NDArray[np.float32]:
    """Return (H / 2, W / 2, 3) float32 of an RGGB raw file, black subtracted, the greens averaged."""
    mosaic = read_raw(path)
    assert mosaic.pattern == "RGGB"
    planes = np.maximum(mosaic.block_planes() - mosaic.black[:, :, None, None], 0)
    green = (planes[0, 1] + planes[1, 0]) / 2
    return np.stack([planes[0, 0], green, planes[1, 1]], axis=-1).astype(np.float32)


def _nus(path: Path) -> Collection:
    with np.load(path) as data:
        rows = zip(data["names"], data["gt"], data["images"], strict=True)
        return Collection("NUS", [Image(str(name), truth, image) for name, truth, image in rows])


def collections() -> dict[str, Callable[[], Collection]]:
    """Return what makes each collection that can be made here, by its name."""
    found = available("benchmark/nus_canon_1ds_mk3_64x64.npz")
    return dict([("photographs", photographs), *(("NUS", partial(_nus, path)) for path in found)])
