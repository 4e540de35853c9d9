"""Causes of a figure beyond its limit, the evidence for them, and the table of rules that selects a cause.

The first rule that applies decides. If no rule applies, the cause is reported as unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Literal

# Taken again after the remedy: the listed frames, the whole session, or nothing because new frames do not help.
Repeats = Literal["frames", "session", "nothing"]


@dataclass(frozen=True)
class Cause:
    """One probable cause.

    - `name`: identifier, as in `report.json`.
    - `description`: noun phrase that follows "probably" in a message.
    - `remedy`: instruction for the user, in the imperative.
    - `repeats`: frames or session that must be taken again after the remedy, or nothing.
    """

    name: str
    description: str
    remedy: str
    repeats: Repeats


HOT_PHOTOSITES = Cause(
    "hot photosites",
    "hot photosites, which the dark frames show too",
    "let the camera cool, or have its pixels remapped; the LUT excludes the listed patches",
    "nothing",
)
OBJECT_IN_FRAME = Cause(
    "hand or object in one frame",
    "a hand, a person or an object in front of the print in single frames",
    "keep people and objects out of the space between projector, print and camera",
    "frames",
)
REFLECTION = Cause(
    "reflection in all frames",
    "a reflection on the print in all frames, which adds the same light to every colour",
    "turn the print or the projector until it mirrors no lamp, window or bright wall, or print on matt paper",
    "session",
)
REFLECTION_IN_FRAME = Cause(
    "reflection in one frame",
    "a reflection on the print in single frames, from a lamp, a display or daylight that changes",
    "cover displays and windows, and let nobody move in the area that the print mirrors",
    "frames",
)
STAIN = Cause(
    "stain",
    "a stain on the print, which absorbs some colours more than others in all frames",
    "clean the print or print it again",
    "session",
)
SHADOW = Cause(
    "shadow or fold",
    "a shadow, a fold or grey dirt on the print, which darkens all colours equally in all frames",
    "remove the object that blocks the light, hang the print flatter, and clean it",
    "session",
)
FALL_OFF = Cause(
    "fall-off",
    "a fall-off towards the corners that the flat field does not describe",
    "stop the lens down, use a longer lens or step back, and zoom the projector out",
    "session",
)
CURL = Cause(
    "curled print",
    "a curled or folded print; its shape there could not be measured",
    "hang the print flatter, on a board or fastened at all corners",
    "session",
)
SPREAD = Cause(
    "soft lens",
    "a lens that spreads light over several patches, so that neighbouring colours mix at the rims",
    "focus on the print, stop down to f/8, clean the lens, move the camera closer, or use a smaller window "
    "(build-lut --window)",
    "session",
)
BUMP = Cause(
    "bump",
    "a push of the print or the camera",
    "fasten camera and print, and keep people away; the sampling grid followed the movement",
    "nothing",
)
DEFOCUS = Cause(
    "defocus",
    "a frame that is out of focus or shaken",
    "switch off autofocus and stabilisation, focus on the print, and keep the camera free from vibration",
    "frames",
)
ANOTHER_PRINT = Cause(
    "another print",
    "another print: its patches differ from chart.json",
    "give the chart.json of this print, and keep it in place until the session ends",
    "frames",
)
WRONG_NAME = Cause(
    "wrong name",
    "a frame stored under the name of another illuminant",
    "correct the list of imported frames, or let the projected image settle longer (sequence.settle_s)",
    "frames",
)
OTHER_CAMERA = Cause(
    "other camera",
    "frames of another camera or lens",
    "take all frames of a LUT with one camera and one lens",
    "frames",
)
OTHER_EXPOSURE = Cause(
    "other exposure",
    "frames with another recorded exposure than the other frames or the session's settings",
    "take all frames with one exposure in manual mode: shutter, aperture and ISO speed",
    "frames",
)
ROOM_LIGHT = Cause(
    "room light",
    "light of the room, which is present while the projector shows black",
    "darken the room, cover lamps and displays, and keep daylight out",
    "session",
)
OTHER_BRIGHTNESS = Cause(
    "one primary's frame",
    "a brightness error in the frame of one primary: a shadow, a hand at the projector, a flickering lamp or another "
    "exposure",
    "take that frame again, and keep the projector's beam free",
    "frames",
)
COLOUR_WHEEL = Cause(
    "colour wheel",
    "the projector's colour wheel: exposures end within a turn, so that frames contain more of one primary than of "
    "another",
    "expose whole turns of the wheel, 0.5 s or longer (camera.shutter_s a multiple of 1 / "
    "lab.projector.colour_wheel_hz; 0.5 s is 30 turns at 60 turns per second), or use a projector without a wheel",
    "session",
)
MIXED = Cause(
    "another light in one frame",
    "another light in the frame of one primary, for example because the projected image had not settled: white "
    "contains more of that primary than its frame, and correspondingly less of another",
    "take that frame again, and let the projected image settle longer (sequence.settle_s)",
    "frames",
)
UNKNOWN = Cause("unknown", "", "", "nothing")  # No rule applies; the remedy of the limit is reported

CAUSES = (
    HOT_PHOTOSITES, OBJECT_IN_FRAME, REFLECTION, REFLECTION_IN_FRAME, STAIN, SHADOW, CURL, FALL_OFF, SPREAD, BUMP,
    DEFOCUS, ANOTHER_PRINT, WRONG_NAME,
    OTHER_CAMERA, OTHER_EXPOSURE, ROOM_LIGHT, OTHER_BRIGHTNESS, MIXED, COLOUR_WHEEL, UNKNOWN,
)  # fmt: skip


NAN = float("nan")


@dataclass(frozen=True)
class Evidence:
    """Measured properties of a deviation; NaN if not measured.

    - `frames`: number of compared frames.
    - `showing`: fraction of these frames with the deviation.
    - `even_showing`: fraction of the white frames among them with the deviation; 0 without white frames.
    - `white_residual`: fraction of white frames with references that deviate there by at least half as much.
    - `some_whites`: 1 if the references deviate there in some white frames and not in others, else 0.
    - `spot`: fraction of patches there with a wrong colour in the mean of the white frames.
    - `in_first`: 1 if at least 80 % of the frames differ there from the frame registered first; else 0.
    - `share`: fraction of the print that deviates.
    - `deviation`: relative deviation in the channel that deviates most; negative is darker.
    - `tint`: range of the deviation over the channels, divided by its magnitude; 0 if all channels are alike.
    - `added`: light added to the patches there, independent of their colour, as a fraction of paper white.
    - `kept`: fraction of their own light that the patches there keep.
    - `rim`: mean relative residual of the outermost references, with its sign.
    - `rim_frames`: fraction of white frames in which `rim` is below −0.5 %.
    - `radial`: fraction of the residuals' variance explained by the distance from the centre.
    - `hot`: fraction of the affected patches with a photosite that is hot in every dark frame.
    - `scatter`: relative scatter of all patches of the frame about their codes' colours.
    - `softer`: light of neighbouring patches that the frame's blur adds to the worst sample, as a fraction.
    - `moved_px`: distance of the chart from its registered position, half-size px.
    - `anew`: fraction of frames in which the chart was registered again.
    - `agreement`: correlation of the patches with the chart at the registered position.
    - `exposure`: exposure of the frame by its file, relative to the other frames.
    - `off_codes_deg`: largest angle between an illuminant's white and the prediction from its codes, degrees.
    - `named_right`: 0 if an illuminant's white fits the codes of another illuminant; else not measured.
    - `cameras`: number of cameras or lenses among the frames, by their files.
    - `room`: light while the projector shows black, as a fraction of white.
    - `room_change`: change of `room` between dark frames, as a fraction of white.
    - `stray`: light of a primary under a code of 0 that is missing in the dark frames, as a fraction of that primary.
    - `stray_primaries`: light common to the primaries' frames that exceeds white, as a fraction of white.
    - `lone_primary`: relative difference of one primary in white from the other two, which agree.
    - `mixed`: relative excess of one primary in white, if another primary lacks about as much.
    - `colour_scatter`: relative scatter of white's colour between successive white frames, beyond drift.
    - `other_iso`: number of frames with another recorded ISO speed than the settings or most frames.
    - `lit`: fraction of the unfit patches with too much light on the print for their level.
    - `misplaced`: fraction of the unfit patches with too large an uncertainty of position.
    - `uneven`: fraction of the unfit patches with different rim and centre.
    - `waves_px`: RMS distance of the tags from a flat sheet, half-size px, for patches of 10 px.
    - `beyond_cell`: fraction of the worst sample's light that the lens brings from outside its patch.
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

    def measured_values(self) -> dict[str, float]:
        """Return the values that were measured, by name."""
        return {name: value for name in evidence_names() if (value := getattr(self, name)) == value}


