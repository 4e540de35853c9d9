"""Sessions taken in the simulated lab, in order and in trouble, go through the states of the table and no others."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Literal

import pytest

from acquisition.judge.measure import ExposureJudge
from acquisition.run.devices import Devices
from acquisition.run.pipeline import StepQueue
from acquisition.run.rig.opening import open_rig
from acquisition.run.run import take_session
from docs.states import AHEAD, TRANSITIONS, UNDER_WAY, StepState
from drivers.camera import Camera, CapturedFrame
from drivers.presenter import BLACK, Colour, Presenter
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illumination
from experiment.session import records
from experiment.session.folder import Session
from experiment.session.journal import IncomingFile, ReceivedFile
from experiment.session.records import Check, Judgement, SessionStep, plan_steps
from foundation.clock import Clock
from foundation.errors import DeviceError, LinkTimeout, StorageError

pytestmark = pytest.mark.slow

LIGHTS = (Illumination(0, "uniform", None, Colour(255, 0, 0)), Illumination(1, "uniform", None, Colour(90, 255, 80)))
SETTINGS = LabSettings.model_validate(
    {"rig": "simulated", "chart": "chart.json", "illuminations": "lights.csv", "simulated": {"body": "Test"}}
)

Fault = Literal["shows black", "does not answer", "cuts the file"]


class Watch:
    """Follows the states of every step of one run.

    Attributes
    ----------
    trouble
        What is raised when a state is reached for the n-th time.
    faults
        What the devices do with the n-th light that is shown.
    """

    def __init__(self, trouble: Mapping[tuple[StepState, int], BaseException], faults: Mapping[int, Fault]) -> None:
        self.trouble, self.faults = dict(trouble), faults
        self.state: dict[int, StepState] = {}
        self.seen: set[tuple[StepState, StepState]] = set()
        self.reached: list[StepState] = []
        self.attempts: dict[int, int] = {}
        self.wanted = -1
        self.lit = -1
        self.exposed = -1

    def enter(self, step: int, state: StepState) -> None:
        """Note that a step is in another state."""
        self.seen.add((self.state.get(step, StepState.PLANNED), state))
        self.state[step] = state
        self.reached.append(state)
        error = self.trouble.pop((state, self.reached.count(state)), None)
        if error is not None:
            raise error

    def leave(self) -> None:
        """Note that the run is over: what was shown is not, and what was under way was cut off."""
        for step, state in self.state.items():
            if state in AHEAD and state is not StepState.PLANNED:
                self.enter(step, StepState.PLANNED)
            elif state in UNDER_WAY:
                self.enter(step, StepState.INTERRUPTED)

    @property
    def fault(self) -> Fault | None:
        """What the devices are to do with the light that is shown now."""
        return self.faults.get(self.reached.count(StepState.LIT))


class WatchedPresenter:
    """A presenter that shows black in place of the colour where that is asked for."""

    def __init__(self, presenter: Presenter, watch: Watch) -> None:
        self.presenter, self.watch = presenter, watch

    def show(self, colour: Colour) -> None:
        black = self.watch.faults.get(self.watch.reached.count(StepState.LIT) + 1) == "shows black"
        self.presenter.show(BLACK if black else colour)
        if self.watch.state.get(self.watch.lit) in (StepState.LIT, StepState.SETTLED):
            self.watch.enter(self.watch.lit, StepState.PLANNED)
        if self.watch.wanted < 0:
            return  # the end of the run leaves the screen black
        self.watch.lit, self.watch.wanted = self.watch.wanted, -1
        self.watch.enter(self.watch.lit, StepState.LIT)

    def close(self) -> None:
        self.presenter.close()


class WatchedClock:
    """The simulated clock; the first wait after a colour is its settling."""

    def __init__(self, clock: Clock, watch: Watch) -> None:
        self.clock, self.watch = clock, watch
        self.now, self.monotonic = clock.now, clock.monotonic

    def sleep(self, seconds: float) -> None:
        self.clock.sleep(seconds)
        if self.watch.state.get(self.watch.lit) is StepState.LIT:
            self.watch.enter(self.watch.lit, StepState.SETTLED)


class WatchedCamera:
    """A camera that states a byte more than it sends, where that is asked for."""

    def __init__(self, camera: Camera, watch: Watch) -> None:
        self.camera, self.watch = camera, watch
        self.identity, self.configure, self.close = camera.identity, camera.configure, camera.close
        self.shutter_speeds = camera.shutter_speeds
        self.cuts = False

    def expose(self) -> datetime:
        self.watch.exposed, self.cuts = self.watch.lit, self.watch.fault == "cuts the file"
        if self.watch.fault == "does not answer":
            raise LinkTimeout("no answer")
        released = self.camera.expose()
        self.watch.enter(self.watch.exposed, StepState.EXPOSED)
        return released

    def download(self, into: BinaryIO) -> CapturedFrame:
        captured = self.camera.download(into)
        if self.cuts:
            return replace(captured, size=captured.size + 1)
        self.watch.enter(self.watch.exposed, StepState.FETCHED)
        return captured


class WatchedJudge:
    """A judge of exposure that is called when a file is saved; it refuses a white frame for all before it if told."""

    def __init__(self, watch: Watch, voids: bool) -> None:
        self.judges = ExposureJudge(SETTINGS)
        self.recall = self.judges.recall
        self.watch, self.voids = watch, voids

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        self.watch.enter(step.number, StepState.SAVED)
        judgement = self.judges.judge(file, step)
        self.watch.enter(step.number, StepState.JUDGED)
        if self.voids and step.kind == "white" and step.number > 0:
            self.voids = False
            return Judgement((Check("light", reason="the picture is stuck"),), voids=True)
        return judgement


@pytest.fixture
def session(tmp_path: Path) -> Generator[Session]:
    """Yield a new session of a chart of eight colours under two lights."""
    made = Session.create(
        tmp_path / "session", SETTINGS.to_toml(), design_chart(bits=1), LIGHTS, plan_steps(LIGHTS, 25)
    )
    with made:
        yield made


@contextmanager
def watched(session: Session, watch: Watch, patch: pytest.MonkeyPatch) -> Generator[Devices]:
    """Yield the simulated lab's devices, and let `watch` follow what session and sequencer do."""
    journal = session.journal
    begin, commit, fail, void = journal.begin, journal.commit, journal.fail, journal.void
    following = StepQueue.next

    def wanting(agenda: StepQueue) -> SessionStep | None:
        step = following(agenda)
        watch.wanted = -1 if step is None else step.number
        return step

    def beginning(step: SessionStep, *given: Any) -> int:
        attempt = begin(step, *given)
        watch.attempts[attempt] = step.number
        watch.enter(step.number, StepState.BEGUN)
        return attempt

    def committing(attempt: int, received: ReceivedFile, judgement: Judgement, *given: Any, **named: Any) -> None:
        commit(attempt, received, judgement, *given, **named)
        watch.enter(watch.attempts[attempt], StepState.ACCEPTED if judgement.accepted else StepState.REFUSED)

    def failing(attempt: int, *given: Any) -> None:
        fail(attempt, *given)
        watch.enter(watch.attempts[attempt], StepState.FAILED)

    def voiding(attempts: Iterable[int], *given: Any) -> None:
        voided = list(attempts)
        void(voided, *given)
        for attempt in voided:
            watch.enter(watch.attempts[attempt], StepState.VOIDED)

    with patch.context() as patched, open_rig(SETTINGS, session.chart, session) as devices:
        patched.setattr(StepQueue, "next", wanting)
        patched.setattr(journal, "begin", beginning)
        patched.setattr(journal, "commit", committing)
        patched.setattr(journal, "fail", failing)
        patched.setattr(journal, "void", voiding)
        yield replace(
            devices,
            camera=WatchedCamera(devices.camera, watch),
            presenter=WatchedPresenter(devices.presenter, watch),
            clock=WatchedClock(devices.clock, watch),
        )


