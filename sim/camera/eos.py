"""The simulated EOS: a PTP responder that behaves as a Canon EOS body does, with a `Film` where the sensor would be.

Here stand its two sides, the session, and its sleep. What it is stands in `sim.camera.eos_state`; what it does, in
`sim.camera.eos_settings`, `sim.camera.eos_files` and `sim.camera.eos_release`. The rules of all five:

- State moves with the time that is handed in, and only when somebody asks or touches the camera: what falls due in
  between happens then, in its order. With a `SimulatedClock` an initiator that waits must sleep by the same clock;
  a camera on a real cable needs the `SystemClock`.
- The picture is what the film shows when the shutter opens. It reaches the initiator byte for byte.
- The camera announces nothing by itself: changes queue up for GetEvent, as on the real body.
- What no public recording shows is marked "assumed" where it is decided; the rest follows the recorded EOS 60D.

An initiator reaches it through `answer`; a hand on the camera through `turn_dial`, `switch_focus`, `set_menu`,
`insert_card`, `remove_card` and `wake`. Both may be used from several threads.

Source: a recorded EOS 60D; ISO 15740:2013 for what is standard; libgphoto2 2.5.34 for what initiators expect.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import replace

from drivers.canon.records import ImageFormat, Notice, number_of, number_value
from drivers.ptp.codes import AeMode, EosEvent, FocusMode, Operation, Property, ReleaseButton, ResponseCode
from drivers.ptp.transaction import PtpEvent, PtpRequest, PtpResponse
from foundation.clock import Clock
from foundation.errors import LinkClosed
from sim.buses.responder import Answer
from sim.camera.eos_model import EosModel
from sim.camera.eos_release import EosRelease
from sim.camera.eos_settings import EosSettings
from sim.camera.eos_state import CARD, Arguments, OperationRefusal, OperationResult
from sim.camera.film import Film

_SHUTDOWN_WARNING_S = 10.0
"""How long before it goes to sleep the camera says so (assumed)."""


class SimulatedEos(EosSettings, EosRelease):
    """An EOS body on a cable; a `sim.buses.responder.Responder`.

    `card_bytes`: capacity of the card; None for an empty slot. `auto_power_off_s`: idle seconds after which it goes to
    sleep; 0 for never, None for the body's own setting. Asking for events keeps no body awake, KeepDeviceOn does.
    `battery`: charge, 0 … 1. `executor`: where the film is developed. None does it while the release is answered, and
    is what tests want; a camera on a real cable hands in an executor of one thread, so that a large frame does not hold
    up the answers.
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
        super().__init__(
            body,
            film,
            clock,
            serial=serial,
            card_bytes=card_bytes,
            auto_power_off_s=auto_power_off_s,
            battery=battery,
            shutter_count=shutter_count,
            forgetful=forgetful,
            executor=executor,
        )
        self._guard = threading.RLock()
        self._operations = self._handlers(frozenset(without))

    # The cable.

    def takes_data(self, request: PtpRequest) -> bool:
        """Return whether the initiator sends a data phase with this operation."""
        return request.code in (
            Operation.SET_DEVICE_PROP_VALUE,
            Operation.EOS_SET_DEVICE_PROP_VALUE_EX,
            Operation.SEND_OBJECT_INFO,
            Operation.SEND_OBJECT,
        )

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Carry out a request."""
        with self._guard:
            self._move()
            if self._asleep:
                raise LinkClosed(f"the simulated {self.body.model} has switched itself off; wake it up")
            try:
                reply = self._carry_out(request, data)
            except OperationRefusal as no:
                return Answer(PtpResponse(no.code, request.transaction, no.parameters))
            return Answer(PtpResponse(ResponseCode.OK, request.transaction, reply.parameters), reply.data)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return hints that GetEvent has something to report, one for a queue that was empty."""
        with self._guard:
            self._move()
            hints, self._hints = tuple(self._hints), []
            return hints

    def cancelled(self, transaction: int) -> None:
        """Note that the initiator gave up a transaction: each is carried out at once, so nothing is left to undo."""

    def unplugged(self) -> None:
        """End the session; frames that wait in the camera's memory go on waiting, unless it is `forgetful`."""
        with self._guard:
            self._move()
            self._end_session()

    # The hand on the camera.

    @property
    def asleep(self) -> bool:
        """Whether it has switched itself off."""
        with self._guard:
            self._move()
            return self._asleep

    @property
    def busy(self) -> bool:
        """Whether a picture is being taken or written."""
        with self._guard:
            self._move()
            return self._is_busy

    def wake(self) -> None:
        """Half-press the release of a sleeping camera."""
        with self._guard:
            self._move()
            self._asleep = False
            self._touch()

    def turn_dial(self, mode: AeMode) -> None:
        """Turn the mode dial; shutter time and aperture can be set where `mode` leaves them to the photographer."""
        with self._guard:
            self._move()
            self._change(Property.EOS_AE_MODE, number_value(mode))
            self._renew_exposure_lists()

    def switch_focus(self, automatic: bool, finds: bool = True) -> None:
        """Move the lens's switch to AF or MF; `finds` says whether AF will find anything to focus on."""
        with self._guard:
            self._move()
            self._finds_focus = finds
            self._focused = False
            self._change(Property.EOS_FOCUS_MODE, number_value(FocusMode.ONE_SHOT if automatic else FocusMode.MANUAL))

    def switch_mirror_lockup(self, on: bool) -> None:
        """Set mirror lockup in the menu or the custom functions, wherever the body has it."""
        with self._guard:
            self._move()
            self._mirror_lockup = on
            if Property.EOS_MIRROR_UP_SETTING in self._properties:
                self._change(Property.EOS_MIRROR_UP_SETTING, number_value(int(on)))
            else:
                self._report(Property.EOS_CUSTOM_FUNCTIONS)

    def set_menu(self, code: int, value: int | ImageFormat) -> None:
        """Set a property by the camera's own menu, which no list restricts."""
        with self._guard:
            self._move()
            self._store(code, value.encode() if isinstance(value, ImageFormat) else number_value(value))

    def insert_card(self, card_bytes: int) -> None:
        """Put an empty card into the slot."""
        with self._guard:
            self._move()
            self._card = self._blank_card(card_bytes)
            self._record(Notice(EosEvent.STORE_ADDED, CARD))
            self._renew_destinations()

    def remove_card(self) -> None:
        """Take the card out, with what is on it."""
        with self._guard:
            self._move()
            self._card = None
            self._record(Notice(EosEvent.STORE_REMOVED, CARD))
            self._renew_destinations()

    # Falling asleep.

    def _move(self) -> None:
        """Let everything happen that has fallen due, and fall asleep in the end."""
        super()._move()
        limit = number_of(self._properties[Property.EOS_AUTO_POWER_OFF].value)
        if not self._session or not limit or self._is_busy:
            return
        idle = self._clock.monotonic() - self._idle_since
        if idle >= limit:
            self._end_session()
            self._memory.clear()
            self._asleep = True
        elif idle >= limit - min(_SHUTDOWN_WARNING_S, limit / 2) and not self._warned:
            self._warned = True
            self._record(Notice(EosEvent.WILL_SOON_SHUT_DOWN, int(limit - idle)))

    def _touch(self) -> None:
        self._idle_since = self._clock.monotonic()
        if self._warned:
            self._warned = False
            limit = number_of(self._properties[Property.EOS_AUTO_POWER_OFF].value)
            self._record(Notice(EosEvent.SHUTDOWN_TIMER_UPDATED, limit))

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
            self._touch()
        one, two, three, *_ = (*request.parameters, 0, 0, 0)
        return operation(Arguments(one, two, three, data))

    def _check_transaction(self, transaction: int) -> None:
        """Refuse a number that is none or was used: one may be skipped, for a request can be lost in transit."""
        advance = (transaction - self._last_transaction) & 0xFFFFFFFF
        if transaction in (0, 0xFFFFFFFF) or not 0 < advance < 1 << 31:
            raise OperationRefusal(ResponseCode.INVALID_TRANSACTION_ID)
        self._last_transaction = transaction

    def _handlers(self, without: frozenset[int]) -> dict[int, Callable[[Arguments], OperationResult]]:
        operations: dict[int, Callable[[Arguments], OperationResult]] = {
            Operation.GET_DEVICE_INFO: self._get_device_info,
            Operation.OPEN_SESSION: self._open_session,
            Operation.CLOSE_SESSION: self._close_session,
            Operation.GET_STORAGE_IDS: self._get_storage_ids,
            Operation.GET_STORAGE_INFO: self._get_storage_info,
            Operation.GET_NUM_OBJECTS: self._get_num_objects,
            Operation.GET_OBJECT_HANDLES: self._get_object_handles,
            Operation.GET_OBJECT_INFO: self._get_object_info,
            Operation.GET_OBJECT: self._get_object,
            Operation.GET_THUMB: self._get_thumb,
            Operation.DELETE_OBJECT: self._delete_object,
            Operation.GET_DEVICE_PROP_DESC: self._get_device_prop_desc,
            Operation.GET_DEVICE_PROP_VALUE: self._get_device_prop_value,
            Operation.SET_DEVICE_PROP_VALUE: self._set_device_prop_value,
            Operation.GET_PARTIAL_OBJECT: self._get_partial_object,
            Operation.EOS_GET_STORAGE_IDS: self._get_storage_ids,
            Operation.EOS_GET_STORAGE_INFO: self._get_storage_info,
            Operation.EOS_GET_OBJECT: self._get_object,
            Operation.EOS_DELETE_OBJECT: self._delete_object,
            Operation.EOS_GET_PARTIAL_OBJECT: self._get_partial_object,
            Operation.EOS_GET_DEVICE_INFO_EX: lambda _: OperationResult(self.body.info_ex.encode()),
            Operation.EOS_GET_OBJECT_INFO_EX: self._get_object_info_ex,
            Operation.EOS_REMOTE_RELEASE: self._remote_release,
            Operation.EOS_SET_DEVICE_PROP_VALUE_EX: self._set_device_prop_value_ex,
            Operation.EOS_REQUEST_DEVICE_PROP_VALUE: self._request_device_prop_value,
            Operation.EOS_GET_REMOTE_MODE: lambda _: OperationResult(parameters=(self._remote_mode,)),
            Operation.EOS_SET_REMOTE_MODE: self._set_remote_mode,
            Operation.EOS_SET_EVENT_MODE: self._set_event_mode,
            Operation.EOS_GET_EVENT: self._get_event,
            Operation.EOS_TRANSFER_COMPLETE: self._transfer_complete,
            Operation.EOS_CANCEL_TRANSFER: self._transfer_complete,
            Operation.EOS_RESET_TRANSFER: self._reset_transfer,
            Operation.EOS_PC_HDD_CAPACITY: self._pc_hdd_capacity,
            Operation.EOS_SET_UI_LOCK: lambda _: OperationResult(),
            Operation.EOS_RESET_UI_LOCK: lambda _: OperationResult(),
            Operation.EOS_KEEP_DEVICE_ON: lambda _: OperationResult(),
            Operation.EOS_AF_CANCEL: self._cancel_focus,
            Operation.EOS_RESET_MIRROR_LOCKUP_STATE: lambda _: OperationResult(),
            Operation.EOS_REMOTE_RELEASE_ON: self._remote_release_on,
            Operation.EOS_REMOTE_RELEASE_OFF: self._remote_release_off,
        }
        return {code: operation for code, operation in operations.items() if code not in without}

    # Device and session.

    def _get_device_info(self, _: Arguments) -> OperationResult:
        known = tuple(code for code in self.body.info.operations if code in self._operations)
        digits = hashlib.md5(self.serial.encode(), usedforsecurity=False).hexdigest()
        return OperationResult(replace(self.body.info, operations=known, serial_number=digits).encode())

    def _open_session(self, arguments: Arguments) -> OperationResult:
        if not arguments.one:
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        if self._session:
            raise OperationRefusal(ResponseCode.SESSION_ALREADY_OPEN, self._session)
        self._session = arguments.one
        self._last_transaction = 0
        self._touch()
        return OperationResult()

    def _close_session(self, _: Arguments) -> OperationResult:
        self._end_session()
        return OperationResult()

    def _end_session(self) -> None:
        self._session = 0
        self._remote_mode = 0
        self._event_mode = 0
        self._queue.clear()
        self._hints.clear()
        if self._forgetful:
            self._memory.clear()
        self._host_bytes = 0
        self._warned = False
        self._let_go(ReleaseButton.HALF_AND_FULL)
        self._renew_destinations()

    def _set_remote_mode(self, arguments: Arguments) -> OperationResult:
        self._remote_mode = arguments.one
        if not self._remote_mode:
            self._let_go(ReleaseButton.HALF_AND_FULL)
        return OperationResult()

    def _set_event_mode(self, arguments: Arguments) -> OperationResult:
        self._event_mode = arguments.one
        self._queue.clear()
        if self._event_mode:
            self._tell_everything()
        return OperationResult()

    def _tell_everything(self) -> None:
        for code, known in self._properties.items():
            if known.reported:
                self._report(code)
        if self._card is not None:
            self._record(Notice(EosEvent.CTG_INFO_CHECK_COMPLETE, CARD))
        for code in self._properties:
            self._report_list(code)
        # Assumed: a frame that nobody fetched is offered to the next who listens.
        for item in self._memory.values():
            self._offer_transfer(item)
