"""Simulated Canon EOS: a PTP responder (camera) that gets its frames from a `Film`.

Each call first carries out the actions that are due by the clock. With a `SimulatedClock`, the initiator (host) must
wait by the same clock. Behaviour follows a recorded EOS 60D; comments with the word "assumed" mark behaviour that no
public recording shows.

Sources: a recorded EOS 60D; ISO 15740:2013 (PTP); libgphoto2 2.5.34 for the expectations of initiators.
"""

from __future__ import annotations

import hashlib
import heapq
import itertools
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import Enum
from io import BytesIO
from typing import NamedTuple

from drivers import canon
from drivers.camera import ExposureSettings
from drivers.canon import (
    IMAGE_FORMAT_PROPERTIES,
    AvailableFormats,
    AvailableValues,
    ImageFormat,
    Notice,
    ObjectEntry,
    ObjectEvent,
    PropertyChanged,
    PropertySetting,
    Record,
    TransferRequest,
    encode_events,
    encode_object_entries,
    number_of,
    number_value,
    text_value,
)
from drivers.ptp.codes import (
    AeMode,
    CameraStatus,
    CaptureDestination,
    DataType,
    EosEvent,
    EventCode,
    FilesystemType,
    FocusMode,
    ObjectFormat,
    Operation,
    Property,
    ReleaseButton,
    ResponseCode,
    StorageType,
)
from drivers.ptp.protocol import (
    Answer,
    DevicePropDesc,
    ObjectInfo,
    PtpEvent,
    PtpRequest,
    PtpResponse,
    StorageInfo,
    Value,
    decode_value,
    encode_u32_array,
    encode_value,
)
from foundation.clock import Clock
from foundation.errors import CropError, DeviceError, DeviceRefused, LinkClosed, ProtocolError
from sim.camera.bodies import FREE, LIST, MIRROR_LOCKUP, EosModel, custom_functions
from sim.camera.film import Film

CARD = 0x00020001  # Storage id of the card.
EMPTY_SLOT = 0x00020000  # Storage id without a card.
DCIM = 0x90000000  # Handle of the folder DCIM on the card.
FOLDER = 0x91900000  # Handle of the folder 100CANON; files on the card have handles from here, in steps of 16.
BULB = 0x0C  # Shutter speed code of bulb exposures, which are simulated with the shutter time `_METERED_S`.

# Largest 32-bit number. In GetObjectHandles it means any store, any format, or the root (ISO 15740).
U32 = 0xFFFFFFFF
_MEMORY = 0xA0000000  # First handle of objects in the camera's memory (assumed).
_MOST_SHOTS = 0x7FFFFFFF  # Highest reported number of free shots: the largest signed 32-bit number.
_TEXT_PROPERTIES = (Property.EOS_OWNER, Property.EOS_ARTIST, Property.EOS_COPYRIGHT)


class OperationRefusal(Exception):
    """Ends an operation with a response other than OK."""

    def __init__(self, code: int, *parameters: int) -> None:
        super().__init__(code)
        self.code = code
        self.parameters = parameters


class OperationResult(NamedTuple):
    """Data and parameters of a successful operation."""

    data: bytes | None = None
    parameters: tuple[int, ...] = ()


class Arguments(NamedTuple):
    """Parameters of a request (0 if missing), and the data that the initiator sent with it."""

    first: int
    second: int
    third: int
    data: bytes | None


@dataclass
class PropertyState:
    """Value of a property and its allowed values."""

    value: bytes
    list_kind: int
    reported: bool  # Whether the body sends the value without a request
    choices: tuple[int, ...] = ()
    formats: tuple[ImageFormat, ...] = ()


@dataclass(frozen=True)
class StoredObject:
    """A file or folder on the card, or in the camera's memory if `storage` is 0."""

    handle: int
    storage: int
    format: int
    name: str
    taken_at: datetime
    parent: int = 0
    data: bytes = b""

    @property
    def entry(self) -> ObjectEntry:
        """Entry of the object in lists and events."""
        return ObjectEntry(
            self.handle, self.storage, self.format, len(self.data), self.name, self.parent, self.handle,
            time=int(self.taken_at.timestamp()) & U32,
        )  # fmt: skip


@dataclass
class Card:
    """Memory card: capacity in bytes, and objects by handle."""

    capacity: int
    objects: dict[int, StoredObject] = field(default_factory=dict[int, StoredObject])

    @property
    def free_bytes(self) -> int:
        """Free space in bytes."""
        return self.capacity - sum(len(item.data) for item in self.objects.values())


_AUTO_ISO = 400  # ISO speed chosen by the body (assumed, because no light meter is simulated).
_METERED_S = 1 / 60  # Shutter time chosen by the body, s (assumed).
_METERED_APERTURE = 5.6  # Aperture chosen by the body (assumed).
_FORMATS_BY_SUFFIX = {".crw": ObjectFormat.CRW, ".cr3": ObjectFormat.CR3}
_JPEG_SIZE = (160, 240)  # Height and width, px: enough for the file name, fast to encode.


