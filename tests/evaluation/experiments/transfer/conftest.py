"""Generated sets of a naive look-up table: colours reflect the linear sRGB of their codes, without print and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from calibration.table.lut import Lut
from evaluation.datasets.generated import open_generated
from evaluation.scene import SceneSet
from foundation.colorimetry import decode_srgb
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.lights.lighting import LightChoice, ListedLights
from generator.pictures.sources import UNPREPARED, Preparation, find_pictures
from generator.variation.sensor_noise import SensorNoise
from generator.variation.variation import Variation, parse_gradient
from tests.evaluation.tables import CODES, write_lut

LIGHTS = np.array([[4000.0, 8000, 3000], [3000, 8000, 6000]])
"""Counts of white under the two lights of the table."""
BOTH = ListedLights((0, 1))


@dataclass(frozen=True)
class Maker:
    """Makes generated sets in a folder from its pictures and its LUT."""

    folder: Path
    lut: Lut

    @property
    def pictures(self) -> Path:
        return self.folder / "pictures"

    def make(
        self,
        name: str = "made",
        lights: LightChoice = BOTH,
        preparation: Preparation = UNPREPARED,
        split: tuple[float, float, float] | None = None,
        pictures: Path | None = None,
        seed: int = 0,
        gradient: str | None = None,
    ) -> SceneSet:
        reading = {} if preparation == UNPREPARED else preparation.describe()
        if seed != preparation.seed:
            reading["lights_of"] = {"pictures_seed": preparation.seed}
        silent = SensorNoise((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        variation = None if gradient is None else Variation(gradient=parse_gradient(gradient), noise=silent)
        options = DatasetOptions(
            previews=False,
            split=split,
            reading=reading,
            crops=preparation.crops,
            variation=variation,
            rendering="codes",
        )
        sources = find_pictures(pictures or self.pictures, preparation)
        generate_dataset(self.lut, self.folder / name, sources, lights, seed=seed, options=options)
        return open_generated(self.folder / name)


def save_pictures(folder: Path, names: Sequence[str], seed: int = 0, side: int = 24) -> None:
    """Save pictures of flat patches, with codes that the LUT contains exactly."""
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        patches: npt.NDArray[np.uint8] = random.integers(0, 8, (side // 4, side // 4, 3)).astype(np.uint8) * 32
        Image.fromarray(patches.repeat(4, axis=0).repeat(4, axis=1)).save(folder / name)


def write_table(folder: Path, matrix: npt.NDArray[np.float64] | None = None, camera: str = "Canon EOS 550D") -> Lut:
    """Write a LUT with samples of linear sRGB, optionally through a matrix, times the illuminant."""
    linear = decode_srgb(CODES * 32 / 255)
    if matrix is not None:
        linear = np.maximum(linear @ matrix.T, 0)
    return write_lut(folder, [(linear * light)[:, None].repeat(2, axis=1) for light in LIGHTS], LIGHTS, camera)


@pytest.fixture
def maker(tmp_path: Path) -> Maker:
    """Return a `Maker` with three pictures."""
    save_pictures(tmp_path / "pictures", ("a.png", "b.png", "c.png"))
    return Maker(tmp_path, write_table(tmp_path / "lut"))
