"""The simulated projector: a lamp that takes its time, and PJLink ports that speak for it.

Rules that hold inside:

- `SimulatedProjector` is physics and knows no bytes; `PjLinkPeer` and `Announcer` are bytes and know no physics.
- State moves with the time that is handed in, and only when somebody looks.
- What the world needs is `light`: how much of the full light reaches the screen now.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
from dataclasses import dataclass
from types import TracebackType

from drivers.links.link import Link
from drivers.links.memory import PeerLink
from drivers.links.tcp import LOOPBACK, TcpLink, TcpServer
from drivers.links.udp import Address, UdpSocket
from drivers.pjlink import notices, wire
from drivers.pjlink.notices import FaultsChanged, Found, InputChanged, LinkUp, Notice, PowerChanged
from drivers.pjlink.wire import (
    ErrorCode,
    Greeting,
    Input,
    LineCutter,
    NoResolution,
    Refused,
    Reply,
    Request,
    Resolution,
)
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity, Severity
from foundation.clock import Clock
from foundation.errors import DeviceFault, DeviceRefused, LinkClosed, LinkTimeout, ProtocolError

WARM_UP_S = 30.0
COOL_DOWN_S = 60.0
IDENTITY = ProjectorIdentity("CroP", "Simulated Projector", "dark room")
INPUTS = (
    Input("11", "Computer"),
    Input("31", "HDMI 1"),
    Input("32", "HDMI 2"),
    Input("3A", "HDBaseT"),
    Input("61", "Test pattern"),
)
PANEL = Resolution(1920, 1080)
MAX_VOLUME = 20
WATCH_S = 0.5
"""How often a served projector looks whether there is something to announce."""


@dataclass(frozen=True)
class ProjectorTraits:
    """What does not change about a simulated projector.

    `lamp_hours` is what its lamp has burnt at the start; `filter_hours` is None for a projector without filter;
    `inputs` beyond class 1 are hidden in a projector of class 1; `sha256` is what PJLink 2.10 adds.
    """

    identity: ProjectorIdentity = IDENTITY
    warm_up_s: float = WARM_UP_S
    cool_down_s: float = COOL_DOWN_S
    lamp_hours: float = 120.0
    inputs: tuple[Input, ...] = INPUTS
    pjlink_class: int = 2
    sha256: bool = False
    serial_number: str = "SIM0000001"
    software_version: str = "1.00"
    filter_hours: int | None = 45
    lamp_model: str = "LAMP-1"
    filter_model: str = "FILTER-1"
    panel: Resolution = PANEL
    mac: str = "02:00:00:00:00:01"


class SimulatedProjector:
    """A lamp projector. It keeps the contract of `drivers.projector.Projector`, and may be used from several threads.

    Parameters
    ----------
    clock
        The time by which the lamp warms up and cools down.
    power
        The state in which it is found, `Power.ON` or `Power.STANDBY`.
    """

    def __init__(self, clock: Clock, power: Power = Power.STANDBY, traits: ProjectorTraits | None = None) -> None:
        self.clock = clock
        self.traits = traits or ProjectorTraits()
        self._guard = threading.RLock()
        self._power = power
        self._since = clock.monotonic()
        self._lit_s = self.traits.lamp_hours * 3600.0
        self._muted = False
        self._faults: dict[str, Severity] = {}
        self._input = "31"
        self._frozen = False
        self.signal: Resolution | NoResolution = self.traits.panel
        """What arrives at its input; change it at will."""
        self.speaker = MAX_VOLUME // 2
        self.microphone = MAX_VOLUME // 2

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name."""
        return self.traits.identity

    def power(self) -> Power:
        """Return the power state now."""
        with self._guard:
            self._move()
            return self._power

    def switch_on(self) -> None:
        """Strike the lamp; refused while it cools."""
        with self._guard:
            self._begin(Power.WARMING, Power.ON, "cooling down")

    def switch_off(self) -> None:
        """Put the lamp out; refused while it warms up."""
        with self._guard:
            self._begin(Power.COOLING, Power.STANDBY, "warming up")

    def muted(self) -> bool:
        """Return whether the picture is blanked; refused unless it is on."""
        with self._guard:
            self._require_on()
            return self._muted

    def set_muted(self, muted: bool) -> None:
        """Blank the picture, or show it; refused unless it is on."""
        with self._guard:
            self._require_on()
            self._muted = muted

    def input(self) -> str:
        """Return the code of the input that is shown (PJLink INPT); refused unless it is on."""
        with self._guard:
            self._require_on()
            return self._input

    def set_input(self, code: str) -> None:
        """Show another of the inputs in its traits; refused unless it is on."""
        with self._guard:
            self._require_on()
            if code not in [source.code for source in self.traits.inputs]:
                raise ValueError(code)
            self._input = code

    def input_resolution(self) -> Resolution | NoResolution:
        """Return the resolution of the signal at its input, or why there is none; refused unless it is on."""
        with self._guard:
            self._require_on()
            return self.signal

    def frozen(self) -> bool:
        """Return whether the picture is frozen; refused unless it is on."""
        with self._guard:
            self._require_on()
            return self._frozen

    def set_frozen(self, frozen: bool) -> None:
        """Freeze the picture, or let it move; refused unless it is on."""
        with self._guard:
            self._require_on()
            self._frozen = frozen

    def turn_speaker(self, step: int) -> None:
        """Turn the speaker by `step`, as far as it goes; refused unless it is on."""
        with self._guard:
            self._require_on()
            self.speaker = min(max(self.speaker + step, 0), MAX_VOLUME)

    def turn_microphone(self, step: int) -> None:
        """Turn the microphone by `step`, as far as it goes; refused unless it is on."""
        with self._guard:
            self._require_on()
            self.microphone = min(max(self.microphone + step, 0), MAX_VOLUME)

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault that has been injected and not repaired."""
        with self._guard:
            return tuple(Fault(part, self._faults[part]) for part in wire.FAULT_PARTS if part in self._faults)

    def lamps(self) -> tuple[Lamp, ...]:
        """Return its one lamp."""
        with self._guard:
            self._move()
            burning = self.clock.monotonic() - self._since if self._lit() else 0.0
            return (Lamp(int((self._lit_s + burning) / 3600.0), self._lit()),)

    def close(self) -> None:
        """Do nothing: it is the thing itself, not a connection to it."""

    def light(self) -> float:
        """Return the fraction of the full light that reaches the screen now, 0 … 1.

        0 when off, muted or with a dead lamp; rises in proportion to time while the lamp warms up.
        """
        with self._guard:
            self._move()
            if self._muted or not self._lit():
                return 0.0
            if self._power is Power.WARMING:
                return (self.clock.monotonic() - self._since) / self.traits.warm_up_s
            return 1.0

    def break_part(self, part: str, severity: Severity) -> None:
        """Inject a fault in one of `drivers.pjlink.wire.FAULT_PARTS`; an error of the lamp puts it out."""
        if part not in wire.FAULT_PARTS:
            raise ValueError(f"{part} is no part that can be reported; choose of {', '.join(wire.FAULT_PARTS)}")
        with self._guard:
            self._move()
            self._faults[part] = severity
            if part == "lamp" and severity is Severity.ERROR and self._power in (Power.ON, Power.WARMING):
                self._enter(Power.COOLING, self.clock.monotonic())

    def repair(self) -> None:
        """Take away every fault."""
        with self._guard:
            self._faults.clear()

    def _begin(self, change: Power, settled: Power, busy: str) -> None:
        self._move()
        if self._power is settled:
            return
        if self._power in (Power.WARMING, Power.COOLING):
            if self._power is change:
                busy = self._power.value
            raise DeviceRefused(f"the simulated projector is {busy}; wait until it is done")
        if change is Power.WARMING and self._faults.get("lamp") is Severity.ERROR:
            raise DeviceFault("the lamp of the simulated projector is dead; repair it")
        self._enter(change, self.clock.monotonic())

    def _require_on(self) -> None:
        self._move()
        if self._power is not Power.ON:
            raise DeviceRefused(f"the simulated projector is in {self._power.value}; wait until it is on")

    def _lit(self) -> bool:
        return self._power in (Power.ON, Power.WARMING)

    def _move(self) -> None:
        """Let the state follow the time that has passed."""
        passed = self.clock.monotonic() - self._since
        if self._power is Power.WARMING and passed >= self.traits.warm_up_s:
            self._enter(Power.ON, self._since + self.traits.warm_up_s)
        elif self._power is Power.COOLING and passed >= self.traits.cool_down_s:
            self._enter(Power.STANDBY, self._since + self.traits.cool_down_s)

    def _enter(self, power: Power, at: float) -> None:
        if self._lit():
            self._lit_s += at - self._since
        self._power = power
        self._since = at
        if power is Power.STANDBY:
            self._muted = False
            self._frozen = False


class PjLinkPeer:
    """The far side of one PJLink connection to a `SimulatedProjector`: bytes in, bytes out.

    Parameters
    ----------
    password
        Asked of every connection; None for a projector without one.
    seed
        Eight characters for the greeting; None draws new ones for each connection.
    """

    def __init__(self, projector: SimulatedProjector, password: str | None = None, seed: str | None = None) -> None:
        self._projector = projector
        self._password = password
        self._fixed_seed = seed
        self.connect()

    def connect(self) -> bytes:
        """Begin a new connection, forgetting the last, and return the greeting."""
        self._cutter = LineCutter(wire.MAX_LINE + wire.MAX_DIGEST)
        self._closed = False
        self._last_heard = self._projector.clock.monotonic()
        self._expected_digest = ""
        self._challenge = b""
        if self._password is None:
            return wire.encode_greeting(Greeting())
        seed = self._fixed_seed or secrets.token_hex(4)
        self._expected_digest = wire.authentication_digest(seed, self._password)
        return wire.encode_greeting(Greeting(seed))

    @property
    def closed(self) -> bool:
        """Whether it has hung up: after 30 s without a command, a wrong password, or something that is no line."""
        if self._projector.clock.monotonic() - self._last_heard >= wire.IDLE_LIMIT_S:
            self._closed = True
        return self._closed

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to the commands that they complete."""
        if self.closed:
            return b""
        answer = b""
        try:
            for line in self._cutter.feed(data):
                if wire.is_security_question(line) and self._expected_digest:
                    answer += self._security_answer()
                else:
                    reply = self._reply(wire.parse_request(line))
                    answer += wire.encode_reply(reply)
                    self._closed = isinstance(reply, Refused)
                if self._closed:
                    break
        except ProtocolError:
            self._closed = True
        self._last_heard = self._projector.clock.monotonic()
        return answer

    def _security_answer(self) -> bytes:
        if not self._projector.traits.sha256:
            # Whoever knows MD5 only takes this for a digest, and a wrong one.
            self._closed = True
            return wire.encode_reply(Refused.WRONG_PASSWORD)
        self._challenge = secrets.token_bytes(16)
        return wire.encode_challenge(self._challenge)

    def _proves_password(self, digest: str) -> bool:
        if not self._challenge:
            return digest == self._expected_digest
        try:
            nonce = bytes.fromhex(digest[:32])
        except ValueError:
            return False
        assert self._password is not None
        return len(nonce) == 16 and digest == wire.sha256_digest(self._challenge, nonce, self._password)

    def _reply(self, request: Request) -> Reply | Refused:
        if self._expected_digest:
            if not self._proves_password(request.digest):
                return Refused.WRONG_PASSWORD
            self._expected_digest = ""
        try:
            value = self._value(request) if request.level == 1 else self._class_2_value(request)
        except DeviceRefused:
            value = ErrorCode.UNAVAILABLE.value
        except DeviceFault:
            value = ErrorCode.FAILURE.value
        except ValueError:
            value = ErrorCode.OUT_OF_PARAMETER.value
        return Reply(request.command, value, request.level)

    def _value(self, request: Request) -> str:
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

    def _class_2_value(self, request: Request) -> str:
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


