"""Choose a random sample for each pixel, and check the arguments of all kernels.

The look-up table (LUT) holds S samples of each patch colour. A pixel receives one sample of its colour. The choice
depends only on the seed, image number, stream (see below), x and y, so tiles, threads and workers cannot change it. The
rule is part of the data set format (reasons: `docs/decisions/0010-compiled-kernel.md`). All arithmetic is modulo 2³²
except for p and q::

    keys     k0, k1, k2: first words of Philox4x32-10 with counter (y, stream, image, 0) and the seed as key
    word     i = 8 ⌊x/16⌋ + x mod 8,  h = (i ⊕ k0) · 0x21F0AAAD ⊕ k1,  h = (h ⊕ ⌊h/2¹⁶⌋) · 0x735A2D97 ⊕ k2,
             h = (h ⊕ ⌊h/2¹⁵⌋) · 0x31848BAB
    sample   p = h S,  q = (p mod 2³²) S,  index of the sample: ⌊p/2³²⌋ if x mod 16 < 8, else ⌊q/2³²⌋

`stream` is 0 for an image under one illuminant. If several illuminants are mixed per pixel, the stream of each is its
index.

A group is 32 consecutive pixels of a row. The offset of a sample is its distance from the start of the samples, in
bytes. Functions decorated with `step` emit LLVM vector code (`kernels/vector.py`); only compiled functions can call
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numpy import uint32, uint64

from foundation.arrays import native
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

# Offsets are chosen this many groups before their samples are read, which hides the latency of memory.
LEAD: Final = 2
OFFSETS_BYTES: Final = 4 * GROUP  # Size of the offsets of a group, uint32 each
# The picture is prefetched this many bytes before it is read.
_PREFETCH_BYTES: Final = 2048
# Scratch memory for the last, incomplete group of a row, in bytes: 96, rounded up to whole cache lines.
EDGE_BYTES: Final = 128
# Scratch memory per thread, in bytes: the incomplete group, and the offsets of four groups, of which LEAD + 1 are used.
SCRATCH_BYTES: Final = EDGE_BYTES + 4 * OFFSETS_BYTES

_P0: Final = np.uint64(MULTIPLIERS[0])
_P1: Final = np.uint64(MULTIPLIERS[1])
_W0: Final = np.uint32(KEY_STEPS[0])
_W1: Final = np.uint32(KEY_STEPS[1])
_WORD_BITS: Final = np.uint64(32)
_SAMPLES_PURPOSE: Final = np.uint32(SAMPLES)
_PAIRS: Final = ir.VectorType(I64, LANES // 2)
# Odd multipliers of the three rounds: C. Wellons, "Prospecting for hash functions", 2018, and its list of improved
# constants.
_MULTIPLIERS: Final = (0x21F0AAAD, 0x735A2D97, 0x31848BAB)


def _colours(builder: Builder, picture: Value, bits: Value) -> Value:
    codes = pixel_codes(builder, picture)

    def field(digit: int) -> Value:
        shift = builder.sub(ir.Constant(I32, 8 * (digit + 1)), builder.mul(bits, ir.Constant(I32, digit + 1)))
        ones = builder.sub(builder.shl(ir.Constant(I32, 1), bits), ir.Constant(I32, 1))
        mask = builder.shl(ones, builder.mul(bits, ir.Constant(I32, digit)))
        return builder.and_(builder.lshr(codes, broadcast(builder, shift, WORDS)), broadcast(builder, mask, WORDS))

    return builder.or_(builder.or_(field(0), field(1)), field(2))


def hashed(builder: Builder, word: Value, keys: Sequence[Value]) -> Value:
    """Return 16 random words, h of the module docstring for i = word, word + 1 …; `keys` are k0, k1 and k2."""
    # Three rounds are needed. After one, images of two seeds would differ only by swapped neighbours. After two, pixels
    # at distances near a power of two would be correlated.
    numbers = builder.add(broadcast(builder, word, WORDS), constant(WORDS, range(LANES)))
    h = builder.xor(numbers, broadcast(builder, keys[0], WORDS))
    h = builder.mul(h, constant(WORDS, _MULTIPLIERS[0]))
    for key, shift, multiplier in zip(keys[1:], (16, 15), _MULTIPLIERS[1:], strict=True):
        h = builder.xor(h, broadcast(builder, key, WORDS))
        h = builder.xor(h, builder.lshr(h, constant(WORDS, shift)))
        h = builder.mul(h, constant(WORDS, multiplier))
    return h


def _choices_of_words(builder: Builder, h: Value, count: Value) -> tuple[Value, ...]:
    # Each word, read as a fraction of 2³², gives two choices: its first two digits in base S. The joint probability of
    # two digits is 1/S², with a relative error below S²/2³².
    counts = broadcast(builder, count, WORDS)

    def upper_halves(numbers: Value) -> Value:
        # A lane of 64 bits holds two words, so the words of even and odd lanes are multiplied separately.
        low, half = constant(_PAIRS, 0xFFFFFFFF), constant(_PAIRS, 32)
        pairs, factor = builder.bitcast(numbers, _PAIRS), builder.and_(builder.bitcast(counts, _PAIRS), low)
        even_lanes = builder.lshr(builder.mul(builder.and_(pairs, low), factor), half)
        odd_lanes = builder.mul(builder.lshr(pairs, half), factor)
        odd_lanes = builder.and_(odd_lanes, constant(_PAIRS, 0xFFFFFFFF << 32))
        return builder.bitcast(builder.or_(even_lanes, odd_lanes), WORDS)

    first, second = upper_halves(h), upper_halves(builder.mul(h, counts))
    # Of 16 pixels, the first eight use the first digits of eight words, the next eight use the second digits.
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
    """Choose the samples of the 32 pixels at `picture` and write their offsets (uint32) to `target`.

    `word` is the first i of the group (module docstring), `count` is S. 96 bytes are read, 128 written.
    """
    stride = broadcast(builder, builder.mul(count, ir.Constant(I32, SAMPLE_BYTES)), WORDS)
    for half, choices in enumerate(_choices_of_words(builder, hashed(builder, word, (k0, k1, k2)), count)):
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
    second_stride: Value,
    second_target: Value,
) -> None:
    """Write the colour indices (uint32) of 32 pixels to two targets, each multiplied by the stride of its target."""
    for half in range(2):
        colours = _colours(builder, builder.add(picture, ir.Constant(I64, 3 * LANES * half)), bits)
        for factor, address in ((stride, target), (second_stride, second_target)):
            store(builder, builder.mul(colours, broadcast(builder, factor, WORDS)), address, 4 * LANES * half)


@step(ADDRESS, "uint32", "uint32", "uint32", "uint32", "uint32", ADDRESS)
def choose_for_colours(
    builder: Builder, colours: Value, word: Value, k0: Value, k1: Value, k2: Value, count: Value, target: Value
) -> None:
    """Do the same as `choose`, but with known colours.

    `colours` is the address of one uint32 per pixel: the offset of the first sample of its colour.
    """
    for half, choices in enumerate(_choices_of_words(builder, hashed(builder, word, (k0, k1, k2)), count)):
        colour_offsets = load(builder, colours, 4 * LANES * half, WORDS)
        offsets = builder.add(colour_offsets, builder.mul(choices, constant(WORDS, SAMPLE_BYTES)))
        store(builder, offsets, target, 4 * LANES * half)


def emit_prefetch(builder: Builder, address: Value, locality: int) -> None:
    """Emit an LLVM prefetch; locality 3 keeps the cache line in every cache, 0 in none."""
    pointer = I8.as_pointer()
    function_type = ir.FunctionType(ir.VoidType(), [pointer, I32, I32, I32])
    function = builder.module.declare_intrinsic("llvm.prefetch", [pointer], function_type)
    arguments = [ir.Constant(I32, number) for number in (0, locality, 1)]  # read access, locality, data cache
    builder.call(function, [pointer_at(builder, address, 0, I8), *arguments])


@step(ADDRESS)
def prefetch(builder: Builder, address: Value) -> None:
    """Prefetch the cache line of `address` into all caches; an invalid address is ignored."""
    emit_prefetch(builder, address, 3)


@step(ADDRESS)
def prefetch_once(builder: Builder, address: Value) -> None:
    """Prefetch a cache line that is read once, without filling the larger caches."""
    emit_prefetch(builder, address, 0)


@inlined
def philox4x32(c0: Any, c1: Any, c2: Any, c3: Any, seed: Any) -> Any:
    """Return the four words of Philox4x32-10; words and counter are uint32, `seed` is uint64."""
    k0, k1 = uint32(seed), uint32(seed >> _WORD_BITS)
    for _ in range(ROUNDS):
        p0, p1 = uint64(c0) * _P0, uint64(c2) * _P1
        c0, c1, c2, c3 = (
            uint32(uint32(p1 >> _WORD_BITS) ^ c1 ^ k0),
            uint32(p1),
            uint32(uint32(p0 >> _WORD_BITS) ^ c3 ^ k1),
            uint32(p0),
        )
        k0, k1 = uint32(k0 + _W0), uint32(k1 + _W1)
    return c0, c1, c2, c3


@inlined
def row_keys(y: Any, stream: Any, image: Any, seed: Any, purpose: Any = _SAMPLES_PURPOSE) -> Any:
    """Return the three keys (uint32) of row `y`; `seed` is uint64, `purpose` a uint32 of `philox`."""
    k0, k1, k2, _ = philox4x32(uint32(y), uint32(stream), uint32(image), purpose, seed)
    return k0, k1, k2


@inlined
def offsets_slot(scratch: int, group: int) -> int:
    """Return the address in scratch memory at which the offsets of `group` are buffered."""
    return scratch + EDGE_BYTES + OFFSETS_BYTES * (group & 3)


@inlined
def group_address(row: int, width: int, group: int, scratch: int) -> int:
    """Return an address at which a whole group can be read; `row` is the address of the first pixel of the row.

    If the row ends inside the group, its pixels are first copied to scratch memory.
    """
    source = row + 3 * GROUP * group
    if GROUP * (group + 1) > width:
        for i in range(3 * (width - GROUP * group)):
            copy1(source + i, scratch + i)
        source = scratch
    return source


@inlined
def prefetch_group(row: int, group: int) -> None:
    """Prefetch the pixels `_PREFETCH_BYTES` after a group; call it for each group of a row in turn."""
    line = row + 3 * GROUP * group + _PREFETCH_BYTES
    prefetch_once(line)
    prefetch_once(line + LINE)


@inlined
def choose_group(row: int, width: int, group: int, keys: Any, count: Any, bits: Any, scratch: int, target: int) -> None:
    """Choose the samples of a group (number `group` of its row) and write their offsets (uint32) to `target`."""
    source = group_address(row, width, group, scratch)
    choose(source, uint32(LANES * group), keys[0], keys[1], keys[2], count, bits, target)


def channel_bits(colours: int) -> int:
    """Return the bits per channel of samples with `colours` = 8**bits colours."""
    for bits in range(1, 6):
        if colours == 8**bits:
            return bits
    raise InputError(f"the samples have {colours} colours, expected 8, 64, 512, 4096 or 32768; pass LUT samples")


def channels_of(colours: npt.ArrayLike, bits: int) -> npt.NDArray[np.int64]:
    """Return the channel codes (..., 3) int64, 0 … 2**bits − 1, of colour indices (...) int."""
    colours = np.asarray(colours, dtype=np.int64)
    mask = (1 << bits) - 1
    return np.stack([colours >> 2 * bits & mask, colours >> bits & mask, colours & mask], axis=-1)


Samples = npt.NDArray[np.uint16]
Picture = npt.NDArray[np.uint8]

# Smallest memory page of x86-64 and arm64, in bytes. If one byte of a page is readable, all are.
_PAGE_BYTES: Final = 4096
_MOST_BYTES: Final = 0xFFFFFFFF  # Largest size of the samples of one illuminant: offsets have 32 bits


def check_samples(samples: Samples) -> int:
    """Check the samples of an illuminant, uint16 (8**bits, S, 3), S ≥ 1; return the bits per channel."""
    if samples.dtype != np.uint16 or samples.ndim != 3 or samples.shape[2] != 3 or not samples.shape[1]:
        raise InputError(f"the samples are {samples.dtype} {samples.shape}, expected uint16 (8**bits, samples, 3)")
    if samples.nbytes > _MOST_BYTES:
        raise InputError(f"an illuminant has {samples.nbytes} bytes of samples, at most {_MOST_BYTES} are allowed")
    return channel_bits(samples.shape[0])


def check_tables(tables: Samples | Sequence[Samples]) -> list[Samples]:
    """Check the samples of several illuminants, all uint16 (8**bits, S, 3) of one shape; return them as a list."""
    checked = [native(table) for table in tables]
    if not checked:
        raise InputError("0 illuminants were given to mix, expected 1 or more")
    for table in checked:
        check_samples(table)
        if table.shape != checked[0].shape:
            raise InputError(f"samples have shapes {checked[0].shape} and {table.shape}, expected equal shapes")
    return checked


def check_picture(picture: Any) -> None:
    """Check that `picture` is uint8 (H, W, 3)."""
    if getattr(picture, "dtype", None) != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(
            f"the picture is {value_text(picture)}, expected an array uint8 (height, width, 3), for example "
            "read_picture(FILE)"
        )


def check_out(
    out: npt.NDArray[Any] | None, shape: tuple[int, ...], dtype: type[np.uint16] | type[np.float32]
) -> npt.NDArray[Any]:
    """Return `out` after checking its shape and dtype, or a new array if it is None."""
    if out is None:
        return np.empty(shape, dtype)
    if out.dtype != dtype or out.shape != shape:
        raise InputError(f"`out` is {out.dtype} {out.shape}, expected {np.dtype(dtype)} {shape}")
    if not out.flags.writeable:
        raise InputError("`out` is read-only, expected an array with flags.writeable = True")
    return out


def check_seed(seed: int, image: int) -> np.uint64:
    """Check the seed and the image number; return the seed as uint64."""
    key_of(seed)
    if not 0 <= image < 1 << 32:
        raise InputError(f"the image number is {image}, expected 0 to 2^32 - 1")
    return np.uint64(seed)


def check_white_level(white_level: int) -> None:
    """Check that `white_level` is 1 … 65535."""
    if not 1 <= white_level <= 65535:
        raise InputError(f"the saturation level is {white_level}, expected 1 to 65535")


def check_weights(weights: npt.ArrayLike, lights: int) -> npt.NDArray[np.float64]:
    """Check the weights of `lights` illuminants; return them as (K,) float64."""
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (lights,) or not np.isfinite(checked).all() or (checked < 0).any():
        raise InputError(f"the weights are {np.asarray(weights).tolist()}, expected {lights} finite numbers ≥ 0")
    return checked


def packed_rows(picture: Picture) -> Picture:
    """Return `picture` (H, W, 3) uint8 if the bytes of each row are contiguous, else a contiguous copy."""
    return picture if picture.strides[1:] == (3, 1) else np.ascontiguousarray(picture)


def readable(samples: Samples) -> Samples:
    """Return samples (8**bits, S, 3) uint16 as a contiguous array with two readable bytes after its end.

    A copy is returned if the samples are not contiguous, or if the two bytes are on another memory page.
    """
    # Eight bytes are read for a sample of six. The two bytes after the last sample can be read if they are on its page,
    # even if another object owns them.
    last_byte = samples.ctypes.data + samples.nbytes - 1
    if samples.flags.c_contiguous and last_byte // _PAGE_BYTES == (last_byte + 2) // _PAGE_BYTES:
        return samples
    padded = np.empty(samples.size + 1, np.uint16)
    padded[:-1] = samples.reshape(-1)
    return padded[:-1].reshape(samples.shape)


def writable(target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target` (H, W, 3) or (H, W) uint16 if compiled code can write its rows, else a new array of its shape.

    Rows must be contiguous and at even addresses. After filling, pass the returned array to `copied_back`.
    """
    packed = (6, 2) if target.ndim == 3 else (2,)
    return target if target.strides[1:] == packed and target.flags.aligned else np.empty(target.shape, target.dtype)


def copied_back(work: npt.NDArray[np.uint16], target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target` with the content of `work`; `work` is `target` or the array from `writable`."""
    if work is not target:
        target[...] = work
    return target


def run_in_threads(fill: Callable[[int, int], object], count: int, threads: int) -> None:
    """Call `fill(first, end)` for `threads` equal parts of 0 … count − 1, each in its own thread."""
    threads = min(threads, count)
    if threads <= 1:
        fill(0, count)
        return
    edges = [count * thread // threads for thread in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, edges[:-1], edges[1:]))
