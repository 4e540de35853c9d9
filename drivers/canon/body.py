"""An EOS body in one session: what it has reported of itself, and every step from connection to a frame's last byte.

Rules that hold inside:

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
- A fault of cable or protocol ends the session, and goes to `drivers.canon.camera`, which begins a new one.

Source: conversations of an EOS 60D and an EOS 400D with a host; libgphoto2 2.5.34 for the order of a release; the
number of mirror lockup among the custom functions as ExifTool names it (CanonCustom::Functions2).
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import BinaryIO, TypeVar

from drivers.camera import CameraIdentity, ExposureSettings, Supplies
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
from drivers.ptp.datasets import Cursor, DeviceInfo, StorageInfo, decode_u32_array
from drivers.ptp.session import PASSING_LIMIT_S, START_TIMEOUT_S, OperationDeclined, PtpSession, Transport
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceRefused, InputError, LinkTimeout, ProtocolError

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
                self._session.call(operation, _REMOTE_OFF, timeout=START_TIMEOUT_S, patience=1.0)
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
                    patience=0.0,
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
            f"{self.label} was given {value.hex()} for property 0x{code:04x} and reports "
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
                    self._session.call(Operation.EOS_KEEP_DEVICE_ON, patience=0.0)

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
