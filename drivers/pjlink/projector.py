"""A projector with a PJLink control port, as the suite's `Projector`.

Rules that hold inside:

- One connection at a time, opened when first needed: many projectors serve one controller only.
- Projectors hang up on an idle connection after about 30 s. A command that meets a connection so lost is sent once
  more over a new one; every command here may be repeated without harm.
- After a fault of cable or protocol the connection is dropped, so that a late answer never meets a later question.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.clock import Clock, SystemClock
from drivers.errors import DeviceFault, DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError
from drivers.link import Link
from drivers.pjlink import wire
from drivers.pjlink.wire import ErrorCode, LineCutter, Refused, Reply, Request
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity

DEFAULT_TIMEOUT_S = 5.0
"""The standard asks for an answer within 2 s; real projectors take longer while they warm up."""

_SYSTEM_CLOCK = SystemClock()


class _ConnectionSpent(Exception):
    """A connection that has served before serves no more; a new one may."""


class _Connection:
    """A greeted connection: the digest that its first command needs, and what was read beyond a line."""

    def __init__(self, link: Link, timeout: float, clock: Clock) -> None:
        self.link = link
        self.digest = ""
        self.used = False
        self._timeout = timeout
        self._clock = clock
        self._cutter = LineCutter()
        self._lines: list[bytes] = []

    def read_line(self) -> bytes:
        deadline = self._clock.monotonic() + self._timeout
        while not self._lines:
            remaining = deadline - self._clock.monotonic()
            if remaining <= 0:
                raise LinkTimeout(f"the projector has not finished its answer within {self._timeout:g} s")
            self._lines = self._cutter.feed(self.link.read(wire.MAX_LINE, remaining))
        return self._lines.pop(0)

    def ask(self, request: Request) -> Reply | Refused:
        # Whatever stands here unasked answers no question of ours.
        self._lines.clear()
        self.link.write(wire.encode_request(request), self._timeout)
        return wire.parse_reply(self.read_line())


class PjLinkProjector:
    """A `drivers.projector.Projector` over PJLink class 1.

    Parameters
    ----------
    connect
        Opens a new cable to the control port; called again after the projector hung up.
    password
        The PJLink password, None where the projector has none.
    timeout
        Seconds to wait for each answer.
    label
        What messages call it.
    clock
        Measures `timeout` across the pieces of an answer.
    """

    def __init__(
        self,
        connect: Callable[[], Link],
        password: str | None = None,
        timeout: float = DEFAULT_TIMEOUT_S,
        label: str = "the projector",
        clock: Clock = _SYSTEM_CLOCK,
    ) -> None:
        self._connect = connect
        self._password = password
        self._timeout = timeout
        self._label = label
        self._clock = clock
        self._connection: _Connection | None = None

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

    def muted(self) -> bool:
        """Return whether the picture is blanked by mute; refused unless the projector is on."""
        return wire.parse_mute(self._ask("AVMT"))

    def set_muted(self, muted: bool) -> None:
        """Blank picture and sound, or show them; refused unless the projector is on."""
        self._set("AVMT", wire.format_mute(muted))

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now; empty when healthy."""
        return wire.parse_faults(self._ask("ERST"))

    def lamps(self) -> tuple[Lamp, ...]:
        """Return every lamp; empty for a lampless projector, which does not know the question."""
        reply = self._exchange(Request("LAMP"))
        if reply.error is ErrorCode.UNDEFINED:
            return ()
        return wire.parse_lamps(self._value(reply))

    def close(self) -> None:
        """Hang up; the power state stays."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.link.close()

    def _name(self, command: str) -> str:
        reply = self._exchange(Request(command))
        return reply.value if reply.error is None else ""

    def _ask(self, command: str) -> str:
        return self._value(self._exchange(Request(command)))

    def _set(self, command: str, parameter: str) -> None:
        value = self._value(self._exchange(Request(command, parameter)), parameter)
        if value.upper() != wire.OK:
            self.close()
            raise ProtocolError(f"{self._label} answers {value!r} to {command} {parameter}; expected OK")

    def _value(self, reply: Reply, parameter: str = wire.QUERY) -> str:
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

    def _exchange(self, request: Request) -> Reply:
        """Return the answer to `request`, over a new connection if the one there is has been dropped meanwhile."""
        try:
            return self._exchange_once(request)
        except _ConnectionSpent:
            return self._exchange_once(request)

    def _exchange_once(self, request: Request) -> Reply:
        connection = self._connection
        if connection is None:
            connection = self._connection = self._greeted()
        used, connection.used = connection.used, True
        try:
            digest, connection.digest = connection.digest, ""
            reply = connection.ask(Request(request.command, request.parameter, request.level, digest))
            if isinstance(reply, Refused):
                if used:
                    # Some servers want the digest before every command: a new connection begins with one.
                    raise _ConnectionSpent
                raise self._wrong_password()
            if reply.command != request.command:
                raise ProtocolError(
                    f"{self._label} answers {reply.command} to {request.command}; check that no other controller "
                    "shares the connection"
                )
        except LinkClosed as error:
            self.close()
            if used:
                raise _ConnectionSpent from error
            raise
        except (LinkError, ProtocolError, DeviceRefused, _ConnectionSpent):
            self.close()
            raise
        return reply

    def _greeted(self) -> _Connection:
        link = self._connect()
        try:
            connection = _Connection(link, self._timeout, self._clock)
            greeting = wire.parse_greeting(connection.read_line())
            if isinstance(greeting, Refused):
                raise self._wrong_password()
            if greeting.seed is not None:
                if self._password is None:
                    raise DeviceRefused(f"{self._label} asks for a password; give the one set for PJLink in its menu")
                connection.digest = wire.authentication_digest(greeting.seed, self._password)
        except BaseException:
            link.close()
            raise
        return connection

    def _wrong_password(self) -> DeviceRefused:
        return DeviceRefused(f"{self._label} refuses the password; give the one set for PJLink in its menu")
