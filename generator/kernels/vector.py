"""Kernel steps written as LLVM code: vectors of 16 numbers of 32 bits, and loads and stores by address.

numba does not vectorise pixel loops that shuffle bytes, and cannot load eight bytes from an arbitrary address. The
steps of this module do both; only compiled functions can call them. LLVM maps a vector to the registers of the
processor: one of AVX-512, two of AVX2 or four of NEON. Bytes are shuffled within 16 bytes, which all of these can do.

Addresses are plain integers, and the caller must ensure that they are valid. A docstring reports if a step reads or
writes bytes beyond its result. Large images are streamed: written past the caches, which then keep the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, Final

from llvmlite import ir

from foundation.compiled import inlined, intrinsic

LANES: Final = 16  # 32-bit numbers per vector: one register of AVX-512
GROUP: Final = 2 * LANES  # Pixels of a group; each word of a random vector chooses the samples of two pixels
EIGHT: Final = 8  # Pixels that are written to float32 planes together: one register of AVX2 per channel
SAMPLE_BYTES: Final = 6  # Bytes of a sample: red, green and blue, uint16 each
LINE: Final = 64  # Bytes of a cache line on x86-64 and on most arm64 processors

I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
F32 = ir.FloatType()
FLOATS = ir.VectorType(F32, LANES)
WORDS = ir.VectorType(I32, LANES)
_EIGHT_FLOATS, _EIGHT_WORDS = ir.VectorType(F32, EIGHT), ir.VectorType(I32, EIGHT)
_LINE = ir.VectorType(I32, LINE // 4)
ADDRESS: Final = "int64"

Builder = Any
Value = Any


def constant(ir_type: Any, numbers: int | Sequence[int]) -> Value:
    """Return a constant vector with one number in all lanes, or one number per lane."""
    return ir.Constant(ir_type, [numbers] * ir_type.count if isinstance(numbers, int) else list(numbers))


def broadcast(builder: Builder, number: Value, ir_type: Any) -> Value:
    """Return a vector with `number` in every lane."""
    unset = ir.Constant(ir_type, ir.Undefined)
    first = builder.insert_element(unset, number, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, unset, constant(ir.VectorType(I32, ir_type.count), 0))


def pointer_at(builder: Builder, address: Value, offset: int, ir_type: Any) -> Value:
    """Return a pointer of type `ir_type` to the memory `offset` bytes after `address`."""
    return builder.inttoptr(builder.add(address, ir.Constant(I64, offset)), ir_type.as_pointer())


def load(builder: Builder, address: Value, offset: int, ir_type: Any) -> Value:
    """Return the value of type `ir_type` at `offset` bytes after `address`, aligned or not."""
    loaded = builder.load(pointer_at(builder, address, offset, ir_type))
    loaded.align = 1
    return loaded


def store(builder: Builder, value: Value, address: Value, offset: int) -> None:
    """Write `value` to the memory `offset` bytes after `address`, aligned or not."""
    builder.store(value, pointer_at(builder, address, offset, value.type)).align = 1


def concatenated(builder: Builder, vectors: Sequence[Value]) -> Value:
    """Return vectors of equal size as one; their number is a power of two."""
    while len(vectors) > 1:
        lanes = constant(ir.VectorType(I32, 2 * vectors[0].type.count), range(2 * vectors[0].type.count))
        vectors = [builder.shuffle_vector(*vectors[i : i + 2], lanes) for i in range(0, len(vectors), 2)]
    return vectors[0]


def pixel_codes(builder: Builder, picture: Value) -> Value:
    """Return blue | green << 8 | red << 16 of the 16 pixels (48 bytes) at `picture`."""
    # Four pixels for each 16 bytes of the vector. The last load starts earlier, so that it ends with the last pixel.
    starts = (0, 12, 24, 32)
    loaded = concatenated(builder, [load(builder, picture, start, ir.VectorType(I8, 16)) for start in starts])
    lanes: list[int] = []
    for quarter, start in enumerate(starts):
        for pixel in range(4):
            first = 16 * quarter + 12 * quarter - start + 3 * pixel
            lanes += [first + 2, first + 1, first, 4 * LANES]
    zeros = constant(loaded.type, 0)
    mask = constant(ir.VectorType(I32, 4 * LANES), lanes)
    return builder.bitcast(builder.shuffle_vector(loaded, zeros, mask), WORDS)


def signature(returned: str, *type_names: str) -> Any:
    """Return numba's function type, from the names of the return type and the argument types."""
    from numba import types

    numba_types: Any = types
    return getattr(numba_types, returned)(*(getattr(numba_types, ir_type) for ir_type in type_names))


