"""Whole runs with faults in the simulated laboratory: intermittent causes, and a night of twelve hours.

`python -m benchmarks.troubled_runs night [GRID [FOLDER]]` takes a night without an operator, builds its LUT and prints
one JSON object per line (a grid of 33 steps has 597 illuminants). `python -m benchmarks.troubled_runs causes` and
`benchmarks.detection` print the table of causes. The code of `acquire run` is used. Clock, body, projector and cables
of the simulated laboratory are replaced, so that faults can happen at given times.

Simplifications: a full disk affects flushing, but not SQLite. Waiting takes no real time. Somebody changes the battery
and empties the card in time. A service manager restarts the command after a power cut.
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
from experiment.lights import plan_illuminants, save_illuminants
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
    """The clock of the machine, whose date can be set."""

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
    """Clock of a session; events that are due happen while it sleeps."""

    def __init__(self, lab: TroubledLab, start: datetime) -> None:
        self.time = SimulatedClock(start)
        self.machine = _Machine(self.time)
        self._lab = lab
        self._before_s = (start - SIM_START).total_seconds()
        super().__init__(self.machine, None, self.time.monotonic)

    def lab_s(self) -> float:
        """Return seconds since the start of the lab."""
        return self._before_s + self.time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let time pass; each event happens once, at its time."""
        end_s = self.lab_s() + seconds
        due = self._lab.due
        while due and due[0][0] <= end_s:
            event_s, event = due.pop(0)
            self.time.sleep(max(event_s - self.lab_s(), 0))
            event()
        self.time.sleep(max(end_s - self.lab_s(), 0))


class _Presenter(SimulatedPresenter):
    """A presenter that shows the previously ordered colour while `lab.is_late`."""

    def __init__(self, lab: TroubledLab, screen: Screen, clock: EventfulClock) -> None:
        super().__init__(screen, clock)
        self._lab, self._ordered = lab, BLACK

    def show(self, colour: Colour) -> None:
        self._lab.shows += 1
        if event := self._lab.at_show.pop(self._lab.shows, None):
            event()
        super().show(self._ordered if self._lab.is_late else colour)
        self._ordered = colour


class _Eos(SimulatedEos):
    """A camera body that hangs, or has a full card, while the lab demands it."""

    lab: ClassVar[TroubledLab]

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if self.lab.camera_hangs:
            self.lab.clock.sleep(20)
            raise NoAnswer
        return super().answer(request, data)

    def _available_shots(self) -> int:
        return 0 if self.lab.card_is_full else super()._available_shots()


class TroubledLab:
    """The simulated laboratory with methods that start and end faults, now or at a given time.

    `due` holds events by lab time (see `at`), `at_show` by the number of shown colours. `notices` holds the notices:
    lab time, event, message.
    """

    def __init__(self, *, after_power_cut: bool = False) -> None:
        self.due: list[tuple[float, Callable[[], object]]] = []
        self.at_show: dict[int, Callable[[], object]] = {}
        self.notices: list[tuple[float, str, str]] = []
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

    def at(self, lab_s: float, action: Callable[[], object]) -> None:
        """Schedule an event at a lab time."""
        bisect.insort(self.due, (lab_s, action), key=lambda event: event[0])

    def pull_camera(self, pulled: bool = True) -> None:
        """Disconnect or reconnect the cable of the camera."""
        self._camera_is_there = not pulled
        if pulled and self._bus is not None and self._device is not None:
            self._bus.unplug(self._device)
            self._bus = None

    def restart_router(self, off: bool = True) -> None:
        """Make the projector unreachable, or reachable again."""
        self._projector_is_there = not off
        if off and self._line is not None:
            self._line.close()

    def cut_power(self) -> None:
        """Interrupt the power: the lamp goes out, and the camera is missing for twenty seconds."""
        self.projector = self._strike(Power.STANDBY)
        self.pull_camera()
        self.at(self.clock.lab_s() + 20, lambda: self.pull_camera(False))

    def _strike(self, power: Power) -> SimulatedProjector:
        self.projector._enter(power, self.clock.monotonic())
        return self.projector

    @contextmanager
    def opened(self, settings: LabSettings, chart: Chart, session: Session | None) -> Generator[Devices]:
        """Open the simulated laboratory with the parts of this one."""

        def clock(start: datetime) -> EventfulClock:
            self.clock = EventfulClock(self, start)
            return self.clock

        def projector(clock: EventfulClock, power: Power) -> SimulatedProjector:
            self.projector = SimulatedProjector(clock, Power.STANDBY if self._after_power_cut else power)
            return self.projector

        def eos(*arguments: Any, **options: Any) -> _Eos:
            _Eos.lab = self
            self.eos = _Eos(*arguments, **options)
            return self.eos

        def presenter(screen: Screen, clock: EventfulClock) -> _Presenter:
            return _Presenter(self, screen, clock)

        replacements: dict[str, Any] = {
            "SimulatedClock": clock,
            "SimulatedProjector": projector,
            "SimulatedEos": eos,
            "SimulatedPresenter": presenter,
            "MemoryTransport": self._connect_camera,
            "PeerLink": self._connect_projector,
        }
        with patch.multiple(simulated, **replacements), open_rig(settings, chart, session) as devices:
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
        """Take the session as `acquire run` does; return the error that ended it, or None if it is complete."""
        fsync_file = os.fsync

        def fsync(handle: int) -> None:
            if self.disk_is_full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            fsync_file(handle)

        notices, seconds = self.notices, self.clock_s

        class Recorded:
            def __init__(self, *_: object) -> None: ...

            def send(self, event: str, message: str, at: datetime) -> None:
                notices.append((seconds(), event, message))

            def report_failures(self) -> None: ...

            def close(self) -> None: ...

        replacements: dict[str, Any] = {"open_rig": self.opened, "Notices": Recorded}
        with patch.multiple(runs, **replacements), patch.object(os, "fsync", fsync):
            try:
                outcome = run_session(load_lab(lab), folder, lambda count, total: None)
            except CropError as error:
                return error
        return None if outcome.complete else QualityError("; ".join(outcome.refused))

    def clock_s(self) -> float:
        """Return seconds since the start of the lab."""
        return self.clock.lab_s()

    def most_notices_an_hour(self) -> int:
        """Return the largest number of pause notices for one cause within an hour."""
        times: dict[str, list[float]] = {}
        for time_s, event, message in self.notices:
            if event == "paused":
                times.setdefault(pause_cause(message), []).append(time_s)
        return max((sum(0 <= b - a < HOUR_S for b in of) for of in times.values() for a in of), default=0)


