"""NEC projectors: binary frames with a checksum, over a serial cable or over TCP (port 7142).

Rules that hold inside:

- A frame is a kind, a code, two numbers (0 from us; the projector's own from it), the length of the data, the data,
  and the low byte of the sum of all before. A reply's kind is the command's plus 20h, plus A0h when it failed; then two
  bytes say why.
- `NecProjector.power` is the running status; warm-up and switching off both show as "switching"; which of them it is
  follows from the state of cooling or from our own last command.

Source: NEC, Projector Control Command Reference Manual, revision 6.1 (037, 078-2 to 078-5), and Control Commands
(Basic), revision 5.16 (009, 015, table of error codes); revision 7.1 as public lists quote it (051, 052 shutter,
078-6 cover, 079 freeze, 305-3 basic information, 02h 0Fh). Not confirmed by a manual: the bytes of 016 power off, 020
and 021 picture mute (as other drivers have them), 02h 0Eh, the running status during warm-up, and that a laser's closed
shutter is told of as its cover, for no question about the shutter itself is listed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from drivers.links.link import quoted
from drivers.projector import Fault, Power, Severity
from drivers.serial_projectors.driver import CHECK_SPEED, SerialProjector
from foundation.errors import DeviceFault, DeviceRefused, ProtocolError

BAUD = 38400
"""One of the speeds that the menu offers, 4800 to 115200; set it so."""
TCP_PORT = 7142
"""Where a projector on a network takes the same frames (as other drivers have it)."""
_HEADER = 5
"""Bytes before the data: kind, code, two numbers, length."""


@dataclass(frozen=True)
class NecCommand:
    """A command, as the controller sends it."""

    kind: int
    code: int
    data: bytes = b""


@dataclass(frozen=True)
class NecReply:
    """An answer; `failed` holds the two bytes that give the reason why it did not do it."""

    kind: int
    code: int
    data: bytes = b""
    failed: tuple[int, int] | None = None
    projector: int = 1
    model: int = 0x40


POWER_ON = NecCommand(2, 0x00)
POWER_OFF = NecCommand(2, 0x01)
MUTE_ON = NecCommand(2, 0x10)
MUTE_OFF = NecCommand(2, 0x11)
ERRORS = NecCommand(0, 0x88)
RUNNING = NecCommand(0, 0x85, b"\x01")
MUTES = NecCommand(0, 0x85, b"\x03")
MODEL = NecCommand(0, 0x85, b"\x04")
COVER = NecCommand(0, 0x85, b"\x05")
BASIC_INFORMATION = NecCommand(0, 0xBF, b"\x02")
SHUTTER_CLOSE = NecCommand(2, 0x16)
SHUTTER_OPEN = NecCommand(2, 0x17)
FREEZE_ON = NecCommand(1, 0x98, b"\x01")
FREEZE_OFF = NecCommand(1, 0x98, b"\x02")
INFORMATION = NecCommand(3, 0x8A)

UNKNOWN_COMMAND = (0, 0)
"""The two bytes with which a command is refused (table of error codes)."""
UNKNOWN_TO_MODEL = (0, 1)
"""What this model has not (same table)."""
POWER_IS_OFF = (2, 0x0D)
"""Not possible in standby (same table)."""
EXECUTION_FAILED = (2, 0x0E)
"""Not confirmed by a manual."""
NO_AUTHORITY = (2, 0x0F)
"""The command needs authority (same table)."""
_FAILURES = {
    UNKNOWN_COMMAND: "it does not know this command",
    UNKNOWN_TO_MODEL: "its model cannot do this",
    (1, 0): "it does not know this value",
    (1, 1): "it has no such terminal",
    (2, 3): "it cannot be set now",
    (2, 4): "its on-screen mute is forced on; release it",
    (2, 8): "it shows a test pattern; leave that with its remote control",
    NO_AUTHORITY: "it wants authority for this; log in, or switch off the lock of its controls, in its menu",
    POWER_IS_OFF: "it is off, or on the way; wait until its power is on and try again",
}

_ERROR_BITS: Mapping[tuple[int, int], tuple[str, Severity]] = {
    (0, 0): ("cover", Severity.ERROR),
    (0, 1): ("temperature", Severity.ERROR),
    (0, 4): ("fan", Severity.ERROR),
    (0, 6): ("lamp", Severity.ERROR),
    (0, 7): ("lamp", Severity.WARNING),
    (1, 0): ("lamp", Severity.WARNING),
    (1, 2): ("lamp", Severity.ERROR),
    (2, 2): ("temperature", Severity.ERROR),
    (2, 3): ("lamp", Severity.ERROR),
    (2, 4): ("lamp", Severity.ERROR),
    (2, 5): ("cover", Severity.ERROR),
    (2, 6): ("lamp", Severity.WARNING),
    (2, 7): ("lamp", Severity.WARNING),
    (3, 0): ("lamp", Severity.ERROR),
    (3, 1): ("lamp", Severity.ERROR),
    (3, 2): ("temperature", Severity.WARNING),
}
_ERRORS_LENGTH = 12
"""Bytes of data in the answer to 009, error status."""


def checksum(data: bytes) -> int:
    """Return the low byte of the sum."""
    return sum(data) & 0xFF


def encode_command(command: NecCommand) -> bytes:
    """Return a command's frame."""
    frame = bytes([command.kind, command.code, 0, 0, len(command.data)]) + command.data
    return frame + bytes([checksum(frame)])


