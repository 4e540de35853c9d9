"""Plain colours from the test pattern generator of a TI LightCrafter 4500 (DLPC350), 6500 or 9000 (DLPC900).

The controller makes the colour itself, so no desktop, cable or scaler can change it. A report has 64 bytes: flags,
sequence number, length (u16), then `length` bytes, padded with zeros. To the device they begin with the command (u16)
and go on with its data; in an answer they are the data alone. All is little endian. After a fault of cable or protocol
the connection is dropped; the next `show` makes a new one and sets everything up again.

Not confirmed on hardware: the USB numbers of the DLPC900 boards, that the DLPC350 gives the pattern's colours back when
asked, and whether the pattern passes the degamma of video mode (`Colour` is then encoded as video is, otherwise linear:
photograph a ramp once, before a session counts on it). Killed without `close`, the projector goes on showing its last
colour: it needs no computer for that.

Sources: TI DLPU010 (DLPC350) and DLPU018 (DLPC900), the sections on USB transactions and on test patterns. Written
after public clients of both; not yet tried on hardware here.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from drivers.links.usb import HidDevice, open_hid
from drivers.presenter import BLACK, Colour
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import DeviceError, DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError

if TYPE_CHECKING:
    from usb.backend import IBackend


REPORT = 64
"""Bytes of a report, whatever it says (DLPU010, DLPU018: USB transactions)."""
MAX_DATA = REPORT - 6
"""What flags, sequence number, length and command leave of a report."""
FULL = 1023
"""The highest of the 10-bit codes of the test pattern."""

_READ, _REPLY, _ERROR = 0x80, 0x40, 0x20
"""Bits of the flags of a report: it reads, it is answered or is an answer, it is refused (same sources)."""


_REPLUG = "unplug its USB cable and put it back, or switch it off and on"


class LightCrafterCommand(IntEnum):
    """The commands that are used here."""

    TEST_PATTERN = 0x1203
    PATTERN_COLOUR = 0x1204
    INPUT_SOURCE = 0x1A00
    DISPLAY_MODE = 0x1A1B


SOURCE_TEST_PATTERN = 1
"""Value of INPUT_SOURCE: the internal test pattern (DLPU010, DLPU018: input source selection)."""
PATTERN_SOLID = 0
"""Value of TEST_PATTERN: a solid field (same sources: test pattern selection)."""
MODE_VIDEO = 0
"""Value of DISPLAY_MODE: the input is shown as it comes, not as a sequence of patterns (display mode selection)."""


@dataclass(frozen=True)
class LightCrafterRequest:
    """A report to the device."""

    sequence: int
    command: int
    data: bytes = b""
    reads: bool = False


@dataclass(frozen=True)
class LightCrafterReply:
    """A report from the device; `refused` where it does not know the command or its data."""

    sequence: int
    data: bytes = b""
    refused: bool = False


def encode_request(request: LightCrafterRequest) -> bytes:
    """Return the report of a request; every one asks for a reply."""
    flags = _REPLY | (_READ if request.reads else 0)
    head = struct.pack("<BBHH", flags, request.sequence, 2 + len(request.data), request.command)
    return (head + request.data).ljust(REPORT, b"\0")


def parse_request(report: bytes) -> LightCrafterRequest:
    """Return the request in a report."""
    flags, sequence, length, command = struct.unpack_from("<BBHH", _whole(report))
    if not 2 <= length <= 2 + MAX_DATA:
        raise ProtocolError(f"a request of {length} bytes; 2 … {2 + MAX_DATA} fit in a report")
    return LightCrafterRequest(sequence, command, report[6 : 4 + length], bool(flags & _READ))


def encode_reply(reply: LightCrafterReply, *, reads: bool) -> bytes:
    """Return the report of a reply to a request that `reads` or writes."""
    flags = _REPLY | (_READ if reads else 0) | (_ERROR if reply.refused else 0)
    return (struct.pack("<BBH", flags, reply.sequence, len(reply.data)) + reply.data).ljust(REPORT, b"\0")


def parse_reply(report: bytes) -> LightCrafterReply:
    """Return the reply in a report."""
    flags, sequence, length = struct.unpack_from("<BBH", _whole(report))
    if length > REPORT - 4:
        raise ProtocolError(
            f"the LightCrafter's report claims {length} bytes of data, at most {REPORT - 4} fit in it; {_REPLUG}"
        )
    return LightCrafterReply(sequence, report[4 : 4 + length], bool(flags & _ERROR))


def ten_bits(code: int) -> int:
    """Return the 10-bit code nearest to an 8-bit one, as a fraction of full: round(code · 1023 / 255).

    Every 8-bit code has its own 10-bit one; 0 is 0 and 255 is 1023.
    """
    return (code * FULL + 127) // 255


def eight_bits(code: int) -> int:
    """Return the 8-bit code nearest to a 10-bit one; undoes `ten_bits`."""
    return (code * 255 + FULL // 2) // FULL


def encode_colour(colour: Colour) -> bytes:
    """Return the data of `LightCrafterCommand.PATTERN_COLOUR`: foreground red, green, blue, and a black background."""
    return struct.pack("<6H", ten_bits(colour.red), ten_bits(colour.green), ten_bits(colour.blue), 0, 0, 0)


def parse_colour(data: bytes) -> tuple[int, int, int]:
    """Return the foreground in the data of `LightCrafterCommand.PATTERN_COLOUR`, 10 bits each."""
    if len(data) != 12:
        raise ProtocolError(f"the LightCrafter gives its colours in {len(data)} bytes, 12 expected; {_REPLUG}")
    codes = struct.unpack("<6H", data)
    if max(codes) > FULL:
        raise ProtocolError(f"the LightCrafter gives {codes} as its colours, 0 … {FULL} expected; {_REPLUG}")
    return codes[0], codes[1], codes[2]


def _whole(report: bytes) -> bytes:
    if len(report) != REPORT:
        raise ProtocolError(f"the LightCrafter's report has {len(report)} bytes, {REPORT} expected; {_REPLUG}")
    return report


VENDOR = 0x0451
"""USB vendor number of Texas Instruments."""
PRODUCTS = {"DLPC350": 0x6401, "DLPC900": 0xC900}
"""USB product numbers by controller."""
TIMEOUT_S = 2.0
"""For one report: chosen long beside what 64 bytes take on USB; not tried on hardware."""
SWITCHING_S = 3.0
"""How long the controller may take to change its mode; DLPC900 takes about 0.3 s."""

_LOOK_AGAIN_S = 0.05
"""Between questions whether a mode has been taken: some six of them in the 0.3 s that it takes."""
_STALE_REPLIES = 8
"""Replies to earlier questions that are skipped; more than a lost exchange leaves, and an end to reading."""
_SETTLED = (
    # What is set, to what, and which bits of the answer say so (the rest means other things).
    (LightCrafterCommand.TEST_PATTERN, PATTERN_SOLID, 0x0F),
    (LightCrafterCommand.INPUT_SOURCE, SOURCE_TEST_PATTERN, 0x07),
    (LightCrafterCommand.DISPLAY_MODE, MODE_VIDEO, 0x03),
)


def find_lightcrafter(serial: str | None = None, *, backend: IBackend | None = None) -> HidDevice:
    """Open the one LightCrafter on USB, of whatever kind; `serial` names one of several."""
    for controller, product in PRODUCTS.items():
        with contextlib.suppress(LinkClosed):
            return open_hid(VENDOR, product, name=f"LightCrafter {controller}", serial=serial, backend=backend)
    raise LinkClosed(
        f"no LightCrafter{f' with serial number {serial}' if serial else ''} on USB "
        f"({VENDOR:04x}:{' or '.join(f'{product:04x}' for product in PRODUCTS.values())}); "
        "switch it on, check its cable, and that libusb is installed"
    )


class LightCrafter:
    """A `drivers.presenter.Presenter`; black from the moment it opens."""

    def __init__(self, connect: Callable[[], HidDevice], clock: Clock = SYSTEM_CLOCK) -> None:
        self._connect = connect
        self._clock = clock
        self._reports: HidDevice | None = None
        self._sequence = 0
        self._open = True
        self.show(BLACK)

    def show(self, colour: Colour) -> None:
        """Fill the picture with exactly `colour`; returns when the controller confirms it."""
        if not self._open:
            raise DeviceError("the LightCrafter was closed; open the rig again")
        try:
            fresh = self._reports is None
            if self._reports is None:
                self._reports = self._connect()
            # The colour comes first, so that nothing else is seen when the generator is switched to.
            self._write(LightCrafterCommand.PATTERN_COLOUR, encode_colour(colour))
            if fresh:
                for command, value, _ in _SETTLED:
                    self._write(command, bytes([value]))
            self._confirm(colour)
        except (LinkError, ProtocolError):
            self._drop()
            raise

    def verify(self, colour: Colour) -> None:
        """Return if the controller generates exactly `colour` now; see `drivers.presenter.ReadsBack`."""
        if not self._open or self._reports is None:
            raise DeviceError("the LightCrafter was closed, or its cable was lost; show the colour again")
        try:
            fault = self._fault(colour)
        except (LinkError, ProtocolError):
            self._drop()
            raise
        if fault:
            raise DeviceError(f"the LightCrafter shows {fault}; close other control programs")

    def close(self) -> None:
        """Leave the picture black and release the cable; a second call does nothing."""
        if not self._open:
            return
        # What cannot be reached cannot be darkened either.
        with contextlib.suppress(DeviceError):
            self.show(BLACK)
        self._open = False
        self._drop()

    def _confirm(self, colour: Colour) -> None:
        deadline = self._clock.monotonic() + SWITCHING_S
        while True:
            reason = self._fault(colour)
            if not reason:
                return
            if self._clock.monotonic() > deadline:
                raise DeviceError(
                    f"the LightCrafter confirms {reason}; close other control programs, then switch it off and on"
                )
            self._clock.sleep(_LOOK_AGAIN_S)

    def _fault(self, colour: Colour) -> str:
        """Return what the controller does in place of showing a colour, empty where it shows it."""
        shown = parse_colour(self._read(LightCrafterCommand.PATTERN_COLOUR))
        expected = parse_colour(encode_colour(colour))
        return f"colour {shown} in place of {expected} of 1023" if shown != expected else self._unsettled()

    def _unsettled(self) -> str:
        for command, value, mask in _SETTLED:
            answer = self._read(command)
            if not answer:
                raise ProtocolError(f"the LightCrafter answers nothing to {command:#06x}; expected a byte")
            if answer[0] & mask != value:
                return f"{answer[0] & mask} in place of {value} for {command.name.lower().replace('_', ' ')}"
        return ""

    def _write(self, command: LightCrafterCommand, data: bytes) -> None:
        self._exchange(command, data, reads=False)

    def _read(self, command: LightCrafterCommand) -> bytes:
        return self._exchange(command, b"", reads=True)

    def _exchange(self, command: LightCrafterCommand, data: bytes, *, reads: bool) -> bytes:
        assert self._reports is not None
        self._sequence = (self._sequence + 1) % 256
        self._reports.write(encode_request(LightCrafterRequest(self._sequence, command, data, reads)), TIMEOUT_S)
        for _ in range(_STALE_REPLIES):
            reply = parse_reply(self._reports.read(TIMEOUT_S))
            if reply.sequence != self._sequence:
                continue
            if reply.refused:
                raise DeviceRefused(
                    f"{self._reports.label} refuses command {command:#06x} ({command.name.lower()}); "
                    "check that its firmware offers test patterns"
                )
            return reply.data
        raise LinkTimeout(f"{self._reports.label} answers other questions than ours; close other control programs")

    def _drop(self) -> None:
        reports, self._reports = self._reports, None
        if reports is not None:
            reports.close()
