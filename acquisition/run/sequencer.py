"""Take the frames of a session: make the devices ready, let the pipeline take what is open, and say how it ended.

Knows devices by contract only. The plan is a value, why a run ended is a value; what has been taken stays taken
whatever happens, and a second call goes on where the first stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from acquisition.config import LabSettings
from acquisition.judge.exposure import ExposureJudge
from acquisition.run.agenda import Agenda, unclosed_kinds
from acquisition.run.devices import Devices
from acquisition.run.lamp import make_ready
from acquisition.run.patience import Patience
from acquisition.run.pipeline import Pipeline, Taken
from acquisition.run.saving import Saver
from acquisition.session.folder import Session
from acquisition.session.heartbeat import RunState
from acquisition.session.judgement import FrameJudge
from acquisition.session.records import ACCEPTED, VOIDED
from drivers.camera import keep_awake
from foundation.console import Ending
from foundation.errors import StorageError


@dataclass(frozen=True)
class RunOutcome:
    """Why a run ended.

    Attributes
    ----------
    total, left
        Steps of the plan, and those without an accepted frame.
    refused
        Why steps were left for the next run, a sentence each.
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
) -> RunOutcome:
    """Take every step of the session's plan that has no accepted frame yet.

    Parameters
    ----------
    session
        Opened for a run.
    judge
        Looks at every frame; None looks at its exposure alone.
    observe
        Called with each frame when its verdict is known, in the order of taking.
    announce
        Called with a sentence when a frame is refused, and when the run waits, tries again, pauses and goes on.
    state
        Called every few seconds of a wait with what is waited for and how long; the newest holds.
    ending
        By which the run learns that it is to end after the running frame; None for a run that nobody asks.

    Raises
    ------
    DeviceError, StorageError
        A device or the disk failed for longer than `sequence.patience_s`; the session can be taken up again.
    QualityError
        Frames were refused for that long; likewise.
    KeyboardInterrupt
        The end was asked for by `ending`; the frames that were under way are in the journal.
    """
    clock, journal = devices.clock, session.journal

    def report(what: str, sentence: str, /) -> None:
        announce(f"{what}: {sentence}")
        if what != VOIDED:  # the journal notes that with the rows that it changes
            journal.note(clock.now(), what, sentence)

    def beat(what: str, sentence: str, within_s: float, /) -> None:
        doing: RunState = "paused" if what == "paused" else "waiting" if what == "waiting" else "running"
        journal.beat(doing, sentence, datetime.now(UTC) + timedelta(seconds=within_s))
        if doing != "running":
            state(sentence)

    patience = Patience(clock, settings.sequence.patience_s, report, lambda: keep_awake(devices.camera), beat)
    asked = ending or Ending()
    for stray in session.set_aside_strays():
        report("stray", f"{stray.name}: complete, but not in the journal; kept, not used")
    total = len(session.steps)
    taken = [attempt.kind for attempt in journal.attempts() if attempt.verdict == ACCEPTED]
    agenda = Agenda(session.steps, session.done_steps(), settings.sequence.attempts, unclosed=unclosed_kinds(taken))
    if not len(agenda):
        return RunOutcome(total, 0, ())
    journal.note(clock.now(), "start", f"{len(agenda)} of {total} frames to take")
    devices.camera.configure(settings.camera.exposure)
    used = judge or ExposureJudge(settings)
    for step, _, measurement, accepted in journal.measurements():
        used.recall(step, measurement, accepted)
    try:
        if devices.projector is not None:
            make_ready(devices.projector, settings.sequence, patience)
        with Saver(session, used) as saver:
            Pipeline(session, devices, settings, agenda, saver, patience, observe, asked).run()
    except BaseException:
        # It is derived, and made anew at the next opening: the fault that is there counts.
        with suppress(StorageError):
            session.write_frames_csv()
        raise
    session.write_frames_csv()
    outcome = RunOutcome(total, len(agenda), agenda.given_up)
    if outcome.complete and settings.sequence.switch_off and devices.projector is not None:
        devices.projector.switch_off()
    journal.note(clock.now(), "complete" if outcome.complete else "incomplete", f"{outcome.left} frames left")
    if asked.asked and not outcome.complete:
        raise KeyboardInterrupt
    return outcome
