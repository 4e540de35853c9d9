"""The table that decides: each rule is a cause, the figures that it may explain, and what must be known for it.

Rules that hold inside:

- A rule holds where every one of its conditions does; a condition is an interval, both ends included, and what is not
  known lies in none.
- The first rule that holds decides; those that rest on what files say, or dark frames show, stand before those that
  rest on what a deviation looks like.
- Where none holds, the cause is unknown and said to be. A cause that is wrong costs a session; one that is not named
  costs a look at the report. So intervals leave gaps between causes.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

from calibration.causes.cause import (
    ANOTHER_PRINT,
    BUMP,
    CURL,
    DEFOCUS,
    FALL_OFF,
    HOT_PHOTOSITES,
    OBJECT_IN_FRAME,
    OTHER_CAMERA,
    OTHER_EXPOSURE,
    REFLECTION,
    REFLECTION_IN_FRAME,
    ROOM_LIGHT,
    SHADOW,
    SPREAD,
    STAIN,
    UNKNOWN,
    VEIL,
    WRONG_NAME,
    Cause,
)
from calibration.causes.evidence import Evidence

_FAR = math.inf


@dataclass(frozen=True)
class Condition:
    """What must be known: that a value of `Evidence` lies between two numbers, both included."""

    name: str
    low: float
    high: float

    def holds(self, evidence: Evidence) -> bool:
        """Return whether it does; what is not known lies nowhere."""
        return self.low <= getattr(evidence, self.name) <= self.high


@dataclass(frozen=True)
class Rule:
    """One line of the table.

    - `cause`: what is said where it holds.
    - `figures`: the figures that it may explain, by the names of their limits.
    - `conditions`: all of which must hold.
    - `why`: why the cause follows.
    """

    cause: Cause
    figures: frozenset[str]
    conditions: tuple[Condition, ...]
    why: str

    def holds(self, figure: str, evidence: Evidence) -> bool:
        """Return whether it explains a figure by what is known."""
        return figure in self.figures and all(condition.holds(evidence) for condition in self.conditions)


PLACE = frozenset({"unlike_block", "disturbed_cells"})
COVERED = frozenset({"disturbed_cells", "unfit_share"})
ALL_CELLS = frozenset({"unlike_scatter", "softer_bleed", "moved_anew", "noisy_share"})
PRINT = frozenset({"doubtful_share", "unfit_share", "added_light", "reference_spread"})
FOUND = frozenset({"agreement", "blocks_good", "tags_found"})
SHEET = PRINT | {"noisy_share"}
DRIFT = frozenset({"white_drift", "white_drift_deg"})
NAMES = frozenset({"off_codes_deg", "white_frame_deg", "exchanged_lights"})
BRIGHTNESS = frozenset({"off_brightness", "white_frame_brightness", "white_short", "other_exposure"})
LIGHT = NAMES | BRIGHTNESS | {"additivity", "white_drift", "white_drift_deg"}
DARK = frozenset({"leak_share", "dark_drift"})
STRAY = frozenset({"stray_share"})

_IN_ALL_FRAMES = (
    Condition("in_first", 0, 0), Condition("even_showing", 0, 0), Condition("some_whites", 0, 0),
    Condition("frames", 2, _FAR),
)  # fmt: skip
"""A place of the print looks in every frame as in the one registered first."""

_SHARP_PLACE = (Condition("share", 0, 0.5), Condition("scatter", 0, 0.1), Condition("softer", -_FAR, 0.003))
"""What is off lies at one place, and the rest of the frame is as sharp as before."""

_IN_FEW_FRAMES = (
    Condition("in_first", 0, 0), Condition("frames", 3, _FAR), Condition("showing", 1e-9, 0.34),
)  # fmt: skip
"""A place is off in few of the frames, and not in the one that they are compared with."""

RULES: tuple[Rule, ...] = (
    Rule(
        OTHER_CAMERA,
        PLACE | ALL_CELLS | PRINT | LIGHT | DARK | frozenset({"other_camera", "other_lens"}),
        (Condition("cameras", 2, _FAR),),
        "the files name more than one camera or lens",
    ),
    Rule(
        OTHER_EXPOSURE,
        LIGHT,
        (Condition("exposure", 0, 0.97),),
        "the file states less exposure than the others'",
    ),
    Rule(
        OTHER_EXPOSURE,
        LIGHT,
        (Condition("exposure", 1.03, _FAR),),
        "the file states more exposure than the others'",
    ),
    Rule(
        OTHER_EXPOSURE,
        frozenset({"other_iso"}),
        (Condition("other_iso", 1, _FAR),),
        "the file states another ISO speed than the others'",
    ),
    Rule(
        WRONG_NAME,
        LIGHT,
        (Condition("named_right", 0, 0), Condition("exposure", 0.97, 1.03)),
        "its white is not what its own codes give, and is what another light's codes give",
    ),
    Rule(
        ROOM_LIGHT,
        DARK,
        (Condition("room_change", 0.002, _FAR),),
        "what is there in the dark changes between dark frames; the projector's own black does not",
    ),
    Rule(
        ROOM_LIGHT,
        DARK,
        (Condition("room", 0.02, _FAR), Condition("frames", 1, _FAR)),
        "no projector's black is a fiftieth of its white",
    ),
    Rule(
        ROOM_LIGHT,
        STRAY,
        (Condition("stray", 0.004, 0.1),),
        "lights have, or lack, of a primary whose code is 0, what the dark frames do not show",
    ),
    Rule(
        ROOM_LIGHT,
        STRAY,
        (Condition("stray_primaries", 0.004, 0.1),),
        "red, green and blue alone together give more than white, each by as much, under a steady lamp; a projector "
        "that holds full white back would do so too",
    ),
    Rule(
        HOT_PHOTOSITES,
        PLACE | PRINT | frozenset({"noisy_share"}),
        (Condition("hot", 0.5, 1),),
        "most of the cells concerned hold a photosite that stands out in every dark frame",
    ),
    Rule(
        DEFOCUS,
        ALL_CELLS | PLACE,
        (Condition("softer", 0.003, _FAR), Condition("scatter", 0, 0.1)),
        "the tags are softer than in the frame registered first, and cells have their neighbours' light",
    ),
    Rule(
        ANOTHER_PRINT,
        ALL_CELLS | PLACE | FOUND,
        (Condition("scatter", 0.2, _FAR), Condition("softer", -_FAR, 0.012)),
        "the cells' colours are not those of their codes anywhere, though the tags are sharp",
    ),
    Rule(
        ANOTHER_PRINT,
        FOUND,
        (Condition("agreement", -1, 0.5),),
        "cells and chart have nothing in common",
    ),
    Rule(
        BUMP,
        frozenset({"moved_anew"}),
        (Condition("anew", 1e-9, 1), Condition("moved_px", 0.5, _FAR), Condition("softer", -_FAR, 0.003)),
        "the tags lie elsewhere than before, as sharp",
    ),
    Rule(
        OBJECT_IN_FRAME,
        FOUND | SHEET,
        (
            Condition("white_residual", 1e-9, 0.5),
            Condition("deviation", -1, -0.03),
            Condition("share", 0, 0.5),
            Condition("rim_frames", 0, 0.5),
        ),
        "white references are dark at one place in few of the white frames",
    ),
    Rule(
        OBJECT_IN_FRAME,
        PLACE | SHEET | DRIFT,
        (
            Condition("in_first", 1, 1),
            Condition("frames", 4, _FAR),
            Condition("showing", 0.8, 1),
            Condition("share", 0, 0.5),
        ),
        "all frames differ at one place from the one that they are compared with",
    ),
    Rule(
        OBJECT_IN_FRAME,
        frozenset({"unlike_block"}) | SHEET | DRIFT,
        (
            *_IN_FEW_FRAMES,
            Condition("even_showing", 1e-9, 1),
            Condition("deviation", -1, _FAR),
            *_SHARP_PLACE,
        ),
        "one place is off in few frames, a white one among them, and as it should be in the others",
    ),
    Rule(
        OBJECT_IN_FRAME,
        frozenset({"disturbed_cells"}),
        (
            *_IN_FEW_FRAMES,
            Condition("even_showing", 1e-9, 1),
            Condition("deviation", -1, 0),
            *_SHARP_PLACE,
        ),
        "few cells look covered in few frames, a white one among them, and are as they should be in the others",
    ),
    Rule(
        REFLECTION_IN_FRAME,
        PLACE,
        (
            *_IN_FEW_FRAMES,
            Condition("spot", 0, 0.1),
            Condition("deviation", 0, _FAR),
            Condition("added", 0.004, _FAR),
            Condition("kept", 0.9, 1.1),
            *_SHARP_PLACE,
        ),
        "in few frames light is added at one place, and the cells keep their own",
    ),
    Rule(
        OBJECT_IN_FRAME,
        frozenset({"unlike_block"}),
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("kept", -_FAR, 0.85), *_SHARP_PLACE),
        "in few frames cells of one place have light of their own colours less, and all alike",
    ),
    Rule(
        OBJECT_IN_FRAME,
        PLACE | COVERED,
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("deviation", -1, 0), *_SHARP_PLACE),
        "one place is off in few frames, and as it should be in the others and under white",
    ),
    Rule(
        REFLECTION,
        SHEET,
        (
            *_IN_ALL_FRAMES,
            Condition("added", 0.004, _FAR),
            Condition("deviation", 0, _FAR),
            Condition("share", 0, 0.7),
        ),
        "light is added at one place in all frames, so that dark colours gain most",
    ),
    Rule(
        FALL_OFF,
        frozenset({"reference_spread"}),
        (Condition("radial", 0.5, 1), Condition("rim", -1, -0.005), Condition("rim_frames", 0.9, 1)),
        "what the field leaves depends on the distance from the middle alone, and the rim is darker, in all frames",
    ),
    Rule(
        STAIN,
        SHEET,
        (
            *_IN_ALL_FRAMES,
            Condition("deviation", -1, -0.01),
            Condition("added", -0.05, 0.05),
            Condition("kept", 0, 0.99),
            Condition("tint", 0.35, _FAR),
            Condition("share", 0, 0.2),
        ),
        "a place is darker in all frames, in proportion to its light, and more so in one colour",
    ),
    Rule(
        STAIN,
        SHEET,
        (
            Condition("white_residual", 0.9, 1),
            Condition("deviation", -1, -0.03),
            Condition("tint", 0.35, _FAR),
            Condition("share", 0, 0.2),
        ),
        "white references are dark at one place in all white frames, and more so in one colour",
    ),
    Rule(
        SHADOW,
        SHEET,
        (
            *_IN_ALL_FRAMES,
            Condition("deviation", -1, -0.005),
            Condition("added", -0.02, 0.004),
            Condition("kept", 0, 0.995),
            Condition("tint", 0, 0.25),
            Condition("share", 0, 0.5),
        ),
        "a place is darker in all frames, in proportion to its light, in all colours alike",
    ),
    Rule(
        CURL,
        frozenset({"unfit_share"}),
        (Condition("misplaced", 0.5, 1), Condition("waves_px", 0.3, _FAR)),
        "most of the cells concerned lie where their places are not known well enough, and tags lie beside a plane",
    ),
    Rule(
        SPREAD,
        frozenset({"unfit_share", "noisy_share", "bleed"}),
        (Condition("beyond_cell", 0.01, _FAR), Condition("uneven", 0.5, 1)),
        "rim and middle of cells differ, and the print shows that the lens brings light from beyond them",
    ),
    Rule(
        VEIL,
        frozenset({"bleed", "correction_residual", "veil"}),
        (Condition("veil", 0.005, _FAR),),
        "black at the print's bright places is brighter than at its dark ones",
    ),
)  # fmt: skip
"""The table, in the order of deciding."""


@dataclass(frozen=True)
class Decision:
    """The probable cause of a figure beyond its limit, and the rule that says so; None where it is unknown.

    - `cause`, `rule`: as said.
    - `follows`: the figure that the rule explains where it is another one, which this one goes with; "" else.
    """

    cause: Cause
    rule: Rule | None
    follows: str = ""


def decide(figure: str, evidence: Evidence, rules: Collection[Rule] = RULES) -> Decision:
    """Return the cause of a figure by what is known; unknown where no rule of the table holds."""
    for rule in rules:
        if rule.holds(figure, evidence):
            return Decision(rule.cause, rule)
    return Decision(UNKNOWN, None)
