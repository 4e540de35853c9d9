"""Steps of the kernels written in LLVM's own terms: vectors of eight 32-bit numbers, and loads and stores by address.

numba compiles loops well, but does not put eight pixels into one vector where bytes must be shuffled, and knows no load
of eight bytes from any address. These functions can be called from compiled functions only. LLVM makes of them whatever
the processor has: AVX2, AVX-512 and NEON need no word here.

Addresses are plain integers; whoever calls must keep them inside arrays. What may be read or written beyond is said
with each function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES: Final = 8
GROUP: Final = 2 * LANES
"""Pixels that share a vector of words; `choice.py`."""
SAMPLE_BYTES: Final = 6
MEAN_BYTES: Final = 16
"""Of a colour's mean: red, green, blue and nothing, float32."""
SUM_BYTES: Final = 16 * LANES
"""Of eight pixels' sums: red, green, blue and nothing, float32."""

_I8, _I16, _I32, _I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
_F32 = ir.FloatType()
_FLOATS = ir.VectorType(_F32, LANES)
_WORDS = ir.VectorType(_I32, LANES)
_PAIRS = ir.VectorType(_I64, LANES // 2)
_ADDRESS = types.int64
_MULTIPLIERS: Final = (0x21F0AAAD, 0x735A2D97, 0x31848BAB)

Builder = Any
Value = Any


def _constant(kind: Any, numbers: int | Sequence[int]) -> Value:
    return ir.Constant(kind, [numbers] * kind.count if isinstance(numbers, int) else list(numbers))


def _spread(builder: Builder, number: Value, kind: Any) -> Value:
    """Return a vector whose every lane is `number`."""
    unset = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(unset, number, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, unset, _constant(ir.VectorType(_I32, kind.count), 0))


def _at(builder: Builder, address: Value, offset: int, kind: Any) -> Value:
    return builder.inttoptr(builder.add(address, ir.Constant(_I64, offset)), kind.as_pointer())


def _load(builder: Builder, address: Value, offset: int, kind: Any) -> Value:
    loaded = builder.load(_at(builder, address, offset, kind))
    loaded.align = 1
    return loaded


def _store(builder: Builder, value: Value, address: Value, offset: int) -> None:
    builder.store(value, _at(builder, address, offset, value.type)).align = 1


def _colours(builder: Builder, picture: Value, bits: Value) -> Value:
    """Return the colour indices of the eight pixels (24 bytes) at `picture`."""
    bytes_ = ir.VectorType(_I8, 16)
    first, second = _load(builder, picture, 0, bytes_), _load(builder, picture, 8, bytes_)
    both = builder.shuffle_vector(first, second, _constant(ir.VectorType(_I32, 32), range(32)))
    lanes: list[int] = []
    for pixel in range(LANES):
        start = 3 * pixel if pixel < 4 else 3 * pixel - 8 + 16
        lanes += [start + 2, start + 1, start, 32]
    spread = builder.shuffle_vector(
        both, _constant(ir.VectorType(_I8, 32), 0), _constant(ir.VectorType(_I32, 32), lanes)
    )
    codes = builder.bitcast(spread, _WORDS)  # blue | green << 8 | red << 16

    def field(place: int) -> Value:
        shift = builder.sub(ir.Constant(_I32, 8 * (place + 1)), builder.mul(bits, ir.Constant(_I32, place + 1)))
        ones = builder.sub(builder.shl(ir.Constant(_I32, 1), bits), ir.Constant(_I32, 1))
        mask = builder.shl(ones, builder.mul(bits, ir.Constant(_I32, place)))
        return builder.and_(builder.lshr(codes, _spread(builder, shift, _WORDS)), _spread(builder, mask, _WORDS))

    return builder.or_(builder.or_(field(0), field(1)), field(2))


def _digits(builder: Builder, word: Value, keys: Sequence[Value], count: Value) -> tuple[Value, Value]:
    """Return the choices of the pixels in the first and second half of a group; the rule is that of `choice.py`."""
    numbers = builder.add(_spread(builder, word, _WORDS), _constant(_WORDS, range(LANES)))
    h = builder.xor(numbers, _spread(builder, keys[0], _WORDS))
    h = builder.mul(h, _constant(_WORDS, _MULTIPLIERS[0]))
    for key, shift, multiplier in zip(keys[1:], (16, 15), _MULTIPLIERS[1:], strict=True):
        h = builder.xor(h, _spread(builder, key, _WORDS))
        h = builder.xor(h, builder.lshr(h, _constant(_WORDS, shift)))
        h = builder.mul(h, _constant(_WORDS, multiplier))
    counts = _spread(builder, count, _WORDS)

    def upper(numbers: Value) -> Value:
        """Return the upper halves of the products with `count`, even and odd lanes by one 64-bit product each."""
        low, half = _constant(_PAIRS, 0xFFFFFFFF), _constant(_PAIRS, 32)
        pairs, factor = builder.bitcast(numbers, _PAIRS), builder.and_(builder.bitcast(counts, _PAIRS), low)
        even = builder.lshr(builder.mul(builder.and_(pairs, low), factor), half)
        odd = builder.mul(builder.lshr(pairs, half), factor)
        odd = builder.and_(odd, _constant(_PAIRS, 0xFFFFFFFF << 32))
        return builder.bitcast(builder.or_(even, odd), _WORDS)

    return upper(h), upper(builder.mul(h, counts))


def _void(emit: Callable[..., None], *kinds: Any) -> Any:
    """Return what numba wants of an intrinsic that returns nothing."""

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del signature
        emit(builder, *arguments)
        return context.get_dummy_value()

    return types.void(*kinds), generate


@intrinsic
def choose(typing: Any, picture: Any, word: Any, k0: Any, k1: Any, k2: Any, count: Any, bits: Any, target: Any) -> Any:
    """Write where in a light's samples the 16 pixels at `picture` find theirs: uint32 offsets in bytes, at `target`.

    `word` is the number of the group's first word; reads 48 bytes, writes 64.
    """
    del typing, picture, word, k0, k1, k2, count, bits, target
    number = types.uint32

    def emit(
        builder: Builder,
        picture: Value,
        word: Value,
        k0: Value,
        k1: Value,
        k2: Value,
        count: Value,
        bits: Value,
        target: Value,
    ) -> None:
        stride = _spread(builder, builder.mul(count, ir.Constant(_I32, SAMPLE_BYTES)), _WORDS)
        for half, choices in enumerate(_digits(builder, word, (k0, k1, k2), count)):
            begin = builder.add(picture, ir.Constant(_I64, 3 * LANES * half))
            colours = builder.mul(_colours(builder, begin, bits), stride)
            offsets = builder.add(colours, builder.mul(choices, _constant(_WORDS, SAMPLE_BYTES)))
            _store(builder, offsets, target, 4 * LANES * half)

    return _void(emit, _ADDRESS, number, number, number, number, number, number, _ADDRESS)


@intrinsic
def name_colours(typing: Any, picture: Any, bits: Any, target: Any) -> Any:
    """Write where the means of the 16 pixels at `picture` stand: uint32 offsets in bytes, `MEAN_BYTES` a colour."""
    del typing, picture, bits, target

    def emit(builder: Builder, picture: Value, bits: Value, target: Value) -> None:
        for half in range(2):
            colours = _colours(builder, builder.add(picture, ir.Constant(_I64, 3 * LANES * half)), bits)
            _store(builder, builder.mul(colours, _constant(_WORDS, MEAN_BYTES)), target, 4 * LANES * half)

    return _void(emit, _ADDRESS, types.uint32, _ADDRESS)


@intrinsic
def offset_at(typing: Any, source: Any) -> Any:
    """Return the uint32 at `source` as an address can be added to it."""
    del typing, source

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        return builder.zext(_load(builder, arguments[0], 0, _I32), _I64)

    return types.int64(_ADDRESS), generate


@intrinsic
def copy8(typing: Any, source: Any, target: Any) -> Any:
    """Copy a sample and the two bytes behind it."""
    del typing, source, target

    def emit(builder: Builder, source: Value, target: Value) -> None:
        _store(builder, _load(builder, source, 0, _I64), target, 0)

    return _void(emit, _ADDRESS, _ADDRESS)


@intrinsic
def copy6(typing: Any, source: Any, target: Any) -> Any:
    """Copy a sample."""
    del typing, source, target

    def emit(builder: Builder, source: Value, target: Value) -> None:
        _store(builder, _load(builder, source, 0, _I32), target, 0)
        _store(builder, _load(builder, source, 4, _I16), target, 4)

    return _void(emit, _ADDRESS, _ADDRESS)


@intrinsic
def copy2(typing: Any, source: Any, target: Any) -> Any:
    """Copy one channel of a sample."""
    del typing, source, target

    def emit(builder: Builder, source: Value, target: Value) -> None:
        _store(builder, _load(builder, source, 0, _I16), target, 0)

    return _void(emit, _ADDRESS, _ADDRESS)


@intrinsic
def copy1(typing: Any, source: Any, target: Any) -> Any:
    """Copy one byte."""
    del typing, source, target

    def emit(builder: Builder, source: Value, target: Value) -> None:
        _store(builder, _load(builder, source, 0, _I8), target, 0)

    return _void(emit, _ADDRESS, _ADDRESS)


def _joined(builder: Builder, parts: Sequence[Value]) -> Value:
    """Return vectors as one; there are a power of two."""
    while len(parts) > 1:
        kind = ir.VectorType(_I32, 2 * parts[0].type.count)
        parts = [
            builder.shuffle_vector(first, second, _constant(kind, range(kind.count)))
            for first, second in zip(parts[::2], parts[1::2], strict=True)
        ]
    return parts[0]


def _channels(builder: Builder, samples: Value, offsets: Value, step: Value) -> list[Value]:
    """Return red, green and blue, eight float32 each, of the samples whose offsets are `step` bytes apart."""
    quads = ir.VectorType(_I16, 4)
    parts = [
        _load(
            builder,
            builder.add(
                samples,
                builder.zext(
                    _load(builder, builder.add(offsets, builder.mul(step, ir.Constant(_I64, lane))), 0, _I32), _I64
                ),
            ),
            0,
            quads,
        )
        for lane in range(LANES)
    ]
    everything = _joined(builder, parts)
    lanes = ir.VectorType(_I32, LANES)
    return [
        builder.sitofp(
            builder.zext(
                builder.shuffle_vector(everything, everything, _constant(lanes, range(channel, 4 * LANES, 4))),
                _WORDS,
            ),
            _FLOATS,
        )
        for channel in range(3)
    ]


def _least(builder: Builder, first: Value, second: Value) -> Value:
    return builder.select(builder.fcmp_ordered("<", first, second), first, second)


@intrinsic
def planes8(typing: Any, samples: Any, offsets: Any, step: Any, scale: Any, red: Any, green: Any, blue: Any) -> Any:
    """Write eight pixels as float32 to three planes: sample times `scale`, at most 1; offsets `step` bytes apart."""
    del typing, samples, offsets, step, scale, red, green, blue

    def emit(
        builder: Builder,
        samples: Value,
        offsets: Value,
        step: Value,
        scale: Value,
        red: Value,
        green: Value,
        blue: Value,
    ) -> None:
        factor, one = _spread(builder, scale, _FLOATS), ir.Constant(_FLOATS, [1.0] * LANES)
        for channel, target in zip(_channels(builder, samples, offsets, step), (red, green, blue), strict=True):
            _store(builder, _least(builder, builder.fmul(channel, factor), one), target, 0)

    return _void(emit, _ADDRESS, _ADDRESS, _ADDRESS, types.float32, _ADDRESS, _ADDRESS, _ADDRESS)


@intrinsic
def plane1(typing: Any, source: Any, scale: Any, target: Any) -> Any:
    """Write one channel of one pixel as float32: `planes8` for what is narrower."""
    del typing, source, scale, target

    def emit(builder: Builder, source: Value, scale: Value, target: Value) -> None:
        value = builder.uitofp(_load(builder, source, 0, _I16), _F32)
        _store(builder, _least(builder, builder.fmul(value, scale), ir.Constant(_F32, 1.0)), target, 0)

    return _void(emit, _ADDRESS, types.float32, _ADDRESS)


@intrinsic
def prefetch(typing: Any, address: Any) -> Any:
    """Ask for the memory at `address` to be at hand soon."""
    del typing, address

    def emit(builder: Builder, address: Value) -> None:
        pointer = _I8.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, _I32, _I32, _I32])
        function = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
        numbers = [ir.Constant(_I32, number) for number in (0, 3, 1)]  # to read, keep close, data
        builder.call(function, [_at(builder, address, 0, _I8), *numbers])

    return _void(emit, _ADDRESS)


