"""Epson projectors: ESC/VP21 over a serial cable, or over TCP after the ESC/VP.net handshake.

Rules that hold inside:

- Every command ends with CR, every answer with a colon; ``ERR`` before the colon is a refusal. A CR alone is answered
  by the colon alone.
- One command at a time. ``PWR ON`` and ``PWR OFF`` are answered only when they are done, after up to 130 s: until then
  nothing else is asked, and `EpsonProjector.power` says what is under way.
- ``ERR`` means "not now" or "not known"; of a projector that is on, the latter: what it then does not answer it cannot
  tell.
- The language has no question for the model: `EpsonProjector.identity` gives the serial number as the name.

Source: Epson, ESC/VP21 Command User's Guide (PWR, SOURCE, MSEL, times, ERR). Not confirmed by a manual: the state 09,
the codes of ERR? (as other drivers have them), the events that newer projectors send unasked, the handshake's states.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from drivers.links.link import Exchange, quoted
from drivers.projector import Fault, Power, Severity
from drivers.serial_projectors.driver import CHECK_SPEED, SerialProjector, text_of
from foundation.errors import DeviceFault, DeviceRefused, LinkTimeout, ProtocolError

BAUD = 9600
"""With 8 data bits, no parity, 1 stop bit (ESC/VP21)."""
TCP_PORT = 3629
"""Port of ESC/VP.net (not confirmed by a manual: as other drivers have it)."""
SWITCHING_LIMIT_S = 130.0
"""Three attempts to strike the lamp, and the time for which an abnormal state lasts."""

HELLO = b"ESC/VP.net\x10\x03\x00\x00\x00\x00"
"""What opens a connection over TCP: name, version 1.0, the request to connect, no password."""
WELCOME = 0x20
"""State in the answer to `HELLO`: connected."""
_HELLO_STATES = {
    0x40: "a bad request",
    0x41: "a password is wanted; switch the password for network control off in its menu",
    0x43: "a wrong password; switch the password for network control off in its menu",
    0x45: "the request is not allowed",
    0x53: "it is busy; close the other controller",
    0x55: "this version of ESC/VP.net is not supported",
}

_POWERS = {
    "00": Power.STANDBY,
    "01": Power.ON,
    "02": Power.WARMING,
    "03": Power.COOLING,
    "04": Power.STANDBY,
    "09": Power.STANDBY,
}
_ABNORMAL = "05"
_POWER_CODES = {Power.STANDBY: "04", Power.ON: "01", Power.WARMING: "02", Power.COOLING: "03"}
_PARTS: Mapping[str, str] = {
    "01": "fan",
    "03": "lamp",
    "04": "temperature",
    "06": "lamp",
    "07": "cover",
    "08": "filter",
    "0D": "filter",
}
_FAULT_CODES = {"fan": "01", "lamp": "06", "temperature": "04", "cover": "07", "filter": "0D", "other": "0B"}
REFUSAL = "ERR"
_EVENT = "IMEVENT="


def encode_get(name: str) -> bytes:
    """Return the question after the value of `name`."""
    return f"{name}?\r".encode("ascii")


def encode_set(name: str, value: str) -> bytes:
    """Return the command that sets `name` to `value`."""
    return f"{name} {value}\r".encode("ascii")


def encode_reply(text: str = "") -> bytes:
    """Return the projector's answer; without a text, that a command is done."""
    return f"{text}\r:".encode("ascii") if text else b":"


def take_reply(data: bytes) -> tuple[str, int] | None:
    """Take one answer, without CR and colon, off the front of `data`; events sent unasked are passed over."""
    start = 0
    while (end := data.find(b":", start)) >= 0:
        text = text_of(data[start:end].strip(b"\r\n"))
        if not text.startswith(_EVENT):
            return text, end + 1
        start = end + 1
    # At the wrong speed a colon may never come; what stands there shows it earlier.
    text_of(data[start:].replace(b"\r", b"").replace(b"\n", b""))
    return None


def value_of(name: str, reply: str) -> str:
    """Return the value in the answer to the question after `name`."""
    if reply == REFUSAL:
        raise DeviceRefused(f"the projector answers ERR to {name}?; wait until its power is on and try again")
    found, equals, value = reply.partition("=")
    if not equals or found.strip() != name:
        raise ProtocolError(f"the projector answers {reply!r} to {name}?; expected {name}= and a value; {CHECK_SPEED}")
    return value.strip()


def encode_welcome(state: int = WELCOME) -> bytes:
    """Return the projector's answer to `HELLO`."""
    return HELLO[:14] + bytes([state, 0])


def take_welcome(data: bytes) -> tuple[int, int] | None:
    """Take the answer to `HELLO` off the front of `data` and return its state."""
    if not HELLO.startswith(data[:10]):
        raise ProtocolError(f"the projector greets with {quoted(data)}, not with ESC/VP.net; check the port")
    return None if len(data) < len(HELLO) else (data[14], len(HELLO))


def format_power(power: Power) -> str:
    """Return PWR's code; standby is the one in which the network is on."""
    return _POWER_CODES[power]


def parse_power(code: str) -> Power:
    """Return the power state of PWR's code."""
    if code == _ABNORMAL:
        raise DeviceFault("the projector answers PWR=05: it stopped itself; look at its indicators, unplug and plug it")
    if code not in _POWERS:
        raise ProtocolError(f"the projector answers PWR={code}; expected one of {', '.join(_POWERS)}, {_ABNORMAL}")
    return _POWERS[code]


