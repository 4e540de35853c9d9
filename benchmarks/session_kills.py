"""Kills of a run at random operations and times: the session must end with the frames of an undisturbed session.

`python -m benchmarks.session_kills [KILLS [SEED]]` kills 10 000 runs and prints one JSON object per line. Each run is a
separate process that is killed by SIGKILL. Half of the kills happen before or after the n-th operation (a call that
writes, flushes, renames, journals, shows, exposes or downloads), half by a timer at any moment. After a few kills the
session is completed. Its frames, the accepted rows of its journal and `frames.csv` are compared with an undisturbed
run: bytes, hashes, times. A LUT depends only on these data. Ctrl-C ends the program and prints the results so far. A
kill takes about 50 ms of one core.

`python -m benchmarks.session_kills troubled [KILLS [SEED]]` kills runs with many other faults: refused and repeated
frames, a failing camera, power cuts, a lamp that is lit again, a deleted or cut journal that is rebuilt. Kills are
counted by the phase of the run. These sessions cannot be compared with an undisturbed run, because their times differ
with each kill. Instead, three conditions are checked: no accepted frame is lost, each step has one frame of its own
illuminant in the end, and no exposure counts twice.

`python -m benchmarks.session_kills programs [KILLS [SEED]]` kills the program `acquire run` itself.

Camera and screen are minimal implementations of the contracts. The files of the camera contain the illuminant, the
number of exposures of this illuminant and the release time, so that lost, doubled and exchanged frames are detected.
Simplifications: data that were written but not flushed survive a kill, unlike a power cut, and the files are small.
"""

from __future__ import annotations

import json
import mmap
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from acquisition.run import devices
from acquisition.run.devices import Devices, Pause
from acquisition.run.pipeline import StepQueue, link_runs
from acquisition.run.run import take_session
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from drivers.projector import Power
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illuminant
from experiment.session.folder import Session, rebuild_journal
from experiment.session.journal import IncomingFile, Journal, ledger_path, settled_frames
from experiment.session.records import ACCEPTED, VOIDED, Check, Judgement, SessionStep, plan_steps
from experiment.session.repair import damaged_files
from foundation.clock import SIM_START, SimulatedClock
from foundation.errors import DeviceError, FormatError
from sim.projectors.projector import SimulatedProjector
from tests.end_to_end.conftest import make_lab

KILLS = 10_000
# Average number of kills per session.
KILLS_A_SESSION = 4

# Sessions between two progress lines.
PROGRESS_EVERY = 100

LIGHTS = tuple(Illuminant(n, "uniform", None, Colour(255, 20 * n, 255 - n)) for n in range(6))
SETTINGS = LabSettings.model_validate(
    {
        "rig": "simulated",
        "chart": "chart.json",
        "illuminations": "lights.csv",
        "sequence": {"reference_every": 3, "patience_s": 10},
    }
)
STEPS = plan_steps(LIGHTS, 3)


