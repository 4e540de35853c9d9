"""What goes wrong in the simulated lab while a session is taken: events as frozen values, by frame or by time.

An event says from which frame to which it lasts, or from which second to which; both count since the session began,
frames as the camera exposes them (from 0, retaken ones included), seconds by the lab's clock. It changes a frame in
one of three places: what is shown, and the light, chart, lens and sensor (a `Situation`), or the counts that go into
the file. All are functions of an event and a `Moment`, so that a frame comes out the same whoever asks and whatever
was asked before.

Sizes that are left out are chosen: large enough to be wrong, small enough to be overlooked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from drivers.presenter import BLACK, Colour
from foundation.colorimetry import decode_srgb
from foundation.errors import ConfigurationError
from sim.world.world import UNDISTURBED, Blob, Glare, Patch, Place, Situation

_HALF: Final[Place] = (-9.0, 0.5, 9.0, 9.0)  # The lower half of the picture, its overscan included

# A shoulder that reaches over a quarter of the chart from its lower right.
_QUARTER: Final[Place] = (0.5, 0.35, 1.1, 1.4)

# Most of the upper half of the page: what a matt surface mirrors of a lamp is broad.
_SPOT: Final[Place] = (0.1, -0.2, 0.9, 0.8)

_PRIMARIES: Final = ("red", "green", "blue")

_PATCH: Final = 6.0  # Standard deviation of a screen saver's patches, sixtieths of the picture's height

_SLANTED_DEG: Final = 30.0  # Direction of a push, clockwise from the right: along neither axis


_Code = Annotated[int, Field(ge=0, le=255)]  # A code of a colour, as files of settings give it


@dataclass(frozen=True)
class Moment:
    """When a frame is exposed, and what is ordered.

    - `frame`: exposures before it in this session.
    - `at_s`: seconds since the lab opened for the session.
    - `colour`: what is to be shown.
    - `before`: of each frame before it, in taking order: its second, and what was ordered.
    """

    frame: int
    at_s: float = 0.0
    colour: Colour = BLACK
    before: tuple[tuple[float, Colour], ...] = ()


@dataclass(frozen=True)
class Disturbance:
    """An event: when it is there. What it does is in the subclasses.

    - `from_frame`, `to_frame`: first and last frame; None: no last one.
    - `from_s`, `to_s`: first and last second; None: no limit.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    from_frame: int = 0
    to_frame: int | None = None
    from_s: float | None = None
    to_s: float | None = None

    def __post_init__(self) -> None:
        for name, first, last in (("frame", self.from_frame, self.to_frame), ("s", self.from_s, self.to_s)):
            if first is not None and last is not None and last < first:
                raise ValueError(f"it ends with to_{name} = {last:g} before it begins with from_{name} = {first:g}")

    def is_there(self, moment: Moment) -> bool:
        """Return whether it is there at a moment."""
        return (
            self.from_frame <= moment.frame
            and (self.to_frame is None or moment.frame <= self.to_frame)
            and (self.from_s is None or self.from_s <= moment.at_s)
            and (self.to_s is None or moment.at_s <= self.to_s)
        )

    def shown(self, colour: Colour, moment: Moment) -> Colour:
        """Return what is on the screen in place of `colour`."""
        return colour

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Return the situation with what the event does to it."""
        return situation

    def counted(self, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return the counts (rows, columns) uint16 that go into the file in place of `counts`."""
        return counts