def format_fault(part: str) -> str:
    """Return ERR's code for a faulty part; the language has neither warnings nor two faults at once."""
    return _FAULT_CODES[part]


def parse_faults(codes: str) -> tuple[Fault, ...]:
    """Return the faults of ERR's code or codes."""
    words = codes.upper().split()
    if not words or any(not re.fullmatch("[0-9A-F]{2}", word) for word in words):
        raise ProtocolError(f"the projector answers ERR={codes}; expected two hexadecimal digits")
    parts = dict.fromkeys(_PARTS.get(word, "other") for word in words if word != "00")
    return tuple(Fault(part, Severity.ERROR) for part in parts)


class EpsonProjector(SerialProjector):
    """A `drivers.projector.Projector` over ESC/VP21."""

    maker = "Epson"
    _under_way: Power | None = None
    _give_up_at = 0.0

    def name(self) -> str:
        """Return the serial number."""
        return self._get("SNO")

    def power(self) -> Power:
        """Return the power state now; while it carries out our own command, what that brings about."""
        self._take_late_answer()
        return self._under_way or parse_power(self._get("PWR"))

    def switch(self, on: bool) -> None:
        """Send the command that switches on or off, whose answer comes when that is done."""
        self.exchange.send(encode_set("PWR", "ON" if on else "OFF"))
        self._under_way = Power.WARMING if on else Power.COOLING
        self._give_up_at = self.clock.monotonic() + SWITCHING_LIMIT_S

    def muted(self) -> bool | None:
        """Return whether the picture is blanked by mute, None where it cannot tell; refused unless it is on."""
        value = self._get_if_known("MUTE")
        if value is None:
            return None
        if value not in ("ON", "OFF"):
            raise ProtocolError(f"{self.label} answers MUTE={value}; expected ON or OFF")
        return value == "ON"

    def set_muted(self, muted: bool) -> None:
        """Blank picture and sound, or show them; refused unless the projector is on."""
        self._require_idle()
        command = encode_set("MUTE", "ON" if muted else "OFF")
        reply = self.exchange.ask(command, take_reply)
        if reply == REFUSAL:
            raise DeviceRefused(f"{self.label} answers ERR to MUTE; wait until its power is on and try again")
        if reply:
            self.exchange.close()
            raise ProtocolError(f"{self.label} answers {reply!r} to MUTE; expected the colon alone")

    def faults(self) -> tuple[Fault, ...]:
        """Return the fault reported now; empty when healthy, and where it reports none, as in warm-up and cooling."""
        try:
            return parse_faults(self._get("ERR"))
        except DeviceRefused:
            if self.power() in (Power.WARMING, Power.COOLING, Power.ON):
                return ()
            raise

    def lamp_hours(self) -> tuple[int, ...]:
        """Return the hours of every lamp; empty where it has none, refused where it does not report them now."""
        value = self._get_if_known("LAMP")
        return () if value is None else self.hours_in("LAMP", value)

    def close(self) -> None:
        """Release the cable; the power state stays."""
        self._under_way = None
        super().close()

    def _take_late_answer(self) -> None:
        """Check whether the command under way has been carried out."""
        if self._under_way is None:
            return
        command = "PWR ON" if self._under_way is Power.WARMING else "PWR OFF"
        try:
            reply = self.exchange.poll(take_reply)
        except BaseException:
            self._under_way = None
            raise
        if reply is None:
            if self.clock.monotonic() >= self._give_up_at:
                self.close()
                raise LinkTimeout(
                    f"{self.label} has not carried out {command} within {SWITCHING_LIMIT_S:g} s; "
                    "look at its indicators and its cable"
                )
            return
        self._under_way = None
        if reply == REFUSAL:
            raise DeviceRefused(f"{self.label} answers ERR to {command}; look at its indicators and try again")

    def _require_idle(self) -> None:
        self._take_late_answer()
        if self._under_way is not None:
            raise DeviceRefused(f"{self.label} is busy with its {self._under_way.value}; wait until that is done")

    def _get(self, name: str) -> str:
        self._require_idle()
        reply = self.exchange.ask(encode_get(name), take_reply)
        try:
            return value_of(name, reply)
        except ProtocolError:
            self.exchange.close()
            raise

    def _get_if_known(self, name: str) -> str | None:
        """Return the value of `name`; None where a projector that is on refuses to tell it."""
        try:
            return self._get(name)
        except DeviceRefused:
            if self.power() is Power.ON:
                return None
            raise

    def greet(self, exchange: Exchange) -> bytes:
        """Say CR, whose colon shows that it listens, and which ends an incomplete command on the line."""
        try:
            exchange.open_with(b"\r", take_reply)
        except LinkTimeout as error:
            raise LinkTimeout(
                f"{error}; or it is still switching on or off for an earlier program: wait {SWITCHING_LIMIT_S:g} s"
            ) from error
        return b""


class EpsonOnNetwork(EpsonProjector):
    """The same after the handshake of ESC/VP.net."""

    def greet(self, exchange: Exchange) -> bytes:
        """Shake hands."""
        state = exchange.open_with(HELLO, take_welcome)
        if state != WELCOME:
            reason = _HELLO_STATES.get(state, "look into its network menu")
            raise DeviceRefused(f"{self.label} refuses the connection with {state:#04x}: {reason}")
        return b""
