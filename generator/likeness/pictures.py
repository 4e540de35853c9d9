"""What each source picture would be as a photograph: the numbers that a real data set's images are told by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from foundation.processors import ordered_map
from generator.pictures.sources import Source
from generator.statistics.image_numbers import CELLS, cell_means, log_chroma, numbers_of_cells

if TYPE_CHECKING:
    from calibration.table.lut import Lut

Photograph = Callable[[npt.NDArray[np.uint8], int], npt.NDArray[np.uint16]]
"""From a picture (H, W, 3) uint8 and the number of an image to its raw image (H, W, 3) uint16 under one light."""


@dataclass(frozen=True, eq=False)
class MeasuredPictures:
    """Numbers of source pictures as the camera would see them.

    Attributes
    ----------
    values
        (N,) float64 each, by the names of `image_numbers.numbers_of_cells`; NaN of a picture that has no such number.
    unreadable
        (N,) bool, pictures that cannot be read or cut, of which every number is NaN.
    """

    values: Mapping[str, npt.NDArray[np.float64]]
    unreadable: npt.NDArray[np.bool_]


def reference_light(lut: Lut, lights: npt.NDArray[np.float64]) -> int:
    """Return the light of a table nearest to the mean of lights (L, 3) float64 above 0 in ln(R/G) and ln(B/G)."""
    apart = log_chroma(lut.white) - log_chroma(lights).mean(axis=0)
    return int(np.square(apart).sum(axis=1).argmin())


def measure_pictures(
    sources: Sequence[Source],
    photograph: Photograph,
    white: npt.NDArray[np.float64],
    cells: int = CELLS,
    workers: int = 1,
    on_picture: Callable[[int, int], None] | None = None,
) -> MeasuredPictures:
    """Return the numbers of source pictures, photographed one after the other.

    Parameters
    ----------
    sources
        N pictures.
    photograph
        How each, (H, W, 3) uint8, becomes a raw image (H, W, 3) uint16.
    white
        (3,) float64 above 0, the light of these images in linear camera RGB.
    cells
        Cells a side that images are reduced to, at most: as many as those of the data set that they are held to.
    workers
        Threads; no number depends on it.
    on_picture
        Called after each picture, from the calling thread, with how many are done and how many there are.
    """
    found: list[dict[str, float] | None] = []
    measure = partial(_measure, photograph=photograph, white=white, cells=cells)
    for numbers in ordered_map(measure, enumerate(sources), workers):
        found.append(numbers)
        if on_picture:
            on_picture(len(found), len(sources))
    names = next((numbers.keys() for numbers in found if numbers is not None), ())
    values = {name: np.array([np.nan if numbers is None else numbers[name] for numbers in found]) for name in names}
    return MeasuredPictures(values, np.array([numbers is None for numbers in found]))


def _measure(
    numbered: tuple[int, Source], photograph: Photograph, white: npt.NDArray[np.float64], cells: int
) -> dict[str, float] | None:
    """Return the numbers of a picture, or None if it cannot be read: the dataset would leave it out."""
    number, source = numbered
    try:
        read = source.read()
    except FormatError:
        return None
    crops = [cut.picture for cut in read.cuts] or [read.picture]
    found = [numbers_of_cells(cell_means(photograph(crop, number), white, cells))[0] for crop in crops]
    # Crops of a picture are drawn together, so what they are together counts.
    return {name: float(np.mean([numbers[name] for numbers in found])) for name in found[0]}
