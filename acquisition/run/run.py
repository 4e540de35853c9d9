"""From LAB.toml to a session on disk: creates it or takes it up, opens the rig, and takes every frame that is open.

Rules that hold inside for a session that is taken up:

- Files are held against their hashes before a device is opened: what is damaged is taken again.
- A session has one camera and one projector: a table of two sensors, even of the same model, is a table of none, and
  nothing in the frames says so. There is no option to go on with another one.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from acquisition.judge.judge import LiveJudge
from acquisition.judge.measure import ExposureJudge
from acquisition.monitor.view import write_session_report
from acquisition.run.devices import TRY_S, Devices, RetryPolicy, RunEnd, RunWatch, leave_lab, make_ready
from acquisition.run.notices import Life, Notices, PauseNotices
from acquisition.run.pipeline import Job, StepQueue, Taken, link_runs, take_open, unclosed_kinds, white_first
from acquisition.run.plan import nothing_to_retake, planned_steps, require_plan, require_same
from acquisition.run.rig.opening import open_rig
from drivers.camera import keep_awake
from drivers.presenter import BLACK, WHITE
from experiment.chart.model import load_chart
from experiment.config import LabSettings
from experiment.lights import load_illuminations
from experiment.session.folder import Session, busy_sentence, session_exists
from experiment.session.heartbeat import BEGINS, RunState, SessionPlace, SignOfLife, signs_of_life
from experiment.session.journal import beat_beside
from experiment.session.records import (
    ACCEPTED,
    DOUBT,
    VOIDED,
    FrameJudge,
    FrameKind,
    SessionStep,
    doubts_of,
    duration_text,
    last_moment,
)
from experiment.session.repair import secrets_warning
from foundation.clock import Clock, SteadyClock
from foundation.console import Ending
from foundation.errors import CropError, DeviceRefused, InputError, StorageError, first_of
from foundation.version import software

CONFIGURE_S = 10.0
"""How long a camera is expected to take for its settings: a dozen messages, each with an answer that is waited for."""


def run_session(
    settings: LabSettings,
    folder: Path,
    observe: Callable[[int, int], object],
    announce: Callable[[str], object] = lambda sentence: None,
    retake: str | None = None,
    ending: Ending | None = None,
    taken: Callable[[Taken], object] = lambda taken: None,
    state: Callable[[str], object] = lambda sentence: None,
) -> RunOutcome:
    """Take the session `folder`, new or interrupted, with the rig that the settings name.

    `retake`: what to take again (`Session.retake`); nothing if None.
    """
    with ExitStack() as at_last, ExitStack() as opened:
        session = opened.enter_context(_taken_up(settings, folder, announce)) if session_exists(folder) else None
        if session is None and retake is not None:
            raise nothing_to_retake(folder)
        alive = None if session is None else opened.enter_context(_signs_of(session))
        if session is not None and alive is not None:
            if retake is not None:
                session.retake(retake)

            def checking(done: int, total: int) -> None:
                state(f"checking frame {done} of {total}")
                alive(f"{BEGINS}; frame {done} of {total}")

            check_frames(session, checking, announce)
            total = len(session.steps)
            if len(session.done_steps()) == total:
                observe(total, total)
                return RunOutcome(total, 0, (), tuple(doubts_of(session.journal.events())))
        chart = load_chart(settings.chart) if session is None else session.chart
        devices = opened.enter_context(open_rig(settings, chart, session))
        require_plan(settings, folder, session, devices)
        if session is None:
            session = opened.enter_context(_begun(settings, folder))
            session.journal.retry_locked(settings.sequence.patience_s, announce)
        require_same_devices(session, devices, settings)
        if note := clock_note(session, devices.clock):
            announce(note)
        first = link_runs(session, devices.clock.now()) or white_first(session)
        total = len(session.steps)
        observe(len(session.done_steps()), total)
        # When the screen is dark and the journal at rest.
        at_last.callback(_report, session, announce)
        sign = alive or opened.enter_context(_signs_of(session))
        sign()

        def count(frame: Taken) -> None:
            sign()
            taken(frame)
            # A reference may have been put behind the plan.
            total = len(session.steps)
            observe(total - frame.left, total)

        judge = LiveJudge(settings, session.chart, session.illuminations)
        return take_session(session, devices, settings, judge, count, announce, state, ending, first)


@contextmanager
def _signs_of(session: Session) -> Generator[SignOfLife]:
    """Note how the run before ended, if it was killed, and say from now on that this one is there."""
    journal = session.journal
    if note := killed_note(session):
        # The lab's clock is not open yet, and may be another than the wall's.
        journal.note(last_moment(journal.attempts()) or datetime.now(UTC), "killed", note)
    with signs_of_life(journal.beat, journal.heartbeat, TRY_S) as alive:
        yield alive


def _report(session: Session, announce: Callable[[str], object]) -> None:
    """Write the session's report; it is derived, so that a disk that does not take it leaves the run as it ended."""
    try:
        write_session_report(session.folder)
    except CropError as error:
        announce(f"report: {error}; when that is mended, acquire report {session.folder} makes it")


