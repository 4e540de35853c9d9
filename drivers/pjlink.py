"""PJLink over TCP: messages, a projector driver, and the search for projectors in the network.

The driver sends only lines that the standard defines. In replies it accepts these deviations: lower case, blanks, lines
that end with LF, CR LF or NUL, empty lines, and the values that real projectors send instead of those of the standard
(each in a test with its source). A value that only informs never ends a run: if it cannot be read, it counts as not
reported. Power, faults and the reply to a command must be clear. Datagrams may come from any sender, so a datagram
without a valid reply is ignored.

Sources: JBMIA, PJLink Specifications 1.04 for class 1. PJLink Specifications 2.00 for class 2, with clause 3.2 for the
search and clause 3.3 for status notices. Lines of class 2 have the digit 2.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import chain, repeat
from typing import TypeVar

from drivers.links.link import Exchange, Link, quoted
from drivers.links.network import BROADCAST, UdpSocket
from drivers.projector import FAULT_PARTS, Fault, Lamp, Power, ProjectorIdentity, Severity
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import RUN_AGAIN, DeviceFault, DeviceRefused, LinkError, LinkTimeout, ProtocolError

PORT = 4352  # TCP and UDP port of PJLink (PJLink Specifications 1.04 and 2.00)
MAX_LINE = 136  # Longest command or reply including CR, bytes
DIGEST_LENGTH = 32  # Characters of the MD5 digest before the first command (PJLink Specifications 1.04, 5.1)
MAX_PASSWORD = 32  # Most characters of a password (PJLink Specifications 1.04, authentication)
IDLE_LIMIT_S = 30.0  # Projectors disconnect after about this time without a command, seconds

QUERY = "?"
OK = "OK"
MUTE_ON = "31"
MUTE_OFF = "30"


class ErrorCode(Enum):
    """Error replies (PJLink 1.04, clause 2.3)."""

    UNDEFINED = "ERR1"
    OUT_OF_PARAMETER = "ERR2"
    UNAVAILABLE = "ERR3"
    FAILURE = "ERR4"


class Refused(Enum):
    """Reply to a wrong password, sent instead of a greeting or another reply."""

    WRONG_PASSWORD = "PJLINK ERRA"


@dataclass(frozen=True)
class PjLinkRequest:
    """A command: four capital letters or digits, and a parameter or `QUERY`.

    - `level`: PJLink class, 1 or 2.
    - `digest`: only for the first command on a connection.
    """

    command: str
    parameter: str = QUERY
    level: int = 1
    digest: str = ""


@dataclass(frozen=True)
class PjLinkReply:
    """A reply: the command, the PJLink class (`level`), and a value, `OK` or an error code."""

    command: str
    value: str
    level: int = 1

    @property
    def error(self) -> ErrorCode | None:
        """Error code; None if the value is not an error code."""
        try:
            return ErrorCode(_without_blanks(self.value))
        except ValueError:
            return None


def _without_blanks(text: str) -> str:
    """Return a text in capitals without blanks, as in ``ERR 1`` and ``ERR1``."""
    return "".join(text.split()).upper()


def split_line(data: bytes, limit: int = MAX_LINE) -> tuple[bytes, int] | None:
    """Return the first line without its end, and the number of bytes up to its end; None if no line is complete.

    Empty lines are skipped. NUL ends a line, as CR and LF do.
    """
    start = len(data) - len(data.lstrip(b"\r\n\0"))
    line_end = re.compile(rb"[\r\n\0]").search(data, start)
    line = data[start : None if line_end is None else line_end.start()]
    if len(line) >= limit:
        raise ProtocolError(
            f"a PJLink line starts with {quoted(line)} and has {len(line)} bytes, expected fewer than {limit}; "
            "check that this is the control port of a projector"
        )
    return None if line_end is None else (line, line_end.end())


def authentication_digest(seed: str, password: str) -> str:
    """Return MD5 of seed and password as 32 lowercase hex digits (PJLink 1.04, clause 5.1)."""
    return hashlib.md5((seed + password).encode(), usedforsecurity=False).hexdigest()


def encode_greeting(seed: str | None) -> bytes:
    """Return the first line that the projector sends; `seed` is None if it requires no password."""
    return b"PJLINK 0\r" if seed is None else f"PJLINK 1 {seed}\r".encode("ascii")


def parse_greeting(line: bytes) -> str | Refused | None:
    """Return the seed in the projector's first line, None if it requires no password, or `Refused`."""
    text = line.decode("ascii", "replace").strip()
    words = text.split()
    match [words[0].upper(), *words[1:]] if words else []:
        case ["PJLINK", "0"]:
            return None
        case ["PJLINK", "1", seed]:
            return seed
        case ["PJLINK", *rest] if _without_blanks("".join(rest)) == "ERRA":
            return Refused.WRONG_PASSWORD
        case [word, *_] if word.startswith("HTTP/"):
            raise ProtocolError(
                f"an HTTP server answers {quoted(line)}, expected a PJLink projector; set the projector's port, "
                f"{PORT} unless its menu shows another"
            )
        case _:
            raise ProtocolError(
                f"the projector greets with {quoted(line)}, expected PJLINK 0, or PJLINK 1 and a seed; "
                f"check that PJLink is enabled on it and that the port is {PORT}"
            )


