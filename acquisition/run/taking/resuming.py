"""Taking up a session that was interrupted: are frames, camera and projector those of before, and what ties the halves.

Rules that hold inside:

- Files are held against their hashes before a device is opened: what is damaged is taken again.
- A session has one camera and one projector: a table of two sensors, even of the same model, is a table of none, and
  nothing in the frames says so. There is no option to go on with another one.
- The projector's response is known from frames of its primaries. A run that is taken up shows some of them first, so
  that a chart, a camera or a lamp that changed between the runs is seen before the first light is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from acquisition.run.devices import Devices
from drivers.camera import CameraIdentity
from drivers.projector import ProjectorIdentity
from experiment.config import LabSettings
from experiment.session.folder import Session
from experiment.session.plan import SessionStep, link_steps
from experiment.session.records import ACCEPTED, Attempt, duration_text
from foundation.clock import Clock, SteadyClock
from foundation.errors import DeviceRefused, first_of
from foundation.version import software


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
    names = {"camera": _camera_name(devices.camera.identity())}
    if devices.projector is not None:
        names["projector"] = _projector_name(devices.projector.identity())
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
                f"not make one table; connect the {what} of before, or begin a new session"
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


def _camera_name(body: CameraIdentity) -> str:
    """Return a camera's name; its firmware may be brought up to date between two runs."""
    return f"{body.maker} {body.model}, serial number {body.serial}"


def _projector_name(projector: ProjectorIdentity) -> str:
    """Return a projector's name; what somebody called it in its menu may change."""
    return f"{projector.maker} {projector.model}".strip() or "of an unknown maker"


def tie(session: Session) -> tuple[int, ...]:
    """Put the frames that tie this run to those before into the plan; return the numbers of their steps.

    A set that an earlier run left unfinished is taken again: the chart may have been moved since. Nothing is added
    where nothing was taken yet, or the session does not know its projector by frames of its primaries.
    """
    taken = [attempt for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    if not taken or all(step.kind != "response" for step in session.steps):
        return ()
    ties = link_steps(session.steps[-1].number + 1)
    unfinished = _unfinished(session.steps[-len(ties) :], ties, taken)
    return tuple(step.number for step in unfinished) if unfinished else _added(session, ties)


def white_first(session: Session) -> tuple[int, ...]:
    """Put a white and a dark frame into the plan where no white frame was measured; return the numbers of their steps.

    The frames of journals of version 1 were not measured: the judge would have nothing to hold the first lights
    against. Nothing is added where nothing was taken yet.
    """
    measured = any(step.kind == "white" and accepted for step, _, _, accepted in session.journal.measurements())
    if measured or not session.journal.accepted_files():
        return ()
    return _added(session, link_steps(session.steps[-1].number + 1, response=False))


def _added(session: Session, ties: Sequence[SessionStep]) -> tuple[int, ...]:
    session.add_steps(ties)
    return tuple(step.number for step in ties)


def _unfinished(
    tail: Sequence[SessionStep], ties: Sequence[SessionStep], taken: Sequence[Attempt]
) -> Sequence[SessionStep]:
    """Return the last steps of the plan where they are ties behind which nothing was taken; else nothing."""
    if [(step.kind, step.colour) for step in tail] != [(step.kind, step.colour) for step in ties]:
        return ()
    numbers = {step.number for step in tail}
    done = {attempt.step for attempt in taken if attempt.step in numbers}
    return tail if not done or taken[-1].step in numbers else ()
