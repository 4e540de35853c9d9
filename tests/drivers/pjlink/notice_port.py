"""Hears the notices of PJLink projectors, as a control system in the field does."""

from __future__ import annotations

from drivers import pjlink as wire
from drivers.links.link import ClosedAtEnd
from drivers.links.network import ANY_HOST, UdpSocket
from drivers.pjlink import PjLinkReply
from foundation.clock import Clock, SystemClock
from foundation.errors import LinkTimeout


class NoticePort(ClosedAtEnd):
    """Hears the notices of all projectors in whose menus this computer's address was entered; close it."""

    def __init__(self, port: int = wire.PORT, host: str = ANY_HOST, clock: Clock | None = None) -> None:
        self._socket = UdpSocket(port, host)
        self._clock = clock or SystemClock()
        self._waiting: list[tuple[str, PjLinkReply]] = []
        self.address = self._socket.address
        """Host and port at which it listens."""

    def receive(self, timeout: float) -> tuple[str, PjLinkReply]:
        """Return the next notice and the address of the projector that sent it."""
        deadline = self._clock.monotonic() + timeout
        while not self._waiting:
            datagram, (host, _) = self._socket.receive(max(deadline - self._clock.monotonic(), 0.0))
            self._waiting = [(host, reply) for reply in wire.replies_in(datagram) if reply.command != "ACKN"]
            if not self._waiting and self._clock.monotonic() >= deadline:
                raise LinkTimeout(f"among the datagrams that came within {timeout:g} s was no notice of a projector")
        return self._waiting.pop(0)

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._socket.close()
