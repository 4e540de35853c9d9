"""The sequencer against scripted devices: what fails is tried again, said, and never costs what was taken."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from acquisition.chart.layout import design_chart
from acquisition.config import LabSettings
from acquisition.lights.illuminations import Illumination
from acquisition.run.devices import Devices
from acquisition.run.lamp import RELIGHT_S
from acquisition.run.patience import PAUSE_S
from acquisition.run.sequencer import take_session
from acquisition.session.folder import Session
from acquisition.session.plan import plan_steps
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.links.link import Link
from drivers.pjlink.projector import PjLinkProjector
from drivers.presenter import BLACK, Colour
from drivers.projector import Power, Severity
from foundation.errors import DeviceError, DeviceFault, DeviceRefused, LinkClosed, LinkTimeout
from sim.camera.dng import write_dng
from sim.clock import SimulatedClock
from sim.projectors.pjlink import PjLinkPeer, memory_link
from sim.projectors.projector import SimulatedProjector
from sim.world.sensors import BODIES

BODY = BODIES["Test"]
EXPOSURE = ExposureSettings(100, 8.0, 0.5)
LIGHTS = (
    Illumination(0, "uniform", None, Colour(255, 0, 0)),
    Illumination(1, "uniform", None, Colour(0, 255, 0)),
)
SETTINGS = LabSettings(rig="simulated", chart=Path("chart.json"), illuminations=Path("lights.csv"))


def raw(level: int, exposure: ExposureSettings = EXPOSURE) -> bytes:
    """Return a raw file whose every photosite has `level` counts above black, and which states `exposure`."""
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
    """A presenter that remembers what it showed."""

    shown: list[Colour] = field(default_factory=list[Colour])

    def show(self, colour: Colour) -> None:
        self.shown.append(colour)

    def close(self) -> None:
        self.shown.append(BLACK)


class ScriptedCamera:
    """Photographs black as dark and every other colour as well exposed, unless the script says otherwise.

    The script maps the number of a capture, from 0, to the bytes it gives or the error it raises.
    """

    def __init__(self, screen: Screen, clock: SimulatedClock, script: dict[int, bytes | Exception]) -> None:
        self.screen, self.clock, self.script = screen, clock, script
        self.captures = 0
        self.claims: int | None = None

    def identity(self) -> CameraIdentity:
        return CameraIdentity("Canon", "Test", "1")

    def configure(self, settings: ExposureSettings) -> None:
        self.settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        return ()

    def capture(self, into: BinaryIO) -> CapturedFrame:
        usual = NIGHT if self.screen.shown[-1] == BLACK else WELL
        scripted = self.script.get(self.captures, usual)
        self.captures += 1
        if isinstance(scripted, Exception):
            into.write(b"half a frame")
            raise scripted
        into.write(scripted)
        self.clock.sleep(1.5)
        size = len(scripted) if self.claims is None else self.claims
        self.claims = None
        return CapturedFrame(f"IMG_{self.captures:04d}.DNG", size, self.clock.now())

    def close(self) -> None: ...


class Lab:
    """Scripted devices around a fresh session of two lights."""

    def __init__(self, folder: Path, script: dict[int, bytes | Exception] | None = None) -> None:
        self.clock = SimulatedClock()
        self.screen = Screen()
        self.camera = ScriptedCamera(self.screen, self.clock, script or {})
        self.projector = SimulatedProjector(self.clock, power=Power.ON)
        chart = design_chart(bits=1)
        self.session = Session.create(folder, SETTINGS.to_toml(), chart, LIGHTS, plan_steps(LIGHTS, 25))

    @property
    def devices(self) -> Devices:
        return Devices(self.camera, self.screen, self.projector, self.clock)

    def verdicts(self) -> list[str | None]:
        return [attempt.verdict for attempt in self.session.journal.attempts()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


def test_every_light_is_shown_once_and_its_frame_kept(folder: Path) -> None:
    lab = Lab(folder)
    outcome = take_session(lab.session, lab.devices, SETTINGS)
    assert outcome.complete
    white = Colour(255, 255, 255)
    assert lab.screen.shown == [white, BLACK, LIGHTS[0].colour, LIGHTS[1].colour, white, BLACK]
    assert lab.projector.power() is Power.COOLING, "a complete session switches the lamp off"
    assert lab.verdicts() == ["accepted"] * 6


@pytest.mark.parametrize("fault", [LinkTimeout("no answer"), DeviceError("lost")])
def test_a_lost_frame_is_taken_again(folder: Path, fault: Exception) -> None:
    lab = Lab(folder, {2: fault})
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["accepted", "accepted", "failed", "accepted", "accepted", "accepted", "accepted"]
    assert len(list((folder / "frames").iterdir())) == 6


def test_a_device_that_stays_silent_ends_the_run_and_costs_nothing(folder: Path) -> None:
    lab = Lab(folder, dict.fromkeys(range(3, 6), LinkTimeout("no answer from the camera")))
    with pytest.raises(LinkTimeout, match="no answer"):
        take_session(lab.session, lab.devices, SETTINGS)
    assert len(lab.session.frames()) == 3
    assert take_session(lab.session, lab.devices, SETTINGS).complete


def test_a_refusal_is_not_repeated(folder: Path) -> None:
    lab = Lab(folder, {2: DeviceRefused("card full")})
    with pytest.raises(DeviceRefused):
        take_session(lab.session, lab.devices, SETTINGS)
    assert lab.camera.captures == 3


def test_a_cut_transfer_is_noticed(folder: Path) -> None:
    lab = Lab(folder)
    lab.camera.claims = len(WELL) + 1
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert "bytes" in lab.session.journal.attempts()[0].reason
    assert lab.verdicts()[0] == "failed"


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (NIGHT, "is the projector on"),
        (GLARE, "clipped"),
        (TURNED, "0.4 instead of 0.5"),
        (WELL[:-5000], ""),
        (b"garbage", "raw"),
    ],
)
def test_a_bad_frame_is_kept_refused_and_taken_again(folder: Path, bad: bytes, reason: str) -> None:
    lab = Lab(folder, {2: bad})
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    refused = [frame for frame in lab.session.frames() if not frame.accepted]
    assert len(refused) == 1
    assert reason in refused[0].verdict
    assert (folder / refused[0].file).read_bytes() == bad
    assert len(lab.session.frames()) == 7


def test_a_lit_dark_frame_is_refused(folder: Path) -> None:
    lab = Lab(folder, {1: WELL})
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert "another light" in lab.session.journal.attempts()[1].reason


def test_lasting_darkness_ends_the_run_with_its_reason(folder: Path) -> None:
    lab = Lab(folder, dict.fromkeys(range(100), NIGHT))
    outcome = take_session(lab.session, lab.devices, SETTINGS)
    assert not outcome.complete
    assert len(outcome.refused) == 3
    assert "light 0" in outcome.refused[1]
    lab.camera.script = {}
    assert take_session(lab.session, lab.devices, SETTINGS).complete


def test_a_failing_lamp_ends_the_run_when_patience_does(folder: Path) -> None:
    lab = Lab(folder)

    def fail(step: object, accepted: bool) -> None:
        if lab.camera.captures == 3:
            lab.projector.break_part("lamp", Severity.ERROR)

    begun = lab.clock.monotonic()
    with pytest.raises(DeviceFault, match="lamp"):
        take_session(lab.session, lab.devices, SETTINGS, fail)
    assert lab.clock.monotonic() - begun >= SETTINGS.sequence.patience_s
    assert len(lab.session.frames()) == 3
    lab.projector.repair()
    lab.projector.switch_on()
    assert take_session(lab.session, lab.devices, SETTINGS).complete


class Hurried(SimulatedClock):
    """A clock that calls somebody when a pause is slept through."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[float, Callable[[], None]] = {}
        self.slept: list[float] = []

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self.slept.append(seconds)
        if call := self.calls.pop(seconds, None):
            call()


