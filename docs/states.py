"""The states that a step of a session goes through, as a table, of which docs/explanation/steps.md has the drawing.

`docs/figures.py` draws it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class StepState(Enum):
    """Where a step is; the value is the word shown to the reader, and the journal's verdict where there is one."""

    PLANNED = "planned"
    LIT = "lit"
    SETTLED = "settled"
    BEGUN = "begun"
    EXPOSED = "exposed"
    FETCHED = "fetched"
    SAVED = "saved"
    JUDGED = "judged"
    ACCEPTED = "accepted"
    REFUSED = "refused"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    VOIDED = "voided"


# States of a step of which the journal shows nothing yet: another may still come before it.
AHEAD = (StepState.PLANNED, StepState.LIT, StepState.SETTLED)

# States of an attempt without a verdict, in their order; the journal shows all of them as a row without one.
UNDER_WAY = (StepState.BEGUN, StepState.EXPOSED, StepState.FETCHED, StepState.SAVED, StepState.JUDGED)

# How an attempt ends. Only an accepted frame is used; every frame whose file is complete is kept.
ENDS = (StepState.ACCEPTED, StepState.REFUSED, StepState.FAILED, StepState.INTERRUPTED, StepState.VOIDED)


@dataclass(frozen=True)
class Transition:
    """One line of the table: `after` follows `before` when `cause` happens."""

    before: StepState
    after: StepState
    cause: str


# Every transition that a step can make.
TRANSITIONS = (
    Transition(StepState.PLANNED, StepState.LIT, "the presenter shows the codes"),
    Transition(StepState.LIT, StepState.SETTLED, "settle_s have passed"),
    Transition(StepState.SETTLED, StepState.BEGUN, "the journal has a row"),
    Transition(StepState.BEGUN, StepState.EXPOSED, "the light may change; the screen was read back"),
    Transition(StepState.EXPOSED, StepState.FETCHED, "the camera has handed over its raw file"),
    Transition(StepState.FETCHED, StepState.SAVED, "it is complete on the disk, hashed and renamed"),
    Transition(StepState.SAVED, StepState.JUDGED, "decoded and measured, beside the next exposure"),
    Transition(StepState.JUDGED, StepState.ACCEPTED, "nothing is wrong; the row is committed"),
    Transition(StepState.JUDGED, StepState.REFUSED, "the frame, the screen or the projector is at fault"),
    Transition(StepState.BEGUN, StepState.FAILED, "the camera fails"),
    Transition(StepState.EXPOSED, StepState.FAILED, "the frame cannot be fetched"),
    Transition(StepState.FETCHED, StepState.FAILED, "the disk does not take it"),
    Transition(StepState.LIT, StepState.PLANNED, "a refused light, or the end, comes first"),
    Transition(StepState.SETTLED, StepState.PLANNED, "the end comes first"),
    Transition(StepState.REFUSED, StepState.LIT, "another attempt, now or in the next run"),
    Transition(StepState.FAILED, StepState.LIT, "another attempt, when its cause is gone"),
    Transition(StepState.INTERRUPTED, StepState.LIT, "the next run"),
    Transition(StepState.ACCEPTED, StepState.VOIDED, "the next reference is refused, or the file damaged"),
    Transition(StepState.VOIDED, StepState.LIT, "another attempt, now or in the next run"),
    Transition(StepState.ACCEPTED, StepState.LIT, "its file is gone, or lights want a reference"),
    *(Transition(state, StepState.INTERRUPTED, "Ctrl-C twice, a crash, a power cut") for state in UNDER_WAY),
)
