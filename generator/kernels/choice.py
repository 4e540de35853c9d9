"""Which of a colour's samples a pixel gets: a pure function of (seed, image number, light's place, x, y).

Its steps are LLVM's vectors (`kernels/vector.py`) and can be called from compiled functions only, as can those that
prefetch. Beside that what all kernels share: the colours of a table, and their arguments, which are checked before
compiled code reads their memory.

Tiles, threads and workers cannot change a choice. The rule is part of the dataset format
(`docs/decisions/0010-compiled-kernel.md` says why it is this one); all arithmetic is modulo 2³² but for p and q::

    keys     k0, k1, k2: the first words of Philox4x32-10 with counter (y, place, image, 0) and the seed as key
    word     i = 8 ⌊x/16⌋ + x mod 8,  h = (i ⊕ k0) · 0x21F0AAAD ⊕ k1,  h = (h ⊕ ⌊h/2¹⁶⌋) · 0x735A2D97 ⊕ k2,
             h = (h ⊕ ⌊h/2¹⁵⌋) · 0x31848BAB
    sample   p = h S and q = (p mod 2³²) S, S the samples of a colour; ⌊p/2³²⌋ where x mod 16 < 8, else ⌊q/2³²⌋

`place` is 0 but where lights are mixed per pixel: there it is the light's place among them. Rows are keyed by 96
random bits, so rows, images, seeds and places are as independent as Philox makes them. Within a row three keyed rounds
of multiplying and shifting are needed: with one, pictures of two seeds are each other's with neighbours swapped; with
two, pixels whose distance is near a power of two depend on each other. The two choices from one word are its first two
digits in base S and differ from independent ones by less than S²/2³² of their probability.

The multipliers are odd numbers found by others to spread changes well: C. Wellons, "Prospecting for hash functions",
2018, and its collection of improved constants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numpy import uint32, uint64

from foundation.compiled import inlined
from foundation.errors import InputError, value_text
from generator.kernels.vector import (
    ADDRESS,
    EIGHT,
    GROUP,
    I8,
    I32,
    I64,
    LANES,
    LINE,
    SAMPLE_BYTES,
    WORDS,
    Builder,
    Value,
    broadcast,
    constant,
    copy1,
    load,
    pixel_codes,
    pointer_at,
    step,
    store,
)
from generator.philox import KEY_STEPS, MULTIPLIERS, ROUNDS, SAMPLES, key_of

# Groups of pixels by which choosing offsets leads fetching samples, so that the processor computes while it waits.
LEAD: Final = 2
OFFSETS_BYTES: Final = 4 * GROUP  # Bytes of a group's offsets, uint32 each
# Bytes by which prefetching the picture leads reading it, some 21 groups: time for the memory to answer.
_PREFETCH_BYTES: Final = 2048
# Bytes of scratch memory for the last pixels of a row: a group's 96, rounded up to whole lines of the cache.
EDGE_BYTES: Final = 128
# Bytes of scratch memory a thread needs: a row's last pixels, and the offsets of four groups, LEAD + 1 in use.
SCRATCH_BYTES: Final = EDGE_BYTES + 4 * OFFSETS_BYTES

_P0: Final = np.uint64(MULTIPLIERS[0])
_P1: Final = np.uint64(MULTIPLIERS[1])
_W0: Final = np.uint32(KEY_STEPS[0])
_W1: Final = np.uint32(KEY_STEPS[1])
_HALF: Final = np.uint64(32)
_PURPOSE: Final = np.uint32(SAMPLES)
_PAIRS: Final = ir.VectorType(I64, LANES // 2)
_MULTIPLIERS: Final = (0x21F0AAAD, 0x735A2D97, 0x31848BAB)  # Of the three rounds of the rule


def _colours(builder: Builder, picture: Value, bits: Value) -> Value:
    """Return the colour indices of the 16 pixels (48 bytes) at `picture`."""
    codes = pixel_codes(builder, picture)

    def field(place: int) -> Value:
        shift = builder.sub(ir.Constant(I32, 8 * (place + 1)), builder.mul(bits, ir.Constant(I32, place + 1)))
        ones = builder.sub(builder.shl(ir.Constant(I32, 1), bits), ir.Constant(I32, 1))
        mask = builder.shl(ones, builder.mul(bits, ir.Constant(I32, place)))
        return builder.and_(builder.lshr(codes, broadcast(builder, shift, WORDS)), broadcast(builder, mask, WORDS))

    return builder.or_(builder.or_(field(0), field(1)), field(2))


def _hashed(builder: Builder, word: Value, keys: Sequence[Value]) -> Value:
    numbers = builder.add(broadcast(builder, word, WORDS), constant(WORDS, range(LANES)))
    h = builder.xor(numbers, broadcast(builder, keys[0], WORDS))
    h = builder.mul(h, constant(WORDS, _MULTIPLIERS[0]))
    for key, shift, multiplier in zip(keys[1:], (16, 15), _MULTIPLIERS[1:], strict=True):
        h = builder.xor(h, broadcast(builder, key, WORDS))
        h = builder.xor(h, builder.lshr(h, constant(WORDS, shift)))
        h = builder.mul(h, constant(WORDS, multiplier))
    return h


def _digits(builder: Builder, h: Value, count: Value) -> tuple[Value, ...]:
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


@step(ADDRESS, "uint32", "uint32", "uint32", "uint32", "uint32", "uint32", ADDRESS)
def choose(
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
    """Write to `target` the offsets, uint32 bytes, of the samples chosen for the 32 pixels at `picture`.

    `word` is the number of the group's first word; 96 bytes are read, 128 written.
    """
    stride = broadcast(builder, builder.mul(count, ir.Constant(I32, SAMPLE_BYTES)), WORDS)
    for half, choices in enumerate(_digits(builder, _hashed(builder, word, (k0, k1, k2)), count)):
        begin = builder.add(picture, ir.Constant(I64, 3 * LANES * half))
        colours = builder.mul(_colours(builder, begin, bits), stride)
        offsets = builder.add(colours, builder.mul(choices, constant(WORDS, SAMPLE_BYTES)))
        store(builder, offsets, target, 4 * LANES * half)


@step(ADDRESS, "uint32", "uint32", ADDRESS, "uint32", ADDRESS)
def write_colours(
    builder: Builder,
    picture: Value,
    bits: Value,
    stride: Value,
    target: Value,
    other_stride: Value,
    other_target: Value,
) -> None:
    """Write the colours of the 32 pixels at `picture` as uint32: their indices times each stride, at each target."""
    for half in range(2):
        colours = _colours(builder, builder.add(picture, ir.Constant(I64, 3 * LANES * half)), bits)
        for factor, place in ((stride, target), (other_stride, other_target)):
            store(builder, builder.mul(colours, broadcast(builder, factor, WORDS)), place, 4 * LANES * half)


@step(ADDRESS, "uint32", "uint32", "uint32", "uint32", "uint32", ADDRESS)
def choose_for_colours(
    builder: Builder, colours: Value, word: Value, k0: Value, k1: Value, k2: Value, count: Value, target: Value
) -> None:
    """Write what `choose` writes for the 32 pixels whose colours stand at `colours`, times the bytes of a colour."""
    for half, choices in enumerate(_digits(builder, _hashed(builder, word, (k0, k1, k2)), count)):
        named = load(builder, colours, 4 * LANES * half, WORDS)
        offsets = builder.add(named, builder.mul(choices, constant(WORDS, SAMPLE_BYTES)))
        store(builder, offsets, target, 4 * LANES * half)


def emit_prefetch(builder: Builder, address: Value, locality: int) -> None:
    """Write LLVM's prefetch with that locality: 3 keeps the line in every cache, 0 in none."""
    pointer = I8.as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [pointer, I32, I32, I32])
    function = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
    numbers = [ir.Constant(I32, number) for number in (0, locality, 1)]  # to read, how near, data
    builder.call(function, [pointer_at(builder, address, 0, I8), *numbers])


