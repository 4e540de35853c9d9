"""Steps of the kernels written in LLVM's own terms: vectors of 16 32-bit numbers, and loads and stores by address.

numba compiles loops well, but does not put many pixels into one vector where bytes must be shuffled, and knows no load
of eight bytes from any address. These functions can be called from compiled functions only. LLVM makes of them
whatever the processor has: one vector of AVX-512, two of AVX2, four of NEON. Bytes change places within 16, which all
can do.

Addresses are plain integers; whoever calls must keep them inside arrays. What may be read or written beyond is said
with each function. First come steps that all kernels share, then those that write past the caches an image that they
could not keep, so that they keep the table, then those of `mixing.py`.
What chooses samples, and prefetches, is in `choice.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, Final

from llvmlite import ir

from foundation.compiled import inlined, intrinsic

LANES: Final = 16  # Numbers of 32 bits in a vector: one register of AVX-512
GROUP: Final = 2 * LANES  # Pixels whose choices come from one vector of words, two from each word; see `choice.py`
EIGHT: Final = 8  # Pixels that are written to float32 planes at a time: one register of AVX2 a channel
SAMPLE_BYTES: Final = 6  # Bytes of a sample: red, green and blue, uint16 each
LINE: Final = 64  # Bytes of a line of the cache, on x86-64 and on most arm64 processors

I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
F32 = ir.FloatType()
FLOATS = ir.VectorType(F32, LANES)
WORDS = ir.VectorType(I32, LANES)
_EIGHT_FLOATS, _EIGHT_WORDS = ir.VectorType(F32, EIGHT), ir.VectorType(I32, EIGHT)
_LINE = ir.VectorType(I32, LINE // 4)
ADDRESS: Final = "int64"

Builder = Any
Value = Any


def constant(kind: Any, numbers: int | Sequence[int]) -> Value:
    """Return a constant vector, of one number in every lane or of a number a lane."""
    return ir.Constant(kind, [numbers] * kind.count if isinstance(numbers, int) else list(numbers))


def broadcast(builder: Builder, number: Value, kind: Any) -> Value:
    """Return a vector whose every lane is `number`."""
    unset = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(unset, number, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, unset, constant(ir.VectorType(I32, kind.count), 0))


def pointer_at(builder: Builder, address: Value, offset: int, kind: Any) -> Value:
    """Return a pointer of that kind to the memory `offset` bytes behind `address`."""
    return builder.inttoptr(builder.add(address, ir.Constant(I64, offset)), kind.as_pointer())


def load(builder: Builder, address: Value, offset: int, kind: Any) -> Value:
    """Return the value of that kind `offset` bytes behind `address`, aligned or not."""
    loaded = builder.load(pointer_at(builder, address, offset, kind))
    loaded.align = 1
    return loaded


def store(builder: Builder, value: Value, address: Value, offset: int) -> None:
    """Write `value` to the memory `offset` bytes behind `address`, aligned or not."""
    builder.store(value, pointer_at(builder, address, offset, value.type)).align = 1


def concatenated(builder: Builder, parts: Sequence[Value]) -> Value:
    """Return the vectors of `parts` as one; they are of one size and a power of two in number."""
    while len(parts) > 1:
        lanes = constant(ir.VectorType(I32, 2 * parts[0].type.count), range(2 * parts[0].type.count))
        parts = [builder.shuffle_vector(*parts[i : i + 2], lanes) for i in range(0, len(parts), 2)]
    return parts[0]


def pixel_codes(builder: Builder, picture: Value) -> Value:
    """Return blue | green << 8 | red << 16 of the 16 pixels (48 bytes) at `picture`."""
    # Four pixels for each 16 bytes of the vector; the last four are loaded so that nothing behind them is.
    starts = (0, 12, 24, 32)
    loaded = concatenated(builder, [load(builder, picture, start, ir.VectorType(I8, 16)) for start in starts])
    lanes: list[int] = []
    for four, start in enumerate(starts):
        for pixel in range(4):
            first = 16 * four + 12 * four - start + 3 * pixel
            lanes += [first + 2, first + 1, first, 4 * LANES]
    nothing = constant(loaded.type, 0)
    mask = constant(ir.VectorType(I32, 4 * LANES), lanes)
    return builder.bitcast(builder.shuffle_vector(loaded, nothing, mask), WORDS)


def signature(returned: str, *kinds: str) -> Any:
    """Return numba's type of a function that returns one kind and takes others, by their names."""
    from numba import types

    named: Any = types
    return getattr(named, returned)(*(getattr(named, kind) for kind in kinds))


