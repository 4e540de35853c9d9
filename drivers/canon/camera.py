"""A Canon EOS body as the suite's `Camera`: one raw frame after another, for hours, without a human.

Rules that hold inside, of one connection (`EosBody`):

- Every step is one that the recorded conversations have, or one that libgphoto2 takes; an operation that the body does
  not list is never sent. One that it lists and does not know all the same (0x2005) is not sent again, and done without
  where that is possible: serial number, room on the host, staying awake, the other ways to release and to fetch.
- GetEvent is asked until it has nothing more, but never without end: some firmware repeats itself. `EosState` takes its
  records in their order and holds nothing that was not reported, and no more of it than `MAX_PROPERTIES` values of
  `MAX_VALUE` bytes and as many lists, which no real body comes near.
- What a body does not report is no problem: properties come and go between bodies, and only what is known to spoil a
  series is named. Nothing is taken for settable that the body does not list.
- A body keeps a frame in its memory until TransferComplete, and refuses the next when that memory is full. So every
  object that it announces is fetched or thrown away, and freed in either case.
- Sizes and counts that a body reports are checked against what arrives.
- A fault of cable or protocol ends the session, and goes to `CanonEos`, which begins a new one.

Of the camera (`CanonEos`):

- A connection that fails is renewed, a limited number of times and for a limited time in one call (`CanonLimits`):
  reset, closed, opened again wherever the body is now, and given the settings again. Then the call fails, with its
  first cause: longer patience is the caller's, who can say what is awaited.
- A release is never repeated once it may have happened: after a fault the frame is looked for in the camera's memory,
  and what is not found there is an error. So no frame is ever taken for another one's.
- What waits in the memory before a release belongs to nobody any more, and is thrown away.
- The exposed frame stays in the memory until it has been downloaded whole, or the next is exposed: a cable that fails
  and a file that cannot be written cost a download, not a frame. Once downloaded, the memory is emptied.

Source: conversations of an EOS 60D and an EOS 400D with a host; libgphoto2 2.5.34 for the order of a release; the
number of mirror lockup among the custom functions as ExifTool names it (CanonCustom::Functions2).
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import BinaryIO, TypeVar

from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings, Supplies
from drivers.canon.records import (
    APERTURE,
    ISO,
    RAW_ONLY,
    SHUTTER,
    AvailableFormats,
    AvailableValues,
    ImageFormat,
    Notice,
    ObjectEvent,
    PropertyChanged,
    PropertySetting,
    Record,
    Scale,
    TransferRequest,
    decode_events,
    number_of,
    number_value,
    text_of,
)
from drivers.ptp.codes import (
    AeMode,
    CameraStatus,
    CaptureDestination,
    DriveMode,
    EosEvent,
    FocusMode,
    ObjectFormat,
    Operation,
    Property,
    ReleaseButton,
    ResponseCode,
    WhiteBalance,
)
from drivers.ptp.protocol import (
    PASSING,
    PASSING_LIMIT_S,
    START_TIMEOUT_S,
    Cursor,
    DeviceInfo,
    OperationDeclined,
    PtpSession,
    StorageInfo,
    Transport,
    decode_u32_array,
    describe,
)
from foundation.clock import Clock, SystemClock
from foundation.errors import DeviceError, DeviceRefused, InputError, LinkClosed, LinkError, LinkTimeout, ProtocolError

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
        offered = _offered(state, code, scale)
        if value is None:
            if offered:
                refused.append(f"the lens has apertures, {scale.label(offered[0])} among them: name one as f-number")
        elif scale is APERTURE and not offered:
            refused.append(
                f'aperture {value:g} cannot be set, for the lens tells of none: set aperture = "none" for it'
            )
        else:
            try:
                wanted[code] = number_value(scale.code(value, offered))
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
    """Return the value of property 0xd11c that sends frames to the host; a body that lists none is given it to try."""
    offered = state.lists.get(Property.EOS_CAPTURE_DESTINATION, ())
    known = (*offered, state.number(Property.EOS_CAPTURE_DESTINATION))
    if offered and CaptureDestination.HOST not in known:
        listed = ", ".join(str(value) for value in offered)
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


def _offered(state: EosState, code: int, scale: Scale) -> tuple[int, ...]:
    """Return the codes that a body can be set to, or stands at where it lists nothing: then nothing can be set."""
    current = state.number(code)
    standing = () if current is None or current in scale.specials else (current,)
    return state.lists.get(code) or standing


def _named(kind: type[AeMode] | type[DriveMode], value: int) -> str:
    try:
        return kind(value).name.lower().replace("_", " ")
    except ValueError:
        return f"0x{value:02x}"


PIECE_BYTES = 1 << 20
"""Asked for at once; pieces of 5 MiB have crashed newer bodies."""
MAX_FRAME_BYTES = 256 << 20
"""No raw file of an EOS body comes near it."""
MAX_POLLS = 64
"""GetEvent answers that one drain takes, at most: a few empty the queue, and some firmware repeats itself."""
KEEP_ALIVE_S = 10.0
"""After this long a body is asked to stay awake, as libgphoto2 asks it."""
SETTLE_LIMIT_S = 5.0
"""How long a body may take to report a value that it was given, or room for a frame."""
BUSY_LIMIT_S = 30.0
"""How long a body may be busy after it was connected, or when it is to release, before it is refused: an EOS 2000D is
for seconds at either (gphoto2, issue 382)."""
RELEASE_TRIES = 5
"""Presses in a row, spread over `PASSING_LIMIT_S`: what keeps a body busy ends by itself or by what is fetched
between."""
CAPTURE_TIMEOUT_S = 100.0
"""Wait for the answer to a release; some bodies expose before they answer. libgphoto2 waits as long."""

_REMOTE_ON, _REMOTE_OFF = 1, 0
"""Parameter of SetRemoteMode, as the recorded conversations and libgphoto2 send it."""
_OTHER_REMOTE_MODE = re.compile(r"Canon (?!EOS)|Canon EOS (Kiss )?M(?!6 Mark II\b)")
"""Bodies to which libgphoto2 sends 0x15 or 0x11 as remote mode (`is_canon_eos_m` in its ptp-private.h), with live view
on before each frame: EOS M, but for the M6 Mark II, which is as the reflex bodies, and compact cameras. "Canon EOS
Kiss M" is the M50's name in Japan."""
_WITHOUT_AF = 1
"""Second parameter of RemoteReleaseOn: a release without autofocus."""
_HOST_CLUSTERS, _HOST_CLUSTER_BYTES = 0x04FFFFFF, 0x1000
"""Room announced to the body: so many clusters of so many bytes, 320 GiB, more than a session takes."""
_PAUSES_S = (0.05, 0.1, 0.15, 0.2)
"""Pauses between questions to the body, seconds; short at first, for most answers come at once (as libgphoto2
waits)."""
_PIECE_TRIES = 5
"""Requests of one piece in all, with the longest pause between: a second for a fault that passes, then the frame is
retaken."""
_FREE_TRIES = 3
"""Few, as the next `make_ready` tries again."""
_IN_PIECES = (Operation.EOS_GET_PARTIAL_OBJECT, Operation.GET_PARTIAL_OBJECT)
"""Operations that give a part of an object, the preferred one first."""
_NOT_GOT = (ResponseCode.OPERATION_NOT_SUPPORTED, ResponseCode.EOS_UNKNOWN_COMMAND)
"""Responses to an operation that a body has not got, whatever it lists."""
_LASTING = (
    *_NOT_GOT,
    ResponseCode.INVALID_OBJECT_HANDLE,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.DEVICE_BUSY,
)
"""Responses to a request for a piece that asking again does not change."""
_NOTHING_THERE = (
    ResponseCode.PARAMETER_NOT_SUPPORTED,
    ResponseCode.INVALID_STORAGE_ID,
    ResponseCode.DEVICE_PROP_NOT_SUPPORTED,
    ResponseCode.ACCESS_DENIED,
    ResponseCode.STORE_NOT_AVAILABLE,
    ResponseCode.INVALID_PARAMETER,
)
"""Responses to a question after something that a body has not got: a card, a property."""
_SLOT_FILLED = 0xFFFF
"""Bits of a storage number that are 0 where there is no card in the slot (ISO 15740, 5.2.1)."""
_MAX_CARDS = 8
"""Cards that are asked for their room; bodies have one or two."""
_RELEASE_RESULTS = {
    1: "it finds no focus: set the lens to MF",
    3: "its mirror is up: switch mirror lockup off",
    7: "its card is full: empty it",
    8: "its card is read-only: unlock it",
}
"""What RemoteRelease answers as parameter; 0 is success."""


