"""Steps of `mixing.py` written in LLVM's own terms; see `vector.py` for the laws that hold here too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from generator.vector import (
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
    least,
    load,
    spread,
    store,
    void,
)

MEAN_BYTES: Final = 16
"""Of a colour's mean under one light: red, green, blue and nothing, float32."""
PLAN: Final = 6
"""Addresses that `mix` wants of a pair of lights."""

_HALF: Final = LANES // 2
_SHORTS: Final = ir.VectorType(I16, 2 * LANES)
_PAIRS: Final = ((0, 2), (1, 3), (4, 6), (5, 7))
"""Which two of eight pixels share a vector: so pixels are packed without crossing its halves."""


@intrinsic
def mean4(typing: Any, source: Any, count: Any, target: Any) -> Any:
    """Write the mean of `count` ≥ 1 samples in a row as four float32, the fourth without meaning."""
    del typing, source, count, target

    def emit(builder: Builder, source: Value, count: Value, target: Value) -> None:
        wide, real = ir.VectorType(I64, _HALF), ir.VectorType(ir.DoubleType(), _HALF)
        total = cgutils.alloca_once_value(builder, ir.Constant(wide, [0] * _HALF))
        with cgutils.for_range(builder, count) as loop:
            at = builder.add(source, builder.mul(loop.index, ir.Constant(I64, SAMPLE_BYTES)))
            sample = builder.zext(load(builder, at, 0, ir.VectorType(I16, _HALF)), wide)
            builder.store(builder.add(builder.load(total), sample), total)
        mean = builder.fdiv(
            builder.sitofp(builder.load(total), real), spread(builder, builder.sitofp(count, ir.DoubleType()), real)
        )
        store(builder, builder.fptrunc(mean, ir.VectorType(F32, _HALF)), target, 0)

    return void(emit, ADDRESS, types.int64, ADDRESS)


def _keep(builder: Builder, lines: Sequence[Value], target: Value) -> Value:
    """Write two lights' weights of twice four pixels; return 1 if any of the first is not 0, plus 2 for the second."""
    for four, line in enumerate(lines):
        store(builder, line, target, 4 * LANES * four)
    kind = ir.IntType(16 * LANES)
    both = builder.bitcast(builder.or_(*(builder.bitcast(line, WORDS) for line in lines)), ir.VectorType(kind, 2))
    lit: list[Value] = []
    for light in range(2):
        bits = builder.extract_element(both, ir.Constant(I32, light))
        lit.append(builder.zext(builder.icmp_unsigned("!=", bits, ir.Constant(kind, 0)), I64))
    return builder.add(lit[0], builder.shl(lit[1], ir.Constant(I64, 1)))


