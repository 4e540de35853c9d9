"""PTP over a network: transactions on one TCP connection, events on a second one.

Rules that hold inside:

- A transaction that is called off is awaited to its response.
- The connections themselves, their greetings and pings are in `drivers.ptp.ip_connection`.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 (connections) and 2.3 (packets).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Final

from drivers.links.link import Link
from drivers.links.tcp import TcpLink
from drivers.ptp.ip_connection import CONNECT_S, EVENT_CHANNEL_S, RETRY_S, IpConnection, greet
from drivers.ptp.messages import PtpEvent, PtpRequest, PtpResponse
from drivers.ptp.ptpip import (
    PORT,
    Cancel,
    Data,
    EndData,
    InitCommandRequest,
    OperationRequest,
    Ping,
    Pong,
    StartData,
    encode,
    encode_data,
)
from drivers.ptp.reception import Reception, TransactionState
from drivers.ptp.transport import Transaction
from foundation.clock import Clock
from foundation.errors import DeviceRefused, LinkClosed, LinkError, ProtocolError

DATA_PIECE: Final = 64 * 1024
"""Bytes of data in a packet to the device; what libgphoto2 sends, and bodies are used to it."""

_CALL_OFF_S: Final = 2.0
"""Wait for the end of a transaction that was cancelled."""


class IpTransport:
    """A `drivers.ptp.transport.Transport` over two links.

    `open_command`, `open_event`: open the two connections; called again by `reset`. The second may raise `LinkClosed`
    for as long as the device has not opened its port: it is tried for 2 s. `guid`: 16 bytes by which a camera knows a
    computer that it was paired with.
    """

    def __init__(
        self,
        open_command: Callable[[], Link],
        open_event: Callable[[], Link],
        *,
        guid: bytes,
        name: str,
        clock: Clock,
        label: str = "the camera",
    ) -> None:
        self._open_command = open_command
        self._open_event = open_event
        self._initiator = InitCommandRequest(guid, name)
        self._clock = clock
        self._place = label
        self._connection = self._connect()
        self._state = TransactionState()

    @classmethod
    def connect(
        cls, host: str, port: int = PORT, *, event_port: int | None = None, guid: bytes, name: str, clock: Clock
    ) -> IpTransport:
        """Connect to the camera at an address; `event_port` only where it is not the same."""
        second = port if event_port is None else event_port
        return cls(
            lambda: TcpLink.connect(host, port, CONNECT_S),
            lambda: TcpLink.connect(host, second, CONNECT_S),
            guid=guid,
            name=name,
            clock=clock,
            label=f"the camera at {host}:{port}",
        )

    @property
    def label(self) -> str:
        """The name that the device gave, and its address."""
        name = self._connection.name
        return f"{name} ({self._place})" if name else self._place

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction; see `drivers.ptp.transport.Transport`."""

        def exchange(reception: Reception) -> Transaction:
            self._send(request, send, timeout)
            return self._receive(reception, timeout)

        return self._state.take(Reception(request, receive, self.label), exchange, self._call_off)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call, and answer pings; never waits."""
        self._connection.attend()
        return self._connection.take_events()

    def reset(self) -> None:
        """Hang up and connect anew; the session that was open is over."""
        self.close()
        # A device needs a moment to see that the old connection is gone; until then we ourselves keep it busy.
        deadline = self._clock.monotonic() + EVENT_CHANNEL_S
        while True:
            try:
                self._connection = self._connect()
            except (DeviceRefused, LinkClosed):
                if self._clock.monotonic() >= deadline:
                    raise
                self._clock.sleep(RETRY_S)
            else:
                self._state = TransactionState()
                return

    def close(self) -> None:
        """Hang up both connections; a second call does nothing."""
        self._state.closed = True
        self._connection.close()

    def _connect(self) -> IpConnection:
        return greet(self._open_command, self._open_event, self._initiator, self._clock, self._place)

    def _send(self, request: PtpRequest, send: bytes | None, timeout: float) -> None:
        self._connection.write_command(encode(OperationRequest(request, send is not None)), timeout)
        if send is None:
            return
        transaction = request.transaction
        self._connection.write_command(encode(StartData(transaction, len(send))), timeout)
        view = memoryview(send)
        last = max(0, len(send) - 1) // DATA_PIECE * DATA_PIECE
        for at in range(0, last, DATA_PIECE):
            self._connection.write_command(encode_data(transaction, view[at : at + DATA_PIECE], last=False), timeout)
        self._connection.write_command(encode_data(transaction, view[last:], last=True), timeout)

    def _receive(self, reception: Reception, timeout: float) -> Transaction:
        while True:
            match self._connection.next_command(timeout):
                case StartData(transaction, total):
                    reception.start(transaction, total)
                case Data(_, data) | EndData(_, data):
                    reception.take(data)
                case PtpResponse() as response:
                    return reception.end(response)
                case PtpEvent() as event:
                    self._connection.keep_event(event)
                case Ping():
                    self._connection.write_command(encode(Pong()), timeout)
                case Pong():
                    pass
                case other:
                    raise ProtocolError(
                        f"{self.label} sends {type(other).__name__} in the middle of a transaction; reset it"
                    )

    def _call_off(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take, and wait for its end; return whether it came."""
        deadline = self._clock.monotonic() + _CALL_OFF_S
        with contextlib.suppress(LinkError, ProtocolError):
            self._connection.write_event(encode(Cancel(transaction)), _CALL_OFF_S)
            while self._clock.monotonic() < deadline:
                packet = self._connection.next_command(_CALL_OFF_S)
                if isinstance(packet, PtpResponse) and packet.transaction == transaction:
                    return True
        return False
