"""The simulated projector behind a line protocol: the far end of any `Language`, bytes in and bytes out.

A cable has no connections: the projector goes on where it was when it is opened again, and forgets only a command that
has not ended. `receive` with no bytes returns what the projector has to send by now: a late answer, or news. If the
manuals leave open what a projector does, this one does what is harder for the driver: it is silent, or refuses.
"""

from __future__ import annotations

from drivers.projector import Power, Severity
from drivers.serial_projectors.language import Language, encode_answer
from foundation.errors import DeviceFault, DeviceRefused
from sim.projectors.projector import SimulatedProjector

_ON_THE_WAY = (Power.WARMING, Power.COOLING)


class LinePeer:
    """A projector that speaks a language; `network` if it is reached over TCP."""

    def __init__(self, projector: SimulatedProjector, language: Language, network: bool = False) -> None:
        self._projector = projector
        self._language = language
        self._network = network
        self._begin, end = (part.strip("\r\n") for part in language.line.command.split("{}"))
        self._end = end
        # CR by all makers; a language may end its commands with another character.
        self._last = language.line.command[-1:].encode("ascii")
        self._handshake = language.network.handshake if network and language.network is not None else None
        self._greeted = self._handshake is None
        self._heard = b""
        self._switching_to: Power | None = None
        self._sent_power = projector.power()
        self._sent_faults = self._errors()

    @property
    def closed(self) -> bool:
        """Never: a serial cable is not hung up."""
        return False

    def connect(self) -> bytes:
        """Forget a command that has not ended, and a handshake."""
        self._heard = b""
        self._greeted = self._handshake is None
        return b""

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to the lines that they complete, and the news."""
        said = self._late_answer()
        if self._switching_to is not None:
            # It accepts no command until it has carried out the one that it has.
            return said
        said += self._news()
        self._heard += data
        if not self._greeted:
            said += self._greet()
        while self._greeted and self._switching_to is None and (end := self._heard.find(self._last)) >= 0:
            line = self._heard[: end + 1].decode("ascii", "replace").strip()
            self._heard = self._heard[end + 1 :]
            said += self._answered(line) + self._news()
        return said

    def _greet(self) -> bytes:
        handshake = self._handshake
        if handshake is None or len(self._heard) < len(handshake.send):
            return b""
        hello = handshake.send.encode("ascii")
        self._greeted = self._heard.startswith(hello)
        self._heard = self._heard[len(hello) :]
        answer = bytearray(handshake.answer_begins.encode("ascii").ljust(handshake.answer_length, b"\0"))
        refused = next(iter(handshake.refusals), handshake.accepted)
        answer[handshake.state_at] = int(handshake.accepted if self._greeted else refused, 16)
        return bytes(answer)

    def _late_answer(self) -> bytes:
        if self._switching_to is None or (power := self._projector.power()) in _ON_THE_WAY:
            return b""
        reached = power is self._switching_to
        self._switching_to, self._heard = None, b""
        return self._encoded(self._done(power) if reached else self._refusal())

    def _news(self) -> bytes:
        """Return what is sent unasked about changes since this was called last."""
        power, faults = self._projector.power(), self._errors()
        begun = power if power is not self._sent_power else None
        failed = [part for part in faults if part not in self._sent_faults]
        self._sent_power, self._sent_faults = power, faults
        told = [
            message.text
            for message in self._language.unasked
            if message.fault in failed or (begun is not None and message.power is begun)
        ]
        return b"".join(self._encoded(text) for text in told)

    def _answered(self, line: str) -> bytes:
        language = self._language.line
        prompt = b"" if self._network else language.prompt.encode("ascii")
        if not line:
            return self._encoded("") + prompt if language.wake else prompt
        echo = line.encode("ascii", "replace") + b"\r\n" if language.echo and not self._network else b""
        answer = self._answer(line)
        return echo + (b"" if answer is None else self._encoded(answer)) + prompt

    def _answer(self, line: str) -> str | None:
        """Return what a line is answered; None if that comes later."""
        if not (line.startswith(self._begin) and line.endswith(self._end)):
            return self._refusal(known=False)
        try:
            return self._carried_out(line.removeprefix(self._begin).removesuffix(self._end).upper())
        except (DeviceRefused, DeviceFault):
            return self._refusal()
        except KeyError:
            return self._refusal(known=False)

    def _carried_out(self, text: str) -> str | None:
        """Return what a command or question is answered; a KeyError if the language does not have it."""
        language, projector = self._language, self._projector
        power = projector.power()
        words, mute = language.power, language.mute
        if text == words.ask.upper() and (words.value_of(power) or not language.refusals.busy):
            value = words.value_of(power) or words.value_of(Power.STANDBY) or ""
            return words.answer[0].replace("{}", value)
        if power in _ON_THE_WAY and (language.refusals.busy or language.refusals.unclear):
            raise DeviceRefused("busy")
        commands = {
            words.on.upper(): lambda: self._switch(Power.ON),
            words.off.upper(): lambda: self._switch(Power.STANDBY),
            mute.on.upper(): lambda: self._mute(True),
            mute.off.upper(): lambda: self._mute(False),
        }
        return commands[text]() if text in commands else self._told(text)

    def _told(self, text: str) -> str:
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
        """Return the code of the first faulty part: one fault at a time, and errors only."""
        words = self._language.faults
        assert words is not None
        for part in self._errors():
            for code, meaning in words.parts.items():
                if meaning == part:
                    return code
        return words.healthy

    def _errors(self) -> tuple[str, ...]:
        return tuple(fault.part for fault in self._projector.faults() if fault.severity is Severity.ERROR)

    def _refusal(self, known: bool = True) -> str:
        refusals = self._language.refusals
        first = refusals.busy if known else refusals.unknown
        return (*first, *refusals.unclear, *refusals.unknown, *refusals.busy)[0]

    def _encoded(self, text: str) -> bytes:
        return encode_answer(self._language.line, text)
