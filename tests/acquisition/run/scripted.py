"""Devices that follow a script, with a fresh session of two illuminants, in simulated time."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from acquisition.run.devices import Devices
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.links.link import Link, PeerLink
from drivers.pjlink import PjLinkProjector
from drivers.presenter import BLACK, Colour
from drivers.projector import Power
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.records import plan_steps
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, LinkClosed
from sim.camera.film import write_dng
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import SimulatedProjector
from sim.world.sensors import BODIES

BODY = BODIES["Test"]
EXPOSURE = ExposureSettings(100, 8.0, 0.5)
LIGHTS = (
    Illuminant(0, "uniform", None, Colour(255, 0, 0)),
    Illuminant(1, "uniform", None, Colour(0, 255, 0)),
)
SETTINGS = LabSettings(rig="simulated", chart=Path("chart.json"), illuminations=Path("lights.csv"))
EXPOSE_S = 1.5
DOWNLOAD_S = 0.3


def raw(level: int, exposure: ExposureSettings = EXPOSURE) -> bytes:
    """Return a raw file in which every photosite has `level` counts above black, and which states `exposure`."""
    stream = io.BytesIO()
    counts = np.full(BODY.sensor, BODY.black + level, dtype=np.uint16)
    for area in BODY.masked:
        counts[area.top : area.top + area.height, area.left : area.left + area.width] = BODY.black
    write_dng(stream, counts, BODY, settings=exposure, taken_at=datetime(2026, 1, 1, tzinfo=UTC))
    return stream.getvalue()


WELL, NIGHT, GLARE = raw(6000), raw(0), raw(BODY.saturation - BODY.black)
TURNED = raw(6000, ExposureSettings(100, 8.0, 0.4))


@dataclass
class Screen:
    """A presenter that records its colours, and fails as scripted.

    `covered`: numbers of the exposures, from 0, after which something covers the picture. `fails`: numbers of the
    failing calls of `show`.
    """

    shown: list[Colour] = field(default_factory=list[Colour])
    fails: dict[int, DeviceError] = field(default_factory=dict[int, DeviceError])
    covered: set[int] = field(default_factory=set[int])
    calls: int = 0
    looks: int = 0

    def show(self, colour: Colour) -> None:
        self.calls += 1
        if fault := self.fails.get(self.calls - 1):
            raise fault
        self.shown.append(colour)

    def verify(self, colour: Colour) -> None:
        self.looks += 1
        assert self.shown[-1] == colour, "the light changed before the screen was looked at"
        if self.looks - 1 in self.covered:
            raise DeviceError("a window of Notes covers the picture; close it")

    def close(self) -> None:
        self.shown.append(BLACK)


class ScriptedCamera:
    """A camera that records black as dark and other colours as well exposed, unless the script differs.

    The script maps the number of an exposure, from 0, to the bytes or the error of its file. `downloads` maps the
    number of a download to its error, `after` maps a number of exposures to an action.
    """

    def __init__(self, screen: Screen, clock: SimulatedClock, script: dict[int, bytes | Exception]) -> None:
        self.screen, self.clock, self.script = screen, clock, script
        self.downloads: dict[int, Exception] = {}
        self.after: dict[int, Callable[[], object]] = {}
        self.exposed: list[Colour] = []
        self.released: list[datetime] = []
        self.fetched = 0
        self.claims: int | None = None
        self.held: bytes | None = None
        self.configured: ExposureSettings | None = None

    @property
    def captures(self) -> int:
        return len(self.exposed)

    def identity(self) -> CameraIdentity:
        return CameraIdentity("Canon", "Test", "1")

    def configure(self, settings: ExposureSettings) -> None:
        self.configured = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        return ()

    def expose(self) -> datetime:
        colour = self.screen.shown[-1]
        scripted = self.script.get(len(self.exposed), NIGHT if colour == BLACK else WELL)
        self.exposed.append(colour)
        if isinstance(scripted, Exception):
            raise scripted
        self.released.append(self.clock.now())
        self.clock.sleep(EXPOSE_S)
        assert self.held is None, "a frame was exposed before the last was fetched"
        self.held = scripted
        self.after.pop(self.captures, lambda: None)()
        return self.released[-1]

    def download(self, into: BinaryIO) -> CapturedFrame:
        self.fetched += 1
        if self.held is None:
            raise DeviceError("the camera holds no frame; take it again")
        if fault := self.downloads.get(self.fetched - 1):
            into.write(b"half a frame")
            raise fault
        into.write(self.held)
        self.clock.sleep(DOWNLOAD_S)
        size = len(self.held) if self.claims is None else self.claims
        self.claims = None
        if size == len(self.held):
            self.held = None
        return CapturedFrame(f"IMG_{self.captures:04d}.DNG", size, self.released[-1])

    def close(self) -> None: ...


class Lab:
    """Scripted devices with a fresh session."""

    def __init__(
        self,
        folder: Path,
        script: dict[int, bytes | Exception] | None = None,
        lights: Sequence[Illuminant] = LIGHTS,
        reference_every: int = 25,
    ) -> None:
        self.clock = SimulatedClock()
        self.screen = Screen()
        self.camera = ScriptedCamera(self.screen, self.clock, script or {})
        self.projector = SimulatedProjector(self.clock, power=Power.ON)
        chart = design_chart(bits=1)
        steps = plan_steps(lights, reference_every)
        self.session = Session.create(folder, SETTINGS.to_toml(), chart, lights, steps)

    @property
    def devices(self) -> Devices:
        return Devices(self.camera, self.screen, self.projector, self.clock)

    def verdicts(self) -> list[str | None]:
        return [attempt.verdict for attempt in self.session.journal.attempts()]

    def taken(self) -> list[tuple[str, str | None]]:
        """Return the steps of the attempts in order, ``w0``, ``d1``, ``l2``, with their verdicts."""
        return [(f"{attempt.kind[0]}{attempt.step}", attempt.verdict) for attempt in self.session.journal.attempts()]


DEVICES = ("camera", "display", "projector")
FAULTY = [chosen for count in (1, 2, 3) for chosen in itertools.combinations(DEVICES, count)]

SAYS = {
    "camera": "the camera is asleep; wake it up",
    "display": "HDMI-1 is covered; close what covers it",
    "projector": "nobody answers at 192.0.2.7; look at its cable",
}


class Broken:
    """A device whose methods all fail, except `close`."""

    def __init__(self, says: str) -> None:
        self._says = says

    def close(self) -> None:
        """Do nothing."""

    def __getattr__(self, name: str) -> Any:
        def fail(*_: object) -> None:
            raise LinkClosed(self._says)

        return fail


class Beamer:
    """A projector on a PJLink cable that can be pulled."""

    def __init__(self, clock: SimulatedClock, power: Power = Power.ON) -> None:
        self.device = SimulatedProjector(clock, power=power)
        self.projector = PjLinkProjector(self._connect, clock=clock)
        self._pulled = False
        self._cable: Link | None = None

    def _connect(self) -> Link:
        if self._pulled:
            raise LinkClosed("nothing listens at 127.0.0.1:4352")
        cable = self._cable = PeerLink(PjLinkPeer(self.device))
        return cable

    def pull(self, pulled: bool = True) -> None:
        self._pulled = pulled
        if self._cable is not None:
            self._cable.close()


class Hurried(SimulatedClock):
    """A clock that calls a function during the sleep of a pause."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[float, Callable[[], None]] = {}

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if call := self.calls.pop(seconds, None):
            call()
