"""Disturbances of a simulated session, such as a bumped chart: events that last for some frames or seconds.

Frames and seconds count from the start of the session. Frames are numbered from 0 as the camera exposes them, including
repeated frames. Seconds follow the clock of the laboratory. An event changes the displayed colour, the `Situation`
(light, chart, lens, sensor), or the counts in the file. The effect depends only on the event and the `Moment`, not on
earlier calls.

The default sizes are chosen so that the frame is wrong but looks right to a person.
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

# Lower half of the picture, including the margin outside of the page.
_LOWER_HALF: Final[Place] = (-9.0, 0.5, 9.0, 9.0)

# Lower right quarter of the chart, which the shoulder of a person covers.
_LOWER_RIGHT_QUARTER: Final[Place] = (0.5, 0.35, 1.1, 1.4)

# Most of the upper half of the page, because matt surfaces have broad reflections.
_REFLECTION_PLACE: Final[Place] = (0.1, -0.2, 0.9, 0.8)

_PRIMARIES: Final = ("red", "green", "blue")

# Standard deviation of the blur that makes the soft patches of a screen saver, in pixels of its picture of 96 × 60.
_SAVER_BLUR_PX: Final = 6.0

_PUSH_DIRECTION_DEG: Final = 30.0  # Default direction of a push, clockwise from the right.


_Code = Annotated[int, Field(ge=0, le=255)]  # Code of a colour in settings files.


@dataclass(frozen=True)
class Moment:
    """Time of an exposure, and the colour that the computer sends to the projector (ordered colour)."""

    frame: int  # Number of earlier exposures in the session
    at_s: float = 0.0  # Seconds since the start of the session
    colour: Colour = BLACK  # Ordered colour
    earlier_frames: tuple[tuple[float, Colour], ...] = ()  # Time in seconds and ordered colour of each earlier frame


@dataclass(frozen=True)
class Disturbance:
    """An event; subclasses define its effect."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    from_frame: int = 0
    to_frame: int | None = None  # Last frame; None for no end
    from_s: float | None = None  # First second; None for no limit
    to_s: float | None = None  # Last second; None for no limit

    def __post_init__(self) -> None:
        for name, first, last in (("frame", self.from_frame, self.to_frame), ("s", self.from_s, self.to_s)):
            if first is not None and last is not None and last < first:
                raise ValueError(f"its end to_{name} = {last:g} is before its start from_{name} = {first:g}")

    def is_active(self, moment: Moment) -> bool:
        """Return whether the event is active at a moment."""
        return (
            self.from_frame <= moment.frame
            and (self.to_frame is None or moment.frame <= self.to_frame)
            and (self.from_s is None or self.from_s <= moment.at_s)
            and (self.to_s is None or moment.at_s <= self.to_s)
        )

    def shown(self, colour: Colour, moment: Moment) -> Colour:
        """Return the displayed colour."""
        return colour

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Return the situation with the effect of the event."""
        return situation

    def counted(self, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return the counts (rows, columns) uint16 for the file."""
        return counts


@dataclass(frozen=True)
class _Gradual(Disturbance):
    """An event whose effect grows linearly until the end of the event, and then remains constant."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.to_frame is None and self.to_s is None:
            raise ValueError("its end is missing, expected to_frame or to_s; add one")

    def is_active(self, moment: Moment) -> bool:
        return self.from_frame <= moment.frame and (self.from_s is None or self.from_s <= moment.at_s)

    def progress(self, moment: Moment) -> float:
        """Return the size of the effect, 0 to 1."""
        if self.to_frame is not None:
            return min((moment.frame - self.from_frame) / max(self.to_frame - self.from_frame, 1), 1.0)
        assert self.to_s is not None
        first = self.from_s or 0.0
        return min((moment.at_s - first) / max(self.to_s - first, 1e-9), 1.0)


@dataclass(frozen=True)
class FrozenScreen(Disturbance):
    """The picture is frozen: the projector still shows the colour of the last frame before the event."""

    what: Literal["frozen screen"] = "frozen screen"

    def shown(self, colour: Colour, moment: Moment) -> Colour:
        """Return the colour that was ordered for the last frame before the event."""
        for frame, (at_s, ordered) in reversed(tuple(enumerate(moment.earlier_frames))):
            if not self.is_active(Moment(frame, at_s)):
                return ordered
        return BLACK


@dataclass(frozen=True)
class PopUp(Disturbance):
    """A window in front of the picture covers `place` with the codes `colour` for `share` of the exposure time."""

    what: Literal["pop-up"] = "pop-up"
    place: Place = (0.55, 0.05, 0.9, 0.3)
    colour: tuple[_Code, _Code, _Code] = (255, 136, 0)
    share: float = 1.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add the window."""
        return replace(situation, patches=(*situation.patches, Patch(self.place, Colour(*self.colour), self.share)))


