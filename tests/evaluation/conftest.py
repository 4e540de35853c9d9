"""A small generated dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibration.table.lut import open_lut
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.pictures.random_scenes import random_scenes
from tests.evaluation.tables import CODES, write_lut

LIGHTS = np.array([[2000.0, 3000, 1000], [1500, 3000, 2500]])


@pytest.fixture
def dataset(make_dataset: Callable[[int, int], Path]) -> Path:
    """Return a dataset of images of 96 x 64 px."""
    return make_dataset(96, 64)


@pytest.fixture
def made_lut(tmp_path: Path) -> Path:
    """Return a LUT in which colours reflect as their codes, under two illuminants, without noise."""
    samples = [(CODES / 7 * light)[:, None].repeat(2, axis=1) for light in LIGHTS]
    return write_lut(tmp_path / "lut", samples, LIGHTS).folder


@pytest.fixture
def make_dataset(made_lut: Path, tmp_path: Path) -> Callable[[int, int], Path]:
    """Return a function that makes data sets of 8 random scenes under the illuminants of this LUT."""

    def make(width: int, height: int) -> Path:
        scenes = random_scenes(8, width, height)
        options = DatasetOptions(previews=False, rendering="codes")
        generate_dataset(open_lut(made_lut), tmp_path / "made", scenes, [0, 1], options=options)
        return tmp_path / "made"

    return make
