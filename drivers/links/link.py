"""Connection to a device (`Link`) that can write, read and close, and exchange of requests and replies (`Exchange`).

Every implementation of `Link` raises `LinkTimeout` or `LinkClosed` instead of errors of the operating system. Bytes
that the device sent before it disconnected can still be read.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol, Self, TypeVar

from foundation.clock import Clock
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError


class Link(Protocol):
    """An open, ordered, two-way stream of bytes to a device."""

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 to `limit` bytes; wait at most `timeout` seconds for the first byte.

        With a timeout of 0 it returns b"" if no byte is waiting, and does not raise `LinkTimeout`.
        """

    def close(self) -> None:
        """Disconnect; a second call does nothing."""


class ClosedAtEnd:
    """Base class of objects that are closed at the end of their `with` block."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the resource; a second call does nothing."""
        raise NotImplementedError


class Peer(Protocol):
    """A simulated device at the other end of a connection; it takes bytes and returns bytes."""

    def connect(self) -> bytes:
        """Start a new connection, end any earlier one, and return the first bytes that the device sends."""

    def receive(self, data: bytes) -> bytes:
        """Process the next bytes from the driver and return the bytes of the reply; may disconnect."""

    @property
    def closed(self) -> bool:
        """True if the device has disconnected."""


