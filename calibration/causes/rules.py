"""Why a figure is beyond its limit: the causes there are, the evidence that is asked for, and the table that decides.

The first rule that holds decides; those that rest on what files say, or dark frames show, stand before those that rest
on what a deviation looks like. Where none holds, the cause is unknown and said to be: one that is wrong costs a
session, one that is not named a look at the report. So intervals leave gaps between causes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Literal

# What is to be taken again: the frames that are named, the whole session, or nothing, as no new frame helps.
Mends = Literal["frames", "session", "nothing"]


@dataclass(frozen=True)
class Cause:
    """One probable cause.

    - `name`: as in `report.json`.
    - `says`: what it is, for a sentence that begins with "probably".
    - `remedy`: what helps, an imperative.
    - `mends`: what is then to be taken again.
    """

    name: str
    says: str
    remedy: str
    mends: Mends


HOT_PHOTOSITES = Cause(
    "hot photosites",
    "photosites that are hot, which the dark frames show too",
    "let the camera cool, or have its pixels remapped; the cells are listed, and the table leaves them out",
    "nothing",
)
OBJECT_IN_FRAME = Cause(
    "hand or object in one frame",
    "a hand, a person or an object before the print in single frames",
    "see that nobody comes between lamp, print and camera",
    "frames",
)
REFLECTION = Cause(
    "reflection in all frames",
    "a reflection on the print in all frames: light is added there, whatever the colour printed",
    "turn print or projector until no lamp, window or bright wall is mirrored on it, or print on matt paper",
    "session",
)
REFLECTION_IN_FRAME = Cause(
    "reflection in one frame",
    "a reflection on the print in single frames: a lamp, a display or daylight that is not always there",
    "cover displays and windows, and see that nobody moves in front of what the print mirrors",
    "frames",
)
STAIN = Cause(
    "stain",
    "a stain on the print: it takes some colours more than others, in all frames",
    "clean the print or print it anew",
    "session",
)
SHADOW = Cause(
    "shadow or fold",
    "a shadow, a fold or grey dirt on the print: it takes all colours alike, in all frames",
    "look for what stands in the light there, hang the print flatter, and clean it",
    "session",
)
FALL_OFF = Cause(
    "fall-off",
    "fall-off towards the corners that the field does not follow",
    "stop the lens down, take a longer lens or step back, and zoom the projector's picture out",
    "session",
)
CURL = Cause(
    "curled print",
    "a print that is curled or folded: its shape there is not known from what was measured",
    "hang the print flatter, on a board or held at all corners",
    "session",
)
SPREAD = Cause(
    "soft lens",
    "a lens that spreads light over several cells, so that their rims have the neighbours' colours",
    "focus on the print, stop down to f/8, clean the lens, bring the camera nearer, or take a smaller window "
    "(build-lut --window)",
    "session",
)
BUMP = Cause(
    "bump",
    "print or camera were pushed",
    "fix camera and print, and let nobody walk about; the sampling grid followed",
    "nothing",
)
DEFOCUS = Cause(
    "defocus",
    "the frame is out of focus, or was shaken",
    "switch off autofocus and stabilisation, focus on the print, see that nothing shakes the camera",
    "frames",
)
ANOTHER_PRINT = Cause(
    "another print",
    "a print whose cells are not those of chart.json",
    "name the chart.json of this print, and let it hang until the session's end",
    "frames",
)
WRONG_NAME = Cause(
    "wrong name",
    "a frame that bears another light's name",
    "correct the list of frames that was imported, or let the picture settle for longer (sequence.settle_s)",
    "frames",
)
OTHER_CAMERA = Cause(
    "other camera",
    "frames of another camera or lens",
    "take all frames of a table with one camera and one lens",
    "frames",
)
OTHER_EXPOSURE = Cause(
    "other exposure",
    "frames of another exposure than the rest, or than the session's settings, by their files",
    "expose all frames alike, manually: shutter, aperture and ISO speed",
    "frames",
)
ROOM_LIGHT = Cause(
    "room light",
    "light of the room: it is there while the projector shows black",
    "darken the room, cover lamps and displays, keep daylight out",
    "session",
)
OTHER_BRIGHTNESS = Cause(
    "one primary's frame",
    "less or more light in the frame of one primary alone than in the others: a shadow, a hand at the projector, a "
    "lamp that flickered, another exposure",
    "take that frame again, and see that nobody stands in the projector's light",
    "frames",
)
COLOUR_WHEEL = Cause(
    "colour wheel",
    "the projector's colour wheel: exposures end within a turn, so that frames hold more of one primary than of "
    "another",
    "expose whole turns of the wheel, half a second and more (camera.shutter_s a multiple of 1 / "
    "lab.projector.colour_wheel_hz: 0.5 s are 30 turns of 60 a second), or take a projector without a wheel",
    "session",
)
MIXED = Cause(
    "another light in one frame",
    "part of another light in the frame of one primary, as where its picture had not settled: white has more of that "
    "primary than its frame says, and as much less of another",
    "take that frame again, and let the picture settle for longer (sequence.settle_s)",
    "frames",
)
UNKNOWN = Cause("unknown", "", "", "nothing")  # What was measured does not decide; the remedy is then that of the limit

# All of them.
CAUSES = (
    HOT_PHOTOSITES, OBJECT_IN_FRAME, REFLECTION, REFLECTION_IN_FRAME, STAIN, SHADOW, CURL, FALL_OFF, SPREAD, BUMP,
    DEFOCUS, ANOTHER_PRINT, WRONG_NAME,
    OTHER_CAMERA, OTHER_EXPOSURE, ROOM_LIGHT, OTHER_BRIGHTNESS, MIXED, COLOUR_WHEEL, UNKNOWN,
)  # fmt: skip


NAN = float("nan")


@dataclass(frozen=True)
class Evidence:
    """What is known of a deviation.

    - `frames`: frames of the print that were compared.
    - `showing`: share of them that show it.
    - `even_showing`: share of the white frames, but the one compared with, that show it; 0 where there is no other.
    - `white_residual`: share of the white frames whose references are off there by half as much or more.
    - `some_whites`: 1 where the references of some white frames are off there and those of others not; else 0.
    - `spot`: share of the cells there that are not of their codes' colours in the mean of the white frames.
    - `in_first`: 1 where all frames differ at one place from the frame that they are compared with, so that it is
      there; else 0.
    - `share`: share of the print that deviates.
    - `deviation`: how far the place is off, relative, with its sign: below 0 it is darker; the channel that deviates
      most.
    - `tint`: how differently the channels are off, over `deviation`'s size: 0 where all are off alike.
    - `added`: light that cells have there besides their own, whatever their colour, of paper white.
    - `kept`: share of their own light that they have.
    - `rim`: mean residual of the outermost references, relative, with its sign.
    - `rim_frames`: share of the white frames in which it is below −0.5 %.
    - `radial`: share of the residuals' variance that distance from the middle explains.
    - `hot`: share of the cells concerned that hold a photosite which is hot in every dark frame.
    - `scatter`: spread of all cells of the frame about their codes' colours, relative.
    - `softer`: light of neighbouring cells added by the frame's blur, in the worst sample.
    - `moved_px`: how far the chart lies from where it was registered, half-size px.
    - `anew`: share of the frames in which the chart had to be registered again.
    - `agreement`: correlation of the cells with the chart where it was registered.
    - `exposure`: exposure of the frame by its file over the other frames'.
    - `off_codes_deg`: angle between a light's white and what its codes give, degrees.
    - `named_right`: 1 where a light's white is what its codes give, 0 where it is what another light's give.
    - `cameras`: cameras or lenses among the frames, by their files.
    - `room`: light while the projector shows black, of white.
    - `room_change`: change of it between dark frames, of white.
    - `stray`: light of a primary under a code of 0 that no dark frame shows, of that primary, the worst light.
    - `stray_primaries`: light of the primaries' frames together beyond white's, alike in each, of white.
    - `lone_primary`: how differently much of one primary white has than of the other two, which are alike, relative.
    - `mixed`: how much more of one primary white has than of the third, and less of another, relative.
    - `colour_scatter`: scatter of white's colour from one white frame to the next, relative, over what its drift makes.
    - `other_iso`: frames of another ISO speed than the session's settings, or than most, by their files.
    - `lit`: share of the unfit cells of whose level light that lies on the print there is too much.
    - `misplaced`: share of the unfit cells whose place is not known well enough.
    - `uneven`: share of the unfit cells whose rim and middle differ.
    - `waves_px`: how far tags lie from where a flat sheet would have them, RMS, half-size px of cells of 10 px.
    - `beyond_cell`: share of the light of a window's worst sample that the lens brings from beyond its cell.
    """

    frames: float = NAN
    showing: float = NAN
    even_showing: float = NAN
    white_residual: float = NAN
    some_whites: float = NAN
    spot: float = NAN
    in_first: float = NAN
    share: float = NAN
    deviation: float = NAN
    tint: float = NAN
    added: float = NAN
    kept: float = NAN
    rim: float = NAN
    rim_frames: float = NAN
    radial: float = NAN
    hot: float = NAN
    scatter: float = NAN
    softer: float = NAN
    moved_px: float = NAN
    anew: float = NAN
    agreement: float = NAN
    exposure: float = NAN
    off_codes_deg: float = NAN
    named_right: float = NAN
    cameras: float = NAN
    room: float = NAN
    room_change: float = NAN
    stray: float = NAN
    stray_primaries: float = NAN
    lone_primary: float = NAN
    mixed: float = NAN
    colour_scatter: float = NAN
    other_iso: float = NAN
    lit: float = NAN
    misplaced: float = NAN
    uneven: float = NAN
    waves_px: float = NAN
    beyond_cell: float = NAN

    def known(self) -> dict[str, float]:
        """Return what was measured, by name."""
        return {name: value for name in evidence_names() if (value := getattr(self, name)) == value}


@cache
def evidence_names() -> tuple[str, ...]:
    """Return the names of what evidence may hold, in its order."""
    return tuple(field.name for field in fields(Evidence))


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
    - `about`: what the figures are about that it may explain.
    """

    cause: Cause
    about: frozenset[Subject]
    conditions: tuple[Condition, ...]
    why: str

    def holds(self, subject: Subject, evidence: Evidence) -> bool:
        """Return whether it explains a figure about a subject by what is known."""
        return subject in self.about and all(condition.holds(evidence) for condition in self.conditions)