def step(*kinds: str, returned: str = "void") -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that makes a step for compiled functions to call of a function that writes it in LLVM's terms.

    The function takes a builder and a value of each of `kinds`, by numba's names, and returns what the step does.
    """

    def decorate(emit: Callable[..., Any]) -> Any:
        def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
            del signature
            value = emit(builder, *arguments)
            return context.get_dummy_value() if returned == "void" else value

        @wraps(emit)
        def typed(typing: Any, *arguments: Any) -> Any:
            del typing, arguments
            return signature(returned, *kinds), generate

        return intrinsic(typed)

    return decorate


@step(ADDRESS, returned="int64")
def offset_at(builder: Builder, source: Value) -> Value:
    """Return the uint32 at `source` as an address can be added to it."""
    return builder.zext(load(builder, source, 0, I32), I64)


@step(ADDRESS, ADDRESS)
def copy8(builder: Builder, source: Value, target: Value) -> None:
    """Copy a sample and the two bytes behind it."""
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
    """Copy a line's bytes."""
    store(builder, load(builder, source, 0, _LINE), target, 0)


@step(ADDRESS, ADDRESS)
def stream_line(builder: Builder, source: Value, target: Value) -> None:
    """Copy a line's bytes past the caches to `target`, a multiple of `LINE`; to be followed by `store_fence`."""
    written = builder.store(load(builder, source, 0, _LINE), pointer_at(builder, target, 0, _LINE))
    written.align = LINE
    written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(I32, 1)]))


@step()
def store_fence(builder: Builder) -> None:
    """Wait until all threads can see what was streamed."""
    builder.fence("seq_cst")


@step(ADDRESS, ADDRESS)
def copy1(builder: Builder, source: Value, target: Value) -> None:
    """Copy one byte."""
    store(builder, load(builder, source, 0, I8), target, 0)


def _channels(builder: Builder, samples: Value, offsets: Value, step: int) -> list[Value]:
    """Return red, green and blue, eight float32 each, of the samples whose offsets are `step` bytes apart."""
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
    # Pixels 0, 1, 4, 5 and 2, 3, 6, 7, 32 bits of red and green, 32 of blue and what follows.
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
    builder: Builder, samples: Value, offsets: Value, stride: int, line: Value, targets: Sequence[Value]
) -> None:
    """Write eight pixels whose offsets are `stride` bytes apart to three planes."""

    def number(place: int) -> Value:
        return broadcast(builder, load(builder, line, 4 * place, F32), _EIGHT_FLOATS)

    for place, (channel, target) in enumerate(zip(_channels(builder, samples, offsets, stride), targets, strict=True)):
        value = builder.fadd(builder.fmul(channel, number(place)), number(3 + place))
        store(builder, minimum(builder, value, number(6)), target, 0)


@step(*[ADDRESS] * 6)
def planes8(
    builder: Builder, samples: Value, offsets: Value, line: Value, red: Value, green: Value, blue: Value
) -> None:
    """Write eight pixels as float32 to three planes: sample times factor, plus summand, at most a limit.

    At `line` are seven float32: factors and summands of red, green and blue, and the limit.
    """
    _write_planes8(builder, samples, offsets, 4, line, (red, green, blue))


@step(*[ADDRESS] * 6)
def planes8_mirrored(
    builder: Builder, samples: Value, offsets: Value, line: Value, red: Value, green: Value, blue: Value
) -> None:
    """Do `planes8` from right to left: `offsets` points to the first pixel's offset, the others' stand before it."""
    _write_planes8(builder, samples, offsets, -4, line, (red, green, blue))


@step(ADDRESS, "float32", "float32", "float32", ADDRESS)
def plane1(builder: Builder, source: Value, factor: Value, summand: Value, limit: Value, target: Value) -> None:
    """Write one channel of one pixel as float32: `planes8` for what is narrower."""
    value = builder.fmul(builder.uitofp(load(builder, source, 0, I16), F32), factor)
    store(builder, minimum(builder, builder.fadd(value, summand), limit), target, 0)


BLOCK: Final = 8  # Pixels that are mixed at a time: their weights under two lights fill a vector of 16
MEAN_BYTES: Final = 16  # Bytes of a colour's mean under one light: red, green, blue and padding, float32
PLAN_ENTRIES: Final = 6  # Addresses that `mix` takes of each pair of lights
FAULT_BYTES: Final = 4 * LANES  # Bytes of the 16 float32 that become NaN where a weight is faulty

