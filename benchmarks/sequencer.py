"""What the sequencer costs beside the devices: frames of full size through it, against saving the same bytes safely.

`python -m benchmarks.sequencer` prints one JSON object a line for each figure.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tempfile
import time
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np

from acquisition.chart.layout import design_chart
from acquisition.config import LabSettings
from acquisition.judge.exposure import judge_file
from acquisition.lights.illuminations import Illumination
from acquisition.run.devices import Devices
from acquisition.run.sequencer import take_session
from acquisition.session.folder import Session
from acquisition.session.plan import plan_steps
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from sim.camera.dng import write_dng
from sim.clock import SimulatedClock
from sim.world.sensors import BODIES

LIGHTS = 12
BODY = BODIES["EOS 550D"]
SETTINGS = LabSettings(rig="simulated", chart=Path("chart.json"), illuminations=Path("illuminations.csv"))


class Screen:
    """Remembers the colour."""

    colour = BLACK

    def show(self, colour: Colour) -> None:
        """Show at once."""
        self.colour = colour

    def close(self) -> None:
        """Do nothing."""


class PreparedCamera:
    """Hands out one of two prepared files, so that the camera costs nothing but the write."""

    def __init__(self, screen: Screen, clock: SimulatedClock) -> None:
        self.screen, self.clock = screen, clock
        self.lit, self.dark = _raw(5000), _raw(0)
        self.content = self.dark

    def identity(self) -> CameraIdentity:
        """Return a name."""
        return CameraIdentity("CroP", "prepared", "0")

    def configure(self, settings: ExposureSettings) -> None:
        """Do nothing."""

    def shutter_speeds(self) -> tuple[float, ...]:
        """Offer none: nobody asks."""
        return ()

    def expose(self) -> datetime:
        """See what the screen shows."""
        self.content = self.dark if self.screen.colour == BLACK else self.lit
        return self.clock.now()

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write a file."""
        content = self.content
        return CapturedFrame("IMG_0001.DNG", into.write(content), self.clock.now())

    def close(self) -> None:
        """Do nothing."""


def _raw(level: int) -> bytes:
    counts = np.full(BODY.sensor, BODY.black + level, dtype=np.uint16)
    for area in BODY.masked:
        counts[area.top : area.top + area.height, area.left : area.left + area.width] = BODY.black
    stream = io.BytesIO()
    write_dng(stream, counts, BODY, settings=ExposureSettings(100, 8, 0.5), taken_at=SimulatedClock().now())
    return stream.getvalue()


def _save(path: Path, content: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    hashlib.sha256(content).hexdigest()


def main() -> int:
    """Measure a session of prepared frames."""
    clock, screen = SimulatedClock(), Screen()
    camera = PreparedCamera(screen, clock)
    lights = tuple(Illumination(number, "uniform", None, Colour(255, number, 9)) for number in range(LIGHTS))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        steps = plan_steps(lights, 25)
        with Session.create(folder / "session", SETTINGS.to_toml(), design_chart(bits=1), lights, steps) as session:
            begun = time.perf_counter()
            outcome = take_session(session, Devices(camera, screen, None, clock), SETTINGS)
            taken = time.perf_counter() - begun
            assert outcome.complete
            file = folder / "session" / session.frames()[0].file
            begun = time.perf_counter()
            for _ in steps:
                judge_file(file, "white", SETTINGS)
            judged = time.perf_counter() - begun
        begun = time.perf_counter()
        for number in range(len(steps)):
            _save(folder / f"{number}.dng", camera.lit)
        saved = time.perf_counter() - begun
    for name, value, unit, against in (
        ("sequencer: seconds a frame of 18 Mpx, saved, hashed, decoded, judged", taken / len(steps), "s", ""),
        ("sequencer: time over saving and hashing the same bytes", taken / saved, "ratio", "write, fsync, SHA-256"),
        ("sequencer: time over that and decoding", taken / (saved + judged), "ratio", "the same and judge_file"),
    ):
        print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
