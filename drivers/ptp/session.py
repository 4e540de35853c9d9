"""A PTP session: numbered transactions between its opening and its closing, over any cable.

Rules that hold inside:

- A response other than OK raises `OperationDeclined`, which has its code by number and by name; what a device declines
  for the moment only (`PASSING`) is asked again, for a limited time.
- A fault of cable or protocol goes straight to the caller: whether an operation may be repeated is not known here.
  After one, the session is spent; a new one begins with `Transport.reset` or a new transport.

Source: ISO 15740:2013, clause 9.3 (sessions and transactions).
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator

from drivers.ptp.codes import Operation, ResponseCode, describe
from drivers.ptp.transaction import PtpEvent, PtpRequest, Transport, next_transaction
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceRefused, LinkTimeout, ProtocolError

_log = logging.getLogger(__name__)

START_TIMEOUT_S = 1.5
"""Wait for the answer to OpenSession: a body that a killed host left behind never answers before a reset."""
TIMEOUT_S = 20.0
"""Wait for every other answer, unless the caller sets another; libgphoto2 waits as long."""
PASSING_LIMIT_S = 10.0
"""How long an operation is asked again when a device declines it for the moment."""
OPEN_TRIES = 3
"""Tries at OpenSession with a reset between them, as many as libgphoto2 makes."""

PASSING = (ResponseCode.DEVICE_BUSY, ResponseCode.EOS_OBJECT_NOT_READY, ResponseCode.EOS_MEMORY_STATUS_NOT_READY)
"""Responses that mean: not now."""

_FIRST_PAUSE_S = 0.05
"""Before the first repetition: short to an operator, long beside the milliseconds of an operation."""
_LONGEST_PAUSE_S = 1.0
"""Pauses double up to here, so that a device that is free again waits for a second at most."""
_LAST_SESSION = 8
"""Session numbers tried where a device declines the transaction number, as libgphoto2 does; a few, then no more."""


class OperationDeclined(DeviceRefused):
    """A device answered an operation with another response than OK: `code`."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class PtpSession:
    """The initiator's side of a session."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport = transport
        self._clock = clock
        self._transaction = 0

    @property
    def label(self) -> str:
        """What messages call the device."""
        return self._transport.label

    def open(self) -> None:
        """Open the session; one that a former host left open is taken over."""
        faults = 0
        session = 1
        pauses = self._pauses(PASSING_LIMIT_S)
        while True:
            try:
                code = self._transport.transact(
                    PtpRequest(Operation.OPEN_SESSION, 0, (session,)), timeout=START_TIMEOUT_S
                ).response.code
            except (LinkTimeout, ProtocolError):
                faults += 1
                if faults == OPEN_TRIES:
                    raise
                self._transport.reset()
                continue
            if code in (ResponseCode.OK, ResponseCode.SESSION_ALREADY_OPEN):
                self._transaction = 0
                return
            if code == ResponseCode.INVALID_TRANSACTION_ID and session < _LAST_SESSION:
                session += 1
            elif code not in PASSING or not next(pauses, False):
                raise self._declined(PtpRequest(Operation.OPEN_SESSION, 0, (session,)), code)

    def close(self) -> None:
        """Close the session as far as the device still answers; the cable stays open."""
        with contextlib.suppress(DeviceError):
            self.call(Operation.CLOSE_SESSION, timeout=START_TIMEOUT_S, patience=0.0)

    def call(
        self,
        operation: int,
        *parameters: int,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float = TIMEOUT_S,
        patience: float = PASSING_LIMIT_S,
    ) -> tuple[tuple[int, ...], bytes]:
        """Carry out an operation.

        `send`: the data phase to the device; None where the operation has none. `receive`: takes the data phase from
        the device piece by piece; None collects it. `timeout`: longest wait for each answer, seconds. `patience`: how
        long it is asked again when the device declines for the moment, seconds.
        """
        pauses = self._pauses(patience)
        while True:
            self._transaction = next_transaction(self._transaction)
            request = PtpRequest(operation, self._transaction, parameters)
            done = self._transport.transact(request, send=send, receive=receive, timeout=timeout)
            answered = describe(ResponseCode, done.response.code)
            _log.debug("%s%s: %s", describe(Operation, operation), parameters, answered)
            if done.response.ok:
                return done.response.parameters, done.data
            # A device that declines sends no data, so that `receive` has seen nothing of a try that is repeated.
            if done.response.code not in PASSING or not next(pauses, False):
                raise self._declined(request, done.response.code)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that came on the event channel since the last call; never waits."""
        return self._transport.events()

    def _pauses(self, limit: float) -> Iterator[bool]:
        """Let growing pauses pass, one at each step; end when `limit` seconds are over."""
        end = self._clock.monotonic() + limit
        pause = _FIRST_PAUSE_S
        while (left := end - self._clock.monotonic()) > 0:
            self._clock.sleep(min(pause, left))
            pause = min(2 * pause, _LONGEST_PAUSE_S)
            yield True

    def _declined(self, request: PtpRequest, code: int) -> OperationDeclined:
        remedy = "; wait until it is idle, then try again" if code in PASSING else ""
        return OperationDeclined(f"{self.label} answers {describe(ResponseCode, code)} to {request}{remedy}", code)
