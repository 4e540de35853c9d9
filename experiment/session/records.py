"""A session as values: its plan, and what its journal keeps of attempts, frames, events and verdicts.

What is measured, and by which limits, is the affair of whoever judges (`FrameJudge`); the journal keeps a judgement
whole, so that every refusal can be read again with its numbers, and a run that is taken up again knows what the frames
before looked like.
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
from experiment.lights import Illumination

ACCEPTED = "accepted"  # Verdict of a frame that may be used

REFUSED = "refused"  # Verdict of a frame that is there and cannot be used

FAILED = "failed"  # Verdict of an attempt that gave no frame

VOIDED = "voided"  # Verdict of a frame that was accepted and must not be used: what was found out later says why


DOUBT = "doubt"  # The event that tells what stops nothing, and is to be seen in the morning

# Attempts by which the time left is told: enough that retakes and references do not sway their median, few enough to
# follow a change of the settings.
RECENT = 50


@dataclass(frozen=True)
class Check:
    """One thing looked at in a frame.

    - `name`: what was looked at: "movement", "file", "screen"; what is a figure of a table has its name.
    - `value`: what was found, in `unit`; None if it cannot be told in a number.
    - `low`, `high`: limits of `value`; None where that side is open.
    - `unit`: "%", "px", "DN"; empty for a pure number.
    - `reason`: empty if the frame passed. Else the cause and its remedy, one sentence.
    """

    name: str
    value: float | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    reason: str = ""

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return not self.reason

    @property
    def is_beyond(self) -> bool:
        """Whether the value lies outside its limits: it may follow from another check's cause, or be followed."""
        if self.value is None:
            return False
        return (self.low is not None and self.value < self.low) or (self.high is not None and self.value > self.high)


@dataclass(frozen=True)
class Judgement:
    """What is said of one frame.

    - `checks`: everything that was looked at, in the order in which causes are to be named.
    - `seen`: camera RGB of the paper above black, counts; None if it was not measured.
    - `measurement`: what the judge needs of this frame later, opaque to all others.
    - `preview`: the frame as JPEG for the eye; empty if there is none.
    - `voids`: what was taken before cannot be trusted: of a refused reference all since the last good one, of another
      refused frame all since the run began, or since its last pause for something lasting.
    - `lasting`: taking the frame again will not help before somebody has removed the cause.
    """

    checks: tuple[Check, ...]
    seen: tuple[float, float, float] | None = None
    measurement: bytes = b""
    preview: bytes = b""
    voids: bool = False
    lasting: bool = False

    @classmethod
    def of_reason(cls, name: str, reason: str | None) -> Judgement:
        """Return the judgement of a single check without a number; the frame is accepted if the reason is None."""
        return cls((Check(name, reason=reason or ""),))

    @property
    def accepted(self) -> bool:
        """Whether the frame may be used: no check has a reason against it."""
        return all(check.passed for check in self.checks)

    @property
    def reason(self) -> str:
        """The first reason against the frame; empty if it is accepted."""
        return next((check.reason for check in self.checks if check.reason), "")


class FrameJudge(Protocol):
    """Judges the frames of a session as they are taken.

    Both methods are called from one thread, never two at once, and in the order in which the frames were taken.
    """

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return what is said of a raw file that is complete on the disk."""
        ...

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Take in a frame of an earlier run: the `measurement` of its judgement, and whether it still counts.

        Called for all of them before the first frame is judged.
        """
        ...


@runtime_checkable
class OutlastsPauses(Protocol):
    """A judge that takes pauses of a run into account."""

    def after_pause(self) -> None:
        """Take in that the run paused for something lasting, and that what is judged next links it to what was before.

        Called when everything that was taken before is judged, and when nothing is being judged.
        """
        ...


@dataclass(frozen=True)
class Attempt:
    """One try at a step as the journal has it.

    Times are those of the lab's clock, None where it has not come so far. The verdict is None while it is under way, or
    if it was cut off.
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
        """Whether a raw file came of it; the name of one that failed may be that of the next try."""
        return self.taken_at is not None


@dataclass(frozen=True)
class AttemptDetails:
    """What a journal keeps of an attempt beside its row.

    - `seen`: camera RGB of the paper above black, counts; None if it was not measured.
    - `checks`: what was looked at, in the judge's order.
    - `timings`: seconds of each part of it, by name.
    """

    seen: tuple[float, float, float] | None = None
    checks: tuple[Check, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict[str, float])


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
class SessionEvent:
    """What happened at some time that is no frame: start, stop, warm-up, a device's fault."""

    at: datetime
    what: str
    detail: str
    number: int


def doubts_of(events: Iterable[SessionEvent]) -> list[str]:
    """Return what stopped no run and is to be seen in the morning, each once, in the order of the events."""
    return list(dict.fromkeys(event.detail for event in events if event.what == DOUBT))


def last_moment(attempts: Iterable[Attempt]) -> datetime | None:
    """Return when the last of those attempts was over that gave a frame; None where none did."""
    ends = (attempt.ended_at for attempt in attempts if attempt.has_frame and attempt.ended_at is not None)
    return max(ends, default=None)


def preview_path(folder: Path, file: str) -> Path:
    """Return where the preview of a raw file is, if there is one; `folder` is the session, `file` as in the journal.

    Only the name of `file` counts, so that no row of a journal leads out of `previews/`.
    """
    return folder / "previews" / f"{Path(file).stem}.jpg"