@cache
def evidence_names() -> tuple[str, ...]:
    """Return the field names of `Evidence`."""
    return tuple(field.name for field in fields(Evidence))


_INFINITY = math.inf


@dataclass(frozen=True)
class Condition:
    """Closed interval in which a value of `Evidence` must lie; a value that was not measured fails."""

    name: str
    low: float
    high: float

    def holds(self, evidence: Evidence) -> bool:
        """Return whether the value was measured and lies in the interval."""
        return self.low <= getattr(evidence, self.name) <= self.high


@dataclass(frozen=True)
class Rule:
    """One row of the table: a cause, the subjects that it may explain, its conditions, and the reason."""

    cause: Cause
    about: frozenset[Subject]
    conditions: tuple[Condition, ...]
    why: str

    def holds(self, subject: Subject, evidence: Evidence) -> bool:
        """Return whether the rule applies to a figure about a subject."""
        return subject in self.about and all(condition.holds(evidence) for condition in self.conditions)


# Subject of a figure. Rules refer to it instead of the figure's name.
Subject = Literal[
    "block", "few cells", "unfit cells", "spot", "references", "frame", "movement", "noisy cells", "chart", "drift",
    "names", "brightness", "sum", "dark", "stray", "camera", "iso",
]  # fmt: skip


def _subjects(*names: Subject) -> frozenset[Subject]:
    return frozenset(names)


