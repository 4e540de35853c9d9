"""The simulated projector on a serial cable: one peer a language, bytes in and bytes out.

A cable has no connections: a peer goes on where it was when it is opened again, and forgets only a half-heard command.
`receive` with no bytes asks what a peer has to say by now: a late answer, or news. Where the manuals leave open what a
projector does, a peer does what is harder on the driver: it falls silent, or refuses.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from drivers.links.link import Peer
from drivers.projector import Power, Severity
from drivers.serial_projectors import benq, epson, optoma
from drivers.serial_projectors.driver import take_line
from foundation.errors import DeviceFault, DeviceRefused
from sim.projectors.projector import SimulatedProjector

SERIAL_NUMBER = "CROP0000001"

_ON_THE_WAY = (Power.WARMING, Power.COOLING)


class _Listener:
    """What all of them have: a projector, and what was heard of a command that is not whole yet."""

    def __init__(self, projector: SimulatedProjector) -> None:
        self._projector = projector
        self._heard = b""

    @property
    def closed(self) -> bool:
        """Never: a serial cable is not hung up."""
        return False

    def connect(self) -> bytes:
        """Forget a half-heard command."""
        self._heard = b""
        return b""


class EpsonPeer(_Listener):
    """An Epson: ESC/VP21, after the handshake of ESC/VP.net if `network` says so."""

    def __init__(self, projector: SimulatedProjector, network: bool = False) -> None:
        super().__init__(projector)
        self._network = network
        self._greeted = not network
        self._switching_to: Power | None = None

    def connect(self) -> bytes:
        """Forget a half-heard command, and that it has been greeted."""
        self._greeted = not self._network
        return super().connect()

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to them, and to what has been carried out by now."""
        said = self._late_answer()
        if self._switching_to is not None:
            # It accepts no command until it has carried out the one that it has.
            return said
        self._heard += data
        if not self._greeted:
            if len(self._heard) < len(epson.HELLO):
                return said
            self._greeted = self._heard.startswith(epson.HELLO)
            self._heard = self._heard[len(epson.HELLO) :]
            said += epson.encode_welcome(epson.WELCOME if self._greeted else 0x40)
        while self._switching_to is None and (taken := take_line(self._heard)) is not None:
            command, length = taken
            self._heard = self._heard[length:]
            said += self._answer(command)
        return said

    def _late_answer(self) -> bytes:
        if self._switching_to is None or (power := self._projector.power()) in _ON_THE_WAY:
            return b""
        reached = power is self._switching_to
        self._switching_to, self._heard = None, b""
        return epson.encode_reply("" if reached else epson.REFUSAL)

    def _answer(self, command: str) -> bytes:
        try:
            return self._done(command)
        except (DeviceRefused, DeviceFault, ValueError):
            return epson.encode_reply(epson.REFUSAL)

    def _done(self, command: str) -> bytes:
        projector = self._projector
        power = projector.power()
        match command.upper():
            case "":
                return epson.encode_reply()
            case "PWR?":
                return epson.encode_reply(f"PWR={epson.format_power(power)}")
            case _ if power in _ON_THE_WAY:
                raise DeviceRefused("busy")
            case "PWR ON":
                projector.switch_on()
                self._switching_to = Power.ON
                return self._late_answer()
            case "PWR OFF":
                projector.switch_off()
                self._switching_to = Power.STANDBY
                return self._late_answer()
            case "MUTE?":
                return epson.encode_reply(f"MUTE={'ON' if projector.muted() else 'OFF'}")
            case "MUTE ON":
                projector.set_muted(True)
            case "MUTE OFF":
                projector.set_muted(False)
            case "LAMP?":
                return epson.encode_reply("LAMP=" + " ".join(str(lamp.hours) for lamp in projector.lamps()))
            case "ERR?":
                errors = [fault for fault in projector.faults() if fault.severity is Severity.ERROR]
                code = epson.format_fault(errors[0].part) if errors else "00"
                return epson.encode_reply(f"ERR={code}")
            case "SNO?":
                return epson.encode_reply(f"SNO={SERIAL_NUMBER}")
            case _:
                raise ValueError(command)
        return epson.encode_reply()


