"""What an EOS body has reported of itself, and what follows from it for a series of raw frames.

Rules that hold inside:

- `EosState` takes the records of GetEvent in their order and holds nothing that was not reported.
- What a body does not report is no problem: properties come and go between bodies, and only what is known to spoil a
  series is named.
- Nothing is taken for settable that the body does not list.
- What a body reports costs no more memory than `MAX_PROPERTIES` values of `MAX_VALUE` bytes, and as many lists; what is
  beyond that is passed over, for no real body comes near it.

Source: layouts and numbers as recorded from an EOS 60D; the number of mirror lockup among the custom functions as
ExifTool names it (CanonCustom::Functions2).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from drivers.camera import ExposureSettings
from drivers.canon.apex import APERTURE, ISO, SHUTTER, Scale
from drivers.canon.records import (
    AvailableFormats,
    AvailableValues,
    Notice,
    ObjectEvent,
    PropertyChanged,
    Record,
    TransferRequest,
)
from drivers.canon.values import RAW_ONLY, ImageFormat, number_of, number_value, text_of
from drivers.ptp.codes import (
    AeMode,
    CameraStatus,
    CaptureDestination,
    DriveMode,
    EosEvent,
    FocusMode,
    ObjectFormat,
    Property,
    WhiteBalance,
)
from drivers.ptp.cursor import Cursor
from foundation.errors import DeviceRefused, InputError, ProtocolError

MIRROR_LOCKUP_FUNCTION = 0x060F
"""Number of mirror lockup among the custom functions, on bodies that have it there."""

MAX_PROPERTIES = 1024
"""Properties that are remembered; a real body reports 80 to 300."""
MAX_VALUE = 1 << 14
"""Bytes of a property's value that are remembered; the longest known, of focus points, has some 5000."""
MAX_LIST = 1024
"""Values of a property's list that are remembered; the longest known, of image formats, has 31 and of Kelvin 76."""
_MAX_WAITING = 64
"""Objects that are remembered; more than a body's memory holds."""
_NOT_RAW = (ObjectFormat.EXIF_JPEG, ObjectFormat.JFIF, ObjectFormat.MOV, ObjectFormat.MOV2)
_NOT_RAW_SUFFIXES = (".jpg", ".jpeg", ".hif", ".mov", ".mp4")
_SILENT_OR_PLAIN = (DriveMode.SINGLE, DriveMode.SINGLE_SILENT)
_BATTERY_LOW = 0
"""Of EOS_BATTERY_POWER: 0 is low, as libgphoto2 reads it."""
_BATTERY_LEVELS = {_BATTERY_LOW: 0.0, 5: 0.25, 1: 0.5, 4: 0.75, 2: 1.0}
"""Of EOS_BATTERY_POWER, as libgphoto2 reads it; other numbers are not known."""
_BATTERY_MAINS = 0xFFFFFFFF
"""Of EOS_BATTERY_POWER: mains power, as Canon's EDSDK has it of the same state; not seen on the wire."""


_Kept = TypeVar("_Kept")


@dataclass(frozen=True)
class WaitingObject:
    """An object that the body wants fetched; `size` in bytes as announced, and not to be trusted."""

    handle: int
    format: int
    size: int
    name: str

    @property
    def is_raw(self) -> bool:
        """Whether it is the frame itself rather than the picture or film beside it."""
        return self.format not in _NOT_RAW and not self.name.lower().endswith(_NOT_RAW_SUFFIXES)


