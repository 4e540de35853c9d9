"""PJLink, the projector industry's control protocol over TCP: its bytes, a projector with it, and the search for them.

What we send follows the standard to the letter; what we accept is wider: any case, LF after or instead of CR, empty
lines, NUL between lines (some projectors fill their packets up with it). A datagram, which arrives unasked and from
anybody, is no error: one that holds nothing of ours is an empty answer.

Of the projector:

- One connection at a time, opened when first needed: many projectors serve one controller only. They hang up on an idle
  one after about 30 s; a command that meets a connection so lost is sent once more, and may be without harm.
- After a fault of cable or protocol the connection is dropped, so that a late answer never meets a later question.
- Projectors in the field do not know all of their class. What a question cannot be asked for (`ERR1`, `ERR2`) is None,
  or empty, and not asked again; `ERR3` means that it may be asked later. Only commands are refused.

A controller broadcasts a search over UDP; each class 2 projector answers (ACKN) within 10 s with its MAC address. A
projector also sends notices to the one controller whose address was entered in its menu: of its start (LKUP), and of
each change of fault, power and input. Nothing there is proved by a password.

Source: JBMIA, PJLink Specifications 1.04 (class 1), 2.00 (class 2: same lines, digit 2; 3.2 search, 3.3 status
notification).
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

from drivers.links.link import Exchange, Link, quoted
from drivers.links.network import BROADCAST, UdpSocket
from drivers.projector import FAULT_PARTS, Fault, Lamp, Power, ProjectorIdentity, Severity
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import DeviceFault, DeviceRefused, LinkError, LinkTimeout, ProtocolError

PORT = 4352  # TCP and UDP port of PJLink (PJLink Specifications 1.04 and 2.00)
MAX_LINE = 136  # Bytes of a command or reply, its CR included
DIGEST_LENGTH = 32  # Characters before the first command: the digest by MD5 (PJLink Specifications 1.04, 5.1)
MAX_PASSWORD = 32  # Characters of a password (PJLink Specifications 1.04, authentication)
IDLE_LIMIT_S = 30.0  # Projectors hang up after about this long without a command

QUERY = "?"
OK = "OK"
MUTE_ON = "31"
MUTE_OFF = "30"


class ErrorCode(Enum):
    """What a projector answers instead of a value (1.04, 2.3)."""

    UNDEFINED = "ERR1"
    OUT_OF_PARAMETER = "ERR2"
    UNAVAILABLE = "ERR3"
    FAILURE = "ERR4"


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
            f"a PJLink line of more than {limit} bytes begins {quoted(line)}; "
            "check that this is a projector's control port"
        )
    return None if found is None else (line, found.end())


def authentication_digest(seed: str, password: str) -> str:
    """Return the digest that proves the password: MD5 of seed and password, 32 lowercase hex digits (1.04, 5.1)."""
    return hashlib.md5((seed + password).encode(), usedforsecurity=False).hexdigest()


def encode_greeting(seed: str | None) -> bytes:
    """Return the projector's first line; no seed where no password is wanted."""
    return b"PJLINK 0\r" if seed is None else f"PJLINK 1 {seed}\r".encode("ascii")