def _taken_up(settings: LabSettings, folder: Path, announce: Callable[[str], object]) -> Session:
    session = Session.open_for_run(folder, settings.sequence.patience_s, announce)
    try:
        require_same(session, settings)
        if warning := secrets_warning(folder):
            announce(warning)
    except BaseException:
        session.close()
        raise
    return session


def _begun(settings: LabSettings, folder: Path) -> Session:
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    try:
        return Session.create(folder, settings.to_toml(), chart, lights, planned_steps(settings, lights))
    except InputError:
        # It was not there when this run began: another one has made it since, and frames come into it.
        if session_exists(folder):
            raise InputError(busy_sentence(folder)) from None
        raise


def check_frames(
    session: Session,
    observe: Callable[[int, int], None] = lambda done, total: None,
    announce: Callable[[str], object] = lambda sentence: None,
) -> None:
    """Hold every accepted frame against its hash; what is damaged is voided, and said."""
    if not session.journal.accepted_files():
        return
    damaged = session.verify(observe)
    if damaged:
        announce(f"voided: {first_of(damaged, 5)}")


def require_same_devices(session: Session, devices: Devices, settings: LabSettings) -> None:
    """Require that camera and projector are those that the session was begun with; note those of a new one."""
    known = session.journal.records()
    body = devices.camera.identity()
    # Its firmware may be brought up to date between two runs, and the name in a projector's menu may change.
    names = {"camera": f"{body.maker} {body.model}, serial number {body.serial}"}
    if devices.projector is not None:
        projector = devices.projector.identity()
        names["projector"] = f"{projector.maker} {projector.model}".strip() or "of an unknown maker"
    if settings.rig == "lab":
        light = settings.lab.light
        names["screen"] = " ".join(
            str(part) for part in (light.shown_by, light.display, light.host) if part is not None
        )
    for what, name in names.items():
        before = known.get(what, name)
        if before != name:
            raise DeviceRefused(
                f"{session.folder} was begun with the {what} {before}, and now there is {name}: frames of both would "
                "not make one table",
                remedy=f"connect the {what} of before, or begin a new session",
                value=name,
                expected=before,
            )
    for what, name in {**names, "software": software()}.items():
        if known.get(what) != name:
            session.journal.record(what, name)


def clock_note(session: Session, clock: Clock) -> str:
    """Return what to say where the machine's clock is behind the session's last frame, with the remedy.

    Else nothing.
    """
    if not isinstance(clock, SteadyClock) or not clock.behind_s:
        return ""
    return (
        f"clock: it is {duration_text(clock.behind_s)} behind the last frame of {session.folder}, or was ahead when "
        "that was taken; the session's time goes on from there, so that its frames stay in their order; set the "
        "machine's clock right"
    )


