"""Statistics-based methods, compared with numbers of real photographs that were computed with other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from drivers.raw.rawfile import read_raw
from evaluation.methods import standard_methods
from evaluation.metrics import recovery_error, summarise
from tests.data_files import available, shipped

Span = tuple[slice, slice]
"""Rows and columns in the half-size picture."""

PLACES: dict[str, tuple[Span, Span]] = {
    "canon_eos_550d_colorchart.dng": (np.s_[452:476, 394:418], np.s_[435:490, 322:655]),
    "canon_powershot_g2.crw": (np.s_[620:690, 290:360], np.s_[570:735, 80:1080]),
}
"""Where the patch "neutral 8" and the row of grey patches of a ColorChecker are on each photograph."""

PHOTOGRAPHS = {
    "gray-world": (9.75, 6.82, 8.19, 1.74, 22.11),
    "shades-of-gray": (9.83, 6.01, 7.38, 1.51, 22.48),
    "white-patch": (11.84, 13.84, 12.10, 1.97, 22.94),
}
"""Mean, median, trimean, best and worst quarter of recovery errors, of dcraw's counts and 20 lines of NumPy."""

THUMBNAILS: dict[str, dict[str, dict[str, tuple[float, ...]]]] = {
    "nus_canon_1ds_mk3_64x64": {
        "": {
            "gray-world": (5.21, 4.18, 4.40, 1.11, 11.01),
            "shades-of-gray": (4.51, 3.37, 3.66, 1.00, 9.88),
            "white-patch": (5.78, 3.75, 4.25, 0.90, 14.45),
        },
    },
    "intel_tau_5dsr_64x64": {
        "lab_printouts": {"gray-world": (5.13, 4.27), "shades-of-gray": (4.99, 3.98)},
        "field": {"gray-world": (4.65, 3.51), "shades-of-gray": (4.76, 3.56)},
    },
}
"""Figures that came with thumbnails, by file and by a part of the images' names; zeros are included as they are."""
ARCHIVES = available(*(f"benchmark/{name}.npz" for name in THUMBNAILS))


def half_size(path: Path) -> npt.NDArray[np.float32]:
    """Return (H / 2, W / 2, 3) float32 of an RGGB raw file without black level, greens averaged."""
    mosaic = read_raw(path)
    assert mosaic.pattern == "RGGB"
    planes = np.maximum(mosaic.block_planes() - mosaic.black[:, :, None, None], 0)
    green = (planes[0, 1] + planes[1, 0]) / 2
    return np.stack([planes[0, 0], green, planes[1, 1]], axis=-1).astype(np.float32)


@pytest.mark.slow
def test_statistics_methods_on_parts_of_photographs() -> None:
    images: list[npt.NDArray[np.float32]] = []
    truths: list[npt.NDArray[np.float64]] = []
    for name, (patch, row) in PLACES.items():
        picture = half_size(shipped(f"raw/{name}"))
        truth = picture[patch].mean(axis=(0, 1), dtype=np.float64)
        picture[row] = 0  # What is zero adds to no norm.
        height, width = picture.shape[0] // 4, picture.shape[1] // 6
        for top, x in np.ndindex(4, 6):
            images.append(picture[top * height :, x * width :][:height, :width])
            truths.append(truth)
    for name, expected in PHOTOGRAPHS.items():
        errors = recovery_error(np.stack([standard_methods()[name].estimate(image) for image in images]), truths)
        assert summarise(errors).as_tuple()[:5] == pytest.approx(expected, abs=0.00501), name


@pytest.mark.slow
@pytest.mark.parametrize("path", ARCHIVES, ids=lambda path: path.stem)
def test_statistics_methods_on_thumbnails(path: Path) -> None:
    with np.load(path) as data:
        images, truths, names = data["images"], data["gt"], data["names"]
    for value, figures in THUMBNAILS[path.stem].items():
        indices = np.char.find(names.astype(str), value) >= 0
        for name, expected in figures.items():
            lights = np.stack([standard_methods()[name].estimate(image) for image in images[indices]])
            summary = summarise(recovery_error(lights, truths[indices])).as_tuple()
            assert summary[: len(expected)] == pytest.approx(expected, abs=0.00501), (value, name)