def encode_request(request: PjLinkRequest) -> bytes:
    """Return the bytes of a command."""
    if not re.fullmatch(r"[A-Z0-9]{4}", request.command):
        raise ValueError(f"PJLink command {request.command!r}: expected four capital letters or digits")
    line = f"%{request.level}{request.command} {request.parameter}\r".encode()
    if len(line) > MAX_LINE or b"\r" in line[:-1] or b"\n" in line:
        raise ValueError(f"PJLink parameter {request.parameter!r}: expected one line of at most {MAX_LINE} bytes")
    return request.digest.encode("ascii") + line


def parse_request(line: bytes) -> PjLinkRequest:
    """Return the command in a line without its end."""
    match = re.fullmatch(rb"([0-9A-Fa-f]{32})?%([0-9])([0-9A-Za-z]{4}) (.{1,128})", line, re.DOTALL)
    if match is None:
        raise ProtocolError(
            f"{quoted(line)} is not a PJLink command, expected %1 or %2, four letters, a space, a parameter"
        )
    digest, level, command, parameter = match.groups(b"")
    return PjLinkRequest(
        command.decode("ascii").upper(),
        parameter.decode("utf-8", "replace"),
        int(level),
        digest.decode("ascii").lower(),
    )


def encode_reply(reply: PjLinkReply | Refused) -> bytes:
    """Return the bytes of a reply."""
    if isinstance(reply, Refused):
        return f"{reply.value}\r".encode("ascii")
    return f"%{reply.level}{reply.command}={reply.value}\r".encode()


def parse_reply(line: bytes) -> PjLinkReply | Refused:
    """Return the reply in a line without its end; upper and lower case of the value are unchanged."""
    match = re.fullmatch(rb"\s*%([0-9])([0-9A-Za-z]{4})\s*=(.{0,128})", line, re.DOTALL)
    # Some servers put ERRA into the reply to the command.
    if _without_blanks((line if match is None else match[3]).decode("ascii", "replace")) in ("PJLINKERRA", "ERRA"):
        return Refused.WRONG_PASSWORD
    if match is None:
        raise ProtocolError(f"the projector answers {quoted(line)}, expected %1 or %2, four letters, = and a value")
    level, command, value = match.groups()
    return PjLinkReply(command.decode("ascii").upper(), value.decode("utf-8", "replace").strip(), int(level))


_POWERS = {"0": Power.STANDBY, "1": Power.ON, "2": Power.COOLING, "3": Power.WARMING}
_POWER_DIGITS = {power: digit for digit, power in _POWERS.items()}
_SEVERITIES = {"1": Severity.WARNING, "2": Severity.ERROR}
_SEVERITY_DIGITS = {severity: digit for digit, severity in _SEVERITIES.items()}


def format_power(power: Power) -> str:
    """Return the POWR digit of a power state."""
    return _POWER_DIGITS[power]


def parse_power(value: str) -> Power:
    """Return the power state in a POWR reply."""
    digit = value.lstrip("0") or value[:1]
    if digit not in _POWERS:
        raise _unexpected("POWR", value, "0 standby, 1 on, 2 cooling or 3 warm-up")
    return _POWERS[digit]


