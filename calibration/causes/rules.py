"""Probable causes of a figure beyond its limit, the evidence for them, and the rules that select one of them.

The first rule that applies decides. If no rule applies, the cause is reported as unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Literal

# What must be taken again after the remedy: the listed frames, the whole session, or nothing.
Repeats = Literal["frames", "session", "nothing"]


@dataclass(frozen=True)
class Cause:
    """One probable cause.

    - `name`: identifier, as in `report.json`.
    - `description`: noun phrase that follows "probably" in a message.
    - `remedy`: instruction for the user, in the imperative.
    - `repeats`: what must be taken again after the remedy.
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
    "turn the print or the projector until the print mirrors no lamp, window or bright wall; or print on matt paper",
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
    "a fall-off of light towards the corners that the flat field does not describe",
    "stop the lens down, use a longer lens or step back, and zoom the projector out",
    "session",
)
CURL = Cause(
    "curled print",
    "a curled or folded print, so that the positions of patches could not be measured accurately",
    "hang the print flatter, on a board or fastened at all corners",
    "session",
)
SPREAD = Cause(
    "soft lens",
    "a lens that spreads light over several patches, so that their colours mix at the rims",
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
    "use the chart.json of this print, and leave the print in place until the session ends",
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
    "frames with a recorded exposure that differs from the other frames or from the settings of the session",
    "take all frames with one exposure in manual mode: shutter, aperture and ISO speed",
    "frames",
)
ROOM_LIGHT = Cause(
    "room light",
    "light of the room in addition to the projected light",
    "darken the room, cover lamps and displays, and keep daylight out",
    "session",
)
OTHER_BRIGHTNESS = Cause(
    "one primary's frame",
    "a brightness error in the frame of one primary: a shadow, a hand at the projector, a flickering lamp or another "
    "exposure",
    "take the frame of this primary again, and keep the projector's beam free",
    "frames",
)
COLOUR_WHEEL = Cause(
    "colour wheel",
    "the projector's colour wheel: exposures end within a turn, so that frames contain more of one primary than of "
    "another",
    "expose for whole turns of the wheel and at least 0.5 s (set camera.shutter_s to a multiple of 1 / "
    "lab.projector.colour_wheel_hz), or use a projector without a wheel",
    "session",
)
MIXED = Cause(
    "another light in one frame",
    "light of another illuminant in the frame of one primary, for example because the projected image had not settled",
    "take the frame of this primary again, and let the projected image settle longer (sequence.settle_s)",
    "frames",
)
UNKNOWN = Cause("unknown", "", "", "nothing")  # No rule applies; the remedy of the figure is reported

CAUSES = (
    HOT_PHOTOSITES, OBJECT_IN_FRAME, REFLECTION, REFLECTION_IN_FRAME, STAIN, SHADOW, CURL, FALL_OFF, SPREAD, BUMP,
    DEFOCUS, ANOTHER_PRINT, WRONG_NAME,
    OTHER_CAMERA, OTHER_EXPOSURE, ROOM_LIGHT, OTHER_BRIGHTNESS, MIXED, COLOUR_WHEEL, UNKNOWN,
)  # fmt: skip


NAN = float("nan")