@dataclass(frozen=True)
class HalfChanged(Disturbance):
    """A part of the picture, by default its lower half, still shows the previous frame."""

    what: Literal["half-changed"] = "half-changed"
    place: Place = _LOWER_HALF
    share: float = 1.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add the previous colour in this part."""
        last = moment.earlier_frames[-1][1] if moment.earlier_frames else BLACK
        return replace(situation, patches=(*situation.patches, Patch(self.place, last, self.share)))


@dataclass(frozen=True)
class Bump(Disturbance):
    """The chart is shifted by `px` half-size pixels, by `mm` millimetres, or by the sum of both.

    `direction_deg` is clockwise from the right; `turn_deg` rotates the chart about its centre.
    """

    what: Literal["bump"] = "bump"
    px: float = 0.0
    mm: float = 0.0
    direction_deg: float = _PUSH_DIRECTION_DEG
    turn_deg: float = 0.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Shift and rotate the chart from its position."""
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
    """The lamp brightness changes suddenly by `percent`; `rgb` are further changes of each primary, in percent."""

    what: Literal["lamp step"] = "lamp step"
    percent: float = -10.0
    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Change the lamp brightness."""
        return _with_lamp(situation, self.percent, self.rgb, 1.0)


@dataclass(frozen=True)
class LampDrift(_Gradual):
    """The lamp brightness changes linearly by `percent`; `rgb` are further changes of each primary, in percent."""

    what: Literal["lamp drift"] = "lamp drift"
    percent: float = -2.0
    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Change the lamp brightness."""
        return _with_lamp(situation, self.percent, self.rgb, self.progress(moment))


@dataclass(frozen=True)
class AmbientStep(Disturbance):
    """A lamp in the room is switched on. It adds `percent` of the full light to each primary, multiplied by `rgb`."""

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
    """The lens was turned: additional blur with standard deviation `px`, half-size pixels."""

    what: Literal["defocus"] = "defocus"
    px: float = 1.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add the blur."""
        return replace(situation, defocus_px=math.hypot(situation.defocus_px, self.px))


@dataclass(frozen=True)
class Person(Disturbance):
    """A person in front of the chart: a dark ellipse in the rectangle `place`, with the share `left` of the light."""

    what: Literal["person"] = "person"
    place: Place = _LOWER_RIGHT_QUARTER
    left: float = 0.08

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add the person."""
        return replace(situation, blobs=(*situation.blobs, Blob(self.place, self.left)))


@dataclass(frozen=True)
class SensorWarming(_Gradual):
    """The sensor warms up: its black level increases linearly by `dn`."""

    what: Literal["sensor warming"] = "sensor warming"
    dn: float = 6.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Increase the black level."""
        return replace(situation, black_dn=situation.black_dn + self.dn * self.progress(moment))


@dataclass(frozen=True)
class StaleFile(Disturbance):
    """The camera delivers the previous counts again. If `new_header` is true, the file has the new date."""

    what: Literal["stale file"] = "stale file"
    new_header: bool = False


@dataclass(frozen=True)
class ZeroedStrip(Disturbance):
    """A part of the file is lost: rows from `top` to `bottom`, relative to the sensor height, are 0."""

    what: Literal["zeroed strip"] = "zeroed strip"
    top: float = 0.5
    bottom: float = 0.55

    def counted(self, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return the counts (rows, columns) uint16, 0 in the lost rows."""
        damaged = counts.copy()
        damaged[_rows(counts, self.top, self.bottom)] = 0
        return damaged


