"""What a simulated EOS is at a moment, and what moves it: its time, its events, the values of its properties.

The rules, and who joins all this to a camera, stand in `sim.camera.eos`. Everything that a body remembers is set here,
so that the files above hold behaviour alone.

Source: a recorded EOS 60D; libgphoto2 2.5.34 for what initiators expect.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import NamedTuple

from drivers.canon.records import (
    IMAGE_FORMAT_PROPERTIES,
    AvailableFormats,
    AvailableValues,
    ImageFormat,
    Notice,
    ObjectEntry,
    PropertyChanged,
    Record,
    encode_events,
    number_of,
    number_value,
    text_value,
)
from drivers.ptp.codes import AeMode, CaptureDestination, EosEvent, EventCode, ObjectFormat, Property, ResponseCode
from drivers.ptp.transaction import PtpEvent
from foundation.clock import Clock
from sim.camera.eos_model import MIRROR_LOCKUP, EosModel, custom_functions
from sim.camera.film import Film

CARD = 0x00020001
"""The store that is the card."""
EMPTY_SLOT = 0x00020000
"""The storage id while there is no card."""
DCIM = 0x90000000
"""Handle of the folder DCIM in the root of the card."""
FOLDER = 0x91900000
"""Handle of the folder 100CANON; files on the card are numbered from it, 16 apart."""
BULB = 0x0C
"""The shutter speed that lasts as long as the release is held."""
U32 = 0xFFFFFFFF
"""What a parameter or a time can hold at most."""
_MEMORY = 0xA0000000
"""Handles of objects in the camera's memory are numbered from here (assumed)."""
_MOST_SHOTS = 0x7FFFFFFF
"""Highest number of free shots that is reported: what a signed number of 32 bits holds."""
_TEXTS = (Property.EOS_OWNER, Property.EOS_ARTIST, Property.EOS_COPYRIGHT)


class OperationRefusal(Exception):
    """Ends an operation with another response than OK."""

    def __init__(self, code: int, *parameters: int) -> None:
        super().__init__(code)
        self.code = code
        self.parameters = parameters


class OperationResult(NamedTuple):
    """What an operation that was carried out answers."""

    data: bytes | None = None
    parameters: tuple[int, ...] = ()


class Arguments(NamedTuple):
    """What came with a request: three parameters, 0 where it had fewer, and the data phase."""

    one: int
    two: int
    three: int
    data: bytes | None


@dataclass
class PropertyState:
    """A property as it stands: what it is, and what it can be set to."""

    value: bytes
    kind: int
    reported: bool
    choices: tuple[int, ...] = ()
    formats: tuple[ImageFormat, ...] = ()


@dataclass(frozen=True)
class StoredObject:
    """A file or folder: on the card, or in the camera's memory where `storage` is 0."""

    handle: int
    storage: int
    format: int
    name: str
    taken_at: datetime
    parent: int = 0
    data: bytes = b""

    @property
    def entry(self) -> ObjectEntry:
        """It as a body lists it, and announces it."""
        return ObjectEntry(
            self.handle, self.storage, self.format, len(self.data), self.name, self.parent, self.handle,
            time=int(self.taken_at.timestamp()) & U32,
        )  # fmt: skip


@dataclass
class Card:
    """A memory card: its capacity in bytes, and the objects on it by handle."""

    capacity: int
    objects: dict[int, StoredObject] = field(default_factory=dict[int, StoredObject])

    @property
    def free(self) -> int:
        """Bytes that still fit on it."""
        return self.capacity - sum(len(item.data) for item in self.objects.values())