def take(
    session: Session,
    patch: pytest.MonkeyPatch,
    trouble: Mapping[tuple[StepState, int], BaseException] | None = None,
    faults: Mapping[int, Fault] | None = None,
    before: Watch | None = None,
    voids: bool = False,
) -> Watch:
    """Take the session as far as it goes and return what was seen; `before` is the run that ended early."""
    watch = Watch(trouble or {}, faults or {})
    if before is not None:
        watch.state, watch.attempts = before.state, before.attempts
    with watched(session, watch, patch) as devices, suppress(DeviceError, KeyboardInterrupt):
        take_session(session, devices, SETTINGS, WatchedJudge(watch, voids))
    watch.leave()
    return watch


def journalled(session: Session) -> set[tuple[StepState, StepState]]:
    """Return the transitions that the journal shows."""
    seen: set[tuple[StepState, StepState]] = set()
    state: dict[int, StepState] = {}
    for attempt in session.journal.attempts():
        end = StepState.INTERRUPTED if attempt.verdict is None else StepState(attempt.verdict)
        seen.add((state.get(attempt.step, StepState.PLANNED), StepState.BEGUN))
        # Its row said accepted before it said voided.
        voided = end is StepState.VOIDED
        seen |= (
            {(StepState.BEGUN, StepState.ACCEPTED), (StepState.ACCEPTED, end)} if voided else {(StepState.BEGUN, end)}
        )
        state[attempt.step] = end
    return seen


