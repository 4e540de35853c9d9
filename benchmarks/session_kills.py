"""Kills of a run at random operations and times: the session ends in the frames of an undisturbed one.

`python -m benchmarks.session_kills [KILLS [SEED]]` kills 10 000 runs and prints one JSON object a line. Each run is a
process of its own that is killed by the system (SIGKILL): half of them at the n-th operation (a call that writes,
flushes, renames, journals, shows, exposes or fetches; before or after it), half of them by a timer at any moment. After
a few kills a session is taken to its end, and its frames, the accepted rows of its journal and `frames.csv` are
compared with those of an undisturbed run: bytes, hashes, times. A table follows from these alone. Ctrl-C ends it with
the figures so far; a kill costs some 50 ms of one core.

`python -m benchmarks.session_kills troubled [KILLS [SEED]]` kills runs that are in trouble all the time: frames that
are refused and taken again, a camera that fails, power that goes, a lamp that is lit again, a journal that was deleted
or cut and is made anew. Each kill is told by where it fell. Times differ there with each kill; what must hold is that
no frame that counted is lost, each step has one frame of its own light in the end, and no exposure counts twice.
`… programs [KILLS [SEED]]` kills `acquire run` itself, started as a program of its own, from outside.

Camera and screen are the simplest that keep the contracts; their files are the light, its number and the time of
release, so that a frame that is lost, doubled or of another moment differs. What is flattered: a kill is no power cut
(what was written and not flushed stays), and the files are small.
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
from experiment.lights import Illumination
from experiment.session.folder import Session, rebuild_journal
from experiment.session.journal import IncomingFile, Journal, ledger_path, settled_frames
from experiment.session.records import ACCEPTED, VOIDED, Check, Judgement, SessionStep, plan_steps
from experiment.session.repair import damaged_files
from foundation.clock import SIM_START, SimulatedClock
from foundation.errors import DeviceError, FormatError
from sim.projectors.projector import SimulatedProjector
from tests.end_to_end.conftest import make_lab

KILLS = 10_000
# Kills, on the average, between the beginning and the end of a session.
KILLS_A_SESSION = 4

# Sessions from one line about the kills so far to the next.
TOLD_EVERY = 100

LIGHTS = tuple(Illumination(n, "uniform", None, Colour(255, 20 * n, 255 - n)) for n in range(6))
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
    """Devices in the state that a session's journal gives: the same time, the same pictures taken."""

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
        """Return the devices: this is all of them."""
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
        """Show a colour after one picture."""
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
    """Accepts a file that shows the light of its step."""

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Look at the file's first words."""
        shown = file.read_bytes().startswith(f"{step.colour} ".encode())
        return Judgement.of_reason("light", None if shown else "another light")

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Remember nothing."""


# Where a run is killed: before or after a call.
OPERATIONS: tuple[tuple[Any, str], ...] = (
    *((os, name) for name in ("fsync", "replace", "unlink", "close")),
    *((Journal, name) for name in ("begin", "commit", "note", "beat", "add_steps")),
    *((SmallLab, name) for name in ("show", "verify", "expose", "download")),
    *((Session, name) for name in ("write_frames_csv", "set_aside_strays")),
    *((IncomingFile, "__init__"), (IncomingFile, "complete"), (LightJudge, "judge"), (StepQueue, "accept")),
)


def take(folder: Path) -> None:
    """Take the session as far as it goes, as `acquire run` does."""
    with Session.open_for_run(folder) as session:
        session.verify()
        assert take_session(session, SmallLab(session).devices, SETTINGS, LightJudge()).complete


def counting(happens: Callable[[int], object]) -> None:
    """Call `happens` with the number of each operation from now on, before and after it."""
    count = [0]

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            count[0] += 1
            happens(count[0])
            result = real(*given, **named)
            count[0] += 1
            happens(count[0])
            return result

        return call

    for owner, name in OPERATIONS:
        setattr(owner, name, counted(getattr(owner, name)))


def in_child(work: Callable[[], object]) -> int:
    """Do `work` in a process of its own; return how that ended, as `os.waitstatus_to_exitcode`."""
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
    """Take the session in a process that kills itself at an operation; return how it ended."""

    def die(count: int) -> None:
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)

    def work() -> None:
        counting(die)
        take(folder)

    return in_child(work)


def killed_at_time(folder: Path, seconds: float) -> int:
    """Take the session in a process that the system ends after some time; return how it ended."""

    def work() -> None:
        # The signal's own action ends the process wherever it is.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, seconds)
        take(folder)
        signal.setitimer(signal.ITIMER_REAL, 0)

    return in_child(work)


def contents(folder: Path) -> dict[str, object]:
    """Return what must be the same: frames with their bytes, the accepted rows, the list of frames."""
    with Session.open(folder) as session:
        rows = sorted((frame.step, frame.sha256, frame.size) for frame in session.journal.accepted_files())
        frames = {
            (frame.kind, frame.illumination, frame.taken_at.isoformat(), frame.exposure_s): (
                (folder / frame.file).read_bytes()
            )
            for frame in session.frames()
            if frame.accepted
        }
    listed = [line for line in (folder / "frames.csv").read_text().splitlines() if line.endswith(",accepted")]
    return {"rows": rows, "frames": frames, "listed": sorted(listed)}


# What a run that is in trouble does where it is killed.
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
    """Devices of which each fails at some frames of every run, and is mended while it is waited for."""

    def __init__(self, session: Session, phase: Callable[[str], object]) -> None:
        super().__init__(session)
        self.projector = SimulatedProjector(self.clock, Power.ON)
        self._phase = phase
        self._fails = 0

    @property
    def devices(self) -> Devices:
        """Return the devices, with a projector."""
        return Devices(self, self, self.projector, self.clock)

    def expose(self) -> datetime:
        """Fail for a while at each seventh frame; let the power go before each ninth."""
        taken = sum(self.exposed.values())
        if taken % 7 == 6 and self._fails < 4:
            self._fails += 1
            raise DeviceError("the camera does not answer; look at its cable")
        self._fails = 0
        if taken % 9 == 8:
            self.projector._enter(Power.STANDBY, self.clock.monotonic())
        return super().expose()


class TroubledJudge(LightJudge):
    """Refuses the first frame of every third colour, and the first two of another for something that lasts."""

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Look at the colour, and how often it was exposed."""
        seen = super().judge(file, step)
        tries = int(file.read_bytes().split(b") ")[1].split()[0])
        kind = sum(step.colour) % 3
        if not seen.accepted or step.kind == "dark" or tries >= kind:
            return seen
        return Judgement((Check("light", reason="somebody walks past"),), lasting=kind == 2)


