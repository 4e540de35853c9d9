"""What is said of a frame: the things looked at, each with its number, its limits and its reason, and what follows.

Values only, and the contract of whoever judges. What is measured, and by which limits, is the judge's affair; the
journal keeps a judgement whole, so that every refusal can be read again with its numbers, and so that a run that is
taken up again knows what the frames before looked like.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

from experiment.session.plan import SessionStep


@dataclass(frozen=True)
class Check:
    """One thing looked at in a frame.

    - `name`: what was looked at: "exposure", "light", "movement", "dark", "file", "screen" and so on.
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
    """A judge that wants to be told of pauses of a run."""

    def after_pause(self) -> None:
        """Take in that the run paused for something lasting, and that what is judged next ties it to what was before.

        Called when everything that was taken before is judged, and when nothing is being judged.
        """
        ...
