"""A PTP device without a USB cable: in memory, without a thread or a wait, or on a TCP port for any initiator (PTP/IP).

Rules of the network's device:

- One initiator at a time, known by the number that joins its two connections; a second one hears that the device is
  busy.
- The responder is asked by one thread only, that of the command connection. It is asked for events after each
  operation, before the response goes out, and 20 times a second between operations.
- A data phase to the initiator is announced even if it is empty, for initiators wait for it.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 and 2.3.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator

from drivers.links.link import Link, Pipe, PipeStalled
from drivers.links.network import LOOPBACK, TcpServer
from drivers.ptp.codes import ResponseCode
from drivers.ptp.ip import (
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
from drivers.ptp.session import PtpRequest, PtpResponse
from drivers.ptp.usb import UsbTransport
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError
from sim.buses.responder import Answer, NoAnswer, Responder
from sim.buses.usb import (
    BULK_IN,
    BULK_OUT,
    INTERRUPT_IN,
    INTERRUPT_PACKET,
    PACKET,
    Overflowed,
    PtpUsbDevice,
    Setup,
    Stalled,
)
from sim.clock import SimulatedClock

_ADDRESSES = {Pipe.BULK_OUT: BULK_OUT, Pipe.BULK_IN: BULK_IN, Pipe.INTERRUPT_IN: INTERRUPT_IN}


class MemoryPipes:
    """The `drivers.links.link.UsbPipes` of a device in the same thread; what it has not sent yet, it will not send."""

    def __init__(self, device: PtpUsbDevice) -> None:
        self._device = device
        self._there = True

    @property
    def label(self) -> str:
        """The device's name."""
        return f"the simulated {self._device.identity.name}"

    @property
    def packet_size(self) -> int:
        """Bytes of a full packet on the bulk pipes."""
        return PACKET

    @property
    def polling_s(self) -> float:
        """No time at all."""
        return 0.0

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Hand `data` to the device."""
        self._check()
        try:
            self._device.bulk_out(data)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return what one transfer brings."""
        self._check()
        try:
            return self._said(self._device.bulk_in(limit), timeout)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error
        except Overflowed as error:
            raise ProtocolError(f"{self.label} sends more than the {limit} bytes asked for") from error

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe."""
        self._check()
        try:
            return self._said(self._device.interrupt_in(INTERRUPT_PACKET), timeout)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a request of the interface's class."""
        self._check()
        try:
            self._device.control(Setup(0x21, request, 0, 0, len(data)), data)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the answer to a request of the interface's class."""
        self._check()
        try:
            return self._device.control(Setup(0xA1, request, 0, 0, limit))
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def clear_halt(self, pipe: Pipe) -> None:
        """Let a stalled pipe transfer again."""
        self._check()
        self._device.control(Setup(0x02, 1, 0, _ADDRESSES[pipe], 0))

    def reset_port(self) -> None:
        """Have the device forget everything."""
        self._check()
        self._device.unplugged()

    def close(self) -> None:
        """Let go of the device."""
        self._there = False

    def pull(self) -> None:
        """Pull the cable: the device is gone for good."""
        if self._there:
            self._there = False
            self._device.unplugged()

    def _check(self) -> None:
        if not self._there:
            raise LinkClosed(f"{self.label} was unplugged; open it again")

    def _said(self, data: bytes | None, timeout: float) -> bytes:
        if data is None:
            raise LinkTimeout(f"{self.label} sent nothing for {timeout:g} s")
        return data


class MemoryTransport(UsbTransport):
    """A `drivers.ptp.session.Transport` straight to a responder."""

    def __init__(self, responder: Responder) -> None:
        self._memory = MemoryPipes(PtpUsbDevice(responder))
        super().__init__(self._memory, SimulatedClock())

    def pull(self) -> None:
        """Pull the cable."""
        self._memory.pull()


GUID = bytes(range(16))
"""Identifier of a simulated device unless another is given."""
NAME = "CroP camera"
"""What a simulated device calls itself unless another is given; ptpy fails on names of more than 19 characters."""
DATA_PIECE = 256 * 1024
"""Bytes of data in a packet to the initiator; what fits goes out in one EndData."""

_READ = 256 * 1024
"""Bytes read at once; as large as a piece of data, which makes few calls of a long transfer."""
_TICK_S = 0.05
"""Between two looks for events while no command comes: soon enough for a host, and hardly any load."""
_PATIENCE_S = 10.0
"""For the first packet, a data phase under way, and a host that reads slowly; long beside a transfer on one machine."""


def serve_ptpip(
    responder: Responder,
    port: int = PORT,
    *,
    name: str = NAME,
    guid: bytes = GUID,
    host: str = LOOPBACK,
) -> TcpServer:
    """Put a device on a TCP port; 0 picks a free one.

    Use the result in a ``with`` block; its `address` is host and port, both connections go there.
    """
    return TcpServer(PtpIpService(responder, name, guid).handle, port, host)