def format_mute(muted: bool) -> str:
    """Return the AVMT code that mutes image and sound, or shows both."""
    return MUTE_ON if muted else MUTE_OFF


def parse_mute(value: str) -> bool | None:
    """Return whether an AVMT code mutes the image, None if it is no code; code 21 mutes only the sound."""
    return value in ("11", "31") if re.fullmatch("[123][01]", value) else None


def format_faults(faults: Iterable[Fault]) -> str:
    """Return the six digits of ERST."""
    digits = {fault.part: _SEVERITY_DIGITS[fault.severity] for fault in faults}
    return "".join(digits.get(component, "0") for component in FAULT_PARTS)


def parse_faults(value: str) -> tuple[Fault, ...]:
    """Return the faults in the digits of ERST.

    Fewer digits are the first components; digits after the sixth belong to other components.
    """
    digits = _without_blanks(value)
    if not re.fullmatch("[012]*", digits):
        raise _unexpected("ERST", value, "six digits of 0, 1 or 2")
    parts = chain(FAULT_PARTS, repeat("other"))
    pairs = zip(parts, digits, strict=False)
    return tuple(dict.fromkeys(Fault(part, _SEVERITIES[digit]) for part, digit in pairs if digit != "0"))


def format_lamps(lamps: Sequence[Lamp]) -> str:
    """Return the LAMP value: the hours of each lamp, then 1 if it is lit, else 0."""
    return " ".join(f"{lamp.hours} {int(bool(lamp.lit))}" for lamp in lamps)


def parse_lamps(value: str) -> tuple[Lamp, ...]:
    """Return the lamps in a LAMP reply, () if it has no hours; the state of a lamp may be missing."""
    pairs = re.findall(r"([0-9]+)(?:[ ,]+([01])(?![0-9]))?", value, re.ASCII)
    is_readable = re.fullmatch(r"[0-9 ,]*", value, re.ASCII)
    return tuple(Lamp(int(hours), lit == "1" if lit else None) for hours, lit in pairs) if is_readable else ()


def is_class_1_input(code: str) -> bool:
    """Return whether class 1 permits an input code."""
    return re.fullmatch("[1-5][1-9]", code) is not None


def parse_input(value: str) -> str:
    """Return an input code, or the name that some projectors send, in capitals."""
    return value.upper()


@dataclass(frozen=True)
class Resolution:
    """Width and height of an image, pixels."""

    width: int
    height: int


class NoResolution(Enum):
    """Reason why an input has no resolution (IRES)."""

    NO_SIGNAL = "-"
    UNKNOWN_SIGNAL = "*"


def format_resolution(resolution: Resolution | NoResolution) -> str:
    """Return the IRES value."""
    if isinstance(resolution, NoResolution):
        return resolution.value
    return f"{resolution.width}x{resolution.height}"


def parse_input_resolution(value: str) -> Resolution | NoResolution:
    """Return the resolution in an IRES reply, such as ``1920x1080``, or the reason if it is missing."""
    match = re.match(r"([0-9]{1,5})\s*[x*\u00d7]\s*([0-9]{1,5})", value, re.ASCII | re.IGNORECASE)
    if match is None:
        return NoResolution.NO_SIGNAL if re.fullmatch("-+", value) else NoResolution.UNKNOWN_SIGNAL
    return Resolution(int(match[1]), int(match[2]))


def format_freeze(frozen: bool) -> str:
    """Return the FREZ digit."""
    return "1" if frozen else "0"


def parse_freeze(value: str) -> bool | None:
    """Return whether a FREZ reply reports a frozen image, None if it is no digit of the standard."""
    return value == "1" if value in ("0", "1") else None


def parse_class(value: str) -> int:
    """Return the class in a CLSS reply, its first digit, as in ``Class 1`` and ``Version1``; without a digit, 1."""
    match = re.search("[1-9]", value)
    return 1 if match is None else int(match[0])


def _unexpected(command: str, value: str, expected: str) -> ProtocolError:
    return ProtocolError(f"the projector answers {value!r} to {command} ?, expected {expected}")


SEARCH = b"%2SRCH\r"
# Time in which replies to a search are collected, seconds. Projectors wait up to 10 s (PJLink 2.00, clause 3.2).
COLLECT_S = 30.0


