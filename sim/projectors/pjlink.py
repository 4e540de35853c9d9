"""PJLink for the simulated projector: the far side of a connection, and a TCP port that speaks for it.

Rules that hold inside: a peer deals with bytes alone; what they do happens in
`sim.projectors.projector.SimulatedProjector`.

Over UDP a projector of class 2 answers searches and gives notice of its changes.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
from dataclasses import dataclass
from types import TracebackType

from drivers.links.link import Link, PeerLink
from drivers.links.network import LOOPBACK, Address, TcpLink, TcpServer, UdpSocket
from drivers.pjlink import wire
from drivers.pjlink.wire import (
    ErrorCode,
    FaultsChanged,
    Found,
    Greeting,
    InputChanged,
    LineCutter,
    LinkUp,
    PjLinkNotice,
    PjLinkReply,
    PjLinkRequest,
    PowerChanged,
    Refused,
)
from foundation.errors import DeviceFault, DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.projectors.projector import SimulatedProjector

WATCH_S = 0.5
"""How often a served projector looks whether there is something to announce."""


class Announcer:
    """The notices of a `SimulatedProjector` of class 2: its start, then each change since somebody last looked."""

    def __init__(self, projector: SimulatedProjector) -> None:
        self._projector = projector
        self._sent: dict[type[PjLinkNotice], PjLinkNotice] = self._state()
        self._begun = False

    def news(self) -> tuple[PjLinkNotice, ...]:
        """Return the notices that are due now."""
        if self._projector.traits.pjlink_class < 2:
            return ()
        begun, self._begun = self._begun, True
        if not begun:
            return (LinkUp(self._projector.traits.mac),)
        state = self._state()
        news = tuple(notice for kind, notice in state.items() if self._sent.get(kind) != notice)
        self._sent |= state
        return news

    def _state(self) -> dict[type[PjLinkNotice], PjLinkNotice]:
        projector = self._projector
        state: list[PjLinkNotice] = [FaultsChanged(projector.faults()), PowerChanged(projector.power())]
        # In standby there is no input.
        with contextlib.suppress(DeviceRefused):
            state.append(InputChanged(projector.input()))
        return {type(notice): notice for notice in state}


class ProjectorDatagrams:
    """The UDP side of a simulated projector, in threads of its own: answers searches, sends notices; close it.

    An answer goes to the port from which the question came, not always to 4352: here both may share one computer.

    `controller`: to whom it sends notices, as a projector has it entered in its menu; None for nobody.
    """

    def __init__(self, projector: SimulatedProjector, port: int = 0, controller: Address | None = None) -> None:
        self._projector = projector
        self._controller = controller
        self._announcer = Announcer(projector)
        self._guard = threading.Lock()
        self._closing = threading.Event()
        self._socket = UdpSocket(port, LOOPBACK)
        self.address = self._socket.address
        """Host and port at which it hears searches."""
        self._threads = [
            threading.Thread(target=work, name=f"{name} {self.address[1]}", daemon=True)
            for work, name in ((self._answer, "answering searches at"), (self._watch, "announcing beside"))
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> ProjectorDatagrams:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def announce(self) -> None:
        """Send the notices that are due now; nobody need call it, for it is done every half second."""
        with self._guard:
            if self._controller is None:
                return
            for notice in self._announcer.news():
                with contextlib.suppress(LinkClosed):
                    self._socket.send(wire.encode_datagram(notice), self._controller)

    def close(self) -> None:
        """Stop listening and wait for the threads; a second call does nothing."""
        if self._closing.is_set():
            return
        self._closing.set()
        # A datagram of our own is the one portable way to wake a thread that waits for one.
        with contextlib.suppress(LinkClosed):
            self._socket.send(b"", self.address)
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def _answer(self) -> None:
        while not self._closing.is_set():
            try:
                datagram, sender = self._socket.receive(wire.IDLE_LIMIT_S)
            except LinkTimeout:
                continue
            except LinkClosed:
                return
            if wire.is_search(datagram) and self._projector.traits.pjlink_class >= 2:
                with contextlib.suppress(LinkClosed):
                    self._socket.send(wire.encode_datagram(Found(self._projector.traits.mac)), sender)

    def _watch(self) -> None:
        while not self._closing.wait(WATCH_S):
            self.announce()


@dataclass
class _Connection:
    """One connection.

    - `cutter`: cuts what comes into lines.
    - `last_heard`: when the last command came, by the projector's clock, seconds.
    - `expected_digest`: what proves the password by MD5; empty where none is wanted, or it has been proved.
    - `challenge`: what a proof by SHA-256 begins with; empty until the controller asks for one.
    - `closed`: whether the projector has hung up.
    """

    cutter: LineCutter
    last_heard: float
    expected_digest: str = ""
    challenge: bytes = b""
    closed: bool = False


class PjLinkPeer:
    """The far side of one PJLink connection to a `SimulatedProjector`: bytes in, bytes out.

    `password`: asked of every connection; None for a projector without one. `seed`: eight characters for the greeting;
    None draws new ones for each connection.
    """

    def __init__(self, projector: SimulatedProjector, password: str | None = None, seed: str | None = None) -> None:
        self._projector = projector
        self._password = password
        self._fixed_seed = seed
        self._connection, _ = self._begun()

    def connect(self) -> bytes:
        """Begin a new connection, forgetting the last, and return the greeting."""
        self._connection, greeting = self._begun()
        return greeting

    @property
    def closed(self) -> bool:
        """Whether it has hung up: after 30 s without a command, a wrong password, or something that is no line."""
        connection = self._connection
        if self._projector.clock.monotonic() - connection.last_heard >= wire.IDLE_LIMIT_S:
            connection.closed = True
        return connection.closed

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to the commands that they complete."""
        if self.closed:
            return b""
        connection, answer = self._connection, b""
        try:
            for line in connection.cutter.feed(data):
                if wire.is_security_question(line) and connection.expected_digest:
                    answer += self._security_answer()
                else:
                    reply = self._reply(wire.parse_request(line))
                    answer += wire.encode_reply(reply)
                    connection.closed = isinstance(reply, Refused)
                if connection.closed:
                    break
        except ProtocolError:
            connection.closed = True
        connection.last_heard = self._projector.clock.monotonic()
        return answer

    def _begun(self) -> tuple[_Connection, bytes]:
        """Return a new connection and its greeting."""
        cutter, now = LineCutter(wire.MAX_LINE + wire.MAX_DIGEST), self._projector.clock.monotonic()
        if self._password is None:
            return _Connection(cutter, now), wire.encode_greeting(Greeting())
        seed = self._fixed_seed or secrets.token_hex(4)
        digest = wire.authentication_digest(seed, self._password)
        return _Connection(cutter, now, digest), wire.encode_greeting(Greeting(seed))

    def _security_answer(self) -> bytes:
        if not self._projector.traits.sha256:
            # A projector with MD5 alone takes this for a digest, and a wrong one.
            self._connection.closed = True
            return wire.encode_reply(Refused.WRONG_PASSWORD)
        self._connection.challenge = secrets.token_bytes(16)
        return wire.encode_challenge(self._connection.challenge)

    def _proves_password(self, digest: str) -> bool:
        connection = self._connection
        if not connection.challenge:
            return digest == connection.expected_digest
        try:
            nonce = bytes.fromhex(digest[:32])
        except ValueError:
            return False
        assert self._password is not None
        return len(nonce) == 16 and digest == wire.sha256_digest(connection.challenge, nonce, self._password)

    def _reply(self, request: PjLinkRequest) -> PjLinkReply | Refused:
        if self._connection.expected_digest:
            if not self._proves_password(request.digest):
                return Refused.WRONG_PASSWORD
            self._connection.expected_digest = ""
        try:
            value = self._value(request) if request.level == 1 else self._class_2_value(request)
        except DeviceRefused:
            value = ErrorCode.UNAVAILABLE.value
        except DeviceFault:
            value = ErrorCode.FAILURE.value
        except ValueError:
            value = ErrorCode.OUT_OF_PARAMETER.value
        return PjLinkReply(request.command, value, request.level)

    def _value(self, request: PjLinkRequest) -> str:
        projector = self._projector
        match request.command, request.parameter:
            case "POWR", wire.QUERY:
                return wire.format_power(projector.power())
            case "POWR", "1":
                projector.switch_on()
            case "POWR", "0":
                projector.switch_off()
            case "INPT", wire.QUERY:
                return projector.input()
            case "INPT", code if wire.is_class_1_input(code):
                projector.set_input(code)
            case "AVMT", wire.QUERY:
                return wire.format_mute(projector.muted())
            case "AVMT", "10" | "11" | "30" | "31" as code:
                projector.set_muted(wire.parse_mute(code))
            case "AVMT", "20" | "21":
                # It has no loudspeaker.
                pass
            case "ERST", wire.QUERY:
                return wire.format_faults({fault.part: fault.severity for fault in projector.faults()})
            case "LAMP", wire.QUERY:
                return wire.format_lamps(projector.lamps())
            case "INST", wire.QUERY:
                codes = (source.code for source in projector.traits.inputs)
                return " ".join(code for code in codes if wire.is_class_1_input(code))
            case "NAME", wire.QUERY:
                return projector.identity().name
            case "INF1", wire.QUERY:
                return projector.identity().maker
            case "INF2", wire.QUERY:
                return projector.identity().model
            case "INFO", wire.QUERY:
                return "simulated"
            case "CLSS", wire.QUERY:
                return str(projector.traits.pjlink_class)
            case command, _ if command in _COMMANDS:
                return ErrorCode.OUT_OF_PARAMETER.value
            case _:
                return ErrorCode.UNDEFINED.value
        return wire.OK

    def _class_2_value(self, request: PjLinkRequest) -> str:
        projector = self._projector
        traits = projector.traits
        match request.command, request.parameter:
            case _ if request.level > traits.pjlink_class:
                return ErrorCode.UNDEFINED.value
            case "INPT", wire.QUERY:
                return projector.input()
            case "INPT", code:
                projector.set_input(code.upper())
            case "INST", wire.QUERY:
                return " ".join(source.code for source in traits.inputs)
            case "INNM", question:
                names = {wire.QUERY + source.code: source.name for source in traits.inputs}
                return names.get(question.upper(), ErrorCode.OUT_OF_PARAMETER.value)
            case "IRES", wire.QUERY:
                return wire.format_resolution(projector.input_resolution())
            case "RRES", wire.QUERY:
                return wire.format_resolution(traits.panel)
            case "SNUM", wire.QUERY:
                return traits.serial_number
            case "SVER", wire.QUERY:
                return traits.software_version
            case "FILT" | "RFIL", wire.QUERY if traits.filter_hours is None:
                return ErrorCode.UNDEFINED.value
            case "FILT", wire.QUERY:
                return str(traits.filter_hours)
            case "RFIL", wire.QUERY:
                return traits.filter_model
            case "RLMP", wire.QUERY:
                return traits.lamp_model
            case "FREZ", wire.QUERY:
                return wire.format_freeze(projector.frozen())
            case "FREZ", "0" | "1" as digit:
                projector.set_frozen(wire.parse_freeze(digit))
            case "SVOL", wire.RAISE | wire.LOWER as step:
                projector.turn_speaker(1 if step == wire.RAISE else -1)
            case "MVOL", wire.RAISE | wire.LOWER as step:
                projector.turn_microphone(1 if step == wire.RAISE else -1)
            case command, _ if command in _CLASS_2_COMMANDS:
                return ErrorCode.OUT_OF_PARAMETER.value
            case _:
                return ErrorCode.UNDEFINED.value
        return wire.OK


