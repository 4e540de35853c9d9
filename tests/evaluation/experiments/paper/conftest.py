"""Small made-up tables of the paper's two cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from experiment.lights import Illumination

BITS = 3
"""Bits a channel of the tables: 512 colours."""

LIGHTS = np.array([[2000.0, 3000, 1000], [1500, 3000, 2500], [2600, 3000, 700], [900, 2000, 3000]])
"""The tables' lights, camera RGB; the last two are black bodies of the plan."""

TableMaker = Callable[..., Lut]


@pytest.fixture
def make_table(tmp_path: Path) -> TableMaker:
    """Return a maker of tables whose colours reflect as their code, with noise of that share of the value."""

    def make(camera: str, noise: float = 0.0, samples: int = 25) -> Lut:
        folder = tmp_path / camera.replace(" ", "-")
        folder.mkdir()
        index = np.arange(8**BITS)
        code = np.stack([index >> 2 * BITS, index >> BITS & 7, index & 7], axis=-1) / 7
        writer = LutWriter(folder, len(LIGHTS), 8**BITS, samples)
        rng = np.random.default_rng(5)
        for number, light in enumerate(LIGHTS):
            bright: npt.NDArray[np.float64] = (code * light)[:, None, :].repeat(samples, axis=1)
            values = bright * (1 + noise * rng.standard_normal(bright.shape))
            writer.put(number, np.rint(np.maximum(values, 0)).astype(np.uint16))
        known = Provenance(
            camera=camera, bits=BITS, white_level=9000, session_sha256="0", chart_sha256="0", software="t"
        )
        plan = [
            Illumination(number, "uniform", None, Colour(1, 2, 3))
            if number < 2
            else Illumination(number, "blackbody", 3000.0 + number, Colour(1, 2, 3))
            for number in range(len(LIGHTS))
        ]
        writer.finish(plan, LIGHTS, known)
        return open_lut(folder)

    return make
