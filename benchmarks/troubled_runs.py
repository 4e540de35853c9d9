"""Whole runs in which things go wrong, in the simulated lab: causes that come and go, and a night of twelve hours.

`python -m benchmarks.troubled_runs night [GRID [FOLDER]]` takes a night without an operator, builds its table, and
prints one JSON object a line (33 steps of grid are 597 lights); `python -m benchmarks.troubled_runs causes`, and
`benchmarks.detection`, print the table of causes. Everything is what `acquire run` uses; parts of the simulated lab
(clock, body, projector, cables) are held so that something can happen to them at a moment of the lab's time.

What is flattered: a disk is full where files are flushed and not where SQLite writes; time passes at once; somebody
changes the battery and empties the card in time, and a service manager starts the command again when power is back.
"""

from __future__ import annotations

import bisect
import errno
import json
import os
import re
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

from acquisition.cli import main as acquire
from acquisition.run import run as runs
from acquisition.run.devices import Devices, pause_cause
from acquisition.run.rig import simulated
from acquisition.run.rig.opening import open_rig
from acquisition.run.run import run_session
from benchmarks.session_kills import in_child
from drivers.links.link import Link, PeerLink
from drivers.links.usb import open_usb
from drivers.presenter import BLACK, Colour
from drivers.projector import Power
from drivers.ptp.protocol import Answer, NoAnswer, PtpRequest, Transport
from drivers.ptp.usb import UsbTransport
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.config import LabSettings, load_lab
from experiment.lights import plan_illuminations, save_illuminations
from experiment.session.folder import Session
from experiment.session.records import ACCEPTED, REFUSED, VOIDED
from foundation.clock import SIM_START, SimulatedClock, SteadyClock
from foundation.errors import CropError, LinkClosed, QualityError
from sim.buses.usb import PtpUsbDevice, SimulatedBus
from sim.camera.eos import SimulatedEos
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import Screen, SimulatedPresenter, SimulatedProjector

SETTINGS: Mapping[str, object] = {
    "reference_every": 10,
    "settle_s": 0.5,
    "warm_up_s": 60.0,
    "patience_s": 600.0,
    "relight": True,
    "refused_gb": 5.0,
    "notify": "true",
}
MINUTE_S, HOUR_S = 60.0, 3600.0
NIGHT_S = 12 * HOUR_S


class _Machine:
    """The machine's own clock, whose date somebody may set."""

    def __init__(self, time: SimulatedClock) -> None:
        self.time = time
        self.set_ahead_s = 0.0

    def now(self) -> datetime:
        return self.time.now() + timedelta(seconds=self.set_ahead_s)

    def monotonic(self) -> float:
        return self.time.monotonic()

    def sleep(self, seconds: float) -> None:
        self.time.sleep(seconds)