def may_lead_to(before: StepState, after: StepState) -> bool:
    """Return whether `after` can be the next state that the journal shows after `before`.

    Of a light that is shown the journal shows nothing, and of an attempt under way that it has begun; the states up to
    its end are passed over.
    """
    reached, waiting = set[StepState](), [before]
    while waiting:
        state = waiting.pop()
        for line in TRANSITIONS:
            if line.before is state and line.after not in reached:
                reached.add(line.after)
                if line.after in (*AHEAD, *UNDER_WAY) and line.after is not StepState.BEGUN:
                    waiting.append(line.after)
    return after in reached


def check(session: Session, *runs: Watch) -> set[tuple[StepState, StepState]]:
    """Check what was seen against the table, and the journal too; return what was seen."""
    seen = set[tuple[StepState, StepState]]().union(*(watch.seen for watch in runs))
    assert seen <= {(line.before, line.after) for line in TRANSITIONS}
    assert [pair for pair in journalled(session) if not may_lead_to(*pair)] == []
    return seen


def test_every_line_of_the_table_happens(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    # What was fetched is completed, judged and journalled though the run is cut: in these states the thread is cut.
    runs = [take(session, monkeypatch, {(StepState.JUDGED, 2): KeyboardInterrupt()}, {1: "shows black"})]
    for state in (StepState.LIT, StepState.SETTLED, StepState.BEGUN, StepState.EXPOSED, StepState.FETCHED):
        runs.append(take(session, monkeypatch, {(state, 1): KeyboardInterrupt()}, before=runs[-1]))
    runs.append(take(session, monkeypatch, {(StepState.SAVED, 1): KeyboardInterrupt()}, before=runs[-1]))
    runs.append(take(session, monkeypatch, faults={1: "does not answer", 2: "cuts the file"}, before=runs[-1]))
    with monkeypatch.context() as patched:
        full = iter([StorageError("No space left on device")])
        complete = IncomingFile.complete

        def filling(self: IncomingFile, captured: CapturedFrame) -> ReceivedFile:
            if error := next(full, None):
                self.abandon()
                raise error
            return complete(self, captured)

        patched.setattr(IncomingFile, "complete", filling)
        (session.folder / session.frames()[-1].file).unlink()
        (session.folder / session.frames()[0].file).unlink()
        runs.append(take(session, monkeypatch, before=runs[-1]))
    for frame in session.frames():
        (session.folder / frame.file).unlink(missing_ok=True)
    runs.append(take(session, monkeypatch, before=runs[-1], voids=True))
    seen = check(session, *runs)
    assert {(line.before, line.after) for line in TRANSITIONS} - seen == set()


def test_the_words_are_the_journals() -> None:
    words = (StepState.ACCEPTED, StepState.REFUSED, StepState.FAILED, StepState.VOIDED)
    assert tuple(state.value for state in words) == (
        records.ACCEPTED,
        records.REFUSED,
        records.FAILED,
        records.VOIDED,
    )
