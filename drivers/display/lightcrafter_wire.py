"""The commands of TI's LightCrafter controllers as bytes: both ends of the cable, nothing but pure functions.

A report has 64 bytes: flags, sequence number, length (u16), then `length` bytes, padded with zeros. To the device they
begin with the command (u16) and go on with its data; in an answer they are the data alone. All is little endian.

Sources: TI DLPU010 (DLPC350) and DLPU018 (DLPC900), the sections on USB transactions and on test patterns. Written
after public clients of both; not yet tried on hardware here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from drivers.presenter import Colour
from foundation.errors import ProtocolError

REPORT = 64
"""Bytes of a report, whatever it says (DLPU010, DLPU018: USB transactions)."""
MAX_DATA = REPORT - 6
"""What flags, sequence number, length and command leave of a report."""
FULL = 1023
"""The highest of the 10-bit codes of the test pattern."""

_READ, _REPLY, _ERROR = 0x80, 0x40, 0x20
"""Bits of the flags of a report: it reads, it is answered or is an answer, it is refused (same sources)."""


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
        raise ProtocolError(f"a reply of {length} bytes; {REPORT - 4} fit in a report: {report.hex(' ')}")
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
    codes = struct.unpack("<6H", data) if len(data) == 12 else ()
    if not codes or max(codes) > FULL:
        raise ProtocolError(f"no colours in {data.hex(' ')!r}; expected six 10-bit codes in 12 bytes")
    return codes[0], codes[1], codes[2]


def _whole(report: bytes) -> bytes:
    if len(report) != REPORT:
        raise ProtocolError(f"a report of {len(report)} bytes; expected {REPORT}: {report.hex(' ')}")
    return report
