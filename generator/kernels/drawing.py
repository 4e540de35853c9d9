"""The samples of one light for a row's pixels: the loop that images under one light and under several share."""

from __future__ import annotations

from typing import Any

from numpy import uint32

from foundation.compiled import compiled, inlined
from generator.kernels.choice import LEAD, SCRATCH_BYTES, choose_group, offsets_slot, prefetch_group
from generator.kernels.dithering import LOCATE_LEAD, locate, offset_cells
from generator.kernels.vector import (
    GROUP,
    LANES,
    LINE,
    SAMPLE_BYTES,
    choose,
    copy6,
    copy8,
    offset_at,
    prefetch,
)


@inlined
def choose_first_groups(
    row: int, width: int, keys: Any, count: Any, bits: Any, scratch: int, begin: int, limit: int
) -> None:
    """Choose the offsets of the first `LEAD` groups from `begin` on, which `draw_groups` expects in scratch memory."""
    for group in range(begin, min(begin + LEAD, limit)):
        choose_group(row, width, group, keys, count, bits, scratch, offsets_slot(scratch, group))


@inlined
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
    prefetch_from: int,
    lines_per_group: int,
    base: int,
) -> None:
    """Write the samples of groups `begin` … `end` − 1 of a row; its first pixel would go to `base`.

    Offsets are chosen `LEAD` groups before the samples they point to are fetched, but none from group `limit` on. With
    each group `lines_per_group` further lines of the cache are prefetched, the first at address `prefetch_from`. Two
    bytes are written behind the last pixel, if it is not the row's last.
    """
    done, whole = begin, min(limit, width // GROUP)
    while done < end:
        while done < min(end, whole - LEAD):
            source, word = row + 3 * GROUP * (done + LEAD), uint32(LANES * (done + LEAD))
            prefetch_group(row, done + LEAD)
            _prefetch_lines(prefetch_from, lines_per_group, done - begin)
            choose(source, word, keys[0], keys[1], keys[2], count, bits, offsets_slot(scratch, done + LEAD))
            _copy_group(samples, offsets_slot(scratch, done), base + SAMPLE_BYTES * GROUP * done)
            done += 1
        # For the last groups no offsets are left to choose, or they have fewer pixels.
        if done < end:
            _prefetch_lines(prefetch_from, lines_per_group, done - begin)
            if done + LEAD < limit:
                choose_group(row, width, done + LEAD, keys, count, bits, scratch, offsets_slot(scratch, done + LEAD))
            offsets, at, pixels = offsets_slot(scratch, done), base + SAMPLE_BYTES * GROUP * done, width - GROUP * done
            if pixels > GROUP:
                _copy_group(samples, offsets, at)
            else:
                for i in range(pixels):
                    copy6(samples + offset_at(offsets + 4 * i), at + SAMPLE_BYTES * i)
            done += 1


@compiled
def draw_dithered(
    row: int,
    width: int,
    inks: Any,
    keys: Any,
    samples: int,
    count: Any,
    scratch: int,
    begin: int,
    end: int,
    base: int,
) -> None:
    """Do what `draw_groups` does, for the cells that stand for a row's pixels; `inks` are the row's.

    Nothing needs to be chosen before; segments of a row are to come in turn. A function of its own: within the loop of
    rows it is a third slower, since it is more than the registers hold.
    """
    groups, stride, memory = (width + GROUP - 1) // GROUP, uint32(SAMPLE_BYTES * count), scratch + SCRATCH_BYTES
    for step in range(-LOCATE_LEAD if begin == 0 else begin, end):
        group = step + LOCATE_LEAD
        if group < groups:
            prefetch_group(row, group)
            locate(row, width, group, inks, keys, count, scratch, memory)
        group = step + LEAD
        if 0 <= group < groups:
            offset_cells(group, inks, stride, memory, offsets_slot(scratch, group))
        if step >= 0:
            offsets, at, pixels = offsets_slot(scratch, step), base + SAMPLE_BYTES * GROUP * step, width - GROUP * step
            if pixels > GROUP:
                _copy_group(samples, offsets, at)
            else:
                for i in range(pixels):
                    copy6(samples + offset_at(offsets + 4 * i), at + SAMPLE_BYTES * i)


@inlined
def _prefetch_lines(prefetch_from: int, lines: int, group: int) -> None:
    for line in range(lines * group, lines * (group + 1)):
        prefetch(prefetch_from + LINE * line)


@inlined
def _copy_group(samples: int, offsets: int, target: int) -> None:
    """Write the samples of a whole group, and two bytes more: each copy's last two are the next one's first two."""
    for i in range(GROUP):
        copy8(samples + offset_at(offsets + 4 * i), target + SAMPLE_BYTES * i)
