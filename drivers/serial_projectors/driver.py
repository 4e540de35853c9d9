"""The driver of all projectors that speak a line protocol: what is asked and sent is in their `Language`.

- A projector that cools down is not switched on, and one that warms up is not switched off; one that is in the wanted
  state, or on the way to it, is sent nothing.
- Every command may be repeated without harm (`drivers.links.link`).
- A question that the projector refuses though it is on is one that it does not know.
"""

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
    refusal_in,
    value_in,
)
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import DeviceFault, DeviceRefused, LinkTimeout, ProtocolError

_CHECK_CABLE = (
    "check the cable (straight or null-modem, as its manual says), the speed, and that it may be controlled in standby"
)
_WAIT = "wait until its power is on and try again"
_BY_HAND = "do it with its remote control, or try again when its power is on"


class _Unknown(DeviceRefused):
    """The projector does not have this command or question."""


class _Busy(DeviceRefused):
    """The projector cannot carry it out now."""


class _Unclear(DeviceRefused):
    """The projector does not have it, or cannot carry it out now."""


_REFUSED = {"unknown": (_Unknown, _BY_HAND), "busy": (_Busy, _WAIT), "unclear": (_Unclear, _WAIT)}


class LineProjector(Projector):
    """A `drivers.projector.Projector` that speaks a line protocol; nothing is opened before its first use.

    Every question and command may raise `DeviceRefused`, `DeviceFault`, `LinkError` and `ProtocolError`.

    `network`: whether the connection is one over TCP, and begins as the language says.
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
        self._exchange = Exchange(connect, timeout, label, clock, self._greet, _CHECK_CABLE, CHECK_SPEED)
        # A command to switch whose answer is to come, and until when.
        self._under_way: Power | None = None
        self._give_up_at = 0.0
        # What was seen, announced or set last.
        self._settled: Power | None = None
        self._announced: Power | None = None
        self._failed: tuple[str, ...] = ()
        self._muted: bool | None = None

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name; empty what the projector does not report."""
        language = self._language
        return ProjectorIdentity(language.maker, self._text(language.model), self._text(language.name))

    def power(self) -> Power:
        """Return the power state now; what the language does not report, by what was seen, announced or sent last."""
        self._take_late_answer()
        if self._under_way is not None:
            return self._under_way
        words = self._language.power
        try:
            value = self._value(words).upper()
        except _Busy as error:
            return self._state_between(error)
        if value in words.stopped:
            raise DeviceFault(f"{self.label} answers {value} to {words.ask}: {words.stopped[value]}")
        if value not in words.states:
            raise self._unexpected(words.ask, value, f"one of {', '.join((*words.states, *words.stopped))}")
        power = words.states[value]
        if power is Power.ON and self._announced is not Power.COOLING:
            self._announced = None
        power = self._announced or power
        if power in (Power.ON, Power.STANDBY):
            self._settled = power
        if power is Power.STANDBY:
            self._muted = None
        return power

    def switch_on(self) -> None:
        """Begin to switch on; refused while it cools down."""
        power = self.power()
        if power is Power.COOLING:
            raise DeviceRefused(f"{self.label} is cooling down; wait until it is in standby and try again")
        if power is Power.STANDBY:
            self._switch(self._language.power.on, Power.WARMING)

    def switch_off(self) -> None:
        """Begin to switch off; refused while it warms up."""
        power = self.power()
        if power is Power.WARMING:
            raise DeviceRefused(f"{self.label} is warming up; wait until it is on and try again")
        if power is Power.ON:
            self._switch(self._language.power.off, Power.COOLING)

    def muted(self) -> bool | None:
        """Return whether the picture is hidden; what was set last if the projector cannot tell, None before that."""
        told = self._mute_told()
        return self._muted if told is None else told

    def _mute_told(self) -> bool | None:
        """Return whether it answers that the picture is hidden; without such a question, what was set last."""
        words = self._language.mute
        if not words.ask:
            return self._muted
        value = self._value_if_known(Question(ask=words.ask, answer=words.answer))
        if value is None:
            return None
        if value.upper() not in words.states:
            raise self._unexpected(words.ask, value, f"one of {', '.join(words.states)}")
        return words.states[value.upper()]

    def set_muted(self, muted: bool) -> None:
        """Hide the picture, or show it; refused unless the projector is on."""
        words = self._language.mute
        if words.only_changes and self._mute_told() is muted:
            return
        self._exchanged(words.on if muted else words.off, (words.done,))
        self._muted = muted

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now, or announced since the lamp was struck last.

        Empty if the projector is healthy, if its language has no faults, and if it does not report them now though it
        is not in standby.
        """
        words = self._language.faults
        if words is None:
            # To be silent because the cable is out must not look like health.
            with contextlib.suppress(_Busy):
                self.power()
            if self._language.has_news:
                self._pass_over(POLL_S)
            return tuple(Fault(part, Severity.ERROR) for part in self._failed)
        try:
            codes = self._value(words).upper().split()
        except _Unknown:
            return ()
        except DeviceRefused:
            if self.power() is Power.STANDBY:
                raise
            return ()
        if not codes or not all(map(words.may_be, codes)):
            raise self._unexpected(words.ask, " ".join(codes), f"{words.healthy} or one of {', '.join(words.parts)}")
        parts = dict.fromkeys(words.parts.get(code, "other") for code in codes if code != words.healthy.upper())
        return tuple(Fault(part, Severity.ERROR) for part in parts)

    def lamps(self) -> tuple[Lamp, ...]:
        """Return every lamp; empty for a lampless projector, and for one that does not count hours."""
        question = self._language.lamp_hours
        value = None if question is None else self._value_if_known(question)
        if question is None or value is None:
            return ()
        hours = value.split()
        if not hours or not all(word.isascii() and word.isdecimal() for word in hours):
            raise self._unexpected(question.ask, value, "hours")
        lit = self.power() in (Power.ON, Power.WARMING)
        return tuple(Lamp(int(word), lit) for word in hours)

    def close(self) -> None:
        """Release the cable; the power state stays."""
        self._under_way = None
        self._exchange.close()

    def _switch(self, command: str, begins: Power) -> None:
        words = self._language.power
        if words.done_within_s:
            self._exchange.send(encode_command(self._language.line, command))
            self._under_way = begins
            self._give_up_at = self._clock.monotonic() + words.done_within_s
            return
        self._exchanged(command, (words.done,))
        if self._language.announces_power:
            self._announced = begins

    def _state_between(self, error: DeviceRefused) -> Power:
        if self._settled is None:
            unclear = f"{self.label} is warming up or cooling down, and does not report which; wait two minutes"
            raise _Busy(unclear) from error
        return Power.WARMING if self._settled is Power.STANDBY else Power.COOLING

    def _take_late_answer(self) -> None:
        if self._under_way is None:
            return
        words = self._language.power
        command = words.on if self._under_way is Power.WARMING else words.off
        try:
            reply = self._next_answer(POLL_S)
        except BaseException:
            self._under_way = None
            raise
        if reply is None:
            if self._clock.monotonic() >= self._give_up_at:
                self.close()
                raise LinkTimeout(
                    f"{self.label} has not carried out {command} within {words.done_within_s:g} s; "
                    "look at its indicators and its cable"
                )
            return
        self._under_way = None
        self._require_accepted(command, reply, "look at its indicators and try again")

    def _text(self, question: TextQuestion | None) -> str:
        if question is None:
            return ""
        try:
            return question.shown.replace("{}", self._value(question))
        except DeviceRefused:
            return ""

    def _value_if_known(self, question: Question) -> str | None:
        """Return the value that a question is answered; None if the projector does not know the question."""
        try:
            return self._value(question)
        except _Unknown:
            return None
        except _Unclear:
            if self.power() is Power.ON:
                return None
            raise

    def _value(self, question: Question) -> str:
        return self._exchanged(question.ask, question.answer)

    def _exchanged(self, text: str, answers: tuple[str, ...]) -> str:
        self._take_late_answer()
        if self._under_way is not None:
            raise DeviceRefused(f"{self.label} is busy with its {self._under_way.value}; wait until that is done")
        if self._language.has_news:
            # What waits is thrown away when a question is asked; here it may be news.
            self._pass_over(0.0)
        line = self._language.line
        reply = self._exchange.ask(encode_command(line, text), answer_parser(self._language, text), self._take_unasked)
        self._require_accepted(text, reply)
        value = value_in(answers, reply)
        if value is None:
            self._exchange.close()
            raise self._unexpected(text, reply, f"{' or '.join(map(repr, answers))}; {CHECK_SPEED}")
        return value

    def _require_accepted(self, sent: str, reply: str, remedy: str = "") -> None:
        refusal = refusal_in(self._language.refusals, reply)
        if refusal is not None:
            kind, usual = _REFUSED[refusal]
            raise kind(f"{self.label} answers {reply} to {sent}; {remedy or usual}")

    def _pass_over(self, wait: float) -> None:
        while self._next_answer(wait) is not None:
            pass

    def _next_answer(self, wait: float) -> str | None:
        """Return the next message that answers something, None if none comes within `wait` seconds."""
        take = answer_parser(self._language)
        while (message := self._exchange.poll(take, wait)) is not None:
            if not self._take_unasked(message):
                return message
        return None

    def _take_unasked(self, message: str) -> bool:
        unasked = self._language.unasked_in(message)
        if unasked is None:
            return False
        if unasked.power is not None:
            self._announced = None if unasked.power in (Power.STANDBY, Power.ON) else unasked.power
            self._failed = () if unasked.power is Power.WARMING else self._failed
        if unasked.fault is not None and unasked.fault not in self._failed:
            self._failed += (unasked.fault,)
        return True

    def _greet(self, exchange: Exchange) -> bytes:
        line = self._language.line
        if self._handshake is not None:
            state = exchange.open_with(self._handshake.send.encode("ascii"), handshake_parser(self._handshake))
            if state != self._handshake.accepted.upper():
                reason = self._handshake.refusals.get(state, "check the network settings in the projector's menu")
                raise DeviceRefused(f"{self.label} refuses the connection with 0x{state}: {reason}")
        elif line.wake:
            try:
                exchange.open_with(line.wake.encode("ascii"), answer_parser(self._language), self._take_unasked)
            except LinkTimeout as error:
                limit = self._language.power.done_within_s
                late = f"; or it is still switching on or off for an earlier program: wait {limit:g} s" if limit else ""
                raise LinkTimeout(f"{error}{late}") from error
        return b""

    def _unexpected(self, question: str, answer: str, expected: str) -> ProtocolError:
        return ProtocolError(f"{self.label} answers {answer!r} to {question}; expected {expected}")