def take_troubled(folder: Path, phase: Callable[[str], object]) -> None:
    """Take a session that is in trouble as far as it goes; its journal is made anew first where that is needed."""
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


def telling(phase: Callable[[str], object], owner: Any, name: str, what: str) -> None:
    """Let `phase` know while a method is at work."""
    real = getattr(owner, name)

    def told(*given: Any, **named: Any) -> Any:
        phase(what)
        try:
            return real(*given, **named)
        finally:
            phase("taking")

    setattr(owner, name, told)


def counted_run(blank: Path, scratch: Path, take_it: Callable[[Path], object]) -> tuple[int, float]:
    """Return how many operations an undisturbed run of a copy of `blank` has, and how many seconds it takes."""
    folder, count = scratch / "counted", scratch / "count"
    shutil.copytree(blank, folder)
    most = [0]

    def work() -> None:
        counting(lambda number: most.__setitem__(0, number))
        take_it(folder)
        count.write_text(str(most[0]))

    begun = time.perf_counter()
    assert in_child(work) == 0
    return int(count.read_text()), time.perf_counter() - begun


class TroubledSessions:
    """Sessions in trouble that are killed by chance and then taken to their end.

    - `kills`: how many there were, by what the run did.
    - `lost`, `doubled`: frames that had counted and do not any more, for no reason; steps with another number of
      frames than one, frames of another light, exposures that count twice.
    """

    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.chance = scratch, random.Random(seed)
        self.kills: Counter[str] = Counter()
        self.sessions = self.lost = self.doubled = 0
        self.phase = mmap.mmap(-1, 1)
        self.blank = scratch / "blank"
        steps = plan_steps(LIGHTS, 3, response=RESPONSES)
        Session.create(self.blank, TROUBLED.to_toml(), design_chart(bits=1), LIGHTS, steps).close()
        taken = partial(take_troubled, phase=self._tell)
        self.operations, self.seconds = counted_run(self.blank, scratch, taken)

    def _tell(self, what: str) -> None:
        self.phase[0] = PHASES.index(what)

    def session(self) -> None:
        """Kill a session some times, take it to its end, and look what is there."""
        self.sessions += 1
        folder = self.scratch / f"session-{self.sessions}"
        shutil.copytree(self.blank, folder)
        counted = set[str]()
        for _ in range(self.chance.randint(2, 4 * KILLS_A_SESSION)):
            if self.sessions % 2 and self.chance.random() < 0.3:
                self._lose_journal(folder)
            by_operation, rebuilt = self.chance.random() < 0.5, self.chance.random() < 0.1
            operation = self.chance.randrange(1, 60 if rebuilt else self.operations)
            seconds = self.chance.uniform(0.001, self.seconds)

            def work(by_operation: bool = by_operation, operation: int = operation, seconds: float = seconds) -> None:
                telling(self._tell, Pause, "wait", "pause")
                telling(self._tell, devices, "_wait_until_healthy", "relighting")
                telling(self._tell, devices, "_warm_up", "relighting")
                telling(self._tell, Journal, "rebuild", "rebuilding")
                self._tell_retakes()
                if by_operation:
                    counting(lambda count: os.kill(os.getpid(), signal.SIGKILL) if count == operation else None)
                else:
                    signal.signal(signal.SIGALRM, signal.SIG_DFL)
                    signal.setitimer(signal.ITIMER_REAL, seconds)
                take_troubled(folder, self._tell)
                signal.setitimer(signal.ITIMER_REAL, 0)

            ended = in_child(work)
            assert ended in (0, -signal.SIGKILL, -signal.SIGALRM), ended
            if ended:
                self.kills[PHASES[self.phase[0]]] += 1
            counted |= {sha256 for _, sha256, verdict in settled_frames(ledger_path(folder)) if verdict == ACCEPTED}
        assert in_child(lambda: take_troubled(folder, self._tell)) == 0
        self._look(folder, counted)
        shutil.rmtree(folder)

    def _tell_retakes(self) -> None:
        begin = Journal.begin

        def begun(journal: Journal, step: SessionStep, file: str, at: datetime) -> int:
            self._tell("retake" if "_try" in file else "taking")
            return begin(journal, step, file, at)

        setattr(Journal, "begin", begun)  # noqa: B010 - another function, for this process alone

    def _lose_journal(self, folder: Path) -> None:
        path = folder / "journal.sqlite"
        if path.is_file() and ledger_path(folder).is_file():
            path.unlink() if self.chance.random() < 0.5 else os.truncate(path, self.chance.randrange(5000))

    def _look(self, folder: Path, counted: set[str]) -> None:
        with Session.open(folder) as session:
            accepted = session.journal.accepted_files()
            colours = {step.number: step.colour for step in session.steps}
            voided = {one.id for one in session.journal.attempts() if one.verdict == VOIDED}
            not_used = {frame.sha256 for frame in session.frames() if frame.attempt in voided}
            gone = damaged_files(folder, accepted, lambda done, total: None)
            self.lost += len(counted - {frame.sha256 for frame in accepted} - not_used) + len(gone)
            self.doubled += sorted(frame.step for frame in accepted) != sorted(colours)
            contents = {frame.step: (folder / frame.file).read_bytes() for frame in accepted}
            self.doubled += len(accepted) - len(set(contents.values()))
            self.doubled += sum(
                not content.startswith(f"{colours[step]} ".encode()) for step, content in contents.items()
            )


