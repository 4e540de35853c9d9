"""The simulated JVC projector's network port: bytes in, bytes out, and a flat field on the simulated screen.

It knows the raster and the three levels; anything else gets no answer, as from the real one. Until the flat field is
chosen its video input is seen, which is white.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.display import jvc
from drivers.presenter import WHITE, Colour
from foundation.errors import ProtocolError
from sim.projectors.projector import Screen

_CHANNELS = {text: channel for channel, text in jvc.LEVELS.items()}


@dataclass
class _Connection:
    """One connection: the bytes of an incomplete command, whether it was let in, whether it is over."""

    received: bytes = b""
    admitted: bool = False
    closed: bool = False


class JvcPeer:
    """The far side of the network port; keeps the contract of `drivers.links.link.Peer`."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen
        self._levels = dict.fromkeys(jvc.LEVELS, 255)
        self._flat = False
        self._connection = _Connection()
        self._show()

    def connect(self) -> bytes:
        """Begin a new connection and return the greeting; the picture stays."""
        self._connection = _Connection()
        return jvc.GREETING

    @property
    def closed(self) -> bool:
        """Whether it has hung up: on whoever does not ask to be let in."""
        return self._connection.closed

    def hang_up(self) -> None:
        """Close the connection, as the projector does with one that is idle."""
        self._connection.closed = True

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to the commands that they complete."""
        connection = self._connection
        connection.received += data
        answer = b""
        if not connection.admitted:
            if len(connection.received) < len(jvc.REQUEST):
                return b""
            if not connection.received.startswith(jvc.REQUEST):
                connection.closed = True
                return jvc.REFUSED
            connection.received = connection.received[len(jvc.REQUEST) :]
            connection.admitted = True
            answer = jvc.ACCEPTED
        while b"\n" in connection.received:
            line, _, connection.received = connection.received.partition(b"\n")
            answer += self._obey(line + b"\n")
        return answer

    def _obey(self, line: bytes) -> bytes:
        try:
            text = jvc.parse_operation(line)
            if text == jvc.FLAT_FIELD:
                self._flat = True
            else:
                level = int(text[4:], 16)
                if len(text) != 8 or level > 255:
                    return b""
                self._levels[_CHANNELS[text[:4]]] = level
        except (ProtocolError, KeyError, ValueError):
            return b""
        self._show()
        return jvc.encode_acknowledgement(text)

    def _show(self) -> None:
        self._screen.colour = Colour(**self._levels) if self._flat else WHITE