def parse_greeting(line: bytes) -> str | Refused | None:
    """Return the seed in the projector's first line, None where no password is wanted."""
    text = line.decode("ascii", "replace").strip()
    words = text.split()
    match [words[0].upper(), *words[1:]] if words else []:
        case ["PJLINK", "0"]:
            return None
        case ["PJLINK", "1", seed] if len(seed) == 8:
            return seed
        case ["PJLINK", word] if word.upper() == "ERRA":
            return Refused.WRONG_PASSWORD
        case [word, *_] if word.startswith("HTTP/"):
            raise ProtocolError(
                f"an HTTP server answers {quoted(line)}, no projector; give the projector's port, {PORT} unless its "
                "menu says another"
            )
        case _:
            raise ProtocolError(
                f"the projector greets with {quoted(line)}, PJLINK 0 or PJLINK 1 and a seed of 8 characters was "
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
    found = re.fullmatch(rb"([0-9A-Fa-f]{32})?%([0-9])([0-9A-Za-z]{4}) (.{1,128})", line, re.DOTALL)
    if found is None:
        raise ProtocolError(
            f"{quoted(line)} is no PJLink command; expected %1 or %2, four letters, a space, a parameter"
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
        raise ProtocolError(f"the projector answers {quoted(line)}; expected %1 or %2, four letters, = and a value")
    level, command, value = found.groups()
    return PjLinkReply(command.decode("ascii").upper(), value.decode("utf-8", "replace").strip(), int(level))


_POWERS = {"0": Power.STANDBY, "1": Power.ON, "2": Power.COOLING, "3": Power.WARMING}
_POWER_DIGITS = {power: digit for digit, power in _POWERS.items()}
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


def format_faults(faults: Iterable[Fault]) -> str:
    """Return ERST's six digits."""
    digits = {fault.part: _SEVERITY_DIGITS[fault.severity] for fault in faults}
    return "".join(digits.get(part, "0") for part in FAULT_PARTS)


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


def is_class_1_input(code: str) -> bool:
    """Return whether a code may be used in class 1."""
    return re.fullmatch("[1-5][1-9]", code) is not None


def parse_input(value: str) -> str:
    """Return an input's code, its letter a capital."""
    if not re.fullmatch("[1-6][1-9A-Z]", value.upper()):
        raise _unexpected("INPT", value, "a digit 1 to 6 and one of 1 to 9 or A to Z")
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
    """Return the value of IRES."""
    if isinstance(resolution, NoResolution):
        return resolution.value
    return f"{resolution.width}x{resolution.height}"


def parse_input_resolution(value: str) -> Resolution | NoResolution:
    """Return the resolution that IRES answers, such as ``1920x1080``, or why there is none."""
    if value in ("-", "*"):
        return NoResolution(value)
    found = re.fullmatch(r"([0-9]{1,5})[xX]([0-9]{1,5})", value, re.ASCII)
    if found is None:
        raise _unexpected("IRES", value, "width, x and height in pixels, - or *")
    return Resolution(int(found[1]), int(found[2]))


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


SEARCH = b"%2SRCH\r"
COLLECT_S = 30.0  # So long a controller collects answers, which projectors delay by up to 10 s


def replies_in(datagram: bytes) -> tuple[PjLinkReply, ...]:
    """Return the answers and notices in a datagram, in their order; what is neither is passed over."""
    found: list[PjLinkReply] = []
    for line in re.split(rb"[\r\n\0]+", datagram):
        with contextlib.suppress(ProtocolError):
            reply = parse_reply(line.strip())
            if isinstance(reply, PjLinkReply) and reply.level == 2:
                found.append(reply)
    return tuple(found)


def is_notice_of_start(line: bytes) -> bool:
    """Return whether a line is LKUP, which some projectors send into a controller's TCP connection as well."""
    return any(reply.command == "LKUP" for reply in replies_in(line))


DEFAULT_TIMEOUT_S = 5.0  # The standard asks for an answer within 2 s; real projectors take longer while they warm up
_SILENT = "check that it is on the network, and that PJLink is enabled on it in standby too"
_CHECK_PORT = "check that a projector answers at this port"

# How long another server may take to answer its own kind of question; on a local network it takes milliseconds.
_OTHER_SERVER_S = 2.0
_HTTP_QUESTION = b"GET / HTTP/1.0\r\n\r\n"
_HTTP_ANSWERS = (b"http/", b"rtsp/", b"<!doc", b"<html")
# InitCommandRequest: length, type, an identifier of zeros, name, version (CIPA DC-005, 2.3.1).
_PTPIP_QUESTION = struct.pack("<II16s10sI", 38, 1, b"", "CroP".encode("utf-16-le"), 0x10000)
# Types of packets, behind their length: InitCommandAck and InitFail (same place).
_PTPIP_ANSWERS = tuple(struct.pack("<I", kind) for kind in (2, 5))


_Answer = TypeVar("_Answer")


class PjLinkProjector:
    """A `drivers.projector.Projector` over PJLink class 1, and what class 2 adds.

    Every question and command may raise `DeviceRefused` (not known, not offered, not now, wrong password),
    `DeviceFault` (the projector reports a failure of its own), `LinkError` and `ProtocolError`.

    `password`: the PJLink password, None where the projector has none.
    """

    def __init__(
        self,
        connect: Callable[[], Link],
        password: str | None = None,
        timeout: float = DEFAULT_TIMEOUT_S,
        label: str = "the projector",
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._class: int | None = None
        self._password = password
        self._label = label
        self._connect, self._has_greeted = connect, False
        self._exchange = Exchange(connect, timeout, label, clock, self._greet, _SILENT, _CHECK_PORT)
        self._unknown: set[PjLinkRequest] = set()

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name; empty what the projector does not say."""
        return ProjectorIdentity(self._name("INF1"), self._name("INF2"), self._name("NAME"))

    def power(self) -> Power:
        """Return the power state now."""
        return parse_power(self._ask("POWR"))

    def switch_on(self) -> None:
        """Begin to switch on; refused while it cools down."""
        self._set("POWR", "1")

    def switch_off(self) -> None:
        """Begin to switch off; refused while it warms up."""
        self._set("POWR", "0")

    def muted(self) -> bool | None:
        """Return whether the picture is blanked by mute, None where it cannot tell; refused unless it is on."""
        value = self._ask_if_known("AVMT")
        return None if value is None else parse_mute(value)

    def set_muted(self, muted: bool) -> None:
        """Blank picture and sound, or show them; refused unless the projector is on."""
        self._set("AVMT", format_mute(muted))

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now; empty when healthy, and where the projector cannot tell, or not now."""
        request = PjLinkRequest("ERST")
        if request in self._unknown:
            self.power()  # to be silent because the cable is out must not look like health
            return ()
        reply = self._reply_to(request)
        if self._cannot_tell(request, reply) or reply.error is ErrorCode.UNAVAILABLE:
            return ()
        return parse_faults(self._value(reply))

    def lamps(self) -> tuple[Lamp, ...]:
        """Return every lamp; empty for a lampless projector, which does not know the question."""
        value = self._ask_if_known("LAMP")
        return () if value is None else parse_lamps(value)

    def pjlink_class(self) -> int:
        """Return the class of PJLink that the projector speaks, 1 or 2; asked once."""
        if self._class is None:
            value = self._ask_if_known("CLSS")
            self._class = 1 if value is None else parse_class(value)
        return self._class

    def input(self) -> str:
        """Return the code of the input that is selected; refused unless the projector is on."""
        return parse_input(self._ask("INPT", level=min(self.pjlink_class(), 2)))

    def input_resolution(self) -> Resolution | NoResolution | None:
        """Return the resolution of the signal, or why it has none; None where it cannot tell; class 2."""
        value = self._ask_class_2("IRES")
        return None if value is None else parse_input_resolution(value)

    def frozen(self) -> bool | None:
        """Return whether the picture is frozen: it then no longer follows the signal; as `input_resolution`."""
        value = self._ask_class_2("FREZ")
        return None if value is None else parse_freeze(value)

    def picture_fault(self) -> str | None:
        """Return whether the picture is frozen or no signal arrives, as far as the projector can tell; else None."""
        if self._answer_now(self.pjlink_class, 1) < 2:
            return None
        if self._answer_now(self.frozen, None):
            return "the projector's picture is frozen; release freeze on its remote control"
        if self._answer_now(self.input_resolution, None) is NoResolution.NO_SIGNAL:
            return "no signal arrives at the projector's input; check the cable, the input and the display's settings"
        return None

    def close(self) -> None:
        """Release the control port; the power state stays."""
        self._exchange.close()

    def _name(self, command: str) -> str:
        reply = self._reply_to(PjLinkRequest(command))
        return reply.value if reply.error is None else ""

    def _ask(self, command: str, level: int = 1) -> str:
        return self._value(self._reply_to(PjLinkRequest(command, level=level)))

    def _ask_class_2(self, command: str) -> str | None:
        if self.pjlink_class() < 2:
            raise DeviceRefused(
                f"{self._label} speaks PJLink class 1, {command} needs class 2; look in its menu or on its type plate"
            )
        return self._ask_if_known(command, level=2)

    def _ask_if_known(self, command: str, level: int = 1) -> str | None:
        """Return what the projector answers, None where it does not know the question, or has no such part."""
        request = PjLinkRequest(command, level=level)
        if request in self._unknown:
            return None
        reply = self._reply_to(request)
        return None if self._cannot_tell(request, reply) else self._value(reply)

    def _cannot_tell(self, request: PjLinkRequest, reply: PjLinkReply) -> bool:
        """Return whether a question is unknown to the projector, and remember it: that does not change."""
        # A question has no parameter that could be out of range; whoever says so does not know it either.
        unknown = reply.error in (ErrorCode.UNDEFINED, ErrorCode.OUT_OF_PARAMETER)
        if unknown:
            self._unknown.add(request)
        return unknown

    def _answer_now(self, question: Callable[[], _Answer], unknown: _Answer) -> _Answer:
        """Return what is answered now, `unknown` where the projector declines to answer now."""
        try:
            return question()
        except DeviceRefused:
            if not self._exchange.connected:
                raise  # it refused the connection, not the question
            return unknown

    def _set(self, command: str, parameter: str) -> None:
        value = self._value(self._reply_to(PjLinkRequest(command, parameter)), parameter)
        if value.upper() != OK:
            self.close()
            raise ProtocolError(f"{self._label} answers {value!r} to {command} {parameter}; expected OK")

    def _value(self, reply: PjLinkReply, parameter: str = QUERY) -> str:
        asked = f"{self._label} answers {reply.value} to {reply.command} {parameter}"
        match reply.error:
            case None:
                return reply.value
            case ErrorCode.UNDEFINED:
                raise DeviceRefused(f"{asked}: it does not know this command; do it with its remote control")
            case ErrorCode.OUT_OF_PARAMETER:
                raise DeviceRefused(f"{asked}: it does not offer this value; choose it with its remote control")
            case ErrorCode.UNAVAILABLE:
                raise DeviceRefused(
                    f"{asked}: it is warming up, cooling down or in standby; wait until its power is on and try again"
                )
            case ErrorCode.FAILURE:
                raise DeviceFault(f"{asked}: it reports a failure of its own; look at its lamps and display")

    def _reply_to(self, request: PjLinkRequest) -> PjLinkReply:
        reply = self._exchange.ask(encode_request(request), take_line, is_notice_of_start)
        try:
            answer = parse_reply(reply)
            if isinstance(answer, Refused):
                raise self._wrong_password()
            if answer.command != request.command:
                raise ProtocolError(
                    f"{self._label} answers {answer.command} to {request.command}; check that no other controller "
                    "shares the connection"
                )
        except DeviceRefused:
            asked_before = self._exchange.questions > 1
            self._exchange.close()
            if asked_before:
                # Some servers want the digest before every command: a new connection begins with one.
                return self._reply_to(request)
            raise
        except ProtocolError:
            self._exchange.close()
            raise
        return answer

    def _greet(self, exchange: Exchange) -> bytes:
        """Return the digest that the first command must begin with."""
        try:
            line = exchange.listen(take_line, is_notice_of_start)
        except LinkTimeout as error:
            exchange.close()
            server = None if self._has_greeted else self._other_server()
            if server is None:
                raise
            raise DeviceRefused(
                f"{self._label}: {server} answers at its address and port, no projector; give the address of the "
                f"projector, and as port {PORT} unless its menu says another"
            ) from error
        seed = parse_greeting(line)
        self._has_greeted = True
        if isinstance(seed, Refused):
            raise self._wrong_password()
        if seed is None:
            return b""
        if self._password is None:
            raise DeviceRefused(f"{self._label} asks for a password; give the one set for PJLink in its menu")
        return authentication_digest(seed, self._password).encode("ascii")

    def _other_server(self) -> str | None:
        """Return what answers where nobody greets, by what it says to questions of its own kind; None if nothing does.

        It is asked only where no projector was met before, for one that is starting is silent as well.
        """
        said = self._answer_to(_HTTP_QUESTION)
        if said[:5].lower() in _HTTP_ANSWERS:
            return "an HTTP server"
        return "a camera (PTP/IP)" if self._answer_to(_PTPIP_QUESTION)[4:8] in _PTPIP_ANSWERS else None

    def _answer_to(self, question: bytes) -> bytes:
        try:
            link = self._connect()
        except LinkError:
            return b""
        try:
            link.write(question, _OTHER_SERVER_S)
            return link.read(MAX_LINE, _OTHER_SERVER_S)
        except LinkError:
            return b""
        finally:
            link.close()

    def _wrong_password(self) -> DeviceRefused:
        return DeviceRefused(f"{self._label} refuses the password; give the one set for PJLink in its menu")


ASKED = 3  # A datagram may be lost, so the search is sent so often, a second apart; a projector may answer each
ASK_EVERY_S = 1.0  # Far enough apart that one disturbance of the network does not swallow two

_MAC = re.compile("[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}")


@dataclass(frozen=True)
class FoundProjector:
    """A projector that answered: where its control port is reached, and its MAC address."""

    host: str
    mac: str


def search(
    seconds: float = COLLECT_S,
    address: str = BROADCAST,
    listen_port: int = PORT,
    open_socket: Callable[[int], UdpSocket] = UdpSocket,
    clock: Clock = SYSTEM_CLOCK,
) -> tuple[FoundProjector, ...]:
    """Ask all projectors of the network to answer, and return those that do, in the order of their answers.

    `address`: of the broadcast. `clock`: measures `seconds`.
    """
    found: dict[FoundProjector, None] = {}
    with open_socket(listen_port) as datagrams:
        start = clock.monotonic()
        asked = 0
        while (passed := clock.monotonic() - start) < seconds:
            if asked < ASKED and passed >= asked * ASK_EVERY_S:
                datagrams.send(SEARCH, (address, PORT))
                asked += 1
            ends = min(seconds, asked * ASK_EVERY_S) if asked < ASKED else seconds
            try:
                datagram, (host, _) = datagrams.receive(max(ends - passed, 0.0))
            except LinkTimeout:
                continue
            for reply in replies_in(datagram):
                if reply.command == "ACKN" and _MAC.fullmatch(reply.value):
                    found[FoundProjector(host, reply.value.lower())] = None
    return tuple(found)
