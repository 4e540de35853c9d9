"""From LAB.toml to a session on disk: creates it or takes it up, opens the rig, hands both to the sequencer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from acquisition.chart.model import load_chart
from acquisition.config import LabSettings, parse_lab
from acquisition.lights.illuminations import load_illuminations
from acquisition.run.rig.opening import open_rig
from acquisition.run.sequencer import RunOutcome, take_session
from acquisition.session.folder import Session, session_exists
from acquisition.session.plan import plan_steps
from foundation.console import Ending
from foundation.errors import ConfigurationError

FIXED = (
    "rig", "camera", "simulated.body", "simulated.camera", "simulated.seed", "simulated.room",
    "sequence.reference_every",
)  # fmt: skip
"""Settings that must stay for a whole session: they decide what its frames show."""


def run_session(
    settings: LabSettings,
    folder: Path,
    observe: Callable[[int, int], None],
    announce: Callable[[str], None] = lambda sentence: None,
    retake: str | None = None,
    ending: Ending | None = None,
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
    ending
        By which the run learns that it is to end after the running frame.

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

        with open_rig(settings, session.chart, session) as devices:
            return take_session(
                session,
                devices,
                settings,
                observe=lambda taken: observe(total - taken.left, total),
                announce=announce,
                ending=ending,
            )


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
            _require_same(session, settings)
        except BaseException:
            session.close()
            raise
        return session
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    sequence = settings.sequence
    seed = sequence.seed if sequence.order == "shuffled" else None
    steps = plan_steps(lights, sequence.reference_every, seed=seed)
    return Session.create(folder, settings.to_toml(), chart, lights, steps)


def _require_same(session: Session, settings: LabSettings) -> None:
    before = parse_lab(session.settings_text(), str(session.folder / "session.toml"))
    for key in FIXED:
        old, new = _value(before, key), _value(settings, key)
        if old != new:
            raise ConfigurationError(
                f"{session.folder} was begun with {key} = {old!r}, {settings.file} says {new!r}; "
                "put the old value back, or name a new session folder"
            )
    if load_chart(settings.chart).sha256 != session.chart.sha256:
        raise ConfigurationError(
            f"{session.folder} was begun with another chart than {settings.chart}; name that, or a new session folder"
        )
    if load_illuminations(settings.illuminations) != session.illuminations:
        raise ConfigurationError(
            f"{session.folder} was begun with other lights than {settings.illuminations}; "
            "name those, or a new session folder"
        )


def _value(settings: LabSettings, key: str) -> Any:
    value: Any = settings.model_dump()
    for part in key.split("."):
        value = value[part]
    return value
