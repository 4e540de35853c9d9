"""What a step of a session goes through, as data: the states, and which may follow which.

The sequencer (`acquisition.run.sequencer`) takes the steps; the journal keeps what must survive a power cut: that an
attempt has begun, and how it ended. `docs/architecture.md` draws the table, and
`tests/acquisition/session/test_states.py` checks that sessions taken in the simulated lab follow it and that each line
of it happens.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class StepState(Enum):
    """Where a step is; the value is the word shown to the reader, and the journal's verdict where there is one."""

    PLANNED = "planned"
    BEGUN = "begun"
    LIT = "lit"
    SETTLED = "settled"
    EXPOSED = "exposed"
    SAVED = "saved"
    JUDGED = "judged"
    ACCEPTED = "accepted"
    REFUSED = "refused"
    FAILED = "failed"
    INTERRUPTED = "interrupted"


UNDER_WAY = (
    StepState.BEGUN,
    StepState.LIT,
    StepState.SETTLED,
    StepState.EXPOSED,
    StepState.SAVED,
    StepState.JUDGED,
)
"""States of an attempt without a verdict, in their order; the journal shows all of them as a row without one."""

ENDS = (StepState.ACCEPTED, StepState.REFUSED, StepState.FAILED, StepState.INTERRUPTED)
"""How an attempt ends. Only an accepted frame is used; every frame whose file is complete is kept."""


@dataclass(frozen=True)
class Transition:
    """One line of the table: `after` follows `before` when `cause` happens."""

    before: StepState
    after: StepState
    cause: str


TRANSITIONS = (
    Transition(StepState.PLANNED, StepState.BEGUN, "the projector is healthy; the journal has a row"),
    Transition(StepState.BEGUN, StepState.LIT, "the presenter shows the step's codes"),
    Transition(StepState.LIT, StepState.SETTLED, "settle_s have passed"),
    Transition(StepState.SETTLED, StepState.EXPOSED, "the camera has released and handed over its raw file"),
    Transition(StepState.EXPOSED, StepState.SAVED, "the file is complete on the disk, hashed and renamed"),
    Transition(StepState.SAVED, StepState.JUDGED, "decoded and measured; the projector asked for its health"),
    Transition(StepState.JUDGED, StepState.ACCEPTED, "nothing is wrong; the journal's row is committed"),
    Transition(StepState.JUDGED, StepState.REFUSED, "the frame or the projector is at fault"),
    Transition(StepState.BEGUN, StepState.FAILED, "the presenter fails"),
    Transition(StepState.SETTLED, StepState.FAILED, "the camera fails"),
    Transition(StepState.EXPOSED, StepState.FAILED, "bytes are missing"),
    Transition(StepState.REFUSED, StepState.BEGUN, "another attempt, now or in the next run"),
    Transition(StepState.FAILED, StepState.BEGUN, "another attempt, now or in the next run"),
    Transition(StepState.INTERRUPTED, StepState.BEGUN, "the next run"),
    Transition(StepState.ACCEPTED, StepState.BEGUN, "the next run finds its file gone or cut"),
    *(Transition(state, StepState.INTERRUPTED, "Ctrl-C, a crash, a power cut") for state in UNDER_WAY),
)
"""Every transition that a step can make."""


def may_follow(before: StepState, after: StepState) -> bool:
    """Return whether the table has a line from `before` to `after`."""
    return any((line.before, line.after) == (before, after) for line in TRANSITIONS)


def may_lead_to(before: StepState, after: StepState) -> bool:
    """Return whether `after` can be the next state that the journal shows after `before`.

    Of an attempt under way the journal shows that it has begun; the states up to its end are passed over.
    """
    reached, waiting = set[StepState](), [before]
    while waiting:
        state = waiting.pop()
        for line in TRANSITIONS:
            if line.before is state and line.after not in reached:
                reached.add(line.after)
                if line.after in UNDER_WAY and line.after is not StepState.BEGUN:
                    waiting.append(line.after)
    return after in reached