class PtpIpService:
    """Speaks PTP/IP for a responder on connections that it is given."""

    def __init__(self, responder: Responder, name: str = NAME, guid: bytes = GUID) -> None:
        self._responder = responder
        self._name = name
        self._guid = guid
        self._numbers = itertools.count(1)
        self._guard = threading.Lock()
        self._initiator: _Initiator | None = None

    def handle(self, link: Link) -> None:
        """Serve one connection, command or event, until it ends."""
        try:
            self._serve(link, _Incoming(link))
        except ProtocolError as error:
            raise LinkClosed(f"a stream without packets is of no use: {error}") from error

    def _serve(self, link: Link, packets: _Incoming) -> None:
        match packets.next(_PATIENCE_S):
            case InitCommandRequest():
                self._serve_commands(link, packets)
            case InitEventRequest(number):
                self._serve_events(link, packets, number)
            case _:
                _send(link, InitFail(FailReason.UNSPECIFIED))

    def _serve_commands(self, link: Link, packets: _Incoming) -> None:
        initiator = _Initiator(next(self._numbers), link)
        with self._guard:
            free = self._initiator is None
            if free:
                self._initiator = initiator
        if not free:
            _send(link, InitFail(FailReason.BUSY))
            return
        try:
            _send(link, InitCommandAck(initiator.number, self._guid, self._name))
            while True:
                try:
                    packet = packets.next(_TICK_S)
                except LinkTimeout:
                    self._tell_events(initiator)
                    continue
                match packet:
                    case OperationRequest(request, sends_data):
                        self._operate(initiator, packets, request, sends_data)
                    case Ping():
                        _send(link, Pong())
                    case _:
                        # What is left of a transaction that was called off.
                        pass
        finally:
            initiator.hang_up()
            self._responder.unplugged()
            with self._guard:
                self._initiator = None

    def _serve_events(self, link: Link, packets: _Incoming, number: int) -> None:
        with self._guard:
            initiator = self._initiator
        if initiator is None or initiator.number != number:
            _send(link, InitFail(FailReason.REJECTED))
            return
        _send(link, InitEventAck())
        initiator.join(link)
        while True:
            try:
                packet = packets.next(_PATIENCE_S)
            except LinkTimeout:
                continue
            match packet:
                case Ping():
                    initiator.send_event(Pong())
                case Cancel(transaction):
                    initiator.cancel(transaction)
                case _:
                    pass

    def _operate(self, initiator: _Initiator, packets: _Incoming, request: PtpRequest, sends_data: bool) -> None:
        initiator.forget_cancellation()
        data: bytes | None = None
        if sends_data:
            data = _collect(packets)
            if data is None:
                self._responder.cancelled(request.transaction)
                response = PtpResponse(ResponseCode.TRANSACTION_CANCELLED, request.transaction)
                _send(initiator.command, response)
                return
        if data is None and self._responder.takes_data(request):
            answer = Answer(PtpResponse(ResponseCode.GENERAL_ERROR, request.transaction))
        else:
            try:
                answer = self._responder.answer(request, data)
            except NoAnswer:
                return
        self._tell_events(initiator)
        if answer.data is not None:
            for packet in _data_packets(request.transaction, answer.data):
                if initiator.gave_up(request.transaction):
                    _send(initiator.command, EndData(request.transaction))
                    self._responder.cancelled(request.transaction)
                    response = PtpResponse(ResponseCode.TRANSACTION_CANCELLED, request.transaction)
                    _send(initiator.command, response)
                    return
                initiator.command.write(packet, _PATIENCE_S)
        _send(initiator.command, answer.response)

    def _tell_events(self, initiator: _Initiator) -> None:
        for event in self._responder.events():
            initiator.send_event(event)


class _Initiator:
    """Who is connected: the number and the two connections that it joins."""

    def __init__(self, number: int, command: Link) -> None:
        self.number = number
        self.command = command
        self._cancelled: int | None = None
        self._event: Link | None = None
        self._waiting: list[Packet] = []
        self._guard = threading.Lock()

    def cancel(self, transaction: int) -> None:
        """Note that the initiator gave up a transaction; the thread that serves it will see."""
        self._cancelled = transaction

    def gave_up(self, transaction: int) -> bool:
        """Return whether this transaction was given up."""
        return self._cancelled == transaction

    def forget_cancellation(self) -> None:
        """Begin a transaction; what was given up before has ended."""
        self._cancelled = None

    def join(self, event: Link) -> None:
        """Take the second connection, and send on it what came up before."""
        with self._guard:
            self._event = event
            for packet in self._waiting:
                _send(event, packet)
            self._waiting.clear()

    def send_event(self, packet: Packet) -> None:
        """Send on the event connection, once there is one."""
        with self._guard:
            if self._event is None:
                self._waiting.append(packet)
            else:
                _send(self._event, packet)

    def hang_up(self) -> None:
        """Close the event connection; the command connection is its handler's."""
        with self._guard:
            if self._event is not None:
                self._event.close()


class _Incoming:
    """The packets on a connection, one after the other."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._cutter = PacketCutter()
        self._packets: list[Packet] = []

    def next(self, timeout: float) -> Packet:
        while not self._packets:
            self._packets = self._cutter.feed(self._link.read(_READ, timeout))
        return self._packets.pop(0)


def _send(link: Link, packet: Packet) -> None:
    link.write(encode(packet), _PATIENCE_S)


def _collect(packets: _Incoming) -> bytes | None:
    """Return the initiator's data phase, None if it is called off."""
    data = bytearray()
    while True:
        match packets.next(_PATIENCE_S):
            case Data(_, piece):
                data += piece
            case EndData(_, piece):
                return bytes(data + piece)
            case Cancel():
                return None
            case _:
                pass


def _data_packets(transaction: int, data: bytes) -> Iterator[bytes]:
    yield encode(StartData(transaction, len(data)))
    view = memoryview(data)
    last = max(0, len(data) - 1) // DATA_PIECE * DATA_PIECE
    for at in range(0, last, DATA_PIECE):
        yield encode_data(transaction, view[at : at + DATA_PIECE], last=False)
    yield encode_data(transaction, view[last:], last=True)