class EventfulClock(SteadyClock):
    """A session's clock, as a lab has it; what is due happens while it is waited."""

    def __init__(self, lab: TroubledLab, start: datetime) -> None:
        self.time = SimulatedClock(start)
        self.machine = _Machine(self.time)
        self._lab = lab
        self._before_s = (start - SIM_START).total_seconds()
        super().__init__(self.machine, None, self.time.monotonic)

    def lab_s(self) -> float:
        """Return seconds since the lab opened."""
        return self._before_s + self.time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let time pass; each event happens at its moment, once."""
        until_s = self.lab_s() + seconds
        due = self._lab.due
        while due and due[0][0] <= until_s:
            at_s, happens = due.pop(0)
            self.time.sleep(max(at_s - self.lab_s(), 0))
            happens()
        self.time.sleep(max(until_s - self.lab_s(), 0))


class _Presenter(SimulatedPresenter):
    """Shows the picture that was ordered before, while the lab says so."""

    def __init__(self, lab: TroubledLab, screen: Screen, clock: EventfulClock) -> None:
        super().__init__(screen, clock)
        self._lab, self._ordered = lab, BLACK

    def show(self, colour: Colour) -> None:
        self._lab.shows += 1
        if happens := self._lab.at_show.pop(self._lab.shows, None):
            happens()
        super().show(self._ordered if self._lab.is_late else colour)
        self._ordered = colour


class _Eos(SimulatedEos):
    """A body that says nothing, has no space left, or an empty battery, while the lab says so."""

    lab: ClassVar[TroubledLab]

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if self.lab.camera_hangs:
            self.lab.clock.sleep(20)
            raise NoAnswer
        return super().answer(request, data)

    def _available_shots(self) -> int:
        return 0 if self.lab.card_is_full else super()._available_shots()


class TroubledLab:
    """The simulated lab, and what goes wrong in it: call what begins and ends it, now, or when it is `due`.

    - `due`: what happens at moments, seconds since the lab opened; see `at`.
    - `at_show`: what happens when so many pictures were shown.
    - `told`: what somebody was notified of: lab seconds, event and message.
    """

    def __init__(self, *, after_power_cut: bool = False) -> None:
        self.due: list[tuple[float, Callable[[], object]]] = []
        self.at_show: dict[int, Callable[[], object]] = {}
        self.told: list[tuple[float, str, str]] = []
        self.shows = 0
        self.is_late = self.camera_hangs = self.card_is_full = self.disk_is_full = False
        self._camera_is_there = self._projector_is_there = True
        self._after_power_cut = after_power_cut
        self._bus: SimulatedBus | None = None
        self._device: PtpUsbDevice | None = None
        self._line: Link | None = None
        self.clock = EventfulClock(self, SIM_START)
        self.projector = SimulatedProjector(self.clock)
        self.eos: _Eos | None = None

    def at(self, lab_s: float, happens: Callable[[], object]) -> None:
        """Let something happen when the lab has been open for so long."""
        bisect.insort(self.due, (lab_s, happens), key=lambda event: event[0])

    def pull_camera(self, pulled: bool = True) -> None:
        """Pull the camera's cable, or put it back."""
        self._camera_is_there = not pulled
        if pulled and self._bus is not None and self._device is not None:
            self._bus.unplug(self._device)
            self._bus = None

    def restart_router(self, off: bool = True) -> None:
        """Let the projector be out of reach, or be back."""
        self._projector_is_there = not off
        if off and self._line is not None:
            self._line.close()

    def cut_power(self) -> None:
        """Let the power dip: the lamp goes out, and the camera is gone for twenty seconds."""
        self.projector = self._strike(Power.STANDBY)
        self.pull_camera()
        self.at(self.clock.lab_s() + 20, lambda: self.pull_camera(False))

    def _strike(self, power: Power) -> SimulatedProjector:
        self.projector._enter(power, self.clock.monotonic())
        return self.projector

    @contextmanager
    def opened(self, settings: LabSettings, chart: Chart, session: Session | None) -> Generator[Devices]:
        """Open the simulated lab with parts that this one holds."""

        def clock(start: datetime) -> EventfulClock:
            self.clock = EventfulClock(self, start)
            return self.clock

        def projector(clock: EventfulClock, power: Power) -> SimulatedProjector:
            self.projector = SimulatedProjector(clock, Power.STANDBY if self._after_power_cut else power)
            return self.projector

        def eos(*given: Any, **named: Any) -> _Eos:
            _Eos.lab = self
            self.eos = _Eos(*given, **named)
            return self.eos

        def presenter(screen: Screen, clock: EventfulClock) -> _Presenter:
            return _Presenter(self, screen, clock)

        replaced: dict[str, Any] = {
            "SimulatedClock": clock,
            "SimulatedProjector": projector,
            "SimulatedEos": eos,
            "SimulatedPresenter": presenter,
            "MemoryTransport": self._connect_camera,
            "PeerLink": self._connect_projector,
        }
        with patch.multiple(simulated, **replaced), open_rig(settings, chart, session) as devices:
            yield devices

    def _connect_camera(self, eos: SimulatedEos) -> Transport:
        if not self._camera_is_there:
            raise LinkClosed("no camera on USB; connect it and switch it on")
        self._device = PtpUsbDevice(eos)
        self._bus = SimulatedBus(self._device)
        return UsbTransport(open_usb(backend=self._bus), self.clock)

    def _connect_projector(self, peer: PjLinkPeer) -> Link:
        if not self._projector_is_there:
            raise LinkClosed("nothing listens at the projector's address")
        self._line = PeerLink(peer)
        return self._line

    def take(self, lab: Path, folder: Path) -> CropError | None:
        """Take the session as `acquire run` does; return what ended it, None where it is complete."""
        real = os.fsync

        def fsync(handle: int) -> None:
            if self.disk_is_full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(handle)

        told, seconds = self.told, self.clock_s

        class Recorded:
            def __init__(self, *_: object) -> None: ...

            def tell(self, event: str, message: str, at: datetime) -> None:
                told.append((seconds(), event, message))

            def say_failures(self) -> None: ...

            def close(self) -> None: ...

        replaced: dict[str, Any] = {"open_rig": self.opened, "Notices": Recorded}
        with patch.multiple(runs, **replaced), patch.object(os, "fsync", fsync):
            try:
                outcome = run_session(load_lab(lab), folder, lambda done, total: None)
            except CropError as error:
                return error
        return None if outcome.complete else QualityError("; ".join(outcome.refused))

    def clock_s(self) -> float:
        """Return seconds since the lab opened."""
        return self.clock.lab_s()

    def most_notices_an_hour(self) -> int:
        """Return how often somebody was told of a pause for one cause within an hour, at most."""
        times: dict[str, list[float]] = {}
        for at_s, event, message in self.told:
            if event == "paused":
                times.setdefault(pause_cause(message), []).append(at_s)
        return max((sum(0 <= b - a < HOUR_S for b in of) for of in times.values() for a in of), default=0)


