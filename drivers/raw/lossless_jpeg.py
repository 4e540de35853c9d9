"""Whether a lossless JPEG, in which CR2 and most DNG keep their pixels, decodes to the frame that it claims.

LibRaw decodes on behind damaged bytes: Huffman codes fall into step again by themselves, and all samples behind the
damage are shifted, or off by what the damaged differences add up to, without a word. So the stream is decoded here as
well. It must hold as many samples as its header says and end there, within its precision.

Source: ITU-T T.81 (ISO/IEC 10918-1), annexes B (markers), C and F (Huffman codes) and H (lossless mode).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy import int64, uint64

from foundation.compiled import compiled

# Markers (T.81, table B.1).
_SOI, _EOI, _SOF0, _SOF1, _SOF3, _DHT, _DQT, _DRI, _SOS = 0xD8, 0xD9, 0xC0, 0xC1, 0xC3, 0xC4, 0xDB, 0xDD, 0xDA

# Bytes behind the last sample that say nothing: some encoders write whole words. More are padding if all are alike.
_PADDING: Final = 4

# Zeros in a row that are no samples: where zero bits say other than "as before", a dozen steps would be alike.
_HOLE: Final = bytes(16)

_END: Final = bytes((0xFF, _EOI))

_WHOLE, _NO_CODE, _TOO_SHORT, _TOO_LONG, _OUT_OF_RANGE = range(5)
_REASONS: Final = {
    _NO_CODE: "has bits that are no code",
    _TOO_SHORT: "ends before its last sample",
    _TOO_LONG: "goes on behind its last sample",
    _OUT_OF_RANGE: "has samples beyond its precision",
}


@dataclass
class _Header:
    """What stands before the samples: `tables` by their number, (65536,) uint16 each, bits of the code · 256 + SSSS."""

    precision: int = 0
    rows: int = 0
    columns: int = 0
    components: tuple[int, ...] = ()
    plain: bool = True
    tables: dict[int, npt.NDArray[np.uint16]] = field(default_factory=dict[int, npt.NDArray[np.uint16]])
    used: tuple[int, ...] = ()
    predictor: int = 0
    transform: int = 0
    restart: bool = False
    start: int = 0


class JpegSize(NamedTuple):
    """What the frame header of a JPEG states: rows, samples in each, those of all `components`, and their bits."""

    rows: int
    columns: int
    components: int
    bits: int
    lossless: bool


def jpeg_size(stream: bytes | memoryview) -> JpegSize | None:
    """Return what a JPEG states of its frame, lossless or of a sequential DCT; None for anything else.

    Of a DCT are 8 or 12 bits that are quantised (T.81, tables B.2 and B.4); LibRaw leaves what is not as memory was.
    """
    found, quantised, at = None, False, 2
    while bytes(stream[:2]) == bytes((0xFF, _SOI)) and at + 10 <= len(stream) and stream[at] == 0xFF:
        marker, length = struct.unpack_from(">BH", stream, at + 1)
        if marker == _SOS:
            break
        if marker in (_SOF0, _SOF1, _SOF3) and found is None:
            bits, rows, columns, components = struct.unpack_from(">BHHB", stream, at + 4)
            found = JpegSize(rows, columns * components, components, bits, marker == _SOF3)
        quantised |= marker == _DQT
        at += 2 + length
    if found is None or found.lossless or (quantised and found.bits in (8, 12)):
        return found
    return None


def lossless_fault(stream: bytes | memoryview) -> str | None:
    """Return why a strip or tile that begins as a lossless JPEG is damaged; None where it is whole, or is no such.

    Not looked at: other processes than Huffman-coded lossless, and components of different sizes, as of Canon's small
    raw files, which are of no Bayer sensor.
    """
    try:
        header = _header(stream)
    except (struct.error, IndexError):
        return "its lossless JPEG has no samples behind its header"
    if header is None or not header.plain:
        return None
    unknown = [number for number in header.used if number not in header.tables]
    if unknown or not (1 <= header.predictor <= 7 and 2 <= header.precision <= 16 and header.used):
        return "its lossless JPEG has a header that no encoder writes"
    if header.transform or header.restart:
        return "its lossless JPEG has a point transform or restart intervals, which no maker of raw files uses"
    tables = np.stack([header.tables[number] for number in header.used])
    whole = bytes(stream)
    hole = whole.find(_HOLE, header.start, max(whole.find(_END, header.start), 0) or len(whole))
    if hole >= 0 and (tables[:, 0] & 255).all():
        return f"its lossless JPEG is damaged: it has nothing but zeros from its byte {hole} on"
    size, limit = (header.rows, header.columns), 1 << header.precision
    what, row = _decode(np.frombuffer(whole, np.uint8), header.start, tables, size, header.predictor, limit)
    return None if what == _WHOLE else f"its lossless JPEG is damaged: it {_REASONS[what]}, seen in row {row}"


def _header(stream: bytes | memoryview) -> _Header | None:
    """Return what the markers before the samples say; None where it is no stream that can be looked at."""
    if bytes(stream[:2]) != bytes((0xFF, _SOI)):
        return None
    found, at = _Header(), 2
    while True:
        if stream[at] != 0xFF:
            raise IndexError
        marker = stream[at + 1]
        (length,) = struct.unpack_from(">H", stream, at + 2)
        content = bytes(stream[at + 4 : at + 2 + length])
        at += 2 + length
        if marker == _SOF3:
            found.precision, found.rows, found.columns, count = struct.unpack_from(">BHHB", content)
            found.components = tuple(content[6 + 3 * number] for number in range(count))
            found.plain = all(content[7 + 3 * number] == 0x11 for number in range(count))
        elif 0xC0 <= marker <= 0xCF and marker != _DHT:
            return None
        elif marker == _DHT:
            _read_tables(content, found.tables)
        elif marker == _DRI:
            found.restart = any(content[:2])
        elif marker == _SOS:
            count = content[0]
            chosen = {content[1 + 2 * number]: content[2 + 2 * number] >> 4 for number in range(count)}
            found.predictor, found.transform = content[1 + 2 * count], content[3 + 2 * count] & 15
            found.start = at
            # A component that the scan leaves out has no table.
            found.used = tuple(chosen.get(component, -1) for component in found.components)
            return found


def _read_tables(content: bytes, tables: dict[int, npt.NDArray[np.uint16]]) -> None:
    """Add Huffman tables (T.81, B.2.4.2, with the codes of C.2) to those that are known."""
    while content:
        number, counts = content[0] & 15, content[1:17]
        values = content[17 : 17 + sum(counts)]
        content = content[17 + sum(counts) :]
        table, code = np.zeros(1 << 16, np.uint16), 0
        of = iter(values)
        for bits, count in enumerate(counts, 1):
            for _ in range(count):
                first = code << (16 - bits)
                table[first : first + (1 << (16 - bits))] = bits << 8 | next(of, 0)
                code += 1
            code <<= 1
        tables[number] = table


@compiled
def _decode(stream: Any, start: int, tables: Any, size: Any, predictor: int, limit: int) -> tuple[int, int]:
    """Decode a scan; return what is wrong with it, 0 if nothing, and the row where that was seen.

    `stream` (N,) uint8; `tables` (C, 65536) uint16, one for each component; `size`: rows and columns.
    """
    components, (rows, columns) = len(tables), size
    above, row = np.zeros((columns, components), int64), np.zeros((columns, components), int64)
    at, end, held, bits, missing = start, len(stream), uint64(0), 0, 0
    for y in range(rows):
        for x in range(columns):
            for component in range(components):
                while bits <= 48:
                    byte = 0xFF
                    if at + 1 < end and not (stream[at] == 0xFF and stream[at + 1] != 0):
                        byte = int64(stream[at])
                        at += 2 if byte == 0xFF else 1
                    else:
                        missing += 8
                    held = held << uint64(8) | uint64(byte)
                    bits += 8
                entry = int64(tables[component, int64(held >> uint64(bits - 16)) & 0xFFFF])
                length, more = entry >> 8, entry & 255
                if length == 0 or more > 16:
                    return 1, y
                bits -= length
                difference = int64(0)
                if more == 16:
                    difference = 32768
                elif more:
                    bits -= more
                    difference = int64(held >> uint64(bits)) & ((1 << more) - 1)
                    if difference < 1 << (more - 1):
                        difference -= (1 << more) - 1
                if bits < missing:
                    return 2, y
                if x == 0:
                    before = above[0, component] if y else limit >> 1
                elif y == 0 or predictor == 1:
                    before = row[x - 1, component]
                else:
                    left, up, corner = row[x - 1, component], above[x, component], above[x - 1, component]
                    before = _predicted(predictor, left, up, corner)
                sample = before + difference & 0xFFFF
                if sample >= limit:
                    return 4, y
                row[x, component] = sample
        above, row = row, above
    # What has been read ahead is given back; what is left of the last byte is padding, and so are a few more of it.
    left = (bits - missing) // 8
    first = int64(stream[at]) if at < end else -1
    while at + 1 < end and not (stream[at] == 0xFF and stream[at + 1] != 0):
        left += 1
        if left > _PADDING and int64(stream[at]) != first:
            return 3, rows - 1
        at += 1
    return 0, rows


@compiled
def _predicted(predictor: int, left: int, up: int, corner: int) -> int:
    """Return what a sample is predicted to be (T.81, table H.1)."""
    if predictor == 2:
        return up
    if predictor == 3:
        return corner
    if predictor == 4:
        return left + up - corner
    if predictor == 5:
        return left + (up - corner >> 1)
    if predictor == 6:
        return up + (left - corner >> 1)
    return left + up >> 1
