"""Small look-up tables of prints with known faults."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from experiment.lights import Illuminant
from tests.generator.rendering.prints import WHITES, printed

MakeTable = Callable[..., Lut]


@pytest.fixture
def make_table(tmp_path: Path) -> MakeTable:
    """Return a function that writes a LUT of a print, with Poisson noise, to a new folder."""

    def make(
        bits: int = 3,
        tint: float = 0.0,
        blue_of_green: float = 0.0,
        lights: int = 3,
        change: Callable[[npt.NDArray[np.uint16]], None] | None = None,
        camera: str = "Canon EOS 550D",
        white_level: int = 11536,
        name: str = "lut",
        computed: dict[str, Any] | None = None,
    ) -> Lut:
        folder = tmp_path / name
        folder.mkdir()
        writer = LutWriter(folder, lights, 1 << 3 * bits, 25)
        rng = np.random.default_rng(20191127)
        illuminations: list[Illuminant] = []
        for light, kelvin in zip(range(lights), (2000.0, 5600.0, 10000.0), strict=False):
            camera_colours = printed(bits, tint)
            if light == 0:
                # A warm illuminant has no blue: the blue channel records mostly green.
                camera_colours[:, 2] += blue_of_green * (camera_colours[:, 1] - camera_colours[:, 2])
            means = camera_colours * WHITES[light]
            counts = np.asarray(rng.poisson(np.repeat(means[:, None], 25, axis=1)), np.int64)
            samples: npt.NDArray[np.uint16] = np.minimum(counts, white_level).astype(np.uint16)
            if change is not None:
                change(samples)
            writer.put(light, samples)
            illuminations.append(Illuminant(light, "blackbody", kelvin, Colour(255, 255 - light, light)))
        writer.finish(
            illuminations,
            WHITES[:lights],
            Provenance(
                camera=camera,
                bits=bits,
                white_level=white_level,
                session_sha256="1" * 64,
                chart_sha256="2" * 64,
                software="test 1",
                computed=computed,
            ),
        )
        return open_lut(folder)

    return make