def parse_datagram(datagram: bytes) -> tuple[PjLinkReply, ...]:
    """Return the replies and notices of class 2 in a datagram, in order; ignore all other lines."""
    replies: list[PjLinkReply] = []
    for line in re.split(rb"[\r\n\0]+", datagram):
        with contextlib.suppress(ProtocolError):
            reply = parse_reply(line.strip())
            if isinstance(reply, PjLinkReply) and reply.level == 2:
                replies.append(reply)
    return tuple(replies)


def is_startup_notice(line: bytes) -> bool:
    """Return whether a line is the start-up notice LKUP; some projectors also send it over TCP."""
    return any(reply.command == "LKUP" for reply in parse_datagram(line))


# Time limit for a reply, seconds. The standard requires 2 s, but real projectors take longer during warm-up.
DEFAULT_TIMEOUT_S = 5.0
_SILENCE_REMEDY = "check that it is on the network, and that PJLink is enabled on it, also in standby"
_PORT_REMEDY = "check that a projector answers at this port"

_OTHER_SERVER_TIMEOUT_S = 2.0  # Time limit for the reply of a server that is no projector, seconds
_HTTP_REQUEST = b"GET / HTTP/1.0\r\n\r\n"
_HTTP_REPLY_STARTS = (b"http/", b"rtsp/", b"<!doc", b"<html")
# InitCommandRequest: length, type, an identifier of zeros, name, version (CIPA DC-005, 2.3.1).
_PTPIP_REQUEST = struct.pack("<II16s10sI", 38, 1, b"", "CroP".encode("utf-16-le"), 0x10000)
# Packet types after the length field: InitCommandAck and InitFail (same clause).
_PTPIP_REPLY_TYPES = tuple(struct.pack("<I", packet_type) for packet_type in (2, 5))


_Value = TypeVar("_Value")


