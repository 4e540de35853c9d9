"""Read data sets made by `generate`, of every layout and in every store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.datasets.options import choose_name
from evaluation.scene import SceneSet
from foundation.errors import InputError
from foundation.secret_texts import masked
from generator.dataset.reader import Dataset, open_dataset
from generator.dataset.records import SPLITS, Entry


@dataclass(frozen=True)
class GeneratedScene:
    """Image of a data set made by `generate`."""

    dataset: Dataset
    entry: Entry

    @property
    def name(self) -> str:
        """File name of the image."""
        return self.entry.image

    @property
    def group(self) -> str:
        """Name of the source picture. All images of a source picture belong to the same fold."""
        return self.entry.source

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Ground truth (3,) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.entry.truth)

    @property
    def saturation(self) -> float:
        """Saturation level of the LUT from which the image was made, in the units of the image."""
        return float(self.dataset.description.table.white_level)

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, linear camera RGB, and None for the mask."""
        return self.dataset.read_image(self.entry), None


@dataclass(frozen=True)
class GeneratedMixedScene(GeneratedScene):
    """Generated image with several illuminants."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """Illuminants (K, 3) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.entry.truths)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the fraction of each illuminant in each pixel: (H, W, K) float32, 0 … 1, sum 1."""
        return self.dataset.read_weights(self.entry)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the illuminant of each pixel: (H, W, 3) float32, r + g + b = 1."""
        return self.dataset.read_ground_truth_map(self.entry)


def open_generated(location: Path | str, subset: str | None = None) -> SceneSet:
    """Return a generated data set, or its subset train, validation or test; images are read on use."""
    dataset = open_dataset(location)
    subsets = [split for split in SPLITS if any(entry.split == split for entry in dataset.entries)]
    if subset is not None and not subsets:
        raise InputError(
            f"subset {subset} was requested, but {masked(str(location))} was not divided; generate it with --split "
            "0.8,0.1,0.1, or use evaluate cv, which needs no subsets and keeps all images of a picture in one fold"
        )
    split = choose_name(subset, subsets, "subset", masked(str(location)))
    table = dataset.description.table
    white = table.white_level
    # Results must show that the colours were calculated, not photographed.
    computed = {} if table.computed is None else {"table": "computed from spectra and a model of the sensor"}
    uncertainties_deg = [light.uncertainty_deg for light in dataset.description.lights]
    known_deg = [value for value in uncertainties_deg if value is not None]
    uncertainty_deg = max(known_deg) if known_deg and len(known_deg) == len(uncertainties_deg) else None
    uncertainty_note = "" if uncertainty_deg is None else f"; largest uncertainty {uncertainty_deg:.2g}° (k = 2)"
    return SceneSet(
        name=_dataset_name(str(location)) + (f" {split}" if split else ""),
        layout="generated",
        location=masked(str(location)),
        scenes=tuple(
            (GeneratedScene if len(entry.lights) == 1 else GeneratedMixedScene)(dataset, entry)
            for entry in dataset.entries
            if split is None or entry.split == split
        ),
        treatment={
            **computed,
            "black level": "subtracted when the LUT was made",
            "saturation": f"from {white:g}, the saturation level of the LUT",
            "mask": "none",
            "ground truth": "white under the illuminant, from the LUT; mean over the image if there are several"
            + uncertainty_note,
        },
        truth_uncertainty_deg=uncertainty_deg,
        black_bodies={
            light.cct_k: light.white
            for light in dataset.description.lights
            if light.kind == "blackbody" and light.cct_k is not None
        },
    )


def _dataset_name(location: str) -> str:
    return location.rstrip("/").rpartition("/")[2] if "://" in location else Path(location).resolve().name
