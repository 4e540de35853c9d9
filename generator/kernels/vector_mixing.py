"""Steps of `mixing.py` written in LLVM's own terms; see `vector.py` for the laws that hold here too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from generator.kernels.vector import (
    ADDRESS,
    F32,
    FLOATS,
    I16,
    I32,
    I64,
    LANES,
    SAMPLE_BYTES,
    WORDS,
    Builder,
    Value,
    constant,
    joined,
    least,
    load,
    spread,
    store,
    void,
)

BLOCK: Final = 8
"""Pixels that are mixed at a time."""
MEAN_BYTES: Final = 16
"""Of a colour's mean under one light: red, green, blue and nothing, float32."""
PLAN: Final = 6
"""Addresses that `mix` wants of a pair of lights."""
FAULTS: Final = 4 * LANES
"""Bytes that tell faulty weights."""
FIRST: Final = 0x0F0F
"""Of the lanes of a block's weights those of the pair's first light; four higher stand the second's. See `line_up8`."""

_FOUR: Final = 4
_SHORTS: Final = ir.VectorType(I16, 2 * LANES)
_COUPLES: Final = ((0, 2), (4, 6), (1, 3), (5, 7))
"""Which two of eight pixels share a vector: so pixels are packed without crossing its quarters."""


@intrinsic
def mean4(typing: Any, source: Any, count: Any, target: Any) -> Any:
    """Write the mean of `count` ≥ 1 samples in a row as four float32, the fourth without meaning."""
    del typing, source, count, target

    def emit(builder: Builder, source: Value, count: Value, target: Value) -> None:
        wide, real = ir.VectorType(I64, _FOUR), ir.VectorType(ir.DoubleType(), _FOUR)
        total = cgutils.alloca_once_value(builder, ir.Constant(wide, [0] * _FOUR))
        with cgutils.for_range(builder, count) as loop:
            at = builder.add(source, builder.mul(loop.index, ir.Constant(I64, SAMPLE_BYTES)))
            sample = builder.zext(load(builder, at, 0, ir.VectorType(I16, _FOUR)), wide)
            builder.store(builder.add(builder.load(total), sample), total)
        mean = builder.fdiv(
            builder.sitofp(builder.load(total), real), spread(builder, builder.sitofp(count, ir.DoubleType()), real)
        )
        store(builder, builder.fptrunc(mean, ir.VectorType(F32, _FOUR)), target, 0)

    return void(emit, ADDRESS, types.int64, ADDRESS)


def _keep(builder: Builder, line: Value, target: Value) -> Value:
    """Write a line of weights; return which of its lanes are not 0, a bit a lane."""
    store(builder, line, target, 0)
    other = builder.icmp_unsigned("!=", builder.bitcast(line, WORDS), constant(WORDS, 0))
    return builder.zext(builder.bitcast(other, ir.IntType(LANES)), I64)


@intrinsic
def line_up8(typing: Any, first: Any, first_step: Any, second: Any, second_step: Any, target: Any) -> Any:
    """Write eight pixels' weights of a pair of lights as `mix` takes them, 64 bytes.

    The float32 of each light are so many bytes apart. They come to stand as four pixels of the first light, the same of
    the second, and so on. Returns which are not 0, a bit for each, the first one's lowest.
    """
    del typing, first, first_step, second, second_step, target

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        line = ir.Constant(FLOATS, ir.Undefined)
        for lane in range(LANES):
            light, pixel = lane // _FOUR % 2, lane // (2 * _FOUR) * _FOUR + lane % _FOUR
            weights, step = arguments[2 * light], arguments[2 * light + 1]
            at = builder.add(weights, builder.mul(step, ir.Constant(I64, pixel)))
            line = builder.insert_element(line, load(builder, at, 0, F32), ir.Constant(I32, lane))
        return _keep(builder, line, arguments[4])

    return types.int64(ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS), generate


@intrinsic
def part8(typing: Any, weights: Any, target: Any) -> Any:
    """Do `line_up8` for two lights whose weights alternate."""
    del typing, weights, target

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        both = load(builder, arguments[0], 0, FLOATS)
        lanes = [8 * four + 2 * pixel + light for four in range(2) for light in range(2) for pixel in range(_FOUR)]
        return _keep(builder, builder.shuffle_vector(both, both, constant(WORDS, lanes)), arguments[1])

    return types.int64(ADDRESS, ADDRESS), generate


@intrinsic
def full8(typing: Any, weights: Any, light: Any) -> Any:
    """Return whether the eight weights of the pair's first or second (1) light are all 1."""
    del typing, weights, light

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        line = load(builder, arguments[0], 0, FLOATS)
        other = builder.fcmp_unordered("!=", line, ir.Constant(FLOATS, [1.0] * LANES))
        kind = ir.IntType(LANES)
        lanes = builder.shl(ir.Constant(I64, FIRST), builder.mul(arguments[1], ir.Constant(I64, _FOUR)))
        found = builder.and_(builder.bitcast(other, kind), builder.trunc(lanes, kind))
        return builder.icmp_unsigned("==", found, ir.Constant(kind, 0))

    return types.boolean(ADDRESS, types.int64), generate


def _store_pixels(builder: Builder, even: Value, odd: Value, target: Value) -> None:
    """Write the red, green and blue of eight pixels as uint16, given those of even and of odd places as 32 bits."""
    both = builder.bitcast(builder.or_(even, builder.shl(odd, constant(WORDS, 16))), _SHORTS)
    # Of each quarter: red, red, green, green, blue, blue of two pixels, and two without meaning.
    lanes = [8 * quarter + lane for quarter in range(_FOUR) for lane in (0, 2, 4, 1, 3, 5)]
    for part in (slice(0, 16), slice(16, 24)):
        kind = ir.VectorType(I32, len(lanes[part]))
        store(builder, builder.shuffle_vector(both, both, constant(kind, lanes[part])), target, 2 * part.start)


