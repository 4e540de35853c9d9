"""A projector with a PJLink control port, as the suite's `Projector`; and the search for them (class 2).

Rules that hold inside:

- One connection at a time, opened when first needed: many projectors serve one controller only.
- Projectors hang up on an idle connection after about 30 s. A command that meets a connection so lost is sent once
  more over a new one; every command here may be repeated without harm.
- After a fault of cable or protocol the connection is dropped, so that a late answer never meets a later question.
- Class 2 is used only where the projector reports that it has it: others may never answer.
- Projectors in the field do not know all of their class. What a question cannot be asked for (`ERR1`, `ERR2`) is None,
  or empty, and not asked again; `ERR3` means that it may be asked later. Only commands are refused.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from drivers.links.link import Exchange, Link
from drivers.links.network import BROADCAST, Address, UdpSocket
from drivers.pjlink import wire
from drivers.pjlink.wire import (
    COLLECT_S,
    ErrorCode,
    Found,
    Input,
    NoResolution,
    PjLinkReply,
    PjLinkRequest,
    Refused,
    Resolution,
)
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity
from foundation.clock import Clock, SystemClock
from foundation.errors import DeviceFault, DeviceRefused, LinkError, LinkTimeout, ProtocolError

DEFAULT_TIMEOUT_S = 5.0
"""The standard asks for an answer within 2 s; real projectors take longer while they warm up."""
_SILENT = "check that it is on the network, and that PJLink is enabled on it in standby too"
_CHECK_PORT = "check that a projector answers at this port"

_STRANGER_S = 2.0
"""How long another server may take to answer its own kind of question; on a local network it takes milliseconds."""
_HTTP_QUESTION = b"GET / HTTP/1.0\r\n\r\n"
_HTTP_ANSWERS = (b"http/", b"rtsp/", b"<!doc", b"<html")
_PTPIP_QUESTION = struct.pack("<II16s10sI", 38, 1, b"", "CroP".encode("utf-16-le"), 0x10000)
"""InitCommandRequest: length, type, an identifier of zeros, name, version (CIPA DC-005, 2.3.1)."""
_PTPIP_ANSWERS = tuple(struct.pack("<I", kind) for kind in (2, 5))
"""Types of packets, behind their length: InitCommandAck and InitFail (same place)."""

_SYSTEM_CLOCK = SystemClock()

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
        clock: Clock = _SYSTEM_CLOCK,
    ) -> None:
        self._class: int | None = None
        self._password = password
        self._label = label
        self._connect, self._met = connect, False
        self._exchange = Exchange(connect, timeout, label, clock, self._greet, _SILENT, _CHECK_PORT)
        self._unknown: set[PjLinkRequest] = set()

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name; empty what the projector does not say."""
        return ProjectorIdentity(self._name("INF1"), self._name("INF2"), self._name("NAME"))

    def power(self) -> Power:
        """Return the power state now."""
        return wire.parse_power(self._ask("POWR"))

    def switch_on(self) -> None:
        """Begin to switch on; refused while it cools down."""
        self._set("POWR", "1")

    def switch_off(self) -> None:
        """Begin to switch off; refused while it warms up."""
        self._set("POWR", "0")

    def muted(self) -> bool | None:
        """Return whether the picture is blanked by mute, None where it cannot tell; refused unless it is on."""
        value = self._ask_if_known("AVMT")
        return None if value is None else wire.parse_mute(value)

    def set_muted(self, muted: bool) -> None:
        """Blank picture and sound, or show them; refused unless the projector is on."""
        self._set("AVMT", wire.format_mute(muted))

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now; empty when healthy, and where the projector cannot tell, or not now."""
        request = PjLinkRequest("ERST")
        if request in self._unknown:
            self.power()  # to be silent because the cable is out must not look like health
            return ()
        reply = self._reply_to(request)
        if self._cannot_tell(request, reply) or reply.error is ErrorCode.UNAVAILABLE:
            return ()
        return wire.parse_faults(self._value(reply))

    def lamps(self) -> tuple[Lamp, ...]:
        """Return every lamp; empty for a lampless projector, which does not know the question."""
        value = self._ask_if_known("LAMP")
        return () if value is None else wire.parse_lamps(value)

    def pjlink_class(self) -> int:
        """Return the class of PJLink that the projector speaks, 1 or 2; asked once."""
        if self._class is None:
            value = self._ask_if_known("CLSS")
            self._class = 1 if value is None else wire.parse_class(value)
        return self._class

    def input(self) -> Input:
        """Return the input that is selected, without its name; refused unless the projector is on."""
        return Input(wire.parse_input(self._ask("INPT", level=min(self.pjlink_class(), 2))))

    def input_resolution(self) -> Resolution | NoResolution | None:
        """Return the resolution of the signal, or why it has none; None where it cannot tell; class 2."""
        value = self._ask_class_2("IRES")
        return None if value is None else wire.parse_input_resolution(value)

    def frozen(self) -> bool | None:
        """Return whether the picture is frozen: it then no longer follows the signal; as `input_resolution`."""
        value = self._ask_class_2("FREZ")
        return None if value is None else wire.parse_freeze(value)

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
        if value.upper() != wire.OK:
            self.close()
            raise ProtocolError(f"{self._label} answers {value!r} to {command} {parameter}; expected OK")

    def _value(self, reply: PjLinkReply, parameter: str = wire.QUERY) -> str:
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
        reply = self._exchange.ask(wire.encode_request(request), wire.take_line, wire.is_notice_of_start)
        try:
            answer = wire.parse_reply(reply)
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
            line = exchange.listen(wire.take_line, wire.is_notice_of_start)
        except LinkTimeout as error:
            exchange.close()
            stranger = None if self._met else self._stranger()
            if stranger is None:
                raise
            raise DeviceRefused(
                f"{self._label}: {stranger} answers at its address and port, no projector; give the address of the "
                f"projector, and as port {wire.PORT} unless its menu says another"
            ) from error
        greeting = wire.parse_greeting(line)
        self._met = True
        if isinstance(greeting, Refused):
            raise self._wrong_password()
        if greeting.seed is None:
            return b""
        if self._password is None:
            raise DeviceRefused(f"{self._label} asks for a password; give the one set for PJLink in its menu")
        return wire.authentication_digest(greeting.seed, self._password).encode("ascii")

    def _stranger(self) -> str | None:
        """Return what answers where nobody greets, by what it says to questions of its own kind; None if nothing does.

        It is asked only where no projector was met before, for one that is starting is silent as well.
        """
        said = self._answer_to(_HTTP_QUESTION)
        if said[:5].lower() in _HTTP_ANSWERS:
            return "an HTTP server"
        return "a camera (PTP/IP)" if self._answer_to(_PTPIP_QUESTION)[4:8] in _PTPIP_ANSWERS else None

    def _answer_to(self, question: bytes) -> bytes:
        """Return what comes first over a new connection after a question that is no projector's."""
        try:
            link = self._connect()
        except LinkError:
            return b""
        try:
            link.write(question, _STRANGER_S)
            return link.read(wire.MAX_LINE, _STRANGER_S)
        except LinkError:
            return b""
        finally:
            link.close()

    def _wrong_password(self) -> DeviceRefused:
        return DeviceRefused(f"{self._label} refuses the password; give the one set for PJLink in its menu")


