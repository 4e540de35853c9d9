"""Take the frames of a plan, one after another: show the light, settle, release, save, judge, and journal it.

Knows devices by contract only. The plan is a value, why a run ended is a value; what has been taken stays taken
whatever happens, and a second call goes on where the first stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from acquisition.config import LabSettings
from acquisition.judge.exposure import judge_file
from acquisition.run.devices import Devices
from acquisition.run.lamp import await_health, health_fault, make_ready
from acquisition.run.patience import Patience
from acquisition.session.folder import Session
from acquisition.session.judgement import Judgement
from acquisition.session.plan import SessionStep
from drivers.camera import keep_awake
from foundation.errors import DeviceError, DeviceFault, DeviceRefused

REFUSED_IN_A_ROW = 3
"""Steps refused one after another that end a run: something lasting is wrong."""


@dataclass(frozen=True)
class RunOutcome:
    """Why a run ended: `left` steps are without an accepted frame; `refused` says why, one line a step."""

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
    observe: Callable[[SessionStep, bool], None] = lambda step, accepted: None,
    announce: Callable[[str], None] = lambda sentence: None,
) -> RunOutcome:
    """Take every step of the session's plan that has no accepted frame yet.

    Parameters
    ----------
    observe
        Called after each step with whether it got an accepted frame.
    announce
        Called with a sentence when the run waits, tries again, pauses and goes on.

    Raises
    ------
    DeviceError
        A device failed beyond the allowed attempts; the session can be taken up again.
    StorageError
        The disk is full; likewise.
    """
    try:
        return _take(session, devices, settings, observe, announce)
    finally:
        session.write_frames_csv()


def _take(
    session: Session,
    devices: Devices,
    settings: LabSettings,
    observe: Callable[[SessionStep, bool], None],
    announce: Callable[[str], None],
) -> RunOutcome:
    clock = devices.clock
    for stray in session.set_aside_strays():
        session.journal.note(clock.now(), "stray", f"{stray.name}: complete, but not in the journal; kept, not used")
    steps = session.steps
    done = session.done_steps()
    open_steps = [step for step in steps if step.number not in done]
    if not open_steps:
        return RunOutcome(len(steps), 0, ())
    session.journal.note(clock.now(), "start", f"{len(open_steps)} of {len(steps)} frames to take")
    devices.camera.configure(settings.camera.exposure)

    def report(what: str, sentence: str) -> None:
        session.journal.note(clock.now(), what, sentence)
        announce(f"{what}: {sentence}")

    patience = Patience(clock, settings.sequence.patience_s, report, lambda: keep_awake(devices.camera))
    if devices.projector is not None:
        make_ready(devices.projector, settings.sequence, patience)
    refused: list[str] = []
    taken = 0
    in_a_row = 0
    for step in open_steps:
        reason = _take_step(session, step, devices, settings, patience)
        observe(step, reason is None)
        if reason is None:
            taken += 1
            if step.kind != "dark":  # a dark frame is accepted where no light reaches the chart, too
                in_a_row = 0
            continue
        refused.append(f"{_name(step)}: {reason}")
        in_a_row += 1
        if in_a_row == REFUSED_IN_A_ROW:
            break
    outcome = RunOutcome(len(steps), len(open_steps) - taken, tuple(refused))
    if outcome.complete and settings.sequence.switch_off and devices.projector is not None:
        devices.projector.switch_off()
    session.journal.note(clock.now(), "complete" if outcome.complete else "incomplete", f"{outcome.left} frames left")
    return outcome


def _take_step(
    session: Session, step: SessionStep, devices: Devices, settings: LabSettings, patience: Patience
) -> str | None:
    """Try a step until its frame is accepted; return None then, else the last refusal."""
    clock = devices.clock
    reason: str | None = None
    for remaining in reversed(range(settings.sequence.attempts)):
        if devices.projector is not None:
            await_health(devices.projector, settings.sequence, patience)
        kept = session.journal.kept_files(step)
        stem = step.stem if kept == 0 else f"{step.stem}_try{kept + 1}"
        attempt = session.journal.begin(step, f"frames/{stem}", clock.now())
        try:
            devices.presenter.show(step.colour)
            clock.sleep(settings.sequence.settle_s)
            received = session.receive(stem, devices.camera.capture)
        except DeviceError as error:
            session.journal.fail(attempt, clock.now(), str(error))
            if remaining == 0 or isinstance(error, DeviceFault | DeviceRefused):
                raise
            patience.report("retry", f"{_name(step)}: {error}")
            continue
        fault = health_fault(devices.projector)
        reason = judge_file(received.path, step.kind, settings) or (None if fault is None else str(fault))
        session.commit(
            attempt,
            received,
            Judgement.of_reason("exposure", reason),
            exposure_s=settings.camera.shutter_s,
            ended_at=clock.now(),
        )
        if reason is None:
            return None
    return reason


def _name(step: SessionStep) -> str:
    return f"light {step.illumination}" if step.illumination is not None else f"{step.kind} frame {step.number}"
