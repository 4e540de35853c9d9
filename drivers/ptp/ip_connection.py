"""The two TCP connections of PTP/IP, from the greetings on: packets, events and pings, but no transactions.

Rules that hold inside:

- Whoever waits for the device also answers its pings, at least once a second; nothing here has a thread.
- Events are kept until asked for, the newest `MAX_EVENTS` of them.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 (connections) and 2.3 (packets).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from drivers.links.link import Link
from drivers.ptp.messages import PtpEvent
from drivers.ptp.ptpip import (
    FailReason,
    InitCommandAck,
    InitCommandRequest,
    InitEventAck,
    InitEventRequest,
    InitFail,
    Packet,
    PacketCutter,
    Ping,
    Pong,
    encode,
)
from foundation.clock import Clock
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout, ProtocolError

MAX_EVENTS: Final = 4096
"""Events kept for a caller who never asks for them."""

CONNECT_S: Final = 10.0
"""Wait for each connection and each greeting: a camera wakes its network up in a few seconds."""

EVENT_CHANNEL_S: Final = 2.0
"""How long the second connection is tried: devices refuse it for about 0.1 s after they acknowledged the first."""

RETRY_S: Final = 0.1
"""Pause between two such tries."""

_READ: Final = 128 * 1024
"""Bytes asked of a link at once: two pieces of data as bodies send them."""

_PING_EVERY_S: Final = 1.0
"""Longest wait on the command connection without a look at the event connection."""

_EVENT_READS: Final = 64
"""Reads of the event connection at one look: a device that never stops talking must not keep us there."""


class IpConnection:
    """Both connections to one device, which has accepted this initiator.

    `name`: what the device calls itself; may be empty.
    """

    def __init__(
        self,
        command: tuple[Link, PacketCutter],
        event: tuple[Link, PacketCutter],
        name: str,
        events: Iterable[PtpEvent],
    ) -> None:
        self._command, self._command_cutter = command
        self._event, self._event_cutter = event
        self.name = name
        self._packets: deque[Packet] = deque()
        self._events = deque(events, maxlen=MAX_EVENTS)

    def write_command(self, data: bytes, timeout: float) -> None:
        """Send bytes on the command connection."""
        self._command.write(data, timeout)

    def write_event(self, data: bytes, timeout: float) -> None:
        """Send bytes on the event connection."""
        self._event.write(data, timeout)

    def next_command(self, timeout: float) -> Packet:
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
                self.attend()
                continue
            left = timeout
            self._packets.extend(self._command_cutter.feed(piece))
        return self._packets.popleft()

    def attend(self) -> None:
        """Take what the event connection holds, and answer pings; never waits."""
        for _ in range(_EVENT_READS):
            try:
                piece = self._event.read(_READ, 0.0)
            except LinkTimeout:
                return
            for packet in self._event_cutter.feed(piece):
                match packet:
                    case PtpEvent():
                        self._events.append(packet)
                    case Ping():
                        self._event.write(encode(Pong()), _PING_EVERY_S)
                    case _:
                        pass

    def keep_event(self, event: PtpEvent) -> None:
        """Keep an event that came on the command connection."""
        self._events.append(event)

    def take_events(self) -> tuple[PtpEvent, ...]:
        """Return the events kept since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events

    def close(self) -> None:
        """Hang up both connections; a second call does nothing."""
        self._event.close()
        self._command.close()


def greet(
    open_command: Callable[[], Link],
    open_event: Callable[[], Link],
    initiator: InitCommandRequest,
    clock: Clock,
    place: str,
) -> IpConnection:
    """Open both connections and introduce the initiator on them (clause 2.2).

    `open_command`, `open_event`: open the two connections; the second is tried for `EVENT_CHANNEL_S`.
    """
    hello = encode(initiator)
    command, cutter = open_command(), PacketCutter()
    try:
        command.write(hello, CONNECT_S)
        acknowledgement, events = _greeting(command, cutter, place)
        if not isinstance(acknowledgement, InitCommandAck):
            raise _refusal(acknowledgement, place)
        event, event_cutter = _dial(open_event, clock), PacketCutter()
    except BaseException:
        command.close()
        raise
    try:
        event.write(encode(InitEventRequest(acknowledgement.connection)), CONNECT_S)
        answer, more = _greeting(event, event_cutter, place)
        if not isinstance(answer, InitEventAck):
            raise _refusal(answer, place)
    except BaseException:
        event.close()
        command.close()
        raise
    return IpConnection((command, cutter), (event, event_cutter), acknowledgement.name.strip(), [*events, *more])


def _dial(open_event: Callable[[], Link], clock: Clock) -> Link:
    """Open the second connection."""
    deadline = clock.monotonic() + EVENT_CHANNEL_S
    while True:
        try:
            return open_event()
        except LinkClosed:
            if clock.monotonic() >= deadline:
                raise
            clock.sleep(RETRY_S)


def _greeting(link: Link, cutter: PacketCutter, place: str) -> tuple[Packet, list[PtpEvent]]:
    """Return the first packet on a new connection, and the events behind it; nothing else comes unasked."""
    while True:
        try:
            packets = cutter.feed(link.read(_READ, CONNECT_S))
        except ProtocolError as error:
            raise ProtocolError(f"what answers in place of {place} speaks no PTP/IP: {error}") from error
        if packets:
            return packets[0], [packet for packet in packets[1:] if isinstance(packet, PtpEvent)]


def _refusal(answer: Packet, place: str) -> DeviceRefused | ProtocolError:
    if not isinstance(answer, InitFail):
        return ProtocolError(
            f"{place} answers a greeting with {type(answer).__name__}; an acknowledgement was expected: "
            f"check that a camera listens at this port"
        )
    match answer.reason:
        case FailReason.REJECTED:
            why = "does not know this computer: pair the two anew in the camera's wireless menu"
        case FailReason.BUSY:
            why = "is in use by another program or computer: disconnect that one, or switch the camera off and on"
        case _:
            why = f"gives reason {answer.reason}: switch it off and on"
    return DeviceRefused(f"{place} refuses the connection; it {why}")
