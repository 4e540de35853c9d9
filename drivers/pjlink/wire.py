"""PJLink as bytes: both ends of the cable over TCP and UDP, nothing but pure functions and a line cutter.

Rules that hold inside:

- A line is at most 136 bytes with its CR: ``%``, class digit, four letters, a space or ``=``, up to 128 bytes of
  parameter. Whoever sends more gets `ProtocolError`, never memory.
- What we send follows the standard to the letter; what we accept is wider: any case, LF after or instead of CR, empty
  lines, NUL between lines (some projectors fill their packets up with it).
- Bytes that do not fit raise `ProtocolError`, which quotes them. A datagram, which arrives unasked and from anybody, is
  no error: one that holds nothing of ours is an empty answer.

A controller broadcasts a search over UDP; each class 2 projector answers within 10 s with its MAC address. A projector
also sends notices to the one controller whose address was entered in its menu: of its start, and of each change of
fault, power and input. Nothing there is proved by a password.

Source: JBMIA, PJLink Specifications 1.04 (class 1), 2.00 (class 2: same lines, digit 2; 3.2 search, 3.3 status
notification), 2.10 (SHA-256).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from drivers.projector import Fault, Lamp, Power, Severity
from foundation.errors import ProtocolError

PORT = 4352
"""TCP and UDP port of PJLink (PJLink Specifications 1.04 and 2.00)."""
MAX_LINE = 136
"""Bytes of a command or reply, its CR included."""
MAX_DIGEST = 96
"""Characters before the first command: 32 with MD5, 32 of random number and 64 of digest with SHA-256."""
MAX_PASSWORD = 32
"""Characters of a password (PJLink Specifications 1.04, authentication)."""
IDLE_LIMIT_S = 30.0
"""Projectors hang up after about this long without a command."""

QUERY = "?"
OK = "OK"
RAISE = "1"
LOWER = "0"
"""SVOL and MVOL move by one step; their level cannot be read."""
MUTE_ON = "31"
MUTE_OFF = "30"


class ErrorCode(Enum):
    """What a projector answers instead of a value (1.04, 2.3)."""

    UNDEFINED = "ERR1"
    OUT_OF_PARAMETER = "ERR2"
    UNAVAILABLE = "ERR3"
    FAILURE = "ERR4"


@dataclass(frozen=True)
class Greeting:
    """The projector's first line; `seed` is None where no password is wanted."""

    seed: str | None = None


class Refused(Enum):
    """The line that answers a wrong password, in place of a greeting or reply."""

    WRONG_PASSWORD = "PJLINK ERRA"


@dataclass(frozen=True)
class PjLinkRequest:
    """A command: four capital letters and a parameter, `QUERY` to ask; `digest` on a connection's first one."""

    command: str
    parameter: str = QUERY
    level: int = 1
    digest: str = ""


@dataclass(frozen=True)
class PjLinkReply:
    """An answer: the command it belongs to, and its value, or `OK`, or an error's code."""

    command: str
    value: str
    level: int = 1

    @property
    def error(self) -> ErrorCode | None:
        """The error that the value stands for, or None for a true value."""
        try:
            return ErrorCode(self.value.upper())
        except ValueError:
            return None


def take_line(data: bytes, limit: int = MAX_LINE) -> tuple[bytes, int] | None:
    """Take one line, without its end, off the front of `data`, past empty ones and filling."""
    start = len(data) - len(data.lstrip(b"\r\n\0"))
    found = re.compile(rb"[\r\n]").search(data, start)
    line = data[start : None if found is None else found.start()].replace(b"\0", b"")
    if len(line) >= limit:
        raise ProtocolError(
            f"a PJLink line of more than {limit} bytes begins {_quoted(line)}; "
            "check that this is a projector's control port"
        )
    return None if found is None else (line, found.end())