def step(*type_names: str, returned: str = "void") -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that turns an emitter of LLVM code into a function callable from compiled functions.

    The emitter takes a builder and one value for each of `type_names` (numba type names), and returns the result of the
    step.
    """

    def decorate(emit: Callable[..., Any]) -> Any:
        def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
            del signature
            value = emit(builder, *arguments)
            return context.get_dummy_value() if returned == "void" else value

        @wraps(emit)
        def typed(typing: Any, *arguments: Any) -> Any:
            del typing, arguments
            return signature(returned, *type_names), generate

        return intrinsic(typed)

    return decorate


@step(ADDRESS, returned="int64")
def offset_at(builder: Builder, source: Value) -> Value:
    """Return the uint32 at `source` as int64, to be added to an address."""
    return builder.zext(load(builder, source, 0, I32), I64)


@step(ADDRESS, ADDRESS)
def copy8(builder: Builder, source: Value, target: Value) -> None:
    """Copy a sample and the two bytes after it."""
    store(builder, load(builder, source, 0, I64), target, 0)


@step(ADDRESS, ADDRESS)
def copy6(builder: Builder, source: Value, target: Value) -> None:
    """Copy a sample."""
    store(builder, load(builder, source, 0, I32), target, 0)
    store(builder, load(builder, source, 4, I16), target, 4)


@step(ADDRESS, ADDRESS)
def copy2(builder: Builder, source: Value, target: Value) -> None:
    """Copy one channel of a sample."""
    store(builder, load(builder, source, 0, I16), target, 0)


@step(ADDRESS, ADDRESS)
def copy_line(builder: Builder, source: Value, target: Value) -> None:
    """Copy the bytes of a cache line."""
    store(builder, load(builder, source, 0, _LINE), target, 0)


@step(ADDRESS, ADDRESS)
def stream_line(builder: Builder, source: Value, target: Value) -> None:
    """Copy a cache line past the caches to `target`, a multiple of `LINE`; call `store_fence` afterwards."""
    written = builder.store(load(builder, source, 0, _LINE), pointer_at(builder, target, 0, _LINE))
    written.align = LINE
    written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(I32, 1)]))


@step()
def store_fence(builder: Builder) -> None:
    """Wait until all threads can see the streamed bytes."""
    builder.fence("seq_cst")


@step(ADDRESS, ADDRESS)
def copy1(builder: Builder, source: Value, target: Value) -> None:
    """Copy one byte."""
    store(builder, load(builder, source, 0, I8), target, 0)


def _channels(builder: Builder, samples: Value, offsets: Value, step: int) -> list[Value]:
    # Returns red, green and blue of eight samples, eight float32 each; the offsets are `step` bytes apart.
    pairs = [
        [
            load(
                builder,
                builder.add(samples, builder.zext(load(builder, offsets, step * pixel, I32), I64)),
                0,
                ir.VectorType(I32, 2),
            )
            for pixel in couple
        ]
        for couple in ((0, 1), (4, 5), (2, 3), (6, 7))
    ]
    fours = [builder.shuffle_vector(*pair, constant(ir.VectorType(I32, 4), range(4))) for pair in pairs]
    # The two halves are pixels 0, 1, 4, 5 and 2, 3, 6, 7. A pixel has 32 bits of red and green, then 16 of blue and 16
    # that are unused.
    halves = [builder.shuffle_vector(*fours[i : i + 2], constant(_EIGHT_WORDS, range(EIGHT))) for i in (0, 2)]
    front = builder.shuffle_vector(*halves, constant(_EIGHT_WORDS, (0, 2, 8, 10, 4, 6, 12, 14)))
    back = builder.shuffle_vector(*halves, constant(_EIGHT_WORDS, (1, 3, 9, 11, 5, 7, 13, 15)))
    low = constant(_EIGHT_WORDS, 0xFFFF)
    numbers = (builder.and_(front, low), builder.lshr(front, constant(_EIGHT_WORDS, 16)), builder.and_(back, low))
    return [builder.sitofp(number, _EIGHT_FLOATS) for number in numbers]


def minimum(builder: Builder, first: Value, second: Value) -> Value:
    """Return the smaller of two numbers in each lane."""
    return builder.select(builder.fcmp_ordered("<", first, second), first, second)


def _write_planes8(
    builder: Builder, samples: Value, offsets: Value, stride: int, scales: Value, targets: Sequence[Value]
) -> None:

    def broadcast_value(index: int) -> Value:
        return broadcast(builder, load(builder, scales, 4 * index, F32), _EIGHT_FLOATS)

    for index, (channel, target) in enumerate(zip(_channels(builder, samples, offsets, stride), targets, strict=True)):
        value = builder.fadd(builder.fmul(channel, broadcast_value(index)), broadcast_value(3 + index))
        store(builder, minimum(builder, value, broadcast_value(6)), target, 0)


@step(*[ADDRESS] * 6)
def planes8(
    builder: Builder, samples: Value, offsets: Value, scales: Value, red: Value, green: Value, blue: Value
) -> None:
    """Write eight pixels as float32 to three planes: min(sample · factor + summand, limit).

    `scales` is the address of seven float32: factors and summands of red, green and blue, and the limit.
    """
    _write_planes8(builder, samples, offsets, 4, scales, (red, green, blue))


@step(*[ADDRESS] * 6)
def planes8_mirrored(
    builder: Builder, samples: Value, offsets: Value, scales: Value, red: Value, green: Value, blue: Value
) -> None:
    """Write eight pixels mirrored, as `planes8` does; `offsets` is the address of the last of eight offsets."""
    _write_planes8(builder, samples, offsets, -4, scales, (red, green, blue))


@step(ADDRESS, "float32", "float32", "float32", ADDRESS)
def plane1(builder: Builder, source: Value, factor: Value, summand: Value, limit: Value, target: Value) -> None:
    """Write one channel of one pixel as `planes8` does, for crops narrower than eight pixels."""
    value = builder.fmul(builder.uitofp(load(builder, source, 0, I16), F32), factor)
    store(builder, minimum(builder, builder.fadd(value, summand), limit), target, 0)


BLOCK: Final = 8  # Pixels mixed at a time: their weights under two illuminants fill a vector of 16
MEAN_BYTES: Final = 16  # Bytes of the mean of a colour under one illuminant: red, green, blue, padding; float32
PLAN_ENTRIES: Final = 6  # Addresses per pair of illuminants in the plan of `mix`
FAULT_BYTES: Final = 4 * LANES  # Bytes of the 16 fault marks, float32 that become NaN if a weight is invalid

_QUAD: Final = 4  # Numbers per pixel in a vector: red, green, blue and padding
_SHORTS: Final = ir.VectorType(I16, 2 * LANES)
# The eight pixels of a block are mixed in these pairs. This order lets `_store_pixels` shuffle within 16 bytes.
_PIXEL_PAIRS: Final = ((0, 2), (4, 6), (1, 3), (5, 7))
# Pixel and illuminant of each weight of a block in the order of `arrange_weights`, which follows `_PIXEL_PAIRS`.
_ORDER: Final = tuple((_PIXEL_PAIRS[lane % _QUAD][lane // (2 * _QUAD)], lane // _QUAD % 2) for lane in range(LANES))


@step(ADDRESS, "int64", ADDRESS, returned="int64")
def mean4(builder: Builder, source: Value, count: Value, target: Value) -> Value:
    """Write the mean of `count` ≥ 1 consecutive samples as four float32; the fourth is padding.

    Returns the largest channel value of the samples.
    """
    from numba.core import cgutils

    integers, reals = ir.VectorType(I64, _QUAD), ir.VectorType(ir.DoubleType(), _QUAD)
    total, largest = (cgutils.alloca_once_value(builder, ir.Constant(integers, [0] * _QUAD)) for _ in range(2))
    with cgutils.for_range(builder, count) as loop:
        address = builder.add(source, builder.mul(loop.index, ir.Constant(I64, SAMPLE_BYTES)))
        sample = builder.zext(load(builder, address, 0, ir.VectorType(I16, _QUAD)), integers)
        builder.store(builder.add(builder.load(total), sample), total)
        previous = builder.load(largest)
        builder.store(builder.select(builder.icmp_unsigned(">", sample, previous), sample, previous), largest)
    divisor = broadcast(builder, builder.sitofp(count, ir.DoubleType()), reals)
    mean = builder.fdiv(builder.sitofp(builder.load(total), reals), divisor)
    store(builder, builder.fptrunc(mean, ir.VectorType(F32, _QUAD)), target, 0)
    largest_channel = ir.Constant(I64, 0)
    for channel in range(3):
        value = builder.extract_element(builder.load(largest), ir.Constant(I32, channel))
        largest_channel = builder.select(builder.icmp_unsigned(">", value, largest_channel), value, largest_channel)
    return largest_channel


def _for_each_block(builder: Builder, weights: Value, count: Value, process: Callable[[Value, Value], None]) -> None:
    # Calls `process` for each block of eight pixels, with its weights under two illuminants and its index.
    with _blocks(builder, count) as (block, begin):
        process(load(builder, builder.add(weights, builder.shl(begin, ir.Constant(I64, 3))), 0, WORDS), block)


def _any_nonzero(builder: Builder, words: Value) -> Value:
    # Sets bit 0 if an even lane is not 0, and bit 1 if an odd lane is not 0.
    flags = ir.Constant(I64, 0)
    for light in range(2):
        lanes = constant(_EIGHT_WORDS, range(light, LANES, 2))
        light_words = builder.shuffle_vector(words, words, lanes)
        is_nonzero = builder.bitcast(builder.icmp_unsigned("!=", light_words, constant(_EIGHT_WORDS, 0)), I8)
        is_nonzero = builder.zext(builder.icmp_unsigned("!=", is_nonzero, ir.Constant(I8, 0)), I64)
        flags = builder.or_(flags, builder.shl(is_nonzero, ir.Constant(I64, light)))
    return flags


@step(ADDRESS, "int64", returned="int64")
def weight_flags(builder: Builder, weights: Value, count: Value) -> Value:
    """Return four flags for the weights of two illuminants at `count` ≥ 8 pixels; a pixel has two float32 weights.

    Bits 0 and 1 are set if any weight of the first and second illuminant is not 0; bits 2 and 3 if any is not 1.
    """
    from numba.core import cgutils

    ones = builder.bitcast(ir.Constant(FLOATS, [1.0] * LANES), WORDS)
    accumulators = [cgutils.alloca_once_value(builder, constant(WORDS, 0)) for _ in range(2)]

    def accumulate(line: Value, block: Value) -> None:
        del block
        for accumulator, words in zip(accumulators, (line, builder.xor(line, ones)), strict=True):
            builder.store(builder.or_(builder.load(accumulator), words), accumulator)

    _for_each_block(builder, weights, count, accumulate)
    nonzero, not_one = (_any_nonzero(builder, builder.load(accumulator)) for accumulator in accumulators)
    return builder.or_(nonzero, builder.shl(not_one, ir.Constant(I64, 2)))


@step(ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS)
def interleave_weights(
    builder: Builder, first: Value, first_step: Value, second: Value, second_step: Value, target: Value
) -> None:
    """Write the weights of eight pixels under two illuminants alternately. Both steps are in bytes."""
    line = ir.Constant(FLOATS, ir.Undefined)
    for lane in range(LANES):
        weights, stride = ((first, first_step), (second, second_step))[lane % 2]
        address = builder.add(weights, builder.mul(stride, ir.Constant(I64, lane // 2)))
        line = builder.insert_element(line, load(builder, address, 0, F32), ir.Constant(I32, lane))
    store(builder, line, target, 0)


@step(ADDRESS, "int64", ADDRESS, returned="int64")
def arrange_weights(builder: Builder, weights: Value, count: Value, target: Value) -> Value:
    """Write weights, stored as for `weight_flags`, in the order of `mix`: 64 bytes for eight pixels.

    Returns bits 0 and 1 of `weight_flags`.
    """
    from numba.core import cgutils

    lanes = constant(WORDS, [2 * pixel + light for pixel, light in _ORDER])
    accumulator = cgutils.alloca_once_value(builder, constant(WORDS, 0))

    def write_line(line: Value, block: Value) -> None:
        builder.store(builder.or_(builder.load(accumulator), line), accumulator)
        address = builder.add(target, builder.shl(block, ir.Constant(I64, 6)))
        store(builder, builder.shuffle_vector(line, line, lanes), address, 0)

    _for_each_block(builder, weights, count, write_line)
    return _any_nonzero(builder, builder.load(accumulator))


@contextmanager
def _blocks(builder: Builder, count: Value) -> Generator[tuple[Value, Value]]:
    """Loop over `count` ≥ 8 pixels in blocks of eight; yield the index and the first pixel of each block.

    If `count` is no multiple of eight, the last block overlaps the previous one.
    """
    from numba.core import cgutils

    blocks = builder.lshr(builder.add(count, ir.Constant(I64, BLOCK - 1)), ir.Constant(I64, 3))
    last = builder.sub(count, ir.Constant(I64, BLOCK))
    with cgutils.for_range(builder, blocks) as loop:
        begin = builder.shl(loop.index, ir.Constant(I64, 3))
        yield loop.index, builder.select(builder.icmp_signed("<", begin, last), begin, last)


def _store_pixels(builder: Builder, even_pixels: Value, odd_pixels: Value, target: Value) -> None:
    packed = builder.bitcast(builder.or_(even_pixels, builder.shl(odd_pixels, constant(WORDS, 16))), _SHORTS)
    # Each quarter holds red, red, green, green, blue, blue of two pixels, and two numbers of padding.
    lanes = [8 * quarter + lane for quarter in range(_QUAD) for lane in (0, 2, 4, 1, 3, 5)]
    for span in (slice(0, 16), slice(16, 24)):
        ir_type = ir.VectorType(I32, len(lanes[span]))
        store(builder, builder.shuffle_vector(packed, packed, constant(ir_type, lanes[span])), target, 2 * span.start)


def _mix_pair(
    builder: Builder, addresses: Sequence[Value], block: Value, position: Value, means: Value
) -> tuple[list[Value], Value]:
    # Returns the sums of two illuminants in the even and in the odd pixels, and the fault marks of the weights.
    weights, *other_addresses = addresses
    offsets, samples, mean_base = other_addresses[:2], other_addresses[2:4], other_addresses[4]
    name = f"llvm.sqrt.v{LANES}f32"
    function_type = ir.FunctionType(FLOATS, [FLOATS])
    square_root = builder.module.globals.get(name) or ir.Function(builder.module, function_type, name)
    weight = load(builder, builder.add(weights, builder.shl(block, ir.Constant(I64, 6))), 0, FLOATS)
    root = builder.call(square_root, [weight])
    remainder = builder.fsub(weight, root)
    # A fault mark is 0, or NaN for an invalid weight: the root of a negative number and 0 times infinity are NaN.
    fault = builder.fmul(root, ir.Constant(FLOATS, [0.0] * LANES))
    sums: list[Value] = []
    for lane, pixels in enumerate(_PIXEL_PAIRS):

        def fetch(base: Value, offset_row: Value, pixel: int, value_type: Any) -> Value:
            offset = builder.zext(load(builder, builder.add(offset_row, position), 4 * pixel, I32), I64)
            return load(builder, builder.add(base, offset), 0, value_type)

        def repeated(numbers: Value, lane: int = lane) -> Value:
            lanes = [_QUAD * (position // _QUAD) + lane for position in range(LANES)]
            return builder.shuffle_vector(numbers, numbers, constant(WORDS, lanes))

        drawn = [
            fetch(base, offset_row, pixel, ir.VectorType(I16, 4))
            for pixel in pixels
            for base, offset_row in zip(samples, offsets, strict=True)
        ]
        mean = [fetch(mean_base, means, pixel, ir.VectorType(F32, 2 * _QUAD)) for pixel in pixels]
        noisy = builder.fmul(builder.sitofp(builder.zext(concatenated(builder, drawn), WORDS), FLOATS), repeated(root))
        sums.append(builder.fadd(noisy, builder.fmul(concatenated(builder, mean), repeated(remainder))))
    totals: list[Value] = []
    for pair_sums in (sums[:2], sums[2:]):
        light_sums = [
            builder.shuffle_vector(
                *pair_sums, constant(WORDS, [8 * pixel + _QUAD * light + i for pixel in range(4) for i in range(4)])
            )
            for light in range(2)
        ]
        totals.append(builder.fadd(*light_sums))
    return totals, fault


@step(ADDRESS, "int64", "int64", ADDRESS, ADDRESS, "float32", ADDRESS)
def mix(
    builder: Builder, plan: Value, pairs: Value, count: Value, means: Value, faults: Value, white: Value, target: Value
) -> None:
    """Write `count` ≥ 8 pixels under pairs of illuminants as uint16, rounded and clipped to 0 … `white`.

    `mixing.py` has the formula. `plan` is the address of `PLAN_ENTRIES` addresses per pair: weights from
    `arrange_weights`, sample offsets of the first and second illuminant, samples of the first and second illuminant,
    and means of all colours. `means` is the address of the offset of each pixel's mean. Some of the 16 float32 at
    `faults` become NaN if a weight is negative, infinite or NaN.
    """
    from numba.core import cgutils

    def number(value: int) -> Value:
        return ir.Constant(I64, value)

    def addresses(pair: Value) -> list[Value]:
        entry = builder.add(plan, builder.mul(pair, number(8 * PLAN_ENTRIES)))
        return [load(builder, entry, 8 * i, I64) for i in range(PLAN_ENTRIES)]

    zero, half = ir.Constant(FLOATS, [0.0] * LANES), ir.Constant(FLOATS, [0.5] * LANES)
    upper_limit = broadcast(builder, white, FLOATS)
    fault = cgutils.alloca_once_value(builder, load(builder, faults, 0, FLOATS))
    sums = [cgutils.alloca_once(builder, FLOATS) for _ in range(2)]

    def fill(compute: Callable[[Value, Value], Sequence[Value]]) -> None:
        with _blocks(builder, count) as (block, begin):
            rounded: list[Value] = []
            for value in compute(block, builder.shl(begin, number(2))):
                shifted = builder.fadd(value, half)
                shifted = builder.select(builder.fcmp_ordered(">", shifted, zero), shifted, zero)
                rounded.append(builder.fptosi(minimum(builder, shifted, upper_limit), WORDS))
            _store_pixels(
                builder, rounded[0], rounded[1], builder.add(target, builder.mul(begin, number(SAMPLE_BYTES)))
            )

    def mix_pair(entries: Sequence[Value], block: Value, position: Value) -> Sequence[Value]:
        totals, pair_fault = _mix_pair(builder, entries, block, position, means)
        builder.store(builder.fadd(builder.load(fault), pair_fault), fault)
        return totals

    def mix_all_pairs(block: Value, position: Value) -> Sequence[Value]:
        for total in sums:
            builder.store(zero, total)
        with cgutils.for_range(builder, pairs) as loop:
            for total, value in zip(sums, mix_pair(addresses(loop.index), block, position), strict=True):
                builder.store(builder.fadd(builder.load(total), value), total)
        return [builder.load(total) for total in sums]

    with builder.if_else(builder.icmp_signed("==", pairs, number(1))) as (single, several):
        with single:
            entries = addresses(number(0))
            fill(lambda block, position: mix_pair(entries, block, position))
        with several:
            fill(mix_all_pairs)
    store(builder, builder.load(fault), faults, 0)


# Images of this size or larger are streamed, bytes: the size of the last-level cache of a desktop processor.
STREAMED_BYTES: Final = 24 << 20


def line_buffer_bytes(segment_bytes: int) -> int:
    """Return the buffer size for a segment of a row, with reserve because both may begin anywhere in a cache line."""
    return segment_bytes + 3 * LINE


@inlined
def first_line(buffer: int) -> int:
    """Return the address of the first whole cache line in the memory at `buffer`."""
    return (buffer + LINE - 1) & -LINE


@inlined
def stream_lines(lines: int, begin: int, stop: int, last: bool) -> int:
    """Stream the buffer at `lines` to the target addresses `begin` … `stop` − 1; `begin` and `stop` are even.

    The buffer starts with the cache line of `begin`, but bytes before `begin` are not written. Unless this is the
    `last` segment of the row, an incomplete last line stays in the buffer for the next call. Returns the number of its
    bytes.
    """
    source, line_target = lines, begin & -LINE
    if begin > line_target:
        for i in range(begin - line_target, min(LINE, stop - line_target), 2):
            copy2(source + i, line_target + i)
        source, line_target = source + LINE, line_target + LINE
    while line_target + LINE <= stop:
        stream_line(source, line_target)
        source, line_target = source + LINE, line_target + LINE
    if last:
        for i in range(0, stop - line_target, 2):
            copy2(source + i, line_target + i)
    else:
        copy_line(source, lines)
    return stop - line_target
