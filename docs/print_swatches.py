"""Draw what the simulated prints of one file look like under daylight of 5000 K: ``python -m docs.print_swatches``.

Writes docs/images/prints.png: a file's colours and greys, then on each paper ink codes (left) and managed (right). The
pictures are the reflectances' sRGB as an observer sees them beside an ideal white, so paper is not quite white.
"""

from __future__ import annotations

from pathlib import Path

import colour
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from foundation.colorimetry import encode_srgb
from sim.spectral import WAVELENGTHS_NM, PaperName, ProfileName, printed_reflectance

PAPERS: tuple[PaperName, ...] = ("poster", "matt", "glossy")
PROFILES: tuple[ProfileName, ...] = ("unmanaged", "managed")
# Pixels of a colour's side, so that six prints stand in 910 pixels.
SQUARE = 7
# Pixels of white between prints.
GAP = 14


def file_codes() -> NDArray[np.float64]:
    """Return (19, 64, 3) float64 codes 0 … 255: 16 by 16 of red and green at four of blue, and three rows of grey."""
    steps = np.linspace(0, 255, 16)
    red, green = np.meshgrid(steps, steps)
    planes = [np.stack([red, green, np.full_like(red, blue)], axis=-1) for blue in (0.0, 85.0, 170.0, 255.0)]
    grey = np.repeat(np.linspace(0, 255, 64)[None, :, None], 3, axis=2)
    return np.concatenate([np.concatenate(planes, axis=1), np.repeat(grey, 3, axis=0)])


def seen(codes: NDArray[np.float64], profile: ProfileName, paper: PaperName) -> NDArray[np.uint8]:
    """Return (rows, columns, 3) uint8 sRGB of the print of codes (rows, columns, 3) under D50."""
    shape = colour.SpectralShape(float(WAVELENGTHS_NM[0]), float(WAVELENGTHS_NM[-1]), 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    light = observer * colour.SDS_ILLUMINANTS["D50"].copy().align(shape).values[:, None]
    xyz = printed_reflectance(codes.reshape(-1, 3), profile, paper) @ light / light[:, 1].sum()
    white = light.sum(axis=0) / light[:, 1].sum()
    adapted = colour.adaptation.chromatic_adaptation(xyz, white, [0.9505, 1.0, 1.089], method="Von Kries")
    linear = np.asarray(colour.XYZ_to_RGB(adapted, "sRGB"), dtype=np.float64)
    return np.round(255 * encode_srgb(np.clip(linear, 0, 1))).astype(np.uint8).reshape(codes.shape)


def large(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (SQUARE · rows, SQUARE · columns, 3): each colour of (rows, columns, 3) as a square."""
    return picture.repeat(SQUARE, axis=0).repeat(SQUARE, axis=1)


def main() -> None:
    """Write the picture beside the others of the documentation."""
    codes = file_codes()
    across = np.full((SQUARE * len(codes), GAP, 3), 255, dtype=np.uint8)
    file = large(np.round(codes).astype(np.uint8))
    rows = [np.concatenate([file, across, np.full_like(file, 255)], axis=1)]
    for paper in PAPERS:
        left, right = (large(seen(codes, profile, paper)) for profile in PROFILES)
        rows += [
            np.full((GAP, rows[0].shape[1], 3), 255, dtype=np.uint8),
            np.concatenate([left, across, right], axis=1),
        ]
    Image.fromarray(np.concatenate(rows)).save(Path(__file__).with_name("images") / "prints.png", optimize=True)


if __name__ == "__main__":
    main()
