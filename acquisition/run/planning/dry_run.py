"""A dry run: every device opened and asked, nothing lit, released, shown or written."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from acquisition.run.devices import Devices
from acquisition.run.planning.answers import Answers, ask
from acquisition.run.planning.plan import RunPlan, make_plan
from acquisition.run.planning.sizes import free_bytes_at
from acquisition.run.planning.work import outline, work_left
from acquisition.run.rig.opening import known_frame_bytes, open_rig
from experiment.config import LabSettings
from experiment.session.folder import Session
from foundation.errors import CropError


def dry_run(settings: LabSettings, folder: Path) -> RunPlan:
    """Return the plan of the run that `settings` and `folder` would begin; devices that cannot be opened are faults."""
    with ExitStack() as opened:
        work, session = outline(settings, folder), None
        if not work.new:
            session = opened.enter_context(Session.open(folder))
        try:
            devices = opened.enter_context(open_rig(settings, work.chart, session))
        except CropError as fault:
            return make_plan(settings, work, Answers(faults=(fault,)), free_bytes_at(folder))
        return make_plan(settings, work, ask(devices), free_bytes_at(folder), known_frame_bytes(settings))


def checked_plan(settings: LabSettings, folder: Path, session: Session | None, devices: Devices) -> RunPlan:
    """Return the plan of a run whose devices are open and have not moved.

    `session`: what is taken up; None where a new one is to be made in `folder`.
    """
    work = outline(settings, folder) if session is None else work_left(session, settings)
    plan = make_plan(settings, work, ask(devices), free_bytes_at(folder), known_frame_bytes(settings))
    plan.require()
    return plan