class EosBody:
    """An EOS body behind an open cable."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._clock = clock
        self._session = PtpSession(transport, clock)
        self._info = DeviceInfo()
        self._destination: bytes | None = None
        self._unsupported: set[int] = set()
        self._spoken_at = clock.monotonic()
        self.state = EosState()

    @property
    def label(self) -> str:
        """What messages call the body."""
        return self._session.label

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware; the serial number is the engraved one where it is sent."""
        serial = self.state.text(Property.EOS_SERIAL_NUMBER) or self._info.serial_number
        return CameraIdentity(self._info.manufacturer, self._info.model, serial, self._info.device_version)

    def connect(self) -> None:
        """Open the session, take the body under remote control and learn its state."""
        self._while_busy(self._session.open)
        self._while_busy(self._take_control)

    def _take_control(self) -> None:
        _, data = self._session.call(Operation.GET_DEVICE_INFO)
        self._info = DeviceInfo.decode(data)
        remote = (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_GET_EVENT)
        if "canon" not in self._info.manufacturer.lower() or not all(map(self._offers, remote)):
            raise DeviceRefused(
                f"{self.label} is a {self._info.manufacturer} {self._info.model}, which does not speak as a Canon EOS "
                "does; connect an EOS body, or take the frames otherwise and use `acquire import`"
            )
        if _OTHER_REMOTE_MODE.match(self._info.model):
            raise DeviceRefused(
                f"{self.label} is a {self._info.model}; EOS M and compact bodies want another remote mode than 1, and "
                'other steps to a frame, which are not known well enough here; set connection = "gphoto2" in '
                "[lab.camera], or take the frames otherwise and use `acquire import`"
            )
        self._session.call(Operation.EOS_SET_REMOTE_MODE, _REMOTE_ON)
        self._session.call(Operation.EOS_SET_EVENT_MODE, _REMOTE_ON)
        self.drain()
        # libgphoto2 asks again, too: newer bodies have nothing to tell when they are asked at once.
        if not self._settled(lambda: bool(self.state.values)):
            raise ProtocolError(f"{self.label} sends no state when asked for events; switch it off and on")
        if self._requested(Property.EOS_SERIAL_NUMBER):
            self._settled(lambda: Property.EOS_SERIAL_NUMBER in self.state.values)
        self._receive_frames()

    def supplies(self) -> Supplies:
        """Return what is left of battery and card, as far as the body tells."""
        self.drain()
        level = self._battery_level()
        mains = power_source(self.state)
        saves_to_host = self.state.holds(Property.EOS_CAPTURE_DESTINATION, number_value(CaptureDestination.HOST))
        return Supplies(level, mains, self._card_free_bytes(), saves_to_host)

    def disconnect(self) -> None:
        """Give the body back as it was found; a fault of the cable goes to the caller."""
        self.free_waiting()
        if self._destination is not None:
            with contextlib.suppress(OperationDeclined):
                self._send(Property.EOS_CAPTURE_DESTINATION, self._destination)
        for operation in (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_SET_EVENT_MODE):
            with contextlib.suppress(OperationDeclined):
                self._session.call(operation, _REMOTE_OFF, timeout=START_TIMEOUT_S, retry_s=1.0)
        self._session.close()

    def poll(self) -> bool:
        """Ask once what is new; return whether anything was."""
        with contextlib.suppress(ProtocolError):
            self._session.events()  # hints that asking would be worth while, which it is anyway
        _, data = self._session.call(Operation.EOS_GET_EVENT)
        records = decode_events(data)
        self.state.take(records)
        self._keep_awake()
        return bool(records)

    def drain(self) -> None:
        """Ask until there is nothing new."""
        for _ in range(MAX_POLLS):
            if not self.poll():
                return

    def set(self, code: int, value: bytes) -> None:
        """Set a property, and see that the body reports it."""
        if self.state.holds(code, value):
            return
        self._send(code, value)
        self._verify(code, value)

    def make_ready(self) -> None:
        """Empty the event queue and the memory, and wait until the body can take a frame."""
        self.drain()
        self.free_waiting()
        # A body whose "idle" was lost would seem busy for ever; its answer shows whether it takes the release.
        self._settled(lambda: not self.state.busy)
        self.free_waiting()
        if not self._settled(lambda: self.state.number(Property.EOS_AVAILABLE_SHOTS) != 0):
            raise DeviceRefused(f"{self.label} has no room for a frame; switch it off and on to empty its memory")

    def release(self) -> None:
        """Press the release down and let it go, without autofocus."""
        if self._offers(Operation.EOS_REMOTE_RELEASE_ON):
            try:
                self._while_busy(self._press)
            except OperationDeclined as error:
                if not self._lacks(Operation.EOS_REMOTE_RELEASE_ON, error):
                    raise
            else:
                return
        parameters, _ = self._session.call(Operation.EOS_REMOTE_RELEASE, timeout=CAPTURE_TIMEOUT_S)
        result = parameters[0] if parameters else 0
        if result:
            reason = _RELEASE_RESULTS.get(result, f"result 0x{result:x}")
            raise DeviceRefused(f"{self.label} does not release: {reason}")

    def _press(self) -> None:
        for left in reversed(range(RELEASE_TRIES)):
            try:
                self._session.call(
                    Operation.EOS_REMOTE_RELEASE_ON,
                    ReleaseButton.HALF_AND_FULL,
                    _WITHOUT_AF,
                    timeout=CAPTURE_TIMEOUT_S,
                    retry_s=0.0,
                )
                break
            except OperationDeclined as error:
                # What keeps a body busy here is a release still held down, or events that nobody fetched.
                self._let_go()
                self.drain()
                if error.code != ResponseCode.DEVICE_BUSY:
                    raise
                if not left:
                    raise OperationDeclined(
                        f"{error}; look for mirror lockup, a timer or a menu on its display", error.code
                    ) from error
                self._clock.sleep(PASSING_LIMIT_S / RELEASE_TRIES)
        self._let_go()

    def await_object(self, not_before: float, until: float, wanted: Callable[[WaitingObject], bool]) -> WaitingObject:
        """Return the newest object that waits and is wanted."""
        pauses = iter(_PAUSES_S)
        while True:
            if self.poll():
                pauses = iter(_PAUSES_S)
            if self._clock.monotonic() < not_before:
                self.free_waiting()
            # Of two the later one belongs to this release: the other's announcement was late.
            for candidate in reversed(list(self.state.waiting.values())):
                if wanted(candidate):
                    return candidate
            if self._clock.monotonic() >= until:
                raise LinkTimeout(f"{self.label} has announced no frame in time")
            self._clock.sleep(next(pauses, _PAUSES_S[-1]))

    def fetch(self, waiting: WaitingObject, into: BinaryIO, offset: int = 0) -> None:
        """Append an object's bytes from `offset` on to `into`, piece by piece."""
        if not 0 < waiting.size <= MAX_FRAME_BYTES:
            raise DeviceError(
                f"{self.label} announces {waiting.name!r} of {waiting.size} bytes; 1 to {MAX_FRAME_BYTES} were expected"
            )
        while offset < waiting.size:
            operation = next((known for known in _IN_PIECES if self._offers(known)), None)
            if operation is None:
                self._fetch_whole(waiting, into, offset)
                return
            try:
                offset += into.write(self._piece(operation, waiting, offset))
            except OperationDeclined as error:
                if not self._lacks(operation, error):
                    raise
            self._keep_awake()

    def free(self, waiting: WaitingObject) -> None:
        """Let the body forget an object; where it will not, the next `make_ready` tries again."""
        for left in reversed(range(_FREE_TRIES)):
            try:
                self._session.call(Operation.EOS_TRANSFER_COMPLETE, waiting.handle)
            except OperationDeclined as error:
                # What has gone is as well, and where nothing can be freed the body frees it by itself.
                gone = error.code == ResponseCode.INVALID_OBJECT_HANDLE
                if not gone and not self._lacks(Operation.EOS_TRANSFER_COMPLETE, error):
                    if left:
                        self._clock.sleep(_PAUSES_S[-1])
                    continue
            self.state.waiting.pop(waiting.handle, None)
            return

    def free_waiting(self) -> None:
        """Let the body forget every object that waits."""
        for waiting in list(self.state.waiting.values()):
            self.free(waiting)

    def _fetch_whole(self, waiting: WaitingObject, into: BinaryIO, offset: int) -> None:
        """Append an object's bytes from `offset` on, from a body that gives no parts: those before come again."""
        came = 0

        def take(piece: bytes) -> None:
            nonlocal came
            if came + len(piece) > waiting.size:
                raise ProtocolError(f"{self.label} announced {waiting.size} bytes for {waiting.name!r} and gives more")
            into.write(piece[max(offset - came, 0) :])
            came += len(piece)

        self._session.call(Operation.GET_OBJECT, waiting.handle, receive=take)
        if came < waiting.size:
            raise self._cut(waiting, came)

    def _piece(self, operation: Operation, waiting: WaitingObject, offset: int) -> bytes:
        """Return the next bytes of an object; fewer than were asked for are good, for the rest follows."""
        wanted = min(PIECE_BYTES, waiting.size - offset)
        for left in reversed(range(_PIECE_TRIES)):
            try:
                sent, data = self._session.call(operation, waiting.handle, offset, wanted)
            except OperationDeclined as error:
                if not left or error.code in _LASTING:
                    raise
            else:
                if len(data) > wanted:
                    raise ProtocolError(f"{self.label} gives {len(data)} bytes at {offset}; {wanted} were asked for")
                # The standard's operation answers how many bytes were sent; what Canon's own answers is not known.
                counted = sent[0] if sent and operation == Operation.GET_PARTIAL_OBJECT else len(data)
                if data and counted == len(data):
                    return data
            self._clock.sleep(_PAUSES_S[-1])
        raise self._cut(waiting, offset)

    def _cut(self, waiting: WaitingObject, came: int) -> DeviceError:
        return DeviceError(
            f"{self.label} announced {waiting.size} bytes for {waiting.name!r}, but gives only {came}; "
            "the frame is worthless and may be retaken"
        )

    def _receive_frames(self) -> None:
        """Have frames sent to the host, and report room for them to the body."""
        host = host_destination(self.state)
        # A body that a killed run left behind stands at the host already; its user wants the card again.
        self._destination = number_value(CaptureDestination.CARD)
        if not self.state.holds(Property.EOS_CAPTURE_DESTINATION, host):
            self._destination = self.state.values.get(Property.EOS_CAPTURE_DESTINATION, self._destination)
            self._send(Property.EOS_CAPTURE_DESTINATION, host)
        self._optional(Operation.EOS_PC_HDD_CAPACITY, _HOST_CLUSTERS, _HOST_CLUSTER_BYTES, 1)
        self.drain()
        self._verify(Property.EOS_CAPTURE_DESTINATION, host)

    def _send(self, code: int, value: bytes) -> None:
        self._session.call(Operation.EOS_SET_DEVICE_PROP_VALUE_EX, send=PropertySetting(code, value).encode())

    def _verify(self, code: int, value: bytes) -> None:
        if self._settled(lambda: self.state.holds(code, value)):
            return
        if self._requested(code) and self._settled(lambda: self.state.holds(code, value)):
            return
        came = self.state.values.get(code)
        raise DeviceRefused(
            f"{self.label} was given {value.hex()} for property {describe(Property, code)} and reports "
            f"{came.hex() if came is not None else 'nothing'}; set it by hand, or switch the camera off and on"
        )

    def _while_busy(self, action: Callable[[], None]) -> None:
        """Do something until the body is not busy, for a limited time: a new session would only begin its work anew."""
        end = self._clock.monotonic() + BUSY_LIMIT_S
        while True:
            try:
                return action()
            except OperationDeclined as error:
                if error.code != ResponseCode.DEVICE_BUSY:
                    raise
                if self._clock.monotonic() >= end:
                    raise DeviceRefused(f"{error}; it has been so for {BUSY_LIMIT_S:g} s") from error

    def _let_go(self) -> None:
        with contextlib.suppress(OperationDeclined):
            self._session.call(Operation.EOS_REMOTE_RELEASE_OFF, ReleaseButton.HALF_AND_FULL)

    def _settled(self, condition: Callable[[], bool]) -> bool:
        """Poll until `condition` holds, for a limited time; return whether it does."""
        end = self._clock.monotonic() + SETTLE_LIMIT_S
        while not condition():
            if self._clock.monotonic() >= end:
                return False
            self.poll()
            if not condition():
                self._clock.sleep(_PAUSES_S[0])
        return True

    def _keep_awake(self) -> None:
        now = self._clock.monotonic()
        if now - self._spoken_at >= KEEP_ALIVE_S:
            self._spoken_at = now
            if self._offers(Operation.EOS_KEEP_DEVICE_ON):
                with contextlib.suppress(OperationDeclined):
                    self._session.call(Operation.EOS_KEEP_DEVICE_ON, retry_s=0.0)

    def _battery_level(self) -> float | None:
        level = battery_level(self.state)
        if level is None and Property.BATTERY_LEVEL in self._info.properties:
            answer = self._optional(Operation.GET_DEVICE_PROP_VALUE, Property.BATTERY_LEVEL)
            # 0 may stand for power from elsewhere (ISO 15740, 13.4.1); an empty battery would not answer.
            if answer is not None and answer[1][:1] not in (b"", b"\0"):
                level = min(answer[1][0], 100) / 100
        return level

    def _card_free_bytes(self) -> int | None:
        """Return the room on all cards together; None where there is no card, or none is told of."""
        listed = self._optional(Operation.EOS_GET_STORAGE_IDS)
        if listed is None:
            return None
        free: list[int] = []
        for storage in decode_u32_array(listed[1], "the list of cards")[:_MAX_CARDS]:
            if storage & _SLOT_FILLED:
                answer = self._optional(Operation.EOS_GET_STORAGE_INFO, storage)
                if answer is not None:
                    free.append(StorageInfo.decode(answer[1]).free)
        return sum(free) if free else None

    def _requested(self, code: int) -> bool:
        """Ask for a property whose value an event will bring; return whether the body takes the question."""
        return self._optional(Operation.EOS_REQUEST_DEVICE_PROP_VALUE, code) is not None

    def _optional(self, operation: Operation, *parameters: int) -> tuple[tuple[int, ...], bytes] | None:
        """Return what an operation answers; None where the body has not got it, or declines these parameters."""
        if not self._offers(operation):
            return None
        try:
            return self._session.call(operation, *parameters)
        except OperationDeclined as error:
            if not self._lacks(operation, error) and error.code not in _NOTHING_THERE:
                raise
            return None

    def _lacks(self, operation: Operation, error: OperationDeclined) -> bool:
        """Return whether a body has not got an operation that it lists, by its answer; it is not asked again then."""
        if error.code not in _NOT_GOT:
            return False
        self._unsupported.add(operation)
        return True

    def _offers(self, operation: int) -> bool:
        return operation in self._info.operations and operation not in self._unsupported


