"""LUTs without noise for two cameras and known illuminants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from experiment.lights import Illuminant

# Spectra in three bands, by the blue code of the projector.
SPECTRA: dict[int, tuple[float, float, float]] = {0: (9, 5, 2), 1: (7, 6, 4), 2: (5, 6, 6), 3: (3, 5, 9), 4: (4, 9, 3)}

# Sensitivities of two cameras in these bands.
CAMERAS: dict[str, npt.NDArray[np.float64]] = {
    "one": np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.2], [0.0, 0.1, 0.8]]),
    "two": np.array([[0.7, 0.3, 0.0], [0.2, 0.9, 0.1], [0.1, 0.1, 1.1]]),
}


def camera_counts(camera: str, light: int) -> npt.NDArray[np.float64]:
    """Return the counts (64, 3) of all patches of 2 bits; black reflects 0.1 and paper 1."""
    index = np.arange(64)
    reflected = 0.1 + 0.9 * np.stack([index >> 4 & 3, index >> 2 & 3, index & 3], axis=1) / 3
    return 400 * (reflected * SPECTRA[light]) @ CAMERAS[camera].T


def make_table(folder: Path, camera: str, order: tuple[int, ...], names: tuple[str, ...] = ()) -> Lut:
    """Make a LUT of 2 bits without noise; with names, all illuminants are spectra with equal codes."""
    folder.mkdir()
    writer = LutWriter(folder, len(order), 64, 25)
    white: list[npt.NDArray[np.float64]] = []
    for number, light in enumerate(order):
        counts = camera_counts(camera, light)
        writer.put(number, np.rint(counts)[:, None, :].repeat(25, axis=1).astype(np.uint16))
        white.append(counts[-1])
    plan = [Illuminant(number, "uniform", None, Colour(9, 8, light)) for number, light in enumerate(order)]
    if names:
        plan = [Illuminant(number, "spectrum", None, Colour(9, 8, 7), name) for number, name in enumerate(names)]
    writer.finish(
        plan,
        np.array(white),
        Provenance(
            camera=f"Camera {camera}",
            bits=2,
            white_level=12000,
            session_sha256="1" * 64,
            chart_sha256="2" * 64,
            software="test 1",
        ),
    )
    return open_lut(folder)
