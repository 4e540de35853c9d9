"""PJLink protocol of the simulated projector, and a TCP server for it."""

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
    last_received_s: float  # Time of the last received data, by the clock of the projector
    received: bytes = b""  # Bytes of an incomplete line
    expected_digest: str = ""  # Digest of the password; empty if not required or already verified
    closed: bool = False  # Whether the projector closed the connection


class PjLinkPeer:
    """Projector end of a PJLink connection: it receives bytes and returns the bytes of its answers.

    `password`: required on each connection; None for no password. `seed`: the eight characters of the greeting; None
    for random characters.
    """

    def __init__(self, projector: SimulatedProjector, password: str | None = None, seed: str | None = None) -> None:
        self._projector = projector
        self._password = password
        self._fixed_seed = seed
        self._connection, _ = self._new_connection()
        self._classes = _class_1(projector), _class_2(projector)

    def connect(self) -> bytes:
        """Start a new connection that replaces the previous one, and return the greeting."""
        self._connection, greeting = self._new_connection()
        return greeting

    @property
    def closed(self) -> bool:
        """Whether the connection was closed, after 30 s without data, a wrong password or invalid bytes."""
        connection = self._connection
        if self._projector.clock.monotonic() - connection.last_received_s >= wire.IDLE_LIMIT_S:
            connection.closed = True
        return connection.closed

    def receive(self, data: bytes) -> bytes:
        """Process bytes and return the answers to complete commands."""
        if self.closed:
            return b""
        connection, answer = self._connection, b""
        connection.received += data
        if data:
            connection.last_received_s = self._projector.clock.monotonic()
        try:
            while not connection.closed and (next_line := wire.split_line(connection.received, _LONGEST)) is not None:
                line, length = next_line
                connection.received = connection.received[length:]
                reply = self._reply(wire.parse_request(line))
                answer += wire.encode_reply(reply)
                connection.closed = isinstance(reply, Refused)
        except ProtocolError:
            connection.closed = True
        return answer

    def _new_connection(self) -> tuple[_Connection, bytes]:
        now_s = self._projector.clock.monotonic()
        if self._password is None:
            return _Connection(now_s), wire.encode_greeting(None)
        seed = self._fixed_seed or secrets.token_hex(4)
        digest = wire.authentication_digest(seed, self._password)
        return _Connection(now_s, expected_digest=digest), wire.encode_greeting(seed)

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
        is_supported = request.level <= self._projector.traits.pjlink_class
        offered = self._classes[0 if request.level == 1 else 1]
        answers = offered.get(request.command) if is_supported else None
        if answers is None:
            return ErrorCode.UNDEFINED.value
        answer = answers.get(request.parameter.upper())
        if answer is None:
            return ErrorCode.OUT_OF_PARAMETER.value
        value = answer()
        return value if isinstance(value, str) else wire.OK


_LONGEST = wire.MAX_LINE + wire.DIGEST_LENGTH  # Length limit of the first command of a connection, bytes.
_INPUTS = tuple(source + number for source in "123456" for number in "123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ")
# Actions by command and parameter; each returns the value of the reply, None for OK.
_Answers = Mapping[str, Mapping[str, Callable[[], str | None]]]


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
        "INPT": _input_actions(projector, inputs),
        "AVMT": {
            wire.QUERY: lambda: wire.format_mute(projector.muted()),
            "11": mute,
            "31": mute,
            "10": show,
            "30": show,
            # Muting of sound only; the projector has no loudspeaker.
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
        "INPT": _input_actions(projector, _INPUTS),
        "INST": {wire.QUERY: lambda: " ".join(INPUTS)},
        "IRES": {wire.QUERY: lambda: wire.format_resolution(projector.input_resolution())},
        "FREZ": {
            wire.QUERY: lambda: wire.format_freeze(projector.frozen()),
            "0": lambda: projector.set_frozen(False),
            "1": lambda: projector.set_frozen(True),
        },
    }


def _input_actions(projector: SimulatedProjector, codes: Iterable[str]) -> dict[str, Callable[[], str | None]]:
    return {wire.QUERY: projector.input, **{code: partial(projector.set_input, code) for code in codes}}


def serve_pjlink(projector: SimulatedProjector, port: int = 0, password: str | None = None) -> TcpServer:
    """Return a running PJLink server of the projector; use it in a `with` block or close it."""
    return serve_peer(lambda: PjLinkPeer(projector, password), port)
