"""Take the frames of a session: make the devices ready, let the pipeline take what is open, and say how it ended.

Knows devices by contract only. The plan is a value, why a run ended is a value; what has been taken stays taken
whatever happens, and a second call goes on where the first stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from acquisition.judge.exposure import ExposureJudge
from acquisition.run.devices import Devices
from acquisition.run.lamp import RunEnd, leave_lab, make_ready
from acquisition.run.notices import Notices
from acquisition.run.pipeline import Job, Pipeline, Saver, Taken
from acquisition.run.queue import StepQueue, unclosed_kinds
from acquisition.run.retry import RetryPolicy
from drivers.camera import keep_awake
from drivers.presenter import BLACK, WHITE
from experiment.config import LabSettings
from experiment.session.folder import Session
from experiment.session.heartbeat import RunState
from experiment.session.plan import FrameKind, SessionStep
from experiment.session.records import ACCEPTED, VOIDED, FrameJudge
from foundation.clock import Clock
from foundation.console import Ending
from foundation.errors import StorageError

NOTIFIED = ("paused", "resumed")
"""Words of a run's reports that are told to whoever is notified; its end is, in any case."""


@dataclass(frozen=True)
class RunOutcome:
    """Why a run ended.

    - `total`, `left`: steps of the plan, and those without an accepted frame.
    - `refused`: why steps were left for the next run, a sentence each.
    """

    total: int
    left: int
    refused: tuple[str, ...]

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
    reports = _Reports(session, devices.clock, announce, state, sequence.notify)
    asked = ending or Ending()
    retry = RetryPolicy(
        devices.clock,
        sequence.patience_s,
        reports.tell,
        lambda: keep_awake(devices.camera),
        reports.sign_of_life,
        asked.at_once,
    )
    try:
        for stray in session.set_aside_strays():
            reports.tell("stray", f"{stray.name}: complete, but not in the journal; kept, not used")
        job = Job(session, devices, settings, _open_steps(session, settings, first), retry)
        if len(job.queue):
            _take_open(job, judge or ExposureJudge(settings), observe, asked)
        outcome = RunOutcome(len(session.steps), len(job.queue), job.queue.given_up)
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


def _take_open(job: Job, judge: FrameJudge, observe: Callable[[Taken], object], ending: Ending) -> None:
    """Make the devices ready, and take what is open."""
    devices, settings, journal = job.devices, job.settings, job.session.journal
    journal.note(devices.clock.now(), "start", f"{len(job.queue)} of {len(job.session.steps)} frames to take")
    devices.camera.configure(settings.camera.exposure)
    for step, _, measurement, accepted in journal.measurements():
        judge.recall(step, measurement, accepted)
    if devices.projector is not None:
        make_ready(devices.projector, settings.sequence, job.retry)
    with Saver(job.session, judge) as saver:
        Pipeline(job, saver, observe, ending).run()


class _Reports:
    """Where words of a run go: terminal, journal, whoever is notified."""

    def __init__(
        self,
        session: Session,
        clock: Clock,
        announce: Callable[[str], object],
        state: Callable[[str], object],
        notify: str,
    ) -> None:
        self._journal = session.journal
        self._clock = clock
        self._announce = announce
        self._state = state
        self._notices = Notices(notify, session.folder.name, announce)

    def tell(self, what: str, sentence: str, /) -> None:
        """Tell what happens."""
        self._announce(f"{what}: {sentence}")
        if what in NOTIFIED:
            self._notices.tell(what, sentence, datetime.now(UTC))
        if what != VOIDED:  # the journal notes that with the rows that it changes
            self._journal.note(self._clock.now(), what, sentence)

    def sign_of_life(self, what: str, sentence: str, within_s: float, /) -> None:
        """Say that the run waits, and for what."""
        doing: RunState = "paused" if what == "paused" else "waiting"
        self._state(sentence)
        self._journal.beat(doing, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def end(self, how: str, sentence: str) -> None:
        """Note why the run is over; a disk that cannot take that is told of already."""
        self._notices.tell(how, sentence, datetime.now(UTC))
        with suppress(StorageError):
            self._journal.note(self._clock.now(), how, sentence)

    def close(self) -> None:
        """Let the last notices be delivered."""
        self._notices.close()
