"""The rows of a session's journal as values: frames that count, attempts, events, and the words of verdicts.

And where the preview is that belongs to a row.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from experiment.session.plan import FrameKind

ACCEPTED = "accepted"
"""Verdict of a frame that may be used."""

REFUSED = "refused"
"""Verdict of a frame that is there and cannot be used."""

FAILED = "failed"
"""Verdict of an attempt that gave no frame."""

VOIDED = "voided"
"""Verdict of a frame that was accepted and must not be used: what was found out later says why."""


@dataclass(frozen=True)
class FrameRecord:
    """A frame that counts as taken and judged; the row of `frames.csv`.

    `file` is relative to the session's folder; `illumination` is None but for lights; `verdict` is
    ``accepted`` or ``refused: reason``, also of a frame that was accepted at first; `attempt` is its number in the
    journal, by which frames are in the order taken whatever a clock said.
    """

    kind: FrameKind
    illumination: int | None
    file: str
    sha256: str
    taken_at: datetime
    exposure_s: float
    verdict: str
    attempt: int = 0

    @property
    def accepted(self) -> bool:
        """Whether the frame may be used."""
        return self.verdict == ACCEPTED


@dataclass(frozen=True)
class AcceptedFile:
    """The raw file of an accepted frame: of which attempt, step and light, its name in the session, its bytes."""

    attempt: int
    step: int
    illumination: int | None
    file: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Attempt:
    """One try at a step as the journal has it.

    `verdict` is None while it is under way, or if it was cut off; `has_frame` is whether a raw file came of it.
    """

    id: int
    step: int
    kind: FrameKind
    illumination: int | None
    file: str
    started_at: datetime
    ended_at: datetime | None
    verdict: str | None
    reason: str
    has_frame: bool


def last_moment(attempts: Iterable[Attempt]) -> datetime | None:
    """Return when the last of those attempts was over that gave a frame; None where none did."""
    ends = (attempt.ended_at for attempt in attempts if attempt.has_frame and attempt.ended_at is not None)
    return max(ends, default=None)


@dataclass(frozen=True)
class SessionEvent:
    """What happened at some time that is no frame: start, stop, warm-up, a device's fault."""

    at: datetime
    what: str
    detail: str


def preview_path(folder: Path, file: str) -> Path:
    """Return where the preview of a raw file is, if there is one; `folder` is the session, `file` as in the journal.

    Only the name of `file` counts, so that no row of a journal leads out of `previews/`.
    """
    return folder / "previews" / f"{Path(file).stem}.jpg"