# What a figure beyond its limit is about: the rules ask for that, and not for its name.
Subject = Literal[
    "block", "few cells", "unfit cells", "spot", "references", "frame", "movement", "noisy cells", "chart", "drift",
    "names", "brightness", "sum", "dark", "stray", "camera", "iso",
]  # fmt: skip


def _about(*subjects: Subject) -> frozenset[Subject]:
    return frozenset(subjects)


PLACE = _about("block", "few cells")
WHOLE_FRAME = _about("frame", "movement", "noisy cells")
PRINT = _about("spot", "unfit cells", "references")
SHEET = PRINT | _about("noisy cells")
DRIFT = _about("drift")
LIGHT = _about("names", "brightness", "sum", "drift")
DARK = _about("dark")
STRAY = _about("stray")
CHART = _about("chart")

# A place of the print looks in every frame as in the one registered first.
_IN_ALL_FRAMES = (
    Condition("in_first", 0, 0), Condition("even_showing", 0, 0), Condition("some_whites", 0, 0),
    Condition("frames", 2, _FAR),
)  # fmt: skip

# What is off lies at one place, and the rest of the frame is as sharp as before.
_SHARP_PLACE = (Condition("share", 0, 0.5), Condition("scatter", 0, 0.1), Condition("softer", -_FAR, 0.003))

