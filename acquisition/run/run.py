"""From LAB.toml to a session on disk: creates it or takes it up, opens the rig, hands both to the sequencer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from acquisition.chart.model import load_chart
from acquisition.config import LabSettings
from acquisition.lights.illuminations import load_illuminations
from acquisition.run.planning.work import planned_steps, require_same
from acquisition.run.rig.opening import open_rig
from acquisition.run.sequencer import RunOutcome, take_session
from acquisition.session.folder import Session, session_exists


def run_session(
    settings: LabSettings,
    folder: Path,
    observe: Callable[[int, int], None],
    announce: Callable[[str], None] = lambda sentence: None,
    retake: str | None = None,
) -> RunOutcome:
    """Take the session `folder`, new or interrupted, with the rig that the settings name.

    Parameters
    ----------
    observe
        Called with frames done and in all, once at the start and after each frame.
    announce
        Called with a sentence when the run waits, tries again, pauses and goes on.
    retake
        What to take again (`Session.retake`); nothing if None.

    Raises
    ------
    InputError
        The settings are not those that the session was begun with, or the folder holds something else.
    DeviceError, StorageError
        See `acquisition.run.sequencer.take_session`; the session can be taken up again.
    """
    with open_session(settings, folder) as session:
        if retake is not None:
            session.retake(retake)
        total = len(session.steps)
        done = len(session.done_steps())
        observe(done, total)
        if done == total:
            return RunOutcome(total, 0, ())

        def count(step: object, accepted: bool) -> None:
            nonlocal done
            done += accepted
            observe(done, total)

        with open_rig(settings, session.chart, session) as devices:
            return take_session(session, devices, settings, count, announce)


def open_session(settings: LabSettings, folder: Path) -> Session:
    """Open the session `folder`, after making it if it is not there.

    Raises
    ------
    InputError
        As `run_session`.
    """
    if session_exists(folder):
        session = Session.open_for_run(folder)
        try:
            require_same(session, settings)
        except BaseException:
            session.close()
            raise
        return session
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    return Session.create(folder, settings.to_toml(), chart, lights, planned_steps(settings, lights))
