"""The simulated projector: a lamp that takes its time, and a PJLink port that speaks for it.

Rules that hold inside:

- `SimulatedProjector` is physics and knows no bytes; `PjLinkPeer` is bytes and knows no physics.
- State moves with the time that is handed in, and only when somebody looks.
- What the world needs is `light`: how much of the full light reaches the screen now.
"""

from __future__ import annotations

import secrets
import threading
from dataclasses import dataclass

from drivers.clock import Clock
from drivers.errors import DeviceFault, DeviceRefused, LinkTimeout, ProtocolError
from drivers.link import Link
from drivers.links.memory import PeerLink
from drivers.links.tcp import TcpLink, TcpServer
from drivers.pjlink import wire
from drivers.pjlink.wire import ErrorCode, Greeting, LineCutter, Refused, Reply, Request
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity, Severity

WARM_UP_S = 30.0
COOL_DOWN_S = 60.0
IDENTITY = ProjectorIdentity("CroP", "Simulated Projector", "dark room")


@dataclass(frozen=True)
class ProjectorTraits:
    """What does not change about a simulated projector; `lamp_hours` is what its lamp has burnt at the start."""

    identity: ProjectorIdentity = IDENTITY
    warm_up_s: float = WARM_UP_S
    cool_down_s: float = COOL_DOWN_S
    lamp_hours: float = 120.0
    inputs: tuple[str, ...] = ("11", "31", "32")


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
            if code not in self.traits.inputs:
                raise ValueError(code)
            self._input = code

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
        self._cutter = LineCutter(wire.MAX_LINE + wire.DIGEST_LENGTH)
        self._closed = False
        self._last_heard = self._projector.clock.monotonic()
        self._expected_digest = ""
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
                reply = self._reply(wire.parse_request(line))
                answer += wire.encode_reply(reply)
                if isinstance(reply, Refused):
                    self._closed = True
                    break
        except ProtocolError:
            self._closed = True
        self._last_heard = self._projector.clock.monotonic()
        return answer

    def _reply(self, request: Request) -> Reply | Refused:
        if self._expected_digest:
            if request.digest != self._expected_digest:
                return Refused.WRONG_PASSWORD
            self._expected_digest = ""
        try:
            value = self._value(request)
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
            case _ if request.level != 1:
                return ErrorCode.UNDEFINED.value
            case "POWR", wire.QUERY:
                return wire.format_power(projector.power())
            case "POWR", "1":
                projector.switch_on()
            case "POWR", "0":
                projector.switch_off()
            case "INPT", wire.QUERY:
                return projector.input()
            case "INPT", code:
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
                return " ".join(projector.traits.inputs)
            case "NAME", wire.QUERY:
                return projector.identity().name
            case "INF1", wire.QUERY:
                return projector.identity().maker
            case "INF2", wire.QUERY:
                return projector.identity().model
            case "INFO", wire.QUERY:
                return "simulated"
            case "CLSS", wire.QUERY:
                return "1"
            case command, _ if command in _COMMANDS:
                return ErrorCode.OUT_OF_PARAMETER.value
            case _:
                return ErrorCode.UNDEFINED.value
        return wire.OK


_COMMANDS = ("POWR", "INPT", "AVMT", "ERST", "LAMP", "INST", "NAME", "INF1", "INF2", "INFO", "CLSS")


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