PLACE = _subjects("block", "few cells")
WHOLE_FRAME = _subjects("frame", "movement", "noisy cells")
PRINT = _subjects("spot", "unfit cells", "references")
SHEET = PRINT | _subjects("noisy cells")
DRIFT = _subjects("drift")
LIGHT = _subjects("names", "brightness", "sum", "drift")
DARK = _subjects("dark")
STRAY = _subjects("stray")
CHART = _subjects("chart")

# At a position on the print, the white frames agree with the frame registered first.
_IN_ALL_FRAMES = (
    Condition("in_first", 0, 0), Condition("even_showing", 0, 0), Condition("some_whites", 0, 0),
    Condition("frames", 2, _INFINITY),
)  # fmt: skip

# The deviation is local, and the frame is as sharp as the frame registered first.
_SHARP_PLACE = (Condition("share", 0, 0.5), Condition("scatter", 0, 0.1), Condition("softer", -_INFINITY, 0.003))

# At most 34 % of the frames deviate at a position, and the frame registered first is correct there.
_IN_FEW_FRAMES = (
    Condition("in_first", 0, 0), Condition("frames", 3, _INFINITY), Condition("showing", 1e-9, 0.34),
)  # fmt: skip

# Rules in the order of decision: rules based on file data and dark frames precede rules based on appearance.
# A wrong cause may lead to an unnecessary session; an unknown cause does less harm. Therefore there are gaps between
# the intervals of different causes.
RULES: tuple[Rule, ...] = (
    Rule(
        OTHER_CAMERA,
        PLACE | WHOLE_FRAME | PRINT | LIGHT | DARK | _subjects("camera"),
        (Condition("cameras", 2, _INFINITY),),
        "the files name more than one camera or lens",
    ),
    Rule(
        OTHER_EXPOSURE,
        LIGHT,
        (Condition("exposure", 0, 0.97),),
        "the file records a shorter exposure than the other files",
    ),
    Rule(
        OTHER_EXPOSURE,
        LIGHT,
        (Condition("exposure", 1.03, _INFINITY),),
        "the file records a longer exposure than the other files",
    ),
    Rule(
        OTHER_EXPOSURE,
        _subjects("iso"),
        (Condition("other_iso", 1, _INFINITY),),
        "the file records another ISO speed than the settings or the other files",
    ),
    Rule(
        COLOUR_WHEEL,
        _subjects("drift", "sum", "brightness"),
        (Condition("colour_scatter", 0.002, 0.15),),
        "white's colour alternates between successive white frames, which lamp drift does not do",
    ),
    Rule(
        MIXED,
        _subjects("sum", "brightness", "stray"),
        (Condition("mixed", 0.01, 0.5),),
        "white contains more of one primary than of the third, and correspondingly less of another",
    ),
    Rule(
        OTHER_BRIGHTNESS,
        _subjects("sum"),
        (Condition("lone_primary", 0.01, _INFINITY),),
        "white contains more or less of one primary than of the other two",
    ),
    Rule(
        WRONG_NAME,
        LIGHT,
        (Condition("named_right", 0, 0), Condition("exposure", 0.97, 1.03)),
        "its white does not fit its own codes, but the codes of another illuminant",
    ),
    Rule(
        ROOM_LIGHT,
        DARK,
        (Condition("room_change", 0.002, _INFINITY),),
        "the light changes between dark frames; the projector's own black is constant",
    ),
    Rule(
        ROOM_LIGHT,
        DARK,
        (Condition("room", 0.02, _INFINITY), Condition("frames", 1, _INFINITY)),
        "no projector's black reaches 2 % of its white",
    ),
    Rule(
        ROOM_LIGHT,
        STRAY,
        (Condition("stray", 0.004, 0.1),),
        "illuminants with a code of 0 contain or lack light of that primary which the dark frames do not show",
    ),
    Rule(
        ROOM_LIGHT,
        STRAY,
        (Condition("stray_primaries", 0.004, 0.1),),
        "red, green and blue alone add up to more than white, by the same amount in each, under a steady lamp; a "
        "projector that reduces full white has the same effect",
    ),
    Rule(
        HOT_PHOTOSITES,
        PLACE | SHEET,
        (Condition("hot", 0.5, 1),),
        "most of the affected patches contain a photosite that is hot in every dark frame",
    ),
    Rule(
        HOT_PHOTOSITES,
        PLACE,
        (Condition("hot", 0.2, 1), Condition("deviation", 0, _INFINITY)),
        "the patches are too bright, and at least 20 % of them contain a photosite that is hot in every dark frame",
    ),
    Rule(
        DEFOCUS,
        WHOLE_FRAME | PLACE,
        (Condition("softer", 0.003, _INFINITY), Condition("scatter", 0, 0.1)),
        "the tags are softer than in the frame registered first, and patches contain their neighbours' light",
    ),
    Rule(
        ANOTHER_PRINT,
        WHOLE_FRAME | PLACE | CHART,
        (Condition("scatter", 0.2, _INFINITY), Condition("softer", -_INFINITY, 0.012)),
        "no patch has the colour of its code, although the tags are sharp",
    ),
    Rule(
        ANOTHER_PRINT,
        CHART,
        (Condition("agreement", -1, 0.5),),
        "patches and chart are uncorrelated",
    ),
    Rule(
        BUMP,
        _subjects("movement"),
        (Condition("anew", 1e-9, 1), Condition("moved_px", 0.5, _INFINITY), Condition("softer", -_INFINITY, 0.003)),
        "the tags are at other positions than before, and as sharp",
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
        "white references are dark at one position in few white frames",
    ),
    Rule(
        OBJECT_IN_FRAME,
        PLACE | SHEET | DRIFT,
        (
            Condition("in_first", 1, 1),
            Condition("frames", 4, _INFINITY),
            Condition("showing", 0.8, 1),
            Condition("share", 0, 0.5),
        ),
        "all frames differ at one position from the frame that they are compared with",
    ),
    Rule(
        OBJECT_IN_FRAME,
        _subjects("block") | SHEET | DRIFT,
        (
            *_IN_FEW_FRAMES,
            Condition("even_showing", 1e-9, 1),
            Condition("deviation", -1, _INFINITY),
            *_SHARP_PLACE,
        ),
        "one position deviates in few frames, including a white one, and is correct in the others",
    ),
    Rule(
        OBJECT_IN_FRAME,
        _subjects("few cells"),
        (
            *_IN_FEW_FRAMES,
            Condition("even_showing", 1e-9, 1),
            Condition("deviation", -1, 0),
            *_SHARP_PLACE,
        ),
        "few patches appear covered in few frames, including a white one, and are correct in the others",
    ),
    Rule(
        REFLECTION_IN_FRAME,
        PLACE,
        (
            *_IN_FEW_FRAMES,
            Condition("spot", 0, 0.1),
            Condition("deviation", 0, _INFINITY),
            Condition("added", 0.004, _INFINITY),
            Condition("kept", 0.9, 1.1),
            *_SHARP_PLACE,
        ),
        "light is added at one position in few frames, and the patches keep their own light",
    ),
    Rule(
        OBJECT_IN_FRAME,
        _subjects("block"),
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("kept", -_INFINITY, 0.85), *_SHARP_PLACE),
        "patches at one position lose light of their own colours in few frames, all by the same fraction",
    ),
    Rule(
        OBJECT_IN_FRAME,
        PLACE | _subjects("unfit cells"),
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("deviation", -1, 0), *_SHARP_PLACE),
        "one position deviates in few frames, and is correct in the others and under white",
    ),
    Rule(
        REFLECTION,
        SHEET,
        (
            *_IN_ALL_FRAMES,
            Condition("added", 0.004, _INFINITY),
            Condition("deviation", 0, _INFINITY),
            Condition("share", 0, 0.7),
        ),
        "light is added at one position in all frames, and dark colours gain most",
    ),
    Rule(
        FALL_OFF,
        _subjects("references"),
        (Condition("radial", 0.5, 1), Condition("rim", -1, -0.005), Condition("rim_frames", 0.9, 1)),
        "the residual depends only on the distance from the centre, and the rim is darker, in all frames",
    ),
    Rule(
        STAIN,
        SHEET,
        (
            *_IN_ALL_FRAMES,
            Condition("deviation", -1, -0.01),
            Condition("added", -0.05, 0.05),
            Condition("kept", 0, 0.99),
            Condition("tint", 0.35, _INFINITY),
            Condition("share", 0, 0.2),
        ),
        "a position is darker in all frames, in proportion to its light, and more in one colour",
    ),
    Rule(
        STAIN,
        SHEET,
        (
            Condition("white_residual", 0.9, 1),
            Condition("deviation", -1, -0.03),
            Condition("tint", 0.35, _INFINITY),
            Condition("share", 0, 0.2),
        ),
        "white references are dark at one position in all white frames, and more in one colour",
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
        "a position is darker in all frames, in proportion to its light, equally in all colours",
    ),
    Rule(
        REFLECTION,
        _subjects("unfit cells"),
        (Condition("lit", 0.5, 1),),
        "most of the affected patches are too bright by the same amount as their neighbours, whatever their colour",
    ),
    Rule(
        CURL,
        _subjects("unfit cells"),
        (Condition("misplaced", 0.5, 1), Condition("waves_px", 0.3, _INFINITY)),
        "most of the affected patches have an uncertain position, and the tags do not lie in a plane",
    ),
    Rule(
        SPREAD,
        _subjects("unfit cells", "noisy cells"),
        (Condition("beyond_cell", 0.01, _INFINITY), Condition("uneven", 0.5, 1)),
        "rim and centre of patches differ, and the print proves that the lens brings light from outside them",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Decision:
    """Probable cause of a figure beyond its limit, with the rule that applied; None if the cause is unknown.

    - `follows`: name of another figure that the rule explains, if this figure has the same cause; else "".
    """

    cause: Cause
    rule: Rule | None
    follows: str = ""


def decide(subject: Subject, evidence: Evidence) -> Decision:
    """Return the cause of the first rule that applies; unknown if none does."""
    for rule in RULES:
        if rule.holds(subject, evidence):
            return Decision(rule.cause, rule)
    return Decision(UNKNOWN, None)
