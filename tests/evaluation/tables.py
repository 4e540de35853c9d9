"""Look-up tables of 512 colours with given samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from experiment.lights import Illuminant

CODES = np.indices((8, 8, 8)).reshape(3, -1).T
"""The codes (512, 3) of 3 bits, 0 … 7, in the order of a table."""

WHITE_LEVEL = 9000


def write_lut(
    folder: Path, samples: Sequence[npt.NDArray[np.float64]], lights: npt.NDArray[np.float64], camera: str = "Test"
) -> Lut:
    """Write the samples (512, S, 3) under each illuminant; from the third on illuminants are black bodies."""
    folder.mkdir(parents=True)
    writer = LutWriter(folder, len(lights), len(CODES), samples[0].shape[1])
    for number, values in enumerate(samples):
        writer.put(number, np.rint(values).astype(np.uint16))
    names = Provenance(
        camera=camera, bits=3, white_level=WHITE_LEVEL, session_sha256="0", chart_sha256="0", software="test"
    )
    plan = [
        Illuminant(number, "uniform", None, Colour(1, 2, 3))
        if number < 2
        else Illuminant(number, "blackbody", 3000.0 + number, Colour(1, 2, 3))
        for number in range(len(lights))
    ]
    writer.finish(plan, lights, names)
    return open_lut(folder)