class SmallLab:
    """Devices in the state given by the journal of a session: same time, same number of exposures."""

    def __init__(self, session: Session) -> None:
        attempts = [attempt for attempt in session.journal.attempts() if attempt.has_frame]
        colours = {step.number: step.colour for step in session.steps}
        self.exposed = Counter(colours[attempt.step] for attempt in attempts)
        ends = [attempt.ended_at for attempt in attempts if attempt.ended_at is not None]
        self.clock = SimulatedClock(max(ends, default=SIM_START))
        self.colour = BLACK
        self._frame = b""
        self._released = SIM_START

    @property
    def devices(self) -> Devices:
        return Devices(self, self, None, self.clock)

    def identity(self) -> CameraIdentity:
        """Return a name."""
        return CameraIdentity("CroP", "small", "1")

    def configure(self, settings: ExposureSettings) -> None:
        """Do nothing."""

    def shutter_speeds(self) -> tuple[float, ...]:
        """Offer none."""
        return ()

    def show(self, colour: Colour) -> None:
        """Show a colour after one frame of the display."""
        self.clock.sleep(1 / 60)
        self.colour = colour

    def verify(self, colour: Colour) -> None:
        """Require the colour."""
        assert self.colour == colour

    def expose(self) -> datetime:
        """Release."""
        self._released = self.clock.now()
        self._frame = f"{self.colour} {self.exposed[self.colour]} {self._released} ".encode() * 400
        self.exposed[self.colour] += 1
        self.clock.sleep(1.5)
        return self._released

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the file in two pieces."""
        half = len(self._frame) // 2
        for piece in (self._frame[:half], self._frame[half:]):
            self.clock.sleep(0.1)
            into.write(piece)
        return CapturedFrame("IMG_0001.CR2", len(self._frame), self._released)

    def close(self) -> None:
        """Do nothing."""


class LightJudge:
    """A judge that accepts a file with the illuminant of its step."""

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Compare the first words of the file."""
        is_ordered = file.read_bytes().startswith(f"{step.colour} ".encode())
        return Judgement.of_reason("light", None if is_ordered else "another illuminant")

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Do nothing."""


# Operations before and after which a run is killed.
OPERATIONS: tuple[tuple[Any, str], ...] = (
    *((os, name) for name in ("fsync", "replace", "unlink", "close")),
    *((Journal, name) for name in ("begin", "commit", "note", "beat", "add_steps")),
    *((SmallLab, name) for name in ("show", "verify", "expose", "download")),
    *((Session, name) for name in ("write_frames_csv", "set_aside_strays")),
    *((IncomingFile, "__init__"), (IncomingFile, "complete"), (LightJudge, "judge"), (StepQueue, "accept")),
)


def take(folder: Path) -> None:
    """Take the session as `acquire run` does."""
    with Session.open_for_run(folder) as session:
        session.verify()
        assert take_session(session, SmallLab(session).devices, SETTINGS, LightJudge()).complete


def count_operations(on_operation: Callable[[int], object]) -> None:
    """Call `on_operation` with the number of each operation from now on, before and after it."""
    counter = [0]

    def wrap(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            counter[0] += 1
            on_operation(counter[0])
            result = original(*arguments, **options)
            counter[0] += 1
            on_operation(counter[0])
            return result

        return call

    for owner, name in OPERATIONS:
        setattr(owner, name, wrap(getattr(owner, name)))


def in_child(work: Callable[[], object]) -> int:
    """Run `work` in a child process; return its exit code as `os.waitstatus_to_exitcode` does."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work()
            code = 0
        except BaseException as error:
            sys.excepthook(type(error), error, error.__traceback__)
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at_operation(folder: Path, number: int) -> int:
    """Take the session in a process that kills itself at an operation; return its exit code."""

    def die(count: int) -> None:
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)

    def work() -> None:
        count_operations(die)
        take(folder)

    return in_child(work)


def killed_at_time(folder: Path, seconds: float) -> int:
    """Take the session in a process that is killed after some time; return its exit code."""

    def work() -> None:
        # The default action of the signal ends the process wherever it is.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, seconds)
        take(folder)
        signal.setitimer(signal.ITIMER_REAL, 0)

    return in_child(work)


def contents(folder: Path) -> dict[str, object]:
    """Return what must be equal: frames with their bytes, the accepted rows, the list of frames."""
    with Session.open(folder) as session:
        rows = sorted((frame.step, frame.sha256, frame.size) for frame in session.journal.accepted_files())
        frames = {
            (frame.kind, frame.illumination, frame.taken_at.isoformat(), frame.exposure_s): (
                (folder / frame.file).read_bytes()
            )
            for frame in session.frames()
            if frame.accepted
        }
    accepted_lines = [line for line in (folder / "frames.csv").read_text().splitlines() if line.endswith(",accepted")]
    return {"rows": rows, "frames": frames, "listed": sorted(accepted_lines)}


# Phases of a troubled run at the moment of a kill.
PHASES = ("taking", "pause", "retake", "relighting", "rebuilding")

RESPONSES = (Colour(250, 0, 0), Colour(0, 250, 0), Colour(0, 0, 250))
TROUBLED = SETTINGS.model_copy(
    update={
        "sequence": SETTINGS.sequence.model_copy(
            update={"patience_s": 3600.0, "relight": True, "warm_up_s": 30.0, "attempts": 5}
        )
    }
)