@intrinsic
def add_light8(
    typing: Any, samples: Any, offsets: Any, means: Any, colours: Any, weights: Any, step: Any, total: Any, faults: Any
) -> Any:
    """Add one light to eight pixels' sums at `total`; see `mixing.py`.

    `offsets` leads to the samples, `colours` to the means; weights are float32, `step` bytes apart. Sums are four
    float32 a pixel, red, green, blue and one without meaning. The eight float32 at `faults` are no numbers from the
    moment that a weight was negative, infinite or no number.
    """
    del typing, samples, offsets, means, colours, weights, step, total, faults

    def emit(
        builder: Builder,
        samples: Value,
        offsets: Value,
        means: Value,
        colours: Value,
        weights: Value,
        step: Value,
        total: Value,
        faults: Value,
    ) -> None:
        weight = ir.Constant(_FLOATS, ir.Undefined)
        for lane in range(LANES):
            number = _load(builder, builder.add(weights, builder.mul(step, ir.Constant(_I64, lane))), 0, _F32)
            weight = builder.insert_element(weight, number, ir.Constant(_I32, lane))
        name = f"llvm.sqrt.v{LANES}f32"
        root_of = builder.module.globals.get(name) or ir.Function(
            builder.module, ir.FunctionType(_FLOATS, [_FLOATS]), name
        )
        root = builder.call(root_of, [weight])
        rest = builder.fsub(weight, root)

        def two(base: Value, places: Value, first: int, kind: Any) -> Value:
            """Return the four numbers each that pixels `first` and the next find at their places."""
            parts = [
                _load(builder, builder.add(base, builder.zext(_load(builder, places, 4 * lane, _I32), _I64)), 0, kind)
                for lane in (first, first + 1)
            ]
            return builder.shuffle_vector(*parts, _constant(_WORDS, range(LANES)))

        for first in range(0, LANES, 2):
            pixels = _constant(_WORDS, [first] * 4 + [first + 1] * 4)
            drawn = builder.zext(two(samples, offsets, first, ir.VectorType(_I16, 4)), _WORDS)
            drawn = builder.fmul(builder.sitofp(drawn, _FLOATS), builder.shuffle_vector(root, root, pixels))
            mean = two(means, colours, first, ir.VectorType(_F32, 4))
            mean = builder.fmul(mean, builder.shuffle_vector(rest, rest, pixels))
            value = builder.fadd(builder.fadd(_load(builder, total, 16 * first, _FLOATS), drawn), mean)
            _store(builder, value, total, 16 * first)
        # The root of what is negative, and nothing times infinity, are no numbers.
        nothing = builder.fmul(root, ir.Constant(_FLOATS, [0.0] * LANES))
        _store(builder, builder.fadd(_load(builder, faults, 0, _FLOATS), nothing), faults, 0)

    return _void(emit, _ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS)