class PeerLink:
    """A `Link` to a `Peer` in the same thread."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        self._incoming = bytearray(peer.connect())
        self._open = True

    def write(self, data: bytes, timeout: float) -> None:
        """Pass `data` to the peer."""
        if not self._open:
            raise LinkClosed("this end of the simulated cable was closed; open a new connection")
        # As on a real cable, only the next read reports a disconnection.
        if not self._peer.closed:
            self._incoming += self._peer.receive(data)

    def read(self, limit: int, timeout: float) -> bytes:
        """Return up to `limit` bytes of the reply; see `Link.read`."""
        if not self._open:
            raise LinkClosed("this end of the simulated cable was closed; open a new connection")
        if not self._incoming:
            if self._peer.closed:
                raise LinkClosed("the simulated device closed the connection; open a new one")
            if not timeout:
                return b""
            raise LinkTimeout(f"the simulated device has not answered within {timeout:g} s; repeat the request")
        data = bytes(self._incoming[:limit])
        del self._incoming[:limit]
        return data

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        self._open = False


_log = logging.getLogger(__name__)

# Time to wait for a message that the device may send without a request, seconds.
POLL_S = 0.1

# Longest accepted message, bytes. Messages of all supported protocols are much shorter.
MAX_MESSAGE = 512

_T = TypeVar("_T")
# Takes received bytes, and returns the first message and its length in bytes, or None if the message is incomplete.
MessageParser = Callable[[bytes], tuple[_T, int] | None]


class Exchange:
    """Requests and replies over a connection that `connect` opens when it is needed.

    - `greet` exchanges the first messages of a new connection. It returns bytes to send before the first request, which
      are not logged.
    - `silence_remedy`, `endless_remedy`: remedies in the messages for a missing reply and for a reply without an end.
    """

    def __init__(
        self,
        connect: Callable[[], Link],
        timeout: float,
        label: str,
        clock: Clock,
        greet: Callable[[Exchange], bytes],
        silence_remedy: str,
        endless_remedy: str,
    ) -> None:
        self._connect = connect
        self._timeout = timeout
        self._label = label
        self._clock = clock
        self._greet = greet
        self._silence_remedy, self._endless_remedy = silence_remedy, endless_remedy
        self._prefix = b""
        # Number of requests on the present connection, without its greeting.
        self.request_count = 0
        self._link: Link | None = None
        self._received = b""

    def query(self, request: bytes, parse: MessageParser[_T], skip: Callable[[_T], bool] | None = None) -> _T:
        """Send `request` and return the first message after it for which `skip` is false."""
        return self._repeat_if_lost(lambda: self._request_once(request, parse, skip))

    def open_with(self, opening: bytes, parse: MessageParser[_T], skip: Callable[[_T], bool] | None = None) -> _T:
        """Send `opening` over the new connection and return its reply; used only by `greet`."""
        return self._request_once(opening, parse, skip)

    def listen(self, parse: MessageParser[_T], skip: Callable[[_T], bool] | None = None) -> _T:
        """Return the first message of the device on the new connection; used only by `greet`."""
        assert self._link is not None
        return self._answer(self._link, parse, skip)

    def send(self, command: bytes) -> None:
        """Send a command without waiting for its reply, which `poll` returns later."""
        self._repeat_if_lost(lambda: self._send_once(command))

    def poll(self, parse: MessageParser[_T], wait: float = POLL_S) -> _T | None:
        """Return the next message within `wait` seconds; None if no message arrives or no connection is open."""
        if self._link is None:
            return None
        try:
            return self._next_message(self._link, parse, wait)
        except LinkTimeout:
            return None
        except BaseException:
            self.close()
            raise

    @property
    def connected(self) -> bool:
        """True if a connection is open."""
        return self._link is not None

    def close(self) -> None:
        """Close the connection, if there is one."""
        link, self._link = self._link, None
        self._received = b""
        if link is not None:
            link.close()

    def _repeat_if_lost(self, action: Callable[[], _T]) -> _T:
        """Run `action`; if the connection was open before and is lost now, repeat it once over a new connection."""
        was_connected = self._link is not None
        try:
            return action()
        except LinkClosed:
            if not was_connected:
                raise
            return action()

    def _request_once(self, request: bytes, parse: MessageParser[_T], skip: Callable[[_T], bool] | None) -> _T:
        link = self._send_once(request)
        try:
            return self._answer(link, parse, skip)
        except BaseException:
            self.close()
            raise

    def _answer(self, link: Link, parse: MessageParser[_T], skip: Callable[[_T], bool] | None) -> _T:
        while True:
            message = self._next_message(link, parse, self._timeout)
            if skip is None or not skip(message):
                return message

    def _send_once(self, command: bytes) -> Link:
        try:
            link = self._link
            if link is None:
                link = self._link = self._connect()
                self._prefix = self._greet(self)
                self.request_count = 0
            self._discard_input(link)
            prefix, self._prefix = self._prefix, b""
            link.write(prefix + command, self._timeout)
            self.request_count += 1
            _log.debug("sent %r", command)
        except BaseException:
            self.close()
            raise
        return link

    def _next_message(self, link: Link, parse: MessageParser[_T], wait: float) -> _T:
        deadline = self._clock.monotonic() + wait
        remaining = wait
        while (parsed := parse(self._received)) is None:
            if len(self._received) > MAX_MESSAGE:
                sent = f"sent {len(self._received)} bytes without the end of a message, expected at most {MAX_MESSAGE}"
                raise ProtocolError(f"{self._label} {sent}; {self._endless_remedy}")
            if remaining < 0:
                raise self._timeout_error(wait)
            try:
                data = link.read(MAX_MESSAGE, remaining)
            except LinkTimeout as error:
                raise self._timeout_error(wait) from error
            if not data:
                raise self._timeout_error(wait)
            self._received += data
            remaining = deadline - self._clock.monotonic()
        message, length = parsed
        _log.debug("received %r", self._received[:length])
        self._received = self._received[length:]
        return message

    def _discard_input(self, link: Link) -> None:
        self._received = b""
        # The loop is limited, because a faulty device may never stop sending. The next message then fails.
        for _ in range(MAX_MESSAGE):
            if not link.read(MAX_MESSAGE, 0.0):
                return

    def _timeout_error(self, wait: float) -> LinkTimeout:
        received = f" (received only {quoted(self._received)})" if self._received else ""
        return LinkTimeout(f"{self._label} has not answered within {wait:g} s{received}; {self._silence_remedy}")


def quoted(data: bytes) -> str:
    """Return the first 40 bytes as text in quotation marks, for a message."""
    return repr(data[:40])[1:] + ("…" if len(data) > 40 else "")