def test_a_muted_picture_pauses_the_run_until_it_is_released(folder: Path) -> None:
    lab = Lab(folder)
    lab.clock = clock = Hurried()
    lab.camera.clock = clock
    lab.projector = SimulatedProjector(clock, power=Power.ON)
    clock.calls[PAUSE_S] = lambda: lab.projector.set_muted(False)

    def mute(step: object, accepted: bool) -> None:
        if lab.camera.captures == 2:
            lab.projector.set_muted(True)

    said: list[str] = []
    assert take_session(lab.session, lab.devices, SETTINGS, mute, said.append).complete
    assert [sentence.split(":")[0] for sentence in said] == ["retry", "paused", "resumed"]
    assert [event.what for event in lab.session.journal.events()] == ["start", "retry", "paused", "resumed", "complete"]
    assert "mute" in lab.session.journal.events()[1].detail
    assert lab.verdicts() == ["accepted"] * 6


def test_a_frame_during_which_the_picture_was_muted_is_taken_again(folder: Path) -> None:
    lab = Lab(folder)
    lab.clock = clock = Hurried()
    lab.camera.clock = clock
    lab.projector = SimulatedProjector(clock, power=Power.ON)
    # The scripted camera sleeps 1.5 s for its first frame: that is when somebody presses mute.
    clock.calls = {1.5: lambda: lab.projector.set_muted(True), PAUSE_S: lambda: lab.projector.set_muted(False)}
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["refused"] + ["accepted"] * 6
    assert "muted" in lab.session.frames()[0].verdict


