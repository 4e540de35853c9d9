"""Writing past the caches: for an image that they could not keep, so that they keep the table.

Pixels are put together in a thread's own memory, a segment of a row at a time, and written in whole lines of the cache.
"""

from __future__ import annotations

from typing import Final

from foundation.compiled import inlined
from generator.kernels.vector import LINE, copy2, copy_line, stream_line

STREAMED_BYTES: Final = 24 << 20
"""Bytes of an image from which it is streamed: the size of a desktop processor's last-level cache."""


def line_buffer_bytes(segment_bytes: int) -> int:
    """Return the bytes of memory for a segment that begins anywhere in a line, and a line behind it."""
    return segment_bytes + 3 * LINE


@inlined
def first_line(buffer: int) -> int:
    """Return the address of the first whole line in the memory at `buffer`."""
    return (buffer + LINE - 1) & -LINE


@inlined
def stream_lines(lines: int, begin: int, stop: int, last: bool) -> int:
    """Stream the content of `lines` to its target, from the line of address `begin` up to `stop`; both are even.

    Nothing is written before `begin`. The last line, not full yet, is kept for the next call, and the number of its
    bytes returned, unless this is the row's `last` segment.
    """
    source, to = lines, begin & -LINE
    if begin > to:
        for i in range(begin - to, min(LINE, stop - to), 2):
            copy2(source + i, to + i)
        source, to = source + LINE, to + LINE
    while to + LINE <= stop:
        stream_line(source, to)
        source, to = source + LINE, to + LINE
    if last:
        for i in range(0, stop - to, 2):
            copy2(source + i, to + i)
    else:
        copy_line(source, lines)
    return stop - to
