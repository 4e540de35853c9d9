"""The causes that a remark or a refusal may name, each with what it is, what helps, and what is to be taken again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Mends = Literal["frames", "session", "nothing"]
"""What is to be taken again: the frames that are named, the whole session, or nothing, as no new frame helps."""


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
    "frames of another exposure than the rest, by their files",
    "expose all frames alike, manually: shutter, aperture and ISO speed",
    "frames",
)
ROOM_LIGHT = Cause(
    "room light",
    "light of the room: it is there while the projector shows black",
    "darken the room, cover lamps and displays, keep daylight out",
    "session",
)
VEIL = Cause(
    "veil",
    "veiling glare: the lens spreads part of the frame's light over all of it",
    "clean the lens, use its hood, and hang black cloth around the print",
    "session",
)
UNKNOWN = Cause("unknown", "", "", "nothing")
"""What was measured does not decide; the remedy is then that of the limit."""

CAUSES = (
    HOT_PHOTOSITES, OBJECT_IN_FRAME, REFLECTION, REFLECTION_IN_FRAME, STAIN, SHADOW, CURL, FALL_OFF, SPREAD, BUMP,
    DEFOCUS, ANOTHER_PRINT, WRONG_NAME,
    OTHER_CAMERA, OTHER_EXPOSURE, ROOM_LIGHT, VEIL, UNKNOWN,
)  # fmt: skip
"""All of them."""
