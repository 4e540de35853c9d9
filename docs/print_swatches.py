"""Draw simulated prints of one file under daylight of 5000 K: ``python -m docs.print_swatches``.

It writes docs/images/prints.png: colours and greys of the file, then on each paper ink codes (left) and managed
(right). The pictures show the sRGB of the reflectances next to an ideal white, so paper is slightly darker than white.
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
# Side of a colour square, px, so that six prints fit into 910 px.
SQUARE = 7
# White gap between prints, px.
GAP = 14


def file_codes() -> NDArray[np.float64]:
    """Return codes 0 to 255 (19, 64, 3): 16 × 16 of red and green at four levels of blue, and three rows of grey."""
    steps = np.linspace(0, 255, 16)
    red, green = np.meshgrid(steps, steps)
    planes = [np.stack([red, green, np.full_like(red, blue)], axis=-1) for blue in (0.0, 85.0, 170.0, 255.0)]
    grey = np.repeat(np.linspace(0, 255, 64)[None, :, None], 3, axis=2)
    return np.concatenate([np.concatenate(planes, axis=1), np.repeat(grey, 3, axis=0)])


def print_srgb(codes: NDArray[np.float64], profile: ProfileName, paper: PaperName) -> NDArray[np.uint8]:
    """Return the sRGB (rows, columns, 3) uint8 of the printed codes (rows, columns, 3) under D50."""
    shape = colour.SpectralShape(float(WAVELENGTHS_NM[0]), float(WAVELENGTHS_NM[-1]), 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    light = observer * colour.SDS_ILLUMINANTS["D50"].copy().align(shape).values[:, None]
    xyz = printed_reflectance(codes.reshape(-1, 3), profile, paper) @ light / light[:, 1].sum()
    white = light.sum(axis=0) / light[:, 1].sum()
    adapted = colour.adaptation.chromatic_adaptation(xyz, white, [0.9505, 1.0, 1.089], method="Von Kries")
    linear = np.asarray(colour.XYZ_to_RGB(adapted, "sRGB"), dtype=np.float64)
    return np.round(255 * encode_srgb(np.clip(linear, 0, 1))).astype(np.uint8).reshape(codes.shape)


def large(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Enlarge each colour of (rows, columns, 3) to a square."""
    return picture.repeat(SQUARE, axis=0).repeat(SQUARE, axis=1)


def main() -> None:
    """Write docs/images/prints.png."""
    codes = file_codes()
    across = np.full((SQUARE * len(codes), GAP, 3), 255, dtype=np.uint8)
    file = large(np.round(codes).astype(np.uint8))
    rows = [np.concatenate([file, across, np.full_like(file, 255)], axis=1)]
    for paper in PAPERS:
        left, right = (large(print_srgb(codes, profile, paper)) for profile in PROFILES)
        rows += [
            np.full((GAP, rows[0].shape[1], 3), 255, dtype=np.uint8),
            np.concatenate([left, across, right], axis=1),
        ]
    Image.fromarray(np.concatenate(rows)).save(Path(__file__).with_name("images") / "prints.png", optimize=True)


if __name__ == "__main__":
    main()