class LineCutter:
    """Cuts a stream into lines, however it was split in transit."""

    def __init__(self, limit: int = MAX_LINE) -> None:
        self._limit = limit
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Take the next bytes and return the lines that they complete, without their ends; empty lines are dropped."""
        self._rest += data
        lines: list[bytes] = []
        while (taken := take_line(self._rest, self._limit)) is not None:
            line, length = taken
            self._rest = self._rest[length:]
            lines.append(line)
        return lines


def authentication_digest(seed: str, password: str) -> str:
    """Return the digest that proves the password: MD5 of seed and password, 32 lowercase hex digits (1.04, 5.1)."""
    return hashlib.md5((seed + password).encode(), usedforsecurity=False).hexdigest()


def is_security_question(line: bytes) -> bool:
    """Return whether a line, without its end, asks for SHA-256."""
    return line.strip().upper() == b"PJLINK 2"


def encode_challenge(challenge: bytes) -> bytes:
    """Return the line by which a projector agrees to SHA-256; `challenge` is its 16 random bytes."""
    return f"PJLINK 2 {challenge.hex()}\r".encode("ascii")


def sha256_digest(challenge: bytes, nonce: bytes, password: str) -> str:
    """Return the digest that proves the password to a projector with SHA-256 (2.10, 5.1).

    `challenge`: the projector's 16 random bytes. `nonce`: the controller's own 16 random bytes.
    """
    mixed = bytes(ours ^ theirs for ours, theirs in zip(nonce, challenge, strict=True))
    return nonce.hex() + hashlib.sha256((mixed.hex() + password).encode()).hexdigest()


def encode_greeting(greeting: Greeting) -> bytes:
    """Return the projector's first line."""
    return b"PJLINK 0\r" if greeting.seed is None else f"PJLINK 1 {greeting.seed}\r".encode("ascii")


def parse_greeting(line: bytes) -> Greeting | Refused:
    """Return the greeting in the projector's first line."""
    text = line.decode("ascii", "replace").strip()
    words = text.split()
    match [words[0].upper(), *words[1:]] if words else []:
        case ["PJLINK", "0"]:
            return Greeting()
        case ["PJLINK", "1", seed] if len(seed) == 8:
            return Greeting(seed)
        case ["PJLINK", word] if word.upper() == "ERRA":
            return Refused.WRONG_PASSWORD
        case [word, *_] if word.startswith("HTTP/"):
            raise ProtocolError(
                f"an HTTP server answers {_quoted(line)}, no projector; give the projector's port, {PORT} unless its "
                "menu says another"
            )
        case _:
            raise ProtocolError(
                f"the projector greets with {_quoted(line)}, PJLINK 0 or PJLINK 1 and a seed of 8 characters was "
                f"expected; check that PJLink is enabled on it and that the port is {PORT}"
            )


def encode_request(request: PjLinkRequest) -> bytes:
    """Return a command line."""
    if not re.fullmatch(r"[A-Z0-9]{4}", request.command):
        raise ValueError(f"{request.command!r} is no PJLink command")
    line = f"%{request.level}{request.command} {request.parameter}\r".encode()
    if len(line) > MAX_LINE or b"\r" in line[:-1] or b"\n" in line:
        raise ValueError(f"{request.parameter!r} is no PJLink parameter")
    return request.digest.encode("ascii") + line


def parse_request(line: bytes) -> PjLinkRequest:
    """Return the command in a line, without its end."""
    found = re.fullmatch(rb"([0-9A-Fa-f]{96}|[0-9A-Fa-f]{32})?%([0-9])([0-9A-Za-z]{4}) (.{1,128})", line, re.DOTALL)
    if found is None:
        raise ProtocolError(
            f"{_quoted(line)} is no PJLink command; expected %1 or %2, four letters, a space, a parameter"
        )
    digest, level, command, parameter = found.groups(b"")
    return PjLinkRequest(
        command.decode("ascii").upper(),
        parameter.decode("utf-8", "replace"),
        int(level),
        digest.decode("ascii").lower(),
    )


def encode_reply(reply: PjLinkReply | Refused) -> bytes:
    """Return an answer's line."""
    if isinstance(reply, Refused):
        return f"{reply.value}\r".encode("ascii")
    return f"%{reply.level}{reply.command}={reply.value}\r".encode()


def parse_reply(line: bytes) -> PjLinkReply | Refused:
    """Return the answer in a line, without its end; a value's case is kept, for names have one."""
    if line.strip().upper() == b"PJLINK ERRA":
        return Refused.WRONG_PASSWORD
    found = re.fullmatch(rb"%([0-9])([0-9A-Za-z]{4})=(.{0,128})", line, re.DOTALL)
    if found is None:
        raise ProtocolError(f"the projector answers {_quoted(line)}; expected %1 or %2, four letters, = and a value")
    level, command, value = found.groups()
    return PjLinkReply(command.decode("ascii").upper(), value.decode("utf-8", "replace").strip(), int(level))