def killed_note(session: Session) -> str:
    """Return what the journal is to say of the run before, if that did not end in order; else nothing."""
    beat = session.journal.heartbeat()
    if beat is None or beat.state == "ended" or beat.is_of(SessionPlace.of(session.journal.path)) is False:
        return ""
    at = f"{beat.at.astimezone():%Y-%m-%d %H:%M:%S}"
    return f"the run before gave its last sign of life at {at}, and was killed, or power was lost"


@dataclass(frozen=True)
class RunOutcome:
    """Why a run ended.

    - `total`, `left`: steps of the plan, and those without an accepted frame.
    - `refused`: why steps were left for the next run, a sentence each.
    - `doubts`: what stopped nothing in this run and those before, and is to be seen.
    """

    total: int
    left: int
    refused: tuple[str, ...]
    doubts: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every step has its frame."""
        return self.left == 0


def take_session(
    session: Session,
    devices: Devices,
    settings: LabSettings,
    judge: FrameJudge | None = None,
    observe: Callable[[Taken], object] = lambda taken: None,
    announce: Callable[[str], object] = lambda sentence: None,
    state: Callable[[str], object] = lambda sentence: None,
    ending: Ending | None = None,
    first: Sequence[int] = (),
) -> RunOutcome:
    """Take every step of the session's plan that has no accepted frame yet.

    `judge`: looks at every frame; None looks at its exposure alone. `state`: called every few seconds of a wait with
    what is waited for and how long; the newest holds. `ending`: by which the run learns that it is to end after the
    running frame; None for a run that nobody asks. `first`: numbers of steps that are taken before all others.
    """
    sequence = settings.sequence
    reports = _Reports(session, devices.clock, announce, state, settings)
    asked = ending or Ending()
    retry = RetryPolicy(
        devices.clock,
        sequence.patience_s,
        reports.tell,
        lambda: keep_awake(devices.camera),
        reports.sign_of_life,
        asked.at_once,
    )

    def count(frame: Taken) -> None:
        reports.working(f"{len(session.steps) - frame.left} of {len(session.steps)} frames")
        observe(frame)

    reports.ready()
    try:
        for stray in session.set_aside_strays():
            reports.tell("stray", f"{stray.name}: complete, but not in the journal; kept, not used")
        with RunWatch(reports.late) as watch:
            queue = _open_steps(session, settings, first)
            job = Job(session, devices, settings, queue, judge or ExposureJudge(settings), retry, watch)
            if len(job.queue):
                _make_ready(job)
                take_open(job, count, asked)
        session.journal.require_whole()
        doubts = tuple(doubts_of(session.journal.events()))
        outcome = RunOutcome(len(session.steps), len(job.queue), job.queue.given_up, doubts)
        if asked.asked and not outcome.complete:
            raise KeyboardInterrupt
        leave_lab(devices, RunEnd.COMPLETE if outcome.complete else RunEnd.UNFINISHED, sequence, reports.tell)
    except BaseException as error:
        interrupted = isinstance(error, KeyboardInterrupt)
        leave_lab(devices, RunEnd.INTERRUPTED if interrupted else RunEnd.UNFINISHED, sequence, reports.tell)
        # It is derived, and made anew at the next opening: the fault that is there counts.
        with suppress(StorageError):
            session.write_frames_csv()
        reports.end("interrupted" if interrupted else "ended", str(error) or "by the operator")
        raise
    else:
        session.write_frames_csv()
        left = f"{outcome.left} of {outcome.total} frames left"
        reports.end("complete" if outcome.complete else "incomplete", "; ".join([left, *outcome.refused]))
    finally:
        reports.close()
    return outcome


def _open_steps(session: Session, settings: LabSettings, first: Sequence[int]) -> StepQueue:
    """Return the steps without an accepted frame, and what puts references behind the plan where they are needed."""

    def append(kind: FrameKind) -> SessionStep:
        step = SessionStep(session.steps[-1].number + 1, kind, None, WHITE if kind == "white" else BLACK)
        session.add_steps([step])
        return step

    taken = [attempt.kind for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    sequence = settings.sequence
    return StepQueue(
        session.steps,
        session.done_steps(),
        sequence.attempts,
        first,
        unclosed_kinds(taken),
        append,
        sequence.reference_every,
    )


def _make_ready(job: Job) -> None:
    """Make the devices ready to take what is open, and let the judge know what was taken."""
    devices, settings, journal = job.devices, job.settings, job.session.journal
    journal.note(devices.clock.now(), "start", f"{len(job.queue)} of {len(job.session.steps)} frames to take")
    with job.watch.step("the camera", "takes its settings", CONFIGURE_S, "configure"):
        devices.camera.configure(settings.camera.exposure)
    for step, _, measurement, accepted in journal.measurements():
        job.judge.recall(step, measurement, accepted)
    if devices.projector is not None:
        make_ready(devices.projector, settings.sequence, job.retry)


class _Reports:
    """Where words of a run go: terminal, journal, whoever is notified."""

    def __init__(
        self,
        session: Session,
        clock: Clock,
        announce: Callable[[str], object],
        state: Callable[[str], object],
        settings: LabSettings,
    ) -> None:
        self._journal = session.journal
        self._clock = clock
        self._announce = announce
        self._state = state
        name = session.folder.name
        self._notices = Notices(settings.sequence.notify, name, lambda why: self.doubt(f"sequence.notify: {why}"))
        self._life = Life(settings.notify.alive, name, lambda why: self.doubt(f"notify.alive: {why}"), clock)
        self._pauses = PauseNotices(self._notify, clock)

    def ready(self) -> None:
        """Say that devices and session are open."""
        self._life.ready()

    def working(self, doing: str) -> None:
        """Say what the run does now, and what could not be told of it to others."""
        self._life.sign(doing)
        self._notices.say_failures()

    def doubt(self, sentence: str) -> None:
        """Tell what stops nothing and is to be seen in the morning; a disk that cannot take it is told of already."""
        self._announce(f"{DOUBT}: {sentence}")
        with suppress(StorageError):
            self._journal.note(self._clock.now(), DOUBT, sentence)

    def tell(self, what: str, sentence: str, /) -> None:
        """Tell what happens."""
        self._announce(f"{what}: {sentence}")
        if what == "paused":
            self._pauses.paused(sentence)
        elif what == "resumed":
            self._pauses.resumed(sentence)
        if what != VOIDED:  # the journal notes that with the rows that it changes
            self._journal.note(self._clock.now(), what, sentence)

    def sign_of_life(self, what: str, sentence: str, within_s: float, /) -> None:
        """Say that the run waits, and for what."""
        doing: RunState = "paused" if what == "paused" else "waiting"
        if doing == "paused":
            self._pauses.paused(sentence)
        self._state(sentence)
        self.working(f"{doing}: {sentence}")
        self._journal.beat(doing, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def late(self, sentence: str, begun: datetime) -> None:
        """Say, from another thread, that a step takes longer than it should: the run's own thread waits for it."""
        beat_beside(self._journal.path, "late", sentence, begun + timedelta(seconds=TRY_S))

    def end(self, how: str, sentence: str) -> None:
        """Note why the run is over; a disk that cannot take that is told of already."""
        self._notify(how, sentence)
        self._life.end(how, sentence)
        with suppress(StorageError):
            self._journal.note(self._clock.now(), how, sentence)

    def _notify(self, event: str, sentence: str) -> None:
        self._notices.tell(event, sentence, datetime.now(UTC))

    def close(self) -> None:
        """Let the last notices be delivered."""
        self._notices.close()
        self._life.close()