class TroubledLab(SmallLab):
    """Devices that fail at some frames of every run and recover while the run waits."""

    def __init__(self, session: Session, phase: Callable[[str], object]) -> None:
        super().__init__(session)
        self.projector = SimulatedProjector(self.clock, Power.ON)
        self._phase = phase
        self._fails = 0

    @property
    def devices(self) -> Devices:
        return Devices(self, self, self.projector, self.clock)

    def expose(self) -> datetime:
        """Fail for a while at every seventh frame; cut the power before every ninth."""
        exposure_count = sum(self.exposed.values())
        if exposure_count % 7 == 6 and self._fails < 4:
            self._fails += 1
            raise DeviceError("the camera does not answer; look at its cable")
        self._fails = 0
        if exposure_count % 9 == 8:
            self.projector._enter(Power.STANDBY, self.clock.monotonic())
        return super().expose()


class TroubledJudge(LightJudge):
    """A judge that refuses the first frame of every third colour, and the first two of another with a lasting cause."""

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Decide by the colour and the number of its exposures."""
        judgement = super().judge(file, step)
        exposures = int(file.read_bytes().split(b") ")[1].split()[0])
        rejections = sum(step.colour) % 3
        if not judgement.accepted or step.kind == "dark" or exposures >= rejections:
            return judgement
        return Judgement((Check("light", reason="somebody walks past"),), lasting=rejections == 2)


def take_troubled(folder: Path, phase: Callable[[str], object]) -> None:
    """Take a troubled session to its end; first rebuild its journal if needed."""
    phase("rebuilding")
    try:
        with Session.open(folder):
            pass
    except FormatError:
        rebuild_journal(folder)
    phase("taking")
    with Session.open_for_run(folder) as session:
        session.verify()
        if len(session.done_steps()) == len(session.steps):
            return
        lab = TroubledLab(session, phase)
        first = link_runs(session, lab.clock.now())
        assert take_session(session, lab.devices, TROUBLED, TroubledJudge(), first=first).complete


def report_phase_of(phase: Callable[[str], object], owner: Any, name: str, phase_name: str) -> None:
    """Call `phase` while a method is running."""
    original = getattr(owner, name)

    def report_phase(*arguments: Any, **options: Any) -> Any:
        phase(phase_name)
        try:
            return original(*arguments, **options)
        finally:
            phase("taking")

    setattr(owner, name, report_phase)


def counted_run(blank: Path, scratch: Path, take_session_in: Callable[[Path], object]) -> tuple[int, float]:
    """Return the number of operations of an undisturbed run of a copy of `blank`, and its seconds."""
    folder, count_file = scratch / "counted", scratch / "count"
    shutil.copytree(blank, folder)
    operation_count = [0]

    def work() -> None:
        count_operations(lambda number: operation_count.__setitem__(0, number))
        take_session_in(folder)
        count_file.write_text(str(operation_count[0]))

    start = time.perf_counter()
    assert in_child(work) == 0
    return int(count_file.read_text()), time.perf_counter() - start


class TroubledSessions:
    """Troubled sessions that are killed at random and then completed.

    `kills` counts kills by phase. `lost` counts frames that had counted and no longer do, without a reason. `doubled`
    counts steps without exactly one frame, frames of a wrong illuminant, and exposures that count twice.
    """

    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.chance = scratch, random.Random(seed)
        self.kills: Counter[str] = Counter()
        self.sessions = self.lost = self.doubled = 0
        self.phase = mmap.mmap(-1, 1)
        self.blank = scratch / "blank"
        steps = plan_steps(LIGHTS, 3, response=RESPONSES)
        Session.create(self.blank, TROUBLED.to_toml(), design_chart(bits=1), LIGHTS, steps).close()
        take_session_in = partial(take_troubled, phase=self._set_phase)
        self.operations, self.seconds = counted_run(self.blank, scratch, take_session_in)

    def _set_phase(self, phase_name: str) -> None:
        self.phase[0] = PHASES.index(phase_name)

    def session(self) -> None:
        """Kill a session several times, complete it and check the result."""
        self.sessions += 1
        folder = self.scratch / f"session-{self.sessions}"
        shutil.copytree(self.blank, folder)
        counted_hashes = set[str]()
        for _ in range(self.chance.randint(2, 4 * KILLS_A_SESSION)):
            if self.sessions % 2 and self.chance.random() < 0.3:
                self._lose_journal(folder)
            is_by_operation, is_early = self.chance.random() < 0.5, self.chance.random() < 0.1
            operation = self.chance.randrange(1, 60 if is_early else self.operations)
            seconds = self.chance.uniform(0.001, self.seconds)

            def work(
                is_by_operation: bool = is_by_operation, operation: int = operation, seconds: float = seconds
            ) -> None:
                report_phase_of(self._set_phase, Pause, "wait", "pause")
                report_phase_of(self._set_phase, devices, "_wait_until_healthy", "relighting")
                report_phase_of(self._set_phase, devices, "_warm_up", "relighting")
                report_phase_of(self._set_phase, Journal, "rebuild", "rebuilding")
                self._report_retakes()
                if is_by_operation:
                    count_operations(lambda count: os.kill(os.getpid(), signal.SIGKILL) if count == operation else None)
                else:
                    signal.signal(signal.SIGALRM, signal.SIG_DFL)
                    signal.setitimer(signal.ITIMER_REAL, seconds)
                take_troubled(folder, self._set_phase)
                signal.setitimer(signal.ITIMER_REAL, 0)

            exit_code = in_child(work)
            assert exit_code in (0, -signal.SIGKILL, -signal.SIGALRM), exit_code
            if exit_code:
                self.kills[PHASES[self.phase[0]]] += 1
            counted_hashes |= {
                sha256 for _, sha256, verdict in settled_frames(ledger_path(folder)) if verdict == ACCEPTED
            }
        assert in_child(lambda: take_troubled(folder, self._set_phase)) == 0
        self._check(folder, counted_hashes)
        shutil.rmtree(folder)

    def _report_retakes(self) -> None:
        begin = Journal.begin

        def begin_and_report(journal: Journal, step: SessionStep, file: str, started_at: datetime) -> int:
            self._set_phase("retake" if "_try" in file else "taking")
            return begin(journal, step, file, started_at)

        setattr(Journal, "begin", begin_and_report)  # noqa: B010 - another function, for this process alone

    def _lose_journal(self, folder: Path) -> None:
        path = folder / "journal.sqlite"
        if path.is_file() and ledger_path(folder).is_file():
            path.unlink() if self.chance.random() < 0.5 else os.truncate(path, self.chance.randrange(5000))

    def _check(self, folder: Path, counted_hashes: set[str]) -> None:
        with Session.open(folder) as session:
            accepted = session.journal.accepted_files()
            colours = {step.number: step.colour for step in session.steps}
            voided_attempts = {attempt.id for attempt in session.journal.attempts() if attempt.verdict == VOIDED}
            voided_hashes = {frame.sha256 for frame in session.frames() if frame.attempt in voided_attempts}
            damaged = damaged_files(folder, accepted, lambda count, total: None)
            self.lost += len(counted_hashes - {frame.sha256 for frame in accepted} - voided_hashes) + len(damaged)
            self.doubled += sorted(frame.step for frame in accepted) != sorted(colours)
            contents = {frame.step: (folder / frame.file).read_bytes() for frame in accepted}
            self.doubled += len(accepted) - len(set(contents.values()))
            self.doubled += sum(
                not content.startswith(f"{colours[step]} ".encode()) for step, content in contents.items()
            )


class KilledSessions:
    """Sessions that are killed at random and then completed.

    `differing` counts sessions that differ from the undisturbed one. `strays` counts complete files without a row,
    which were moved aside.
    """

    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.chance = scratch, random.Random(seed)
        self.kills = self.sessions = self.differing = self.strays = 0
        self.blank = scratch / "blank"
        Session.create(self.blank, SETTINGS.to_toml(), design_chart(bits=1), LIGHTS, STEPS).close()
        undisturbed = scratch / "undisturbed"
        shutil.copytree(self.blank, undisturbed)
        start = time.perf_counter()
        assert in_child(lambda: take(undisturbed)) == 0
        self.seconds = time.perf_counter() - start
        self.expected = contents(undisturbed)
        self.operations, _ = counted_run(self.blank, scratch, take)

    def session(self) -> None:
        """Kill a session several times, complete it and compare it."""
        self.sessions += 1
        folder = self.scratch / f"session-{self.sessions}"
        shutil.copytree(self.blank, folder)
        for _ in range(self.chance.randint(1, 2 * KILLS_A_SESSION - 1)):
            if self.chance.random() < 0.5:
                exit_code = killed_at_operation(folder, self.chance.randrange(1, self.operations))
            else:
                exit_code = killed_at_time(folder, self.chance.uniform(0.001, self.seconds))
            assert exit_code in (0, -signal.SIGKILL, -signal.SIGALRM), exit_code
            self.kills += exit_code != 0
        assert in_child(lambda: take(folder)) == 0
        self.differing += contents(folder) != self.expected
        self.differing += any(folder.rglob(".*partial*"))
        self.strays += len(list(folder.rglob("*.stray")))
        shutil.rmtree(folder)


class KilledPrograms:
    """Sessions of the simulated laboratory with `acquire run` killed from outside; fields as above."""

    def __init__(self, scratch: Path, seed: int) -> None:
        self.chance = random.Random(seed)
        self.lab = make_lab(scratch)
        self.kills = self.sessions = self.lost = self.doubled = 0

    def session(self) -> None:
        """Kill the program until it completes the session."""
        self.sessions += 1
        folder = self.lab.parent / f"session-{self.sessions}"
        counted_hashes = set[str]()
        while True:
            command = [sys.executable, "-m", "acquisition.cli", "run", str(self.lab), str(folder)]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as program:
                with suppress(subprocess.TimeoutExpired):
                    assert program.wait(self.chance.uniform(1, 40)) == 0
                    break
                program.kill()
            self.kills += 1
            counted_hashes |= {
                sha256 for _, sha256, verdict in settled_frames(ledger_path(folder)) if verdict == ACCEPTED
            }
        with Session.open(folder) as session:
            accepted = session.journal.accepted_files()
            self.lost += len(counted_hashes - {frame.sha256 for frame in session.frames()})
            self.lost += len(damaged_files(folder, accepted, lambda count, total: None))
            self.doubled += sorted(frame.step for frame in accepted) != [step.number for step in session.steps]
            self.doubled += len(accepted) - len({frame.sha256 for frame in accepted})
        shutil.rmtree(folder)


def _kill_sessions(kind: str, kill_count: int, seed: int) -> int:
    """Kill sessions of one kind until there are `kill_count` kills, and print the result."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        make_sessions = TroubledSessions if kind == "troubled" else KilledPrograms
        sessions = make_sessions(Path(scratch), seed)
        with suppress(KeyboardInterrupt):
            while (sessions.kills.total() if isinstance(sessions.kills, Counter) else sessions.kills) < kill_count:
                sessions.session()
                print(
                    f"{sessions.kills}, {sessions.lost} lost, {sessions.doubled} doubled", file=sys.stderr, flush=True
                )
    kills = sessions.kills if isinstance(sessions.kills, Counter) else {"by SIGKILL from outside": sessions.kills}
    figures = {f"kills: {phase}": count for phase, count in kills.items()}
    figures |= {"sessions": sessions.sessions, "lost": sessions.lost, "doubled": sessions.doubled}
    figures["seconds"] = round(time.perf_counter() - start)
    for name, value in figures.items():
        print(json.dumps({"name": f"session kills, {kind}: {name}", "value": value, "unit": "", "against": ""}))
    return int(bool(sessions.lost or sessions.doubled))


