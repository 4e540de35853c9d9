"""The plan of a run as text, a line for each thing that is planned, asked, doubted or wrong."""

from __future__ import annotations

from collections import Counter

from acquisition.run.planning.answers import Answers
from acquisition.run.planning.plan import RunPlan, is_offered
from acquisition.run.planning.sizes import RETAKEN_SHARE, bytes_text
from acquisition.run.planning.work import Work
from acquisition.run.shutter import holds_whole_turns, period_s, wheel_of
from experiment.config import LabSettings
from experiment.session.plan import KINDS
from experiment.session.records import duration_text
from foundation.errors import counted
from foundation.secret_texts import target_label


def plan_lines(plan: RunPlan) -> tuple[str, ...]:
    """Return the plan as text: in each line what is meant, and what is known of it."""
    work, settings, answers = plan.work, plan.settings, plan.answers
    count = counted(work.left, "frame")
    lines = [
        ("session", f"{work.folder}: {'new' if work.new else 'taken up again'}, {_kinds(work)}"),
        ("order", work.order),
        ("chart", f"{settings.chart}: {work.chart.colour_count} colours, SHA-256 {work.chart.sha256[:16]}"),
        ("lights", f"{settings.illuminations}: {len(work.lights)}, SHA-256 {work.lights_sha256[:16]}"),
        ("exposure", _exposure(plan)),
        ("time", _time(plan, count)),
        ("disk", _disk(plan, count)),
        ("camera", _camera(answers)),
        ("projector", answers.projector or "not under control, or not asked"),
    ]
    if settings.sequence.notify:
        lines.append(("notices", f"to {target_label(settings.sequence.notify)}"))
    lines += [("not asked", sentence) for sentence in answers.unasked]
    lines += [("doubt", sentence) for sentence in plan.doubts]
    lines += [("fault", str(fault)) for fault in plan.faults]
    return tuple(f"{name:<11} {text}" for name, text in lines)


def _exposure(plan: RunPlan) -> str:
    exposure = plan.settings.camera
    said = {
        True: "the body offers this time",
        False: "the body does not offer this time",
        None: "whether the body offers this time is not known",
    }
    offered = said[is_offered(exposure.shutter_s, plan.answers.offered_s)]
    return f"ISO {exposure.iso}, f/{exposure.aperture:g}, {exposure.shutter_s:g} s{_turns(plan.settings)}; {offered}"


def _time(plan: RunPlan, count: str) -> str:
    if not plan.work.left:
        return "nothing is left to take"
    warm_up = f", after {duration_text(plan.warm_up_s)} until the lamp is warm" if plan.warm_up_s else ""
    each = f"{plan.frame_s.value:.2f} s each ({plan.frame_s.basis})"
    return f"{duration_text(plan.time_s)}: {count}, {each}{warm_up}"


def _disk(plan: RunPlan, count: str) -> str:
    free = f"{bytes_text(plan.free_bytes)} free"
    if not plan.work.left:
        return f"nothing needed, {free}"
    return (
        f"{bytes_text(plan.needed_bytes)} needed for {count} of {bytes_text(plan.frame_bytes.value)} "
        f"({plan.frame_bytes.basis}), {RETAKEN_SHARE:.0%} taken again and a reserve; {free}"
    )


def _camera(answers: Answers) -> str:
    if answers.camera is None:
        return "could not be asked"
    text = answers.camera.name
    if answers.camera.serial:
        text += f", serial number {answers.camera.serial}"
    supplies = answers.supplies
    if supplies is None:
        return text
    if supplies.mains:
        text += ", on mains power"
    elif supplies.battery is not None:
        text += f", battery {supplies.battery:.0%}"
    text += ", frames go to this computer" if supplies.saves_to_host else ", frames stay on its card"
    if supplies.card_free_bytes is not None:
        text += f", card {bytes_text(supplies.card_free_bytes)} free"
    return text


def _kinds(work: Work) -> str:
    todo = Counter(step.kind for step in work.steps if step.number not in work.done)
    parts = ", ".join(f"{todo[kind]} {kind}" for kind in KINDS if todo[kind])
    done = f"{counted(len(work.done), 'frame')} of {len(work.steps)} done"
    return f"{counted(work.left, 'frame')} to take ({parts}); {done}" if work.left else f"complete; {done}"


def _turns(settings: LabSettings) -> str:
    """Return how many turns of the colour wheel, or pictures, an exposure holds; empty where the light is steady."""
    wheel = wheel_of(settings)
    if settings.rig != "lab" and not wheel:
        return ""
    period, unit = period_s(settings), "turn of the colour wheel" if wheel else "picture"
    turns = settings.camera.shutter_s / period
    plural = unit.replace("turn ", "turns ").replace("picture", "pictures")
    if holds_whole_turns(settings.camera.shutter_s, period):
        return f" = {counted(round(turns), unit, plural)}"
    return f" = {turns:.2f} {plural}, which are not whole"
