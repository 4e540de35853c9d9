"""What `acquire status` says of a session: whether it lives, how far it is, what was measured last, what went wrong.

It says what the page of `acquire monitor` says, from the same look at the journal, in lines for a terminal and as
values for programs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from acquisition.monitor.view import AttemptView, Head, SessionView, read_session
from experiment.session.folder import Session
from experiment.session.records import ACCEPTED, Check, doubts_of, duration_text
from foundation.errors import CropError, counted

LAST = 5  # Verdicts, and events, that are shown: chosen, a screen has room for them beside the rest


# What marks a value outside its limits that refused no frame.
BEYOND = " (beyond; it follows from another cause, or is followed)"

# What the numbers of the checks are, for who has not read docs/how-to/night-run.md.
MEANINGS = {
    "data": "photosites without counts",
    "clipping": "photosites that are clipped",
    "exposure": "brightest photosites, of saturation",
    "chart": "tags found, or references on a chart without",
    "repeated": "noise of the difference to earlier frames, of that of independent ones",
    "movement": "of the chart, from where it lies at rest",
    "blur": "of the print, softer than in the first white frame",
    "rows": "strips of rows that show what belongs elsewhere",
    "uniformity": "the tile that deviates most from the frame's light",
    "off_codes_deg": "from the light ordered to the one seen",
    "off_brightness": "brighter than foretold from the frames before",
    "stray_share": "light from elsewhere, of white",
    "dark_drift": "change of the light in dark frames, of white",
    "leak_share": "light in the dark frame, of white",
    "white_drift": "brightness of white since the first white frame",
    "additivity": "white beyond the sum of the primaries",
}


def read_status(folder: Path, now: datetime) -> SessionView:
    """Return a session as it stands; one that is complete is opened, too, as who makes a table of it opens it."""
    view = read_session(folder)
    if view.head(now).state == "complete":
        try:
            Session.open(folder).close()
        except CropError as error:
            return replace(view, unreadable=str(error))
    return view


def status_lines(view: SessionView, now: datetime) -> list[str]:
    """Return a session's state for people, line by line."""
    head = view.head(now)
    lines = [
        f"state   {_state(head)}",
        f"frames  {head.done} of {head.total}",
        f"lights  {head.lights_done} of {head.lights_total}",
        f"left    {_left(head)}",
        f"refused {head.refused}, failed {head.failed}, voided {head.voided}",
    ]
    if (drift := _white_drift(view)) is not None:
        lines.append(f"white   {drift:+.2%} since the first white frame")
    lines += _block("doubts", doubts_of(view.events))
    lines += _block("last measured", [check_text(check) for check in _newest_checks(view).values()])
    judged = [attempt for attempt in view.attempts if attempt.verdict is not None]
    lines += _block("last verdicts", [_verdict_text(attempt) for attempt in judged[-LAST:]])
    lines += _block("without an accepted frame", list(_open_reasons(view).values()))
    return lines + _block(
        "last events", [f"{event.at:%Y-%m-%d %H:%M:%S} {event.what}: {event.detail}" for event in view.events[-LAST:]]
    )


def status_json(view: SessionView, now: datetime) -> dict[str, Any]:
    """Return a session's state for programs: the fields of `Head`, and what was measured and refused; times as text."""
    head = view.head(now)
    values = head.to_plain()
    if not head.alive:
        values["remaining_s"] = None
    return values | {
        "name": view.name,
        "white_drift": _white_drift(view),
        "checks": {name: asdict(check) for name, check in _newest_checks(view).items()},
        "without_accepted_frame": _open_reasons(view),
        "doubts": doubts_of(view.events),
        "events": [{"at": event.at.isoformat(), "what": event.what, "detail": event.detail} for event in view.events],
    }


def _state(head: Head) -> str:
    if head.state == "copy":
        return head.sentence
    if not head.sentence or head.sentence.startswith(head.state):
        return head.sentence or head.state
    return f"{head.state}: {head.sentence}"


def _left(head: Head) -> str:
    """Return the time left; none of a run that is not at work."""
    if head.done == head.total:
        return "nothing"
    if not head.alive:
        at_work = "this copy gets none" if head.state == "copy" else "no run is at work"
        return f"{counted(head.total - head.done, 'frame')}; {at_work}"
    ready = f", ready at {head.eta.astimezone():%H:%M}" if head.eta is not None else ""
    return f"{duration_text(head.remaining_s)}{ready}"


def _white_drift(view: SessionView) -> float | None:
    """Return how much brighter the newest accepted white frame is than the first, 0 for equal; None without two."""
    white_steps = {step.number for step in view.steps if step.kind == "white"}
    seen = [
        attempt.seen
        for attempt in view.attempts
        if attempt.step in white_steps and attempt.verdict == ACCEPTED and attempt.seen is not None
    ]
    return sum(seen[-1]) / sum(seen[0]) - 1 if len(seen) > 1 and sum(seen[0]) > 0 else None


def _newest_checks(view: SessionView) -> Mapping[str, Check]:
    return {check.name: check for attempt in view.attempts for check in attempt.checks if check.value is not None}


def _open_reasons(view: SessionView) -> dict[int, str]:
    done = {attempt.step for attempt in view.attempts if attempt.verdict == ACCEPTED}
    return {
        attempt.step: f"{attempt.file}: {attempt.reason}"
        for attempt in view.attempts
        if attempt.reason and attempt.step not in done
    }


def _verdict_text(attempt: AttemptView) -> str:
    return f"{attempt.file}: {attempt.verdict}{': ' if attempt.reason else ''}{attempt.reason}"


def check_text(check: Check) -> str:
    """Return what was found, what is allowed, and what the number is."""
    unit = f" {check.unit}" if check.unit else ""
    sign = "+" if check.low is not None and check.low < 0 else ""
    match check.low, check.high:
        case None, None:
            allowed = "; no limits before more frames tell how it scatters" if check.name == "off_brightness" else ""
        case None, high:
            allowed = f", at most {high:.4g}{unit}"
        case low, None:
            allowed = f", at least {low:.4g}{unit}"
        case low, high:
            allowed = f", {low:+.4g} to {high:+.4g}{unit} allowed"
    meaning = f" ({MEANINGS[check.name]})" if check.name in MEANINGS else ""
    beyond = BEYOND if check.is_beyond and check.passed else ""
    return f"{check.name} {check.value:{sign}.4g}{unit}{allowed}{beyond}{meaning}"


def _block(title: str, lines: list[str]) -> list[str]:
    """Return lines under a title; nothing where there are none."""
    return [f"{title}:", *(f"  {line}" for line in lines)] if lines else []