class KilledSessions:
    """Sessions that are killed by chance and then taken to their end.

    - `kills`, `sessions`, `differing`: how many there were, and how many sessions ended otherwise than the undisturbed
      one.
    - `strays`: complete files that no row counts, set aside.
    """

    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.chance = scratch, random.Random(seed)
        self.kills = self.sessions = self.differing = self.strays = 0
        self.blank = scratch / "blank"
        Session.create(self.blank, SETTINGS.to_toml(), design_chart(bits=1), LIGHTS, STEPS).close()
        undisturbed = scratch / "undisturbed"
        shutil.copytree(self.blank, undisturbed)
        begun = time.perf_counter()
        assert in_child(lambda: take(undisturbed)) == 0
        self.seconds = time.perf_counter() - begun
        self.expected = contents(undisturbed)
        self.operations, _ = counted_run(self.blank, scratch, take)

    def session(self) -> None:
        """Kill a session some times, take it to its end, and compare."""
        self.sessions += 1
        folder = self.scratch / f"session-{self.sessions}"
        shutil.copytree(self.blank, folder)
        for _ in range(self.chance.randint(1, 2 * KILLS_A_SESSION - 1)):
            if self.chance.random() < 0.5:
                ended = killed_at_operation(folder, self.chance.randrange(1, self.operations))
            else:
                ended = killed_at_time(folder, self.chance.uniform(0.001, self.seconds))
            assert ended in (0, -signal.SIGKILL, -signal.SIGALRM), ended
            self.kills += ended != 0
        assert in_child(lambda: take(folder)) == 0
        self.differing += contents(folder) != self.expected
        self.differing += any(folder.rglob(".*partial*"))
        self.strays += len(list(folder.rglob("*.stray")))
        shutil.rmtree(folder)


