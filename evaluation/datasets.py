"""The datasets that methods are evaluated on: images with the light they were taken under."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from evaluation.methods import Image
from generator.dataset.reader import Dataset, Entry, open_dataset


class Scene(Protocol):
    """One image of a dataset; read when it is needed."""

    @property
    def name(self) -> str:
        """What the dataset calls it."""
        ...

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, linear camera RGB of any length."""
        ...

    @property
    def saturation(self) -> float | None:
        """Return the value from which a pixel is clipped, None if none is."""
        ...

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3), linear camera RGB, and its mask (H, W) bool, True = not to be used."""
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
        """The light (3,) float64, r + g + b = 1."""
        return np.array(self.entry.truth)

    @property
    def saturation(self) -> float:
        """The table's saturation level."""
        return float(self.dataset.description.table.white_level)

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16; nothing in it is masked."""
        return self.dataset.read_image(self.entry), None


def open_scenes(place: Path | str) -> Sequence[GeneratedScene]:
    """Return the scenes of a dataset, from its folder or its URL on a store that fsspec knows.

    Raises
    ------
    FormatError
        There is no dataset.
    """
    dataset = open_dataset(place)
    return tuple(GeneratedScene(dataset, entry) for entry in dataset.entries)
