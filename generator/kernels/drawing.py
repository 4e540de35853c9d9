"""The samples of one light for a row's pixels: the loop that whole images and lone lights among several share."""

from __future__ import annotations

from typing import Any

import numba
from numba import uint32

from generator.kernels.choice import AHEAD, ask_group, choose_group, slot
from generator.kernels.vector import GROUP, LANES, LINE, SAMPLE_BYTES, choose, copy6, copy8, offset_at, prefetch


@numba.njit(inline="always")
def choose_first(row: int, width: int, keys: Any, count: Any, bits: Any, scratch: int, begin: int, limit: int) -> None:
    """Choose what `draw_groups` finds chosen when it starts with group `begin` of a row."""
    for group in range(begin, min(begin + AHEAD, limit)):
        choose_group(row, width, group, keys, count, bits, scratch, slot(scratch, group))


@numba.njit(inline="always")
def draw_groups(
    row: int,
    width: int,
    keys: Any,
    samples: int,
    count: Any,
    bits: Any,
    scratch: int,
    begin: int,
    end: int,
    limit: int,
    soon: int,
    asked: int,
    base: int,
) -> None:
    """Write the samples of groups `begin` … `end` − 1 of a row; its first pixel would go to `base`.

    Offsets are chosen `AHEAD` groups before the samples they lead to are fetched, but none from group `limit` on, so
    that the processor multiplies while it waits. With each group so many lines of what is read `soon` are `asked` for.
    Two bytes are written behind the last pixel, if it is not the row's last.
    """
    done, whole = begin, min(limit, width // GROUP)
    while done < end:
        while done < min(end, whole - AHEAD):
            source, word = row + 3 * GROUP * (done + AHEAD), uint32(LANES * (done + AHEAD))
            ask_group(row, done + AHEAD)
            _ask(soon, asked, done - begin)
            choose(source, word, keys[0], keys[1], keys[2], count, bits, slot(scratch, done + AHEAD))
            _copy_group(samples, slot(scratch, done), base + SAMPLE_BYTES * GROUP * done)
            done += 1
        # The last groups have none to choose ahead, or fewer pixels.
        if done < end:
            _ask(soon, asked, done - begin)
            if done + AHEAD < limit:
                choose_group(row, width, done + AHEAD, keys, count, bits, scratch, slot(scratch, done + AHEAD))
            offsets, at, pixels = slot(scratch, done), base + SAMPLE_BYTES * GROUP * done, width - GROUP * done
            if pixels > GROUP:
                _copy_group(samples, offsets, at)
            else:
                for i in range(pixels):
                    copy6(samples + offset_at(offsets + 4 * i), at + SAMPLE_BYTES * i)
            done += 1


@numba.njit(inline="always")
def _ask(soon: int, lines: int, group: int) -> None:
    for line in range(lines * group, lines * (group + 1)):
        prefetch(soon + LINE * line)


@numba.njit(inline="always")
def _copy_group(samples: int, offsets: int, target: int) -> None:
    """Write the samples of a whole group, and two bytes more: each copy's last two are the next one's first two."""
    for i in range(GROUP):
        copy8(samples + offset_at(offsets + 4 * i), target + SAMPLE_BYTES * i)
