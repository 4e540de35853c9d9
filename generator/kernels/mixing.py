"""Mix several illuminants with the noise that one exposure under all of them would have.

Light is additive. If m_i is the mean of a colour under illuminant i alone, the mean under all illuminants with weights
w_i is Σ w_i m_i. A sample is x_i = m_i + n_i. Its noise n_i has the variance g m_i + r², with photon noise at gain g,
and read noise r. One exposure under all illuminants has the variance g Σ w_i m_i + r². A weighted mean of samples has
too little photon noise: its variance is only g Σ w_i² m_i, half the true value for two equal illuminants. Therefore the
noise of each sample is multiplied by √w_i::

    y = Σ w_i m_i + Σ √w_i (x_i − m_i),   x_i drawn independently for each illuminant

The variance of y is Σ w_i (g m_i + r²). Photon noise is exact for any weights. Read noise is exact if the weights sum
to 1. For another sum, it is √(Σ w_i) times its true value. A single illuminant of weight 1 gives its own
samples exactly.

There are three approximations:

- m_i is the mean of S samples, not of the whole patch.
- Differences between points of the print and between photosites are proportional to the light, but are multiplied by
  √w_i here. For illuminants of equal brightness they are 1/√(Σ w_i) of their true value.
- Samples clipped by the sensor stay clipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32

from foundation.arrays import native
from foundation.compiled import compiled, inlined
from foundation.errors import InputError, value_text
from generator import philox
from generator.kernels import vector as streaming
from generator.kernels.choice import (
    OFFSETS_BYTES,
    SCRATCH_BYTES,
    Picture,
    Samples,
    channel_bits,
    check_out,
    check_picture,
    check_seed,
    check_tables,
    check_weights,
    check_white_level,
    choose_for_colours,
    group_address,
    packed_rows,
    philox4x32,
    prefetch,
    prefetch_group,
    readable,
    row_keys,
    run_in_threads,
    writable,
    write_colours,
)
from generator.kernels.rendering import choose_first_groups, draw_groups
from generator.kernels.unfit import colours_in
from generator.kernels.vector import (
    BLOCK,
    FAULT_BYTES,
    GROUP,
    LANES,
    LINE,
    MEAN_BYTES,
    PLAN_ENTRIES,
    SAMPLE_BYTES,
    arrange_weights,
    first_line,
    interleave_weights,
    line_buffer_bytes,
    mean4,
    mix,
    store_fence,
    stream_lines,
    weight_flags,
)

_MIXTURES: Final = np.uint32(philox.MIXTURES)


@compiled
def _mix_table(samples: Any, weight: float, seed: Any, stream: int, shuffled: bool, colours: Any, total: Any) -> None:
    # Adds the samples of one illuminant to `total` (N, S, 3) float64; each colour has its own shuffle.
    count = samples.shape[1]
    root = np.sqrt(weight)
    order = np.empty(count, np.uint32)
    for i in range(count):
        order[i] = i
    words = np.empty(count + 3, np.uint32)
    mean_parts = np.empty(3)
    for number, colour in enumerate(colours):
        colour_samples, sums = samples[colour], total[number]
        if shuffled:
            for i in range(0, count, 4):
                words[i], words[i + 1], words[i + 2], words[i + 3] = philox4x32(
                    np.uint32(colour), np.uint32(i // 4), np.uint32(stream), _MIXTURES, seed
                )
            for i in range(count):
                order[i] = i
            for i in range(count - 1):
                j = i + np.int64((np.uint64(words[i]) * np.uint64(count - i)) >> np.uint64(32))
                order[i], order[j] = order[j], order[i]
        red = green = blue = 0
        for i in range(count):
            red, green, blue = red + colour_samples[i, 0], green + colour_samples[i, 1], blue + colour_samples[i, 2]
        for channel, mean in enumerate((red / count, green / count, blue / count)):
            mean_parts[channel] = (weight - root) * mean
        for i in range(count):
            sample = colour_samples[order[i]]
            for channel in range(3):
                sums[i, channel] += root * sample[channel] + mean_parts[channel]


@compiled
def _round_table(total: Any, white: float, colours: Any, out: Any) -> None:
    for number, colour in enumerate(colours):
        for i in range(total.shape[1]):
            for channel in range(3):
                out[colour, i, channel] = np.uint16(min(max(total[number, i, channel] + 0.5, 0.0), white))


def mixed_table(
    tables: Samples | Sequence[Samples],
    weights: npt.ArrayLike,
    *,
    white_level: int = 65535,
    seed: int = 0,
    colours: npt.NDArray[np.bool_] | None = None,
) -> Samples:
    """Mix the samples of several illuminants into those of one illuminant; the module docstring has the formula.

    Within a colour, the samples of the first illuminant with a weight keep their order. The samples of each further
    illuminant are shuffled independently, so that their noise is uncorrelated.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16, or a sequence of K (8**bits, S, 3): linear camera RGB of the illuminants, counts.
    weights
        (K,) float ≥ 0, relative intensity of each illuminant; 1 is the intensity at which it was photographed.
    white_level
        Saturation level, 1 … 65535 counts; larger values are clipped.
    seed
        Seed of the shuffles, 0 … 2⁶⁴ − 1.
    colours
        (8**bits,) bool, colours to compute, for example from `kernels.unfit.colours_in`; None for all. Samples of other
        colours are 0. A selection saves time for small pictures and changes no sample.

    Returns
    -------
    ndarray
        (8**bits, S, 3) uint16, linear camera RGB, rounded to the nearest count, halves up.

    Raises
    ------
    InputError
        If a shape, type or value is not as described above.

    Examples
    --------
    >>> red, blue = np.zeros((2, 8, 25, 3), np.uint16)
    >>> red[7], blue[7] = (800, 400, 200), (200, 400, 800)
    >>> mixed_table([red, blue], [0.5, 0.25])[7, 0]
    array([450, 300, 300], dtype=uint16)
    """
    lights = check_tables(tables)
    checked = check_weights(weights, len(lights))
    check_white_level(white_level)
    key = check_seed(seed, 0)
    shape = lights[0].shape
    if colours is not None and (colours.shape != shape[:1] or colours.dtype != np.bool_):
        raise InputError(f"the colours are {colours.dtype} {colours.shape}, expected bool ({shape[0]},)")
    chosen_colours = np.flatnonzero(np.ones(shape[0], np.bool_) if colours is None else colours)
    total = np.zeros((len(chosen_colours), *shape[1:]), np.float64)
    shuffled = False
    for stream, (samples, weight) in enumerate(zip(lights, checked, strict=True)):
        if weight > 0:
            _mix_table(np.asarray(samples), float(weight), key, stream, shuffled, chosen_colours, total)
            shuffled = True
    out = np.zeros(shape, np.uint16)
    _round_table(total, float(white_level), chosen_colours, out)
    return out


# A row is mixed in segments of this many pixels, a multiple of a group. Their weights and offsets fit into the
# second-level cache.
SEGMENT_PIXELS: Final = 512
# Weights are prefetched this many pixels before they are read.
_PREFETCH_PIXELS: Final = 4096
# Size of the offsets of a segment, or of its weights of one illuminant, in bytes. The last segment of a row has up to
# seven more pixels.
SEGMENT_BYTES: Final = OFFSETS_BYTES * (SEGMENT_PIXELS // GROUP + 1)
# Scratch memory of a segment for a pair of illuminants, in bytes: weights in pixel order, weights in the order of
# `mix`, and offsets.
PAIR_BYTES: Final = 6 * SEGMENT_BYTES
# Size of the buffer of a segment before it is streamed (written past the caches), in bytes.
_LINES_BYTES: Final = line_buffer_bytes(SAMPLE_BYTES * (SEGMENT_PIXELS + BLOCK))


@compiled
def _fill_means(samples: int, colours: Any, count: int, means: int, stride: int) -> int:
    # Writes the means of all colours, `stride` bytes apart; returns the largest channel value of all samples.
    largest = 0
    for colour in colours:
        largest = max(largest, mean4(samples + SAMPLE_BYTES * count * colour, count, means + stride * colour))
    return largest


@inlined
def _single_light(pair_weights: Any, count: int) -> int:
    # Returns the illuminant with weight 1 in all of the first `count` pixels, if the weights of all others are 0 there.
    # Returns −1 if there is no such illuminant.
    lit, single = 0, -1
    for pair in range(len(pair_weights)):
        flags = weight_flags(pair_weights[pair], count)
        for member in range(2):
            if flags >> member & 1:
                lit += 1
                if not flags >> 2 + member & 1:
                    single = 2 * pair + member
    return single if lit == 1 else -1


@compiled
def _draw_segment(
    row: int,
    width: int,
    low: int,
    high: int,
    keys: Any,
    samples: int,
    count: Any,
    bits: Any,
    scratch: int,
    prefetch_from: int,
    lines_per_group: int,
    base: int,
) -> None:
    # Separate from `_mix_pixels`, because one function with both loops would need too many registers.
    choose_first_groups(row, width, keys, count, bits, scratch, low, high)
    draw_groups(row, width, keys, samples, count, bits, scratch, low, high, high, prefetch_from, lines_per_group, base)


@compiled
def _mix_segment(
    row: int,
    width: int,
    low: int,
    high: int,
    pixels: int,
    keys: Any,
    tables: Any,
    means: int,
    count: Any,
    bits: Any,
    pair_weights: Any,
    white: Any,
    scratch: int,
    prefetch_from: int,
    lines_per_group: int,
    plan: Any,
    plan_at: int,
    target: int,
) -> None:
    """Mix the groups `low` … `high` − 1 of a row, `pixels` in all, under several illuminants.

    `pair_weights` are the addresses of the weights of each pair. Scratch memory holds, in this order: the incomplete
    group, the fault marks (NaN if a weight is invalid), each pixel's offset in the means and in the samples, then the
    weights and offsets of each pair. With each group, `lines_per_group` cache lines of later weights are prefetched,
    starting at `prefetch_from`.
    """
    pairs = len(pair_weights)
    faults = scratch + SCRATCH_BYTES
    mean_offsets = faults + FAULT_BYTES
    colours = mean_offsets + SEGMENT_BYTES
    lines = colours + SEGMENT_BYTES
    for group in range(low, high):
        position = OFFSETS_BYTES * (group - low)
        prefetch_group(row, group)
        for line in range(lines_per_group):
            prefetch(prefetch_from + LINE * (lines_per_group * (group - low) + line))
        source = group_address(row, width, group, scratch)
        mean_stride, stride = uint32(2 * MEAN_BYTES * pairs), uint32(SAMPLE_BYTES * count)
        write_colours(source, bits, mean_stride, mean_offsets + position, stride, colours + position)
    lit_pairs = 0
    for pair in range(pairs):
        line, light = lines + PAIR_BYTES * pair + 2 * SEGMENT_BYTES, 2 * pair
        lit = arrange_weights(pair_weights[pair], pixels, line)
        if not lit:
            continue
        plan[lit_pairs, 0], plan[lit_pairs, 5] = line, means + 2 * MEAN_BYTES * pair
        for member in range(2):
            # If all weights of one illuminant are 0, the samples of the other one of the pair are read for both.
            drawn_member = member if lit >> member & 1 else 1 - member
            offsets = line + SEGMENT_BYTES * (2 + drawn_member)
            plan[lit_pairs, 1 + member], plan[lit_pairs, 3 + member] = offsets, tables[light + drawn_member]
            if drawn_member != member:
                continue
            k0, k1, k2 = keys[light + drawn_member, 0], keys[light + drawn_member, 1], keys[light + drawn_member, 2]
            for group in range(low, high):
                position, word = OFFSETS_BYTES * (group - low), uint32(LANES * group)
                choose_for_colours(colours + position, word, k0, k1, k2, count, offsets + position)
        lit_pairs += 1
    mix(plan_at, lit_pairs, pixels, mean_offsets, faults, np.float32(white), target)


@compiled
def _mix_pixels(
    picture: int,
    pitch: int,
    width: int,
    rows: int,
    tables: Any,
    means: int,
    count: Any,
    bits: Any,
    weights: int,
    weight_steps: Any,
    white: Any,
    is_unclipped: Any,
    seed: Any,
    image: int,
    first_row: int,
    target: int,
    target_pitch: int,
    scratch: int,
    plan: Any,
    plan_at: int,
    keys: Any,
    pair_weights: Any,
    zero_weight: int,
    streamed: bool,
) -> None:
    # Rows have at least eight pixels. `weight_steps` are the distances of weights in bytes: to the next row, pixel and
    # illuminant. `is_unclipped` marks illuminants without samples above the saturation level.
    lights, pairs = len(tables), len(pair_weights)
    lines = scratch + SCRATCH_BYTES + FAULT_BYTES + 2 * SEGMENT_BYTES
    line_buffer = first_line(lines + PAIR_BYTES * pairs)
    uniform = weight_steps[0] == 0 and weight_steps[1] == 0
    # Number of cache lines with the weights of a group; 0 if the weights of a pixel are not adjacent.
    lines_per_group = GROUP * weight_steps[1] // LINE if weight_steps[1] == 4 * lights else 0
    for y in range(rows):
        row, start = picture + y * pitch, 0
        begin = target + y * target_pitch
        buffered = begin & (LINE - 1)
        for light in range(lights):
            keys[light, 0], keys[light, 1], keys[light, 2] = row_keys(first_row + y, light, image, seed)
        while start < width:
            # At least eight pixels must remain after a segment.
            end = width if width - start < SEGMENT_PIXELS + BLOCK else start + SEGMENT_PIXELS
            pixels, low, high = end - start, start // GROUP, (end + GROUP - 1) // GROUP
            for pair in range(pairs):
                line, light = lines + PAIR_BYTES * pair, 2 * pair
                first, stride = weights + y * weight_steps[0] + light * weight_steps[2], weight_steps[1]
                # If the number of illuminants is odd, the second illuminant of the last pair has weight 0.
                second, second_stride = (first + weight_steps[2], stride) if light + 1 < lights else (zero_weight, 0)
                if stride == 8 and second == first + 4:
                    pair_weights[pair] = first + stride * start
                    continue
                pair_weights[pair] = line
                if not uniform or (y == 0 and start == 0):
                    for i in range(0, SEGMENT_PIXELS + BLOCK if uniform else pixels, BLOCK):
                        x = i if uniform else min(i, pixels - BLOCK)
                        from_first, from_second = first + stride * (start + x), second + second_stride * (start + x)
                        interleave_weights(from_first, stride, from_second, second_stride, line + 8 * x)
            prefetch_from = weights + y * weight_steps[0] + (end + _PREFETCH_PIXELS) * weight_steps[1]
            segment_target = target + y * target_pitch + SAMPLE_BYTES * start
            stop = segment_target + SAMPLE_BYTES * pixels
            if streamed:
                segment_target = line_buffer + buffered
            # A segment under one illuminant of weight 1 needs no mixing. The first pixels are checked first, because
            # they usually show that several illuminants have weights.
            single = _single_light(pair_weights, BLOCK)
            if single >= 0:
                single = _single_light(pair_weights, pixels)
            if single >= 0 and is_unclipped[single]:
                light_keys = keys[single, 0], keys[single, 1], keys[single, 2]
                base = segment_target - SAMPLE_BYTES * start
                _draw_segment(
                    row,
                    width,
                    low,
                    high,
                    light_keys,
                    tables[single],
                    count,
                    bits,
                    scratch,
                    prefetch_from,
                    lines_per_group,
                    base,
                )
            else:
                _mix_segment(
                    row,
                    width,
                    low,
                    high,
                    pixels,
                    keys,
                    tables,
                    means,
                    count,
                    bits,
                    pair_weights,
                    white,
                    scratch,
                    prefetch_from,
                    lines_per_group,
                    plan,
                    plan_at,
                    segment_target,
                )
            if streamed:
                buffered = stream_lines(line_buffer, begin, stop, end == width)
                begin = stop - buffered
            start = end
    if streamed:
        store_fence()


def mix_samples(
    tables: Samples | Sequence[Samples],
    picture: Picture,
    weights: npt.NDArray[np.float32],
    *,
    white_level: int = 65535,
    seed: int = 0,
    image: int = 0,
    first_row: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.uint16]:
    """Draw the raw linear image of `picture` under several illuminants with one weight per pixel and illuminant.

    The module docstring has the formula. `choice.py` chooses the sample of each illuminant; the stream is the index of
    the illuminant in `tables`. With weights 1, 0, 0 …, a pixel is the same as from `draw_samples`.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16, or a sequence of K (8**bits, S, 3): linear camera RGB of the illuminants, counts.
    picture
        (H, W, 3) uint8, sRGB codes.
    weights
        (H, W, K) float32 ≥ 0, or (K,) for all pixels: relative intensity of each illuminant; 1 is the intensity at
        which it was photographed.
    white_level
        Saturation level, 1 … 65535 counts; larger values are clipped.
    seed, image, first_row, threads
        As for `rendering.draw_samples`.
    out
        (H, W, 3) uint16 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, computed in float32, rounded to the nearest count, halves up. The light of illuminants 2 j
        and 2 j + 1 is added first, then the sums of these pairs in order.

    Raises
    ------
    InputError
        If a shape, type or value is not as described above.

    Examples
    --------
    Two illuminants on a white wall, the left half under the first, the right half under both:

    >>> red, blue = np.zeros((2, 8, 25, 3), np.uint16)
    >>> red[7], blue[7] = (800, 400, 200), (200, 400, 800)
    >>> weights = np.array([[[1, 0], [0.5, 0.5]]], np.float32)
    >>> mix_samples([red, blue], np.full((1, 2, 3), 255, np.uint8), weights)
    array([[[800, 400, 200],
            [500, 400, 500]]], dtype=uint16)
    """
    lights = check_tables(tables)
    bits = channel_bits(lights[0].shape[0])
    check_picture(picture)
    check_white_level(white_level)
    target = check_out(out, picture.shape, np.uint16)
    key = check_seed(seed, image)
    shape = (*picture.shape[:2], len(lights))
    pixel_weights = native(weights)
    if pixel_weights.ndim == 1:
        pixel_weights = check_weights(pixel_weights, len(lights))
    if pixel_weights.shape not in (shape, shape[2:]) or pixel_weights.dtype.kind not in "fiub":
        raise InputError(f"the weights are {value_text(pixel_weights)}, expected numbers {shape} or {shape[2:]}")
    pixel_weights = pixel_weights.astype(np.float32, copy=False)
    source, pixel_weights = packed_rows(picture), np.broadcast_to(pixel_weights, shape)
    if picture.shape[1] < BLOCK:
        source = np.pad(source, ((0, 0), (0, BLOCK), (0, 0)))
        pixel_weights = np.pad(pixel_weights, ((0, 0), (0, BLOCK), (0, 0)))
    work = writable(target) if source.shape == picture.shape else np.empty(source.shape, np.uint16)
    tables_in_memory = [readable(samples) for samples in lights]
    addresses = np.array([samples.ctypes.data for samples in tables_in_memory])
    pairs = (len(lights) + 1) // 2
    colours, count = lights[0].shape[:2]
    # The means of a pair, 32 bytes, must be in one cache line.
    memory = np.zeros(8 * pairs * colours + 15, np.float32)
    means = memory[-memory.ctypes.data % 64 // 4 :][: 8 * pairs * colours].reshape(colours, 2 * pairs, MEAN_BYTES // 4)
    # For a small picture, the means of all colours would take longer than the mixing.
    is_small = picture.shape[0] * picture.shape[1] < 10 * colours
    chosen_colours = np.flatnonzero(colours_in(picture, bits) if is_small else np.ones(colours, np.bool_))
    largest = [
        _fill_means(samples.ctypes.data, chosen_colours, count, means[:, light].ctypes.data, means.strides[0])
        for light, samples in enumerate(tables_in_memory)
    ]
    is_unclipped = np.array(largest) <= white_level
    faults: list[bool] = []
    no_weight = np.zeros(1, np.float32)

    def fill(top: int, bottom: int) -> None:
        scratch = np.zeros(
            SCRATCH_BYTES + FAULT_BYTES + 2 * SEGMENT_BYTES + PAIR_BYTES * pairs + _LINES_BYTES, np.uint8
        )
        plan = np.zeros((pairs, PLAN_ENTRIES), np.int64)
        _mix_pixels(
            source[top:].ctypes.data,
            source.strides[0],
            source.shape[1],
            bottom - top,
            addresses,
            means.ctypes.data,
            np.uint32(count),
            np.uint32(bits),
            pixel_weights[top:].ctypes.data,
            np.array(pixel_weights.strides),
            np.uint16(white_level),
            is_unclipped,
            key,
            image,
            first_row + top,
            work[top:].ctypes.data,
            work.strides[0],
            scratch.ctypes.data,
            plan,
            plan.ctypes.data,
            np.zeros((len(lights), 3), np.uint32),
            np.zeros(pairs, np.int64),
            no_weight.ctypes.data,
            work.nbytes >= streaming.STREAMED_BYTES,
        )
        faults.append(bool(np.isnan(scratch[SCRATCH_BYTES : SCRATCH_BYTES + FAULT_BYTES].view(np.float32)).any()))

    run_in_threads(fill, len(picture), threads)
    if any(faults):
        raise InputError("a weight is negative, infinite or NaN, expected finite numbers ≥ 0")
    if work is not target:
        target[...] = work[:, : target.shape[1]]
    return target
