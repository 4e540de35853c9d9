"""Writing past the caches: for an image that they could not keep, so that they keep the table.

Pixels are put together in a thread's own memory, a stretch of a row at a time, and passed on in whole lines of memory.
"""

from __future__ import annotations

from typing import Final

import numba

from generator.kernels.vector import LINE, copy2, copy_line, stream_line

STREAMED_BYTES: Final = 24 << 20
"""Bytes of an image from which it is streamed: what a processor's last cache may have."""


def line_room(stretch_bytes: int) -> int:
    """Return the bytes of memory for a stretch that begins anywhere in a line, and a line behind it."""
    return stretch_bytes + 3 * LINE


@numba.njit(inline="always")
def line_at(room: int) -> int:
    """Return the first line in the memory at `room`."""
    return (room + LINE - 1) & -LINE


@numba.njit(inline="always")
def pass_on(lines: int, begin: int, stop: int, last: bool) -> int:
    """Stream what `lines` holds, which is to stand from the line of `begin` up to `stop`; addresses are even.

    Nothing is written before `begin`. Returns the bytes of the last line, which are kept but for the row's `last`.
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