@step(ADDRESS)
def prefetch(builder: Builder, address: Value) -> None:
    """Prefetch the line of `address` into all caches; an address without memory is ignored."""
    emit_prefetch(builder, address, 3)


@step(ADDRESS)
def prefetch_once(builder: Builder, address: Value) -> None:
    """Prefetch a line that is read once, so that it takes no place in the larger caches."""
    emit_prefetch(builder, address, 0)


@inlined
def philox4x32(c0: Any, c1: Any, c2: Any, c3: Any, seed: Any) -> Any:
    """Return the four words of Philox4x32-10, compiled; words and counter are uint32, `seed` is uint64."""
    k0, k1 = uint32(seed), uint32(seed >> _HALF)
    for _ in range(ROUNDS):
        p0, p1 = uint64(c0) * _P0, uint64(c2) * _P1
        c0, c1, c2, c3 = (
            uint32(uint32(p1 >> _HALF) ^ c1 ^ k0),
            uint32(p1),
            uint32(uint32(p0 >> _HALF) ^ c3 ^ k1),
            uint32(p0),
        )
        k0, k1 = uint32(k0 + _W0), uint32(k1 + _W1)
    return c0, c1, c2, c3


@inlined
def row_keys(y: Any, place: Any, image: Any, seed: Any) -> Any:
    """Return the three keys (uint32) of row `y`; `seed` is uint64."""
    k0, k1, k2, _ = philox4x32(uint32(y), uint32(place), uint32(image), _PURPOSE, seed)
    return k0, k1, k2