class PjLinkProjector:
    """A `drivers.projector.Projector` over PJLink class 1, with the additions of class 2.

    All queries and commands may raise `DeviceRefused` (unknown command, value not offered, not possible now, wrong
    password), `DeviceFault` (the projector reports a failure), `LinkError` and `ProtocolError`.

    - `connect` opens a connection when it is needed. Many projectors accept only one connection, and close it after
      about 30 s without a command. The command is then sent again over a new connection. All commands can be repeated
      without harm.
    - After an error the connection is closed, so that a late reply is not read as the reply to the next command.
    - Many projectors implement only a part of their class. After `ERR1` or `ERR2`, a query returns None or an empty
      value and is not sent again. After `ERR3` it may be sent again.
    - `password` is None if the projector has no password.
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
        self._exchange = Exchange(connect, timeout, label, clock, self._greet, _SILENCE_REMEDY, _PORT_REMEDY)
        self._unsupported: set[PjLinkRequest] = set()

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name; an empty text if the projector does not report the value."""
        return ProjectorIdentity(self._query_name("INF1"), self._query_name("INF2"), self._query_name("NAME"))

    def power(self) -> Power:
        """Return the current power state."""
        return parse_power(self._query("POWR"))

    def switch_on(self) -> None:
        """Start to switch on; refused during cooling."""
        self._set("POWR", "1")

    def switch_off(self) -> None:
        """Start to switch off; refused during warm-up."""
        self._set("POWR", "0")

    def muted(self) -> bool | None:
        """Return whether the image is muted, None if this is not reported; refused unless the projector is on."""
        value = self._query_if_supported("AVMT")
        return None if value is None else parse_mute(value)

    def set_muted(self, muted: bool) -> None:
        """Mute image and sound, or unmute both; refused unless the projector is on."""
        self._set("AVMT", format_mute(muted))

    def faults(self) -> tuple[Fault, ...]:
        """Return all present faults; empty if there are none, or if the projector does not report them now."""
        request = PjLinkRequest("ERST")
        if request in self._unsupported:
            self.power()  # raises an error if the cable is unplugged; otherwise this would look like "no faults"
            return ()
        reply = self._exchange_request(request)
        if self._is_unsupported(request, reply) or reply.error is ErrorCode.UNAVAILABLE:
            return ()
        return parse_faults(self._value(reply))

    def lamps(self) -> tuple[Lamp, ...]:
        """Return all lamps; empty for a projector without a lamp, which does not support the query."""
        value = self._query_if_supported("LAMP")
        return () if value is None else parse_lamps(value)

    def pjlink_class(self) -> int:
        """Return the PJLink class of the projector; the query is sent only once."""
        if self._class is None:
            value = self._query_if_supported("CLSS")
            self._class = 1 if value is None else parse_class(value)
        return self._class

    def input(self) -> str:
        """Return the code of the selected input; refused unless the projector is on."""
        return parse_input(self._query("INPT", level=min(self.pjlink_class(), 2)))

    def input_resolution(self) -> Resolution | NoResolution | None:
        """Return the resolution of the signal or the reason why it is missing; None if not reported (class 2)."""
        value = self._query_class_2("IRES")
        return None if value is None else parse_input_resolution(value)

    def frozen(self) -> bool | None:
        """Return whether the image is frozen and does not follow the signal; None if not reported (class 2)."""
        value = self._query_class_2("FREZ")
        return None if value is None else parse_freeze(value)

    def picture_fault(self) -> str | None:
        """Return a message if the image is frozen or no signal arrives; None if no fault is reported."""
        if self._value_now(self.pjlink_class, 1) < 2:
            return None
        if self._value_now(self.frozen, None):
            return "the projected image is frozen; release freeze on its remote control"
        if self._value_now(self.input_resolution, None) is NoResolution.NO_SIGNAL:
            return "no signal arrives at the projector's input; check the cable, the input and the display's settings"
        return None

    def close(self) -> None:
        """Release the control port and keep the power state."""
        self._exchange.close()

    def _query_name(self, command: str) -> str:
        reply = self._exchange_request(PjLinkRequest(command))
        return reply.value if reply.error is None else ""

    def _query(self, command: str, level: int = 1) -> str:
        return self._value(self._exchange_request(PjLinkRequest(command, level=level)))

    def _query_class_2(self, command: str) -> str | None:
        if self.pjlink_class() < 2:
            raise DeviceRefused(
                f"{self._label} has PJLink class 1, but {command} requires class 2; see the menu of the projector"
            )
        return self._query_if_supported(command, level=2)

    def _query_if_supported(self, command: str, level: int = 1) -> str | None:
        request = PjLinkRequest(command, level=level)
        if request in self._unsupported:
            return None
        reply = self._exchange_request(request)
        return None if self._is_unsupported(request, reply) else self._value(reply)

    def _is_unsupported(self, request: PjLinkRequest, reply: PjLinkReply) -> bool:
        # A query has no parameter that could be out of range, so ERR2 also means that it is unsupported.
        is_unsupported = reply.error in (ErrorCode.UNDEFINED, ErrorCode.OUT_OF_PARAMETER)
        if is_unsupported:
            self._unsupported.add(request)
        return is_unsupported

    def _value_now(self, query: Callable[[], _Value], default: _Value) -> _Value:
        """Return the reply to a query, or `default` if the projector refuses the query now."""
        try:
            return query()
        except DeviceRefused:
            if not self._exchange.connected:
                raise  # The projector refused the connection, not only the query.
            return default

    def _set(self, command: str, parameter: str) -> None:
        value = self._value(self._exchange_request(PjLinkRequest(command, parameter)), parameter)
        if value.upper() != OK:
            self.close()
            raise ProtocolError(f"{self._label} answers {value!r} to {command} {parameter}, expected OK")

    def _value(self, reply: PjLinkReply, parameter: str = QUERY) -> str:
        exchange = f"{self._label} answers {reply.value} to {reply.command} {parameter}"
        match reply.error:
            case None:
                return reply.value
            case ErrorCode.UNDEFINED:
                raise DeviceRefused(f"{exchange}: it does not support this command; use its remote control")
            case ErrorCode.OUT_OF_PARAMETER:
                raise DeviceRefused(f"{exchange}: it does not offer this value; set it with its remote control")
            case ErrorCode.UNAVAILABLE:
                raise DeviceRefused(
                    f"{exchange}: it is warming up, cooling down or in standby; wait until it is on, {RUN_AGAIN}"
                )
            case ErrorCode.FAILURE:
                raise DeviceFault(f"{exchange}: it reports an internal failure; check its indicator lamps and display")

    def _exchange_request(self, request: PjLinkRequest) -> PjLinkReply:
        line = self._exchange.query(encode_request(request), split_line, is_startup_notice)
        try:
            reply = parse_reply(line)
            if isinstance(reply, Refused):
                raise self._wrong_password_error()
            if reply.command != request.command:
                raise ProtocolError(
                    f"{self._label} answers {reply.command} to {request.command}; check that no other controller uses "
                    "this connection"
                )
        except DeviceRefused:
            is_later_request = self._exchange.request_count > 1
            self._exchange.close()
            if is_later_request:
                # Some servers require the digest before every command; a new connection starts with a digest.
                return self._exchange_request(request)
            raise
        except ProtocolError:
            self._exchange.close()
            raise
        return reply

    def _greet(self, exchange: Exchange) -> bytes:
        try:
            line = exchange.listen(split_line, is_startup_notice)
        except LinkTimeout as error:
            exchange.close()
            # If a projector has answered before, it is probably starting up, and no other server is expected.
            server = None if self._has_greeted else self._detect_other_server()
            if server is None:
                raise
            raise DeviceRefused(
                f"{self._label}: {server} answers at its address and port; set the address of the projector, and "
                f"port {PORT} unless its menu shows another"
            ) from error
        seed = parse_greeting(line)
        self._has_greeted = True
        if isinstance(seed, Refused):
            raise self._wrong_password_error()
        if seed is None:
            return b""
        if self._password is None:
            raise DeviceRefused(f"{self._label} requires a password; set the PJLink password of its menu")
        return authentication_digest(seed, self._password).encode("ascii")

    def _detect_other_server(self) -> str | None:
        http_reply = self._probe(_HTTP_REQUEST)
        if http_reply[:5].lower() in _HTTP_REPLY_STARTS:
            return "an HTTP server"
        return "a camera (PTP/IP)" if self._probe(_PTPIP_REQUEST)[4:8] in _PTPIP_REPLY_TYPES else None

    def _probe(self, request: bytes) -> bytes:
        try:
            link = self._connect()
        except LinkError:
            return b""
        try:
            link.write(request, _OTHER_SERVER_TIMEOUT_S)
            return link.read(MAX_LINE, _OTHER_SERVER_TIMEOUT_S)
        except LinkError:
            return b""
        finally:
            link.close()

    def _wrong_password_error(self) -> DeviceRefused:
        return DeviceRefused(f"{self._label} refuses the password; set the PJLink password of its menu")


