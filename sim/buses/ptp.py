"""A PTP device on a TCP port, for one initiator at a time (PTP/IP).

The responder is asked by one thread only, that of the command connection: for events after each operation, before the
response goes out, and 20 times a second between operations.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 and 2.3.
"""

from __future__ import annotations

import itertools
import threading

from drivers.links.network import TcpLink, TcpServer
from drivers.ptp.codes import ResponseCode
from drivers.ptp.ip import (
    PORT,
    Cancel,
    Channel,
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
    Ping,
    Pong,
)
from drivers.ptp.protocol import Answer, NoAnswer, PtpRequest, PtpResponse, Responder
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError

GUID = bytes(range(16))  # Identifier of a simulated device
# What a simulated device calls itself unless another is given; ptpy fails on names of more than 19 characters.
NAME = "CroP camera"
DATA_PIECE = 256 * 1024  # Bytes of data in a packet to the initiator; what fits goes out in one EndData

_TICK_S = 0.05  # Between two looks for events while no command comes: soon enough for a host, and hardly any load
# For the first packet, a data phase under way, and a host that reads slowly; long beside a transfer on one machine.
_TIMEOUT_S = 10.0


def serve_ptpip(responder: Responder, port: int = PORT, *, name: str = NAME) -> TcpServer:
    """Put a device on a TCP port; 0 picks a free one.

    Use the result in a ``with`` block; its `address` is host and port, both connections go there.
    """
    return TcpServer(PtpIpService(responder, name).handle, port)


class PtpIpService:
    """Speaks PTP/IP for a responder on connections that it is given."""

    def __init__(self, responder: Responder, name: str) -> None:
        self._responder = responder
        self._name = name
        self._numbers = itertools.count(1)
        self._guard = threading.Lock()
        self._initiator: _Initiator | None = None

    def handle(self, link: TcpLink) -> None:
        """Serve one connection, command or event, until it ends."""
        channel = Channel(link)
        try:
            match channel.next(_TIMEOUT_S):
                case InitCommandRequest():
                    self._serve_commands(channel)
                case InitEventRequest(number):
                    self._serve_events(channel, link, number)
                case _:
                    _send(channel, InitFail(FailReason.UNSPECIFIED))
        except ProtocolError as error:
            raise LinkClosed(f"a stream without packets is of no use: {error}") from error

    def _serve_commands(self, channel: Channel) -> None:
        initiator = _Initiator(next(self._numbers), channel)
        with self._guard:
            free = self._initiator is None
            if free:
                self._initiator = initiator
        if not free:
            _send(channel, InitFail(FailReason.BUSY))
            return
        try:
            _send(channel, InitCommandAck(initiator.number, GUID, self._name))
            while True:
                try:
                    packet = channel.next(_TICK_S)
                except LinkTimeout:
                    self._send_events(initiator)
                    continue
                match packet:
                    case OperationRequest(sends_data, request):
                        self._operate(initiator, request, sends_data)
                    case Ping():
                        _send(channel, Pong())
                    case _:
                        # What is left of a transaction that was called off.
                        pass
        finally:
            initiator.hang_up()
            self._responder.unplugged()
            with self._guard:
                self._initiator = None

    def _serve_events(self, channel: Channel, link: TcpLink, number: int) -> None:
        with self._guard:
            initiator = self._initiator
        if initiator is None or initiator.number != number:
            _send(channel, InitFail(FailReason.REJECTED))
            return
        _send(channel, InitEventAck())
        initiator.join(channel, link)
        while True:
            try:
                packet = channel.next(_TIMEOUT_S)
            except LinkTimeout:
                continue
            match packet:
                case Ping():
                    initiator.send_event(Pong())
                case Cancel(transaction):
                    initiator.cancelled = transaction
                case _:
                    pass

    def _operate(self, initiator: _Initiator, request: PtpRequest, sends_data: bool) -> None:
        initiator.cancelled = None  # what was given up before has ended
        command, data = initiator.command, None
        if sends_data:
            data = _collect(command)
            if data is None:
                self._call_off(command, request)
                return
        if data is None and self._responder.takes_data(request):
            answer = Answer(PtpResponse(ResponseCode.GENERAL_ERROR, request.transaction))
        else:
            try:
                answer = self._responder.answer(request, data)
            except NoAnswer:
                return
        self._send_events(initiator)
        if answer.data is not None:
            for _ in command.send_data(request.transaction, answer.data, DATA_PIECE, _TIMEOUT_S):
                if initiator.gave_up(request.transaction):
                    _send(command, EndData(request.transaction))
                    self._call_off(command, request)
                    return
        _send(command, answer.response)

    def _call_off(self, command: Channel, request: PtpRequest) -> None:
        self._responder.cancelled(request.transaction)
        _send(command, PtpResponse(ResponseCode.TRANSACTION_CANCELLED, request.transaction))

    def _send_events(self, initiator: _Initiator) -> None:
        for event in self._responder.events():
            initiator.send_event(event)


class _Initiator:
    """Who is connected: the number and the two connections that it joins, and the transaction that it gave up last."""

    def __init__(self, number: int, command: Channel) -> None:
        self.number = number
        self.command = command
        self.cancelled: int | None = None
        self._event: Channel | None = None
        self._event_link: TcpLink | None = None
        self._is_over = False
        self._waiting: list[Packet] = []
        self._guard = threading.Lock()

    def gave_up(self, transaction: int) -> bool:
        """Return whether this transaction was given up."""
        return self.cancelled == transaction

    def join(self, event: Channel, link: TcpLink) -> None:
        """Take the second connection, and send on it what came up before."""
        with self._guard:
            self._event, self._event_link = event, link
            if self._is_over:
                link.hang_up()
                return
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
        """End the event connection, which its handler, woken by it, closes; the command connection is its handler's."""
        with self._guard:
            self._is_over = True
            if self._event_link is not None:
                self._event_link.hang_up()


def _send(channel: Channel, packet: Packet) -> None:
    channel.send(packet, _TIMEOUT_S)


def _collect(packets: Channel) -> bytes | None:
    data = bytearray()
    while True:
        match packets.next(_TIMEOUT_S):
            case Data(_, piece):
                data += piece
            case EndData(_, piece):
                return bytes(data + piece)
            case Cancel():
                return None
            case _:
                pass
