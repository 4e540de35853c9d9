"""From source codes to linear camera RGB: each pixel becomes one of the table's samples of its colour.

Source: paper, section 3.4. With n the table's bits (5 in the paper), a pixel R, G, B at (x, y) becomes

    samples[((R >> (8 - n)) << 2n) | ((G >> (8 - n)) << n) | (B >> (8 - n)), choice(seed, image, x, y)]

where the choice is that of `kernels/choice.py`. Here are whole images;
`kernels/planar.py` has crops for training and `kernels/mixing.py` several lights.

Compiled loops are not split by numba's own threads: their pool cannot be entered from two Python threads at once and
does not survive a fork. Rows are split by plain threads instead.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32

from foundation.compiled import compiled, inlined
from foundation.errors import InputError
from generator.kernels import vector as streaming
from generator.kernels.choice import (
    LEAD,
    SCRATCH_BYTES,
    check_out,
    check_picture,
    check_samples,
    check_seed,
    choose,
    choose_group,
    copied_back,
    offsets_slot,
    packed_rows,
    prefetch,
    prefetch_group,
    readable,
    row_keys,
    run_in_threads,
    writable,
)
from generator.kernels.vector import (
    GROUP,
    LANES,
    LINE,
    SAMPLE_BYTES,
    copy6,
    copy8,
    first_line,
    line_buffer_bytes,
    offset_at,
    store_fence,
    stream_lines,
)

if TYPE_CHECKING:
    from calibration.table.lut import Lut


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


@inlined
def _prefetch_lines(prefetch_from: int, lines: int, group: int) -> None:
    for line in range(lines * group, lines * (group + 1)):
        prefetch(prefetch_from + LINE * line)


@inlined
def _copy_group(samples: int, offsets: int, target: int) -> None:
    """Write the samples of a whole group, and two bytes more: each copy's last two are the next one's first two."""
    for i in range(GROUP):
        copy8(samples + offset_at(offsets + 4 * i), target + SAMPLE_BYTES * i)


# Pixels from which copying all samples of a light (5 MB) is cheaper than reading their pages in random order.
WHOLE_LIGHT_PIXELS: Final = 1 << 20

# Groups of pixels that are put together before they are streamed: 3 KiB, which stay in the first-level cache.
_SEGMENT_GROUPS: Final = 16


@compiled
def _gather(
    picture: int,
    pitch: int,
    width: int,
    rows: int,
    samples: int,
    count: Any,
    bits: Any,
    seed: Any,
    image: int,
    first_row: int,
    target: int,
    target_pitch: int,
    streamed: bool,
    scratch: int,
) -> None:
    """Fill rows of 3-channel pixels; picture, samples, target and scratch are addresses, pitches bytes from row to row.

    Picture and image leave the caches to the samples: the picture is prefetched as data that are read once; the image,
    if `streamed`, is put together in scratch memory and written past the caches, a line at a time.
    """
    groups = (width + GROUP - 1) // GROUP
    lines = first_line(scratch + SCRATCH_BYTES)
    for y in range(rows):
        keys = row_keys(first_row + y, 0, image, seed)
        row, to = picture + y * pitch, target + y * target_pitch
        begin, held = to, to & (LINE - 1)
        choose_first_groups(row, width, keys, count, bits, scratch, 0, groups)
        done = 0
        while done < groups:
            end, base = groups, to
            if streamed:
                end, base = min(done + _SEGMENT_GROUPS, groups), lines + held - SAMPLE_BYTES * GROUP * done
            draw_groups(row, width, keys, samples, count, bits, scratch, done, end, groups, 0, 0, base)
            if streamed:
                stop = to + SAMPLE_BYTES * min(GROUP * end, width)
                held = stream_lines(lines, begin, stop, end == groups)
                begin = stop - held
            done = end
    if streamed:
        store_fence()


def draw_samples(
    samples: npt.NDArray[np.uint16],
    picture: npt.NDArray[np.uint8],
    *,
    seed: int = 0,
    image: int = 0,
    first_row: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image of `picture` under one light; the rule stands at the head of this file.

    Parameters
    ----------
    samples
        (8**bits, S, 3) uint16, linear camera RGB of one light, S ≥ 1; for example `lut.samples[light]`.
    picture
        (H, W, 3) uint8 sRGB codes; the 8 − bits low bits of a code do not matter.
    seed
        0 … 2⁶⁴ − 1.
    image
        Number of the image in its dataset, 0 … 2³² − 1.
    first_row
        The row of the whole picture that `picture` begins with: a picture done in bands is the same picture.
    threads
        Threads that share the rows; no byte depends on it.
    out
        (H, W, 3) uint16 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, linear camera RGB in the units of `samples`.

    Raises
    ------
    InputError
        A shape, type or number is not as above.

    Examples
    --------
    A table of one bit a channel has 8 colours, here with two samples each; the picture is white, the last colour:

    >>> samples = np.arange(8 * 2 * 3, dtype=np.uint16).reshape(8, 2, 3)
    >>> draw_samples(samples, np.full((1, 4, 3), 255, np.uint8), seed=0)
    array([[[45, 46, 47],
            [45, 46, 47],
            [42, 43, 44],
            [45, 46, 47]]], dtype=uint16)
    """
    bits = check_samples(samples)
    check_picture(picture)
    target = check_out(out, picture.shape, np.uint16)
    key = check_seed(seed, image)
    source, table, work = packed_rows(picture), readable(samples), writable(target)
    size = SCRATCH_BYTES + line_buffer_bytes(SAMPLE_BYTES * GROUP * _SEGMENT_GROUPS)

    def fill(top: int, bottom: int) -> None:
        scratch = np.empty(size, np.uint8)
        _gather(
            source[top:].ctypes.data,
            source.strides[0],
            source.shape[1],
            bottom - top,
            table.ctypes.data,
            np.uint32(samples.shape[1]),
            np.uint32(bits),
            key,
            image,
            first_row + top,
            work[top:].ctypes.data,
            work.strides[0],
            work.nbytes >= streaming.STREAMED_BYTES,
            scratch.ctypes.data,
        )

    run_in_threads(fill, len(picture), threads)
    return copied_back(work, target)


def known_light(lut: Lut, light: int) -> int:
    """Return the number of a light; an InputError if the table has no such light."""
    try:
        number = operator.index(light)
    except TypeError as error:
        raise InputError(
            f"light {light!r} is no light; give its whole number from 0, or a text such as 5600K"
        ) from error
    if not 0 <= number < len(lut.samples):
        raise InputError(f"there is no light {number}; the table {lut.folder} has lights 0 to {len(lut.samples) - 1}")
    return number


def read_light(lut: Lut, light: int, pixels: int = WHOLE_LIGHT_PIXELS) -> npt.NDArray[np.uint16]:
    """Return the samples (8**bits, S, 3) uint16 of light number `light`.

    For a picture of `WHOLE_LIGHT_PIXELS` or more they are copied to memory, else they stay on disk until they are used.
    """
    mapped = lut.light_samples(known_light(lut, light))
    return np.array(mapped) if pixels >= WHOLE_LIGHT_PIXELS else mapped