def make_lab(folder: Path, grid: int, events: Sequence[str] = (), **changes: object) -> Path:
    """Write LAB.toml, a chart of 64 colours and lights; return the path of the first."""
    folder.mkdir(exist_ok=True)
    design_chart(bits=2, seed=3).save(folder / "chart.json")
    save_illuminations(plan_illuminations(grid, [3000, 6500]), folder / "illuminations.csv")
    sequence = "".join(f"{key} = {json.dumps(value)}\n" for key, value in {**SETTINGS, **changes}.items())
    path = folder / "LAB.toml"
    path.write_text(
        'rig = "simulated"\nchart = "chart.json"\nilluminations = "illuminations.csv"\n'
        f'[sequence]\n{sequence}[simulated]\nbody = "Test"\nseed = 11\nevents = [{", ".join(events)}]\n'
    )
    return path


@dataclass(frozen=True)
class Cause:
    """Something that goes wrong in a run, and what docs/how-to/night-run.md says becomes of that.

    - `begins`: called with the lab and the session's folder before the run.
    - `ends`: words of the error that ends the run; empty where it goes on.
    - `grid`, `events`, `changes`: of `make_lab`.
    - `process`: whether the run is a process of its own, which is stopped for a while.
    """

    name: str
    begins: Callable[[TroubledLab, Path], object] = lambda lab, folder: None
    ends: str = ""
    grid: int = 4
    events: tuple[str, ...] = ()
    changes: Mapping[str, object] = field(default_factory=dict[str, object])
    process: bool = False


def _each(
    lab: TroubledLab, period_s: float, begins: Callable[[], object], ends: Callable[[], object], s: float
) -> None:
    """Let a cause come and go all night: for `s` seconds of each period."""
    for number in range(1, round(2 * HOUR_S / period_s)):
        lab.at(number * period_s, begins)
        lab.at(number * period_s + s, ends)


def _opens(lab: TroubledLab, s: float) -> None:
    _each(lab, 2 * MINUTE_S, lab.pull_camera, lambda: lab.pull_camera(False), s)


def _hangs(lab: TroubledLab, s: float) -> None:
    def begin() -> None:
        lab.camera_hangs = True
        lab.at(lab.clock_s() + s, end)

    def end() -> None:
        lab.camera_hangs = False

    lab.at_show[12] = begin


