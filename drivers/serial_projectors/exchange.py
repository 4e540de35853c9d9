"""One question and one answer at a time over a cable that keeps no messages apart.

Rules that hold inside:

- The caller defines what a message is: a `MessageParser` looks at the bytes so far and returns the first whole message
  and its length.
- One connection, opened when first needed. After a fault of cable or protocol it is dropped, so that a late answer
  never meets a later question; what waits unread when a question is asked answers none of ours, and is thrown away.
- A question that meets a connection the other side has dropped meanwhile is asked once more over a new one; every
  command of these drivers may be repeated without harm.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from drivers.links.link import Link
from foundation.clock import Clock, SystemClock
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError

SYSTEM_CLOCK = SystemClock()

_log = logging.getLogger(__name__)

DEFAULT_TIMEOUT_S = 5.0
"""Epson's manual asks for an answer within 3 s, 5 s after a change of source; the others say nothing."""

GLANCE_S = 0.1
"""How long to look for something that may have come and answers no question."""

MAX_MESSAGE = 512
"""Bytes; no message of any language here comes near it."""

_T = TypeVar("_T")
MessageParser = Callable[[bytes], tuple[_T, int] | None]
"""Returns the message at the front of the bytes and how many of them it took, or None while it is not whole."""


class Exchange:
    """Questions and answers over connections that `connect` opens."""

    def __init__(
        self,
        connect: Callable[[], Link],
        timeout: float,
        label: str,
        clock: Clock,
        greet: Callable[[Exchange], None] | None = None,
    ) -> None:
        self._connect = connect
        self._timeout = timeout
        self._label = label
        self._clock = clock
        self._greet = greet
        self._link: Link | None = None
        self._rest = b""

    def ask(self, question: bytes, take: MessageParser[_T], overheard: Callable[[_T], bool] | None = None) -> _T:
        """Send `question` and return the first message that `overheard` does not claim."""
        used = self._link is not None
        try:
            return self._ask_once(question, take, overheard)
        except LinkClosed:
            if not used:
                raise
            return self._ask_once(question, take, overheard)

    def open_with(self, question: bytes, take: MessageParser[_T]) -> _T:
        """Send `question` over the connection just opened and return its answer; only for `greet`."""
        return self._ask_once(question, take, None)

    def send(self, command: bytes) -> None:
        """Send `command`, whose answer will take its time and be met by `glance`."""
        used = self._link is not None
        try:
            self._send_once(command)
        except LinkClosed:
            if not used:
                raise
            self._send_once(command)

    def glance(self, take: MessageParser[_T], wait: float = GLANCE_S) -> _T | None:
        """Return the next message if it comes within `wait` seconds; None without one, or without a connection."""
        if self._link is None:
            return None
        try:
            return self._next(self._link, take, wait)
        except LinkTimeout:
            return None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Drop the connection, if there is one."""
        link, self._link = self._link, None
        self._rest = b""
        if link is not None:
            link.close()

    def _ask_once(self, question: bytes, take: MessageParser[_T], overheard: Callable[[_T], bool] | None) -> _T:
        link = self._send_once(question)
        try:
            while True:
                message = self._next(link, take, self._timeout)
                if overheard is None or not overheard(message):
                    return message
        except BaseException:
            self.close()
            raise

    def _send_once(self, command: bytes) -> Link:
        try:
            link = self._link
            if link is None:
                link = self._link = self._connect()
                if self._greet is not None:
                    self._greet(self)
            self._discard(link)
            link.write(command, self._timeout)
            _log.debug("sent %r", command)
        except BaseException:
            self.close()
            raise
        return link

    def _next(self, link: Link, take: MessageParser[_T], wait: float) -> _T:
        deadline = self._clock.monotonic() + wait
        remaining = wait
        while (taken := take(self._rest)) is None:
            if len(self._rest) > MAX_MESSAGE:
                raise ProtocolError(f"{self._label} sends without end; {CHECK_SPEED}")
            if remaining < 0:
                raise self._silent(wait)
            try:
                self._rest += link.read(MAX_MESSAGE, remaining)
            except LinkTimeout as error:
                raise self._silent(wait) from error
            remaining = deadline - self._clock.monotonic()
        message, length = taken
        _log.debug("received %r", self._rest[:length])
        self._rest = self._rest[length:]
        return message

    def _discard(self, link: Link) -> None:
        self._rest = b""
        # Whoever never stops talking is met by the limit of the next message.
        for _ in range(MAX_MESSAGE):
            try:
                link.read(MAX_MESSAGE, 0.0)
            except LinkTimeout:
                return

    def _silent(self, wait: float) -> LinkTimeout:
        begun = f" beyond {quoted(self._rest)}" if self._rest else ""
        return LinkTimeout(
            f"{self._label} has not answered within {wait:g} s{begun}; check the cable (straight or null-modem, as its "
            f"manual says), the speed, and that it may be controlled in standby"
        )


CHECK_SPEED = "check that speed and parity are those set in the projector's menu, and the language its maker's"
"""The remedy against bytes that make no sense."""


def quoted(data: bytes) -> str:
    """Return bytes as a message shows them."""
    return repr(data[:40])[1:] + ("…" if len(data) > 40 else "")


def text_of(data: bytes) -> str:
    """Return printable ASCII as text."""
    if any(not 0x20 <= byte < 0x7F for byte in data):
        raise ProtocolError(f"the projector sends {quoted(data)}, which is no text; {CHECK_SPEED}")
    return data.decode("ascii")
