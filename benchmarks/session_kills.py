"""Kills of a run at random operations and times: the session ends in the frames of an undisturbed one.

`python -m benchmarks.session_kills [KILLS [SEED]]` kills 10 000 runs and prints one JSON object a line. Each run is a
process of its own that is killed by the system (SIGKILL): half of them at the n-th operation (a call that writes,
flushes, renames, journals, shows, exposes or fetches; before or after it), half of them by a timer at any moment. After
a few kills a session is taken to its end, and its frames, the accepted rows of its journal and `frames.csv` are
compared with those of an undisturbed run: bytes, hashes, times. A table follows from these alone. Ctrl-C ends it with
the figures so far; a kill costs some 50 ms of one core.

Camera and screen are the simplest that keep the contracts; their files are the light, its number and the time of
release, so that a frame that is lost, doubled or of another moment differs. What is flattered: a kill is no power cut
(what was written and not flushed stays), and the files are small.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from acquisition.run.devices import Devices
from acquisition.run.queue import StepQueue
from acquisition.run.run import take_session
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illumination
from experiment.session.folder import IncomingFile, Session
from experiment.session.journal import Journal
from experiment.session.records import Judgement, SessionStep, plan_steps
from sim.clock import OPENING, SimulatedClock

KILLS = 10_000
KILLS_A_SESSION = 4
"""Kills, on the average, between the beginning and the end of a session."""

TOLD_EVERY = 100
"""Sessions from one line about the kills so far to the next."""

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
        self.clock = SimulatedClock(max(ends, default=OPENING))
        self.colour = BLACK
        self._frame = b""
        self._released = OPENING

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


OPERATIONS: tuple[tuple[Any, str], ...] = (
    *((os, name) for name in ("fsync", "replace", "unlink", "close")),
    *((Journal, name) for name in ("begin", "commit", "note", "beat", "add_steps")),
    *((SmallLab, name) for name in ("show", "verify", "expose", "download")),
    *((Session, name) for name in ("incoming", "commit", "write_frames_csv", "set_aside_strays")),
    *((IncomingFile, "complete"), (LightJudge, "judge"), (StepQueue, "accept")),
)
"""Where a run is killed: before or after a call."""


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
        self.operations = self._operations()

    def _operations(self) -> int:
        """Return how many operations an undisturbed run has."""
        folder, told = self.scratch / "counted", self.scratch / "count"
        shutil.copytree(self.blank, folder)
        most = [0]

        def work() -> None:
            counting(lambda number: most.__setitem__(0, number))
            take(folder)
            told.write_text(str(most[0]))

        assert in_child(work) == 0
        return int(told.read_text())

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


def main(argv: list[str]) -> int:
    """Kill runs and print what came of it."""
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
