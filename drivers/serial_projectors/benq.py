"""BenQ projectors: commands between ``*`` and ``#``, over a serial cable or over TCP (port 8000).

Rules that hold inside:

- ``*pow=?#`` asks, ``*pow=on#`` sets; the answer repeats the name, ``*POW=ON#``. Between them may stand an echo of
  what was sent and the prompt ``>``; projectors on a network send neither.
- A command that changes nothing may be answered as wrong, so that none is sent.
- The language has power on and off only. `BenqProjector.power` takes ``Block item`` for warm-up or cooling, by the
  state seen last. A projector that reports on while its lamp still warms up counts as on.
- It has no question about faults, and `BenqProjector.faults` is always empty.

Source: BenQ, RS232 Command Control (command table, baud rates, the three refusals, echo). Not confirmed by a manual:
what pow=? answers in warm-up and cooling (as other drivers have met it); which questions standby answers.
"""

from __future__ import annotations

import contextlib
import re

from drivers.links.link import MessageParser
from drivers.projector import Fault, Power
from drivers.serial_projectors.driver import CHECK_SPEED, SerialProjector, text_of
from foundation.errors import DeviceRefused, ProtocolError

BAUD = 115200
"""The highest of the speeds that the menu offers, 2400 to 115200 (RS232 Command Control)."""
TCP_PORT = 8000
"""Where a projector on a network takes the same text (not confirmed by a manual)."""
PROMPT = b">"
QUERY = "?"
ILLEGAL = "Illegal format"
UNSUPPORTED = "Unsupported item"
BLOCKED = "Block item"

_WORD = re.compile(rb"[\r\n\0 ]*(?:(>)|([^\r\n\0>#]+#?)(?:(?<=#)|(?=[\r\n])))")


class Blocked(DeviceRefused):
    """The projector knows the command, and cannot carry it out now."""


def encode_command(name: str, value: str = QUERY) -> bytes:
    """Return a command, a question unless `value` is given."""
    return f"\r*{name}={value}#\r".encode("ascii")


def encode_answer(text: str) -> bytes:
    """Return an answer, such as ``POW=ON`` or `BLOCKED`."""
    return f"*{text}#\r\n".encode("ascii")


def reply_parser(command: bytes) -> MessageParser[str]:
    """Return what takes the answer to `command` off the front of the bytes, past echo and prompts.

    Where the answer and the echo look the same and only one comes, the prompt after it shows that it was the answer.
    """
    sent = command.strip(b"\r").decode("ascii")

    def take(data: bytes) -> tuple[str, int] | None:
        place, echoed = 0, False
        while found := _WORD.match(data, place):
            place = found.end()
            if found[1]:
                if echoed:
                    return sent, place
                continue
            word = text_of(found[2]).strip()
            if word != sent or echoed:
                return word, place
            echoed = True
        text_of(data[place:].translate(None, b"\r\n\0"))
        return None

    return take


def value_of(name: str, reply: str) -> str:
    """Return the value in the answer to a command about `name`."""
    text = reply.removeprefix("*").removesuffix("#").strip()
    match text.lower():
        case "block item":
            raise Blocked(f"the projector answers {BLOCKED} to {name}; wait until its power is on and try again")
        case "unsupported item":
            raise DeviceRefused(f"the projector answers {UNSUPPORTED} to {name}; do it with its remote control")
        case "illegal format":
            raise DeviceRefused(f"the projector answers {ILLEGAL} to {name}; do it with its remote control")
    found, equals, value = text.partition("=")
    if not equals and name == "modelname":
        # Some models say their name and nothing else.
        return text
    if not equals or found.strip().lower() != name:
        raise ProtocolError(f"the projector answers {reply!r} to {name}; expected *{name.upper()}=…#; {CHECK_SPEED}")
    return value.strip()


def on_or_off(name: str, value: str) -> bool:
    """Return whether `value` is on, not off."""
    if value.upper() not in ("ON", "OFF"):
        raise ProtocolError(f"the projector answers {name}={value}; expected ON or OFF")
    return value.upper() == "ON"


class BenqProjector(SerialProjector):
    """A `drivers.projector.Projector` over BenQ's commands."""

    maker = "BenQ"
    _settled: Power | None = None

    def model(self) -> str:
        """Return the model."""
        return self._command("modelname")

    def power(self) -> Power:
        """Return the power state now; warm-up and cooling by what it was before."""
        try:
            lit = on_or_off("pow", self._command("pow"))
        except Blocked as error:
            match self._settled:
                case Power.STANDBY:
                    return Power.WARMING
                case Power.ON:
                    return Power.COOLING
                case _:
                    raise DeviceRefused(
                        f"{self.label} is warming up or cooling down, and does not report which; wait two minutes"
                    ) from error
        self._settled = Power.ON if lit else Power.STANDBY
        return self._settled

    def switch(self, on: bool) -> None:
        """Send the command that switches on or off."""
        self._command("pow", "on" if on else "off")

    def muted(self) -> bool | None:
        """Return whether the picture is blanked, None where it cannot tell; refused unless the projector is on."""
        value = self._command_if_known("blank")
        return None if value is None else on_or_off("blank", value)

    def set_muted(self, muted: bool) -> None:
        """Blank the picture, or show it; refused unless the projector is on."""
        if self.muted() is not muted:
            self._command("blank", "on" if muted else "off")

    def faults(self) -> tuple[Fault, ...]:
        """Return nothing: the language has no question about faults; look at the projector's indicators."""
        # To be silent because the cable is out must not look like health.
        with contextlib.suppress(Blocked):
            self._command("pow")
        return ()

    def lamp_hours(self) -> tuple[int, ...]:
        """Return the hours of the first lamp; empty for a lampless projector, which does not know the question."""
        value = self._command_if_known("ltim")
        return () if value is None else self.hours_in("ltim", value)

    def _command_if_known(self, name: str) -> str | None:
        try:
            return self._command(name)
        except Blocked:
            raise
        except DeviceRefused:
            return None

    def _command(self, name: str, value: str = QUERY) -> str:
        command = encode_command(name, value)
        reply = self.exchange.ask(command, reply_parser(command))
        try:
            return value_of(name, reply)
        except ProtocolError:
            self.exchange.close()
            raise
