"""Data types of a session: its plan, and the attempts, frames, events and verdicts in its journal.

A `FrameJudge` measures frames and applies the limits. The journal contains every judgement with its measured values.
They explain a refusal later, and a resumed run reads the measurements of earlier frames.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal, Protocol, get_args, runtime_checkable

from drivers.presenter import BLACK, WHITE, Colour
from experiment.lights import Illuminant

ACCEPTED = "accepted"  # Verdict of a frame that may be used

REFUSED = "refused"  # Verdict of a complete frame that cannot be used

FAILED = "failed"  # Verdict of an attempt without a frame

VOIDED = "voided"  # Verdict of a frame that was accepted first and must not be used because of a later finding


DOUBT = "doubt"  # Name of an event: a problem that does not stop the run and is reported at its end

# Number of last attempts from which the remaining time is estimated.
RECENT = 50


@dataclass(frozen=True)
class Check:
    """One check of a frame."""

    name: str  # name of the corresponding figure of the look-up table (LUT), or another name, such as "movement"
    value: float | None = None  # result in `unit`; None if the check has no number
    low: float | None = None  # lower limit of `value`; None without limit
    high: float | None = None  # upper limit of `value`; None without limit
    unit: str = ""  # "%", "px", "DN"; empty for a pure number
    reason: str = ""  # cause and remedy of a failure, in one sentence; empty if the frame passed

    @property
    def passed(self) -> bool:
        """Whether the frame passed this check."""
        return not self.reason

    @property
    def is_beyond(self) -> bool:
        """Whether the value is outside its limits. A judge may accept such a value, for example after a pause."""
        if self.value is None:
            return False
        return (self.low is not None and self.value < self.low) or (self.high is not None and self.value > self.high)


@dataclass(frozen=True)
class Judgement:
    """Judgement of one frame."""

    checks: tuple[Check, ...]  # in the order in which causes are reported
    seen: tuple[float, float, float] | None = None  # camera RGB of the paper above black, counts; None if not measured
    measurement: bytes = b""  # data of the judge for later frames, opaque to all others
    preview: bytes = b""  # JPEG of the frame; empty if there is none
    # Whether this frame shows that earlier frames must not be used. If it is a white or dark frame, these are all
    # frames after the last good frame of its kind. If not, these are all frames of the run since its start, or since
    # its last pause for a lasting cause.
    voids: bool = False
    lasting: bool = False  # whether a repetition is useless until somebody has removed the cause

    @classmethod
    def of_reason(cls, name: str, reason: str | None) -> Judgement:
        """Return a judgement with one check and no value; the frame is accepted if `reason` is None."""
        return cls((Check(name, reason=reason or ""),))

    @property
    def accepted(self) -> bool:
        """Whether the frame may be used: all checks passed."""
        return all(check.passed for check in self.checks)

    @property
    def reason(self) -> str:
        """Reason of the first failed check; empty if the frame is accepted."""
        return next((check.reason for check in self.checks if check.reason), "")


class FrameJudge(Protocol):
    """Judges the frames of a session while they are taken.

    Both methods are called from one thread, in the order in which the frames were taken.
    """

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Judge a complete raw file."""
        ...

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Restore a frame of an earlier run from the `measurement` of its judgement.

        It is called for all earlier frames before the first frame is judged. `accepted`: whether the frame is still
        accepted.
        """
        ...


@runtime_checkable
class HandlesPauses(Protocol):
    """A judge that accepts changes of the laboratory during a pause of the run."""

    def after_pause(self) -> None:
        """Prepare for the frames of `link_steps`, which follow a pause for a lasting cause.

        It is called after all earlier frames are judged, and before the next frame is judged.
        """
        ...


@dataclass(frozen=True)
class Attempt:
    """One attempt at a step, as in the journal.

    Times are read from the clock of the laboratory. The time of a stage is None if the attempt did not reach it. The
    verdict is None if the attempt is in progress or was interrupted.
    """

    id: int
    step: int
    kind: FrameKind
    illumination: int | None
    file: str
    started_at: datetime
    ended_at: datetime | None
    taken_at: datetime | None
    verdict: str | None
    reason: str

    @property
    def has_frame(self) -> bool:
        """Whether there is a raw file. If not, the field `file` may name the file of the next attempt."""
        return self.taken_at is not None


@dataclass(frozen=True)
class AttemptDetails:
    """Details of an attempt in other tables of the journal."""

    seen: tuple[float, float, float] | None = None  # camera RGB of the paper above black, counts; None if not measured
    checks: tuple[Check, ...] = ()  # in the order of the judge
    timings: Mapping[str, float] = field(default_factory=dict[str, float])  # seconds of each stage, by name


@dataclass(frozen=True)
class FrameRecord:
    """A frame that was taken and judged: one row of `frames.csv`."""

    kind: FrameKind
    illumination: int | None  # index of the illuminant; None for other kinds
    file: str  # relative to the folder of the session
    sha256: str
    taken_at: datetime
    exposure_s: float
    verdict: str  # "accepted" or "refused: reason", also for a voided frame
    attempt: int = 0  # number of the attempt; frames were taken in this order

    @property
    def accepted(self) -> bool:
        """Whether the frame may be used."""
        return self.verdict == ACCEPTED


@dataclass(frozen=True)
class AcceptedFile:
    """Raw file of an accepted frame."""

    attempt: int
    step: int
    illumination: int | None
    file: str
    size: int
    sha256: str


@dataclass(frozen=True)
class SessionEvent:
    """An event that is not a frame: start, stop, warm-up, failure of a device."""

    at: datetime
    what: str  # name of the event, as in the journal
    detail: str  # sentence
    number: int


def doubts_of(events: Iterable[SessionEvent]) -> list[str]:
    """Return the problems that did not stop the run, each once, in the order of the events."""
    return list(dict.fromkeys(event.detail for event in events if event.what == DOUBT))


def last_frame_time(attempts: Iterable[Attempt]) -> datetime | None:
    """Return the end of the last attempt with a frame; None if there is none."""
    ends = (attempt.ended_at for attempt in attempts if attempt.has_frame and attempt.ended_at is not None)
    return max(ends, default=None)


def preview_path(folder: Path, file: str) -> Path:
    """Return the path of the preview of a raw file in the folder of a session, whether it exists or not."""
    # Only the last part of `file` is used, so that the path is always inside `previews/`.
    return folder / "previews" / f"{Path(file).stem}.jpg"


@dataclass(frozen=True)
class TimedAttempt:
    """Duration and success of an attempt."""

    seconds: float | None  # interval since the previous attempt; None after a pause
    is_accepted: bool  # whether the attempt gave an accepted frame


def time_left(attempts: Iterable[TimedAttempt], remaining_frames: int) -> float | None:
    """Estimate the time for the remaining frames, s; None if it is unknown.

    It is the product of the attempts per accepted frame, the median interval, and the number of remaining frames.

    Parameters
    ----------
    attempts
        Judged attempts, oldest first; only the last `RECENT` are used.
    remaining_frames
        Number of frames that are not taken yet.

    Examples
    --------
    >>> night = [TimedAttempt(seconds, is_accepted=seconds != 7) for seconds in (None, 5, 300, 5, 7, 7)]
    >>> time_left(night, remaining_frames=10)
    105.0
    """
    if not remaining_frames:
        return 0.0
    recent = deque(attempts, RECENT)
    intervals = [attempt.seconds for attempt in recent if attempt.seconds is not None]
    accepted_count = sum(attempt.is_accepted for attempt in recent)
    if not intervals or not accepted_count:
        return None
    return statistics.median(intervals) * len(recent) / accepted_count * remaining_frames


def duration_text(seconds: float | None) -> str:
    """Return seconds as ``2 h 05 min``, ``3 min 20 s`` or ``45 s``; ``unknown`` for None."""
    if seconds is None:
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


# Kind of a frame: an illuminant of the plan, full white, black, or a colour that shows the response of the projector.
# Response frames are used during the session, but not for a LUT.
FrameKind = Literal["light", "white", "dark", "response"]

KINDS: tuple[FrameKind, ...] = get_args(FrameKind)  # All kinds, as in the journal

REFERENCES: tuple[FrameKind, ...] = ("white", "dark")  # Kinds of frames with which frames of illuminants are compared

# Highest code of a response frame. It is below 255, so that response frames differ from white frames and from all
# illuminants.
TOP = 250

# Full red, green and blue of the projector.
PRIMARIES = (Colour(TOP, 0, 0), Colour(0, TOP, 0), Colour(0, 0, TOP))

MIDDLE = 136  # Code with a quarter of the light, at which the response of each primary is compared with grey

# First frames of a session, from which the light of all codes is predicted. Greys show how light depends on the code.
# Pairs of primaries show whether their light adds up. Primaries at `MIDDLE` show whether each responds like grey. Dark
# greys are closer together, because the light of dark codes changes faster, relative to its level. The codes were
# chosen by judgement.
RESPONSE = (
    *PRIMARIES,
    *(Colour(code, code, code) for code in (TOP, 232, 208, 184, 160, 136, 112, 88, 64, 48, 32, 16)),
    *(Colour(TOP, TOP, 0), Colour(TOP, 0, TOP), Colour(0, TOP, TOP)),
    *(Colour(MIDDLE, 0, 0), Colour(0, MIDDLE, 0), Colour(0, 0, MIDDLE)),
)


@dataclass(frozen=True)
class SessionStep:
    """One frame of the plan."""

    number: int  # position in the order of taking, from 0
    kind: FrameKind
    illumination: int | None  # index of the illuminant in `illuminations.csv`; None for other kinds
    colour: Colour  # codes that the projector shows, 0 … 255

    @property
    def stem(self) -> str:
        """File name without extension, for example ``0007_light_005``; sorts in the order of taking."""
        tail = "" if self.illumination is None else f"_{self.illumination:03d}"
        return f"{self.number:04d}_{self.kind}{tail}"


def plan_steps(
    illuminations: Sequence[Illuminant],
    reference_every: int,
    *,
    seed: int | None = None,
    response: Sequence[Colour] = (),
) -> tuple[SessionStep, ...]:
    """Return the plan: a white and a dark frame at the start, every `reference_every` illuminants, and at the end.

    `seed`: seed of a random order of the illuminants (numpy's PCG64), so that time does not correlate with colour; None
    keeps the given order. `response`: colours of the response frames, which follow the first pair.
    """
    steps: list[SessionStep] = []

    def add(kind: FrameKind, illumination: int | None, colour: Colour) -> None:
        steps.append(SessionStep(len(steps), kind, illumination, colour))

    for index, light in enumerate(illuminations if seed is None else _shuffled(illuminations, seed)):
        if index % reference_every == 0:
            add("white", None, WHITE)
            add("dark", None, BLACK)
        if index == 0:
            for colour in response:
                add("response", None, colour)
        add("light", light.index, light.colour)
    add("white", None, WHITE)
    add("dark", None, BLACK)
    return tuple(steps)


def link_steps(first_number: int) -> tuple[SessionStep, ...]:
    """Return the first frames of a resumed run, which make its frames comparable with earlier frames.

    A grey and the primaries measure the response of the projector again. The next illuminants are compared with a new
    white and a new dark frame, because the lamp may have changed during the pause.
    """
    colours = (Colour(TOP, TOP, TOP), *PRIMARIES)
    frames: list[tuple[FrameKind, Colour]] = [*(("response", colour) for colour in colours), ("white", WHITE)]
    frames.append(("dark", BLACK))
    return tuple(SessionStep(number, kind, None, colour) for number, (kind, colour) in enumerate(frames, first_number))


def _shuffled(illuminations: Sequence[Illuminant], seed: int) -> list[Illuminant]:
    from numpy.random import PCG64, Generator

    return [illuminations[position] for position in Generator(PCG64(seed)).permutation(len(illuminations))]