@dataclass(frozen=True)
class TimedAttempt:
    """How long after the one before an attempt came, seconds, None behind a pause; and whether it gave its frame."""

    seconds: float | None
    gained: bool


def time_left(attempts: Iterable[TimedAttempt], left: int) -> float | None:
    """Return how long the frames that are left will take, seconds; None while that is unknown.

    Each frame costs as many attempts as frames have cost lately, retakes and references included; each attempt the
    median interval, so that a pause does not count for ever.

    `attempts`: those that are judged, oldest first; the newest `RECENT` count.

    Examples
    --------
    >>> night = [TimedAttempt(seconds, gained=seconds != 7) for seconds in (None, 5, 300, 5, 7, 7)]
    >>> time_left(night, left=10)
    105.0
    """
    if not left:
        return 0.0
    recent = deque(attempts, RECENT)
    intervals = [attempt.seconds for attempt in recent if attempt.seconds is not None]
    gained = sum(attempt.gained for attempt in recent)
    if not intervals or not gained:
        return None
    return statistics.median(intervals) * len(recent) / gained * left


def duration_text(seconds: float | None) -> str:
    """Return seconds as ``2 h 05 min``, ``3 min 20 s`` or ``45 s``; ``unknown`` for None."""
    if seconds is None:
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


# What a frame shows: one of the planned lights, full white, the picture's black, or a colour by which the projector
# is known. Frames of the last kind are looked at while a session is taken, and never part of a table.
FrameKind = Literal["light", "white", "dark", "response"]

KINDS: tuple[FrameKind, ...] = get_args(FrameKind)  # Every kind, as journals name them

REFERENCES: tuple[FrameKind, ...] = ("white", "dark")  # Kinds of frames that lights are held against

# Highest code of a response frame; 255 is left to white and to the lights, so that none is taken for one of them.
TOP = 250

PRIMARIES = (Colour(TOP, 0, 0), Colour(0, TOP, 0), Colour(0, 0, TOP))  # The projector's red, green and blue, each alone

MIDDLE = 136  # Code of a quarter of the light, at which each primary's own curve is compared with that of grey

# What a session shows first so that the light of any codes can be predicted: the primaries; greys that give the curve
# from codes to light; pairs of primaries, for what light is added where they overlap; and each primary at half code,
# for what its curve has of its own. The steps are chosen: even in code, and closer where the curve is steep in
# proportion.
RESPONSE = (
    *PRIMARIES,
    *(Colour(code, code, code) for code in (TOP, 232, 208, 184, 160, 136, 112, 88, 64, 48, 32, 16)),
    *(Colour(TOP, TOP, 0), Colour(TOP, 0, TOP), Colour(0, TOP, TOP)),
    *(Colour(MIDDLE, 0, 0), Colour(0, MIDDLE, 0), Colour(0, 0, MIDDLE)),
)


@dataclass(frozen=True)
class SessionStep:
    """One frame of the plan.

    - `number`: its place in taking order, from 0.
    - `kind`: what it shows.
    - `illumination`: index of its light in `illuminations.csv`; None for frames of other kinds.
    - `colour`: codes that the projector shows, 0 … 255.
    """

    number: int
    kind: FrameKind
    illumination: int | None
    colour: Colour

    @property
    def stem(self) -> str:
        """The file name without suffix, e.g. ``0007_light_005``; sorts in taking order."""
        tail = "" if self.illumination is None else f"_{self.illumination:03d}"
        return f"{self.number:04d}_{self.kind}{tail}"


def plan_steps(
    illuminations: Sequence[Illumination],
    reference_every: int,
    *,
    seed: int | None = None,
    response: Sequence[Colour] = (),
) -> tuple[SessionStep, ...]:
    """Return the whole session as data: a white and a dark frame first, every `reference_every` lights, and last.

    `seed`: shuffles the lights, so that neither time nor a frame that is repeated runs along with colour; the same seed
    gives the same order (numpy's PCG64). None keeps their order.
    """
    steps: list[SessionStep] = []

    def add(kind: FrameKind, illumination: int | None, colour: Colour) -> None:
        steps.append(SessionStep(len(steps), kind, illumination, colour))

    for position, light in enumerate(illuminations if seed is None else _shuffled(illuminations, seed)):
        if position % reference_every == 0:
            add("white", None, WHITE)
            add("dark", None, BLACK)
        if position == 0:
            for colour in response:
                add("response", None, colour)
        add("light", light.index, light.colour)
    add("white", None, WHITE)
    add("dark", None, BLACK)
    return tuple(steps)


def link_steps(first_number: int) -> tuple[SessionStep, ...]:
    """Return what a run that is taken up again shows first, to link it to what was taken before.

    A grey and the primaries, by which the projector is known again, and a white and a dark frame, so that lights lie
    between references of one level of the lamp.
    """
    colours = (Colour(TOP, TOP, TOP), *PRIMARIES)
    shown: list[tuple[FrameKind, Colour]] = [*(("response", colour) for colour in colours), ("white", WHITE)]
    shown.append(("dark", BLACK))
    return tuple(SessionStep(number, kind, None, colour) for number, (kind, colour) in enumerate(shown, first_number))


def _shuffled(illuminations: Sequence[Illumination], seed: int) -> list[Illumination]:
    from numpy.random import PCG64, Generator

    return [illuminations[position] for position in Generator(PCG64(seed)).permutation(len(illuminations))]
