"""Finds PJLink projectors on the network (class 2 only).

Rules that hold inside:

- A search opens no control connection: many projectors serve one controller only, who would be disturbed.
- Answers come to one's own port 4352; only one program of a computer can hear them at a time.
- Who answers proves nothing: a search is a convenience, the address in the lab's settings is what counts.

Source: JBMIA, PJLink Specifications 2.00 and 2.10, 3.2 (search).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.links.network import BROADCAST, Address, UdpSocket
from drivers.pjlink import wire
from drivers.pjlink.wire import COLLECT_S, Found
from foundation.clock import Clock, SystemClock
from foundation.errors import LinkTimeout

ASKED = 3
"""A datagram may be lost, so the search is sent so often, a second apart; a projector may answer each."""
ASK_EVERY_S = 1.0
"""Far enough apart that one disturbance of the network does not swallow two."""

_SYSTEM_CLOCK = SystemClock()


class Datagrams(Protocol):
    """The part of `drivers.links.network.UdpSocket` that is used here."""

    def send(self, data: bytes, address: Address) -> None:
        """Send one datagram to host and port."""
        ...

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        """Return the next datagram and who sent it; `LinkTimeout` when none comes in time."""
        ...

    def close(self) -> None:
        """Stop listening."""
        ...


@dataclass(frozen=True)
class FoundProjector:
    """A projector that answered: where its control port is reached, and its MAC address."""

    host: str
    mac: str


def search(
    seconds: float = COLLECT_S,
    enough: int | None = None,
    address: str = BROADCAST,
    port: int = wire.PORT,
    listen_port: int = wire.PORT,
    open_socket: Callable[[int], Datagrams] = UdpSocket,
    clock: Clock = _SYSTEM_CLOCK,
) -> tuple[FoundProjector, ...]:
    """Ask all projectors of the network to answer, and return those that do, in the order of their answers.

    `enough`: return as soon as so many have answered; None waits the whole time. `clock`: measures `seconds`.
    """
    found: dict[FoundProjector, None] = {}
    datagrams = open_socket(listen_port)
    try:
        start = clock.monotonic()
        asked = 0
        while enough is None or len(found) < enough:
            passed = clock.monotonic() - start
            if passed >= seconds:
                break
            if asked < ASKED and passed >= asked * ASK_EVERY_S:
                datagrams.send(wire.SEARCH, (address, port))
                asked += 1
            ends = min(seconds, asked * ASK_EVERY_S) if asked < ASKED else seconds
            try:
                datagram, (host, _) = datagrams.receive(max(ends - passed, 0.0))
            except LinkTimeout:
                continue
            for message in wire.decode_datagram(datagram):
                if isinstance(message, Found):
                    found[FoundProjector(host, message.mac)] = None
    finally:
        datagrams.close()
    return tuple(found)