def make_lab(folder: Path, grid: int, events: Sequence[str] = (), **changes: object) -> Path:
    """Write LAB.toml, a chart of 64 colours and the illuminants; return the path of LAB.toml."""
    folder.mkdir(exist_ok=True)
    design_chart(bits=2, seed=3).save(folder / "chart.json")
    save_illuminants(plan_illuminants(grid, [3000, 6500]), folder / "illuminations.csv")
    sequence = "".join(f"{key} = {json.dumps(value)}\n" for key, value in {**SETTINGS, **changes}.items())
    path = folder / "LAB.toml"
    path.write_text(
        'rig = "simulated"\nchart = "chart.json"\nilluminations = "illuminations.csv"\n'
        f'[sequence]\n{sequence}[simulated]\nbody = "Test"\nseed = 11\nevents = [{", ".join(events)}]\n'
    )
    return path


@dataclass(frozen=True)
class Cause:
    """A fault during a run and its documented effect (docs/how-to/events.md)."""

    name: str
    # called with the lab and the session folder
    begins: Callable[[TroubledLab, Path], object] = lambda lab, folder: None
    ends: str = ""  # pattern of the error that ends the run; empty if it goes on
    grid: int = 4
    events: tuple[str, ...] = ()
    changes: Mapping[str, object] = field(default_factory=dict[str, object])
    process: bool = False  # the run is a separate process, which is stopped for a while


def _each(
    lab: TroubledLab, period_s: float, begins: Callable[[], object], ends: Callable[[], object], s: float
) -> None:
    """Let a fault occur for `s` seconds of each period."""
    for number in range(1, round(2 * HOUR_S / period_s)):
        lab.at(number * period_s, begins)
        lab.at(number * period_s + s, ends)


def _open_cable(lab: TroubledLab, s: float) -> None:
    _each(lab, 2 * MINUTE_S, lab.pull_camera, lambda: lab.pull_camera(False), s)


def _hang_camera(lab: TroubledLab, s: float) -> None:
    def begin() -> None:
        lab.camera_hangs = True
        lab.at(lab.clock_s() + s, end)

    def end() -> None:
        lab.camera_hangs = False

    lab.at_show[12] = begin


def _delay_picture(lab: TroubledLab, first: int, last: int) -> None:
    def late(is_late: bool) -> None:
        lab.is_late = is_late

    lab.at_show[first], lab.at_show[last] = lambda: late(True), lambda: late(False)


def _overwrite(path: Path) -> None:
    with path.open("r+b") as stream:
        stream.write(bytes(path.stat().st_size))


def _damage_journal(mishap: Callable[[Path], object]) -> Callable[[TroubledLab, Path], object]:
    def begins(lab: TroubledLab, folder: Path) -> None:
        lab.at_show[25] = lambda: mishap(folder / "journal.sqlite")

    return begins


