"""Simulated projector that is controlled by lines of text, in any `Language` of a maker.

A `LinePeer` is the projector end of a cable: it receives bytes and returns the bytes of its answers. A new connection
discards an incomplete command. If manuals are ambiguous, the projector refuses a command or does not answer, because
this tests a driver more strictly.
"""

from __future__ import annotations

from drivers.projector import Power, Severity
from drivers.serial_projectors.language import Language, encode_answer
from foundation.errors import DeviceFault, DeviceRefused
from sim.projectors.projector import SimulatedProjector

_TRANSITIONAL = (Power.WARMING, Power.COOLING)


class LinePeer:
    """Projector that uses a language; `network` is true for a TCP connection."""

    def __init__(self, projector: SimulatedProjector, language: Language, network: bool = False) -> None:
        self._projector = projector
        self._language = language
        self._network = network
        self._begin, end = (text.strip("\r\n") for text in language.line.command.split("{}"))
        self._end = end
        # Last character of a command, which is CR in the languages of all makers.
        self._last = language.line.command[-1:].encode("ascii")
        self._handshake = language.network.handshake if network and language.network is not None else None
        self._is_greeted = self._handshake is None
        self._received = b""
        self._switching_to: Power | None = None
        self._sent_power = projector.power()
        self._sent_faults = self._errors()

    @property
    def closed(self) -> bool:
        """False, because a projector does not disconnect a serial cable."""
        return False

    def connect(self) -> bytes:
        """Discard an incomplete command, and require a new handshake."""
        self._received = b""
        self._is_greeted = self._handshake is None
        return b""

    def receive(self, data: bytes) -> bytes:
        """Process bytes, of which there may be none; return answers to complete lines, and unsolicited messages."""
        answer = self._late_answer()
        if self._switching_to is not None:
            # The projector accepts no command before it has completed the current one.
            return answer
        answer += self._news()
        self._received += data
        if not self._is_greeted:
            answer += self._greet()
        while self._is_greeted and self._switching_to is None and (end := self._received.find(self._last)) >= 0:
            line = self._received[: end + 1].decode("ascii", "replace").strip()
            self._received = self._received[end + 1 :]
            answer += self._line_answer(line) + self._news()
        return answer

    def _greet(self) -> bytes:
        handshake = self._handshake
        if handshake is None or len(self._received) < len(handshake.send):
            return b""
        hello = handshake.send.encode("ascii")
        self._is_greeted = self._received.startswith(hello)
        self._received = self._received[len(hello) :]
        answer = bytearray(handshake.answer_begins.encode("ascii").ljust(handshake.answer_length, b"\0"))
        refused = next(iter(handshake.refusals), handshake.accepted)
        answer[handshake.state_at] = int(handshake.accepted if self._is_greeted else refused, 16)
        return bytes(answer)

    def _late_answer(self) -> bytes:
        if self._switching_to is None or (power := self._projector.power()) in _TRANSITIONAL:
            return b""
        reached = power is self._switching_to
        self._switching_to, self._received = None, b""
        return self._encode(self._done(power) if reached else self._refusal())

    def _news(self) -> bytes:
        """Return the unsolicited messages about changes since the last call."""
        power, faults = self._projector.power(), self._errors()
        new_power = power if power is not self._sent_power else None
        failed = [fault for fault in faults if fault not in self._sent_faults]
        self._sent_power, self._sent_faults = power, faults
        messages = [
            message.text
            for message in self._language.unasked
            if message.fault in failed or (new_power is not None and message.power is new_power)
        ]
        return b"".join(self._encode(text) for text in messages)

    def _line_answer(self, line: str) -> bytes:
        language = self._language.line
        prompt = b"" if self._network else language.prompt.encode("ascii")
        if not line:
            return self._encode("") + prompt if language.wake else prompt
        echo = line.encode("ascii", "replace") + b"\r\n" if language.echo and not self._network else b""
        answer = self._answer(line)
        return echo + (b"" if answer is None else self._encode(answer)) + prompt

    def _answer(self, line: str) -> str | None:
        """Return the answer to a line; None if it comes later."""
        if not (line.startswith(self._begin) and line.endswith(self._end)):
            return self._refusal(is_known=False)
        try:
            return self._carry_out(line.removeprefix(self._begin).removesuffix(self._end).upper())
        except (DeviceRefused, DeviceFault):
            return self._refusal()
        except KeyError:
            return self._refusal(is_known=False)

    def _carry_out(self, text: str) -> str | None:
        """Return the answer to a command or question; raise a KeyError if the language does not have it."""
        language, projector = self._language, self._projector
        power = projector.power()
        words, mute = language.power, language.mute
        if text == words.ask.upper() and (words.value_of(power) or not language.refusals.busy):
            value = words.value_of(power) or words.value_of(Power.STANDBY) or ""
            return words.answer[0].replace("{}", value)
        if power in _TRANSITIONAL and (language.refusals.busy or language.refusals.unclear):
            raise DeviceRefused("busy")
        commands = {
            words.on.upper(): lambda: self._switch(Power.ON),
            words.off.upper(): lambda: self._switch(Power.STANDBY),
            mute.on.upper(): lambda: self._mute(True),
            mute.off.upper(): lambda: self._mute(False),
        }
        return commands[text]() if text in commands else self._answer_question(text)

    def _answer_question(self, text: str) -> str:
        language, projector = self._language, self._projector
        identity = projector.identity()
        if language.mute.ask and text == language.mute.ask.upper():
            return language.mute.answer[0].replace("{}", language.mute.value_of(projector.muted()))
        values = (
            (language.faults, self._fault_code),
            (language.lamp_hours, lambda: " ".join(str(lamp.hours) for lamp in projector.lamps())),
            (language.model, lambda: identity.model),
            (language.name, lambda: identity.name),
        )
        for question, value in values:
            if question is not None and text == question.ask.upper():
                return question.answer[0].replace("{}", value())
        raise KeyError(text)

    def _switch(self, to: Power) -> str | None:
        if to is Power.ON:
            self._projector.switch_on()
        else:
            self._projector.switch_off()
        if self._language.power.done_within_s and self._projector.power() is not to:
            self._switching_to = to
            return None
        return self._done(to)

    def _mute(self, muted: bool) -> str:
        self._projector.set_muted(muted)
        words = self._language.mute
        return words.done.replace("{}", words.value_of(muted))

    def _done(self, power: Power) -> str:
        words = self._language.power
        return words.done.replace("{}", words.value_of(power) or "")

    def _fault_code(self) -> str:
        # The answer has room for one fault; warnings are not reported.
        words = self._language.faults
        assert words is not None
        for faulty_part in self._errors():
            for code, meaning in words.parts.items():
                if meaning == faulty_part:
                    return code
        return words.healthy

    def _errors(self) -> tuple[str, ...]:
        return tuple(fault.part for fault in self._projector.faults() if fault.severity is Severity.ERROR)

    def _refusal(self, is_known: bool = True) -> str:
        refusals = self._language.refusals
        first = refusals.busy if is_known else refusals.unknown
        return (*first, *refusals.unclear, *refusals.unknown, *refusals.busy)[0]

    def _encode(self, text: str) -> bytes:
        return encode_answer(self._language.line, text)