@dataclass(frozen=True)
class ScrambledRows(Disturbance):
    """A part of the file is damaged: rows from `top` to `bottom`, relative to the sensor height, are shuffled."""

    what: Literal["scrambled rows"] = "scrambled rows"
    top: float = 0.4
    bottom: float = 0.6
    seed: int = 0

    def counted(self, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return the counts (rows, columns) uint16 with these rows shuffled."""
        damaged = counts.copy()
        rows = _rows(counts, self.top, self.bottom)
        damaged[rows] = np.random.default_rng(self.seed).permutation(counts[rows])
        return damaged


@dataclass(frozen=True)
class Reflection(Disturbance):
    """A specular reflection: a soft ellipse, whose centre has `percent` of the light from bare paper."""

    what: Literal["reflection"] = "reflection"
    place: Place = _REFLECTION_PLACE
    percent: float = 3.0

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add the reflection."""
        return replace(situation, glares=(*situation.glares, Glare(self.place, self.percent / 100)))


@dataclass(frozen=True)
class DeadPrimary(Disturbance):
    """The projector emits no light of one primary: an LED, panel or wire has failed."""

    what: Literal["dead primary"] = "dead primary"
    primary: Literal["red", "green", "blue"] = "red"

    def shown(self, colour: Colour, moment: Moment) -> Colour:
        """Return the colour without this primary."""
        return Colour(**{name: 0 if name == self.primary else getattr(colour, name) for name in _PRIMARIES})


@dataclass(frozen=True)
class ScreenSaver(Disturbance):
    """A screen saver with soft patches of random colours; the ordered colour keeps 1 − `share` of the light."""

    what: Literal["screen saver"] = "screen saver"
    share: float = 1.0
    seed: int = 1

    def changed(self, situation: Situation, moment: Moment) -> Situation:
        """Add the picture."""
        from scipy.ndimage import gaussian_filter

        noise = np.random.default_rng(self.seed).random((60, 96, 3))
        soft = gaussian_filter(noise, (_SAVER_BLUR_PX, _SAVER_BLUR_PX, 0))
        picture = (soft - soft.min()) / np.ptp(soft)
        ordered = decode_srgb(np.array(moment.colour) / 255)
        mixed = self.share * picture + (1 - self.share) * ordered
        return replace(situation, picture=mixed.astype(np.float32))


# All events.
AnyDisturbance = (
    FrozenScreen | PopUp | HalfChanged | Bump | LampStep | LampDrift | AmbientStep | Defocus | Person | SensorWarming
    | StaleFile | ZeroedStrip | ScrambledRows | Reflection | DeadPrimary | ScreenSaver
)  # fmt: skip

_LISTED: Final[TypeAdapter[tuple[AnyDisturbance, ...]]] = TypeAdapter(
    tuple[Annotated[AnyDisturbance, Field(discriminator="what")], ...]
)

KINDS: Final = tuple(str(event.what) for event in get_args(AnyDisturbance))  # Names of events in settings.


@dataclass(frozen=True)
class Disturbances:
    """All events of a session. They are applied in this order."""

    events: tuple[AnyDisturbance, ...] = ()

    def at(self, moment: Moment) -> tuple[AnyDisturbance, ...]:
        """Return the active events."""
        return tuple(event for event in self.events if event.is_active(moment))

    def shown(self, moment: Moment) -> Colour:
        """Return the displayed colour."""
        colour = moment.colour
        for event in self.at(moment):
            colour = event.shown(colour, moment)
        return colour

    def situation(self, moment: Moment) -> Situation:
        """Return the differences from the undisturbed room."""
        situation = UNDISTURBED
        for event in self.at(moment):
            situation = event.changed(situation, moment)
        return situation

    def counted(self, counts: NDArray[np.uint16], moment: Moment) -> NDArray[np.uint16]:
        """Return the counts (rows, columns) uint16 for the file."""
        for event in self.at(moment):
            counts = event.counted(counts)
        return counts

    def stale(self, moment: Moment) -> StaleFile | None:
        """Return the active event that repeats a file, or None."""
        return next((event for event in self.at(moment) if isinstance(event, StaleFile)), None)

    @property
    def repeats_files(self) -> bool:
        """Whether any event repeats a file."""
        return any(isinstance(event, StaleFile) for event in self.events)


CALM: Final = Disturbances()  # No events.


def read_disturbances(tables: Sequence[Any], where: str, key: str = "simulated.events") -> Disturbances:
    """Return the events of a settings file: tables with `what` (one of `KINDS`) and keys of this event."""
    try:
        return Disturbances(_LISTED.validate_python(tables))
    except ValidationError as error:
        first = error.errors()[0]
        path = [component for component in first["loc"] if component not in KINDS]
        full_key = ".".join([f"{key}[{path[0]}]" if path else key, *(str(component) for component in path[1:])])
        raise ConfigurationError(f"{where}: {full_key}{_message(first)}") from error


def _message(fault: ErrorDetails) -> str:
    # The end of a message, after the key: the value, the expectation and the remedy.
    value = f" = {fault['input']!r}"
    kinds = ", ".join(KINDS)
    messages = {"union_tag_not_found": f"{value} has no event name; add what, one of {kinds}"}
    messages["union_tag_invalid"] = f"{value}: unknown event, expected one of {kinds}; correct it"
    messages["extra_forbidden"] = messages["unexpected_keyword_argument"] = " is not a key of this event; remove it"
    messages["missing"] = " is missing; add it"
    for words, expected in _EXPECTED.items():
        if fault["type"].startswith(words):
            return f"{value}: expected {expected}; correct it"
    return messages.get(fault["type"], f"{value}: {fault['msg'].removeprefix('Value error, ')}; correct it")


# Expected value, by the beginning of the error type of pydantic.
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


def _with_lamp(situation: Situation, percent: float, rgb: tuple[float, float, float], progress: float) -> Situation:
    red, green, blue = (
        light * (1 + percent / 100 * progress) * (1 + change / 100 * progress)
        for light, change in zip(situation.lamp, rgb, strict=True)
    )
    return replace(situation, lamp=(red, green, blue))


def _rows(counts: NDArray[np.uint16], top: float, bottom: float) -> slice:
    return slice(round(top * len(counts)), round(bottom * len(counts)))