REDISCOVERY_S = 10.0
"""Time for a frame to be announced on a new connection, on which the body sends its whole state at once."""

_SYSTEM_CLOCK = SystemClock()
_CERTAIN_SHARE = 0.9
"""Share of the nominal shutter time that passes at least: 1/6 s is really 0.149 s."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 5.0
"""Pauses between attempts to find the camera again, doubled from one to the other: soon for a cable put back, seldom
enough that a body which starts is left alone."""
_STUCK = (
    *PASSING,
    ResponseCode.UNDEFINED,
    ResponseCode.GENERAL_ERROR,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.INVALID_TRANSACTION_ID,
    ResponseCode.INCOMPLETE_TRANSFER,
    ResponseCode.TRANSACTION_CANCELLED,
)
"""Responses that a new session may cure."""
_SUFFIXES: dict[int, str] = {ObjectFormat.CRW: ".CRW", ObjectFormat.CR2: ".CR2", ObjectFormat.CR3: ".CR3"}
_REMEDY = (
    "check its cable and battery, switch it off and on, and end other programs that use it (a desktop's photo importer "
    "begins by itself)"
)

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class CanonLimits:
    """How long one call to a body may go on against trouble before it fails; chosen, not measured.

    - `recoveries`: how often a call renews the connection: a fault that comes back more often lasts.
    - `recovery_s`: seconds after the first fault of a call in which the connection may be renewed; a body that was
      switched off and on, or put back on its cable, is there within 10 s.
    - `frame_s`: seconds after its exposure within which a frame may be announced, beside as much time again as it was
      exposed: so long a dark frame takes that some bodies subtract.
    """

    recoveries: int = 3
    recovery_s: float = 30.0
    frame_s: float = 30.0


_LIMITS = CanonLimits()


@dataclass
class _Shot:
    """A release that has happened, or may have.

    `announced` is its frame once the body has named it, `fetched` what a download has begun with; objects that are
    `absent` cannot be its frame.
    """

    body: EosBody
    released_at: datetime
    not_before: float
    until: float
    shutter_s: float
    announced: WaitingObject | None = None
    fetched: WaitingObject | None = None
    absent: set[int] = field(default_factory=set[int])


class CanonEos:
    """A `drivers.camera.Camera` over PTP, whatever the cable."""

    def __init__(
        self, open_transport: Callable[[], Transport], clock: Clock = _SYSTEM_CLOCK, limits: CanonLimits = _LIMITS
    ) -> None:
        self._open_transport = open_transport
        self._clock = clock
        self._limits = limits
        self._fault: DeviceError | None = None
        self._renewable_until = math.inf
        self._transport: Transport | None = None
        self._body: EosBody | None = None
        self._identity: CameraIdentity | None = None
        self._settings: ExposureSettings | None = None
        self._shot: _Shot | None = None
        self._closed = False

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware."""
        self._begin()
        return self._carry_out(EosBody.identity)

    def supplies(self) -> Supplies:
        """Return what is left of battery and card; see `drivers.camera.ReportsSupplies`."""
        self._begin()
        return self._carry_out(EosBody.supplies)

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify the exposure, raw format and destination; a frame that was not downloaded is dropped."""

        def configured(body: EosBody) -> None:
            body.make_ready()
            _apply(body, settings)

        self._begin()
        self._settings = self._shot = None
        self._carry_out(configured)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers now, as engraved, seconds, rising; empty if it lists none."""

        def listed(body: EosBody) -> tuple[float, ...]:
            body.drain()
            return shutter_speeds(body.state)

        self._begin()
        return self._carry_out(listed)

    def expose(self) -> datetime:
        """Release the shutter without autofocus; return when it was released, UTC, once the body announces the frame.

        A frame that was exposed before and has not been downloaded is dropped.
        """
        settings = self._settings
        if settings is None:
            raise DeviceRefused("the camera has no exposure settings; configure it before the first exposure")
        self._begin()
        self._shot = None
        shot = self._release(settings)
        try:
            self._carry_out(lambda body: self._await_frame(body, shot))
        except Exception:
            self._empty()
            raise
        self._shot = shot
        return shot.released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the frame exposed last, whole and unchanged, to `into`.

        A download that failed, for whatever reason, may be tried again with a new stream as long as the body holds the
        frame in its memory: until the next exposure, or until it is switched off.
        """
        shot = self._shot
        if shot is None:
            raise DeviceError("no exposed frame waits in the camera to be downloaded; expose it again")
        self._begin()
        start = into.tell()
        frame = self._carry_out(lambda body: self._receive(body, shot, into, start))
        self._shot = None
        self._empty()
        return CapturedFrame(_file_name(frame), frame.size, shot.released_at)

    def idle(self) -> None:
        """Fetch what has happened while nothing was asked, and keep the body awake; call it now and then in a pause."""
        self._begin()
        self._carry_out(EosBody.drain)

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""
        self._closed = True
        self._shot = None
        body = self._body
        if body is not None:
            try:
                body.disconnect()
            except DeviceError as error:
                self._drop(error)
            else:
                self._drop(None)

    def _begin(self) -> None:
        """Begin a call: it has had no fault yet."""
        self._fault, self._renewable_until = None, math.inf

    def _carry_out(self, action: Callable[[EosBody], _Result]) -> _Result:
        """Return what `action` does with a connected body, over a new connection if this one fails."""
        renewals = 0
        was_busy = False
        while True:
            body = self._connected()
            try:
                return action(body)
            except DeviceError as error:
                if not _curable(error):
                    raise
                self._lose(error)
                # A body that is busy in every session is kept so by its own settings, not by a fault.
                busy = isinstance(error, OperationDeclined) and error.code == ResponseCode.DEVICE_BUSY
                late = self._clock.monotonic() >= self._renewable_until
                if renewals == self._limits.recoveries or late or (busy and was_busy):
                    kind = DeviceRefused if busy else DeviceError
                    times = "once" if renewals == 1 else f"{renewals} times"
                    raise kind(self._given_up(error, f"the connection was renewed {times} without success")) from error
                was_busy = busy
                renewals += 1

    def _lose(self, fault: DeviceError) -> None:
        """Drop a connection that failed at its work, and keep the first such fault of a call.

        What ails a new connection before it is made follows from the old one's end, and is no first cause.
        """
        if self._fault is None:
            self._fault = fault
            self._renewable_until = self._clock.monotonic() + self._limits.recovery_s
        self._drop(fault)

    def _given_up(self, last: DeviceError, tried: str) -> str:
        """Return why a call ends, its first cause first, for whatever came of that says less; with one remedy."""
        first, held = (fault.without_remedy() for fault in (self._fault or last, last))
        return f"{first}; {tried}{'' if held == first else f'; at last: {held}'}; {_REMEDY}"

    def _release(self, settings: ExposureSettings) -> _Shot:
        """Return the release that has happened, or may have; one that the body declines has not."""

        def released(body: EosBody) -> _Shot:
            body.make_ready()
            _apply(body, settings)  # sends nothing unless a dial was turned
            now = self._clock.monotonic()
            exposed = now + _CERTAIN_SHARE * settings.shutter_s
            until = now + 2 * settings.shutter_s + self._limits.frame_s
            shot = _Shot(body, self._clock.now(), exposed, until, settings.shutter_s, absent=set(body.state.waiting))
            try:
                body.release()
            except (LinkError, ProtocolError) as error:
                self._lose(error)
            return shot

        return self._carry_out(released)

    def _await_frame(self, body: EosBody, shot: _Shot) -> WaitingObject:
        """Return the frame of a release when the body has announced it; the same one whenever it is asked again."""
        renewed = body is not shot.body
        until = self._clock.monotonic() + shot.shutter_s + REDISCOVERY_S if renewed else shot.until
        known = shot.announced

        def wanted(waiting: WaitingObject) -> bool:
            if known is not None and (waiting.name, waiting.size) != (known.name, known.size):
                return False  # taken since, by a finger on the camera
            return waiting.is_raw and waiting.handle not in shot.absent

        try:
            shot.announced = body.await_object(shot.not_before, until, wanted)
        except LinkTimeout as error:
            if not renewed:
                raise  # its announcement may be lost: a new connection hears it again
            self._shot = None
            raise DeviceError(f"{error}, and holds none in its memory; take it again") from error
        return shot.announced

    def _receive(self, body: EosBody, shot: _Shot, into: BinaryIO, start: int) -> WaitingObject:
        """Return the frame of a release when it is complete in `into`, from `start` on."""
        while True:
            frame = self._await_frame(body, shot)
            # What has come of the same object before a fault is good: pieces are written whole.
            offset = into.tell() - start if frame == shot.fetched else 0
            into.seek(start + offset)
            into.truncate()
            shot.fetched = frame
            try:
                body.fetch(frame, into, offset)
            except OperationDeclined as error:
                if error.code != ResponseCode.INVALID_OBJECT_HANDLE:
                    raise
                shot.absent.add(frame.handle)
                shot.announced = None
                body.free(frame)
                continue
            return frame

    def _empty(self) -> None:
        """Let the body forget what waits; where that fails the next call sees to it over a new connection."""
        if self._body is not None:
            try:
                self._body.free_waiting()
                self._body.drain()
                self._body.free_waiting()
            except DeviceError as error:
                self._drop(error)

    def _connected(self) -> EosBody:
        """Return the connected body, after a fault on a new connection and with its settings."""
        if self._closed:
            raise DeviceError("the camera has been closed; open the rig again")
        if self._body is not None:
            return self._body
        first = self._identity is None
        begun = self._clock.monotonic()
        end = min(self._renewable_until, begun + self._limits.recovery_s)
        pause = _FIRST_PAUSE_S
        while True:
            try:
                return self._connect()
            except DeviceError as error:
                # While it comes back a body may be absent, or in the hands of the desktop.
                curable = not first if self._transport is None else _curable(error)
                self._drop(error)
                if not curable:
                    raise
                if self._clock.monotonic() + pause > end:
                    waited = f"no connection for {self._clock.monotonic() - begun:.0f} s"
                    raise DeviceError(self._given_up(error, waited)) from error
            self._clock.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)

    def _connect(self) -> EosBody:
        self._transport = self._open_transport()
        body = EosBody(self._transport, self._clock)
        body.connect()
        found, known = body.identity(), self._identity
        if known is not None and (found.model, found.serial) != (known.model, known.serial):
            raise DeviceRefused(
                f"in place of the {known.model} with serial number {known.serial} there is now a {found.model} with "
                f"{found.serial}; connect the first one again"
            )
        if self._settings is not None:
            _apply(body, self._settings)
        self._identity = found
        self._body = body
        return body

    def _drop(self, fault: DeviceError | None) -> None:
        """Close the cable, with a reset where the body may still be in the midst of something."""
        transport, self._transport, self._body = self._transport, None, None
        if transport is not None:
            if fault is not None and not isinstance(fault, LinkClosed):
                with contextlib.suppress(DeviceError):
                    transport.reset()
            transport.close()


def _apply(body: EosBody, settings: ExposureSettings) -> None:
    for code, value in plan(body.state, settings).items():
        body.set(code, value)


def _curable(error: DeviceError) -> bool:
    """Return whether a new connection may help."""
    return isinstance(error, LinkError | ProtocolError) or (
        isinstance(error, OperationDeclined) and error.code in _STUCK
    )


def _file_name(frame: WaitingObject) -> str:
    """Return the camera's name for a file, with nothing in it that a file name cannot hold, and a suffix."""
    name = re.sub(r"[^A-Za-z0-9._-]", "_", frame.name).strip(".") or f"{frame.handle:08X}"
    # Some bodies announce a file without its name, or without the suffix, but with its format.
    return name if "." in name else name + _SUFFIXES.get(frame.format, "")