def pop_up(frame: int) -> str:
    """Return a pop-up event of the simulated laboratory, as TOML."""
    return f'{{ what = "pop-up", from_frame = {frame}, to_frame = {frame} }}'


LOST = "acquire rebuild"

CAUSES: tuple[Cause, ...] = (
    Cause("one frame late, from a frame on", lambda lab, _: _delay_picture(lab, 30, 10**9), "illuminant|first frames"),
    Cause("one frame late for eight frames", lambda lab, _: _delay_picture(lab, 30, 38)),
    Cause("a pop-up in every tenth frame", events=tuple(pop_up(frame) for frame in range(25, 400, 10))),
    Cause(
        "a pop-up in every second frame",
        ends="refused_gb",
        events=tuple(pop_up(frame) for frame in range(25, 400, 2)),
        changes={"refused_gb": 0.015, "attempts": 20},
    ),
    Cause("a cable that opens every two minutes, after thirty frames", lambda lab, _: _open_cable(lab, 60), grid=8),
    Cause("the same, after one or two frames", lambda lab, _: _open_cable(lab, 114), "no camera"),
    Cause("a camera that hangs for four minutes", lambda lab, _: _hang_camera(lab, 240)),
    Cause("a camera that hangs for good", lambda lab, _: _hang_camera(lab, 10**6), "camera"),
    Cause("a process that is stopped for fifteen seconds", process=True),
    Cause("a journal that is deleted", _damage_journal(Path.unlink), LOST),
    Cause("a journal that is overwritten", _damage_journal(_overwrite), LOST),
    Cause("a journal cut to half", _damage_journal(lambda path: os.truncate(path, path.stat().st_size // 2)), LOST),
)


@dataclass(frozen=True)
class Outcome:
    """Result of one cause: a row of the table. `is_as_documented`: the effect is as in the how-to."""

    cause: Cause
    ended: str
    frames: int
    refused: int
    refused_mb: float
    pauses: int
    resumed: int
    notices: int
    minutes: float
    as_documented: bool

    def line(self) -> str:
        """Return a Markdown row."""
        return (
            f"| {self.cause.name} | {self.ended} | {self.frames} | {self.refused} | {self.refused_mb:.0f} | "
            f"{self.pauses} | {self.resumed} | {self.notices} | {self.minutes:.0f} | "
            f"{'yes' if self.as_documented else 'NO'} |"
        )


HEAD = (
    "| cause | run | accepted | refused | refused MB | paused | resumed | notices per cause and hour | minutes "
    "| as documented |"
    "\n|---|---|---|---|---|---|---|---|---|---|"
)


def outcome_of(cause: Cause, scratch: Path) -> Outcome:
    """Take a session under a cause; if that ended the run, complete it with the same command without the cause."""
    path = make_lab(scratch, cause.grid, cause.events, **cause.changes)
    folder, lab = scratch / "session", TroubledLab()
    cause.begins(lab, folder)
    error = _take_with_stop(path, folder) if cause.process else lab.take(path, folder)
    is_journal_lost = error is not None and LOST in str(error)
    if is_journal_lost:
        assert acquire(["rebuild", str(folder)]) == 0
    with Session.open(folder) as session:
        attempts, events = session.journal.attempts(), session.journal.events()
        unused, accepted = session.journal.unused_bytes(0), session.journal.accepted_files()
    if error is not None:
        print(f"{cause.name}: {error}", file=sys.stderr)
    event_names = [event.what for event in events]
    verdicts = [attempt.verdict for attempt in attempts]
    # Frames in progress when the budget is exceeded are still saved.
    budget = load_lab(path).sequence.refused_gb * 1e9 + 2 * max(frame.size for frame in accepted)
    is_right = unused <= budget and lab.most_notices_an_hour() <= 1
    is_right &= len({frame.step for frame in accepted}) == len(accepted)
    is_right &= (error is None) if not cause.ends else error is not None and bool(re.search(cause.ends, str(error)))
    is_right &= not cause.process or event_names.count("gap") == 1
    if error is not None:
        make_lab(scratch, cause.grid)
        repeat_error = TroubledLab().take(path, folder)
        if repeat_error is not None:
            print(f"{cause.name}, again: {repeat_error}", file=sys.stderr)
        is_right &= repeat_error is None
        with Session.open(folder) as session:
            accepted_steps = [attempt.step for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
            is_right &= sorted(accepted_steps) == [step.number for step in session.steps]
    return Outcome(
        cause,
        "continues" if error is None else f"ends ({type(error).__name__})",
        verdicts.count(ACCEPTED),
        verdicts.count(REFUSED) + verdicts.count(VOIDED),
        unused / 1e6,
        event_names.count("paused"),
        event_names.count("resumed"),
        lab.most_notices_an_hour(),
        lab.clock_s() / MINUTE_S,
        is_right,
    )


def _take_with_stop(path: Path, folder: Path) -> None:
    """Take a session in a separate process that is stopped (SIGSTOP) for 15 s at its twelfth frame."""
    pids: list[int] = []

    def stop() -> None:
        while not folder.is_dir() or sum(1 for _ in (folder / "frames").glob("0*")) < 12:
            time.sleep(0.05)
        os.kill(pids[0], signal.SIGSTOP)
        time.sleep(15)
        os.kill(pids[0], signal.SIGCONT)

    def work() -> None:
        assert TroubledLab().take(path, folder) is None

    notices = path.with_name("pid")
    thread = threading.Thread(target=lambda: (pids.append(_wait_for_pid(notices)), stop()))
    thread.start()
    assert in_child(lambda: (notices.write_text(str(os.getpid())), work())) == 0
    thread.join()


def _wait_for_pid(notices: Path) -> int:
    while not (notices.is_file() and notices.read_text()):
        time.sleep(0.01)
    return int(notices.read_text())


def causes(name_part: str = "") -> bool:
    """Print the table of causes; return whether all effects are as documented."""
    print(HEAD)
    is_right = True
    for cause in CAUSES:
        if name_part in cause.name:
            with tempfile.TemporaryDirectory() as scratch:
                outcome = outcome_of(cause, Path(scratch))
            print(outcome.line(), flush=True)
            is_right &= outcome.as_documented
    return is_right


# Expected journal entries of a night: event and pattern of its detail, by fault.
EXPECTED_EVENTS: Mapping[str, tuple[str, str]] = {
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
    """Result of a night."""

    missing_events: tuple[str, ...]
    frames: int
    doubled: int
    hours: float
    pauses: int


def night(scratch: Path, grid: int, night_s: float = NIGHT_S) -> Night:
    """Take a session that lasts a night, with two power cuts and other faults, without an operator."""
    lights = len(plan_illuminants(grid, [3000, 6500]))
    frames = 21 + lights + 2 * (lights // 10 + 2)
    path = make_lab(scratch, grid, settle_s=max(night_s / frames - 2, 0.5), patience_s=HOUR_S, warm_up_s=20 * MINUTE_S)
    folder = scratch / "session"

    def before_the_second_cut() -> None:
        lab = TroubledLab()
        _schedule_night(lab, night_s, 1.2 * night_s / frames)
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
    accepted_steps = [attempt.step for attempt in attempts if attempt.verdict == ACCEPTED]
    assert sorted(set(accepted_steps)) == steps
    missing_events = tuple(
        fault
        for fault, (event_name, detail) in EXPECTED_EVENTS.items()
        if not any(event.what == event_name and re.search(detail, event.detail, re.IGNORECASE) for event in events)
    )
    hours = (attempts[-1].started_at - SIM_START).total_seconds() / HOUR_S
    times = [attempt.started_at for attempt in attempts]
    assert times == sorted(times), "time never goes back"
    return Night(
        missing_events,
        len(attempts),
        len(accepted_steps) - len(set(accepted_steps)),
        hours,
        [e.what for e in events].count("paused"),
    )


def _schedule_night(lab: TroubledLab, night_s: float, least_s: float) -> None:
    """Schedule the faults of a night; each lasts at least `least_s`, so that it affects a frame."""

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
    """Print the table of causes, or the result of a night."""
    if argv[:1] != ["night"]:
        return int(not causes(argv[1] if argv[1:] else ""))
    from calibration.cli import main as build_lut

    grid = int(argv[1]) if argv[1:] else 33
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(argv[2]) if argv[2:] else Path(scratch) / "night"
        start = time.perf_counter()
        result = night(folder, grid)
        duration_s = time.perf_counter() - start
        code = build_lut([str(folder / "session"), str(folder / "lut")])
    for name, value, unit in (
        ("night: hours of lab time", round(result.hours, 2), "h"),
        ("night: attempts", result.frames, "frames"),
        ("night: steps with two accepted frames", result.doubled, "frames"),
        ("night: pauses", result.pauses, "pauses"),
        (
            "night: expected events that are missing",
            len(result.missing_events),
            f"of {len(EXPECTED_EVENTS)} {' '.join(result.missing_events)}".strip(),
        ),
        ("night: exit code of build-lut", code, ""),
        ("night: time", round(duration_s, 1), "s"),
    ):
        print(json.dumps({"name": name, "value": value, "unit": unit, "against": ""}), flush=True)
    return int(bool(result.missing_events) or code != 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
