"""Several lights at once, with the noise that one exposure under all of them would have.

Light is additive: under lights i of weights w_i a colour's mean is Σ w_i m_i, m_i its mean under light i alone. Noise
is not: a sample is x_i = m_i + n_i, where the variance of n_i is g m_i + r² (photons at gain g, and read noise r), and
one exposure under all lights has the variance g Σ w_i m_i + r². A weighted mean of samples would have g Σ w_i² m_i,
too quiet by half for two equal lights. Scaling deviations by the square root of the weight,

    y = Σ w_i m_i + Σ √w_i (x_i − m_i),   x_i drawn for each light on its own,

has the variance Σ w_i (g m_i + r²): photon noise exact for any weights, read noise exact where the weights sum to 1
and √(Σ w_i) times too large otherwise. Weight 1 of one light gives that light's samples to the last bit.

What is approximate: m_i is the mean of the table's S samples and not of all paper of that colour; print and pixel
patterns that deviate in proportion to the light count as noise (their mixture is too quiet by √(Σ w_i²) for lights of
one brightness); samples clipped by the sensor stay clipped before they are mixed.

Here are images, whose weights change from pixel to pixel, and whole tables (`mixed_table`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32

from foundation.compiled import compiled, inlined
from foundation.errors import InputError
from generator import philox
from generator.kernels import vector as streaming
from generator.kernels.choice import (
    OFFSETS_BYTES,
    SCRATCH_BYTES,
    Picture,
    Samples,
    bits_of,
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
def _mix_table(samples: Any, weight: float, seed: Any, place: int, shuffled: bool, chosen: Any, total: Any) -> None:
    """Add one light to `total` (N, S, 3) float64, each chosen colour's samples in the order of a shuffle of its own."""
    count = samples.shape[1]
    root = np.sqrt(weight)
    order = np.empty(count, np.uint32)
    for i in range(count):
        order[i] = i
    words = np.empty(count + 3, np.uint32)
    rest = np.empty(3)
    for number, colour in enumerate(chosen):
        drawn, sums = samples[colour], total[number]
        if shuffled:
            for i in range(0, count, 4):
                words[i], words[i + 1], words[i + 2], words[i + 3] = philox4x32(
                    np.uint32(colour), np.uint32(i // 4), np.uint32(place), _MIXTURES, seed
                )
            for i in range(count):
                order[i] = i
            for i in range(count - 1):
                j = i + np.int64((np.uint64(words[i]) * np.uint64(count - i)) >> np.uint64(32))
                order[i], order[j] = order[j], order[i]
        red = green = blue = 0
        for i in range(count):
            red, green, blue = red + drawn[i, 0], green + drawn[i, 1], blue + drawn[i, 2]
        for channel, mean in enumerate((red / count, green / count, blue / count)):
            rest[channel] = (weight - root) * mean
        for i in range(count):
            sample = drawn[order[i]]
            for channel in range(3):
                sums[i, channel] += root * sample[channel] + rest[channel]


@compiled
def _round_table(total: Any, white: float, chosen: Any, out: Any) -> None:
    for number, colour in enumerate(chosen):
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
    """Return the samples of a light that is the mixture of some lights; the formula stands at the head of `mixing.py`.

    The result is used as a light's samples: `draw_samples(mixed_table(...), picture)`. Each colour's samples of the
    first light with a weight keep their order; those of each further light are shuffled on their own, so that the
    lights' noises meet by chance.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16 or a sequence of K (8**bits, S, 3), linear camera RGB of the lights.
    weights
        (K,) float ≥ 0, what each light contributes; 1 is the light as it was photographed.
    white_level
        Saturation of the sensor, 1 … 65535: larger values are cut to it.
    seed
        Of the shuffles, 0 … 2⁶⁴ − 1.
    colours
        (8**bits,) bool, which colours are wanted, as from `palette.colours_in`; None for all. For a small picture it is
        much less work. The samples of the others are 0; those of the wanted ones do not depend on it.

    Returns
    -------
    ndarray
        (8**bits, S, 3) uint16, linear camera RGB, rounded to the nearest count, halves up.

    Raises
    ------
    InputError
        A shape, type or number is not as above.

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
    chosen = np.flatnonzero(np.ones(shape[0], np.bool_) if colours is None else colours)
    total = np.zeros((len(chosen), *shape[1:]), np.float64)
    shuffled = False
    for place, (samples, weight) in enumerate(zip(lights, checked, strict=True)):
        if weight > 0:
            _mix_table(np.asarray(samples), float(weight), key, place, shuffled, chosen, total)
            shuffled = True
    out = np.zeros(shape, np.uint16)
    _round_table(total, float(white_level), chosen, out)
    return out


# Pixels of a row that are mixed together, whole groups: their weights and offsets stay in the second-level cache.
SEGMENT_PIXELS: Final = 512
# Pixels by which prefetching weights leads reading them: eight segments: time for the memory to answer.
_PREFETCH_PIXELS: Final = 4096
# Bytes of a segment's offsets, or of one light's weights; a row's last may be longer by up to seven pixels.
SEGMENT_BYTES: Final = OFFSETS_BYTES * (SEGMENT_PIXELS // GROUP + 1)
# Bytes of a segment's weights in the order of pixels and in that of `mix`, and of its offsets, for two lights each.
PAIR_BYTES: Final = 6 * SEGMENT_BYTES
# Bytes of a segment that is put together before it is streamed.
_LINES_BYTES: Final = line_buffer_bytes(SAMPLE_BYTES * (SEGMENT_PIXELS + BLOCK))


@compiled
def _fill_means(samples: int, chosen: Any, count: int, means: int, step: int) -> int:
    """Write each chosen colour's mean, `step` bytes from one to the next; return the largest number of the samples."""
    most = 0
    for colour in chosen:
        most = max(most, mean4(samples + SAMPLE_BYTES * count * colour, count, means + step * colour))
    return most


@inlined
def _single_light(pair_weights: Any, count: int) -> int:
    """Return the only light with weights other than 0 in a segment's first pixels if they are all 1, else -1."""
    lit, single = 0, -1
    for pair in range(len(pair_weights)):
        seen = weight_flags(pair_weights[pair], count)
        for member in range(2):
            if seen >> member & 1:
                lit += 1
                if not seen >> 2 + member & 1:
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
    """Fill the groups `low` … `high` − 1 of a row under one light; the row's first pixel would go to `base`.

    A function of its own, as `_mix_segment`: both within the loop of rows are more than the registers hold. With each
    group `lines_per_group` lines of weights are prefetched, the first at address `prefetch_from`.
    """
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
    """Fill the groups `low` … `high` − 1 of a row, `pixels` in all, under lights with weights.

    `pair_weights` are the addresses of each pair's weights. Scratch memory holds, in this order, a row's last pixels,
    the marks of faulty weights, the colours' offsets in means and in samples, and each pair's weights and offsets. A
    light whose weights are all 0 adds nothing and needs no offsets. With each group `lines_per_group` lines of weights
    are prefetched, the first at address `prefetch_from`.
    """
    pairs = len(pair_weights)
    faults = scratch + SCRATCH_BYTES
    mean_places = faults + FAULT_BYTES
    colours = mean_places + SEGMENT_BYTES
    lines = colours + SEGMENT_BYTES
    for group in range(low, high):
        place = OFFSETS_BYTES * (group - low)
        prefetch_group(row, group)
        for line in range(lines_per_group):
            prefetch(prefetch_from + LINE * (lines_per_group * (group - low) + line))
        source = group_address(row, width, group, scratch)
        mean_stride, stride = uint32(2 * MEAN_BYTES * pairs), uint32(SAMPLE_BYTES * count)
        write_colours(source, bits, mean_stride, mean_places + place, stride, colours + place)
    lit_pairs = 0
    for pair in range(pairs):
        line, light = lines + PAIR_BYTES * pair + 2 * SEGMENT_BYTES, 2 * pair
        lit = arrange_weights(pair_weights[pair], pixels, line)
        if not lit:
            continue
        plan[lit_pairs, 0], plan[lit_pairs, 5] = line, means + 2 * MEAN_BYTES * pair
        for member in range(2):
            # A light without weight is replaced by its partner.
            shown = member if lit >> member & 1 else 1 - member
            offsets = line + SEGMENT_BYTES * (2 + shown)
            plan[lit_pairs, 1 + member], plan[lit_pairs, 3 + member] = offsets, tables[light + shown]
            if shown != member:
                continue
            k0, k1, k2 = keys[light + shown, 0], keys[light + shown, 1], keys[light + shown, 2]
            for group in range(low, high):
                place, word = OFFSETS_BYTES * (group - low), uint32(LANES * group)
                choose_for_colours(colours + place, word, k0, k1, k2, count, offsets + place)
        lit_pairs += 1
    mix(plan_at, lit_pairs, pixels, mean_places, faults, np.float32(white), target)


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
    within: Any,
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
    """Fill rows of at least eight pixels. `weight_steps` are the bytes from row to row, pixel to pixel, light to light.

    A row is done segment by segment. Where only one light has weights in a segment, all of them 1, and its samples are
    `within` the white level, the segment is drawn as under one light.
    """
    lights, pairs = len(tables), len(pair_weights)
    lines = scratch + SCRATCH_BYTES + FAULT_BYTES + 2 * SEGMENT_BYTES
    held_lines = first_line(lines + PAIR_BYTES * pairs)
    uniform = weight_steps[0] == 0 and weight_steps[1] == 0
    # Lines of the weights of a group, where those of a pixel lie together.
    lines_per_group = GROUP * weight_steps[1] // LINE if weight_steps[1] == 4 * lights else 0
    for y in range(rows):
        row, start = picture + y * pitch, 0
        begin = target + y * target_pitch
        held = begin & (LINE - 1)
        for light in range(lights):
            keys[light, 0], keys[light, 1], keys[light, 2] = row_keys(first_row + y, light, image, seed)
        while start < width:
            # What is left after a segment must not be fewer than eight pixels.
            end = width if width - start < SEGMENT_PIXELS + BLOCK else start + SEGMENT_PIXELS
            pixels, low, high = end - start, start // GROUP, (end + GROUP - 1) // GROUP
            for pair in range(pairs):
                line, light = lines + PAIR_BYTES * pair, 2 * pair
                first, step = weights + y * weight_steps[0] + light * weight_steps[2], weight_steps[1]
                # Where lights are odd in number, the last one's partner never has a weight.
                second, second_step = (first + weight_steps[2], step) if light + 1 < lights else (zero_weight, 0)
                if step == 8 and second == first + 4:
                    pair_weights[pair] = first + step * start
                    continue
                pair_weights[pair] = line
                if not uniform or (y == 0 and start == 0):
                    for i in range(0, SEGMENT_PIXELS + BLOCK if uniform else pixels, BLOCK):
                        x = i if uniform else min(i, pixels - BLOCK)
                        at, other = first + step * (start + x), second + second_step * (start + x)
                        interleave_weights(at, step, other, second_step, line + 8 * x)
            prefetch_from = weights + y * weight_steps[0] + (end + _PREFETCH_PIXELS) * weight_steps[1]
            to = target + y * target_pitch + SAMPLE_BYTES * start
            stop = to + SAMPLE_BYTES * pixels
            if streamed:
                to = held_lines + held
            # The first pixels show in most cases that several lights are lit.
            single = _single_light(pair_weights, BLOCK)
            if single >= 0:
                single = _single_light(pair_weights, pixels)
            if single >= 0 and within[single]:
                its_keys, base = (keys[single, 0], keys[single, 1], keys[single, 2]), to - SAMPLE_BYTES * start
                _draw_segment(
                    row,
                    width,
                    low,
                    high,
                    its_keys,
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
                    to,
                )
            if streamed:
                held = stream_lines(held_lines, begin, stop, end == width)
                begin = stop - held
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
    """Return the raw linear image of `picture` under several lights, mixed in each pixel by weights of its own.

    The formula stands at the head of this file. Each light's sample is drawn by the rule of `choice.py` with the
    light's place in `tables`; where light 0 is alone with weight 1, the pixel is that of `draw_samples`.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16 or a sequence of K (8**bits, S, 3), linear camera RGB of the lights.
    picture
        (H, W, 3) uint8 sRGB codes.
    weights
        (H, W, K) float32 ≥ 0, or (K,) for all pixels: what each light contributes; 1 is the light as photographed.
    white_level
        Saturation of the sensor: larger values are cut to it.
    seed, image, first_row, threads
        As for `rendering.draw_samples`.
    out
        (H, W, 3) uint16 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, computed in float32, rounded to the nearest count, halves up. What lights 2 j and 2 j + 1 give
        is added up first, then the pairs in their order.

    Raises
    ------
    InputError
        A shape, type or number is not as above.

    Examples
    --------
    Two lights on a white wall, the left half in the first, the right half in both:

    >>> red, blue = np.zeros((2, 8, 25, 3), np.uint16)
    >>> red[7], blue[7] = (800, 400, 200), (200, 400, 800)
    >>> weights = np.array([[[1, 0], [0.5, 0.5]]], np.float32)
    >>> mix_samples([red, blue], np.full((1, 2, 3), 255, np.uint8), weights)
    array([[[800, 400, 200],
            [500, 400, 500]]], dtype=uint16)
    """
    lights = check_tables(tables)
    bits = bits_of(lights[0].shape[0])
    check_picture(picture)
    check_white_level(white_level)
    target = check_out(out, picture.shape, np.uint16)
    key = check_seed(seed, image)
    shape = (*picture.shape[:2], len(lights))
    each = np.asarray(weights)
    if each.dtype != np.float32:
        each = check_weights(each, len(lights)).astype(np.float32)
    if each.shape not in (shape, shape[2:]):
        raise InputError(f"the weights are {each.shape}, expected {shape} or {shape[2:]}")
    source, each = packed_rows(picture), np.broadcast_to(each, shape)
    if picture.shape[1] < BLOCK:
        source = np.pad(source, ((0, 0), (0, BLOCK), (0, 0)))
        each = np.pad(each, ((0, 0), (0, BLOCK), (0, 0)))
    work = writable(target) if source.shape == picture.shape else np.empty(source.shape, np.uint16)
    pieces = [readable(samples) for samples in lights]
    addresses = np.array([piece.ctypes.data for piece in pieces])
    pairs = (len(lights) + 1) // 2
    colours, count = lights[0].shape[:2]
    # A pair's means, 32 bytes, are to lie in one line of the cache.
    memory = np.zeros(8 * pairs * colours + 15, np.float32)
    means = memory[-memory.ctypes.data % 64 // 4 :][: 8 * pairs * colours].reshape(colours, 2 * pairs, MEAN_BYTES // 4)
    # The means of a whole light take longer than a small picture.
    small = picture.shape[0] * picture.shape[1] < 10 * colours
    chosen = np.flatnonzero(colours_in(picture, bits) if small else np.ones(colours, np.bool_))
    most = [
        _fill_means(samples.ctypes.data, chosen, count, means[:, light].ctypes.data, means.strides[0])
        for light, samples in enumerate(pieces)
    ]
    within = np.array(most) <= white_level
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
            each[top:].ctypes.data,
            np.array(each.strides),
            np.uint16(white_level),
            within,
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
        raise InputError("a weight is negative, infinite or NaN; expected finite numbers from 0")
    if work is not target:
        target[...] = work[:, : target.shape[1]]
    return target