_POWERS = {"0": Power.STANDBY, "1": Power.ON, "2": Power.COOLING, "3": Power.WARMING}
_POWER_DIGITS = {power: digit for digit, power in _POWERS.items()}
FAULT_PARTS = ("fan", "lamp", "temperature", "cover", "filter", "other")
"""The parts in the order of ERST's six digits."""
_SEVERITIES = {"1": Severity.WARNING, "2": Severity.ERROR}
_SEVERITY_DIGITS = {severity: digit for digit, severity in _SEVERITIES.items()}


def format_power(power: Power) -> str:
    """Return POWR's digit for a power state."""
    return _POWER_DIGITS[power]


def parse_power(value: str) -> Power:
    """Return the power state that POWR answers."""
    if value not in _POWERS:
        raise _unexpected("POWR", value, "0 standby, 1 on, 2 cooling or 3 warm-up")
    return _POWERS[value]


def format_mute(muted: bool) -> str:
    """Return AVMT's code for picture and sound muted, or neither."""
    return MUTE_ON if muted else MUTE_OFF


def parse_mute(value: str) -> bool:
    """Return whether AVMT's code means that the picture is muted; 21 mutes the sound alone."""
    if not re.fullmatch("[123][01]", value):
        raise _unexpected("AVMT", value, "11, 21, 31 or 30")
    return value in ("11", "31")


def format_faults(faults: Mapping[str, Severity]) -> str:
    """Return ERST's six digits; `faults` maps a part of `FAULT_PARTS` to how bad it is."""
    return "".join(_SEVERITY_DIGITS[faults[part]] if part in faults else "0" for part in FAULT_PARTS)


def parse_faults(value: str) -> tuple[Fault, ...]:
    """Return the faults in ERST's six digits."""
    if not re.fullmatch("[012]{6}", value):
        raise _unexpected("ERST", value, "six digits of 0, 1 or 2")
    return tuple(
        Fault(part, _SEVERITIES[digit]) for part, digit in zip(FAULT_PARTS, value, strict=True) if digit != "0"
    )


def format_lamps(lamps: Sequence[Lamp]) -> str:
    """Return LAMP's pairs of hours and 0 or 1."""
    return " ".join(f"{lamp.hours} {int(lamp.lit)}" for lamp in lamps)


def parse_lamps(value: str) -> tuple[Lamp, ...]:
    """Return the lamps in LAMP's pairs."""
    if not re.fullmatch(r"[0-9]+ +[01]( +[0-9]+ +[01])*", value, re.ASCII):
        raise _unexpected("LAMP", value, "pairs of hours and 0 or 1")
    words = value.split()
    return tuple(Lamp(int(hours), lit == "1") for hours, lit in zip(words[::2], words[1::2], strict=True))


@dataclass(frozen=True)
class Input:
    """One input: its code of two characters, kind and number, and its name, empty where the projector has none."""

    code: str
    name: str = ""


def is_class_1_input(code: str) -> bool:
    """Return whether a code may be used in class 1."""
    return re.fullmatch("[1-5][1-9]", code) is not None


def parse_input(value: str, command: str = "INPT") -> str:
    """Return an input's code, its letter a capital."""
    if not re.fullmatch("[1-6][1-9A-Z]", value.upper()):
        raise _unexpected(command, value, "a digit 1 to 6 and one of 1 to 9 or A to Z")
    return value.upper()


@dataclass(frozen=True)
class Resolution:
    """A picture's width and height in pixels."""

    width: int
    height: int


class NoResolution(Enum):
    """Why an input has no resolution (IRES)."""

    NO_SIGNAL = "-"
    UNKNOWN_SIGNAL = "*"


def format_resolution(resolution: Resolution | NoResolution) -> str:
    """Return the value of IRES or RRES."""
    if isinstance(resolution, NoResolution):
        return resolution.value
    return f"{resolution.width}x{resolution.height}"


