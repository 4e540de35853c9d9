"""PTP/IP server on a TCP port: the camera end of the connection (CIPA DC-005-2005, PTP-IP, clauses 2.2 and 2.3).

The server accepts one initiator (host) at a time, with a command connection and an event connection. The thread of the
command connection calls the responder (camera). It asks the camera for events before each response, and 20 times per
second between operations.
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

GUID = bytes(range(16))  # Identifier of a simulated device.
NAME = "CroP camera"  # Default name of a simulated device; ptpy fails on names of more than 19 characters.
DATA_PIECE = 256 * 1024  # Bytes of data per packet to the initiator; smaller data are sent in one EndData.

_EVENT_INTERVAL_S = 0.05  # Interval between two requests for events, s.

# Time limit for one packet, s. Transfers on one machine are much faster.
_TIMEOUT_S = 10.0


def serve_ptpip(responder: Responder, port: int = PORT, *, name: str = NAME) -> TcpServer:
    """Serve a device on a TCP port (0: a free port); use the returned server in a ``with`` block."""
    return TcpServer(PtpIpService(responder, name).handle, port)


class PtpIpService:
    """PTP/IP protocol of a responder, on any number of connections."""

    def __init__(self, responder: Responder, name: str) -> None:
        self._responder = responder
        self._name = name
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._initiator: _Initiator | None = None

    def handle(self, link: TcpLink) -> None:
        """Serve one command or event connection until it ends."""
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
            raise LinkClosed(f"the bytes are not PTP/IP packets: {error}; open a new connection") from error

    def _serve_commands(self, channel: Channel) -> None:
        initiator = _Initiator(next(self._numbers), channel)
        with self._lock:
            is_free = self._initiator is None
            if is_free:
                self._initiator = initiator
        if not is_free:
            _send(channel, InitFail(FailReason.BUSY))
            return
        try:
            _send(channel, InitCommandAck(initiator.number, GUID, self._name))
            while True:
                try:
                    packet = channel.next(_EVENT_INTERVAL_S)
                except LinkTimeout:
                    self._send_events(initiator)
                    continue
                match packet:
                    case OperationRequest(sends_data, request):
                        self._operate(initiator, request, sends_data)
                    case Ping():
                        _send(channel, Pong())
                    case _:
                        # Late packets of a cancelled transaction are ignored.
                        pass
        finally:
            initiator.hang_up()
            self._responder.unplugged()
            with self._lock:
                self._initiator = None

    def _serve_events(self, channel: Channel, link: TcpLink, number: int) -> None:
        with self._lock:
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
        initiator.cancelled = None  # A transaction that was cancelled earlier has ended
        command, data = initiator.command, None
        if sends_data:
            data = _collect(command)
            if data is None:
                self._cancel(command, request)
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
                if initiator.is_cancelled(request.transaction):
                    _send(command, EndData(request.transaction))
                    self._cancel(command, request)
                    return
        _send(command, answer.response)

    def _cancel(self, command: Channel, request: PtpRequest) -> None:
        self._responder.cancelled(request.transaction)
        _send(command, PtpResponse(ResponseCode.TRANSACTION_CANCELLED, request.transaction))

    def _send_events(self, initiator: _Initiator) -> None:
        for event in self._responder.events():
            initiator.send_event(event)


class _Initiator:
    """A connected initiator: its number, its two connections, and the transaction that it cancelled last."""

    def __init__(self, number: int, command: Channel) -> None:
        self.number = number
        self.command = command
        self.cancelled: int | None = None
        self._event: Channel | None = None
        self._event_link: TcpLink | None = None
        self._is_over = False
        self._pending: list[Packet] = []
        self._lock = threading.Lock()

    def is_cancelled(self, transaction: int) -> bool:
        """Return whether a transaction was cancelled."""
        return self.cancelled == transaction

    def join(self, event: Channel, link: TcpLink) -> None:
        """Set the event connection, and send the pending events."""
        with self._lock:
            self._event, self._event_link = event, link
            if self._is_over:
                link.hang_up()
                return
            for packet in self._pending:
                _send(event, packet)
            self._pending.clear()

    def send_event(self, packet: Packet) -> None:
        """Send a packet on the event connection, as soon as it exists."""
        with self._lock:
            if self._event is None:
                self._pending.append(packet)
            else:
                _send(self._event, packet)

    def hang_up(self) -> None:
        """End the event connection; the thread that serves it then closes it."""
        with self._lock:
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
