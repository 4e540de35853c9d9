"""Text and JSON of `acquire status`, which reports the same as the page of `acquire monitor`."""

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

LAST = 5  # Number of the newest verdicts, and of the newest events, that are shown.


# Text after a value that is beyond its limits, if the check did not refuse the frame.
BEYOND = " (beyond its limit, but not a reason for refusal)"

# Meanings of the checks of docs/reference/judge.md.
MEANINGS = {
    "data": "share of photosites with counts below half of the black level",
    "clipping": "share of clipped photosites",
    "exposure": "level of the brightest photosites, share of saturation",
    "chart": "number of detected tags, or of white references if the chart has no tags",
    "repeated": "share of the noise that is not in an earlier frame; 0 if the camera sent a frame twice",
    "movement": "distance of the chart from its rest position",
    "blur": "blur compared with the first white frame",
    "rows": "number of strips with unexpected content; a strip is a quarter of a row of 2×2 blocks",
    "uniformity": "largest deviation of a region of the frame from the rest",
    "off_codes_deg": "angle between ordered and measured illuminant",
    "off_brightness": "brightness relative to the prediction from earlier frames",
    "stray_share": "light that is not from the projector, share of white",
    "dark_drift": "change of the light in dark frames, share of white",
    "leak_share": "light in the dark frame, share of white",
    "white_drift": "brightness of white relative to the first white frame",
    "additivity": "white relative to the sum of the primaries",
}


def read_status(folder: Path, now: datetime) -> SessionView:
    """Return the view of a session. A complete session is also opened, to detect faults that would stop build-lut."""
    view = read_session(folder)
    if view.head(now).state == "complete":
        try:
            Session.open(folder).close()
        except CropError as error:
            return replace(view, unreadable=str(error))
    return view


def status_lines(view: SessionView, now: datetime) -> list[str]:
    """Return the state of a session as lines for a terminal."""
    head = view.head(now)
    lines = [
        f"state       {_state_text(head)}",
        f"frames      {head.done} of {head.total}",
        f"illuminants {head.lights_done} of {head.lights_total}",
        f"left        {_remaining_text(head)}",
        f"refused     {head.refused}, failed {head.failed}, voided {head.voided}",
    ]
    if (drift := _white_drift(view)) is not None:
        lines.append(f"white       {drift:+.2%} since the first white frame")
    lines += _block("warnings", doubts_of(view.events))
    lines += _block("last measured", [check_text(check) for check in _newest_checks(view).values()])
    judged = [attempt for attempt in view.attempts if attempt.verdict is not None]
    lines += _block("last verdicts", [_verdict_text(attempt) for attempt in judged[-LAST:]])
    lines += _block("without an accepted frame", list(_open_reasons(view).values()))
    return lines + _block(
        "last events", [f"{event.at:%Y-%m-%d %H:%M:%S} {event.what}: {event.detail}" for event in view.events[-LAST:]]
    )


def status_json(view: SessionView, now: datetime) -> dict[str, Any]:
    """Return the state of a session for programs: fields of `Head`, measured values, and refusals. Times are text."""
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


def _state_text(head: Head) -> str:
    if head.state == "copy":
        return head.sentence
    if not head.sentence or head.sentence.startswith(head.state):
        return head.sentence or head.state
    return f"{head.state}: {head.sentence}"


def _remaining_text(head: Head) -> str:
    if head.done == head.total:
        return "none"
    if not head.alive:
        reason = "no run is active in this copy" if head.state == "copy" else "no run is active"
        return f"{counted(head.total - head.done, 'frame')}; {reason}"
    ready = f", ready at {head.eta.astimezone():%H:%M}" if head.eta is not None else ""
    return f"{duration_text(head.remaining_s)}{ready}"


def _white_drift(view: SessionView) -> float | None:
    white_steps = {step.number for step in view.steps if step.kind == "white"}
    whites = [
        attempt.seen
        for attempt in view.attempts
        if attempt.step in white_steps and attempt.verdict == ACCEPTED and attempt.seen is not None
    ]
    return sum(whites[-1]) / sum(whites[0]) - 1 if len(whites) > 1 and sum(whites[0]) > 0 else None


def _newest_checks(view: SessionView) -> Mapping[str, Check]:
    return {check.name: check for attempt in view.attempts for check in attempt.checks if check.value is not None}


def _open_reasons(view: SessionView) -> dict[int, str]:
    accepted_steps = {attempt.step for attempt in view.attempts if attempt.verdict == ACCEPTED}
    return {
        attempt.step: f"{attempt.file}: {attempt.reason}"
        for attempt in view.attempts
        if attempt.reason and attempt.step not in accepted_steps
    }


def _verdict_text(attempt: AttemptView) -> str:
    return f"{attempt.file}: {attempt.verdict}{': ' if attempt.reason else ''}{attempt.reason}"


def check_text(check: Check) -> str:
    """Return value, limits and meaning of a check."""
    unit = f" {check.unit}" if check.unit else ""
    sign = "+" if check.low is not None and check.low < 0 else ""
    match check.low, check.high:
        case None, None:
            allowed = "; no limits until the scatter of the lamp is known" if check.name == "off_brightness" else ""
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
    return [f"{title}:", *(f"  {line}" for line in lines)] if lines else []
