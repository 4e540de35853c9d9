"""What a cable is: three verbs and a time limit; and one question at a time over it.

An implementation translates the system's errors into `LinkTimeout` and `LinkClosed` at this border and nowhere else.
What was sent before hanging up can still be read after it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol, Self, TypeVar

from foundation.clock import Clock
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError


class Link(Protocol):
    """One open, ordered, two-way stream of bytes to a device."""

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 … `limit` bytes, waiting at most `timeout` seconds for the first.

        A timeout of 0 asks whether something is there: it brings b"" where nothing is, and is no fault.
        """

    def close(self) -> None:
        """Hang up; a second call does nothing."""


class ClosedAtEnd:
    """What is closed at the end of its `with` block."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release it; a second call does nothing."""
        raise NotImplementedError


class Peer(Protocol):
    """The far side of a connection as a pure machine: bytes in, bytes out."""

    def connect(self) -> bytes:
        """Begin a new connection, forgetting any other, and return what the far side sends first."""

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes from the near side and return the answer so far; may hang up."""

    @property
    def closed(self) -> bool:
        """Whether the far side has hung up."""


class PeerLink:
    """A `Link` whose far side is a `Peer` in the same thread."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        self._incoming = bytearray(peer.connect())
        self._open = True

    def write(self, data: bytes, timeout: float) -> None:
        """Hand `data` to the peer; like a real cable, one that was hung up shows it only to the next reader."""
        if not self._open:
            raise LinkClosed("this end of the simulated cable was closed; open a new connection")
        if not self._peer.closed:
            self._incoming += self._peer.receive(data)

    def read(self, limit: int, timeout: float) -> bytes:
        """Return up to `limit` bytes of what the peer has answered; b"" if there is nothing and `timeout` is 0."""
        if not self._open:
            raise LinkClosed("this end of the simulated cable was closed; open a new connection")
        if not self._incoming:
            if self._peer.closed:
                raise LinkClosed("the simulated device hung up; open a new connection")
            if not timeout:
                return b""
            raise LinkTimeout(f"the simulated device has not answered within {timeout:g} s")
        taken = bytes(self._incoming[:limit])
        del self._incoming[:limit]
        return taken

    def close(self) -> None:
        """Hang up."""
        self._open = False


_log = logging.getLogger(__name__)

POLL_S = 0.1  # How long to look for something that may have come and answers no question

MAX_MESSAGE = 512  # Bytes; no message of any language comes near it

_T = TypeVar("_T")
# Returns the message at the front of the bytes and how many of them it took, or None while it is not whole.
MessageParser = Callable[[bytes], tuple[_T, int] | None]


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

    def ask(self, question: bytes, take: MessageParser[_T], unsolicited: Callable[[_T], bool] | None = None) -> _T:
        """Send `question` and return the first message that `unsolicited` does not claim."""
        return self._again_if_lost(lambda: self._ask_once(question, take, unsolicited))

    def open_with(self, opening: bytes, take: MessageParser[_T], unsolicited: Callable[[_T], bool] | None = None) -> _T:
        """Send `opening` over the connection just opened and return its answer, as `ask`; only for `greet`."""
        return self._ask_once(opening, take, unsolicited)

    def listen(self, take: MessageParser[_T], unsolicited: Callable[[_T], bool] | None = None) -> _T:
        """Return what the other side says first over the connection just opened; only for `greet`."""
        assert self._link is not None
        return self._answer(self._link, take, unsolicited)

    def send(self, command: bytes) -> None:
        """Send `command`, whose answer will take its time and be met by `poll`."""
        self._again_if_lost(lambda: self._send_once(command))

    def poll(self, take: MessageParser[_T], wait: float = POLL_S) -> _T | None:
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

    def _again_if_lost(self, action: Callable[[], _T]) -> _T:
        """Do something over the connection there is, once more over a new one where that turns out to be lost."""
        used = self._link is not None
        try:
            return action()
        except LinkClosed:
            if not used:
                raise
            return action()

    def _ask_once(self, question: bytes, take: MessageParser[_T], unsolicited: Callable[[_T], bool] | None) -> _T:
        link = self._send_once(question)
        try:
            return self._answer(link, take, unsolicited)
        except BaseException:
            self.close()
            raise

    def _answer(self, link: Link, take: MessageParser[_T], unsolicited: Callable[[_T], bool] | None) -> _T:
        while True:
            message = self._next(link, take, self._timeout)
            if unsolicited is None or not unsolicited(message):
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
                came = link.read(MAX_MESSAGE, remaining)
            except LinkTimeout as error:
                raise self._silent(wait) from error
            if not came:
                raise self._silent(wait)
            self._rest += came
            remaining = deadline - self._clock.monotonic()
        message, length = taken
        _log.debug("received %r", self._rest[:length])
        self._rest = self._rest[length:]
        return message

    def _discard(self, link: Link) -> None:
        self._rest = b""
        # Whoever never stops talking is met by the limit of the next message.
        for _ in range(MAX_MESSAGE):
            if not link.read(MAX_MESSAGE, 0.0):
                return

    def _silent(self, wait: float) -> LinkTimeout:
        begun = f" beyond {quoted(self._rest)}" if self._rest else ""
        return LinkTimeout(f"{self._label} has not answered within {wait:g} s{begun}; {self._silent_remedy}")


def quoted(data: bytes) -> str:
    """Return bytes as a message shows them."""
    return repr(data[:40])[1:] + ("…" if len(data) > 40 else "")