@dataclass(frozen=True)
class _Gradual(Disturbance):
    """What grows evenly from its begin to its end, and then stays."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.to_frame is None and self.to_s is None:
            raise ValueError("it grows until to_frame or to_s: one of them must be given")

    def is_there(self, moment: Moment) -> bool:
        return self.from_frame <= moment.frame and (self.from_s is None or self.from_s <= moment.at_s)

    def grown(self, moment: Moment) -> float:
        """Return how far it has grown, 0 … 1."""
        if self.to_frame is not None:
            return min((moment.frame - self.from_frame) / max(self.to_frame - self.from_frame, 1), 1.0)
        assert self.to_s is not None
        first = self.from_s or 0.0
        return min((moment.at_s - first) / max(self.to_s - first, 1e-9), 1.0)


@dataclass(frozen=True)
class FrozenScreen(Disturbance):
    """The picture sticks: the projector goes on showing what it showed in the last frame before."""

    what: Literal["frozen screen"] = "frozen screen"

    def shown(self, colour: Colour, moment: Moment) -> Colour:
        """Return what was ordered for the last frame before it."""
        for frame, (at_s, ordered) in reversed(tuple(enumerate(moment.before))):
            if not self.is_there(Moment(frame, at_s)):
                return ordered
        return BLACK


@dataclass(frozen=True)
class PopUp(Disturbance):
    """A window in front of the picture: its place on the page, its codes, and its share of the exposure's time."""

    what: Literal["pop-up"] = "pop-up"
    place: Place = (0.55, 0.05, 0.9, 0.3)
    colour: tuple[_Code, _Code, _Code] = (255, 136, 0)
    share: float = 1.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Lay the window over the picture."""
        return replace(situation, patches=(*situation.patches, Patch(self.place, Colour(*self.colour), self.share)))


@dataclass(frozen=True)
class HalfChanged(Disturbance):
    """A part of the picture, its lower half unless said, still shows the frame before."""

    what: Literal["half-changed"] = "half-changed"
    place: Place = _HALF
    share: float = 1.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Leave the last colour in its place."""
        last = moment.before[-1][1] if moment.before else BLACK
        return replace(situation, patches=(*situation.patches, Patch(self.place, last, self.share)))


@dataclass(frozen=True)
class Bump(Disturbance):
    """The chart, or the camera, has been pushed: by `px` half-size pixels at the chart's middle, or by `mm`, or both.

    `direction_deg` is clockwise from the right; `turn_deg` turns the chart about its middle.
    """

    what: Literal["bump"] = "bump"
    px: float = 0.0
    mm: float = 0.0
    direction_deg: float = _SLANTED_DEG
    turn_deg: float = 0.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Push the chart from where it is."""
        x, y = math.cos(math.radians(self.direction_deg)), math.sin(math.radians(self.direction_deg))
        (px_x, px_y), (mm_x, mm_y) = situation.bump_px, situation.bump_mm
        return replace(
            situation,
            bump_px=(px_x + self.px * x, px_y + self.px * y),
            bump_mm=(mm_x + self.mm * x, mm_y + self.mm * y),
            turn_deg=situation.turn_deg + self.turn_deg,
        )


@dataclass(frozen=True)
class LampStep(Disturbance):
    """The lamp's light changes at once by `percent`; red, green and blue each by its own with `rgb`, on top."""

    what: Literal["lamp step"] = "lamp step"
    percent: float = -10.0
    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Dim or brighten the lamp."""
        return _lit(situation, self.percent, self.rgb, 1.0)


@dataclass(frozen=True)
class LampDrift(_Gradual):
    """The lamp's light changes evenly to `percent` at the end; the primaries each by its own with `rgb`, on top."""

    what: Literal["lamp drift"] = "lamp drift"
    percent: float = -2.0
    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Dim or brighten the lamp."""
        return _lit(situation, self.percent, self.rgb, self.grown(moment))


@dataclass(frozen=True)
class AmbientStep(Disturbance):
    """A light goes on in the room: `percent` of the projector's white, by its primaries as `rgb` over their mean."""

    what: Literal["ambient step"] = "ambient step"
    percent: float = 1.0
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add its light."""
        red, green, blue = (
            light + self.percent / 100 * share for light, share in zip(situation.ambient, self.rgb, strict=True)
        )
        return replace(situation, ambient=(red, green, blue))


@dataclass(frozen=True)
class Defocus(Disturbance):
    """The lens has been turned: further blur of standard deviation `px`, half-size pixels."""

    what: Literal["defocus"] = "defocus"
    px: float = 1.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Blur the picture."""
        return replace(situation, defocus_px=math.hypot(situation.defocus_px, self.px))