def _is_late(lab: TroubledLab, first: int, last: int) -> None:
    def late(is_late: bool) -> None:
        lab.is_late = is_late

    lab.at_show[first], lab.at_show[last] = lambda: late(True), lambda: late(False)


def _overwrite(path: Path) -> None:
    with path.open("r+b") as stream:
        stream.write(bytes(path.stat().st_size))


def _journal(mishap: Callable[[Path], object]) -> Callable[[TroubledLab, Path], object]:
    def begins(lab: TroubledLab, folder: Path) -> None:
        lab.at_show[25] = lambda: mishap(folder / "journal.sqlite")

    return begins


def pop_up(frame: int) -> str:
    """Return an event of the simulated lab."""
    return f'{{ what = "pop-up", from_frame = {frame}, to_frame = {frame} }}'


LOST = "acquire rebuild"

CAUSES: tuple[Cause, ...] = (
    Cause("one frame late, from a frame on", lambda lab, _: _is_late(lab, 30, 10**9), "illuminant|first frames"),
    Cause("one frame late for eight frames", lambda lab, _: _is_late(lab, 30, 38)),
    Cause("a pop-up in every tenth frame", events=tuple(pop_up(frame) for frame in range(25, 400, 10))),
    Cause(
        "a pop-up in every second frame",
        ends="refused_gb",
        events=tuple(pop_up(frame) for frame in range(25, 400, 2)),
        changes={"refused_gb": 0.015, "attempts": 20},
    ),
    Cause("a cable that opens each second minute, thirty frames between", lambda lab, _: _opens(lab, 60), grid=8),
    Cause("the same, a frame or two between", lambda lab, _: _opens(lab, 114), "no camera"),
    Cause("a camera that hangs for four minutes", lambda lab, _: _hangs(lab, 240)),
    Cause("a camera that hangs for good", lambda lab, _: _hangs(lab, 10**6), "camera"),
    Cause("a process that is stopped for fifteen seconds", process=True),
    Cause("a journal that is deleted", _journal(Path.unlink), LOST),
    Cause("a journal that is overwritten", _journal(_overwrite), LOST),
    Cause("a journal that is cut to half", _journal(lambda path: os.truncate(path, path.stat().st_size // 2)), LOST),
)


@dataclass(frozen=True)
class Outcome:
    """What became of a cause: one row of the table; `as_said`: whether that is what the how-to says."""

    cause: Cause
    ended: str
    frames: int
    refused: int
    refused_mb: float
    pauses: int
    resumed: int
    notices: int
    minutes: float
    as_said: bool

    def line(self) -> str:
        """Return a row of Markdown."""
        return (
            f"| {self.cause.name} | {self.ended} | {self.frames} | {self.refused} | {self.refused_mb:.0f} | "
            f"{self.pauses} | {self.resumed} | {self.notices} | {self.minutes:.0f} | "
            f"{'yes' if self.as_said else 'NO'} |"
        )


HEAD = (
    "| cause | the run | accepted | refused | MB of them | paused | resumed | notices a cause and hour | minutes "
    "| as said |"
    "\n|---|---|---|---|---|---|---|---|---|---|"
)


def outcome_of(cause: Cause, scratch: Path) -> Outcome:
    """Take a session under a cause; where that ended the run, let the same command end it when the cause is gone."""
    path = make_lab(scratch, cause.grid, cause.events, **cause.changes)
    folder, lab = scratch / "session", TroubledLab()
    cause.begins(lab, folder)
    error = _stopped_for_a_while(path, folder) if cause.process else lab.take(path, folder)
    lost = error is not None and LOST in str(error)
    if lost:
        assert acquire(["rebuild", str(folder)]) == 0
    with Session.open(folder) as session:
        attempts, events = session.journal.attempts(), session.journal.events()
        unused, accepted = session.journal.unused_bytes(0), session.journal.accepted_files()
    if error is not None:
        print(f"{cause.name}: {error}", file=sys.stderr)
    words = [event.what for event in events]
    verdicts = [attempt.verdict for attempt in attempts]
    # The frames under way when it is spent are there all the same.
    budget = load_lab(path).sequence.refused_gb * 1e9 + 2 * max(frame.size for frame in accepted)
    as_said = unused <= budget and lab.most_notices_an_hour() <= 1
    as_said &= len({frame.step for frame in accepted}) == len(accepted)
    as_said &= (error is None) if not cause.ends else error is not None and bool(re.search(cause.ends, str(error)))
    as_said &= not cause.process or words.count("gap") == 1
    if error is not None:
        make_lab(scratch, cause.grid)
        again = TroubledLab().take(path, folder)
        if again is not None:
            print(f"{cause.name}, again: {again}", file=sys.stderr)
        as_said &= again is None
        with Session.open(folder) as session:
            done = [attempt.step for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
            as_said &= sorted(done) == [step.number for step in session.steps]
    return Outcome(
        cause,
        "goes on" if error is None else f"ends ({type(error).__name__})",
        verdicts.count(ACCEPTED),
        verdicts.count(REFUSED) + verdicts.count(VOIDED),
        unused / 1e6,
        words.count("paused"),
        words.count("resumed"),
        lab.most_notices_an_hour(),
        lab.clock_s() / MINUTE_S,
        as_said,
    )


def _stopped_for_a_while(path: Path, folder: Path) -> None:
    """Take a session in a process of its own, which is stopped (SIGSTOP) at its twelfth frame for fifteen seconds."""
    pids: list[int] = []

    def stop() -> None:
        while not folder.is_dir() or sum(1 for _ in (folder / "frames").glob("0*")) < 12:
            time.sleep(0.05)
        os.kill(pids[0], signal.SIGSTOP)
        time.sleep(15)
        os.kill(pids[0], signal.SIGCONT)

    def work() -> None:
        assert TroubledLab().take(path, folder) is None

    told = path.with_name("pid")
    thread = threading.Thread(target=lambda: (pids.append(_awaited(told)), stop()))
    thread.start()
    assert in_child(lambda: (told.write_text(str(os.getpid())), work())) == 0
    thread.join()


def _awaited(told: Path) -> int:
    while not (told.is_file() and told.read_text()):
        time.sleep(0.01)
    return int(told.read_text())


def causes(only: str = "") -> bool:
    """Print the table of causes; return whether each ended or went on as the how-to says."""
    print(HEAD)
    as_said = True
    for cause in CAUSES:
        if only in cause.name:
            with tempfile.TemporaryDirectory() as scratch:
                outcome = outcome_of(cause, Path(scratch))
            print(outcome.line(), flush=True)
            as_said &= outcome.as_said
    return as_said


# What the journal, and so the report, is to tell of a night: by what happened, an event and words of its sentence.
STORY: Mapping[str, tuple[str, str]] = {
    "router": ("paused", "projector.*(nothing listens|out of reach)"),
    "first power dip": ("relit", "standby"),
    "clock": ("clock", "set ahead by 1 h"),
    "disk": ("paused", "the disk: .*No space left"),
    "card": ("retry", "the camera: .*its card is full"),
    "battery": ("retry", "the camera: .*battery"),
    "second power dip": ("killed", "power was lost"),
    "lamp lit again": ("warming up", ""),
}


@dataclass(frozen=True)
class Night:
    """How a night went: what the story lacks, how many frames, how long, and which table came of it."""

    untold: tuple[str, ...]
    frames: int
    doubled: int
    hours: float
    pauses: int


def night(scratch: Path, grid: int, night_s: float = NIGHT_S) -> Night:
    """Take a session that lasts a night in which power dips twice and much else happens; nobody comes."""
    lights = len(plan_illuminations(grid, [3000, 6500]))
    frames = 21 + lights + 2 * (lights // 10 + 2)
    path = make_lab(scratch, grid, settle_s=max(night_s / frames - 2, 0.5), patience_s=HOUR_S, warm_up_s=20 * MINUTE_S)
    folder = scratch / "session"

    def before_the_second_cut() -> None:
        lab = TroubledLab()
        _happen(lab, night_s, 1.2 * night_s / frames)
        lab.at(night_s * 10 / 12, lambda: os.kill(os.getpid(), signal.SIGKILL))
        lab.take(path, folder)

    assert in_child(before_the_second_cut) == -signal.SIGKILL
    lab = TroubledLab(after_power_cut=True)
    error = lab.take(path, folder)
    assert error is None, error
    with Session.open(folder) as session:
        events, attempts = session.journal.events(), session.journal.attempts()
        assert not session.lost_files()
        steps = [step.number for step in session.steps]
    done = [attempt.step for attempt in attempts if attempt.verdict == ACCEPTED]
    assert sorted(set(done)) == steps
    untold = tuple(
        what
        for what, (word, said) in STORY.items()
        if not any(event.what == word and re.search(said, event.detail, re.IGNORECASE) for event in events)
    )
    hours = (attempts[-1].started_at - SIM_START).total_seconds() / HOUR_S
    times = [attempt.started_at for attempt in attempts]
    assert times == sorted(times), "time never goes back"
    return Night(untold, len(attempts), len(done) - len(set(done)), hours, [e.what for e in events].count("paused"))


def _happen(lab: TroubledLab, night_s: float, least_s: float) -> None:
    """Let a night's events fall due, at shares of it; each lasts for `least_s` at least, so that a frame meets it."""

    def switch(name: str, value: object) -> Callable[[], None]:
        return lambda: setattr(lab, name, value)

    def set_clock() -> None:
        lab.clock.machine.set_ahead_s = HOUR_S

    def battery(charge: float) -> Callable[[], None]:
        def change() -> None:
            assert lab.eos is not None
            lab.eos._battery = charge

        return change

    hour_s = night_s / 12
    lab.at(1 * hour_s, lab.restart_router)
    lab.at(1 * hour_s + max(90, least_s), lambda: lab.restart_router(False))
    lab.at(2.5 * hour_s, lab.cut_power)
    lab.at(4 * hour_s, set_clock)
    lab.at(5 * hour_s, switch("disk_is_full", True))
    lab.at(5 * hour_s + 25 * MINUTE_S, switch("disk_is_full", False))
    lab.at(6.5 * hour_s, switch("card_is_full", True))
    lab.at(6.5 * hour_s + max(20 * MINUTE_S, least_s), switch("card_is_full", False))
    lab.at(8 * hour_s, battery(0.0))
    changed_s = 8 * hour_s + max(15 * MINUTE_S, least_s)
    lab.at(changed_s, lab.pull_camera)
    lab.at(changed_s + MINUTE_S, battery(1.0))
    lab.at(changed_s + MINUTE_S + 1, lambda: lab.pull_camera(False))


def main(argv: list[str]) -> int:
    """Print the table of causes, or what came of a night."""
    if argv[:1] != ["night"]:
        return int(not causes(argv[1] if argv[1:] else ""))
    from calibration.cli import main as build_lut

    grid = int(argv[1]) if argv[1:] else 33
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(argv[2]) if argv[2:] else Path(scratch) / "night"
        begun = time.perf_counter()
        found = night(folder, grid)
        taken_s = time.perf_counter() - begun
        code = build_lut([str(folder / "session"), str(folder / "lut")])
    for name, value, unit in (
        ("night: hours of the lab's time", round(found.hours, 2), "h"),
        ("night: attempts", found.frames, "frames"),
        ("night: steps with two accepted frames", found.doubled, "frames"),
        ("night: pauses", found.pauses, "pauses"),
        ("night: events that the story lacks", len(found.untold), f"of {len(STORY)} {' '.join(found.untold)}".strip()),
        ("night: exit code of build-lut", code, ""),
        ("night: time", round(taken_s, 1), "s"),
    ):
        print(json.dumps({"name": name, "value": value, "unit": unit, "against": ""}), flush=True)
    return int(bool(found.untold) or code != 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
