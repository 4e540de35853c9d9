"""Sessions with several random faults of camera, cable, screen, projector and disk.

The camera's files contain the colour on the screen and the number of earlier exposures, so that a lost, confused or
doubly counted frame is detected.
"""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO
from unittest.mock import patch

from acquisition.run.devices import Devices
from acquisition.run.run import RunOutcome, take_session
from drivers.camera import ExposureSettings
from drivers.canon import CanonEos
from drivers.links.usb import Pipe, UsbPipes, open_usb
from drivers.presenter import BLACK, Colour
from drivers.projector import Severity
from drivers.ptp.codes import ResponseCode
from drivers.ptp.protocol import Responder, Transport
from drivers.ptp.usb import UsbTransport
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.journal import Journal
from experiment.session.records import Judgement, SessionStep, plan_steps
from foundation.clock import SimulatedClock
from foundation.errors import CropError, DeviceError, StorageError
from sim.buses.usb import PtpUsbDevice, SimulatedBus
from sim.camera.bodies import EOS_550D
from sim.camera.eos import SimulatedEos
from tests import cable_faults as faults
from tests.acquisition.run.scripted import Beamer
from tests.cable_faults import Occasion

LIGHTS = tuple(Illuminant(n, "uniform", None, Colour(255, 12 * n, 255 - n)) for n in range(20))
SETTINGS = LabSettings.model_validate(
    {
        "rig": "simulated",
        "chart": "chart.json",
        "illuminations": "lights.csv",
        "sequence": {"reference_every": 5, "warm_up_s": 30, "patience_s": 300},
    }
)
OPERATIONS = 1200  # Approximate number of operations on the camera's cable in an undisturbed session


class ColourFilm:
    """Files that name the colour on the screen and the number of the exposure."""

    suffix = ".cr2"

    def __init__(self, look: Callable[[], Colour]) -> None:
        self.look = look
        self.exposures = 0

    def accept(self, settings: ExposureSettings) -> None:
        """Accept every exposure."""

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        self.exposures += 1
        return into.write(f"{self.look()} exposure {self.exposures} ".encode() + bytes(3000))


class ContentJudge:
    """Accepts files that show the colour of their step."""

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        shown = file.read_bytes().startswith(f"{step.colour} ".encode())
        return Judgement.of_reason("light", None if shown else "another light was on the screen")

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Remember nothing."""


class EventfulClock(SimulatedClock):
    """Simulated time with events at given times."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[tuple[float, Callable[[], object]]] = []

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        due = [event for event in self.events if event[0] <= self.monotonic()]
        self.events = [event for event in self.events if event not in due]
        for _, happens in due:
            happens()


class Screen:
    """A presenter that fails, is covered, or is frozen at the calls with given numbers."""

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock = clock
        self.colour = BLACK
        self.shows = self.looks = -1
        self.fails: set[int] = set()
        self.covered: set[int] = set()
        self.stuck: set[int] = set()

    def show(self, colour: Colour) -> None:
        self.shows += 1
        self.clock.sleep(1 / 60)
        if self.shows in self.fails:
            raise DeviceError("the window does not fill the display")
        if self.shows not in self.stuck:
            self.colour = colour

    def verify(self, colour: Colour) -> None:
        self.looks += 1
        if self.looks in self.covered:
            raise DeviceError("a pop-up covers the picture")

    def close(self) -> None:
        self.colour = BLACK