@dataclass(frozen=True)
class Person(Disturbance):
    """Someone stands before the chart: an ellipse at a place on the page, from where `left` of the light comes."""

    what: Literal["person"] = "person"
    place: Place = _QUARTER
    left: float = 0.08

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Stand there."""
        return replace(situation, blobs=(*situation.blobs, Blob(self.place, self.left)))


@dataclass(frozen=True)
class SensorWarming(_Gradual):
    """The sensor warms up: its black level rises evenly by `dn` at the end."""

    what: Literal["sensor warming"] = "sensor warming"
    dn: float = 6.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Raise the black level."""
        return replace(situation, black_dn=situation.black_dn + self.dn * self.grown(moment))


@dataclass(frozen=True)
class StaleFile(Disturbance):
    """The camera delivers the counts of the frame before once more; with `new_header`, as taken now."""

    what: Literal["stale file"] = "stale file"
    new_header: bool = False


@dataclass(frozen=True)
class ZeroedStrip(Disturbance):
    """A part of the file was lost: rows from `top` to `bottom`, shares of the sensor's height, hold zeros."""

    what: Literal["zeroed strip"] = "zeroed strip"
    top: float = 0.5
    bottom: float = 0.55

    def counted(self, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return counts (rows, columns) uint16 with zeros in those rows."""
        torn = counts.copy()
        torn[_rows(counts, self.top, self.bottom)] = 0
        return torn


@dataclass(frozen=True)
class ScrambledRows(Disturbance):
    """A part of the file is in disorder: rows from `top` to `bottom`, shares of the sensor's height, are shuffled."""

    what: Literal["scrambled rows"] = "scrambled rows"
    top: float = 0.4
    bottom: float = 0.6
    seed: int = 0

    def counted(self, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return counts (rows, columns) uint16 with those rows in another order."""
        torn = counts.copy()
        rows = _rows(counts, self.top, self.bottom)
        torn[rows] = np.random.default_rng(self.seed).permutation(counts[rows])
        return torn


@dataclass(frozen=True)
class Reflection(Disturbance):
    """The print mirrors light into the camera: `percent` of what bare paper sends, in the middle of a soft ellipse."""

    what: Literal["reflection"] = "reflection"
    place: Place = _SPOT
    percent: float = 3.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add it."""
        return replace(situation, glares=(*situation.glares, Glare(self.place, self.percent / 100)))


@dataclass(frozen=True)
class DeadPrimary(Disturbance):
    """The projector gives none of a primary's light: an LED, a panel or a wire of the cable has failed."""

    what: Literal["dead primary"] = "dead primary"
    primary: Literal["red", "green", "blue"] = "red"

    def shown(self, colour: Colour, moment: Moment) -> Colour:
        """Return the colour without it."""
        return Colour(**{name: 0 if name == self.primary else getattr(colour, name) for name in _PRIMARIES})


@dataclass(frozen=True)
class ScreenSaver(Disturbance):
    """Another picture of soft patches is drawn over the projector's; `share`: of its light, the rest is as ordered."""

    what: Literal["screen saver"] = "screen saver"
    share: float = 1.0
    seed: int = 1

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Draw it."""
        from scipy.ndimage import gaussian_filter

        noise = np.random.default_rng(self.seed).random((60, 96, 3))
        soft = gaussian_filter(noise, (_PATCH, _PATCH, 0))
        drawn = (soft - soft.min()) / np.ptp(soft)
        ordered = decode_srgb(np.array(moment.colour) / 255)
        mixed = self.share * drawn + (1 - self.share) * ordered
        return replace(situation, picture=mixed.astype(np.float32))


# Every event, by its `what`.
AnyDisturbance = (
    FrozenScreen | PopUp | HalfChanged | Bump | LampStep | LampDrift | AmbientStep | Defocus | Person | SensorWarming
    | StaleFile | ZeroedStrip | ScrambledRows | Reflection | DeadPrimary | ScreenSaver
)  # fmt: skip

_LISTED: Final[TypeAdapter[tuple[AnyDisturbance, ...]]] = TypeAdapter(
    tuple[Annotated[AnyDisturbance, Field(discriminator="what")], ...]
)

KINDS: Final = tuple(str(kind.what) for kind in get_args(AnyDisturbance))  # What can happen, as settings name it


@dataclass(frozen=True)
class Disturbances:
    """Every event of a session, those that come later over those before."""

    events: tuple[AnyDisturbance, ...] = ()

    def at(self, moment: Moment) -> tuple[AnyDisturbance, ...]:
        """Return the events that are there at a moment."""
        return tuple(event for event in self.events if event.is_there(moment))

    def shown(self, moment: Moment) -> Colour:
        """Return what is on the screen."""
        colour = moment.colour
        for event in self.at(moment):
            colour = event.shown(colour, moment)
        return colour

    def situation(self, moment: Moment) -> Situation:
        """Return what is otherwise than in the undisturbed room."""
        situation = UNDISTURBED
        for event in self.at(moment):
            situation = event.changed(situation, moment)
        return situation

    def counted(self, counts: NDArray[np.uint16], moment: Moment) -> NDArray[np.uint16]:
        """Return the counts (rows, columns) uint16 that go into the file in place of those that were exposed."""
        for event in self.at(moment):
            counts = event.counted(counts)
        return counts

    def stale(self, moment: Moment) -> StaleFile | None:
        """Return the event by which the camera delivers the last file again, None where it does not."""
        return next((event for event in self.at(moment) if isinstance(event, StaleFile)), None)

    @property
    def repeats_files(self) -> bool:
        """Whether a file is ever delivered again."""
        return any(isinstance(event, StaleFile) for event in self.events)


CALM: Final = Disturbances()  # Nothing goes wrong


def read_disturbances(listed: Sequence[Any], where: str, key: str = "simulated.events") -> Disturbances:
    """Return the events of a settings file: tables with `what` (one of `KINDS`) and an event's own keys."""
    try:
        return Disturbances(_LISTED.validate_python(listed))
    except ValidationError as error:
        first = error.errors()[0]
        place = [part for part in first["loc"] if part not in KINDS]
        at = ".".join([f"{key}[{place[0]}]" if place else key, *(str(part) for part in place[1:])])
        raise ConfigurationError(f"{where}: {at}{_said_of(first)}") from error


def _said_of(fault: ErrorDetails) -> str:
    """Return what is wrong with a table or a key of it, behind its place, and what is expected."""
    given = f" = {fault['input']!r}"
    kinds = ", ".join(KINDS)
    known = {"union_tag_not_found": f"{given} does not say what happens; add what, one of {kinds}"}
    known["union_tag_invalid"] = f"{given}: there is no such event; what is one of {kinds}"
    known["extra_forbidden"] = known["unexpected_keyword_argument"] = " is no key of this event; remove it"
    known["missing"] = " is missing; add it"
    for words, expected in _EXPECTED.items():
        if fault["type"].startswith(words):
            return f"{given}: {expected} is expected; correct it"
    return known.get(fault["type"], f"{given}: {fault['msg'].removeprefix('Value error, ')}; correct it")


# What a value should have been, by the first words of the kind of fault.
_EXPECTED: Final = {
    "float_": "a number",
    "int_": "a whole number",
    "greater_than_equal": "a code from 0 to 255",
    "less_than_equal": "a code from 0 to 255",
    "bool_": "true or false",
    "tuple_type": "a list of numbers",
    "too_": "a shorter list",
    "dataclass_type": "a table",
    "model_attributes_type": "a table",
}


def _lit(situation: Situation, percent: float, rgb: tuple[float, float, float], grown: float) -> Situation:
    red, green, blue = (
        light * (1 + percent / 100 * grown) * (1 + own / 100 * grown)
        for light, own in zip(situation.lamp, rgb, strict=True)
    )
    return replace(situation, lamp=(red, green, blue))


def _rows(counts: NDArray[np.uint16], top: float, bottom: float) -> slice:
    return slice(round(top * len(counts)), round(bottom * len(counts)))
