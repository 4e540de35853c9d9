"""Small LUTs for tests, and functions that damage them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from calibration.table.lut import Lut, Provenance, SourceFrame, frames_sha256, open_lut
from calibration.table.writing import LutWriter
from experiment.lights import plan_illuminants

LIGHTS = plan_illuminants(1, (2500, 6500))
FRAMES = [SourceFrame("white", None, "frames/0000_white.dng", "00" * 32)] + [
    SourceFrame("light", light.index, f"frames/{light.index + 2:04d}_light.dng", f"{light.index:02x}" * 32)
    for light in LIGHTS
]


def write(folder: Path, seed: int = 0, chart: str = "cd" * 32, lights: int = len(LIGHTS), report: str = "") -> Lut:
    folder.mkdir(exist_ok=bool(report))
    if report:
        (folder / "report.html").write_text(report)
    writer = LutWriter(folder, lights, 8, 25)
    values = np.random.default_rng(seed).integers(0, 14000, (lights, 8, 25, 3), dtype=np.uint16)
    for light in reversed(range(lights)):
        writer.put(light, values[light])
    writer.finish(
        LIGHTS[:lights],
        np.full((lights, 3), 9000.0),
        Provenance(
            camera="Test",
            bits=1,
            white_level=11000,
            session_sha256=frames_sha256(FRAMES),
            chart_sha256=chart,
            software="croplab test",
        ),
        FRAMES,
    )
    lut = open_lut(folder)
    assert np.array_equal(lut.samples, values)
    return lut


def flip(name: str, position: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[position] ^= 1
        (folder / name).write_bytes(data)

    return change
