"""Driver of all projectors with text commands; the commands and replies of a maker are in a `Language`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from drivers.links.link import POLL_S, Exchange, Link
from drivers.projector import Fault, Lamp, Power, Projector, ProjectorIdentity, Severity
from drivers.serial_projectors.language import (
    CHECK_SPEED,
    Language,
    Question,
    TextQuestion,
    answer_parser,
    encode_command,
    handshake_parser,
    match_value,
    refusal_kind,
    state_of,
)
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import RUN_AGAIN, DeviceFault, DeviceRefused, LinkTimeout, ProtocolError

_CABLE_REMEDY = (
    "check the cable (straight or null-modem, see its manual), the speed, and that control in standby is enabled"
)
_WAIT_REMEDY = f"wait until it is on, {RUN_AGAIN}"
_MANUAL_REMEDY = "use its remote control, or wait until it is on"


class _Unknown(DeviceRefused):
    """The projector does not support this command or query."""


class _Busy(DeviceRefused):
    """The projector cannot execute the command now."""


class _Unclear(DeviceRefused):
    """The projector does not support the command or cannot execute it now; the reply has both meanings."""


_REFUSALS = {"unknown": (_Unknown, _MANUAL_REMEDY), "busy": (_Busy, _WAIT_REMEDY), "unclear": (_Unclear, _WAIT_REMEDY)}


class LineProjector(Projector):
    """A `drivers.projector.Projector` with text commands; the connection is opened at its first use.

    All queries and commands may raise `DeviceRefused`, `DeviceFault`, `LinkError` and `ProtocolError`. A command may be
    repeated without harm. No power command is sent if the projector is already in the requested state or is changing to
    it. With `network`, a connection starts with the handshake of the language.
    """

    def __init__(
        self,
        language: Language,
        connect: Callable[[], Link],
        network: bool = False,
        label: str = "the projector",
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.label = label
        self._language = language
        self._handshake = language.network.handshake if network and language.network is not None else None
        self._clock = clock
        timeout = language.line.timeout_s
        self._exchange = Exchange(connect, timeout, label, clock, self._greet, _CABLE_REMEDY, CHECK_SPEED)
        # Power state that a command has started, if its reply is pending. The time limit is `_switch_deadline`.
        self._switching_to: Power | None = None
        self._switch_deadline = 0.0
        # Last state ON or STANDBY, last announced power state, announced faults, last mute command.
        self._stable_power: Power | None = None
        self._announced_power: Power | None = None
        self._announced_faults: tuple[str, ...] = ()
        self._mute_set: bool | None = None

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name; an empty text if the projector does not report the value."""
        language = self._language
        return ProjectorIdentity(language.maker, self._query_text(language.model), self._query_text(language.name))

    def power(self) -> Power:
        """Return the power state. Warm-up and cooling may be known only from a message or from our own command."""
        self._read_switch_reply()
        if self._switching_to is not None:
            return self._switching_to
        words = self._language.power
        try:
            value = self._query(words).upper()
        except _Busy as error:
            return self._transition_state(error)
        if stopped := state_of(words.stopped, value):
            raise DeviceFault(f"{self.label} answers {value} to {words.ask}: {stopped}")
        if (power := state_of(words.states, value)) is None:
            raise self._unexpected(words.ask, value, f"one of {', '.join((*words.states, *words.stopped))}")
        if power is Power.ON and self._announced_power is not Power.COOLING:
            self._announced_power = None
        power = self._announced_power or power
        if power in (Power.ON, Power.STANDBY):
            self._stable_power = power
        if power is Power.STANDBY:
            self._mute_set = None
        return power

    def switch_on(self) -> None:
        """Start to switch on; refused during cooling."""
        power = self.power()
        if power is Power.COOLING:
            raise DeviceRefused(f"{self.label} is cooling down; wait until it is in standby, {RUN_AGAIN}")
        if power is Power.STANDBY:
            self._switch(self._language.power.on, Power.WARMING)

    def switch_off(self) -> None:
        """Start to switch off; refused during warm-up."""
        power = self.power()
        if power is Power.WARMING:
            raise DeviceRefused(f"{self.label} is warming up; {_WAIT_REMEDY}")
        if power is Power.ON:
            self._switch(self._language.power.off, Power.COOLING)

    def muted(self) -> bool | None:
        """Return whether the image is muted; if not reported, the last command counts. None without a command."""
        reported = self._query_mute()
        return self._mute_set if reported is None else reported

    def _query_mute(self) -> bool | None:
        """Return the reported mute state, or the last command if the language has no query for it."""
        words = self._language.mute
        if not words.ask:
            return self._mute_set
        value = self._query_if_supported(Question(ask=words.ask, answer=words.answer))
        if value is None:
            return None
        if (is_muted := state_of(words.states, value)) is None:
            raise self._unexpected(words.ask, value, f"one of {', '.join(words.states)}")
        return is_muted

    def set_muted(self, muted: bool) -> None:
        """Mute the image or show it; refused unless the projector is on."""
        words = self._language.mute
        if words.only_changes and self._query_mute() is muted:
            return
        self._exchange_command(words.on if muted else words.off, (words.done,))
        self._mute_set = muted

    def faults(self) -> tuple[Fault, ...]:
        """Return all faults that are reported now, or that were announced since the start of the last warm-up.

        Empty if there are no faults, if the projector does not support the query, or if it refuses the query and is not
        in standby.
        """
        words = self._language.faults
        if words is None:
            # This raises an error if the cable is unplugged; otherwise this would look like "no faults".
            with contextlib.suppress(_Busy):
                self.power()
            if self._language.reports_unasked:
                self._discard_messages(POLL_S)
            return tuple(Fault(component, Severity.ERROR) for component in self._announced_faults)
        try:
            codes = self._query(words).upper().split()
        except _Unknown:
            return ()
        except DeviceRefused:
            if self.power() is Power.STANDBY:
                raise
            return ()
        if not codes or not all(map(words.is_valid, codes)):
            raise self._unexpected(words.ask, " ".join(codes), f"{words.healthy} or one of {', '.join(words.parts)}")
        components = dict.fromkeys(words.parts.get(code, "other") for code in codes if code != words.healthy.upper())
        return tuple(Fault(component, Severity.ERROR) for component in components)

    def lamps(self) -> tuple[Lamp, ...]:
        """Return all lamps; empty if the projector has no lamp or does not report lamp hours."""
        query = self._language.lamp_hours
        value = None if query is None else self._query_if_supported(query)
        if query is None or value is None:
            return ()
        hours = value.split()
        # The hours only inform, so a value that is no number must not end a run.
        if not all(number.isascii() and number.isdecimal() for number in hours):
            return ()
        is_lit = self.power() in (Power.ON, Power.WARMING)
        return tuple(Lamp(int(number), is_lit) for number in hours)

    def close(self) -> None:
        """Release the cable and keep the power state."""
        self._switching_to = None
        self._exchange.close()

    def _switch(self, command: str, next_power: Power) -> None:
        words = self._language.power
        if words.done_within_s:
            self._exchange.send(encode_command(self._language.line, command))
            self._switching_to = next_power
            self._switch_deadline = self._clock.monotonic() + words.done_within_s
            return
        self._exchange_command(command, (words.done,))
        if self._language.announces_power:
            self._announced_power = next_power

    def _transition_state(self, error: DeviceRefused) -> Power:
        if self._stable_power is None:
            busy_message = f"{self.label} is warming up or cooling down, and does not report which; wait two minutes"
            raise _Busy(busy_message) from error
        return Power.WARMING if self._stable_power is Power.STANDBY else Power.COOLING

    def _read_switch_reply(self) -> None:
        if self._switching_to is None:
            return
        words = self._language.power
        command = words.on if self._switching_to is Power.WARMING else words.off
        try:
            reply = self._next_reply(POLL_S)
        except BaseException:
            self._switching_to = None
            raise
        if reply is None:
            if self._clock.monotonic() >= self._switch_deadline:
                self.close()
                raise LinkTimeout(
                    f"{self.label} has not confirmed {command} within {words.done_within_s:g} s; "
                    "check its indicators and its cable"
                )
            return
        self._switching_to = None
        self._require_accepted(command, reply, f"check its indicators, {RUN_AGAIN}")

    def _query_text(self, query: TextQuestion | None) -> str:
        if query is None:
            return ""
        try:
            return query.shown.replace("{}", self._query(query))
        except DeviceRefused:
            return ""

    def _query_if_supported(self, query: Question) -> str | None:
        try:
            return self._query(query)
        except _Unknown:
            return None
        except _Unclear:
            # A projector that is on is not busy, so it does not support the query.
            if self.power() is Power.ON:
                return None
            raise

    def _query(self, query: Question) -> str:
        return self._exchange_command(query.ask, query.answer)

    def _exchange_command(self, text: str, answers: tuple[str, ...]) -> str:
        self._read_switch_reply()
        if self._switching_to is not None:
            raise DeviceRefused(f"{self.label} is busy ({self._switching_to.value}); wait until it has finished")
        if self._language.reports_unasked:
            # `Exchange.query` discards the input that has arrived. It may announce power or faults, so read it first.
            self._discard_messages(0.0)
        line = self._language.line
        # Some projectors confirm a query before they answer it (grapefrukt/esphome-optoma 3).
        confirmed = {done.upper() for done in (self._language.power.done, self._language.mute.done) if done}
        reply = self._exchange.query(
            encode_command(line, text),
            answer_parser(self._language, text),
            lambda message: (
                self._handle_unasked(message)
                or (message.upper() in confirmed and match_value(answers, message) is None)
            ),
        )
        self._require_accepted(text, reply)
        value = match_value(answers, reply)
        # Some projectors put a refusal in place of the value (arendst/Tasmota 15841).
        self._require_accepted(text, value or "")
        if value is None:
            self._exchange.close()
            raise self._unexpected(text, reply, f"{' or '.join(map(repr, answers))}; {CHECK_SPEED}")
        return value

    def _require_accepted(self, sent: str, reply: str, remedy: str = "") -> None:
        refusal = refusal_kind(self._language.refusals, reply)
        if refusal is not None:
            error_type, usual_remedy = _REFUSALS[refusal]
            raise error_type(f"{self.label} answers {reply} to {sent}; {remedy or usual_remedy}")

    def _discard_messages(self, wait: float) -> None:
        while self._next_reply(wait) is not None:
            pass

    def _next_reply(self, wait: float) -> str | None:
        parse = answer_parser(self._language)
        while (message := self._exchange.poll(parse, wait)) is not None:
            if not self._handle_unasked(message):
                return message
        return None

    def _handle_unasked(self, message: str) -> bool:
        unasked = self._language.match_unasked(message)
        if unasked is None:
            return False
        if unasked.power is not None:
            self._announced_power = None if unasked.power in (Power.STANDBY, Power.ON) else unasked.power
            self._announced_faults = () if unasked.power is Power.WARMING else self._announced_faults
        if unasked.fault is not None and unasked.fault not in self._announced_faults:
            self._announced_faults += (unasked.fault,)
        return True

    def _greet(self, exchange: Exchange) -> bytes:
        line = self._language.line
        if self._handshake is not None:
            state = exchange.open_with(self._handshake.send.encode("ascii"), handshake_parser(self._handshake))
            if state != self._handshake.accepted.upper():
                reason = self._handshake.refusals.get(state, "unknown reason; check the network settings of its menu")
                raise DeviceRefused(f"{self.label} refuses the connection with 0x{state}: {reason}")
        elif line.wake:
            try:
                exchange.open_with(line.wake.encode("ascii"), answer_parser(self._language), self._handle_unasked)
            except LinkTimeout as error:
                limit = self._language.power.done_within_s
                switching_hint = f"; if an earlier program switched it on or off, wait {limit:g} s" if limit else ""
                raise LinkTimeout(f"{error}{switching_hint}") from error
        return b""

    def _unexpected(self, query: str, answer: str, expected: str) -> ProtocolError:
        return ProtocolError(f"{self.label} answers {answer!r} to {query}, expected {expected}")