def encode_reply(reply: NecReply) -> bytes:
    """Return a reply's frame."""
    data = reply.data if reply.failed is None else bytes(reply.failed)
    kind = reply.kind | (0x20 if reply.failed is None else 0xA0)
    frame = bytes([kind, reply.code, reply.projector, reply.model, len(data)]) + data
    return frame + bytes([checksum(frame)])


def take_command(data: bytes) -> tuple[NecCommand, int] | None:
    """Take one command off the front of `data`."""
    frame = _take_frame(data)
    return None if frame is None else (NecCommand(frame[0], frame[1], frame[_HEADER:-1]), len(frame))


def take_reply(data: bytes) -> tuple[NecReply, int] | None:
    """Take one reply off the front of `data`."""
    if data and data[0] & 0xF0 not in (0x20, 0xA0):
        raise ProtocolError(f"the projector answers {quoted(data)}, which begins no reply; {CHECK_SPEED}")
    frame = _take_frame(data)
    if frame is None:
        return None
    kind, code, projector, model = frame[:4]
    content = frame[_HEADER:-1]
    failed: tuple[int, int] | None = None
    if kind & 0xF0 == 0xA0:
        if len(content) != 2:
            raise ProtocolError(f"the projector refuses with {quoted(frame)}; expected two bytes that say why")
        failed, content = (content[0], content[1]), b""
    return NecReply(kind & 0x0F, code, content, failed, projector, model), len(frame)


def _take_frame(data: bytes) -> bytes | None:
    if len(data) < _HEADER or len(data) < (length := _HEADER + data[4] + 1):
        return None
    frame = data[:length]
    if checksum(frame[:-1]) != frame[-1]:
        raise ProtocolError(
            f"the frame {quoted(frame)} ends with {frame[-1]:#04x}, but its sum is {checksum(frame[:-1]):#04x}; "
            f"{CHECK_SPEED}"
        )
    return frame


def format_running(power: Power) -> bytes:
    """Return the data of the running status."""
    data = bytearray(16)
    data[2] = power in (Power.ON, Power.WARMING)
    data[3] = power is Power.COOLING
    data[4] = power is Power.WARMING
    data[5] = {Power.STANDBY: 0x00, Power.ON: 0x04, Power.WARMING: 0x04, Power.COOLING: 0x05}[power]
    return bytes(data)


def parse_running(data: bytes, ordered_off: bool = False) -> Power:
    """Return the power state in the data of the running status."""
    if len(data) < 6:
        raise ProtocolError(f"the running status holds {len(data)} bytes; expected 16")
    powered, cooling, switching, operation = data[2:6]
    if cooling == 1 or operation == 0x05:
        return Power.COOLING
    if switching == 1:
        return Power.COOLING if ordered_off else Power.WARMING
    if operation == 0xFF:
        return Power.ON if powered == 1 else Power.STANDBY
    if operation not in (0x00, 0x04, 0x06, 0x0F, 0x10):
        raise ProtocolError(f"the running status is {operation:#04x}; expected 0x00, 0x04, 0x05, 0x06, 0x0f or 0x10")
    return Power.ON if operation == 0x04 else Power.STANDBY


def format_errors(faults: Iterable[Fault]) -> bytes:
    """Return the data of the error status; a fault without a bit of its own is the formatter's."""
    data = bytearray(_ERRORS_LENGTH)
    for fault in faults:
        known = [place for place, meaning in _ERROR_BITS.items() if meaning == (fault.part, fault.severity)]
        place, bit = known[0] if known else (1, 1)
        data[place] |= 1 << bit
    return bytes(data)


def parse_errors(data: bytes) -> tuple[Fault, ...]:
    """Return the faults in the data of the error status; of a part's faults the worst."""
    found: dict[str, Severity] = {}
    # From the fifth byte on newer models have bits of their own, such as being moved, which harm no light.
    for place, byte in enumerate(data[:4]):
        for bit in range(8):
            if byte >> bit & 1:
                part, severity = _ERROR_BITS.get((place, bit), ("other", Severity.ERROR))
                if found.get(part) is not Severity.ERROR:
                    found[part] = severity
    return tuple(Fault(part, severity) for part, severity in found.items())


def format_information(name: str, lamp_s: int) -> bytes:
    """Return the data of the information request: 98 bytes."""
    data = bytearray(98)
    data[:48] = name.encode("ascii", "replace")[:48].ljust(48, b"\0")
    data[82:86] = lamp_s.to_bytes(4, "little")
    return bytes(data)


