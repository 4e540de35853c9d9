"""Optoma projectors: ``~``, the projector's number, a command and its value, over a serial cable.

Rules that hold inside:

- A command is answered by ``P`` or ``F``, a question by ``OK`` and a value, all ended by CR.
- The projector sends ``INFO`` and a number unasked when it changes its power state or has a fault. `OptomaProjector`
  keeps what it has received so: warm-up and cooling are known from there only, as power is else on or off.
- A fault once announced is reported until the projector warms up again; none can be asked for.
- Mute cannot be asked of older models; then what this driver has set last is the answer.

Source: Optoma, RS232 Protocol Function List of several models (syntax, P, F, OK, 00, 02, 108, 124, 150, 151, INFO 0 to
3). Not confirmed by a manual: 355, INFO 4, 6 and 7, and what 124 answers in warm-up and cooling.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.links.link import quoted
from drivers.projector import Fault, Power, Severity
from drivers.serial_projectors.driver import CHECK_SPEED, SerialProjector, text_of
from foundation.errors import DeviceRefused, ProtocolError

BAUD = 9600
"""With 8 data bits, no parity, 1 stop bit (RS232 Protocol Function List)."""
EVERYBODY = 0
"""The number that every projector listens to."""

# Numbers of commands and questions, as the RS232 Protocol Function List has them; 355 is not confirmed by it.
POWER = 0
AV_MUTE = 2
LAMP_HOURS = 108
POWER_STATE = 124
MODEL = 151
AV_MUTE_STATE = 355

_POWERS = {0: Power.STANDBY, 1: Power.WARMING, 2: Power.COOLING}
_POWER_NUMBERS = {power: number for number, power in _POWERS.items()}
_PARTS = {4: "lamp", 6: "fan", 7: "temperature"}
_PART_NUMBERS = {part: number for number, part in _PARTS.items()}


PASSED, FAILED = "P", "F"
"""Answers to a command; that to a question begins with `ANSWER`, what is sent unasked with `INFO` and a number."""
ANSWER, INFO = "OK", "INFO"


@dataclass(frozen=True)
class OptomaCommand:
    """A command or question: its number and what it is given."""

    number: int
    value: str
    projector: int = EVERYBODY


_MESSAGE = re.compile(rb"[\r\n\0 ]*(?:([PF])|(?i:OK)([^\r\n]*)[\r\n]|INFO([0-9]{1,3})(?=[^0-9]))")
_BEGINNING = re.compile(rb"[\r\n\0 ]*(?:[oO]([kK][^\r\n]*)?|I(N(F(O[0-9]{0,3})?)?)?)?")
_COMMAND = re.compile(r"~([0-9]{2})([0-9]{2,3}) (.{1,20})")


def encode_command(command: OptomaCommand) -> bytes:
    """Return a command's line."""
    return f"~{command.projector:02d}{command.number:02d} {command.value}\r".encode("ascii")


def take_command(data: bytes) -> tuple[OptomaCommand | None, int] | None:
    """Take one line off the front of `data`; None stands for a line that is no command."""
    end = data.find(b"\r")
    if end < 0:
        return None
    found = _COMMAND.fullmatch(data[:end].decode("ascii", "replace").strip())
    return (OptomaCommand(int(found[2]), found[3].strip(), int(found[1])) if found else None), end + 1


def encode_message(message: str) -> bytes:
    """Return the projector's line: `PASSED`, `FAILED`, or `ANSWER` or `INFO` with what follows them."""
    return f"{message}\r".encode("ascii")


def take_message(data: bytes) -> tuple[str, int] | None:
    """Take one message off the front of `data`, as `encode_message` takes it."""
    found = _MESSAGE.match(data)
    if found is None:
        if not _BEGINNING.fullmatch(data):
            raise ProtocolError(f"the projector answers {quoted(data)}; expected P, F, OK… or INFO…; {CHECK_SPEED}")
        return None
    done, value, info = found.groups()
    if done is not None:
        return done.decode("ascii"), found.end()
    if value is not None:
        return ANSWER + text_of(value).strip(), found.end()
    return f"{INFO}{int(info)}", found.end()