@inlined
def offsets_slot(scratch: int, group: int) -> int:
    """Return where in a thread's scratch memory the offsets of `group` stand until they are used."""
    return scratch + EDGE_BYTES + OFFSETS_BYTES * (group & 3)


@inlined
def group_address(row: int, width: int, group: int, scratch: int) -> int:
    """Return where the pixels from x = 32 `group` on can be read; `row` is the address of a row's first pixel.

    Of a group that reaches beyond the row only the pixels in the row are copied to scratch memory.
    """
    source = row + 3 * GROUP * group
    if GROUP * (group + 1) > width:
        for i in range(3 * (width - GROUP * group)):
            copy1(source + i, scratch + i)
        source = scratch
    return source


@inlined
def prefetch_group(row: int, group: int) -> None:
    """Prefetch a group's share of the pixels that will be read soon; to be called for every group in turn."""
    line = row + 3 * GROUP * group + _PREFETCH_BYTES
    prefetch_once(line)
    prefetch_once(line + LINE)


@inlined
def choose_group(row: int, width: int, group: int, keys: Any, count: Any, bits: Any, scratch: int, target: int) -> None:
    """Write the offsets, uint32 bytes, of the samples of a row's pixels from x = 32 `group` on at `target`."""
    source = group_address(row, width, group, scratch)
    choose(source, uint32(LANES * group), keys[0], keys[1], keys[2], count, bits, target)


def bits_of(colours: int) -> int:
    """Return the bits a channel of a table with `colours` = 8**bits colours."""
    for bits in range(1, 6):
        if colours == 8**bits:
            return bits
    raise InputError(f"the samples are of {colours} colours, expected 8, 64, 512, 4096 or 32768")


def channels_of(colours: npt.ArrayLike, bits: int) -> npt.NDArray[np.int64]:
    """Return the codes (..., 3) int64, 0 … 2**bits − 1, of red, green and blue, of colour indices (...) int."""
    colours = np.asarray(colours, dtype=np.int64)
    mask = (1 << bits) - 1
    return np.stack([colours >> 2 * bits & mask, colours >> bits & mask, colours & mask], axis=-1)


Samples = npt.NDArray[np.uint16]
Picture = npt.NDArray[np.uint8]

# Bytes of a page, the smallest unit of memory protection on x86-64 and arm64; larger pages are whole multiples.
_PAGE: Final = 4096
_OFFSETS: Final = 0xFFFFFFFF  # Most bytes of a light's samples: compiled code counts them in 32 bits


def check_samples(samples: Samples) -> int:
    """Return the bits a channel of a light's samples; they must be uint16 (8**bits, S, 3), S ≥ 1."""
    if samples.dtype != np.uint16 or samples.ndim != 3 or samples.shape[2] != 3 or not samples.shape[1]:
        raise InputError(f"the samples are {samples.dtype} {samples.shape}, expected uint16 (8**bits, samples, 3)")
    if samples.nbytes > _OFFSETS:
        raise InputError(f"the samples of a light take {samples.nbytes} bytes, expected at most {_OFFSETS}")
    return bits_of(samples.shape[0])