class _Refusal(Enum):
    """Reasons to refuse a release, each with the response to RemoteReleaseOn and the result of RemoteRelease."""

    BUSY = (ResponseCode.DEVICE_BUSY, 0x2019)
    MIRROR_LOCKUP = (ResponseCode.DEVICE_BUSY, 3)
    MEMORY_FULL = (ResponseCode.DEVICE_BUSY, 7)
    STORE_FULL = (ResponseCode.STORE_FULL, 7)
    BATTERY_EMPTY = (ResponseCode.EOS_LOW_BATTERY, ResponseCode.EOS_LOW_BATTERY)
    EXPOSURE = (ResponseCode.GENERAL_ERROR, ResponseCode.GENERAL_ERROR)

    def __init__(self, response: int, result: int) -> None:
        self.response = response
        self.result = result


@dataclass(frozen=True)
class _Frame:
    number: int
    taken_at: datetime
    raw: Future[bytes | None]  # Raw file; None if the film failed
    formats: ImageFormat
    destination: int


# Properties that the initiator may set to any value
_FREELY_SET = (*_TEXT_PROPERTIES, Property.EOS_CAMERA_TIME)

_SHUTDOWN_WARNING_S = 10.0  # Time from the warning until the camera switches itself off, s (assumed).


class SimulatedEos:
    """EOS body, a `drivers.ptp.protocol.Responder`. Methods may be called by several threads.

    Parameters
    ----------
    card_bytes
        Capacity of the card; None for an empty slot.
    auto_power_off_s
        Idle seconds after which the body switches itself off; 0 for never, None for the setting of the body. All
        operations except GetEvent and GetDeviceInfo restart the idle time.
    battery
        Charge, 0 to 1.
    without
        Operations that the body does not support.
    forgetful
        Whether frames in the memory are lost when the session ends.
    executor
        Threads that calculate frames, so that large frames do not delay answers. With None, a frame is calculated
        during the release, as tests need.
    """

    def __init__(
        self,
        body: EosModel,
        film: Film,
        clock: Clock,
        *,
        serial: str = "0000000001",
        card_bytes: int | None = 8 << 30,
        auto_power_off_s: int | None = None,
        battery: float = 1.0,
        shutter_count: int = 5000,
        without: Iterable[int] = (),
        forgetful: bool = False,
        executor: Executor | None = None,
    ) -> None:
        self._lock = threading.RLock()
        self._operations = {code: answer for code, answer in self._handlers().items() if code not in set(without)}
        self.body = body
        self.serial = serial
        self._film = film
        self._clock = clock
        self._executor = executor
        self._forgetful = forgetful
        self._card = None if card_bytes is None else self._blank_card(card_bytes)
        self._battery = battery
        self._shutter_count = shutter_count
        self._time_offset = timedelta()
        self._initiator = "Unknown Initiator"
        self._number = 0
        self._handles = itertools.count(_MEMORY + 1)
        self._mirror_lockup = False
        self._is_asleep = False
        # State of a session.
        self._session = 0
        self._last_transaction = 0
        self._remote_mode = 0
        self._event_mode = 0
        self._queue: list[Record] = []
        self._memory: dict[int, StoredObject] = {}
        self._host_bytes = 0
        self._hints: list[PtpEvent] = []
        self._idle_since = clock.monotonic()
        self._is_warned = False
        # Scheduled actions: (time, order, action), earliest first.
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._unfinished = 0
        self._properties = {
            spec.code: PropertyState(
                spec.value or b"", spec.kind, spec.value is not None, tuple(spec.choices), tuple(spec.formats)
            )
            for spec in body.properties
        }
        self._properties[Property.EOS_SERIAL_NUMBER].value = text_value(serial)
        for code in _TEXT_PROPERTIES:
            self._properties[code].value = text_value("")
        if auto_power_off_s is not None:
            self._properties[Property.EOS_AUTO_POWER_OFF].value = number_value(auto_power_off_s)
        if not body.aperture_codes:
            self._properties[Property.EOS_APERTURE].value = number_value(0)
        self._renew_destinations()
        self._renew_exposure_lists()

    # Time.

    @contextmanager
    def _updated(self) -> Generator[None]:
        with self._lock:
            self._update()
            yield

    def _update(self) -> None:
        now_s = self._clock.monotonic()
        while self._due and self._due[0][0] <= now_s:
            _, _, action = heapq.heappop(self._due)
            action()
        limit = number_of(self._properties[Property.EOS_AUTO_POWER_OFF].value)
        if not self._session or not limit or self._is_busy:
            return
        idle = self._clock.monotonic() - self._idle_since
        if idle >= limit:
            self._end_session()
            self._memory.clear()
            self._is_asleep = True
        elif idle >= limit - min(_SHUTDOWN_WARNING_S, limit / 2) and not self._is_warned:
            self._is_warned = True
            self._record(Notice(EosEvent.WILL_SOON_SHUT_DOWN, int(limit - idle)))

    def _restart_idle_time(self) -> None:
        self._idle_since = self._clock.monotonic()
        if self._is_warned:
            self._is_warned = False
            limit = number_of(self._properties[Property.EOS_AUTO_POWER_OFF].value)
            self._record(Notice(EosEvent.SHUTDOWN_TIMER_UPDATED, limit))

    def _schedule(self, due_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._due, (due_s, next(self._order), action))

    @property
    def _is_busy(self) -> bool:
        return self._unfinished > 0

    def _now(self) -> datetime:
        return self._clock.now() + self._time_offset

    # Events.

    def _get_event(self, _: Arguments) -> OperationResult:
        records, self._queue = self._queue, []
        return OperationResult(encode_events(records))

    def _record(self, record: Record) -> None:
        if not self._event_mode:
            return
        if not self._queue:
            self._hints.append(PtpEvent(EventCode.EOS_REQUEST_GET_EVENT))
        self._queue.append(record)

    def _report_list(self, code: int) -> None:
        state = self._properties[code]
        if code in IMAGE_FORMAT_PROPERTIES:
            self._record(AvailableFormats(code, state.formats, state.list_kind))
        else:
            self._record(AvailableValues(code, state.choices, state.list_kind))

    # The values of properties.

    def _value(self, code: int) -> bytes:
        match code:
            case Property.EOS_AVAILABLE_SHOTS:
                return number_value(self._available_shots())
            case Property.EOS_BATTERY_POWER:
                return number_value(self._battery_code())
            case Property.EOS_CAMERA_TIME:
                return number_value(int(self._now().timestamp()) & U32)
            case Property.EOS_SHUTTER_COUNTER:
                return number_value(self._shutter_count)
            case Property.EOS_CURRENT_STORAGE:
                return number_value(EMPTY_SLOT if self._card is None else CARD)
            case Property.EOS_CURRENT_FOLDER:
                return number_value(0 if self._card is None else FOLDER)
            case _:
                return self._properties[code].value

    def _number_of(self, code: int) -> int:
        state = self._properties.get(code)
        return 0 if state is None else number_of(state.value)

    def _report(self, *codes: int) -> None:
        for code in codes:
            self._record(PropertyChanged(code, self._value(code)))
            if code == Property.EOS_CUSTOM_FUNCTIONS and Property.EOS_MIRROR_UP_SETTING not in self._properties:
                # One record per group of custom functions.
                self._record(PropertyChanged(code, custom_functions(3, {MIRROR_LOCKUP: int(self._mirror_lockup)})))

    def _change(self, code: int, value: bytes) -> None:
        self._properties[code].value = value
        self._report(code)

    def _set_choices(self, code: int, choices: tuple[int, ...]) -> None:
        if self._properties[code].choices != choices:
            self._properties[code].choices = choices
            self._report_list(code)

    def _renew_exposure_lists(self) -> None:
        mode = self._number_of(Property.EOS_AE_MODE)
        has_shutter_list = mode in (AeMode.MANUAL, AeMode.SHUTTER_PRIORITY)
        shutter = () if not has_shutter_list else self.body.shutter_codes
        self._set_choices(Property.EOS_SHUTTER_SPEED, shutter)
        has_aperture_list = mode in (AeMode.MANUAL, AeMode.APERTURE_PRIORITY, AeMode.BULB)
        self._set_choices(Property.EOS_APERTURE, self.body.aperture_codes if has_aperture_list else ())
        if mode == AeMode.BULB:
            self._change(Property.EOS_SHUTTER_SPEED, number_value(BULB))
        elif shutter and self._number_of(Property.EOS_SHUTTER_SPEED) not in shutter:
            self._change(Property.EOS_SHUTTER_SPEED, number_value(shutter[len(shutter) // 2]))

    def _renew_destinations(self) -> None:
        """Update the capture destinations; without a session, frames are stored on the card."""
        destinations = (CaptureDestination.CARD, CaptureDestination.HOST, CaptureDestination.CARD_AND_HOST)
        choices = destinations if self._card is not None else (CaptureDestination.HOST,)
        self._set_choices(Property.EOS_CAPTURE_DESTINATION, choices)
        if not self._session or self._number_of(Property.EOS_CAPTURE_DESTINATION) not in choices:
            # Even without a card, the 60D reports the card as destination.
            self._change(Property.EOS_CAPTURE_DESTINATION, number_value(CaptureDestination.CARD))
            self._report(Property.EOS_AVAILABLE_SHOTS, Property.EOS_CURRENT_STORAGE, Property.EOS_CURRENT_FOLDER)

    def _battery_code(self) -> int:
        return next(
            code for minimum, code in ((0.88, 2), (0.63, 4), (0.38, 1), (0.1, 5), (-1, 0)) if self._battery > minimum
        )

    # Remote control, and free space.

    def _require_remote(self) -> None:
        # Assumed: no recording shows the answer without remote control.
        if not self._remote_mode:
            raise OperationRefusal(ResponseCode.EOS_OPERATION_REFUSED)

    def _blank_card(self, capacity: int) -> Card:
        created_at = self._clock.now()
        card = Card(capacity)
        for folder in (
            StoredObject(DCIM, CARD, ObjectFormat.ASSOCIATION, "DCIM", created_at),
            StoredObject(FOLDER, CARD, ObjectFormat.ASSOCIATION, "100CANON", created_at, DCIM),
        ):
            card.objects[folder.handle] = folder
        return card

    def _available_shots(self) -> int:
        destination = self._number_of(Property.EOS_CAPTURE_DESTINATION)
        card = 0 if self._card is None else self._card.free_bytes
        if destination == CaptureDestination.HOST:
            free_bytes = self._host_bytes
        elif destination == CaptureDestination.CARD_AND_HOST:
            free_bytes = min(card, self._host_bytes)
        else:
            free_bytes = card
        return min(max(free_bytes, 0) // self.body.frame_bytes, _MOST_SHOTS)

    # Operations on files.

    def _get_storage_ids(self, _: Arguments) -> OperationResult:
        return OperationResult(encode_u32_array((EMPTY_SLOT if self._card is None else CARD,)))

    def _get_storage_info(self, arguments: Arguments) -> OperationResult:
        self._require_store(arguments.first)
        capacity, free_bytes = (0, 0) if self._card is None else (self._card.capacity, self._card.free_bytes)
        info = StorageInfo(
            StorageType.REMOVABLE_RAM, FilesystemType.DCF, capacity=capacity, free=free_bytes, description="SD"
        )
        return OperationResult(info.encode())

    def _require_store(self, storage: int) -> None:
        if storage not in (EMPTY_SLOT if self._card is None else CARD, U32):
            raise OperationRefusal(ResponseCode.INVALID_STORAGE_ID)

    def _on_card(self) -> dict[int, StoredObject]:
        return {} if self._card is None else self._card.objects

    def _children(self, parent: int) -> list[StoredObject]:
        if parent not in (0, U32) and parent not in self._on_card():
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return [item for item in self._on_card().values() if item.parent == (0 if parent == U32 else parent)]

    def _matching_objects(self, arguments: Arguments) -> list[StoredObject]:
        self._require_store(arguments.first)
        all_folders = arguments.third == 0
        objects = list(self._on_card().values()) if all_folders else self._children(arguments.third)
        return [item for item in objects if arguments.second in (0, U32, item.format)]

    def _get_num_objects(self, arguments: Arguments) -> OperationResult:
        return OperationResult(parameters=(len(self._matching_objects(arguments)),))

    def _get_object_handles(self, arguments: Arguments) -> OperationResult:
        return OperationResult(encode_u32_array(item.handle for item in self._matching_objects(arguments)))

    def _get_object_info_ex(self, arguments: Arguments) -> OperationResult:
        self._require_store(arguments.first)
        return OperationResult(encode_object_entries(item.entry for item in self._children(arguments.second)))

    def _object(self, handle: int) -> StoredObject:
        item = self._memory.get(handle) or self._on_card().get(handle)
        if item is None:
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return item

    def _get_object_info(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.first)
        stamp = item.taken_at.strftime("%Y%m%dT%H%M%S")
        is_folder = item.format == ObjectFormat.ASSOCIATION
        return OperationResult(
            ObjectInfo(
                storage=item.storage, format=item.format, size=len(item.data), parent=item.parent,
                association_type=int(is_folder), filename=item.name, captured_at=stamp, modified_at=stamp,
            ).encode()
        )  # fmt: skip

    def _get_object(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.first)
        if item.format == ObjectFormat.ASSOCIATION:
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return OperationResult(item.data)

    def _get_partial_object(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.first)
        if arguments.second > len(item.data):
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        piece = item.data[arguments.second : arguments.second + arguments.third]
        return OperationResult(piece, (len(piece),))

    def _get_thumb(self, arguments: Arguments) -> OperationResult:
        self._object(arguments.first)
        raise OperationRefusal(ResponseCode.NO_THUMBNAIL_PRESENT)

    def _delete_object(self, arguments: Arguments) -> None:
        item = self._object(arguments.first)
        if item.format == ObjectFormat.ASSOCIATION:
            raise OperationRefusal(ResponseCode.OBJECT_WRITE_PROTECTED)
        if item.storage:
            del self._on_card()[item.handle]
            self._record(Notice(EosEvent.OBJECT_REMOVED, item.handle))
            self._report(Property.EOS_AVAILABLE_SHOTS)
        else:
            del self._memory[item.handle]

    def _transfer_complete(self, arguments: Arguments) -> None:
        if self._memory.pop(arguments.first, None) is None:
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)

    def _reset_transfer(self, _: Arguments) -> None:
        self._memory.clear()

    def _pc_hdd_capacity(self, arguments: Arguments) -> None:
        self._host_bytes = arguments.first * arguments.second
        self._report(Property.EOS_AVAILABLE_SHOTS)

    def _frames_waiting(self) -> int:
        return len({item.name.rpartition(".")[0] for item in self._memory.values()})

    def _offer_transfer(self, item: StoredObject) -> None:
        wide = self.body.wide_objects
        request = EosEvent.REQUEST_OBJECT_TRANSFER_64 if wide else EosEvent.REQUEST_OBJECT_TRANSFER
        self._record(TransferRequest(item.handle, item.format, len(item.data), item.name, request))

    # The release.

    def _remote_release_on(self, arguments: Arguments) -> None:
        self._require_remote()
        if not 1 <= arguments.first <= ReleaseButton.HALF_AND_FULL:
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        if self._is_busy:
            raise OperationRefusal(ResponseCode.DEVICE_BUSY)
        if arguments.first & ReleaseButton.FULL:
            refusal = self._full_press()
            if refusal is not None:
                raise OperationRefusal(refusal.response)

    def _remote_release_off(self, arguments: Arguments) -> None:
        self._require_remote()
        if not 1 <= arguments.first <= ReleaseButton.HALF_AND_FULL:
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)

    def _remote_release(self, _: Arguments) -> OperationResult:
        self._require_remote()
        refusal = self._full_press()
        return OperationResult(parameters=(0 if refusal is None else refusal.result,))

    def _full_press(self) -> _Refusal | None:
        # One frame, independent of drive mode, bracketing and focus.
        settings = self._settings()
        refusal = self._refusal(settings)
        if refusal is None:
            self._plan_exposure(self._clock.monotonic(), settings)
            self._update()
        return refusal

    def _refusal(self, settings: ExposureSettings) -> _Refusal | None:
        destination = self._number_of(Property.EOS_CAPTURE_DESTINATION)
        if self._is_busy:
            return _Refusal.BUSY
        if self._battery <= 0:
            return _Refusal.BATTERY_EMPTY
        if self._mirror_lockup:
            return _Refusal.MIRROR_LOCKUP
        if destination & CaptureDestination.HOST and self._frames_waiting() >= self.body.burst:
            return _Refusal.MEMORY_FULL
        if not self._available_shots():
            return _Refusal.STORE_FULL
        try:
            self._film.accept(settings)
        except DeviceRefused:
            return _Refusal.EXPOSURE
        return None

    def _settings(self) -> ExposureSettings:
        """Return the nominal exposure settings, with assumed values instead of the values of a light meter."""
        iso = self._number_of(Property.EOS_ISO_SPEED)
        aperture = self._number_of(Property.EOS_APERTURE)
        shutter = self._number_of(Property.EOS_SHUTTER_SPEED)
        mode = self._number_of(Property.EOS_AE_MODE)
        return ExposureSettings(
            round(canon.ISO.value(iso)) if iso else _AUTO_ISO,
            None
            if not self.body.aperture_codes
            else canon.APERTURE.value(aperture)
            if aperture and mode in (AeMode.MANUAL, AeMode.APERTURE_PRIORITY)
            else _METERED_APERTURE,
            canon.SHUTTER.value(shutter)
            if shutter and shutter not in canon.SHUTTER.specials and mode in (AeMode.MANUAL, AeMode.SHUTTER_PRIORITY)
            else _METERED_S,
        )

    # The shutter.

    def _plan_exposure(self, opens_at: float, settings: ExposureSettings) -> None:
        self._unfinished += 1
        self._record(Notice(EosEvent.CAMERA_STATUS_CHANGED, CameraStatus.BUSY))

        def open_shutter() -> None:
            delay = timedelta(seconds=self._clock.monotonic() - opens_at)
            self._unfinished -= 1
            self._expose(settings, self._clock.now() - delay, opens_at + settings.shutter_s)

        self._schedule(opens_at, open_shutter)

    def _expose(self, settings: ExposureSettings, opened: datetime, closes_at: float) -> None:
        self._unfinished += 1
        self._shutter_count += 1
        self._battery = max(self._battery - 1 / self.body.shots_per_charge, 0.0)
        self._number = self._number % 9999 + 1
        frame = _Frame(
            self._number,
            opened + self._time_offset,
            self._develop(settings, opened),
            ImageFormat.decode(self._properties[Property.EOS_IMAGE_FORMAT].value),
            self._number_of(Property.EOS_CAPTURE_DESTINATION),
        )
        self._schedule(closes_at + self.body.write_s, lambda: self._finish_frame(frame))

    def _develop(self, settings: ExposureSettings, opened: datetime) -> Future[bytes | None]:
        def develop() -> bytes | None:
            buffer = BytesIO()
            try:
                self._film.accept(settings)
                self._film.expose(settings, opened, buffer)
            except (DeviceError, CropError):
                # No file is sent, as if a real camera had an internal error.
                return None
            return buffer.getvalue()

        if self._executor is not None:
            return self._executor.submit(develop)
        future: Future[bytes | None] = Future()
        future.set_result(develop())
        return future

    def _finish_frame(self, frame: _Frame) -> None:
        # The calculation of a frame may take longer than the exposure and writing of a real body. Then try again later.
        if not frame.raw.done():
            self._schedule(self._clock.monotonic() + 0.01, lambda: self._finish_frame(frame))
            return
        raw = frame.raw.result()
        self._unfinished -= 1
        if raw is not None:
            suffix = self._film.suffix.lower()
            for index, file in enumerate(frame.formats.files):
                name = f"IMG_{frame.number:04d}"
                if file.is_raw:
                    raw_format = _FORMATS_BY_SUFFIX.get(suffix, ObjectFormat.CR2)
                    self._deliver(frame, index, f"{name}{suffix.upper()}", raw_format, raw)
                else:
                    self._deliver(frame, index, f"{name}.JPG", ObjectFormat.EXIF_JPEG, _small_jpeg(name))
        self._report(Property.EOS_AVAILABLE_SHOTS, Property.EOS_SHUTTER_COUNTER, Property.EOS_BATTERY_POWER)
        if not self._is_busy:
            self._record(Notice(EosEvent.CAMERA_STATUS_CHANGED, CameraStatus.IDLE))
        self._idle_since = self._clock.monotonic()

    def _deliver(self, frame: _Frame, index: int, name: str, file_format: int, data: bytes) -> None:
        wide = self.body.wide_objects
        if frame.destination != CaptureDestination.HOST and self._card is not None:
            handle = FOLDER | frame.number << 4 | index + 1
            item = StoredObject(handle, CARD, file_format, name, frame.taken_at, FOLDER, data)
            self._card.objects[handle] = item
            self._record(ObjectEvent(EosEvent.OBJECT_ADDED_64 if wide else EosEvent.OBJECT_ADDED, item.entry))
            self._record(Notice(EosEvent.STORAGE_INFO_CHANGED, CARD))
        if frame.destination & CaptureDestination.HOST:
            handle = next(self._handles)
            self._memory[handle] = StoredObject(handle, 0, file_format, name, frame.taken_at, data=data)
            self._host_bytes = max(self._host_bytes - len(data), 0)
            self._offer_transfer(self._memory[handle])

    # Operations on settings.

    def _set_device_prop_value_ex(self, arguments: Arguments) -> None:
        self._require_remote()
        try:
            setting = PropertySetting.decode(arguments.data or b"")
        except ProtocolError:
            raise OperationRefusal(ResponseCode.INVALID_DEVICE_PROP_FORMAT) from None
        state = self._properties.get(setting.code)
        if state is None:
            raise OperationRefusal(ResponseCode.DEVICE_PROP_NOT_SUPPORTED)
        # The recorded 60D answers DEVICE_BUSY to a value that is not in its list.
        if self._is_busy or not self._allows(setting, state):
            raise OperationRefusal(ResponseCode.DEVICE_BUSY)
        self._store(setting.code, setting.value)

    def _allows(self, setting: PropertySetting, state: PropertyState) -> bool:
        try:
            if setting.code in IMAGE_FORMAT_PROPERTIES:
                return ImageFormat.decode(setting.value) in state.formats
            if state.list_kind == LIST:
                return number_of(setting.value) in state.choices
        except ProtocolError:
            raise OperationRefusal(ResponseCode.INVALID_DEVICE_PROP_FORMAT) from None
        return state.list_kind == FREE and setting.code in _FREELY_SET

    def _store(self, code: int, value: bytes) -> None:
        if code == Property.EOS_CAMERA_TIME:
            self._time_offset = datetime.fromtimestamp(number_of(value), UTC) - self._clock.now()
            self._report(code)
            return
        if code in (Property.EOS_IMAGE_FORMAT, Property.EOS_IMAGE_FORMAT_SD):
            self._change(Property.EOS_IMAGE_FORMAT, value)
            self._change(Property.EOS_IMAGE_FORMAT_SD, value)
            return
        if code == Property.EOS_MIRROR_UP_SETTING:
            self._mirror_lockup = bool(number_of(value))
        self._change(code, value)
        if code == Property.EOS_CAPTURE_DESTINATION:
            self._report(Property.EOS_AVAILABLE_SHOTS, Property.EOS_CURRENT_STORAGE, Property.EOS_CURRENT_FOLDER)

    def _request_device_prop_value(self, arguments: Arguments) -> None:
        if arguments.first not in self._properties:
            raise OperationRefusal(ResponseCode.GENERAL_ERROR)
        self._report(arguments.first)

    def _description(self, code: int) -> DevicePropDesc:
        match code:
            case Property.BATTERY_LEVEL:
                percent = round(100 * self._battery)
                levels = (100, 75, 50, 25, 0)
                return DevicePropDesc(code, DataType.UINT8, False, percent, percent, levels, widened=True)
            case Property.DEVICE_FRIENDLY_NAME:
                return DevicePropDesc(code, DataType.STRING, False, self.body.model, self.body.model)
            case Property.PERCEIVED_DEVICE_TYPE:
                return DevicePropDesc(code, DataType.UINT32, False, 1, 1)
            case Property.SESSION_INITIATOR:
                return DevicePropDesc(code, DataType.STRING, True, "Unknown Initiator", self._initiator)
            case Property.USE_DEVICE_STAGE:
                return DevicePropDesc(code, DataType.UINT8, False, 1, 1)
            case _:
                raise OperationRefusal(ResponseCode.DEVICE_PROP_NOT_SUPPORTED)

    def _get_device_prop_desc(self, arguments: Arguments) -> OperationResult:
        return OperationResult(self._description(arguments.first).encode())

    def _get_device_prop_value(self, arguments: Arguments) -> OperationResult:
        description = self._description(arguments.first)
        return OperationResult(encode_value(description.data_type, description.current))

    def _set_device_prop_value(self, arguments: Arguments) -> None:
        description = self._description(arguments.first)
        if not description.writable:
            raise OperationRefusal(ResponseCode.ACCESS_DENIED)
        try:
            value: Value = decode_value(description.data_type, arguments.data or b"")
        except ProtocolError:
            raise OperationRefusal(ResponseCode.INVALID_DEVICE_PROP_FORMAT) from None
        self._initiator = str(value)

    # The cable.

    def takes_data(self, request: PtpRequest) -> bool:
        """Return whether this operation has a data phase from the initiator."""
        return request.code in (
            Operation.SET_DEVICE_PROP_VALUE,
            Operation.EOS_SET_DEVICE_PROP_VALUE_EX,
            Operation.SEND_OBJECT_INFO,
            Operation.SEND_OBJECT,
        )

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Carry out a request."""
        with self._updated():
            if self._is_asleep:
                raise LinkClosed(f"the simulated {self.body.model} has switched itself off; call wake()")
            try:
                reply = self._carry_out(request, data)
            except OperationRefusal as refusal:
                return Answer(PtpResponse(refusal.code, request.transaction, refusal.parameters))
            return Answer(PtpResponse(ResponseCode.OK, request.transaction, reply.parameters), reply.data)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return hints that GetEvent has events. There is one hint each time an empty queue gets an event."""
        with self._updated():
            hints, self._hints = tuple(self._hints), []
            return hints

    def cancelled(self, transaction: int) -> None:
        """Do nothing, because each operation is complete before it can be cancelled."""

    def unplugged(self) -> None:
        """End the session; frames in the memory are kept unless the camera is `forgetful`."""
        with self._updated():
            self._end_session()

    # Controls of the camera.

    @property
    def asleep(self) -> bool:
        """Whether the camera has switched itself off."""
        with self._updated():
            return self._is_asleep

    @property
    def busy(self) -> bool:
        """Whether a frame is being exposed or written."""
        with self._updated():
            return self._is_busy

    def wake(self) -> None:
        """Half-press the release of a sleeping camera."""
        with self._updated():
            self._is_asleep = False
            self._restart_idle_time()

    def turn_dial(self, mode: AeMode) -> None:
        """Turn the mode dial, which determines whether shutter time and aperture can be set."""
        with self._updated():
            self._change(Property.EOS_AE_MODE, number_value(mode))
            self._renew_exposure_lists()

    def switch_focus(self, automatic: bool) -> None:
        """Set the switch of the lens to AF or MF."""
        with self._updated():
            self._change(Property.EOS_FOCUS_MODE, number_value(FocusMode.ONE_SHOT if automatic else FocusMode.MANUAL))

    def switch_mirror_lockup(self, on: bool) -> None:
        """Set mirror lockup in the menu or in the custom functions of the body."""
        with self._updated():
            self._mirror_lockup = on
            if Property.EOS_MIRROR_UP_SETTING in self._properties:
                self._change(Property.EOS_MIRROR_UP_SETTING, number_value(int(on)))
            else:
                self._report(Property.EOS_CUSTOM_FUNCTIONS)

    def set_menu(self, code: int, value: int | ImageFormat) -> None:
        """Set a property in the menu of the camera, with any value."""
        with self._updated():
            self._store(code, value.encode() if isinstance(value, ImageFormat) else number_value(value))

    def remove_card(self) -> None:
        """Remove the card with its files."""
        with self._updated():
            self._card = None
            self._record(Notice(EosEvent.STORE_REMOVED, CARD))
            self._renew_destinations()

    # Operations.

    def _carry_out(self, request: PtpRequest, data: bytes | None) -> OperationResult:
        operation = self._operations.get(request.code)
        if operation is None:
            raise OperationRefusal(ResponseCode.OPERATION_NOT_SUPPORTED)
        if request.code not in (Operation.GET_DEVICE_INFO, Operation.OPEN_SESSION):
            if not self._session:
                raise OperationRefusal(ResponseCode.SESSION_NOT_OPEN)
            self._check_transaction(request.transaction)
        elif self._session and request.code == Operation.GET_DEVICE_INFO and request.transaction:
            self._check_transaction(request.transaction)
        if request.code not in (Operation.EOS_GET_EVENT, Operation.GET_DEVICE_INFO):
            self._restart_idle_time()
        first, second, third, *_ = (*request.parameters, 0, 0, 0)
        return operation(Arguments(first, second, third, data)) or OperationResult()

    def _check_transaction(self, transaction: int) -> None:
        # Transaction numbers may be skipped, because a request can be lost.
        advance = (transaction - self._last_transaction) & U32
        if transaction in (0, U32) or not 0 < advance < 1 << 31:
            raise OperationRefusal(ResponseCode.INVALID_TRANSACTION_ID)
        self._last_transaction = transaction

    # Device and session.

    def _get_device_info(self, _: Arguments) -> OperationResult:
        digits = hashlib.md5(self.serial.encode(), usedforsecurity=False).hexdigest()
        return OperationResult(
            replace(self.body.info, operations=tuple(self._operations), serial_number=digits).encode()
        )

    def _get_device_info_ex(self, _: Arguments) -> OperationResult:
        return OperationResult(self.body.info_ex.encode())

    def _get_remote_mode(self, _: Arguments) -> OperationResult:
        return OperationResult(parameters=(self._remote_mode,))

    def _open_session(self, arguments: Arguments) -> None:
        if not arguments.first:
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        if self._session:
            raise OperationRefusal(ResponseCode.SESSION_ALREADY_OPEN, self._session)
        self._session = arguments.first
        self._last_transaction = 0
        self._restart_idle_time()

    def _close_session(self, _: Arguments) -> None:
        self._end_session()

    def _end_session(self) -> None:
        self._session = 0
        self._remote_mode = 0
        self._event_mode = 0
        self._queue.clear()
        self._hints.clear()
        if self._forgetful:
            self._memory.clear()
        self._host_bytes = 0
        self._is_warned = False
        self._renew_destinations()

    def _set_remote_mode(self, arguments: Arguments) -> None:
        self._remote_mode = arguments.first

    def _set_event_mode(self, arguments: Arguments) -> None:
        self._event_mode = arguments.first
        self._queue.clear()
        if self._event_mode:
            self._report_everything()

    def _report_everything(self) -> None:
        for code, state in self._properties.items():
            if state.reported:
                self._report(code)
        if self._card is not None:
            self._record(Notice(EosEvent.CTG_INFO_CHECK_COMPLETE, CARD))
        for code in self._properties:
            self._report_list(code)
        # Assumed: a frame that was not fetched is offered to the next initiator.
        for item in self._memory.values():
            self._offer_transfer(item)

    def _do_nothing(self, _: Arguments) -> None:
        """Answer OK."""

    def _handlers(self) -> dict[int, Callable[[Arguments], OperationResult | None]]:
        # In the order of the 60D.
        return {
            Operation.GET_DEVICE_PROP_DESC: self._get_device_prop_desc,
            Operation.GET_DEVICE_PROP_VALUE: self._get_device_prop_value,
            Operation.SET_DEVICE_PROP_VALUE: self._set_device_prop_value,
            Operation.GET_DEVICE_INFO: self._get_device_info,
            Operation.OPEN_SESSION: self._open_session,
            Operation.CLOSE_SESSION: self._close_session,
            Operation.GET_NUM_OBJECTS: self._get_num_objects,
            Operation.GET_STORAGE_IDS: self._get_storage_ids,
            Operation.EOS_GET_STORAGE_IDS: self._get_storage_ids,
            Operation.GET_STORAGE_INFO: self._get_storage_info,
            Operation.EOS_GET_STORAGE_INFO: self._get_storage_info,
            Operation.GET_OBJECT_HANDLES: self._get_object_handles,
            Operation.GET_OBJECT_INFO: self._get_object_info,
            Operation.GET_OBJECT: self._get_object,
            Operation.EOS_GET_OBJECT: self._get_object,
            Operation.GET_THUMB: self._get_thumb,
            Operation.GET_PARTIAL_OBJECT: self._get_partial_object,
            Operation.EOS_GET_PARTIAL_OBJECT: self._get_partial_object,
            Operation.DELETE_OBJECT: self._delete_object,
            Operation.EOS_DELETE_OBJECT: self._delete_object,
            Operation.EOS_SET_DEVICE_PROP_VALUE_EX: self._set_device_prop_value_ex,
            Operation.EOS_REQUEST_DEVICE_PROP_VALUE: self._request_device_prop_value,
            Operation.EOS_GET_DEVICE_INFO_EX: self._get_device_info_ex,
            Operation.EOS_GET_OBJECT_INFO_EX: self._get_object_info_ex,
            Operation.EOS_REMOTE_RELEASE: self._remote_release,
            Operation.EOS_SET_EVENT_MODE: self._set_event_mode,
            Operation.EOS_SET_REMOTE_MODE: self._set_remote_mode,
            Operation.EOS_GET_REMOTE_MODE: self._get_remote_mode,
            Operation.EOS_GET_EVENT: self._get_event,
            Operation.EOS_TRANSFER_COMPLETE: self._transfer_complete,
            Operation.EOS_CANCEL_TRANSFER: self._transfer_complete,
            Operation.EOS_RESET_TRANSFER: self._reset_transfer,
            Operation.EOS_KEEP_DEVICE_ON: self._do_nothing,
            Operation.EOS_SET_UI_LOCK: self._do_nothing,
            Operation.EOS_RESET_UI_LOCK: self._do_nothing,
            Operation.EOS_PC_HDD_CAPACITY: self._pc_hdd_capacity,
            Operation.EOS_AF_CANCEL: self._do_nothing,
            Operation.EOS_REMOTE_RELEASE_ON: self._remote_release_on,
            Operation.EOS_REMOTE_RELEASE_OFF: self._remote_release_off,
            Operation.EOS_RESET_MIRROR_LOCKUP_STATE: self._do_nothing,
        }


def _small_jpeg(name: str) -> bytes:
    # A small grey picture with the file name instead of a frame.
    import cv2
    import numpy as np

    picture = np.full((*_JPEG_SIZE, 3), 118, dtype=np.uint8)
    picture = cv2.putText(picture, name, (20, 90), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (255, 255, 255))
    return cv2.imencode(".jpg", picture)[1].tobytes()
