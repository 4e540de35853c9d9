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
from acquisition.run.lamp import make_ready
from acquisition.run.leaving import RunEnd, end_of, leave_lab
from acquisition.run.notices import Notices
from acquisition.run.patience import Patience
from acquisition.run.taking.agenda import Agenda, unclosed_kinds
from acquisition.run.taking.pipeline import Pipeline, Taken
from acquisition.run.taking.saving import Saver
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
    running frame; None for a run that nobody asks.
    """
    notices = Notices(settings.sequence.notify, session.folder.name, announce)
    telling = _Telling(session, devices.clock, announce, state, notices)
    asked = ending or Ending()
    try:
        outcome = _taken(session, devices, settings, judge, observe, telling, asked, first)
        if asked.asked and not outcome.complete:
            raise KeyboardInterrupt
        end = RunEnd.COMPLETE if outcome.complete else RunEnd.UNFINISHED
        leave_lab(devices, end, settings.sequence, telling.report)
    except BaseException as error:
        leave_lab(devices, end_of(error), settings.sequence, telling.report)
        # It is derived, and made anew at the next opening: the fault that is there counts.
        with suppress(StorageError):
            session.write_frames_csv()
        telling.ended(
            "interrupted" if isinstance(error, KeyboardInterrupt) else "ended", str(error) or "by the operator"
        )
        raise
    else:
        session.write_frames_csv()
        left = f"{outcome.left} of {outcome.total} frames left"
        telling.ended("complete" if outcome.complete else "incomplete", "; ".join([left, *outcome.refused]))
    finally:
        notices.close()
    return outcome


class _Telling:
    """Where words of a run go: terminal, journal, whoever is notified."""

    def __init__(
        self,
        session: Session,
        clock: Clock,
        announce: Callable[[str], object],
        state: Callable[[str], object],
        notices: Notices,
    ) -> None:
        self._journal = session.journal
        self._clock = clock
        self._announce = announce
        self._state = state
        self._notices = notices

    def report(self, what: str, sentence: str, /) -> None:
        """Tell what happens."""
        self._announce(f"{what}: {sentence}")
        if what in NOTIFIED:
            self._notices.tell(what, sentence, datetime.now(UTC))
        if what != VOIDED:  # the journal notes that with the rows that it changes
            self._journal.note(self._clock.now(), what, sentence)

    def beat(self, what: str, sentence: str, within_s: float, /) -> None:
        """Leave a sign of life."""
        doing: RunState = "paused" if what == "paused" else "waiting" if what == "waiting" else "running"
        if doing != "running":
            self._state(sentence)
        self._journal.beat(doing, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def ended(self, how: str, sentence: str) -> None:
        """Note why the run is over; a disk that cannot take that is told of already."""
        self._notices.tell(how, sentence, datetime.now(UTC))
        with suppress(StorageError):
            self._journal.note(self._clock.now(), how, sentence)


def _taken(
    session: Session,
    devices: Devices,
    settings: LabSettings,
    judge: FrameJudge | None,
    observe: Callable[[Taken], object],
    telling: _Telling,
    ending: Ending,
    first: Sequence[int],
) -> RunOutcome:
    """Make the devices ready, and take what is open."""
    clock, journal = devices.clock, session.journal
    patience = Patience(
        clock,
        settings.sequence.patience_s,
        telling.report,
        lambda: keep_awake(devices.camera),
        telling.beat,
        ending.at_once,
    )
    for stray in session.set_aside_strays():
        telling.report("stray", f"{stray.name}: complete, but not in the journal; kept, not used")

    def append(kind: FrameKind) -> SessionStep:
        step = SessionStep(session.steps[-1].number + 1, kind, None, WHITE if kind == "white" else BLACK)
        session.add_steps([step])
        return step

    taken = [attempt.kind for attempt in journal.attempts() if attempt.verdict == ACCEPTED]
    attempts = settings.sequence.attempts
    every = settings.sequence.reference_every
    agenda = Agenda(session.steps, session.done_steps(), attempts, first, unclosed_kinds(taken), append, every)
    if not len(agenda):
        return RunOutcome(len(session.steps), 0, ())
    journal.note(clock.now(), "start", f"{len(agenda)} of {len(session.steps)} frames to take")
    devices.camera.configure(settings.camera.exposure)
    used = judge or ExposureJudge(settings)
    for step, _, measurement, accepted in journal.measurements():
        used.recall(step, measurement, accepted)
    if devices.projector is not None:
        make_ready(devices.projector, settings.sequence, patience)
    with Saver(session, used) as saver:
        Pipeline(session, devices, settings, agenda, saver, patience, observe, ending).run()
    return RunOutcome(len(session.steps), len(agenda), agenda.given_up)