@dataclass
class EosState:
    """The properties of a body, what they can be set to, and the objects that wait in its memory.

    - `values`: the value of each property reported so far.
    - `lists`, `formats`: what a property can be set to now.
    - `functions`: the custom functions: number to first value.
    - `busy`: whether the body reported that it is exposing or writing.
    - `shutting_down`: whether it reported that it will soon switch itself off.
    - `waiting`: by handle, in the order of their announcement.
    """

    values: dict[int, bytes] = field(default_factory=dict[int, bytes])
    lists: dict[int, tuple[int, ...]] = field(default_factory=dict[int, tuple[int, ...]])
    formats: dict[int, tuple[ImageFormat, ...]] = field(default_factory=dict[int, tuple[ImageFormat, ...]])
    functions: dict[int, int] = field(default_factory=dict[int, int])
    busy: bool = False
    shutting_down: bool = False
    waiting: dict[int, WaitingObject] = field(default_factory=dict[int, WaitingObject])

    def take(self, records: Iterable[Record]) -> None:
        """Update the state from the records of one answer."""
        for record in records:
            match record:
                case PropertyChanged(Property.EOS_CUSTOM_FUNCTIONS, value):
                    for number, first in custom_functions(value[:MAX_VALUE]).items():
                        _remember(self.functions, number, first)
                case PropertyChanged(code, value):
                    if len(value) <= MAX_VALUE:
                        _remember(self.values, code, value)
                case AvailableValues(code, values):
                    if len(values) <= MAX_LIST:
                        _remember(self.lists, code, values)
                case AvailableFormats(code, formats):
                    if len(formats) <= MAX_LIST:
                        _remember(self.formats, code, formats)
                case TransferRequest():
                    self._announce(WaitingObject(record.handle, record.format, record.size, record.name))
                case ObjectEvent(EosEvent.OBJECT_ADDED | EosEvent.OBJECT_ADDED_64, entry):
                    if entry.format != ObjectFormat.ASSOCIATION:
                        self._announce(WaitingObject(entry.handle, entry.format, entry.size, entry.name))
                case Notice(EosEvent.OBJECT_REMOVED, handle):
                    self.waiting.pop(handle, None)
                case Notice(EosEvent.CAMERA_STATUS_CHANGED, status):
                    self.busy = status == CameraStatus.BUSY
                case Notice(EosEvent.WILL_SOON_SHUT_DOWN):
                    self.shutting_down = True
                case _:
                    pass

    def number(self, code: int) -> int | None:
        """Return the value of a property that is a number, None where it was not reported."""
        value = self.values.get(code)
        return number_of(value) if value is not None and len(value) >= 4 else None

    def text(self, code: int) -> str:
        """Return the value of a property that is text, empty where it was not reported."""
        return text_of(self.values.get(code, b""))

    def holds(self, code: int, value: bytes) -> bool:
        """Return whether a property has this value now."""
        # Some bodies send more bytes than they take.
        return code in self.values and self.values[code][: len(value)] == value

    def _announce(self, waiting: WaitingObject) -> None:
        # An object announced twice keeps its place; of too many the oldest are forgotten.
        self.waiting[waiting.handle] = waiting
        while len(self.waiting) > _MAX_WAITING:
            del self.waiting[next(iter(self.waiting))]


def battery_level(state: EosState) -> float | None:
    """Return the charge that a body reports, 0 … 1 in quarters; None where it does not, or runs on mains power."""
    power = state.number(Property.EOS_BATTERY_POWER)
    return None if power is None else _BATTERY_LEVELS.get(power)


def power_source(state: EosState) -> bool | None:
    """Return whether a body runs on mains power; None where that is not known: it reports a battery for both."""
    return True if state.number(Property.EOS_BATTERY_POWER) == _BATTERY_MAINS else None


def _remember(kept: dict[int, _Kept], code: int, value: _Kept) -> None:
    if code in kept or len(kept) < MAX_PROPERTIES:
        kept[code] = value


def custom_functions(value: bytes) -> dict[int, int]:
    """Return the custom functions in a value of property 0xd1a0: number to first value.

    A value holds one group: its length, 1, the group's number, the length of the rest, the count of functions, then
    for each its number, the count of its values, and those; 32 bits each. What does not fit that is left out.
    """
    cursor = Cursor(value, "custom functions")
    functions: dict[int, int] = {}
    try:
        cursor.integers(4, 4, "the head")
        for _ in range(cursor.u32("the count of functions")):
            number = cursor.u32("the number of a function")
            first, *_ = cursor.array(4, "the values of a function") or (0,)
            functions[number] = first
    except ProtocolError:
        pass
    return functions


