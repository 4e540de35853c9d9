"""Check whether lossless JPEG streams, which hold the counts in CR2 and most DNG files, are intact.

LibRaw does not report a damaged stream. Huffman codes synchronise again after the damage, but all later samples have a
wrong position or value. Therefore the stream is also decoded here. It must hold as many samples as its header states,
end after the last one, and have no sample above its precision.

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

# Number of bytes after the last sample that are ignored, because some encoders write whole words. More bytes are
# ignored only if all are equal.
_PADDING: Final = 4

# Series of zero bytes. If zero bits are the code of a difference, the series is damage, because a dozen samples never
# change by equal steps.
_GAP: Final = bytes(16)

_END: Final = bytes((0xFF, _EOI))

# Results of `_decode`.
_INTACT, _NO_CODE, _TOO_SHORT, _TOO_LONG, _OUT_OF_RANGE = range(5)
_REASONS: Final = {
    _NO_CODE: "has bits that are no Huffman code",
    _TOO_SHORT: "ends before its last sample",
    _TOO_LONG: "continues after its last sample",
    _OUT_OF_RANGE: "has samples above its precision",
}


@dataclass
class _Header:
    """Header of a stream.

    `tables`: Huffman tables, (65536,) uint16. The next 16 bits of the stream give an element. Its high byte is the
    length of the code, and its low byte the number of bits of the difference (SSSS).
    """

    precision: int = 0
    rows: int = 0
    columns: int = 0
    components: tuple[int, ...] = ()
    is_supported: bool = True
    tables: dict[int, npt.NDArray[np.uint16]] = field(default_factory=dict[int, npt.NDArray[np.uint16]])
    table_numbers: tuple[int, ...] = ()
    predictor: int = 0
    transform: int = 0
    restart: bool = False
    start: int = 0


class JpegSize(NamedTuple):
    """Frame header of a JPEG: rows, samples per row (`columns`, of all components together), and bits per sample."""

    rows: int
    columns: int
    components: int
    bits: int
    lossless: bool


def jpeg_size(stream: bytes | memoryview) -> JpegSize | None:
    """Return the frame header of a lossless or sequential DCT JPEG; None for other streams.

    A DCT stream must have 8 or 12 bits and quantisation tables (T.81, tables B.2 and B.4). For other DCT streams,
    LibRaw returns memory that was never set.
    """
    size, is_quantised, position = None, False, 2
    while bytes(stream[:2]) == bytes((0xFF, _SOI)) and position + 10 <= len(stream) and stream[position] == 0xFF:
        marker, length = struct.unpack_from(">BH", stream, position + 1)
        if marker == _SOS:
            break
        if marker in (_SOF0, _SOF1, _SOF3) and size is None:
            bits, rows, columns, components = struct.unpack_from(">BHHB", stream, position + 4)
            size = JpegSize(rows, columns * components, components, bits, marker == _SOF3)
        is_quantised |= marker == _DQT
        position += 2 + length
    if size is None or size.lossless or (is_quantised and size.bits in (8, 12)):
        return size
    return None


def lossless_fault(stream: bytes | memoryview) -> str | None:
    """Describe the damage of a strip or tile; None if it is intact, or if it is not checked.

    Only Huffman-coded lossless JPEG is checked, if its components have equal size. Canon's small raw files have other
    components, but are no Bayer data.
    """
    try:
        header = _read_header(stream)
    except (struct.error, IndexError):
        return "its lossless JPEG has no samples after its header"
    if header is None or not header.is_supported:
        return None
    missing_tables = [number for number in header.table_numbers if number not in header.tables]
    if missing_tables or not (1 <= header.predictor <= 7 and 2 <= header.precision <= 16 and header.table_numbers):
        return "its lossless JPEG has an invalid header"
    if header.transform or header.restart:
        return "its lossless JPEG has a point transform or restart intervals, which raw files do not use"
    tables = np.stack([header.tables[number] for number in header.table_numbers])
    data = bytes(stream)
    gap = data.find(_GAP, header.start, max(data.find(_END, header.start), 0) or len(data))
    if gap >= 0 and (tables[:, 0] & 255).all():
        return f"its lossless JPEG is damaged: it has only zeros from byte {gap} on"
    size, limit = (header.rows, header.columns), 1 << header.precision
    result, row = _decode(np.frombuffer(data, np.uint8), header.start, tables, size, header.predictor, limit)
    return None if result == _INTACT else f"its lossless JPEG is damaged: it {_REASONS[result]}, detected in row {row}"


def _read_header(stream: bytes | memoryview) -> _Header | None:
    if bytes(stream[:2]) != bytes((0xFF, _SOI)):
        return None
    header, position = _Header(), 2
    while True:
        if stream[position] != 0xFF:
            raise IndexError
        marker = stream[position + 1]
        (length,) = struct.unpack_from(">H", stream, position + 2)
        content = bytes(stream[position + 4 : position + 2 + length])
        position += 2 + length
        if marker == _SOF3:
            header.precision, header.rows, header.columns, count = struct.unpack_from(">BHHB", content)
            header.components = tuple(content[6 + 3 * number] for number in range(count))
            header.is_supported = all(content[7 + 3 * number] == 0x11 for number in range(count))
        elif 0xC0 <= marker <= 0xCF and marker != _DHT:
            return None
        elif marker == _DHT:
            _read_tables(content, header.tables)
        elif marker == _DRI:
            header.restart = any(content[:2])
        elif marker == _SOS:
            count = content[0]
            table_of_component = {content[1 + 2 * number]: content[2 + 2 * number] >> 4 for number in range(count)}
            header.predictor, header.transform = content[1 + 2 * count], content[3 + 2 * count] & 15
            header.start = position
            # A component that the scan does not list gets a table number that does not exist.
            header.table_numbers = tuple(table_of_component.get(component, -1) for component in header.components)
            return header


def _read_tables(content: bytes, tables: dict[int, npt.NDArray[np.uint16]]) -> None:
    """Add Huffman tables to `tables` (T.81, B.2.4.2, with the codes of C.2)."""
    while content:
        number, counts = content[0] & 15, content[1:17]
        values = content[17 : 17 + sum(counts)]
        content = content[17 + sum(counts) :]
        table, code = np.zeros(1 << 16, np.uint16), 0
        symbols = iter(values)
        for bits, count in enumerate(counts, 1):
            for _ in range(count):
                first = code << (16 - bits)
                table[first : first + (1 << (16 - bits))] = bits << 8 | next(symbols, 0)
                code += 1
            code <<= 1
        tables[number] = table


@compiled
def _decode(stream: Any, start: int, tables: Any, size: Any, predictor: int, limit: int) -> tuple[int, int]:
    """Decode a scan; return a result (`_INTACT` to `_OUT_OF_RANGE`), and the row where a fault was detected.

    `stream` (N,) uint8; `tables` (C, 65536) uint16, one for each component; `size`: rows and columns.
    """
    components, (rows, columns) = len(tables), size
    above, row = np.zeros((columns, components), int64), np.zeros((columns, components), int64)
    position, end, buffer, bits, missing_bits = start, len(stream), uint64(0), 0, 0
    for y in range(rows):
        for x in range(columns):
            for component in range(components):
                while bits <= 48:
                    byte = 0xFF
                    if position + 1 < end and not (stream[position] == 0xFF and stream[position + 1] != 0):
                        byte = int64(stream[position])
                        position += 2 if byte == 0xFF else 1
                    else:
                        missing_bits += 8
                    buffer = buffer << uint64(8) | uint64(byte)
                    bits += 8
                entry = int64(tables[component, int64(buffer >> uint64(bits - 16)) & 0xFFFF])
                length, difference_bits = entry >> 8, entry & 255
                if length == 0 or difference_bits > 16:
                    return 1, y
                bits -= length
                difference = int64(0)
                if difference_bits == 16:
                    difference = 32768
                elif difference_bits:
                    bits -= difference_bits
                    difference = int64(buffer >> uint64(bits)) & ((1 << difference_bits) - 1)
                    if difference < 1 << (difference_bits - 1):
                        difference -= (1 << difference_bits) - 1
                if bits < missing_bits:
                    return 2, y
                if x == 0:
                    prediction = above[0, component] if y else limit >> 1
                elif y == 0 or predictor == 1:
                    prediction = row[x - 1, component]
                else:
                    left, up, corner = row[x - 1, component], above[x, component], above[x - 1, component]
                    prediction = _predict(predictor, left, up, corner)
                sample = prediction + difference & 0xFFFF
                if sample >= limit:
                    return 4, y
                row[x, component] = sample
        above, row = row, above
    # Count the bytes after the last sample, including those that are already in the buffer.
    unread = (bits - missing_bits) // 8
    first = int64(stream[position]) if position < end else -1
    while position + 1 < end and not (stream[position] == 0xFF and stream[position + 1] != 0):
        unread += 1
        if unread > _PADDING and int64(stream[position]) != first:
            return 3, rows - 1
        position += 1
    return 0, rows


@compiled
def _predict(predictor: int, left: int, upper: int, upper_left: int) -> int:
    """Return the prediction of a sample (T.81, table H.1)."""
    if predictor == 2:
        return upper
    if predictor == 3:
        return upper_left
    if predictor == 4:
        return left + upper - upper_left
    if predictor == 5:
        return left + (upper - upper_left >> 1)
    if predictor == 6:
        return upper + (left - upper_left >> 1)
    return left + upper >> 1