class KilledPrograms:
    """Sessions of the simulated lab whose program, `acquire run`, is killed from outside; fields as those above."""

    def __init__(self, scratch: Path, seed: int) -> None:
        self.chance = random.Random(seed)
        self.lab = make_lab(scratch)
        self.kills = self.sessions = self.lost = self.doubled = 0

    def session(self) -> None:
        """Kill the program until it ends by itself."""
        self.sessions += 1
        folder = self.lab.parent / f"session-{self.sessions}"
        counted = set[str]()
        while True:
            command = [sys.executable, "-m", "acquisition.cli", "run", str(self.lab), str(folder)]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as program:
                with suppress(subprocess.TimeoutExpired):
                    assert program.wait(self.chance.uniform(1, 40)) == 0
                    break
                program.kill()
            self.kills += 1
            counted |= {sha256 for _, sha256, verdict in settled_frames(ledger_path(folder)) if verdict == ACCEPTED}
        with Session.open(folder) as session:
            accepted = session.journal.accepted_files()
            self.lost += len(counted - {frame.sha256 for frame in session.frames()})
            self.lost += len(damaged_files(folder, accepted, lambda done, total: None))
            self.doubled += sorted(frame.step for frame in accepted) != [step.number for step in session.steps]
            self.doubled += len(accepted) - len({frame.sha256 for frame in accepted})
        shutil.rmtree(folder)


def _disturb(kind: str, wanted: int, seed: int) -> int:
    """Kill sessions of a kind until so many kills are done, and print what came of it."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        made = TroubledSessions if kind == "troubled" else KilledPrograms
        sessions = made(Path(scratch), seed)
        with suppress(KeyboardInterrupt):
            while (sessions.kills.total() if isinstance(sessions.kills, Counter) else sessions.kills) < wanted:
                sessions.session()
                print(
                    f"{sessions.kills}, {sessions.lost} lost, {sessions.doubled} doubled", file=sys.stderr, flush=True
                )
    kills = sessions.kills if isinstance(sessions.kills, Counter) else {"by SIGKILL from outside": sessions.kills}
    figures = {f"kills: {phase}": count for phase, count in kills.items()}
    figures |= {"sessions": sessions.sessions, "lost": sessions.lost, "doubled": sessions.doubled}
    figures["seconds"] = round(time.perf_counter() - begun)
    for name, value in figures.items():
        print(json.dumps({"name": f"session kills, {kind}: {name}", "value": value, "unit": "", "against": ""}))
    return int(bool(sessions.lost or sessions.doubled))


def main(argv: list[str]) -> int:
    """Kill runs and print what came of it."""
    if argv[:1] in (["troubled"], ["programs"]):
        return _disturb(argv[0], int(argv[1]) if argv[1:] else 500, int(argv[2]) if argv[2:] else 20190601)
    wanted, seed = int(argv[0]) if argv else KILLS, int(argv[1]) if argv[1:] else 20190601
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        sessions = KilledSessions(Path(scratch), seed)
        # What was killed until somebody ends it counts.
        with suppress(KeyboardInterrupt):
            while sessions.kills < wanted:
                sessions.session()
                if sessions.sessions % TOLD_EVERY == 0:
                    print(f"{sessions.kills} kills, {sessions.differing} sessions differ", file=sys.stderr, flush=True)
    for name, value, unit in (
        ("session kills: kills", sessions.kills, "kills"),
        ("session kills: sessions", sessions.sessions, "sessions"),
        ("session kills: operations of an undisturbed run", sessions.operations, "operations"),
        ("session kills: complete files that were not in the journal, set aside", sessions.strays, "files"),
        ("session kills: sessions that differ from an undisturbed one", sessions.differing, "sessions"),
        ("session kills: time", round(time.perf_counter() - begun, 1), "s"),
    ):
        print(json.dumps({"name": name, "value": value, "unit": unit, "against": ""}), flush=True)
    return int(sessions.differing > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