def parse_information(data: bytes) -> tuple[str, int]:
    """Return the projector's name and the seconds that its lamp has burnt."""
    if len(data) < 86:
        raise ProtocolError(f"the projector's information holds {len(data)} bytes; expected 98")
    return parse_text(data[:49]), int.from_bytes(data[82:86], "little")


NO_SIGNAL = 1
"""What a projector shows, of the basic information: nothing comes in (305-3)."""
TEST_PATTERNS = (3, 5)
"""Its own test patterns; other numbers stand for pictures that come from outside (same place)."""


def format_basic_information(shown: int, frozen: bool) -> bytes:
    """Return the data of the basic information: its number, then 15 bytes."""
    data = bytearray(BASIC_INFORMATION.data.ljust(16, b"\0"))
    data[2], data[9] = shown, frozen
    return bytes(data)


def parse_basic_information(data: bytes) -> tuple[int, bool]:
    """Return the number of what is shown, and whether the picture is frozen."""
    if len(data) < 10 or data[9] not in (0, 1):
        raise ProtocolError(f"the basic information is {quoted(data)}; expected 16 bytes, the tenth 00 or 01")
    return data[2], data[9] == 1


def parse_text(data: bytes) -> str:
    """Return a text that ends with NUL."""
    return data.split(b"\0")[0].decode("ascii", "replace").strip()


class _NotKnown(DeviceRefused):
    """The projector, or its model, does not know a command."""


class NecProjector(SerialProjector):
    """A `drivers.projector.Projector` over NEC's control commands."""

    maker = "NEC"
    _ordered_off = False

    def model(self) -> str:
        """Return the model."""
        return parse_text(self._ask(MODEL))

    def name(self) -> str:
        """Return the name that it was given."""
        return parse_information(self._ask(INFORMATION))[0]

    def power(self) -> Power:
        """Return the power state now."""
        return parse_running(self._ask(RUNNING), self._ordered_off)

    def switch(self, on: bool) -> None:
        """Send the command that switches on or off."""
        self._ask(POWER_ON if on else POWER_OFF)
        self._ordered_off = not on

    def muted(self) -> bool | None:
        """Return whether the picture is muted, None where it cannot tell."""
        data = self._ask_if_known(MUTES)
        if data is None:
            return None
        if not data or data[0] not in (0, 1):
            raise ProtocolError(f"{self.label} answers {quoted(data)} to its mutes; expected 00 or 01 first")
        return data[0] == 1

    def set_muted(self, muted: bool) -> None:
        """Blank the picture, or show it; refused unless the projector is on."""
        self._ask(MUTE_ON if muted else MUTE_OFF)

    def picture_fault(self) -> str | None:
        """Return why the picture does not follow the signal, or reaches nobody; None where it does, or cannot tell."""
        if (self._ask_if_known(COVER) or b"\0")[0] == 1:
            return "the projector's shutter or lens cover is closed; open it"
        data = self._ask_if_known(BASIC_INFORMATION)
        if data is None:
            return None
        shown, frozen = parse_basic_information(data)
        if frozen:
            return "the projector's picture is frozen; release freeze on its remote control"
        if shown == NO_SIGNAL:
            return "no signal arrives at the projector's input; check the cable, the input and the display's settings"
        if shown in TEST_PATTERNS:
            return "the projector shows a test pattern of its own; leave that with its remote control"
        return None

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now; empty when healthy, and where its model does not report any.

        Only lamp and temperature have warnings.
        """
        return parse_errors(self._ask_if_known(ERRORS) or b"")

    def lamp_hours(self) -> tuple[int, ...]:
        """Return the hours of its first lamp, or of what lights it; empty where its model does not count them."""
        data = self._ask_if_known(INFORMATION)
        return () if data is None else (parse_information(data)[1] // 3600,)

    def _ask_if_known(self, command: NecCommand) -> bytes | None:
        """Return what a question is answered, None where the model does not know it."""
        try:
            return self._ask(command)
        except _NotKnown:
            return None

    def _ask(self, command: NecCommand) -> bytes:
        reply = self.exchange.ask(encode_command(command), take_reply)
        asked = f"command {command.kind:02X}h {command.code:02X}h"
        if (reply.kind, reply.code) != (command.kind, command.code):
            self.exchange.close()
            raise ProtocolError(f"{self.label} answers {reply.kind:02X}h {reply.code:02X}h to {asked}; {CHECK_SPEED}")
        if reply.failed is None:
            return reply.data
        if reply.failed == EXECUTION_FAILED:
            raise DeviceFault(f"{self.label} failed to carry out {asked}; look at its indicators")
        high, low = reply.failed
        reason = _FAILURES.get(reply.failed, "look up this code in its manual")
        kind = _NotKnown if reply.failed in (UNKNOWN_COMMAND, UNKNOWN_TO_MODEL) else DeviceRefused
        raise kind(f"{self.label} refuses {asked} with {high:02X}h {low:02X}h: {reason}")
