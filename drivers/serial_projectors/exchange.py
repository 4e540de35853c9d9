"""What all projectors on a serial cable share: one question and one answer at a time, and the driver around them.

Rules that hold inside:

- The caller defines what a message is: a `MessageParser` looks at the bytes so far and returns the first whole message
  and its length.
- One connection, opened when first needed. After a fault of cable or protocol it is dropped, so that a late answer
  never meets a later question; what waits unread when a question is asked answers none of ours, and is thrown away.
- A question that meets a connection the other side has dropped meanwhile is asked once more over a new one; every
  command of these drivers may be repeated without harm.
- A projector that cools down is not switched on, and one that warms up is not switched off; one that is there, or on
  the way, is sent nothing.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, TypeVar

from drivers.links.link import Link
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity
from foundation.clock import Clock, SystemClock
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout, ProtocolError

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
        greet: Callable[[Exchange], None],
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


def take_line(data: bytes) -> tuple[str, int] | None:
    """Take one command's line, without its CR, off the front of what a projector hears."""
    end = data.find(b"\r")
    return None if end < 0 else (data[:end].decode("ascii", "replace").strip(), end + 1)


class SerialProjector(ABC):
    """A `drivers.projector.Projector` of one maker, whose subclass knows the words; nothing is opened before its use.

    Every question and command may raise `DeviceRefused`, `DeviceFault`, `LinkError` and `ProtocolError`.
    """

    maker: ClassVar[str]

    def __init__(
        self,
        connect: Callable[[], Link],
        timeout: float = DEFAULT_TIMEOUT_S,
        label: str = "the projector",
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.label = label
        self.clock = clock
        self.exchange = Exchange(connect, timeout, label, clock, self.greet)

    @abstractmethod
    def power(self) -> Power:
        """Return the power state now."""

    @abstractmethod
    def muted(self) -> bool | None:
        """Return whether the picture is blanked, None where it cannot tell; refused unless the projector is on."""

    @abstractmethod
    def set_muted(self, muted: bool) -> None:
        """Blank the picture, or show it; refused unless the projector is on."""

    @abstractmethod
    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now; empty when healthy, and where the projector cannot tell."""

    @abstractmethod
    def switch(self, on: bool) -> None:
        """Send the command that switches on or off."""

    @abstractmethod
    def lamp_hours(self) -> tuple[int, ...]:
        """Return the hours of every lamp; empty where the projector does not count them."""

    def greet(self, exchange: Exchange) -> None:
        """Say over a new connection what must be said before the first question: nothing in most languages."""
        return

    def model(self) -> str:
        """Return the model, empty where the language has no question for it."""
        return ""

    def name(self) -> str:
        """Return the name that the projector was given, empty where the language has no question for it."""
        return ""

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name; empty what the projector does not say."""
        return ProjectorIdentity(self.maker, _unless_refused(self.model), _unless_refused(self.name))

    def switch_on(self) -> None:
        """Begin to switch on; refused while it cools down."""
        match self.power():
            case Power.STANDBY:
                self.switch(True)
            case Power.COOLING:
                raise DeviceRefused(f"{self.label} is cooling down; wait until it is in standby and try again")
            case Power.ON | Power.WARMING:
                pass

    def switch_off(self) -> None:
        """Begin to switch off; refused while it warms up."""
        match self.power():
            case Power.ON:
                self.switch(False)
            case Power.WARMING:
                raise DeviceRefused(f"{self.label} is warming up; wait until it is on and try again")
            case Power.STANDBY | Power.COOLING:
                pass

    def lamps(self) -> tuple[Lamp, ...]:
        """Return every lamp; empty for a lampless projector, and for one that does not count hours."""
        hours = self.lamp_hours()
        lit = bool(hours) and self.power() in (Power.ON, Power.WARMING)
        return tuple(Lamp(count, lit) for count in hours)

    def close(self) -> None:
        """Release the cable; the power state stays."""
        self.exchange.close()

    def hours_in(self, question: str, answer: str) -> tuple[int, ...]:
        """Return the hours in an answer: numbers with spaces between them."""
        words = answer.split()
        if not words or not all(word.isascii() and word.isdecimal() for word in words):
            raise self.unexpected(question, answer, "hours")
        return tuple(int(word) for word in words)

    def unexpected(self, question: str, answer: str, expected: str) -> ProtocolError:
        """Return the error of an answer that the language does not have."""
        return ProtocolError(f"{self.label} answers {answer!r} to {question}; expected {expected}")


def _unless_refused(question: Callable[[], str]) -> str:
    try:
        return question()
    except DeviceRefused:
        return ""
