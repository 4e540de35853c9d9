"""Data sets made by `generate`, of every layout and in every store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.datasets.options import choose
from evaluation.scene import SceneSet
from foundation.errors import InputError
from foundation.secret_texts import masked
from generator.dataset.reader import Dataset, open_dataset
from generator.dataset.records import SPLITS, Entry


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
    def group(self) -> str:
        """Name of the picture that it was made from, which other images may share: they are kept in one fold."""
        return self.entry.source

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


@dataclass(frozen=True)
class GeneratedMixedScene(GeneratedScene):
    """An image of such a dataset that several lights fall on."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.entry.truths)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the share of each light in each pixel: (H, W, K) float32, 0 … 1, sum 1."""
        return self.dataset.read_weights(self.entry)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1."""
        return self.dataset.read_ground_truth_map(self.entry)


def open_generated(place: Path | str, subset: str | None = None) -> SceneSet:
    """Return a dataset made by `generate`, or one part of it; images are read when they are evaluated.

    `subset`: train, validation or test of `generate --split`; a picture is in one part with all its images.
    """
    dataset = open_dataset(place)
    parts = [part for part in SPLITS if any(entry.split == part for entry in dataset.entries)]
    if subset is not None and not parts:
        raise InputError(
            f"the subset is {subset}, but {masked(str(place))} was not divided; generate --split 0.8,0.1,0.1 divides a "
            "dataset by pictures, and evaluate cv keeps the images of a picture in one fold without that"
        )
    part = choose(subset, parts, "subset", masked(str(place)))
    table = dataset.description.table
    white = table.white_level
    # Whoever reads results must see that no camera took a photograph of these colours.
    computed = {} if table.computed is None else {"table": "computed from spectra and a model of the sensor"}
    stated = [light.uncertainty_deg for light in dataset.description.lights]
    known = max((one for one in stated if one is not None), default=None) if None not in stated else None
    within = "" if known is None else f"; its direction is known to {known:.2g} degrees at worst (k = 2)"
    return SceneSet(
        name=_name_of(str(place)) + (f" {part}" if part else ""),
        layout="generated",
        location=masked(str(place)),
        scenes=tuple(
            (GeneratedScene if len(entry.lights) == 1 else GeneratedMixedScene)(dataset, entry)
            for entry in dataset.entries
            if part is None or entry.split == part
        ),
        treatment={
            **computed,
            "black level": "subtracted when the table was made",
            "saturation": f"from {white:g}, the white level of the table",
            "mask": "none",
            "ground truth": "white of the light as the table has it; of several lights their mean over the image"
            + within,
        },
        truth_uncertainty_deg=known,
    )


def _name_of(place: str) -> str:
    """Return the name of a dataset: the last part of its URL, or of its folder's absolute path."""
    return place.rstrip("/").rpartition("/")[2] if "://" in place else Path(place).resolve().name
