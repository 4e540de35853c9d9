"""Cables to a peer that speaks when it has something to say: in the same thread, and over TCP.

`sim.buses.pty` has the serial port of the system.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from drivers.links.link import Peer, PeerLink
from drivers.links.network import TcpLink, TcpServer
from foundation.errors import LinkTimeout

POLLING_S: Final = 0.02
"""How often a peer on a real cable is asked what it has to say by now: drivers wait seconds for an answer."""

_PATIENCE_S: Final = 5.0
"""Longest wait for a client to take an answer."""


class SerialPeerLink(PeerLink):
    """A cable to a peer in the same thread, which hears before each read what the peer has to say by now."""

    def read(self, limit: int, timeout: float) -> bytes:
        """Return up to `limit` bytes of what the peer has said."""
        if self._open:
            self._incoming += self._peer.receive(b"")
        return super().read(limit, timeout)


def serve_network(peer: Callable[[], Peer], port: int = 0) -> TcpServer:
    """Return a running server that gives each connection a peer of its own; close it, or use it in a `with` block."""

    def handle(link: TcpLink) -> None:
        there = peer()
        said = there.connect()
        while True:
            if said:
                link.write(said, _PATIENCE_S)
            try:
                said = there.receive(link.read(4096, POLLING_S))
            except LinkTimeout:
                said = there.receive(b"")

    return TcpServer(handle, port)
