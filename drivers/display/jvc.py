"""Plain colours from a JVC D-ILA projector's own flat field, over its network port.

The projector makes the colour itself, 0 … 255 a channel, so no desktop, cable or scaler can change it. A command is
``!``, the unit, text and LF; the projector acknowledges with 06, the unit, the text's first two letters and LF: it
confirms commands, not what it shows. It greets with PJ_OK, wants PJREQ within 5 s and answers PJACK. A command that
meets a connection lost meanwhile is sent once more over a new one, and all of the colour after it.

Not confirmed on hardware: that the raster (SSTP02) is the flat field on every model, that its levels (SSFR, SSFG, SSFB)
are encoded as video is and pass the picture mode's gamma, and that they last through a lost connection; photograph a
ramp once, before a session counts on it. Models that ask for a network password (NZ and later) are not served. Killed
without `close`, the projector goes on showing its last colour: it needs no computer for that.

Source: JVC external control specification for D-ILA projectors, the raster and flat level commands and the network
handshake.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from drivers.links.link import Exchange, Link, MessageParser
from drivers.presenter import BLACK, Colour
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import DeviceError, DeviceRefused, ProtocolError

PORT = 20554
"""TCP port of the external control (JVC external control specification)."""
TIMEOUT_S = 5.0
"""As long as the projector itself waits for PJREQ."""
GREETING, REQUEST, ACCEPTED, BUSY, REFUSED = b"PJ_OK", b"PJREQ", b"PJACK", b"PJ_NG", b"PJNAK"
UNIT = b"\x89\x01"
FLAT_FIELD = b"SSTP02"
LEVELS = {"red": b"SSFR", "green": b"SSFG", "blue": b"SSFB"}
_SILENT = "check that it is on, and that its model knows the flat field"
_CHECK_MODEL = "check that it is a JVC D-ILA"

_OPERATION, _ACKNOWLEDGED, _END = b"!", b"\x06", b"\n"


def encode_operation(text: bytes) -> bytes:
    """Return the bytes of a command that sets something."""
    return _OPERATION + UNIT + text + _END


def encode_acknowledgement(text: bytes) -> bytes:
    """Return the bytes that acknowledge a command of this text."""
    return _ACKNOWLEDGED + UNIT + text[:2] + _END


def parse_operation(line: bytes) -> bytes:
    """Return the text of a command, `line` being its bytes up to and with LF."""
    head = _OPERATION + UNIT
    if not (line.startswith(head) and line.endswith(_END)):
        raise ProtocolError(f"{line!r} is no command; expected {head!r}, text and LF")
    return line[len(head) : -1]


def encode_level(channel: str, code: int) -> bytes:
    """Return the text that sets a channel's level: four hexadecimal digits, capitals."""
    return LEVELS[channel] + f"{code:04X}".encode("ascii")


def take_bytes(count: int) -> MessageParser[bytes]:
    """Return what takes `count` bytes off the front of what has come: an answer has no end of its own."""
    return lambda data: None if len(data) < count else (data[:count], count)


class JvcFlatField:
    """A `drivers.presenter.Presenter`; black from the moment it opens."""

    def __init__(
        self,
        connect: Callable[[], Link],
        label: str = "the JVC projector",
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._label = label
        self._exchange = Exchange(connect, TIMEOUT_S, label, clock, self._greet, _SILENT, _CHECK_MODEL)
        self._open = True
        self.show(BLACK)

    def show(self, colour: Colour) -> None:
        """Fill the picture with exactly `colour`; returns when the projector has acknowledged all of it."""
        if not self._open:
            raise DeviceError(f"{self._label} was closed; open the rig again")
        levels = zip(LEVELS, colour, strict=True)
        texts = (FLAT_FIELD, *(encode_level(channel, code) for channel, code in levels))
        while True:
            for text in texts:
                expected = encode_acknowledgement(text)
                answer = self._exchange.ask(encode_operation(text), take_bytes(len(expected)))
                if answer != expected:
                    self._exchange.close()
                    raise self._unexpected(answer, expected)
            # It hangs up on controllers that say nothing for a while; what it was told before is told again.
            if self._exchange.questions >= len(texts):
                return

    def close(self) -> None:
        """Leave the picture black and hang up; a second call does nothing."""
        if not self._open:
            return
        # What cannot be reached cannot be darkened either.
        with contextlib.suppress(DeviceError):
            self.show(BLACK)
        self._open = False
        self._exchange.close()

    def _greet(self, exchange: Exchange) -> bytes:
        self._require(exchange.listen(take_bytes(len(GREETING))), GREETING)
        self._require(exchange.open_with(REQUEST, take_bytes(len(ACCEPTED))), ACCEPTED)
        return b""

    def _require(self, answer: bytes, expected: bytes) -> None:
        if answer == BUSY:
            raise DeviceRefused(f"{self._label} serves another controller; close that one")
        if answer == REFUSED:
            raise DeviceRefused(f"{self._label} wants a network password, which is not supported; switch it off there")
        if answer != expected:
            raise self._unexpected(answer, expected)

    def _unexpected(self, answer: bytes, expected: bytes) -> ProtocolError:
        return ProtocolError(f"{self._label} answers {answer!r} in place of {expected!r}; {_CHECK_MODEL}")