@intrinsic
def round8(typing: Any, total: Any, white: Any, target: Any) -> Any:
    """Write eight pixels' sums as uint16, rounded, from 0 to `white`, and set the sums to 0."""
    del typing, total, white, target

    def emit(builder: Builder, total: Value, white: Value, target: Value) -> None:
        half, zero = ir.Constant(_FLOATS, [0.5] * LANES), ir.Constant(_FLOATS, [0.0] * LANES)
        most = _spread(builder, white, _FLOATS)
        parts: list[Value] = []
        for first in range(0, LANES, 2):
            value = builder.fadd(_load(builder, total, 16 * first, _FLOATS), half)
            _store(builder, zero, total, 16 * first)
            value = builder.select(builder.fcmp_ordered(">", value, zero), value, zero)
            whole = builder.fptosi(_least(builder, value, most), _WORDS)
            parts.append(builder.trunc(whole, ir.VectorType(_I16, LANES)))
        everything = _joined(builder, parts)
        order = [4 * pixel + channel for pixel in range(LANES) for channel in range(3)]
        kind = ir.VectorType(_I32, 3 * LANES)
        _store(builder, builder.shuffle_vector(everything, everything, _constant(kind, order)), target, 0)

    return _void(emit, _ADDRESS, types.float32, _ADDRESS)
