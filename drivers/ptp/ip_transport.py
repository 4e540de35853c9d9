"""PTP over a network: transactions on one TCP connection, events on a second one.

Laws that hold inside:

- Whoever waits for the device also answers its pings, at least once a second; nothing here has a thread.
- A transaction that is called off is awaited to its response.
- Events are kept until asked for, the newest `MAX_EVENTS` of them.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 (connections) and 2.3 (packets).
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable

from drivers.links.link import Link
from drivers.links.tcp import TcpLink
from drivers.ptp.messages import Event, Request, Response
from drivers.ptp.ptpip import (
    PORT,
    Cancel,
    Data,
    EndData,
    FailReason,
    InitCommandAck,
    InitCommandRequest,
    InitEventAck,
    InitEventRequest,
    InitFail,
    OperationRequest,
    Packet,
    PacketCutter,
    Ping,
    Pong,
    StartData,
    encode,
    encode_data,
)
from drivers.ptp.reception import Reception, Turns
from drivers.ptp.transport import Transaction
from foundation.clock import Clock
from foundation.errors import DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError

DATA_PIECE = 64 * 1024
"""Bytes of data in a packet to the device; what libgphoto2 sends, and bodies are used to it."""
MAX_EVENTS = 4096
"""Events kept for a caller who never asks for them."""

_READ = 128 * 1024
_PING_EVERY_S = 1.0
_CONNECT_S = 10.0
_EVENT_CHANNEL_S = 2.0
_RETRY_S = 0.1
_CALL_OFF_S = 2.0
_EVENT_READS = 64


class IpTransport:
    """A `drivers.ptp.transport.Transport` over two links.

    Parameters
    ----------
    open_command, open_event
        Open the two connections; called again by `reset`. The second may raise `LinkClosed` for as long as the device
        has not opened its port: it is tried for 2 s.
    guid
        16 bytes by which a camera knows a computer that it was paired with.
    name
        What the camera shows, at most 39 characters.
    clock
        Measures what is waited.
    label
        What messages call the device until it has named itself.

    Raises
    ------
    DeviceRefused
        The device does not want this initiator, or has another one.
    LinkTimeout, LinkClosed
        It cannot be reached.
    ProtocolError
        What answers is no PTP/IP device.
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
        self._hello = encode(InitCommandRequest(guid, name))
        self._clock = clock
        self._place = label
        self._label = label
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._connect()

    @classmethod
    def connect(
        cls, host: str, port: int = PORT, *, event_port: int | None = None, guid: bytes, name: str, clock: Clock
    ) -> IpTransport:
        """Connect to the camera at an address; `event_port` only where it is not the same."""
        second = port if event_port is None else event_port
        return cls(
            lambda: TcpLink.connect(host, port, _CONNECT_S),
            lambda: TcpLink.connect(host, second, _CONNECT_S),
            guid=guid,
            name=name,
            clock=clock,
            label=f"the camera at {host}:{port}",
        )

    @property
    def label(self) -> str:
        """The name that the device gave, and its address."""
        return self._label

    def transact(
        self,
        request: Request,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction; see `drivers.ptp.transport.Transport`."""

        def exchange(reception: Reception) -> Transaction:
            self._send(request, send, timeout)
            return self._receive(reception, timeout)

        return self._turns.take(Reception(request, receive, self._label), exchange, self._call_off)

    def events(self) -> tuple[Event, ...]:
        """Return the events that have come since the last call, and answer pings; never waits.

        Raises
        ------
        LinkClosed
            The device hung up the event connection.
        ProtocolError
            It sends what is no packet there.
        """
        self._attend()
        events = tuple(self._events)
        self._events.clear()
        return events

    def reset(self) -> None:
        """Hang up and connect anew; the session that was open is over.

        Raises
        ------
        DeviceRefused, LinkTimeout, LinkClosed, ProtocolError
            As when connecting first.
        """
        self.close()
        # A device needs a moment to see that the old connection is gone; until then we ourselves keep it busy.
        deadline = self._clock.monotonic() + _EVENT_CHANNEL_S
        while True:
            try:
                self._connect()
            except (DeviceRefused, LinkClosed):
                if self._clock.monotonic() >= deadline:
                    raise
                self._clock.sleep(_RETRY_S)
            else:
                return

    def close(self) -> None:
        """Hang up both connections; a second call does nothing."""
        self._turns.closed = True
        self._event.close()
        self._command.close()

    def _connect(self) -> None:
        self._label = self._place
        self._turns = Turns()
        self._turns.closed = True
        self._events.clear()
        self._packets: deque[Packet] = deque()
        self._cutter = PacketCutter()
        self._command = self._open_command()
        try:
            self._command.write(self._hello, _CONNECT_S)
            acknowledgement = self._greeting(self._command, self._cutter)
            if not isinstance(acknowledgement, InitCommandAck):
                raise self._refusal(acknowledgement)
            self._event_cutter = PacketCutter()
            self._event = self._dial_event()
        except BaseException:
            self._command.close()
            raise
        try:
            self._event.write(encode(InitEventRequest(acknowledgement.connection)), _CONNECT_S)
            answer = self._greeting(self._event, self._event_cutter)
            if not isinstance(answer, InitEventAck):
                raise self._refusal(answer)
        except BaseException:
            self.close()
            raise
        name = acknowledgement.name.strip()
        self._label = f"{name} ({self._place})" if name else self._place
        self._turns.closed = False

    def _dial_event(self) -> Link:
        """Open the second connection; devices refuse it for about 0.1 s after they acknowledged the first."""
        deadline = self._clock.monotonic() + _EVENT_CHANNEL_S
        while True:
            try:
                return self._open_event()
            except LinkClosed:
                if self._clock.monotonic() >= deadline:
                    raise
                self._clock.sleep(_RETRY_S)

    def _greeting(self, link: Link, cutter: PacketCutter) -> Packet:
        """Return the first packet on a new connection; a device sends nothing after it unasked, save events."""
        while True:
            try:
                packets = cutter.feed(link.read(_READ, _CONNECT_S))
            except ProtocolError as error:
                raise ProtocolError(f"what answers in place of {self._place} speaks no PTP/IP: {error}") from error
            if packets:
                self._events.extend(packet for packet in packets[1:] if isinstance(packet, Event))
                return packets[0]

    def _refusal(self, answer: Packet) -> DeviceRefused | ProtocolError:
        if not isinstance(answer, InitFail):
            return ProtocolError(
                f"{self._place} answers a greeting with {type(answer).__name__}; an acknowledgement was expected: "
                f"check that a camera listens at this port"
            )
        match answer.reason:
            case FailReason.REJECTED:
                why = "does not know this computer: pair the two anew in the camera's wireless menu"
            case FailReason.BUSY:
                why = "is in use by another program or computer: disconnect that one, or switch the camera off and on"
            case _:
                why = f"gives reason {answer.reason}: switch it off and on"
        return DeviceRefused(f"{self._place} refuses the connection; it {why}")

    def _send(self, request: Request, send: bytes | None, timeout: float) -> None:
        self._command.write(encode(OperationRequest(request, send is not None)), timeout)
        if send is None:
            return
        transaction = request.transaction
        self._command.write(encode(StartData(transaction, len(send))), timeout)
        view = memoryview(send)
        last = max(0, len(send) - 1) // DATA_PIECE * DATA_PIECE
        for at in range(0, last, DATA_PIECE):
            self._command.write(encode_data(transaction, view[at : at + DATA_PIECE], last=False), timeout)
        self._command.write(encode_data(transaction, view[last:], last=True), timeout)

    def _receive(self, reception: Reception, timeout: float) -> Transaction:
        while True:
            match self._next(timeout):
                case StartData(transaction, total):
                    reception.start(transaction, total)
                case Data(_, data) | EndData(_, data):
                    reception.take(data)
                case Response() as response:
                    return reception.end(response)
                case Event() as event:
                    self._events.append(event)
                case Ping():
                    self._command.write(encode(Pong()), timeout)
                case Pong():
                    pass
                case other:
                    raise ProtocolError(
                        f"{self._label} sends {type(other).__name__} in the middle of a transaction; reset it"
                    )

    def _next(self, timeout: float) -> Packet:
        """Return the next packet on the command connection, waiting `timeout` seconds for each of its bytes."""
        left = timeout
        while not self._packets:
            wait = min(left, _PING_EVERY_S)
            try:
                piece = self._command.read(_READ, wait)
            except LinkTimeout:
                left -= wait
                if left <= 0:
                    raise
                self._attend()
                continue
            left = timeout
            self._packets.extend(self._cutter.feed(piece))
        return self._packets.popleft()

    def _attend(self) -> None:
        """Take what the event connection holds, and answer pings."""
        # A device that never stops talking must not keep us here.
        for _ in range(_EVENT_READS):
            try:
                piece = self._event.read(_READ, 0.0)
            except LinkTimeout:
                return
            for packet in self._event_cutter.feed(piece):
                match packet:
                    case Event():
                        self._events.append(packet)
                    case Ping():
                        self._event.write(encode(Pong()), _PING_EVERY_S)
                    case _:
                        pass

    def _call_off(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take, and wait for its end; return whether it came."""
        deadline = self._clock.monotonic() + _CALL_OFF_S
        with contextlib.suppress(LinkError, ProtocolError):
            self._event.write(encode(Cancel(transaction)), _CALL_OFF_S)
            while self._clock.monotonic() < deadline:
                packet = self._next(_CALL_OFF_S)
                if isinstance(packet, Response) and packet.transaction == transaction:
                    return True
        return False