class TroubledLab:
    """Simulated devices in memory, with random faults."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.clock = EventfulClock()
        self.screen = Screen(self.clock)
        self.film = ColourFilm(lambda: self.screen.colour)
        self.eos = SimulatedEos(EOS_550D, self.film, self.clock, auto_power_off_s=0)
        self.device: Responder = self.eos
        self.beamer = Beamer(self.clock)
        self.openings = 0
        self.pipes: dict[int, Callable[[UsbPipes], UsbPipes]] = {}
        self.cables: dict[int, Callable[[Transport], Transport]] = {}
        self.breaks: list[AbstractContextManager[Any]] = []
        self.mishaps: list[str] = []
        for _ in range(self.chance.randint(2, 6)):
            mishap = self.chance.choice(MISHAPS)
            self.mishaps.append(mishap.__name__)
            mishap(self)

    def open(self) -> Transport:
        number, self.openings = self.openings, self.openings + 1
        pipes = self.pipes.get(number, lambda good: good)(open_usb(backend=SimulatedBus(PtpUsbDevice(self.device))))  # pyrefly: ignore[implicit-any-lambda]
        return self.cables.get(number, lambda good: good)(UsbTransport(pipes, self.clock))  # pyrefly: ignore[implicit-any-lambda]

    def take(self, session: Session) -> RunOutcome | CropError:
        """Take the session until it ends; return how it ended."""
        camera = CanonEos(self.open, self.clock)
        devices = Devices(camera, self.screen, self.beamer.projector, self.clock)
        try:
            with ExitStack() as broken:
                for one in self.breaks:
                    broken.enter_context(one)
                return take_session(session, devices, SETTINGS, ContentJudge())
        except CropError as error:
            return error

    def calm_down(self) -> None:
        """Stop all faults, as after switching the camera off and on."""
        self.eos = SimulatedEos(EOS_550D, self.film, self.clock, auto_power_off_s=0)
        self.device, self.pipes, self.cables, self.breaks = self.eos, {}, {}, []
        self.screen.fails, self.screen.covered, self.screen.stuck = set(), set(), set()
        self.clock.events = []
        self.beamer = Beamer(self.clock)

    def occasion(self) -> Occasion:
        return Occasion(after=self.chance.randrange(OPERATIONS))

    def moment(self) -> float:
        return self.chance.uniform(1, 70)


def busy(lab: TroubledLab) -> None:
    codes = (ResponseCode.DEVICE_BUSY, ResponseCode.GENERAL_ERROR, ResponseCode.INVALID_PARAMETER)
    lab.device = faults.Declining(lab.device, lab.chance.choice(codes), lab.occasion())


def hangs(lab: TroubledLab) -> None:
    lab.device = faults.Hanging(lab.device, lab.occasion(), obeys=lab.chance.random() < 0.5)


def falsifies(lab: TroubledLab) -> None:
    keep, more = lab.chance.choice(((slice(-1), b""), (slice(None), b"more"), (slice(0), b"")))
    lab.device = faults.Falsifying(lab.device, lambda data: data[keep] + more, lab.occasion())


def restarts(lab: TroubledLab) -> None:
    lab.device = faults.Interrupting(lab.device, lab.eos.unplugged, lab.occasion())


def delays_events(lab: TroubledLab) -> None:
    lab.device = faults.DelayingEvents(lab.device, lab.chance.randint(1, 4))


def repeats_events(lab: TroubledLab) -> None:
    lab.device = faults.ChangingEvents(lab.device, lambda events: events * 2)


def loses_events(lab: TroubledLab) -> None:
    lab.device = faults.ChangingEvents(lab.device, lambda events: ())


def stalls(lab: TroubledLab) -> None:
    transfers, pipe = {lab.chance.randrange(OPERATIONS)}, lab.chance.choice((Pipe.BULK_IN, Pipe.BULK_OUT))
    lab.pipes[0] = lambda good: faults.Stalling(good, pipe, transfers)


def breaks_off(lab: TroubledLab) -> None:
    after = lab.chance.randrange(150_000)
    lab.pipes[0] = lambda good: faults.CutOff(good, after)


def goes_deaf(lab: TroubledLab) -> None:
    reads = lab.chance.randrange(OPERATIONS)
    lab.pipes[lab.chance.randrange(2)] = lambda good: faults.Deaf(good, reads)


def garbles(lab: TroubledLab) -> None:
    left = [lab.chance.randrange(OPERATIONS)]

    def change(data: bytes) -> bytes:
        left[0] -= 1
        return bytes(byte ^ 0x55 for byte in data) if left[0] == -1 else data

    lab.pipes[0] = lambda good: faults.Garbling(good, change)


def reads_short(lab: TroubledLab) -> None:
    lab.pipes[0] = faults.ShortReads


def sends_heads_alone(lab: TroubledLab) -> None:
    lab.pipes[0] = faults.HeaderAlone


def loses_a_response(lab: TroubledLab) -> None:
    occasion = lab.occasion()
    lab.cables[0] = lambda good: faults.LosingResponses(good, occasion)


def is_pulled(lab: TroubledLab) -> None:
    occasion = lab.occasion()
    lab.cables[0] = lambda good: faults.PulledOut(good, occasion)


def does_not_show(lab: TroubledLab) -> None:
    lab.screen.fails |= {lab.chance.randrange(28) + n for n in range(lab.chance.choice((1, 4)))}


def is_covered(lab: TroubledLab) -> None:
    lab.screen.covered.add(lab.chance.randrange(28))


def sticks(lab: TroubledLab) -> None:
    lab.screen.stuck.add(lab.chance.randrange(28))


def is_muted(lab: TroubledLab) -> None:
    begins = lab.moment()
    lab.clock.events.append((begins, lambda: lab.beamer.device.set_muted(True)))
    lab.clock.events.append((begins + lab.chance.uniform(1, 40), lambda: lab.beamer.device.set_muted(False)))


def lamp_fails(lab: TroubledLab) -> None:
    begins = lab.moment()
    lab.clock.events.append((begins, lambda: lab.beamer.device.break_part("lamp", Severity.ERROR)))
    lab.clock.events.append((begins + lab.chance.uniform(1, 60), lab.beamer.device.repair))


def beamer_is_unplugged(lab: TroubledLab) -> None:
    begins = lab.moment()
    lab.clock.events.append((begins, lambda: lab.beamer.pull(True)))
    lab.clock.events.append((begins + lab.chance.uniform(1, 40), lambda: lab.beamer.pull(False)))


def disk_is_full(lab: TroubledLab) -> None:
    number = lab.chance.choice((errno.ENOSPC, errno.EIO, errno.EDQUOT))
    once(lab, os, "fsync", lab.chance.randrange(60), OSError(number, os.strerror(number)))


def journal_fails(lab: TroubledLab) -> None:
    name = lab.chance.choice(("begin", "commit", "fail", "note", "beat"))
    error = StorageError("cannot write journal.sqlite: disk I/O error")
    once(lab, Journal, name, lab.chance.randrange(1, 24), error)


def once(lab: TroubledLab, owner: Any, name: str, call: int, error: Exception) -> None:
    """Let one call fail, by its number, before it does anything."""
    real, calls = getattr(owner, name), [0]

    def failing(*given: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] - 1 == call:
            raise error
        return real(*given, **named)

    lab.breaks.append(patch.object(owner, name, failing))


MISHAPS: tuple[Callable[[TroubledLab], None], ...] = (
    *(busy, hangs, falsifies, restarts, delays_events, repeats_events, loses_events),
    *(stalls, breaks_off, goes_deaf, garbles, reads_short, sends_heads_alone, loses_a_response, is_pulled),
    *(does_not_show, is_covered, sticks, is_muted, lamp_fails, beamer_is_unplugged, disk_is_full, journal_fails),
)


def take_all(folder: Path, seed: int) -> bool:
    """Take a session with faults, then the missing frames; return whether the first run was complete."""
    lab = TroubledLab(seed)
    with new_session(folder) as session:
        ended = lab.take(session)
        complete = isinstance(ended, RunOutcome) and ended.complete
        if not complete:
            cause = "; ".join(ended.refused) if isinstance(ended, RunOutcome) else str(ended)
            assert cause, f"{lab.mishaps}: the cause has a name"
        kept = {frame.sha256 for frame in session.frames() if frame.accepted}
    lab.calm_down()
    with Session.open_for_run(folder) as session:
        outcome = lab.take(session)
        assert isinstance(outcome, RunOutcome), f"{lab.mishaps}: {outcome}"
        assert outcome.complete
        require_whole(session)
        assert kept <= {frame.sha256 for frame in session.frames()}, "nothing that was accepted is gone"
    return complete


def new_session(folder: Path) -> Session:
    """Make a session of 20 illuminants."""
    return Session.create(folder, SETTINGS.to_toml(), design_chart(bits=1), LIGHTS, plan_steps(LIGHTS, 5))


def require_whole(session: Session) -> None:
    """Require that every step has one accepted frame, of its own illuminant, and that no exposure counts twice."""
    colours = {step.number: step.colour for step in session.steps}
    accepted = session.journal.accepted_files()
    assert sorted(frame.step for frame in accepted) == sorted(colours), "each step once"
    contents = [(session.folder / frame.file).read_bytes() for frame in accepted]
    for frame, content in zip(accepted, contents, strict=True):
        assert content.startswith(f"{colours[frame.step]} ".encode())
        assert len(content) == frame.size
    assert len(set(contents)) == len(contents), "no exposure twice"
    assert not session.verify()
