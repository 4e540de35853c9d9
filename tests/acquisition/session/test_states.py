"""Sessions taken in the simulated lab, in order and in trouble, go through the states of the table and no others."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

import pytest

from acquisition.chart.layout import design_chart
from acquisition.config import LabSettings
from acquisition.lights.illuminations import Illumination
from acquisition.run import sequencer
from acquisition.run.devices import Devices
from acquisition.run.rig.opening import open_rig
from acquisition.run.sequencer import take_session
from acquisition.session import records
from acquisition.session.folder import Session
from acquisition.session.incoming import ReceivedFile
from acquisition.session.judgement import Judgement
from acquisition.session.plan import SessionStep, plan_steps
from acquisition.session.states import ENDS, TRANSITIONS, StepState, may_follow, may_lead_to
from drivers.camera import Camera, CameraIdentity, CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour, Presenter
from foundation.clock import Clock
from foundation.errors import DeviceError, LinkTimeout

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
        What the devices do in the n-th attempt.
    """

    def __init__(self, trouble: Mapping[tuple[StepState, int], BaseException], faults: Mapping[int, Fault]) -> None:
        self.trouble, self.faults = dict(trouble), faults
        self.state: dict[int, StepState] = {}
        self.seen: set[tuple[StepState, StepState]] = set()
        self.reached: list[StepState] = []
        self.step = -1

    def enter(self, state: StepState) -> None:
        """Note that the step under way is in another state."""
        self.seen.add((self.state.get(self.step, StepState.PLANNED), state))
        self.state[self.step] = state
        self.reached.append(state)
        error = self.trouble.pop((state, self.reached.count(state)), None)
        if error is not None:
            raise error

    @property
    def fault(self) -> Fault | None:
        """What the devices are to do in the attempt under way."""
        return self.faults.get(self.reached.count(StepState.BEGUN))


class WatchedPresenter:
    """A presenter that shows black in place of the colour, or fails, where that is asked for."""

    def __init__(self, presenter: Presenter, watch: Watch) -> None:
        self.presenter, self.watch = presenter, watch

    def show(self, colour: Colour) -> None:
        if self.watch.fault == "does not answer":
            raise DeviceError("no picture")
        self.presenter.show(BLACK if self.watch.fault == "shows black" else colour)
        self.watch.enter(StepState.LIT)

    def close(self) -> None:
        self.presenter.close()


class WatchedClock:
    """The simulated clock; the first wait after a colour is its settling."""

    def __init__(self, clock: Clock, watch: Watch) -> None:
        self.clock, self.watch = clock, watch
        self.now, self.monotonic = clock.now, clock.monotonic

    def sleep(self, seconds: float) -> None:
        self.clock.sleep(seconds)
        if self.watch.reached[-1:] == [StepState.LIT]:
            self.watch.enter(StepState.SETTLED)


class WatchedCamera:
    """A camera that states a byte more than it sends, where that is asked for."""

    def __init__(self, camera: Camera, watch: Watch) -> None:
        self.camera, self.watch = camera, watch

    def identity(self) -> CameraIdentity:
        return self.camera.identity()

    def configure(self, settings: ExposureSettings) -> None:
        self.camera.configure(settings)

    def shutter_speeds(self) -> tuple[float, ...]:
        return self.camera.shutter_speeds()

    def capture(self, into: BinaryIO) -> CapturedFrame:
        captured = self.camera.capture(into)
        self.watch.enter(StepState.EXPOSED)
        return replace(captured, size=captured.size + 1) if self.watch.fault == "cuts the file" else captured

    def close(self) -> None:
        self.camera.close()


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

    def after(method: Callable[..., Any], enter: Callable[..., None]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            result = method(*given, **named)
            enter(*given, **named)
            return result

        return call

    def begun(step: SessionStep, *_: object) -> None:
        watch.step = step.number
        watch.enter(StepState.BEGUN)

    def committed(_attempt: int, _received: ReceivedFile, judgement: Judgement, *_: object, **__: object) -> None:
        watch.enter(StepState.ACCEPTED if judgement.accepted else StepState.REFUSED)

    with patch.context() as patched, open_rig(SETTINGS, session.chart, session) as devices:
        patched.setattr(session.journal, "begin", after(session.journal.begin, begun))
        patched.setattr(session, "receive", after(session.receive, lambda *_: watch.enter(StepState.SAVED)))
        patched.setattr(sequencer, "judge_file", after(sequencer.judge_file, lambda *_: watch.enter(StepState.JUDGED)))
        patched.setattr(session, "commit", after(session.commit, committed))
        patched.setattr(session.journal, "fail", after(session.journal.fail, lambda *_: watch.enter(StepState.FAILED)))
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
) -> Watch:
    """Take the session as far as it goes and return what was seen; `before` is the run that ended early."""
    watch = Watch(trouble or {}, faults or {})
    if before is not None:
        watch.state = before.state
    with watched(session, watch, patch) as devices:
        try:
            take_session(session, devices, SETTINGS)
        except KeyboardInterrupt:
            watch.enter(StepState.INTERRUPTED)
        except DeviceError:
            pass
    return watch


def journalled(session: Session) -> set[tuple[StepState, StepState]]:
    """Return the transitions that the journal shows."""
    seen: set[tuple[StepState, StepState]] = set()
    state: dict[int, StepState] = {}
    for attempt in session.journal.attempts():
        end = StepState.INTERRUPTED if attempt.verdict is None else StepState(attempt.verdict)
        seen |= {(state.get(attempt.step, StepState.PLANNED), StepState.BEGUN), (StepState.BEGUN, end)}
        state[attempt.step] = end
    return seen


def check(session: Session, *runs: Watch) -> set[tuple[StepState, StepState]]:
    """Check what was seen against the table, and the journal too; return what was seen."""
    seen = set[tuple[StepState, StepState]]().union(*(watch.seen for watch in runs))
    assert [pair for pair in seen if not may_follow(*pair)] == []
    assert [pair for pair in journalled(session) if not may_lead_to(*pair)] == []
    return seen


def test_every_line_of_the_table_happens(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [take(session, monkeypatch, {(StepState.JUDGED, 2): KeyboardInterrupt()}, {1: "shows black"})]
    for state in (StepState.BEGUN, StepState.LIT, StepState.SETTLED, StepState.EXPOSED, StepState.SAVED):
        runs.append(take(session, monkeypatch, {(state, 1): KeyboardInterrupt()}, before=runs[-1]))
    faults: dict[int, Fault] = {1: "cuts the file", 2: "does not answer"}
    runs.append(take(session, monkeypatch, {(StepState.SETTLED, 3): LinkTimeout("no answer")}, faults, runs[-1]))
    runs.append(take(session, monkeypatch, before=runs[-1]))
    (session.folder / session.frames()[-1].file).unlink()
    runs.append(take(session, monkeypatch, before=runs[-1]))
    seen = check(session, *runs)
    assert {(line.before, line.after) for line in TRANSITIONS} - seen == set()


def test_the_words_are_the_journals() -> None:
    assert tuple(state.value for state in ENDS[:3]) == (records.ACCEPTED, records.REFUSED, records.FAILED)