class Disturbed:
    """A lab whose projector hangs on a PJLink cable; what `disturb` does comes after the second frame."""

    def __init__(self, folder: Path) -> None:
        self.lab = Lab(folder)
        self.lab.clock = self.clock = self.lab.camera.clock = Hurried()
        self.beamer = SimulatedProjector(self.clock, power=Power.ON)
        self.pulled = False
        self.cable: Link | None = None
        self.said: list[str] = []

    def connect(self) -> Link:
        if self.pulled:
            raise LinkClosed("nothing listens at 127.0.0.1:4352")
        cable = self.cable = memory_link(PjLinkPeer(self.beamer))
        return cable

    def pull(self, pulled: bool = True) -> None:
        self.pulled = pulled
        if self.cable is not None:
            self.cable.close()

    def run(self, disturb: Callable[[], None]) -> None:
        def disturbing(step: object, accepted: bool) -> None:
            if self.lab.camera.captures == 2:
                disturb()

        projector = PjLinkProjector(self.connect, clock=self.clock)
        devices = Devices(self.lab.camera, self.lab.screen, projector, self.clock)
        assert take_session(self.lab.session, devices, SETTINGS, disturbing, self.said.append).complete

    @property
    def words(self) -> list[str]:
        return [sentence.split(":")[0] for sentence in self.said]


def test_a_pulled_cable_pauses_the_run_until_it_is_back(folder: Path) -> None:
    disturbed = Disturbed(folder)
    disturbed.clock.calls[PAUSE_S] = lambda: disturbed.pull(False)
    disturbed.run(disturbed.pull)
    assert disturbed.words == ["retry", "paused", "resumed"]
    assert "nothing listens at 127.0.0.1:4352" in disturbed.said[0]
    assert disturbed.lab.verdicts() == ["accepted"] * 6


def test_a_projector_that_lost_its_power_gets_its_minutes_again(folder: Path) -> None:
    disturbed = Disturbed(folder)

    def power_cut() -> None:
        disturbed.beamer = SimulatedProjector(disturbed.clock)
        disturbed.pull()
        disturbed.clock.calls[PAUSE_S] = power_back

    def power_back() -> None:
        disturbed.pull(False)
        disturbed.clock.calls[PAUSE_S] = disturbed.beamer.switch_on

    disturbed.run(power_cut)
    assert disturbed.words == ["retry", "paused", "still paused", "still paused", "warming up", "resumed"]
    assert disturbed.clock.monotonic() > SETTINGS.sequence.warm_up_s
    assert disturbed.lab.verdicts() == ["accepted"] * 6


def test_a_projector_long_out_of_reach_may_have_lost_its_power(folder: Path) -> None:
    disturbed = Disturbed(folder)

    def wait_on() -> None:
        if disturbed.clock.slept.count(PAUSE_S) * PAUSE_S > RELIGHT_S:
            disturbed.pull(False)
        else:
            disturbed.clock.calls[PAUSE_S] = wait_on

    disturbed.clock.calls[PAUSE_S] = wait_on
    disturbed.run(disturbed.pull)
    assert disturbed.words == ["retry", "paused", "warming up", "resumed"]


def test_a_lost_cable_ends_the_run_when_patience_does(folder: Path) -> None:
    disturbed = Disturbed(folder)
    with pytest.raises(LinkClosed, match=r"nothing listens at .*; the run waited 10 min 00 s for that and ended:"):
        disturbed.run(disturbed.pull)
    assert len(disturbed.lab.session.frames()) == 2
    disturbed.pull(False)
    disturbed.run(lambda: None)
    assert disturbed.lab.verdicts() == ["accepted"] * 6


def test_the_camera_is_spoken_to_while_the_lamp_warms_up(folder: Path) -> None:
    lab = Lab(folder)
    lab.projector = SimulatedProjector(lab.clock)
    spoken: list[float] = []

    class PatientCamera(ScriptedCamera):
        def idle(self) -> None:
            spoken.append(self.clock.monotonic())

    lab.camera = PatientCamera(lab.screen, lab.clock, {})
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert spoken[-1] >= SETTINGS.sequence.warm_up_s
    assert max(np.diff(spoken)) <= 10


def test_a_lab_without_lamp_control_works(folder: Path) -> None:
    lab = Lab(folder)
    devices = Devices(lab.camera, lab.screen, None, lab.clock)
    assert take_session(lab.session, devices, SETTINGS).complete