class BenqPeer(_Listener):
    """A BenQ: it echoes what it hears and ends with a prompt, as on a serial cable; not so if `network` says so."""

    def __init__(self, projector: SimulatedProjector, network: bool = False) -> None:
        super().__init__(projector)
        self._network = network

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to the lines that they complete."""
        self._heard += data
        said = b""
        while (taken := take_line(self._heard)) is not None:
            line, length = taken
            self._heard = self._heard[length:]
            if line:
                echo = b"" if self._network else line.encode("ascii", "replace") + b"\r\n"
                said += echo + benq.encode_answer(self._answer(line))
            if not self._network:
                said += benq.PROMPT
        return said

    def _answer(self, line: str) -> str:
        name, equals, value = line.lower().removeprefix("*").removesuffix("#").partition("=")
        if not (line.startswith("*") and line.endswith("#") and equals):
            return benq.ILLEGAL
        try:
            return f"{name.upper()}={self._done(name, value)}"
        except (DeviceRefused, DeviceFault):
            return benq.BLOCKED
        except ValueError:
            return benq.UNSUPPORTED

    def _done(self, name: str, value: str) -> str:
        projector = self._projector
        if projector.power() in _ON_THE_WAY:
            raise DeviceRefused("busy")
        match name, value:
            case "pow", "?":
                return "ON" if projector.power() is Power.ON else "OFF"
            case "pow", "on":
                projector.switch_on()
            case "pow", "off":
                projector.switch_off()
            case "blank", "?":
                return "ON" if projector.muted() else "OFF"
            case "blank", "on" | "off":
                projector.set_muted(value == "on")
            case "ltim", "?":
                return str(projector.lamps()[0].hours)
            case "modelname", "?":
                return projector.identity().model
            case _:
                raise ValueError(name)
        return value.upper()


class OptomaPeer(_Listener):
    """An Optoma: it answers, and says unasked when its power state changes or a part fails."""

    MODEL = "1"

    def __init__(self, projector: SimulatedProjector, answers_mute: bool = True) -> None:
        super().__init__(projector)
        self._answers_mute = answers_mute
        self._sent_power = projector.power()
        self._sent_faults: frozenset[str] = frozenset()

    def receive(self, data: bytes) -> bytes:
        """Take the next bytes and return the answers to the lines that they complete, and the news."""
        said = self._news()
        self._heard += data
        while (taken := optoma.take_command(self._heard)) is not None:
            command, length = taken
            self._heard = self._heard[length:]
            if command is not None and command.projector == optoma.EVERYBODY:
                said += optoma.encode_message(self._answer(command)) + self._news()
        return said

    def _news(self) -> bytes:
        power = self._projector.power()
        broken = frozenset(fault.part for fault in self._projector.faults() if fault.severity is Severity.ERROR)
        news = [optoma.info_of_fault(part) for part in sorted(broken - self._sent_faults)]
        if power is not self._sent_power:
            news.append(optoma.info_of_power(power))
        self._sent_power, self._sent_faults = power, broken
        return b"".join(optoma.encode_message(info) for info in news if info is not None)

    def _answer(self, command: optoma.OptomaCommand) -> str:
        try:
            return self._done(command)
        except (DeviceRefused, DeviceFault, ValueError):
            return optoma.FAILED

    def _done(self, command: optoma.OptomaCommand) -> str:
        projector = self._projector
        match command.number, command.value:
            case optoma.POWER, "1":
                projector.switch_on()
            case optoma.POWER, "0" | "2":
                projector.switch_off()
            case optoma.AV_MUTE, "0" | "1" | "2":
                projector.set_muted(command.value == "1")
            case optoma.LAMP_HOURS, "1":
                return f"{optoma.ANSWER}{projector.lamps()[0].hours:04d}"
            case optoma.POWER_STATE, "1":
                return optoma.ANSWER + ("1" if projector.power() is Power.ON else "0")
            case optoma.MODEL, "1":
                return optoma.ANSWER + self.MODEL
            case optoma.AV_MUTE_STATE, "1" if self._answers_mute:
                return optoma.ANSWER + ("1" if projector.muted() else "0")
            case _:
                raise ValueError(command)
        return optoma.PASSED


class _PeerOf(Protocol):
    def __call__(self, projector: SimulatedProjector) -> Peer: ...


PEERS: Mapping[str, _PeerOf] = {"benq": BenqPeer, "epson": EpsonPeer, "optoma": OptomaPeer}
"""The far side for each of `drivers.serial_projectors.LANGUAGES`."""