_COMMANDS = ("POWR", "INPT", "AVMT", "ERST", "LAMP", "INST", "NAME", "INF1", "INF2", "INFO", "CLSS")
_CLASS_2_COMMANDS = (
    "INPT", "INST", "INNM", "IRES", "RRES", "SNUM", "SVER", "FILT", "RLMP", "RFIL", "FREZ", "SVOL", "MVOL",
)  # fmt: skip


def memory_link(peer: PjLinkPeer) -> Link:
    """Return a new connection to `peer` that needs no thread and never waits."""
    return PeerLink(peer)


def serve_pjlink(
    projector: SimulatedProjector,
    port: int = 0,
    password: str | None = None,
    host: str | None = None,
    answer_s: float = 0.0,
) -> TcpServer:
    """Return a running server that speaks PJLink for `projector`; close it, or use it in a `with` block.

    `answer_s`: how long it takes to answer, seconds of its clock.
    """

    def handle(link: TcpLink) -> None:
        peer = PjLinkPeer(projector, password)
        link.write(peer.connect(), wire.IDLE_LIMIT_S)
        while not peer.closed:
            try:
                answer = peer.receive(link.read(4096, wire.IDLE_LIMIT_S))
            except LinkTimeout:
                continue
            if answer:
                projector.clock.sleep(answer_s)
                link.write(answer, wire.IDLE_LIMIT_S)

    return TcpServer(handle, port) if host is None else TcpServer(handle, port, host)