@intrinsic
def line_up8(typing: Any, first: Any, first_step: Any, second: Any, second_step: Any, target: Any) -> Any:
    """Write eight pixels' weights of a pair of lights as `mix` takes them: 64 bytes.

    The float32 of each light are so many bytes apart. Returns 1 if any of the first light is not 0, plus 2 for the
    second.
    """
    del typing, first, first_step, second, second_step, target

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        lines: list[Value] = []
        for four in range(2):
            line = ir.Constant(FLOATS, ir.Undefined)
            for lane in range(LANES):
                weights, step = arguments[2 * (lane // _HALF)], arguments[2 * (lane // _HALF) + 1]
                at = builder.add(weights, builder.mul(step, ir.Constant(I64, _HALF * four + lane % _HALF)))
                line = builder.insert_element(line, load(builder, at, 0, F32), ir.Constant(I32, lane))
            lines.append(line)
        return _keep(builder, lines, arguments[4])

    return types.int64(ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS), generate


@intrinsic
def part8(typing: Any, weights: Any, target: Any) -> Any:
    """Do `line_up8` for two lights whose weights alternate."""
    del typing, weights, target

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        lanes = [2 * pixel + light for light in range(2) for pixel in range(_HALF)]
        lines: list[Value] = []
        for four in range(2):
            both = load(builder, arguments[0], 4 * LANES * four, FLOATS)
            lines.append(builder.shuffle_vector(both, both, constant(WORDS, lanes)))
        return _keep(builder, lines, arguments[1])

    return types.int64(ADDRESS, ADDRESS), generate


@intrinsic
def full8(typing: Any, weights: Any, light: Any) -> Any:
    """Return whether the eight weights of the pair's first or second (1) light are all 1."""
    del typing, weights, light

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        kind, bits = ir.VectorType(F32, _HALF), ir.IntType(_HALF)
        at = builder.add(arguments[0], builder.mul(arguments[1], ir.Constant(I64, 4 * _HALF)))
        full = ir.Constant(ir.IntType(1), 1)
        for four in range(2):
            line = load(builder, at, 4 * LANES * four, kind)
            other = builder.fcmp_unordered("!=", line, ir.Constant(kind, [1.0] * _HALF))
            full = builder.and_(full, builder.icmp_unsigned("==", builder.bitcast(other, bits), ir.Constant(bits, 0)))
        return full

    return types.boolean(ADDRESS, types.int64), generate


def _store_pixels(builder: Builder, pairs: Sequence[Value], target: Value) -> None:
    """Write the red, green and blue of eight pixels as uint16; each pair has those of two pixels as 32 bits."""
    couples: list[Value] = []
    for low, high in (pairs[:2], pairs[2:]):
        both = builder.or_(low, builder.shl(high, constant(WORDS, 16)))
        couples.append(builder.bitcast(both, _SHORTS))
    # Of each half: red, red, green, green, blue, blue of two pixels, and two without meaning.
    lanes = [LANES * half + lane for half in range(2 * 2) for lane in (0, 2, 4, 1, 3, 5)]
    kind = ir.VectorType(I32, len(lanes))
    store(builder, builder.shuffle_vector(*couples, constant(kind, lanes)), target, 0)


def _pair(
    builder: Builder, addresses: Sequence[Value], block: Value, place: Value, means: Value
) -> tuple[list[Value], Value]:
    """Return what a pair of lights gives eight pixels, by `_PAIRS`, and what tells faulty weights.

    The latter is eight float32 that are 0, but for faulty weights no numbers.
    """
    weights, *rest = addresses
    offsets, samples, mean_base = rest[:2], rest[2:4], rest[4]
    name = f"llvm.sqrt.v{LANES}f32"
    kind = ir.FunctionType(FLOATS, [FLOATS])
    root_of = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    fault = zero = ir.Constant(FLOATS, [0.0] * LANES)
    sums: list[Value] = []
    at = builder.add(weights, builder.mul(block, ir.Constant(I64, 8 * LANES)))
    for four in range(2):
        weight = load(builder, at, 4 * LANES * four, FLOATS)
        root = builder.call(root_of, [weight])
        remainder = builder.fsub(weight, root)
        # The root of what is negative, and nothing times infinity, are no numbers.
        fault = builder.fadd(fault, builder.fmul(root, zero)) if four else builder.fmul(root, zero)
        for pixel in range(_HALF):
            begin = 4 * (_HALF * four + pixel)

            def found(base: Value, places: Value, kind: Any, begin: int = begin) -> Value:
                offset = builder.zext(load(builder, builder.add(places, place), begin, I32), I64)
                return load(builder, builder.add(base, offset), 0, kind)

            def each(numbers: Value, pixel: int = pixel) -> Value:
                lanes = [pixel] * _HALF + [_HALF + pixel] * _HALF
                return builder.shuffle_vector(numbers, numbers, constant(WORDS, lanes))

            both = [found(base, places, ir.VectorType(I16, 4)) for base, places in zip(samples, offsets, strict=True)]
            drawn = builder.zext(builder.shuffle_vector(*both, constant(WORDS, range(LANES))), WORDS)
            drawn = builder.fmul(builder.sitofp(drawn, FLOATS), each(root))
            mean = builder.fmul(found(mean_base, means, FLOATS), each(remainder))
            sums.append(builder.fadd(drawn, mean))
    totals: list[Value] = []
    low = [*range(_HALF), *range(LANES, LANES + _HALF)]
    for pair in _PAIRS:
        parts = [
            builder.shuffle_vector(*(sums[pixel] for pixel in pair), constant(WORDS, [lane + shift for lane in low]))
            for shift in (0, _HALF)
        ]
        totals.append(builder.fadd(*parts))
    return totals, fault


@intrinsic
def mix(typing: Any, plan: Any, pairs: Any, count: Any, means: Any, faults: Any, white: Any, target: Any) -> Any:
    """Write `count` ≥ 8 pixels under pairs of lights as uint16, rounded, from 0 to `white`; see `mixing.py`.

    `plan` leads to `PLAN` addresses a pair: of the weights, of the first and second light's offsets in their samples,
    of the first and second light's samples, and of the means; `means` leads to the offsets in the means. The pixels are
    taken eight by eight, the last eight being some of the ones before again where `count` is not whole eights; so are
    the weights, but each eight stand on their own. The eight float32 at `faults` are no numbers from the moment that a
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
        sums = [cgutils.alloca_once(builder, FLOATS) for _ in range(_HALF)]
        blocks = builder.lshr(builder.add(count, number(LANES - 1)), number(3))
        last = builder.sub(count, number(LANES))

        def fill(total: Callable[[Value, Value], Sequence[Value]]) -> None:
            with cgutils.for_range(builder, blocks) as loop:
                begin = builder.shl(loop.index, number(3))
                begin = builder.select(builder.icmp_signed("<", begin, last), begin, last)
                rounded: list[Value] = []
                for value in total(loop.index, builder.shl(begin, number(2))):
                    lifted = builder.fadd(value, half)
                    lifted = builder.select(builder.fcmp_ordered(">", lifted, zero), lifted, zero)
                    rounded.append(builder.fptosi(least(builder, lifted, most), WORDS))
                _store_pixels(builder, rounded, builder.add(target, builder.mul(begin, number(SAMPLE_BYTES))))

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