def problems(state: EosState) -> list[str]:
    """Return everything about a body's own settings that would spoil a series, each with its remedy."""
    found: list[str] = []
    mode, focus, drive = (
        state.number(code) for code in (Property.EOS_AE_MODE, Property.EOS_FOCUS_MODE, Property.EOS_DRIVE_MODE)
    )
    if mode is not None and mode != AeMode.MANUAL:
        found.append(f"the mode dial stands at {_named(AeMode, mode)}: turn it to M")
    if focus is not None and focus != FocusMode.MANUAL:
        found.append("autofocus is on: set the lens to MF and focus by hand")
    if drive is not None and drive not in _SILENT_OR_PLAIN:
        found.append(f"the drive mode is {_named(DriveMode, drive)}: set single shooting")
    if state.number(Property.EOS_MIRROR_UP_SETTING) or state.functions.get(MIRROR_LOCKUP_FUNCTION) == 1:
        found.append("mirror lockup is on: switch it off")
    if state.number(Property.EOS_AEB) or state.number(Property.EOS_BRACKET_MODE):
        found.append("exposure bracketing is on: switch it off")
    if state.number(Property.EOS_HDR_SETTING):
        found.append("HDR mode is on: switch it off")
    off_after = state.number(Property.EOS_AUTO_POWER_OFF)
    if off_after:
        found.append(f"auto power off is set to {off_after} s: set it to off")
    if state.number(Property.EOS_BATTERY_POWER) == _BATTERY_LOW:
        found.append("the battery is low: charge it, or use mains power")
    return found


def plan(state: EosState, settings: ExposureSettings) -> dict[int, bytes]:
    """Return which property gets which value for a series of raw frames, in the order of setting."""
    refused = problems(state)
    wanted: dict[int, bytes] = {}
    try:
        wanted[Property.EOS_IMAGE_FORMAT] = _raw_format(state).encode()
    except InputError as error:
        refused.append(str(error))
    for code, scale, value in (
        (Property.EOS_ISO_SPEED, ISO, settings.iso),
        (Property.EOS_APERTURE, APERTURE, settings.aperture),
        (Property.EOS_SHUTTER_SPEED, SHUTTER, settings.shutter_s),
    ):
        try:
            wanted[code] = number_value(_code(state, code, scale, value))
        except InputError as error:
            refused.append(str(error))
    if refused:
        raise DeviceRefused(f"the camera cannot take the series: {'; '.join(refused)}")
    if WhiteBalance.DAYLIGHT in state.lists.get(Property.EOS_WHITE_BALANCE, ()):
        # Raw values do not depend on it; a fixed one keeps what converters show the same through the series.
        wanted[Property.EOS_WHITE_BALANCE] = number_value(WhiteBalance.DAYLIGHT)
    return wanted


def shutter_speeds(state: EosState) -> tuple[float, ...]:
    """Return the nominal shutter times that a body lists, seconds, rising; bulb and codes in no table are left out."""
    values = {step.code: step.value for step in SHUTTER.steps}
    return tuple(sorted({values[code] for code in state.lists.get(Property.EOS_SHUTTER_SPEED, ()) if code in values}))


def host_destination(state: EosState) -> bytes:
    """Return the value of property 0xd11c that sends frames to the host."""
    offered = state.lists.get(Property.EOS_CAPTURE_DESTINATION, ())
    if CaptureDestination.HOST not in offered and state.number(Property.EOS_CAPTURE_DESTINATION) != int(
        CaptureDestination.HOST
    ):
        listed = ", ".join(str(value) for value in offered) or "nothing"
        raise DeviceRefused(
            f"the camera offers the capture destinations {listed}, but not {CaptureDestination.HOST.value}, the host; "
            "such a body cannot be tethered here"
        )
    return number_value(CaptureDestination.HOST)


def _raw_format(state: EosState) -> ImageFormat:
    offered = state.formats.get(Property.EOS_IMAGE_FORMAT, ())
    if RAW_ONLY not in offered and not state.holds(Property.EOS_IMAGE_FORMAT, RAW_ONLY.encode()):
        raws = ", ".join(str(item) for item in offered if any(file.is_raw for file in item.files))
        raise InputError(f"image format {RAW_ONLY} alone is not offered; with raw are: {raws or 'none'}")
    return RAW_ONLY


def _code(state: EosState, code: int, scale: Scale, wanted: float) -> int:
    offered = state.lists.get(code, ())
    current = state.number(code)
    if not offered and current is not None and current not in scale.specials:
        # A body that lists nothing lets nothing be set: then it must stand right already.
        offered = (current,)
    return scale.code(wanted, offered)


def _named(kind: type[AeMode] | type[DriveMode], value: int) -> str:
    try:
        return kind(value).name.lower().replace("_", " ")
    except ValueError:
        return f"0x{value:02x}"