def parse_resolution(value: str, command: str = "RRES") -> Resolution:
    """Return the resolution in a value ``1920x1080``."""
    found = re.fullmatch(r"([0-9]{1,5})[xX]([0-9]{1,5})", value, re.ASCII)
    if found is None:
        raise _unexpected(command, value, "width, x and height in pixels")
    return Resolution(int(found[1]), int(found[2]))


def parse_input_resolution(value: str) -> Resolution | NoResolution:
    """Return the resolution that IRES answers, or why there is none."""
    try:
        return NoResolution(value)
    except ValueError:
        return parse_resolution(value, "IRES")


def format_freeze(frozen: bool) -> str:
    """Return FREZ's digit for a picture frozen or moving."""
    return "1" if frozen else "0"


def parse_freeze(value: str) -> bool:
    """Return whether FREZ reports a frozen picture."""
    if value not in ("0", "1"):
        raise _unexpected("FREZ", value, "0 moving or 1 frozen")
    return value == "1"


def parse_class(value: str) -> int:
    """Return the class that CLSS answers."""
    if not re.fullmatch("[1-9]", value, re.ASCII):
        raise _unexpected("CLSS", value, "1 or 2")
    return int(value)


def _unexpected(command: str, value: str, expected: str) -> ProtocolError:
    return ProtocolError(f"the projector answers {value!r} to {command} ?; expected {expected}")


def _quoted(line: bytes) -> str:
    return repr(line[:40])[1:] + ("…" if len(line) > 40 else "")


SEARCH = b"%2SRCH\r"
COLLECT_S = 30.0
"""So long a controller collects answers, which projectors delay by up to 10 s."""


@dataclass(frozen=True)
class Found:
    """The answer to a search: the projector's MAC address, six pairs of lowercase hex digits with colons."""

    mac: str


@dataclass(frozen=True)
class LinkUp:
    """A projector has come up and can be controlled; `mac` as in `Found`."""

    mac: str


@dataclass(frozen=True)
class FaultsChanged:
    """Every fault that is there now; empty when healthy again."""

    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class PowerChanged:
    """The new power state."""

    power: Power


@dataclass(frozen=True)
class InputChanged:
    """The code of the input that is shown now."""

    code: str


PjLinkNotice = LinkUp | FaultsChanged | PowerChanged | InputChanged


def is_search(datagram: bytes) -> bool:
    """Return whether a datagram asks projectors to answer."""
    return datagram.strip(b"\0\r\n ").upper() == b"%2SRCH"


def encode_datagram(message: Found | PjLinkNotice) -> bytes:
    """Return the datagram of an answer or a notice."""
    match message:
        case Found(mac):
            text = f"ACKN={mac}"
        case LinkUp(mac):
            text = f"LKUP={mac}"
        case FaultsChanged(faults):
            text = f"ERST={format_faults({fault.part: fault.severity for fault in faults})}"
        case PowerChanged(power):
            text = f"POWR={format_power(power)}"
        case InputChanged(code):
            text = f"INPT={code}"
    return f"%2{text}\r".encode("ascii")


def decode_datagram(datagram: bytes) -> tuple[Found | PjLinkNotice, ...]:
    """Return the answers and notices in a datagram, in their order; what is neither is passed over."""
    messages = (_message(line) for line in re.split(rb"[\r\n\0]+", datagram))
    return tuple(message for message in messages if message is not None)


def is_notice_of_start(line: bytes) -> bool:
    """Return whether a line is LKUP, which some projectors send into a controller's TCP connection as well."""
    return isinstance(_message(line), LinkUp)


def _message(line: bytes) -> Found | PjLinkNotice | None:
    try:
        reply = parse_reply(line.strip())
        if not isinstance(reply, PjLinkReply) or reply.level != 2:
            return None
        match reply.command:
            case "ACKN":
                return Found(_mac(reply.value))
            case "LKUP":
                return LinkUp(_mac(reply.value))
            case "ERST":
                return FaultsChanged(parse_faults(reply.value))
            case "POWR":
                return PowerChanged(parse_power(reply.value))
            case "INPT":
                return InputChanged(parse_input(reply.value))
            case _:
                return None
    except ProtocolError:
        return None


def _mac(value: str) -> str:
    if not re.fullmatch("[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}", value):
        raise ProtocolError(f"the projector names itself {value!r}; expected a MAC address")
    return value.lower()