class SimulatedEosState:
    """The state of a body; see `sim.camera.eos.SimulatedEos` for the parameters."""

    def __init__(
        self,
        body: EosModel,
        film: Film,
        clock: Clock,
        *,
        serial: str,
        card_bytes: int | None,
        auto_power_off_s: int | None,
        battery: float,
        shutter_count: int,
        forgetful: bool,
        executor: Executor | None,
    ) -> None:
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
        self._finds_focus = True
        self._asleep = False
        # What a session has and loses.
        self._session = 0
        self._last_transaction = 0
        self._remote_mode = 0
        self._event_mode = 0
        self._queue: list[Record] = []
        self._memory: dict[int, StoredObject] = {}
        self._host_bytes = 0
        self._hints: list[PtpEvent] = []
        self._idle_since = clock.monotonic()
        self._warned = False
        # What is under way: (when, order, what happens then), the earliest first.
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._unfinished = 0
        self._focused = False
        self._pressed_at: float | None = None
        self._bulb_since: tuple[float, datetime] | None = None
        self._bracket_step = 0
        self._properties = {
            spec.code: PropertyState(
                spec.value or b"", spec.kind, spec.value is not None, tuple(spec.choices), tuple(spec.formats)
            )
            for spec in body.properties
        }
        self._properties[Property.EOS_SERIAL_NUMBER].value = text_value(serial)
        for code in _TEXTS:
            self._properties[code].value = text_value("")
        if auto_power_off_s is not None:
            self._properties[Property.EOS_AUTO_POWER_OFF].value = number_value(auto_power_off_s)
        self._renew_destinations()
        self._renew_exposure_lists()

    # Time.

    def _move(self) -> None:
        """Let everything happen that has fallen due."""
        now = self._clock.monotonic()
        while self._due and self._due[0][0] <= now:
            _, _, happen = heapq.heappop(self._due)
            happen()

    def _at(self, when: float, happen: Callable[[], None]) -> None:
        heapq.heappush(self._due, (when, next(self._order), happen))

    @property
    def _is_busy(self) -> bool:
        return self._unfinished > 0 or self._bulb_since is not None

    def _now(self) -> datetime:
        return self._clock.now() + self._time_offset

    # Events.

    def _get_event(self, _: Arguments) -> OperationResult:
        if self._bulb_since is not None and self._event_mode:
            open_s = int(self._clock.monotonic() - self._bulb_since[0])
            self._record(Notice(EosEvent.BULB_EXPOSURE_TIME, open_s))
        records, self._queue = self._queue, []
        return OperationResult(encode_events(records))

    def _record(self, record: Record) -> None:
        if not self._event_mode:
            return
        if not self._queue:
            self._hints.append(PtpEvent(EventCode.EOS_REQUEST_GET_EVENT))
        self._queue.append(record)

    def _report_list(self, code: int) -> None:
        known = self._properties[code]
        if code in IMAGE_FORMAT_PROPERTIES:
            self._record(AvailableFormats(code, known.formats, known.kind))
        else:
            self._record(AvailableValues(code, known.choices, known.kind))

    # The values of properties.

    def _value(self, code: int) -> bytes:
        """Return a property's value; some are never stored, for they follow from the camera's state."""
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
        known = self._properties.get(code)
        return 0 if known is None else number_of(known.value)

    def _report(self, *codes: int) -> None:
        for code in codes:
            self._record(PropertyChanged(code, self._value(code)))
            if code == Property.EOS_CUSTOM_FUNCTIONS and Property.EOS_MIRROR_UP_SETTING not in self._properties:
                # Custom functions come as one record a group.
                self._record(PropertyChanged(code, custom_functions(3, {MIRROR_LOCKUP: int(self._mirror_lockup)})))

    def _change(self, code: int, value: bytes) -> None:
        self._properties[code].value = value
        self._report(code)

    def _offer(self, code: int, choices: tuple[int, ...]) -> None:
        if self._properties[code].choices != choices:
            self._properties[code].choices = choices
            self._report_list(code)

    def _renew_exposure_lists(self) -> None:
        mode = self._number_of(Property.EOS_AE_MODE)
        bulb = mode == AeMode.BULB
        timed = mode in (AeMode.MANUAL, AeMode.SHUTTER_PRIORITY)
        shutter = () if not timed else self.body.shutter_codes
        if mode == AeMode.SHUTTER_PRIORITY:
            shutter = tuple(code for code in shutter if code != BULB)
        self._offer(Property.EOS_SHUTTER_SPEED, shutter)
        apertured = mode in (AeMode.MANUAL, AeMode.APERTURE_PRIORITY, AeMode.BULB)
        self._offer(Property.EOS_APERTURE, self.body.aperture_codes if apertured else ())
        if bulb:
            self._change(Property.EOS_SHUTTER_SPEED, number_value(BULB))
        elif shutter and self._number_of(Property.EOS_SHUTTER_SPEED) not in shutter:
            self._change(Property.EOS_SHUTTER_SPEED, number_value(shutter[len(shutter) // 2]))

    def _renew_destinations(self) -> None:
        """Offer the destinations that there are; without remote control frames go to the card."""
        both = (CaptureDestination.CARD, CaptureDestination.HOST, CaptureDestination.CARD_AND_HOST)
        choices = both if self._card is not None else (CaptureDestination.HOST,)
        self._offer(Property.EOS_CAPTURE_DESTINATION, choices)
        if not self._session or self._number_of(Property.EOS_CAPTURE_DESTINATION) not in choices:
            # The 60D without a card reports the card as destination all the same.
            self._change(Property.EOS_CAPTURE_DESTINATION, number_value(CaptureDestination.CARD))
            self._report(Property.EOS_AVAILABLE_SHOTS, Property.EOS_CURRENT_STORAGE, Property.EOS_CURRENT_FOLDER)

    def _battery_code(self) -> int:
        return next(
            code for least, code in ((0.88, 2), (0.63, 4), (0.38, 1), (0.1, 5), (-1, 0)) if self._battery > least
        )

    # Who is in control, and what there is room for.

    def _require_remote(self) -> None:
        # Assumed: nothing shows what a body says to whoever has not taken control of it.
        if not self._remote_mode:
            raise OperationRefusal(ResponseCode.EOS_OPERATION_REFUSED)

    def _blank_card(self, capacity: int) -> Card:
        now = self._clock.now()
        card = Card(capacity)
        for folder in (
            StoredObject(DCIM, CARD, ObjectFormat.ASSOCIATION, "DCIM", now),
            StoredObject(FOLDER, CARD, ObjectFormat.ASSOCIATION, "100CANON", now, DCIM),
        ):
            card.objects[folder.handle] = folder
        return card

    def _available_shots(self) -> int:
        destination = self._number_of(Property.EOS_CAPTURE_DESTINATION)
        card = 0 if self._card is None else self._card.free
        if destination == CaptureDestination.HOST:
            free = self._host_bytes
        elif destination == CaptureDestination.CARD_AND_HOST:
            free = min(card, self._host_bytes)
        else:
            free = card
        return min(max(free, 0) // self.body.frame_bytes, _MOST_SHOTS)
