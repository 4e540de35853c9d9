"""The states of a session step, as a table; `docs/figures.py` draws it for docs/explanation/steps.md."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class StepState(Enum):
    """State of a step; the value is the word shown to the reader, and the verdict in the journal if there is one."""

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


# States before the journal has a row; another step may still come first.
AHEAD = (StepState.PLANNED, StepState.LIT, StepState.SETTLED)

# States of an attempt without a verdict, in their order; in the journal, all are a row without a verdict.
UNDER_WAY = (StepState.BEGUN, StepState.EXPOSED, StepState.FETCHED, StepState.SAVED, StepState.JUDGED)

# Ends of an attempt. Only accepted frames are used; every complete file is kept.
ENDS = (StepState.ACCEPTED, StepState.REFUSED, StepState.FAILED, StepState.INTERRUPTED, StepState.VOIDED)


@dataclass(frozen=True)
class Transition:
    """One transition: `after` follows `before` because of `cause`."""

    before: StepState
    after: StepState
    cause: str


# All transitions of a step.
TRANSITIONS = (
    Transition(StepState.PLANNED, StepState.LIT, "the presenter shows the codes"),
    Transition(StepState.LIT, StepState.SETTLED, "settle_s have passed"),
    Transition(StepState.SETTLED, StepState.BEGUN, "the journal has a row"),
    Transition(StepState.BEGUN, StepState.EXPOSED, "the light may change; the screen was read back"),
    Transition(StepState.EXPOSED, StepState.FETCHED, "the camera has handed over its raw file"),
    Transition(StepState.FETCHED, StepState.SAVED, "the file is complete, hashed and renamed"),
    Transition(StepState.SAVED, StepState.JUDGED, "decoded and measured during the next exposure"),
    Transition(StepState.JUDGED, StepState.ACCEPTED, "no fault; the row is committed"),
    Transition(StepState.JUDGED, StepState.REFUSED, "the frame, the screen or the projector is at fault"),
    Transition(StepState.BEGUN, StepState.FAILED, "the camera fails"),
    Transition(StepState.EXPOSED, StepState.FAILED, "the download fails"),
    Transition(StepState.FETCHED, StepState.FAILED, "the file cannot be written"),
    Transition(StepState.LIT, StepState.PLANNED, "a refused frame or the end comes first"),
    Transition(StepState.SETTLED, StepState.PLANNED, "the end comes first"),
    Transition(StepState.REFUSED, StepState.LIT, "another attempt, now or in the next run"),
    Transition(StepState.FAILED, StepState.LIT, "another attempt without the cause"),
    Transition(StepState.INTERRUPTED, StepState.LIT, "the next run"),
    Transition(StepState.ACCEPTED, StepState.VOIDED, "the next reference is refused, or the file is damaged"),
    Transition(StepState.VOIDED, StepState.LIT, "another attempt, now or in the next run"),
    Transition(StepState.ACCEPTED, StepState.LIT, "the file is lost, or a reference is missing"),
    *(Transition(state, StepState.INTERRUPTED, "Ctrl-C twice, a crash, a power cut") for state in UNDER_WAY),
)
