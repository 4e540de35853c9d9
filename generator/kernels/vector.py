"""Steps of the kernels written in LLVM's own terms: vectors of 16 32-bit numbers, and loads and stores by address.

numba compiles loops well, but does not put many pixels into one vector where bytes must be shuffled, and knows no load
of eight bytes from any address. These functions can be called from compiled functions only. LLVM makes of them whatever
the processor has: one vector of AVX-512, two of AVX2, four of NEON. Bytes change places within 16, which all can do.

Addresses are plain integers; whoever calls must keep them inside arrays. What may be read or written beyond is said
with each function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from llvmlite import ir

from foundation.compiled import intrinsic

LANES: Final = 16
"""Numbers of 32 bits in a vector: one register of AVX-512."""
GROUP: Final = 2 * LANES
"""Pixels whose choices come from one vector of words, two from each word; see `choice.py`."""
EIGHT: Final = 8
"""Pixels that are written to float32 planes at a time: one register of AVX2 a channel."""
SAMPLE_BYTES: Final = 6
"""Bytes of a sample: red, green and blue, uint16 each."""
LINE: Final = 64
"""Bytes of a line of the cache, on x86-64 and on most arm64 processors."""

I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
F32 = ir.FloatType()
FLOATS = ir.VectorType(F32, LANES)
WORDS = ir.VectorType(I32, LANES)
_PAIRS = ir.VectorType(I64, LANES // 2)
_EIGHT_FLOATS, _EIGHT_WORDS = ir.VectorType(F32, EIGHT), ir.VectorType(I32, EIGHT)
_LINE = ir.VectorType(I32, LINE // 4)
ADDRESS: Final = "int64"
_MULTIPLIERS: Final = (0x21F0AAAD, 0x735A2D97, 0x31848BAB)
"""Of the three rounds of the choice rule; `choice.py` names their source."""

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


def _colours(builder: Builder, picture: Value, bits: Value) -> Value:
    """Return the colour indices of the 16 pixels (48 bytes) at `picture`."""
    # Four pixels for each 16 bytes of the vector; the last four are loaded so that nothing behind them is.
    starts = (0, 12, 24, 32)
    loaded = concatenated(builder, [load(builder, picture, start, ir.VectorType(I8, 16)) for start in starts])
    lanes: list[int] = []
    for four, start in enumerate(starts):
        for pixel in range(4):
            first = 16 * four + 12 * four - start + 3 * pixel
            lanes += [first + 2, first + 1, first, 4 * LANES]
    nothing = constant(loaded.type, 0)
    laid = builder.shuffle_vector(loaded, nothing, constant(ir.VectorType(I32, 4 * LANES), lanes))
    codes = builder.bitcast(laid, WORDS)  # blue | green << 8 | red << 16

    def field(place: int) -> Value:
        shift = builder.sub(ir.Constant(I32, 8 * (place + 1)), builder.mul(bits, ir.Constant(I32, place + 1)))
        ones = builder.sub(builder.shl(ir.Constant(I32, 1), bits), ir.Constant(I32, 1))
        mask = builder.shl(ones, builder.mul(bits, ir.Constant(I32, place)))
        return builder.and_(builder.lshr(codes, broadcast(builder, shift, WORDS)), broadcast(builder, mask, WORDS))

    return builder.or_(builder.or_(field(0), field(1)), field(2))


def hashed(builder: Builder, word: Value, keys: Sequence[Value]) -> Value:
    """Return the words h of a group; the rule is that of `choice.py`."""
    numbers = builder.add(broadcast(builder, word, WORDS), constant(WORDS, range(LANES)))
    h = builder.xor(numbers, broadcast(builder, keys[0], WORDS))
    h = builder.mul(h, constant(WORDS, _MULTIPLIERS[0]))
    for key, shift, multiplier in zip(keys[1:], (16, 15), _MULTIPLIERS[1:], strict=True):
        h = builder.xor(h, broadcast(builder, key, WORDS))
        h = builder.xor(h, builder.lshr(h, constant(WORDS, shift)))
        h = builder.mul(h, constant(WORDS, multiplier))
    return h


def digits(builder: Builder, h: Value, count: Value) -> tuple[Value, ...]:
    """Return the choices of the first and the second 16 pixels of a group, from its words."""
    counts = broadcast(builder, count, WORDS)

    def upper(numbers: Value) -> Value:
        """Return the upper halves of the products with `count`, even and odd lanes by one 64-bit product each."""
        low, half = constant(_PAIRS, 0xFFFFFFFF), constant(_PAIRS, 32)
        pairs, factor = builder.bitcast(numbers, _PAIRS), builder.and_(builder.bitcast(counts, _PAIRS), low)
        even = builder.lshr(builder.mul(builder.and_(pairs, low), factor), half)
        odd = builder.mul(builder.lshr(pairs, half), factor)
        odd = builder.and_(odd, constant(_PAIRS, 0xFFFFFFFF << 32))
        return builder.bitcast(builder.or_(even, odd), WORDS)

    first, second = upper(h), upper(builder.mul(h, counts))
    # Eight words serve eight pixels by their first digits and the next eight by their second.
    return tuple(
        builder.shuffle_vector(
            first, second, constant(WORDS, [*range(half, half + EIGHT), *range(LANES + half, LANES + half + EIGHT)])
        )
        for half in (0, EIGHT)
    )


def signature(returned: str, *kinds: str) -> Any:
    """Return numba's type of a function that returns one kind and takes others, by their names."""
    from numba import types

    named: Any = types
    return getattr(named, returned)(*(getattr(named, kind) for kind in kinds))