SEARCH_COUNT = 3  # Number of search requests, because datagrams may be lost
SEARCH_INTERVAL_S = 1.0  # Time between two requests, seconds, so that one network fault does not affect both

_MAC = re.compile("[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}")


@dataclass(frozen=True)
class FoundProjector:
    """A projector that replied to the search: host address and MAC address."""

    host: str
    mac: str


def search(
    seconds: float = COLLECT_S,
    address: str = BROADCAST,
    listen_port: int = PORT,
    open_socket: Callable[[int], UdpSocket] = UdpSocket,
    clock: Clock = SYSTEM_CLOCK,
) -> tuple[FoundProjector, ...]:
    """Search for class 2 projectors by UDP broadcast; return them in the order of their replies within `seconds`.

    The replies are not authenticated. Projectors may also send notices of start-up, faults, power and input to this
    port; these notices are ignored.
    """
    projectors: dict[FoundProjector, None] = {}
    with open_socket(listen_port) as datagrams:
        start = clock.monotonic()
        sent_count = 0
        while (elapsed := clock.monotonic() - start) < seconds:
            if sent_count < SEARCH_COUNT and elapsed >= sent_count * SEARCH_INTERVAL_S:
                datagrams.send(SEARCH, (address, PORT))
                sent_count += 1
            wait_end = min(seconds, sent_count * SEARCH_INTERVAL_S) if sent_count < SEARCH_COUNT else seconds
            try:
                datagram, (host, _) = datagrams.receive(max(wait_end - elapsed, 0.0))
            except LinkTimeout:
                continue
            for reply in parse_datagram(datagram):
                if reply.command == "ACKN" and _MAC.fullmatch(reply.value):
                    projectors[FoundProjector(host, reply.value.lower())] = None
    return tuple(projectors)