def check_tables(tables: Samples | Sequence[Samples]) -> list[Samples]:
    """Return the samples of several lights as a list; they must be uint16 (8**bits, S, 3), all of one shape."""
    checked = list(tables)
    if not checked:
        raise InputError("no light was given to mix; give at least one")
    for table in checked:
        check_samples(table)
        if table.shape != checked[0].shape:
            raise InputError(f"the lights' samples are {checked[0].shape} and {table.shape}, expected one shape")
    return checked


def check_picture(picture: Any) -> None:
    """Check that `picture` is uint8 (H, W, 3)."""
    if getattr(picture, "dtype", None) != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(
            f"the picture is {value_text(picture)}, expected an array uint8 (height, width, 3), such as "
            "read_picture(FILE)"
        )


def check_out(
    out: npt.NDArray[Any] | None, shape: tuple[int, ...], dtype: type[np.uint16] | type[np.float32]
) -> npt.NDArray[Any]:
    """Return `out`, of that shape and that dtype, or a new array of them if it is None."""
    if out is None:
        return np.empty(shape, dtype)
    if out.dtype != dtype or out.shape != shape:
        raise InputError(f"the target is {out.dtype} {out.shape}, expected {np.dtype(dtype)} {shape}")
    if not out.flags.writeable:
        raise InputError("the target may not be written to; give an array whose flags.writeable is True")
    return out


def check_seed(seed: int, image: int) -> np.uint64:
    """Return the seed as uint64 after checking it and the image number."""
    key_of(seed)
    if not 0 <= image < 1 << 32:
        raise InputError(f"the image number is {image}, expected 0 to 2^32 - 1")
    return np.uint64(seed)


def check_white_level(white_level: int) -> None:
    """Check that `white_level` is 1 … 65535."""
    if not 1 <= white_level <= 65535:
        raise InputError(f"the white level is {white_level}, expected 1 to 65535")


def check_weights(weights: npt.ArrayLike, lights: int) -> npt.NDArray[np.float64]:
    """Return the weights (K,) of `lights` lights as (K,) float64."""
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (lights,) or not np.isfinite(checked).all() or (checked < 0).any():
        raise InputError(f"the weights are {np.asarray(weights).tolist()}, expected {lights} finite numbers from 0")
    return checked


def packed_rows(picture: Picture) -> Picture:
    """Return `picture` (H, W, 3) uint8 with the bytes of each row contiguous: itself, or a copy if they are not."""
    return picture if picture.strides[1:] == (3, 1) else np.ascontiguousarray(picture)


def readable(samples: Samples) -> Samples:
    """Return samples (8**bits, S, 3) uint16 as a contiguous array behind which two more bytes can be read.

    Samples, of six bytes, are fetched eight bytes at a time. The two bytes behind an array can be read if they are on
    the page of its last byte, whoever owns them; if not, or if the samples are not contiguous, a copy is returned.
    """
    last = samples.ctypes.data + samples.nbytes - 1
    if samples.flags.c_contiguous and last // _PAGE == (last + 2) // _PAGE:
        return samples
    padded = np.empty(samples.size + 1, np.uint16)
    padded[:-1] = samples.reshape(-1)
    return padded[:-1].reshape(samples.shape)


def writable(target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target`, (H, W, 3) or (H, W) uint16, if compiled code can write its rows, else a new array of its shape.

    Rows must be contiguous and at even addresses. A new array is to be given to `copied_back` when it is filled.
    """
    piece = (6, 2) if target.ndim == 3 else (2,)
    return target if target.strides[1:] == piece and target.flags.aligned else np.empty(target.shape, target.dtype)


def copied_back(work: npt.NDArray[np.uint16], target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target`, (H, W, 3) or (H, W) uint16, with the content of `work`: itself, or the array from `writable`."""
    if work is not target:
        target[...] = work
    return target


def run_in_threads(fill: Callable[[int, int], object], count: int, threads: int) -> None:
    """Call `fill(first, end)` for as many parts of 0 … count − 1 as there are threads, a thread each."""
    threads = min(threads, count)
    if threads <= 1:
        fill(0, count)
        return
    edges = [count * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, edges[:-1], edges[1:]))