class Announcer:
    """What a `SimulatedProjector` of class 2 tells unasked: its start, then each change since somebody last looked."""

    def __init__(self, projector: SimulatedProjector) -> None:
        self._projector = projector
        self._told: dict[type[Notice], Notice] = self._state()
        self._begun = False

    def news(self) -> tuple[Notice, ...]:
        """Return what is to be told now."""
        if self._projector.traits.pjlink_class < 2:
            return ()
        begun, self._begun = self._begun, True
        if not begun:
            return (LinkUp(self._projector.traits.mac),)
        state = self._state()
        news = tuple(notice for kind, notice in state.items() if self._told.get(kind) != notice)
        self._told |= state
        return news

    def _state(self) -> dict[type[Notice], Notice]:
        projector = self._projector
        state: list[Notice] = [FaultsChanged(projector.faults()), PowerChanged(projector.power())]
        # In standby there is no input to tell of.
        with contextlib.suppress(DeviceRefused):
            state.append(InputChanged(projector.input()))
        return {type(notice): notice for notice in state}


def memory_link(peer: PjLinkPeer) -> Link:
    """Return a new connection to `peer` that needs no thread and never waits."""
    return PeerLink(peer)


def serve_pjlink(
    projector: SimulatedProjector, port: int = 0, password: str | None = None, host: str | None = None
) -> TcpServer:
    """Return a running server that speaks PJLink for `projector`; close it, or use it in a `with` block.

    Parameters
    ----------
    port
        0 picks a free one; the server's `address` tells which.
    host
        Where to listen; loopback unless given.

    Raises
    ------
    LinkClosed
        The port is taken.
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
                link.write(answer, wire.IDLE_LIMIT_S)

    return TcpServer(handle, port) if host is None else TcpServer(handle, port, host)


class ProjectorDatagrams:
    """The UDP side of a simulated projector, in threads of its own: answers searches, sends notices; close it.

    An answer goes to the port from which the question came, not always to 4352: here both may share one computer.

    Parameters
    ----------
    port
        Where it hears searches; 0 picks a free one, `address` tells which.
    controller
        To whom it sends notices, as a projector has it entered in its menu; None for nobody.

    Raises
    ------
    LinkClosed
        The port is taken.
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
        """Send what there is to tell now; nobody need call it, for it is done every half second."""
        with self._guard:
            if self._controller is None:
                return
            for notice in self._announcer.news():
                with contextlib.suppress(LinkClosed):
                    self._socket.send(notices.encode(notice), self._controller)

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
            if notices.is_search(datagram) and self._projector.traits.pjlink_class >= 2:
                with contextlib.suppress(LinkClosed):
                    self._socket.send(notices.encode(Found(self._projector.traits.mac)), sender)

    def _watch(self) -> None:
        while not self._closing.wait(WATCH_S):
            self.announce()