def main(argv: list[str]) -> int:
    if argv[:1] in (["troubled"], ["programs"]):
        return _kill_sessions(argv[0], int(argv[1]) if argv[1:] else 500, int(argv[2]) if argv[2:] else 20190601)
    kill_count, seed = int(argv[0]) if argv else KILLS, int(argv[1]) if argv[1:] else 20190601
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        sessions = KilledSessions(Path(scratch), seed)
        # Ctrl-C ends the kills; those so far count.
        with suppress(KeyboardInterrupt):
            while sessions.kills < kill_count:
                sessions.session()
                if sessions.sessions % PROGRESS_EVERY == 0:
                    print(f"{sessions.kills} kills, {sessions.differing} sessions differ", file=sys.stderr, flush=True)
    for name, value, unit in (
        ("session kills: kills", sessions.kills, "kills"),
        ("session kills: sessions", sessions.sessions, "sessions"),
        ("session kills: operations of an undisturbed run", sessions.operations, "operations"),
        ("session kills: complete files without a journal row, moved aside", sessions.strays, "files"),
        ("session kills: sessions that differ from an undisturbed one", sessions.differing, "sessions"),
        ("session kills: time", round(time.perf_counter() - start, 1), "s"),
    ):
        print(json.dumps({"name": name, "value": value, "unit": unit, "against": ""}), flush=True)
    return int(sessions.differing > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