def void(emit: Callable[..., None], *kinds: str) -> Any:
    """Return what numba wants of an intrinsic that returns nothing."""

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del signature
        emit(builder, *arguments)
        return context.get_dummy_value()

    return signature("void", *kinds), generate


@intrinsic
def choose(typing: Any, picture: Any, word: Any, k0: Any, k1: Any, k2: Any, count: Any, bits: Any, target: Any) -> Any:
    """Write to `target` the offsets, uint32 bytes, of the samples chosen for the 32 pixels at `picture`.

    `word` is the number of the group's first word; 96 bytes are read, 128 written.
    """
    del typing, picture, word, k0, k1, k2, count, bits, target
    number = "uint32"

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
        stride = broadcast(builder, builder.mul(count, ir.Constant(I32, SAMPLE_BYTES)), WORDS)
        for half, choices in enumerate(digits(builder, hashed(builder, word, (k0, k1, k2)), count)):
            begin = builder.add(picture, ir.Constant(I64, 3 * LANES * half))
            colours = builder.mul(_colours(builder, begin, bits), stride)
            offsets = builder.add(colours, builder.mul(choices, constant(WORDS, SAMPLE_BYTES)))
            store(builder, offsets, target, 4 * LANES * half)

    return void(emit, ADDRESS, number, number, number, number, number, number, ADDRESS)


@intrinsic
def write_colours(
    typing: Any, picture: Any, bits: Any, stride: Any, target: Any, other_stride: Any, other_target: Any
) -> Any:
    """Write the colours of the 32 pixels at `picture` as uint32: their indices times each stride, at each target."""
    del typing, picture, bits, stride, target, other_stride, other_target

    def emit(
        builder: Builder,
        picture: Value,
        bits: Value,
        stride: Value,
        target: Value,
        other_stride: Value,
        other_target: Value,
    ) -> None:
        for half in range(2):
            colours = _colours(builder, builder.add(picture, ir.Constant(I64, 3 * LANES * half)), bits)
            for factor, place in ((stride, target), (other_stride, other_target)):
                store(builder, builder.mul(colours, broadcast(builder, factor, WORDS)), place, 4 * LANES * half)

    return void(emit, ADDRESS, "uint32", "uint32", ADDRESS, "uint32", ADDRESS)


@intrinsic
def choose_for_colours(typing: Any, colours: Any, word: Any, k0: Any, k1: Any, k2: Any, count: Any, target: Any) -> Any:
    """Write what `choose` writes for the 32 pixels whose colours stand at `colours`, times the bytes of a colour."""
    del typing, colours, word, k0, k1, k2, count, target
    number = "uint32"

    def emit(
        builder: Builder, colours: Value, word: Value, k0: Value, k1: Value, k2: Value, count: Value, target: Value
    ) -> None:
        for half, choices in enumerate(digits(builder, hashed(builder, word, (k0, k1, k2)), count)):
            named = load(builder, colours, 4 * LANES * half, WORDS)
            offsets = builder.add(named, builder.mul(choices, constant(WORDS, SAMPLE_BYTES)))
            store(builder, offsets, target, 4 * LANES * half)

    return void(emit, ADDRESS, number, number, number, number, number, ADDRESS)


@intrinsic
def offset_at(typing: Any, source: Any) -> Any:
    """Return the uint32 at `source` as an address can be added to it."""
    del typing, source

    def generate(context: Any, builder: Builder, signature: Any, arguments: Sequence[Value]) -> Value:
        del context, signature
        return builder.zext(load(builder, arguments[0], 0, I32), I64)

    return signature("int64", ADDRESS), generate


def _copying(*parts: tuple[int, Any]) -> Callable[..., None]:
    """Return what emits the copying of values, each given by its offset in bytes and its kind."""

    def emit(builder: Builder, source: Value, target: Value) -> None:
        for offset, kind in parts:
            store(builder, load(builder, source, offset, kind), target, offset)

    return emit


