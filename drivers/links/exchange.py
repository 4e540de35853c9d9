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
from foundation.clock import Clock
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError

_log = logging.getLogger(__name__)

GLANCE_S = 0.1
"""How long to look for something that may have come and answers no question."""

MAX_MESSAGE = 512
"""Bytes; no message of any language comes near it."""

_T = TypeVar("_T")
MessageParser = Callable[[bytes], tuple[_T, int] | None]
"""Returns the message at the front of the bytes and how many of them it took, or None while it is not whole."""


class Exchange:
    """Questions and answers over connections that `connect` opens.

    `greet`: says and hears over a new connection what comes before the first question; returns what that question must
    begin with, which is not logged. `silent`, `endless`: what helps where no answer comes, and where one has no end.
    """

    def __init__(
        self,
        connect: Callable[[], Link],
        timeout: float,
        label: str,
        clock: Clock,
        greet: Callable[[Exchange], bytes],
        silent: str,
        endless: str,
    ) -> None:
        self._connect = connect
        self._timeout = timeout
        self._label = label
        self._clock = clock
        self._greet = greet
        self._silent_remedy, self._endless_remedy = silent, endless
        self._proof = b""
        self.questions = 0
        """Asked on the connection there is, since it was greeted."""
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

    def listen(self, take: MessageParser[_T], overheard: Callable[[_T], bool] | None = None) -> _T:
        """Return what the other side says first over the connection just opened; only for `greet`."""
        assert self._link is not None
        return self._answer(self._link, take, overheard)

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

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._link is not None

    def close(self) -> None:
        """Drop the connection, if there is one."""
        link, self._link = self._link, None
        self._rest = b""
        if link is not None:
            link.close()

    def _ask_once(self, question: bytes, take: MessageParser[_T], overheard: Callable[[_T], bool] | None) -> _T:
        link = self._send_once(question)
        try:
            return self._answer(link, take, overheard)
        except BaseException:
            self.close()
            raise

    def _answer(self, link: Link, take: MessageParser[_T], overheard: Callable[[_T], bool] | None) -> _T:
        while True:
            message = self._next(link, take, self._timeout)
            if overheard is None or not overheard(message):
                return message

    def _send_once(self, command: bytes) -> Link:
        try:
            link = self._link
            if link is None:
                link = self._link = self._connect()
                self._proof = self._greet(self)
                self.questions = 0
            self._discard(link)
            proof, self._proof = self._proof, b""
            link.write(proof + command, self._timeout)
            self.questions += 1
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
                raise ProtocolError(f"{self._label} sends without end; {self._endless_remedy}")
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
        return LinkTimeout(f"{self._label} has not answered within {wait:g} s{begun}; {self._silent_remedy}")


def quoted(data: bytes) -> str:
    """Return bytes as a message shows them."""
    return repr(data[:40])[1:] + ("…" if len(data) > 40 else "")
