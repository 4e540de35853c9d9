"""What all projectors on a serial cable share: the driver around the words of their makers.

Rules that hold inside:

- A projector that cools down is not switched on, and one that warms up is not switched off; one that is there, or on
  the way, is sent nothing.
- Every command may be repeated without harm (`drivers.links.link`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

from drivers.links.link import Exchange, Link, quoted
from drivers.projector import Lamp, Power, Projector, ProjectorIdentity
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import DeviceRefused, ProtocolError

DEFAULT_TIMEOUT_S = 5.0
"""Epson's manual asks for an answer within 3 s, 5 s after a change of source; the others say nothing."""

CHECK_SPEED = "check that speed and parity are those set in the projector's menu, and the language its maker's"
"""The remedy against bytes that make no sense."""
_CHECK_CABLE = (
    "check the cable (straight or null-modem, as its manual says), the speed, and that it may be controlled in standby"
)


def text_of(data: bytes) -> str:
    """Return printable ASCII as text."""
    if any(not 0x20 <= byte < 0x7F for byte in data):
        raise ProtocolError(f"the projector sends {quoted(data)}, which is no text; {CHECK_SPEED}")
    return data.decode("ascii")


def take_line(data: bytes) -> tuple[str, int] | None:
    """Take one command's line, without its CR, off the front of what a projector hears."""
    end = data.find(b"\r")
    return None if end < 0 else (data[:end].decode("ascii", "replace").strip(), end + 1)


class SerialProjector(Projector, ABC):
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
        self.exchange = Exchange(connect, timeout, label, clock, self.greet, _CHECK_CABLE, CHECK_SPEED)

    @abstractmethod
    def switch(self, on: bool) -> None:
        """Send the command that switches on or off."""

    @abstractmethod
    def lamp_hours(self) -> tuple[int, ...]:
        """Return the hours of every lamp; empty where the projector does not count them."""

    def greet(self, exchange: Exchange) -> bytes:
        """Say over a new connection what must be said before the first question: nothing in most languages.

        Returns what the first question must begin with.
        """
        return b""

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
        power = self.power()
        if power is Power.COOLING:
            raise DeviceRefused(f"{self.label} is cooling down; wait until it is in standby and try again")
        if power is Power.STANDBY:
            self.switch(True)

    def switch_off(self) -> None:
        """Begin to switch off; refused while it warms up."""
        power = self.power()
        if power is Power.WARMING:
            raise DeviceRefused(f"{self.label} is warming up; wait until it is on and try again")
        if power is Power.ON:
            self.switch(False)

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