_QUAD: Final = 4  # Numbers of a pixel in a vector, a quarter of it: red, green, blue and padding
_SHORTS: Final = ir.VectorType(I16, 2 * LANES)
# Which two of eight pixels share a vector, so that pixels are packed without crossing its quarters.
_PIXEL_PAIRS: Final = ((0, 2), (4, 6), (1, 3), (5, 7))
# Pixel and light of each of a block's weights in the order of `arrange_weights`, in the quarters of `_PIXEL_PAIRS`.
_ORDER: Final = tuple((_PIXEL_PAIRS[lane % _QUAD][lane // (2 * _QUAD)], lane // _QUAD % 2) for lane in range(LANES))


@step(ADDRESS, "int64", ADDRESS, returned="int64")
def mean4(builder: Builder, source: Value, count: Value, target: Value) -> Value:
    """Write the mean of `count` ≥ 1 samples in a row as four float32, the fourth is padding.

    Returns the largest number of the samples.
    """
    from numba.core import cgutils

    wide, real = ir.VectorType(I64, _QUAD), ir.VectorType(ir.DoubleType(), _QUAD)
    total, most = (cgutils.alloca_once_value(builder, ir.Constant(wide, [0] * _QUAD)) for _ in range(2))
    with cgutils.for_range(builder, count) as loop:
        at = builder.add(source, builder.mul(loop.index, ir.Constant(I64, SAMPLE_BYTES)))
        sample = builder.zext(load(builder, at, 0, ir.VectorType(I16, _QUAD)), wide)
        builder.store(builder.add(builder.load(total), sample), total)
        before = builder.load(most)
        builder.store(builder.select(builder.icmp_unsigned(">", sample, before), sample, before), most)
    mean = builder.fdiv(
        builder.sitofp(builder.load(total), real), broadcast(builder, builder.sitofp(count, ir.DoubleType()), real)
    )
    store(builder, builder.fptrunc(mean, ir.VectorType(F32, _QUAD)), target, 0)
    largest = ir.Constant(I64, 0)
    for channel in range(3):
        value = builder.extract_element(builder.load(most), ir.Constant(I32, channel))
        largest = builder.select(builder.icmp_unsigned(">", value, largest), value, largest)
    return largest


def _for_each_line(builder: Builder, weights: Value, count: Value, do: Callable[[Value, Value], None]) -> None:
    """Call `do` with the weights of each eight pixels under a pair of lights, WORDS, and the number of those eight."""
    with _blocks(builder, count) as (block, begin):
        do(load(builder, builder.add(weights, builder.shl(begin, ir.Constant(I64, 3))), 0, WORDS), block)


def _any_nonzero(builder: Builder, words: Value) -> Value:
    """Return two bits: whether one of the even lanes, and whether one of the odd lanes, is not 0."""
    answer = ir.Constant(I64, 0)
    for light in range(2):
        lanes = constant(_EIGHT_WORDS, range(light, LANES, 2))
        its = builder.shuffle_vector(words, words, lanes)
        other = builder.bitcast(builder.icmp_unsigned("!=", its, constant(_EIGHT_WORDS, 0)), I8)
        other = builder.zext(builder.icmp_unsigned("!=", other, ir.Constant(I8, 0)), I64)
        answer = builder.or_(answer, builder.shl(other, ir.Constant(I64, light)))
    return answer


@step(ADDRESS, "int64", returned="int64")
def weight_flags(builder: Builder, weights: Value, count: Value) -> Value:
    """Return four bits on the weights of two lights, two float32 for each of `count` ≥ 8 pixels.

    Bits 0 and 1 are set where some weight of the first and of the second light is not 0, bits 2 and 3 where some weight
    of theirs is not 1.
    """
    from numba.core import cgutils

    ones = builder.bitcast(ir.Constant(FLOATS, [1.0] * LANES), WORDS)
    found = [cgutils.alloca_once_value(builder, constant(WORDS, 0)) for _ in range(2)]

    def see(line: Value, block: Value) -> None:
        del block
        for seen, other in zip(found, (line, builder.xor(line, ones)), strict=True):
            builder.store(builder.or_(builder.load(seen), other), seen)

    _for_each_line(builder, weights, count, see)
    lit, less = (_any_nonzero(builder, builder.load(seen)) for seen in found)
    return builder.or_(lit, builder.shl(less, ir.Constant(I64, 2)))


@step(ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS)
def interleave_weights(
    builder: Builder, first: Value, first_step: Value, second: Value, second_step: Value, target: Value
) -> None:
    """Write eight pixels' weights of two lights by turns, as `weight_flags` takes them; steps are bytes to the next."""
    line = ir.Constant(FLOATS, ir.Undefined)
    for lane in range(LANES):
        weights, stride = ((first, first_step), (second, second_step))[lane % 2]
        at = builder.add(weights, builder.mul(stride, ir.Constant(I64, lane // 2)))
        line = builder.insert_element(line, load(builder, at, 0, F32), ir.Constant(I32, lane))
    store(builder, line, target, 0)


@step(ADDRESS, "int64", ADDRESS, returned="int64")
def arrange_weights(builder: Builder, weights: Value, count: Value, target: Value) -> Value:
    """Write the weights that `weight_flags` takes in the order in which `mix` takes them, 64 bytes for eight pixels.

    Returns bits 0 and 1 of `weight_flags`.
    """
    from numba.core import cgutils

    lanes = constant(WORDS, [2 * pixel + light for pixel, light in _ORDER])
    seen = cgutils.alloca_once_value(builder, constant(WORDS, 0))

    def put(line: Value, block: Value) -> None:
        builder.store(builder.or_(builder.load(seen), line), seen)
        to = builder.add(target, builder.shl(block, ir.Constant(I64, 6)))
        store(builder, builder.shuffle_vector(line, line, lanes), to, 0)

    _for_each_line(builder, weights, count, put)
    return _any_nonzero(builder, builder.load(seen))


@contextmanager
def _blocks(builder: Builder, count: Value) -> Generator[tuple[Value, Value]]:
    """Loop over `count` ≥ 8 pixels eight by eight: yield the number of each eight, and the first of its pixels.

    Where `count` is no multiple of eight, the last eight overlap the ones before.
    """
    from numba.core import cgutils

    blocks = builder.lshr(builder.add(count, ir.Constant(I64, BLOCK - 1)), ir.Constant(I64, 3))
    last = builder.sub(count, ir.Constant(I64, BLOCK))
    with cgutils.for_range(builder, blocks) as loop:
        begin = builder.shl(loop.index, ir.Constant(I64, 3))
        yield loop.index, builder.select(builder.icmp_signed("<", begin, last), begin, last)


def _store_pixels(builder: Builder, even: Value, odd: Value, target: Value) -> None:
    """Write the red, green and blue of eight pixels as uint16, given those of even and of odd places as 32 bits."""
    both = builder.bitcast(builder.or_(even, builder.shl(odd, constant(WORDS, 16))), _SHORTS)
    # Of each quarter: red, red, green, green, blue, blue of two pixels, and two of padding.
    lanes = [8 * quarter + lane for quarter in range(_QUAD) for lane in (0, 2, 4, 1, 3, 5)]
    for part in (slice(0, 16), slice(16, 24)):
        kind = ir.VectorType(I32, len(lanes[part]))
        store(builder, builder.shuffle_vector(both, both, constant(kind, lanes[part])), target, 2 * part.start)


def _pair(
    builder: Builder, addresses: Sequence[Value], block: Value, place: Value, means: Value
) -> tuple[list[Value], Value]:
    """Return what a pair of lights adds to the pixels of even and of odd places, and a mark of faulty weights.

    The mark is 16 float32: 0, or NaN where a weight is faulty.
    """
    weights, *rest = addresses
    offsets, samples, mean_base = rest[:2], rest[2:4], rest[4]
    name = f"llvm.sqrt.v{LANES}f32"
    kind = ir.FunctionType(FLOATS, [FLOATS])
    root_of = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    weight = load(builder, builder.add(weights, builder.shl(block, ir.Constant(I64, 6))), 0, FLOATS)
    root = builder.call(root_of, [weight])
    remainder = builder.fsub(weight, root)
    # The root of a negative number, and 0 times infinity, are NaN.
    fault = builder.fmul(root, ir.Constant(FLOATS, [0.0] * LANES))
    sums: list[Value] = []
    for lane, pixels in enumerate(_PIXEL_PAIRS):

        def found(base: Value, places: Value, pixel: int, kind: Any) -> Value:
            offset = builder.zext(load(builder, builder.add(places, place), 4 * pixel, I32), I64)
            return load(builder, builder.add(base, offset), 0, kind)

        def each(numbers: Value, lane: int = lane) -> Value:
            """Return the numbers of a pair of pixels under both lights, four times each."""
            lanes = [_QUAD * (place // _QUAD) + lane for place in range(LANES)]
            return builder.shuffle_vector(numbers, numbers, constant(WORDS, lanes))

        drawn = [
            found(base, places, pixel, ir.VectorType(I16, 4))
            for pixel in pixels
            for base, places in zip(samples, offsets, strict=True)
        ]
        mean = [found(mean_base, means, pixel, ir.VectorType(F32, 2 * _QUAD)) for pixel in pixels]
        noisy = builder.fmul(builder.sitofp(builder.zext(concatenated(builder, drawn), WORDS), FLOATS), each(root))
        sums.append(builder.fadd(noisy, builder.fmul(concatenated(builder, mean), each(remainder))))
    totals: list[Value] = []
    for two in (sums[:2], sums[2:]):
        parts = [
            builder.shuffle_vector(
                *two, constant(WORDS, [8 * pixel + _QUAD * light + i for pixel in range(4) for i in range(4)])
            )
            for light in range(2)
        ]
        totals.append(builder.fadd(*parts))
    return totals, fault


@step(ADDRESS, "int64", "int64", ADDRESS, ADDRESS, "float32", ADDRESS)
def mix(
    builder: Builder, plan: Value, pairs: Value, count: Value, means: Value, faults: Value, white: Value, target: Value
) -> None:
    """Write `count` ≥ 8 pixels under pairs of lights as uint16, rounded, from 0 to `white`; see `mixing.py`.

    `plan` is the address of `PLAN_ENTRIES` addresses a pair: of the weights as `arrange_weights` has them, of the first
    and second light's offsets in their samples, of the first and second light's samples, and of the means; `means` is
    that of the offsets in the means. Of the 16 float32 at `faults` some become NaN as soon as a weight is negative,
    infinite or NaN.
    """
    from numba.core import cgutils

    def number(value: int) -> Value:
        return ir.Constant(I64, value)

    def addresses(pair: Value) -> list[Value]:
        entry = builder.add(plan, builder.mul(pair, number(8 * PLAN_ENTRIES)))
        return [load(builder, entry, 8 * i, I64) for i in range(PLAN_ENTRIES)]

    zero, half = ir.Constant(FLOATS, [0.0] * LANES), ir.Constant(FLOATS, [0.5] * LANES)
    most = broadcast(builder, white, FLOATS)
    fault = cgutils.alloca_once_value(builder, load(builder, faults, 0, FLOATS))
    sums = [cgutils.alloca_once(builder, FLOATS) for _ in range(2)]

    def fill(total: Callable[[Value, Value], Sequence[Value]]) -> None:
        with _blocks(builder, count) as (block, begin):
            rounded: list[Value] = []
            for value in total(block, builder.shl(begin, number(2))):
                lifted = builder.fadd(value, half)
                lifted = builder.select(builder.fcmp_ordered(">", lifted, zero), lifted, zero)
                rounded.append(builder.fptosi(minimum(builder, lifted, most), WORDS))
            _store_pixels(
                builder, rounded[0], rounded[1], builder.add(target, builder.mul(begin, number(SAMPLE_BYTES)))
            )

    def of_pair(entries: Sequence[Value], block: Value, place: Value) -> Sequence[Value]:
        totals, nothing = _pair(builder, entries, block, place, means)
        builder.store(builder.fadd(builder.load(fault), nothing), fault)
        return totals

    def of_all(block: Value, place: Value) -> Sequence[Value]:
        for one in sums:
            builder.store(zero, one)
        with cgutils.for_range(builder, pairs) as loop:
            for one, value in zip(sums, of_pair(addresses(loop.index), block, place), strict=True):
                builder.store(builder.fadd(builder.load(one), value), one)
        return [builder.load(one) for one in sums]

    with builder.if_else(builder.icmp_signed("==", pairs, number(1))) as (single, several):
        with single:
            entries = addresses(number(0))
            fill(lambda block, place: of_pair(entries, block, place))
        with several:
            fill(of_all)
    store(builder, builder.load(fault), faults, 0)


# Bytes of an image from which it is streamed: the size of a desktop processor's last-level cache.
STREAMED_BYTES: Final = 24 << 20


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
