"""The plan of a session as data: every frame to take, in order, and what a step goes through until it is taken.

The sequencer (`acquisition.run.sequencer`) takes the steps; the journal keeps what must survive a power cut: that an
attempt has begun, and how it ended. `docs/architecture.md` draws the table of transitions, and
`tests/experiment/session/test_states.py` checks that sessions taken in the simulated lab follow it and that each line
of it happens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal, get_args

from drivers.presenter import BLACK, WHITE, Colour
from experiment.lights import Illumination

FrameKind = Literal["light", "white", "dark", "response"]
"""What a frame shows: one of the planned lights, full white, the picture's black, or a colour by which the projector is
known. Frames of the last kind are looked at while a session is taken, and never part of a table."""

KINDS: tuple[FrameKind, ...] = get_args(FrameKind)
"""Every kind, as journals name them."""

REFERENCES: tuple[FrameKind, ...] = ("white", "dark")
"""Kinds of frames that lights are held against."""

TOP = 250
"""Highest code of a response frame; 255 is left to white and to the lights, so that none is taken for one of them."""

PRIMARIES = (Colour(TOP, 0, 0), Colour(0, TOP, 0), Colour(0, 0, TOP))
"""The projector's red, green and blue, each alone."""

MIDDLE = 136
"""Code of a quarter of the light, at which each primary's own curve is compared with that of grey."""

RESPONSE = (
    *PRIMARIES,
    *(Colour(code, code, code) for code in (TOP, 232, 208, 184, 160, 136, 112, 88, 64, 48, 32, 16)),
    *(Colour(TOP, TOP, 0), Colour(TOP, 0, TOP), Colour(0, TOP, TOP)),
    *(Colour(MIDDLE, 0, 0), Colour(0, MIDDLE, 0), Colour(0, 0, MIDDLE)),
)
"""What a session shows first so that the light of any codes can be predicted: the primaries; greys that give the curve
from codes to light; pairs of primaries, for what light is added where they overlap; and each primary at half code, for
what its curve has of its own. The steps are chosen: even in code, and closer where the curve is steep in proportion."""


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


def link_steps(first_number: int, *, response: bool = True) -> tuple[SessionStep, ...]:
    """Return what a run that is taken up again shows first, to link it to what was taken before.

    A grey and the primaries, by which the projector is known again, and a white and a dark frame, so that lights lie
    between references of one level of the lamp.
    """
    colours = (Colour(TOP, TOP, TOP), *PRIMARIES) if response else ()
    shown: list[tuple[FrameKind, Colour]] = [*(("response", colour) for colour in colours), ("white", WHITE)]
    shown.append(("dark", BLACK))
    return tuple(SessionStep(number, kind, None, colour) for number, (kind, colour) in enumerate(shown, first_number))


def _shuffled(illuminations: Sequence[Illumination], seed: int) -> list[Illumination]:
    from numpy.random import PCG64, Generator

    return [illuminations[position] for position in Generator(PCG64(seed)).permutation(len(illuminations))]


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


AHEAD = (StepState.PLANNED, StepState.LIT, StepState.SETTLED)
"""States of a step of which the journal shows nothing yet: another may still come before it."""

UNDER_WAY = (StepState.BEGUN, StepState.EXPOSED, StepState.FETCHED, StepState.SAVED, StepState.JUDGED)
"""States of an attempt without a verdict, in their order; the journal shows all of them as a row without one."""

ENDS = (StepState.ACCEPTED, StepState.REFUSED, StepState.FAILED, StepState.INTERRUPTED, StepState.VOIDED)
"""How an attempt ends. Only an accepted frame is used; every frame whose file is complete is kept."""


@dataclass(frozen=True)
class Transition:
    """One line of the table: `after` follows `before` when `cause` happens."""

    before: StepState
    after: StepState
    cause: str


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
"""Every transition that a step can make."""
