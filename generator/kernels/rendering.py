"""Draw generated images by codes: each pixel becomes one sample of its colour (paper, section 3.4).

The look-up table (LUT) has n bits per channel (5 in the paper). A pixel R, G, B at (x, y) becomes ::

    samples[((R >> (8 - n)) << 2n) | ((G >> (8 - n)) << n) | (B >> (8 - n)), choice(seed, image, x, y)]

`kernels/choice.py` defines the choice. This module draws whole images, `kernels/planar.py` training crops, and
`kernels/mixing.py` images under several illuminants.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32

from foundation.arrays import native
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
    """Choose the offsets of the first `LEAD` groups from `begin`; `draw_groups` reads them from scratch memory."""
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
    """Write the samples of groups `begin` … `end` − 1 of a row; `base` is the target address of the row's first pixel.

    Offsets of groups before `limit` are chosen `LEAD` groups before their samples are read. With each group,
    `lines_per_group` cache lines that are needed later are prefetched, starting at `prefetch_from`. The two bytes after
    the last pixel are overwritten, except at the end of the row.
    """
    group, whole_groups = begin, min(limit, width // GROUP)
    while group < end:
        while group < min(end, whole_groups - LEAD):
            source, word = row + 3 * GROUP * (group + LEAD), uint32(LANES * (group + LEAD))
            prefetch_group(row, group + LEAD)
            _prefetch_lines(prefetch_from, lines_per_group, group - begin)
            choose(source, word, keys[0], keys[1], keys[2], count, bits, offsets_slot(scratch, group + LEAD))
            _copy_group(samples, offsets_slot(scratch, group), base + SAMPLE_BYTES * GROUP * group)
            group += 1
        # Near the end of the row, a group is incomplete, or all offsets are already chosen.
        if group < end:
            _prefetch_lines(prefetch_from, lines_per_group, group - begin)
            if group + LEAD < limit:
                choose_group(row, width, group + LEAD, keys, count, bits, scratch, offsets_slot(scratch, group + LEAD))
            offsets, pixels = offsets_slot(scratch, group), width - GROUP * group
            address = base + SAMPLE_BYTES * GROUP * group
            if pixels > GROUP:
                _copy_group(samples, offsets, address)
            else:
                for i in range(pixels):
                    copy6(samples + offset_at(offsets + 4 * i), address + SAMPLE_BYTES * i)
            group += 1


@inlined
def _prefetch_lines(prefetch_from: int, lines: int, group: int) -> None:
    for line in range(lines * group, lines * (group + 1)):
        prefetch(prefetch_from + LINE * line)


@inlined
def _copy_group(samples: int, offsets: int, target: int) -> None:
    # Each copy writes two bytes too many; the next copy overwrites them.
    for i in range(GROUP):
        copy8(samples + offset_at(offsets + 4 * i), target + SAMPLE_BYTES * i)


# From this number of pixels, copying all samples of an illuminant (5 MB) to memory is faster than reading pages from
# disk in random order.
WHOLE_LIGHT_PIXELS: Final = 1 << 20

# Groups of a segment, which is buffered before it is streamed: 3 KiB, which fit into the first-level cache.
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
    # Picture, samples, target and scratch are addresses; pitches are bytes from row to row. The caches are reserved for
    # the samples. The picture is prefetched for one use only, and a `streamed` image is written past the caches.
    groups = (width + GROUP - 1) // GROUP
    lines = first_line(scratch + SCRATCH_BYTES)
    for y in range(rows):
        keys = row_keys(first_row + y, 0, image, seed)
        row, row_target = picture + y * pitch, target + y * target_pitch
        begin, buffered = row_target, row_target & (LINE - 1)
        choose_first_groups(row, width, keys, count, bits, scratch, 0, groups)
        group = 0
        while group < groups:
            end, base = groups, row_target
            if streamed:
                end, base = min(group + _SEGMENT_GROUPS, groups), lines + buffered - SAMPLE_BYTES * GROUP * group
            draw_groups(row, width, keys, samples, count, bits, scratch, group, end, groups, 0, 0, base)
            if streamed:
                stop = row_target + SAMPLE_BYTES * min(GROUP * end, width)
                buffered = stream_lines(lines, begin, stop, end == groups)
                begin = stop - buffered
            group = end
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
    """Draw the raw linear image of `picture` under one illuminant; the module docstring has the formula.

    Parameters
    ----------
    samples
        (8**bits, S, 3) uint16, linear camera RGB in counts, S ≥ 1; for example `lut.samples[light]`.
    picture
        (H, W, 3) uint8, sRGB codes. The lowest 8 − bits bits of a code are ignored.
    seed
        0 … 2⁶⁴ − 1.
    image
        Number of the image in its data set, 0 … 2³² − 1.
    first_row
        Row of the whole picture at which `picture` begins, if it is a band of a larger picture. Bands give the same
        pixels as the whole picture.
    threads
        Number of threads that share the rows. The result does not depend on it.
    out
        (H, W, 3) uint16 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, linear camera RGB in the units of `samples`.

    Raises
    ------
    InputError
        If a shape, type or value is not as described above.

    Examples
    --------
    A LUT of 1 bit per channel has 8 colours, here with 2 samples each. The picture is white, the last colour:

    >>> samples = np.arange(8 * 2 * 3, dtype=np.uint16).reshape(8, 2, 3)
    >>> draw_samples(samples, np.full((1, 4, 3), 255, np.uint8), seed=0)
    array([[[45, 46, 47],
            [45, 46, 47],
            [42, 43, 44],
            [45, 46, 47]]], dtype=uint16)
    """
    samples = native(samples)
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

    # numba's own threads are not used: two Python threads cannot use them at once, and they do not survive a fork.
    run_in_threads(fill, len(picture), threads)
    return copied_back(work, target)


def valid_light(lut: Lut, light: int) -> int:
    """Return the index of an illuminant as int; raise InputError if the LUT has no such illuminant."""
    try:
        number = operator.index(light)
    except TypeError as error:
        raise InputError(
            f"{light!r} is not an illuminant; give its index, a whole number ≥ 0, or a text such as 5600K"
        ) from error
    if not 0 <= number < len(lut.samples):
        raise InputError(f"there is no illuminant {number}; the LUT {lut.folder} has 0 to {len(lut.samples) - 1}")
    return number


def read_light(lut: Lut, light: int, pixels: int = WHOLE_LIGHT_PIXELS) -> npt.NDArray[np.uint16]:
    """Return the samples (8**bits, S, 3) uint16 of illuminant `light`.

    If `pixels` is `WHOLE_LIGHT_PIXELS` or more, they are copied to memory. For fewer pixels, they are read from
    disk when used.
    """
    mapped = lut.light_samples(valid_light(lut, light))
    return np.array(mapped) if pixels >= WHOLE_LIGHT_PIXELS else mapped