# A place is off in few of the frames, and not in the one that they are compared with.
_IN_FEW_FRAMES = (
    Condition("in_first", 0, 0), Condition("frames", 3, _FAR), Condition("showing", 1e-9, 0.34),
)  # fmt: skip

# The table, in the order of deciding.
RULES: tuple[Rule, ...] = (
    Rule(
        OTHER_CAMERA,
        PLACE | WHOLE_FRAME | PRINT | LIGHT | DARK | _about("camera"),
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
        _about("iso"),
        (Condition("other_iso", 1, _FAR),),
        "the file states another ISO speed than the settings, or the others'",
    ),
    Rule(
        COLOUR_WHEEL,
        _about("drift", "sum", "brightness"),
        (Condition("colour_scatter", 0.002, 0.15),),
        "white's colour goes to and fro from one white frame to the next, as no lamp drifts",
    ),
    Rule(
        MIXED,
        _about("sum", "brightness", "stray"),
        (Condition("mixed", 0.01, 0.5),),
        "white has more of one primary than of the third, and as much less of another",
    ),
    Rule(
        OTHER_BRIGHTNESS,
        _about("sum"),
        (Condition("lone_primary", 0.01, _FAR),),
        "white has more or less of one primary than of the other two",
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
        PLACE | SHEET,
        (Condition("hot", 0.5, 1),),
        "most of the cells concerned hold a photosite that stands out in every dark frame",
    ),
    Rule(
        HOT_PHOTOSITES,
        PLACE,
        (Condition("hot", 0.2, 1), Condition("deviation", 0, _FAR)),
        "a place is brighter, and a fifth and more of its cells hold a photosite that stands out in every dark frame",
    ),
    Rule(
        DEFOCUS,
        WHOLE_FRAME | PLACE,
        (Condition("softer", 0.003, _FAR), Condition("scatter", 0, 0.1)),
        "the tags are softer than in the frame registered first, and cells have their neighbours' light",
    ),
    Rule(
        ANOTHER_PRINT,
        WHOLE_FRAME | PLACE | CHART,
        (Condition("scatter", 0.2, _FAR), Condition("softer", -_FAR, 0.012)),
        "the cells' colours are not those of their codes anywhere, though the tags are sharp",
    ),
    Rule(
        ANOTHER_PRINT,
        CHART,
        (Condition("agreement", -1, 0.5),),
        "cells and chart have nothing in common",
    ),
    Rule(
        BUMP,
        _about("movement"),
        (Condition("anew", 1e-9, 1), Condition("moved_px", 0.5, _FAR), Condition("softer", -_FAR, 0.003)),
        "the tags lie elsewhere than before, as sharp",
    ),
    Rule(
        OBJECT_IN_FRAME,
        CHART | SHEET,
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
        _about("block") | SHEET | DRIFT,
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
        _about("few cells"),
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
        _about("block"),
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("kept", -_FAR, 0.85), *_SHARP_PLACE),
        "in few frames cells of one place have light of their own colours less, and all alike",
    ),
    Rule(
        OBJECT_IN_FRAME,
        PLACE | _about("unfit cells"),
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
        _about("references"),
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
        REFLECTION,
        _about("unfit cells"),
        (Condition("lit", 0.5, 1),),
        "most of the cells concerned are brighter by as much as their neighbours, whatever is printed there",
    ),
    Rule(
        CURL,
        _about("unfit cells"),
        (Condition("misplaced", 0.5, 1), Condition("waves_px", 0.3, _FAR)),
        "most of the cells concerned lie where their places are not known well enough, and tags lie beside a plane",
    ),
    Rule(
        SPREAD,
        _about("unfit cells", "noisy cells"),
        (Condition("beyond_cell", 0.01, _FAR), Condition("uneven", 0.5, 1)),
        "rim and middle of cells differ, and the print shows that the lens brings light from beyond them",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Decision:
    """The probable cause of a figure beyond its limit, and the rule that says so; None where it is unknown.

    - `follows`: the figure that the rule explains where it is another one, which this one goes with; "" else.
    """

    cause: Cause
    rule: Rule | None
    follows: str = ""


def decide(subject: Subject, evidence: Evidence) -> Decision:
    """Return the cause of a figure about a subject by what is known; unknown where no rule of the table holds."""
    for rule in RULES:
        if rule.holds(subject, evidence):
            return Decision(rule.cause, rule)
    return Decision(UNKNOWN, None)
