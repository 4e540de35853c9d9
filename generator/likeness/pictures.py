"""What each source picture would be as a photograph: the numbers that a real data set's images are told by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from foundation.processors import ordered_map
from generator.pictures.sources import Source
from generator.statistics.image_numbers import CELLS, cell_means, log_chroma, numbers_of_cells

if TYPE_CHECKING:
    from calibration.table.lut import Lut

TRIED_SHARES: Final = (0.0, 0.3, 0.5, 0.65, 0.75, 0.83, 0.88, 0.92, 0.96, 1.0)
"""Shares of the print's black that are tried with each picture: chosen so that what is left shrinks by a third from one
to the next, since the shadows of real images differ by factors, and at last is nothing."""

Photograph = Callable[[npt.NDArray[np.uint8], int], npt.NDArray[np.uint16]]
"""From a picture (H, W, 3) uint8 and the number of an image to its raw image (H, W, 3) uint16 under one light."""


@dataclass(frozen=True, eq=False)
class MeasuredPictures:
    """Numbers of source pictures as the camera would see them.

    - `values`: (N,) float64 each, by the names of `image_numbers.numbers_of_cells`; NaN of a picture that has no such
      number.
    - `unreadable`: (N,) bool, pictures that cannot be read or cut, of which every number is NaN.
    - `shares`: shares of the print's black, 0 … 1, at which each picture was measured, or none: then N is the number of
      pictures times shares, those of a picture one after the other.
    """

    values: Mapping[str, npt.NDArray[np.float64]]
    unreadable: npt.NDArray[np.bool_]
    shares: tuple[float, ...] = ()

    @property
    def variants(self) -> int:
        """How often each picture was measured."""
        return max(1, len(self.shares))


@dataclass(frozen=True)
class BlackShares:
    """Of a print's black, shares that are tried with each picture.

    - `black`: (3,) what the camera sees of the print's black under the light of the measurement, counts.
    - `shares`: what is taken out of it, 0 … 1, at least one.
    """

    black: tuple[float, float, float]
    shares: tuple[float, ...] = TRIED_SHARES


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
    black: BlackShares | None = None,
) -> MeasuredPictures:
    """Return the numbers of source pictures, photographed one after the other.

    `photograph`: how each, (H, W, 3) uint8, becomes a raw image (H, W, 3) uint16. `white`: (3,) float64 above 0, the
    light of these images in linear camera RGB. `black`: shares of the print's black that are taken out of the cells of
    each photograph, which was taken with all of it; None leaves photographs as they are.
    """
    found: list[dict[str, float] | None] = []
    measure = partial(_measure, photograph=photograph, white=white, cells=cells, black=black)
    shares = black.shares if black else ()
    for done, numbers in enumerate(ordered_map(measure, enumerate(sources), workers), 1):
        found += [None] * max(1, len(shares)) if numbers is None else numbers
        if on_picture:
            on_picture(done, len(sources))
    names = next((numbers.keys() for numbers in found if numbers is not None), ())
    values = {name: np.array([np.nan if numbers is None else numbers[name] for numbers in found]) for name in names}
    return MeasuredPictures(values, np.array([numbers is None for numbers in found]), shares)


def _measure(
    numbered: tuple[int, Source],
    photograph: Photograph,
    white: npt.NDArray[np.float64],
    cells: int,
    black: BlackShares | None,
) -> list[dict[str, float]] | None:
    """Return the numbers of a picture with each share, or None if it cannot be read: the dataset would leave it out."""
    number, source = numbered
    try:
        read = source.read()
    except FormatError:
        return None
    crops = [cut.picture for cut in read.cuts] or [read.picture]
    means = [cell_means(photograph(crop, number), white, cells) for crop in crops]
    by_share: list[dict[str, float]] = []
    for share in black.shares if black else (None,):
        taken = means if black is None or share is None else [_without(mean, black, share, white) for mean in means]
        found = [numbers_of_cells(mean)[0] for mean in taken]
        # Crops of a picture are drawn together, so what they are together counts.
        by_share.append({name: float(np.mean([numbers[name] for numbers in found])) for name in found[0]})
    return by_share


def _without(
    means: npt.NDArray[np.float64], black: BlackShares, share: float, white: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return cells (h, w, 3) float64, divided by their light, without a share of the black: as `black_points` has it.

    What is done there to samples is done here to means of cells, which is the same but where a sample is darker than
    what is taken out of it.
    """
    part = share * np.array(black.black) / white
    return np.maximum(means - part * white.mean(), 0) / (1 - part)
