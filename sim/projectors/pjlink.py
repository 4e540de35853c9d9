"""PJLink for the simulated projector: the far side of a connection, and a TCP port that speaks for it."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

from drivers import pjlink as wire
from drivers.links.network import TcpServer, serve_peer
from drivers.pjlink import ErrorCode, PjLinkReply, PjLinkRequest, Refused
from foundation.errors import DeviceFault, DeviceRefused, ProtocolError
from sim.projectors.projector import INPUTS, SimulatedProjector


@dataclass
class _Connection:
    """One connection.

    - `heard`: of a line that is not whole yet.
    - `last_heard`: when the last command came, by the projector's clock, seconds.
    - `expected_digest`: what proves the password; empty where none is wanted, or it has been proved.
    - `closed`: whether the projector has hung up.
    """

    last_heard: float
    heard: bytes = b""
    expected_digest: str = ""
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
        self._classes = _class_1(projector), _class_2(projector)

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
        connection.heard += data
        if data:
            connection.last_heard = self._projector.clock.monotonic()
        try:
            while not connection.closed and (taken := wire.split_line(connection.heard, _LONGEST)) is not None:
                line, length = taken
                connection.heard = connection.heard[length:]
                reply = self._reply(wire.parse_request(line))
                answer += wire.encode_reply(reply)
                connection.closed = isinstance(reply, Refused)
        except ProtocolError:
            connection.closed = True
        return answer

    def _begun(self) -> tuple[_Connection, bytes]:
        now = self._projector.clock.monotonic()
        if self._password is None:
            return _Connection(now), wire.encode_greeting(None)
        seed = self._fixed_seed or secrets.token_hex(4)
        digest = wire.authentication_digest(seed, self._password)
        return _Connection(now, expected_digest=digest), wire.encode_greeting(seed)

    def _reply(self, request: PjLinkRequest) -> PjLinkReply | Refused:
        if self._connection.expected_digest:
            if request.digest != self._connection.expected_digest:
                return Refused.WRONG_PASSWORD
            self._connection.expected_digest = ""
        try:
            value = self._value(request)
        except DeviceRefused:
            value = ErrorCode.UNAVAILABLE.value
        except DeviceFault:
            value = ErrorCode.FAILURE.value
        except ValueError:
            value = ErrorCode.OUT_OF_PARAMETER.value
        return PjLinkReply(request.command, value, request.level)

    def _value(self, request: PjLinkRequest) -> str:
        known = request.level <= self._projector.traits.pjlink_class
        offered = self._classes[0 if request.level == 1 else 1]
        answers = offered.get(request.command) if known else None
        if answers is None:
            return ErrorCode.UNDEFINED.value
        answer = answers.get(request.parameter.upper())
        if answer is None:
            return ErrorCode.OUT_OF_PARAMETER.value
        value = answer()
        return value if isinstance(value, str) else wire.OK


_LONGEST = wire.MAX_LINE + wire.DIGEST_LENGTH  # Bytes of a connection's first command
_INPUTS = tuple(kind + number for kind in "123456" for number in "123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ")
_Answers = Mapping[str, Mapping[str, Callable[[], str | None]]]  # Command to parameter to what is done; None is OK


def _class_1(projector: SimulatedProjector) -> _Answers:
    inputs = [code for code in _INPUTS if wire.is_class_1_input(code)]
    offered = [code for code in INPUTS if wire.is_class_1_input(code)]
    mute, show = lambda: projector.set_muted(True), lambda: projector.set_muted(False)
    return {
        "POWR": {
            wire.QUERY: lambda: wire.format_power(projector.power()),
            "1": projector.switch_on,
            "0": projector.switch_off,
        },
        "INPT": _selecting(projector, inputs),
        "AVMT": {
            wire.QUERY: lambda: wire.format_mute(projector.muted()),
            "11": mute,
            "31": mute,
            "10": show,
            "30": show,
            # It has no loudspeaker.
            "20": lambda: None,
            "21": lambda: None,
        },
        "ERST": {wire.QUERY: lambda: wire.format_faults(projector.faults())},
        "LAMP": {wire.QUERY: lambda: wire.format_lamps(projector.lamps())},
        "INST": {wire.QUERY: lambda: " ".join(offered)},
        "NAME": {wire.QUERY: lambda: projector.identity().name},
        "INF1": {wire.QUERY: lambda: projector.identity().maker},
        "INF2": {wire.QUERY: lambda: projector.identity().model},
        "CLSS": {wire.QUERY: lambda: str(projector.traits.pjlink_class)},
    }


def _class_2(projector: SimulatedProjector) -> _Answers:
    return {
        "INPT": _selecting(projector, _INPUTS),
        "INST": {wire.QUERY: lambda: " ".join(INPUTS)},
        "IRES": {wire.QUERY: lambda: wire.format_resolution(projector.input_resolution())},
        "FREZ": {
            wire.QUERY: lambda: wire.format_freeze(projector.frozen()),
            "0": lambda: projector.set_frozen(False),
            "1": lambda: projector.set_frozen(True),
        },
    }


def _selecting(projector: SimulatedProjector, codes: Iterable[str]) -> dict[str, Callable[[], str | None]]:
    return {wire.QUERY: projector.input, **{code: partial(projector.set_input, code) for code in codes}}


def serve_pjlink(projector: SimulatedProjector, port: int = 0, password: str | None = None) -> TcpServer:
    """Return a running server that speaks PJLink for `projector`; close it, or use it in a `with` block."""
    return serve_peer(lambda: PjLinkPeer(projector, password), port)