def _pair(
    builder: Builder, addresses: Sequence[Value], block: Value, place: Value, means: Value
) -> tuple[list[Value], Value]:
    """Return what a pair of lights gives the pixels of even and of odd places, and what tells faulty weights.

    The latter is 16 float32 that are 0, but for faulty weights no numbers.
    """
    weights, *rest = addresses
    offsets, samples, mean_base = rest[:2], rest[2:4], rest[4]
    name = f"llvm.sqrt.v{LANES}f32"
    kind = ir.FunctionType(FLOATS, [FLOATS])
    root_of = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    at = builder.add(weights, builder.mul(block, ir.Constant(I64, 4 * LANES)))
    weight = load(builder, at, 0, FLOATS)
    root = builder.call(root_of, [weight])
    remainder = builder.fsub(weight, root)
    # The root of what is negative, and nothing times infinity, are no numbers.
    fault = builder.fmul(root, ir.Constant(FLOATS, [0.0] * LANES))
    sums: list[Value] = []
    for couple in _COUPLES:

        def found(base: Value, places: Value, pixel: int, kind: Any) -> Value:
            offset = builder.zext(load(builder, builder.add(places, place), 4 * pixel, I32), I64)
            return load(builder, builder.add(base, offset), 0, kind)

        def each(numbers: Value, couple: tuple[int, int] = couple) -> Value:
            """Return the numbers of two pixels under both lights, four times each."""
            first = [8 * (pixel // _FOUR) + _FOUR * light + pixel % _FOUR for pixel in couple for light in range(2)]
            return builder.shuffle_vector(numbers, numbers, constant(WORDS, [lane for lane in first for _ in range(4)]))

        drawn = [
            found(base, places, pixel, ir.VectorType(I16, 4))
            for pixel in couple
            for base, places in zip(samples, offsets, strict=True)
        ]
        mean = [found(mean_base, means, pixel, ir.VectorType(F32, 2 * _FOUR)) for pixel in couple]
        noisy = builder.fmul(builder.sitofp(builder.zext(joined(builder, drawn), WORDS), FLOATS), each(root))
        sums.append(builder.fadd(noisy, builder.fmul(joined(builder, mean), each(remainder))))
    totals: list[Value] = []
    for two in (sums[:2], sums[2:]):
        parts = [
            builder.shuffle_vector(
                *two, constant(WORDS, [8 * pixel + _FOUR * light + i for pixel in range(4) for i in range(4)])
            )
            for light in range(2)
        ]
        totals.append(builder.fadd(*parts))
    return totals, fault


@intrinsic
def mix(typing: Any, plan: Any, pairs: Any, count: Any, means: Any, faults: Any, white: Any, target: Any) -> Any:
    """Write `count` ≥ 8 pixels under pairs of lights as uint16, rounded, from 0 to `white`; see `mixing.py`.

    `plan` leads to `PLAN` addresses a pair: of the weights, of the first and second light's offsets in their samples,
    of the first and second light's samples, and of the means; `means` leads to the offsets in the means. The pixels are
    taken eight by eight, the last eight being some of the ones before again where `count` is not whole eights; so are
    the weights, but each eight stand on their own. Some float32 at `faults` are no numbers from the moment that a
    weight was negative, infinite or no number.
    """
    del typing, plan, pairs, count, means, faults, white, target

    def emit(
        builder: Builder,
        plan: Value,
        pairs: Value,
        count: Value,
        means: Value,
        faults: Value,
        white: Value,
        target: Value,
    ) -> None:
        def number(value: int) -> Value:
            return ir.Constant(I64, value)

        def addresses(pair: Value) -> list[Value]:
            entry = builder.add(plan, builder.mul(pair, number(8 * PLAN)))
            return [load(builder, entry, 8 * i, I64) for i in range(PLAN)]

        zero, half = ir.Constant(FLOATS, [0.0] * LANES), ir.Constant(FLOATS, [0.5] * LANES)
        most = spread(builder, white, FLOATS)
        fault = cgutils.alloca_once_value(builder, load(builder, faults, 0, FLOATS))
        sums = [cgutils.alloca_once(builder, FLOATS) for _ in range(2)]
        blocks = builder.lshr(builder.add(count, number(BLOCK - 1)), number(3))
        last = builder.sub(count, number(BLOCK))

        def fill(total: Callable[[Value, Value], Sequence[Value]]) -> None:
            with cgutils.for_range(builder, blocks) as loop:
                begin = builder.shl(loop.index, number(3))
                begin = builder.select(builder.icmp_signed("<", begin, last), begin, last)
                rounded: list[Value] = []
                for value in total(loop.index, builder.shl(begin, number(2))):
                    lifted = builder.fadd(value, half)
                    lifted = builder.select(builder.fcmp_ordered(">", lifted, zero), lifted, zero)
                    rounded.append(builder.fptosi(least(builder, lifted, most), WORDS))
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

    return void(emit, ADDRESS, types.int64, types.int64, ADDRESS, ADDRESS, types.float32, ADDRESS)


@intrinsic
def copy_least(typing: Any, source: Any, white: Any, target: Any) -> Any:
    """Copy a sample and the two bytes behind it, each number at most `white` (uint16)."""
    del typing, source, white, target

    def emit(builder: Builder, source: Value, white: Value, target: Value) -> None:
        kind = ir.VectorType(I16, 4)
        sample, most = load(builder, source, 0, kind), spread(builder, white, kind)
        least = builder.select(builder.icmp_unsigned("<", sample, most), sample, most)
        store(builder, least, target, 0)

    return void(emit, ADDRESS, types.uint16, ADDRESS)
