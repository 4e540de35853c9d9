"""How far a session is, derived from its journal: for the terminal, and for the web page."""

from __future__ import annotations

import statistics
from dataclasses import asdict, dataclass
from datetime import datetime

from acquisition.session.folder import Session
from acquisition.session.records import ACCEPTED, FAILED, REFUSED


@dataclass(frozen=True)
class Progress:
    """A session's state.

    Attributes
    ----------
    total, done
        Frames of the plan, and those taken and accepted.
    lights_total, lights_done
        The same of the lights alone.
    refused, failed
        Attempts whose frame was judged unfit, and attempts that gave no frame.
    refusals
        Of the steps still without an accepted frame: the last reason of each, oldest first.
    seconds_per_frame
        Median time of an accepted attempt by the lab's clock; None before the first.
    last_frame_at
        When the newest frame was released; None before the first.
    """

    total: int
    done: int
    lights_total: int
    lights_done: int
    refused: int
    failed: int
    refusals: tuple[str, ...]
    seconds_per_frame: float | None
    last_frame_at: datetime | None

    @property
    def remaining_s(self) -> float | None:
        """Time left by the lab's clock, seconds; None while it is unknown."""
        return None if self.seconds_per_frame is None else self.seconds_per_frame * (self.total - self.done)

    def as_json(self) -> dict[str, object]:
        """Return the values with their names, times as ISO 8601 text."""
        last = self.last_frame_at.isoformat() if self.last_frame_at else None
        return {**asdict(self), "last_frame_at": last, "remaining_s": self.remaining_s}


def session_progress(session: Session) -> Progress:
    """Return how far `session` is on its plan."""
    steps = session.steps
    done = session.done_steps()
    attempts = session.journal.attempts()
    durations = [
        (attempt.ended_at - attempt.started_at).total_seconds()
        for attempt in attempts
        if attempt.ended_at is not None and attempt.verdict == ACCEPTED
    ]
    last_reason = {
        attempt.step: f"{attempt.file}: {attempt.reason}"
        for attempt in attempts
        if attempt.reason and attempt.step not in done
    }
    frames = session.frames()
    return Progress(
        total=len(steps),
        done=len(done & {step.number for step in steps}),
        lights_total=sum(step.kind == "light" for step in steps),
        lights_done=sum(step.kind == "light" and step.number in done for step in steps),
        refused=sum(attempt.verdict == REFUSED for attempt in attempts),
        failed=sum(attempt.verdict == FAILED for attempt in attempts),
        refusals=tuple(last_reason.values()),
        seconds_per_frame=statistics.median(durations) if durations else None,
        last_frame_at=max((frame.taken_at for frame in frames), default=None),
    )


def duration_text(seconds: float | None) -> str:
    """Return seconds as ``2 h 05 min``, ``3 min 20 s`` or ``45 s``; ``unknown`` for None."""
    if seconds is None:
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