def info_of_power(power: Power) -> str | None:
    """Return what is sent when a power state begins; nothing when the projector has warmed up."""
    return f"{INFO}{_POWER_NUMBERS[power]}" if power in _POWER_NUMBERS else None


def info_of_fault(part: str) -> str | None:
    """Return what is sent when a part fails, None if there is no number for it."""
    return f"{INFO}{_PART_NUMBERS[part]}" if part in _PART_NUMBERS else None


class OptomaProjector(SerialProjector):
    """A `drivers.projector.Projector` over Optoma's commands."""

    maker = "Optoma"
    _on_the_way: Power | None = None
    _muted: bool | None = None
    _faults: tuple[str, ...] = ()

    def model(self) -> str:
        """Return the number that the language has for the model."""
        return f"model {self._get(MODEL)}"

    def power(self) -> Power:
        """Return the power state now; before the first change is announced, on or standby only."""
        value = self._get(POWER_STATE)
        match value, self._on_the_way:
            case "1", Power.COOLING:
                return Power.COOLING
            case "1", _:
                self._on_the_way = None
                return Power.ON
            case "0", on_the_way:
                return on_the_way or Power.STANDBY
            case _:
                raise ProtocolError(f"{self.label} answers OK{value} to its power state; expected OK0 or OK1")

    def switch(self, on: bool) -> None:
        """Send the command that switches on or off."""
        self._set(POWER, "1" if on else "0")
        self._on_the_way = Power.WARMING if on else Power.COOLING

    def muted(self) -> bool | None:
        """Return whether the picture is blanked; None where it cannot be read and was not set by this driver."""
        try:
            return self._get(AV_MUTE_STATE) == "1"
        except DeviceRefused:
            return self._muted

    def set_muted(self, muted: bool) -> None:
        """Blank picture and sound, or show them; refused unless the projector is on."""
        self._set(AV_MUTE, "1" if muted else "0")
        self._muted = muted

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault announced since the lamp was last struck; the language cannot ask for them."""
        # To be silent because the cable is out must not look like health.
        self.power()
        while (message := self.exchange.poll(take_message)) is not None:
            self._take_unsolicited(message)
        return tuple(Fault(part, Severity.ERROR) for part in self._faults)

    def lamp_hours(self) -> tuple[int, ...]:
        """Return the hours of its lamp; empty where the projector reports none."""
        try:
            value = self._get(LAMP_HOURS)
        except DeviceRefused:
            return ()
        return self.hours_in("its lamp hours", value)

    def _get(self, number: int) -> str:
        message = self._ask(OptomaCommand(number, "1"))
        if message == FAILED:
            raise DeviceRefused(f"{self.label} answers F to question {number}: its model does not know it, or now")
        if not message.startswith(ANSWER):
            self.exchange.close()
            raise ProtocolError(f"{self.label} answers {message} to question {number}; expected OK…")
        return message.removeprefix(ANSWER)

    def _set(self, number: int, value: str) -> None:
        message = self._ask(OptomaCommand(number, value))
        if message == FAILED:
            raise DeviceRefused(
                f"{self.label} answers F to command {number} {value}; wait until its power is on and try again"
            )
        if message != PASSED:
            self.exchange.close()
            raise ProtocolError(f"{self.label} answers {message} to command {number} {value}; expected P or F")

    def _ask(self, command: OptomaCommand) -> str:
        # The exchange throws away what waits when a question is asked; here it may be news.
        while (message := self.exchange.poll(take_message, 0.0)) is not None:
            self._take_unsolicited(message)
        return self.exchange.ask(encode_command(command), take_message, self._take_unsolicited)

    def _take_unsolicited(self, message: str) -> bool:
        if not message.startswith(INFO):
            return False
        number = int(message.removeprefix(INFO))
        if number in _POWERS:
            power = _POWERS[number]
            self._on_the_way = None if power is Power.STANDBY else power
            self._muted = None if power is Power.STANDBY else self._muted
            if power is Power.WARMING:
                self._faults = ()
        if number in _PARTS and _PARTS[number] not in self._faults:
            self._faults += (_PARTS[number],)
        return True
