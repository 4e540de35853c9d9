"""Small simulated look-up tables of the paper's two cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibration.table.lut import Lut
from tests.evaluation.tables import CODES, write_lut

LIGHTS = np.array([[2000.0, 3000, 1000], [1500, 3000, 2500], [2600, 3000, 700], [900, 2000, 3000]])
"""The tables' lights, camera RGB; the last two are black bodies of the plan."""

TableMaker = Callable[..., Lut]


@pytest.fixture
def make_table(tmp_path: Path) -> TableMaker:
    """Return a function that makes LUTs whose colours reflect as their codes, with relative noise."""

    def make(camera: str, noise: float = 0.0, samples: int = 25) -> Lut:
        random = np.random.default_rng(5)
        bright = [(CODES / 7 * light)[:, None].repeat(samples, axis=1) for light in LIGHTS]
        noisy = [np.maximum(sample * (1 + noise * random.standard_normal(sample.shape)), 0) for sample in bright]
        return write_lut(tmp_path / camera.replace(" ", "-"), noisy, LIGHTS, camera)

    return make