@intrinsic
def copy8(typing: Any, source: Any, target: Any) -> Any:
    """Copy a sample and the two bytes behind it."""
    del typing, source, target
    return void(_copying((0, I64)), ADDRESS, ADDRESS)


@intrinsic
def copy6(typing: Any, source: Any, target: Any) -> Any:
    """Copy a sample."""
    del typing, source, target
    return void(_copying((0, I32), (4, I16)), ADDRESS, ADDRESS)


@intrinsic
def copy2(typing: Any, source: Any, target: Any) -> Any:
    """Copy one channel of a sample."""
    del typing, source, target
    return void(_copying((0, I16)), ADDRESS, ADDRESS)


@intrinsic
def copy_line(typing: Any, source: Any, target: Any) -> Any:
    """Copy a line's bytes."""
    del typing, source, target
    return void(_copying((0, _LINE)), ADDRESS, ADDRESS)


@intrinsic
def stream_line(typing: Any, source: Any, target: Any) -> Any:
    """Copy a line's bytes past the caches to `target`, a multiple of `LINE`; to be followed by `store_fence`."""
    del typing, source, target

    def emit(builder: Builder, source: Value, target: Value) -> None:
        written = builder.store(load(builder, source, 0, _LINE), pointer_at(builder, target, 0, _LINE))
        written.align = LINE
        written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(I32, 1)]))

    return void(emit, ADDRESS, ADDRESS)


@intrinsic
def store_fence(typing: Any) -> Any:
    """Wait until all threads can see what was streamed."""
    del typing

    def emit(builder: Builder) -> None:
        builder.fence("seq_cst")

    return void(emit)


@intrinsic
def copy1(typing: Any, source: Any, target: Any) -> Any:
    """Copy one byte."""
    del typing, source, target
    return void(_copying((0, I8)), ADDRESS, ADDRESS)


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


def _planes8(step: int) -> Callable[..., None]:
    """Return what emits the writing of eight pixels whose offsets are `step` bytes apart."""

    def emit(
        builder: Builder, samples: Value, offsets: Value, line: Value, red: Value, green: Value, blue: Value
    ) -> None:
        def number(place: int) -> Value:
            return broadcast(builder, load(builder, line, 4 * place, F32), _EIGHT_FLOATS)

        channels = _channels(builder, samples, offsets, step)
        for place, (channel, target) in enumerate(zip(channels, (red, green, blue), strict=True)):
            value = builder.fadd(builder.fmul(channel, number(place)), number(3 + place))
            store(builder, minimum(builder, value, number(6)), target, 0)

    return emit


@intrinsic
def planes8(typing: Any, samples: Any, offsets: Any, line: Any, red: Any, green: Any, blue: Any) -> Any:
    """Write eight pixels as float32 to three planes: sample times factor, plus summand, at most a limit.

    At `line` are seven float32: factors and summands of red, green and blue, and the limit.
    """
    del typing, samples, offsets, line, red, green, blue
    return void(_planes8(4), ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS)


@intrinsic
def planes8_mirrored(typing: Any, samples: Any, offsets: Any, line: Any, red: Any, green: Any, blue: Any) -> Any:
    """Do `planes8` from right to left: `offsets` points to the first pixel's offset, the others' stand before it."""
    del typing, samples, offsets, line, red, green, blue
    return void(_planes8(-4), ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS, ADDRESS)


@intrinsic
def plane1(typing: Any, source: Any, factor: Any, summand: Any, limit: Any, target: Any) -> Any:
    """Write one channel of one pixel as float32: `planes8` for what is narrower."""
    del typing, source, factor, summand, limit, target

    def emit(builder: Builder, source: Value, factor: Value, summand: Value, limit: Value, target: Value) -> None:
        value = builder.fmul(builder.uitofp(load(builder, source, 0, I16), F32), factor)
        store(builder, minimum(builder, builder.fadd(value, summand), limit), target, 0)

    return void(emit, ADDRESS, "float32", "float32", "float32", ADDRESS)


def _prefetching(locality: int) -> Callable[..., None]:
    """Return an emitter of LLVM's prefetch with that locality: 3 keeps the line in every cache, 0 in none."""

    def emit(builder: Builder, address: Value) -> None:
        pointer = I8.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, I32, I32, I32])
        function = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
        numbers = [ir.Constant(I32, number) for number in (0, locality, 1)]  # to read, how near, data
        builder.call(function, [pointer_at(builder, address, 0, I8), *numbers])

    return emit


@intrinsic
def prefetch(typing: Any, address: Any) -> Any:
    """Prefetch the line of `address` into all caches; an address without memory is ignored."""
    del typing, address
    return void(_prefetching(3), ADDRESS)


@intrinsic
def prefetch_once(typing: Any, address: Any) -> Any:
    """Prefetch a line that is read once, so that it takes no place in the larger caches."""
    del typing, address
    return void(_prefetching(0), ADDRESS)