ASKED = 3
"""A datagram may be lost, so the search is sent so often, a second apart; a projector may answer each."""
ASK_EVERY_S = 1.0
"""Far enough apart that one disturbance of the network does not swallow two."""


class Datagrams(Protocol):
    """The part of `drivers.links.network.UdpSocket` that is used here."""

    def send(self, data: bytes, address: Address) -> None:
        """Send one datagram to host and port."""
        ...

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        """Return the next datagram and who sent it; `LinkTimeout` when none comes in time."""
        ...

    def close(self) -> None:
        """Stop listening."""
        ...


@dataclass(frozen=True)
class FoundProjector:
    """A projector that answered: where its control port is reached, and its MAC address."""

    host: str
    mac: str


def search(
    seconds: float = COLLECT_S,
    enough: int | None = None,
    address: str = BROADCAST,
    port: int = wire.PORT,
    listen_port: int = wire.PORT,
    open_socket: Callable[[int], Datagrams] = UdpSocket,
    clock: Clock = _SYSTEM_CLOCK,
) -> tuple[FoundProjector, ...]:
    """Ask all projectors of the network to answer, and return those that do, in the order of their answers.

    `enough`: return as soon as so many have answered; None waits the whole time. `clock`: measures `seconds`.
    """
    found: dict[FoundProjector, None] = {}
    datagrams = open_socket(listen_port)
    try:
        start = clock.monotonic()
        asked = 0
        while enough is None or len(found) < enough:
            passed = clock.monotonic() - start
            if passed >= seconds:
                break
            if asked < ASKED and passed >= asked * ASK_EVERY_S:
                datagrams.send(wire.SEARCH, (address, port))
                asked += 1
            ends = min(seconds, asked * ASK_EVERY_S) if asked < ASKED else seconds
            try:
                datagram, (host, _) = datagrams.receive(max(ends - passed, 0.0))
            except LinkTimeout:
                continue
            for message in wire.decode_datagram(datagram):
                if isinstance(message, Found):
                    found[FoundProjector(host, message.mac)] = None
    finally:
        datagrams.close()
    return tuple(found)