@dataclass(frozen=True)
class Evidence:
    """Measured properties of a deviation; NaN if not measured. A local deviation has one position on the print.

    - `frames`: number of compared frames.
    - `showing`: fraction of these frames that show the deviation.
    - `even_showing`: as `showing`, for the evenly lit (white) frames only; 0 without white frames.
    - `white_residual`: fraction of white frames in which white references have at least half of `deviation` there.
    - `some_whites`: 1 if white references deviate at the position in some white frames but not in all; else 0.
    - `spot`: fraction of the patches at the position that have a wrong colour in the mean of the white frames.
    - `in_first`: 1 if at least 80 % of the frames differ at the position from the frame registered first; else 0.
    - `share`: fraction of the print that deviates.
    - `deviation`: relative deviation in the channel that deviates most; negative is darker.
    - `tint`: range of the deviations of the channels, relative to `deviation`; 0 if all channels are alike.
    - `added`: light added to the patches at the position, equal for all colours, as a fraction of paper white.
    - `kept`: fraction of their own light that the patches at the position still have.
    - `rim`: mean relative deviation of the outermost white references from the flat field; negative is darker.
    - `rim_frames`: fraction of white frames in which `rim` is below −0.5 %.
    - `radial`: fraction of the variance of the references' deviations that depends on the distance from the centre.
    - `hot`: fraction of the affected patches with a photosite that is hot in every dark frame.
    - `scatter`: relative scatter of all patches of the frame about the colours expected from their codes.
    - `softer`: light from neighbouring patches that additional blur brings into the worst sample, as a fraction.
    - `moved_px`: distance of the chart from its registered position, half-size px.
    - `anew`: fraction of frames in which the chart was registered again.
    - `agreement`: correlation of the patches with the chart at the registered position.
    - `exposure`: recorded exposure of the frame that differs most, divided by the usual exposure.
    - `off_codes_deg`: largest angle between an illuminant's white and the prediction from its codes, degrees.
    - `named_right`: 0 if an illuminant's white fits the codes of another illuminant; else not measured.
    - `cameras`: number of cameras or lenses that the raw files name.
    - `room`: light while the projector shows black, as a fraction of white.
    - `room_change`: change of `room` between dark frames, as a fraction of white.
    - `stray`: light of a primary although its code is 0, minus the dark light, as a fraction of that primary.
    - `stray_primaries`: room light in the frames of primaries, as a fraction of white; it makes their sum exceed white.
    - `lone_primary`: relative difference between the amount of one primary in white and the amounts of both others.
    - `mixed`: relative excess of one primary in white, if white lacks about as much of another primary.
    - `colour_scatter`: relative scatter of white's colour between successive white frames, beyond drift.
    - `other_iso`: number of frames with another recorded ISO speed than the settings or most frames.
    - `lit`: fraction of the unfit patches that are too bright because of added light.
    - `misplaced`: fraction of the unfit patches with an uncertain position.
    - `uneven`: fraction of the unfit patches with a rim that differs from the centre.
    - `waves_px`: RMS distance of the tags from a flat sheet, half-size px, scaled to patches of 10 px.
    - `beyond_cell`: fraction of the worst sample's light that comes from outside its patch.
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


# Subject of a figure. Rules refer to subjects, because several figures may have the same causes.
Subject = Literal[
    "block", "few cells", "unfit cells", "spot", "references", "frame", "movement", "noisy cells", "chart", "drift",
    "names", "brightness", "sum", "dark", "stray", "camera", "iso",
]  # fmt: skip


def _subjects(*names: Subject) -> frozenset[Subject]:
    return frozenset(names)


# Groups of subjects.
PLACE = _subjects("block", "few cells")  # A position in single frames
WHOLE_FRAME = _subjects("frame", "movement", "noisy cells")  # All patches of single frames
PRINT = _subjects("spot", "unfit cells", "references")  # A position on the print, in all frames
SHEET = PRINT | _subjects("noisy cells")
DRIFT = _subjects("drift")
LIGHT = _subjects("names", "brightness", "sum", "drift")
DARK = _subjects("dark")
STRAY = _subjects("stray")
CHART = _subjects("chart")

# At the position, no white frame differs from the frame registered first. All frames therefore deviate there equally.
_IN_ALL_FRAMES = (
    Condition("in_first", 0, 0), Condition("even_showing", 0, 0), Condition("some_whites", 0, 0),
    Condition("frames", 2, _INFINITY),
)  # fmt: skip

# The deviation is local, and the frame is not more blurred than the frame registered first.
_SHARP_PLACE = (Condition("share", 0, 0.5), Condition("scatter", 0, 0.1), Condition("softer", -_INFINITY, 0.003))

# At most 34 % of the frames deviate at the position. The frame registered first is correct.
_IN_FEW_FRAMES = (
    Condition("in_first", 0, 0), Condition("frames", 3, _INFINITY), Condition("showing", 1e-9, 0.34),
)  # fmt: skip

# Rules in the order of decision. Rules based on file data and dark frames precede rules based on appearance. The
# intervals of different causes leave gaps, because a wrong cause may lead to an unnecessary session, and an unknown
# cause does less harm.
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
        "the colour of successive white frames alternates; lamp drift does not have this effect",
    ),
    Rule(
        MIXED,
        _subjects("sum", "brightness", "stray"),
        (Condition("mixed", 0.01, 0.5),),
        "white contains too much of one primary, and about as much too little of another",
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
        "the white of an illuminant fits the codes of another illuminant, and not its own codes",
    ),
    Rule(
        ROOM_LIGHT,
        DARK,
        (Condition("room_change", 0.002, _INFINITY),),
        "the light changes between dark frames; a projector's black is constant",
    ),
    Rule(
        ROOM_LIGHT,
        DARK,
        (Condition("room", 0.02, _INFINITY), Condition("frames", 1, _INFINITY)),
        "the light exceeds 2 % of white, which is more than the black of any projector",
    ),
    Rule(
        ROOM_LIGHT,
        STRAY,
        (Condition("stray", 0.004, 0.1),),
        "illuminants contain light of a primary whose code is 0, after subtraction of the dark frames",
    ),
    Rule(
        ROOM_LIGHT,
        STRAY,
        (Condition("stray_primaries", 0.004, 0.1),),
        "white has less of each primary than the frame of this primary, by the same fraction, and the lamp is steady; "
        "a projector that reduces full white has the same effect",
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
        "the tags are more blurred than in the frame registered first, and patches contain light of their neighbours",
    ),
    Rule(
        ANOTHER_PRINT,
        WHOLE_FRAME | PLACE | CHART,
        (Condition("scatter", 0.2, _INFINITY), Condition("softer", -_INFINITY, 0.012)),
        "the patches do not have the colours of their codes, although the tags are sharp",
    ),
    Rule(
        ANOTHER_PRINT,
        CHART,
        (Condition("agreement", -1, 0.5),),
        "the colours of patches and chart are uncorrelated",
    ),
    Rule(
        BUMP,
        _subjects("movement"),
        (Condition("anew", 1e-9, 1), Condition("moved_px", 0.5, _INFINITY), Condition("softer", -_INFINITY, 0.003)),
        "the tags are at other positions than before, and equally sharp",
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
        "nearly all frames differ at one position from the frame registered first, so the object is in that frame",
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
        "light is added at one position in few frames, and the patches have lost none of their own light",
    ),
    Rule(
        OBJECT_IN_FRAME,
        _subjects("block"),
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("kept", -_INFINITY, 0.85), *_SHARP_PLACE),
        "in few frames, the patches at one position lose the same fraction of their own light",
    ),
    Rule(
        OBJECT_IN_FRAME,
        PLACE | _subjects("unfit cells"),
        (*_IN_FEW_FRAMES, Condition("spot", 0, 0.1), Condition("deviation", -1, 0), *_SHARP_PLACE),
        "one position is darker in few frames, and is correct in the others and under white",
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
        "light is added at one position in all frames, and dark colours change most",
    ),
    Rule(
        FALL_OFF,
        _subjects("references"),
        (Condition("radial", 0.5, 1), Condition("rim", -1, -0.005), Condition("rim_frames", 0.9, 1)),
        "in nearly all white frames, the rim is too dark, and deviations depend mainly on the distance from the centre",
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
        "a position is darker in all frames, in proportion to its light, and most in one channel",
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
        "white references are dark at one position in nearly all white frames, and most in one channel",
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
        "a position is darker in all frames, in proportion to its light, and equally in all channels",
    ),
    Rule(
        REFLECTION,
        _subjects("unfit cells"),
        (Condition("lit", 0.5, 1),),
        "most of the affected patches and their neighbours are too bright by the same amount, whatever their colour",
    ),
    Rule(
        CURL,
        _subjects("unfit cells"),
        (Condition("misplaced", 0.5, 1), Condition("waves_px", 0.3, _INFINITY)),
        "most of the affected patches have an uncertain position, and the tags are not in one plane",
    ),
    Rule(
        SPREAD,
        _subjects("unfit cells", "noisy cells"),
        (Condition("beyond_cell", 0.01, _INFINITY), Condition("uneven", 0.5, 1)),
        "rim and centre of patches differ, and samples contain light from outside their patches",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Decision:
    """Probable cause of a figure beyond its limit, with the rule that applied; None if the cause is unknown.

    - `follows`: name of the related figure from which the cause was taken; else "".
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
