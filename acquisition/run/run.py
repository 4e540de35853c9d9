"""From LAB.toml to a session on disk: creates it or takes it up, opens the rig, hands both to the sequencer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from acquisition.judge.judge import LiveJudge
from acquisition.monitor.page import write_session_report
from acquisition.run.patience import TRY_S
from acquisition.run.planning.dry_run import checked_plan
from acquisition.run.planning.work import planned_steps, require_same
from acquisition.run.rig.opening import open_rig
from acquisition.run.sequencer import RunOutcome, take_session
from acquisition.run.taking.pipeline import Taken
from acquisition.run.taking.resuming import check_frames, clock_note, require_same_devices, tie, white_first
from experiment.chart.model import load_chart
from experiment.config import LabSettings
from experiment.lights import load_illuminations
from experiment.session.folder import Session, busy_sentence, session_exists
from experiment.session.heartbeat import signs_of_life
from experiment.session.repair import secrets_warning
from foundation.console import Ending
from foundation.errors import CropError, InputError


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

    def checking(done: int, total: int) -> None:
        state(f"checking frame {done} of {total}")

    with ExitStack() as at_last, ExitStack() as opened:
        session = opened.enter_context(_taken_up(settings, folder, announce)) if session_exists(folder) else None
        if session is None and retake is not None:
            raise InputError(f"{folder}: nothing was taken yet that could be taken again; leave --retake out")
        if session is not None:
            if retake is not None:
                session.retake(retake)
            check_frames(session, checking, announce)
            total = len(session.steps)
            if len(session.done_steps()) == total:
                observe(total, total)
                return RunOutcome(total, 0, ())
        chart = load_chart(settings.chart) if session is None else session.chart
        devices = opened.enter_context(open_rig(settings, chart, session))
        checked_plan(settings, folder, session, devices)
        if session is None:
            session = opened.enter_context(_begun(settings, folder))
            session.journal.retry_locked(settings.sequence.patience_s, announce)
        require_same_devices(session, devices, settings)
        if note := clock_note(session, devices.clock):
            announce(note)
        first = tie(session) or white_first(session)
        total = len(session.steps)
        observe(len(session.done_steps()), total)
        # When the screen is dark and the journal at rest.
        at_last.callback(_report, session, announce)
        alive = opened.enter_context(signs_of_life(session.journal.beat, session.journal.heartbeat, TRY_S))

        def count(frame: Taken) -> None:
            alive()
            taken(frame)
            # A reference may have been put behind the plan.
            total = len(session.steps)
            observe(total - frame.left, total)

        judge = LiveJudge(settings, session.chart, session.illuminations)
        return take_session(session, devices, settings, judge, count, announce, state, ending, first)


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
