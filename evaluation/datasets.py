"""Datasets to evaluate methods on: images, each with the light that it was taken under."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Image
from generator.dataset.reader import Dataset, Entry, open_dataset


class Scene(Protocol):
    """One image of a dataset with its ground truth; the image is read from its file by `read`."""

    @property
    def name(self) -> str:
        """The image's name in its dataset."""
        ...

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB of any length: the ground truth."""
        ...

    @property
    def saturation(self) -> float | None:
        """Value of the image from which a pixel is clipped; None if none is."""
        ...

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3), linear camera RGB with black subtracted, and its mask.

        The mask is (H, W) bool, True where a pixel must not be used, or None if every pixel may be.
        """
        ...


@dataclass(frozen=True)
class GeneratedScene:
    """An image of a dataset made by `generate`."""

    dataset: Dataset
    entry: Entry

    @property
    def name(self) -> str:
        """The image's file name."""
        return self.entry.image

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.entry.truth)

    @property
    def saturation(self) -> float:
        """White level of the table that the image was made with, in the units of the image."""
        return float(self.dataset.description.table.white_level)

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, linear camera RGB, and no mask."""
        return self.dataset.read_image(self.entry), None


def open_scenes(place: Path | str) -> Sequence[GeneratedScene]:
    """Return the scenes of a dataset made by `generate`; images are read when they are evaluated.

    Parameters
    ----------
    place
        The dataset's folder, or its URL on a store that fsspec knows.

    Raises
    ------
    FormatError
        There is no dataset in that place.
    """
    dataset = open_dataset(place)
    return tuple(GeneratedScene(dataset, entry) for entry in dataset.entries)
