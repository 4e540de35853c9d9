"""Separable filters of image strips, with sums kept in registers.

A block of 32 neighbouring numbers is filtered at a time: for each tap two vectors are loaded, added or subtracted, and
multiplied into an accumulator that stays in a register. So a Gaussian derivative costs less than half of OpenCV's two
`sepFilter2D`, whose result it equals but for the last digit. Taps that lie symmetrically are combined before they are
multiplied: a derivative of constant whole numbers is exactly zero.

Strips are interleaved rows of float32, padded by the caller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from foundation.compiled import compiled
from generator.kernels.vector import ADDRESS, F32, FLOATS, I64, LANES, broadcast, load, store, void

BLOCK: Final = 2 * LANES
"""Numbers that are filtered at a time: two vectors an accumulator hide the latency of a multiplication."""
TILE: Final = 12 * BLOCK
"""Numbers of a row in a tile: with 128 + 2 · 18 rows of two intermediate results 0.5 MB, which a core's cache holds."""
_BYTES: Final = 4
"""Of a float32."""

EVEN, ODD, BEND = 0, 1, 2
"""Kinds of kernels: Σ w(k) (x(k) + x(-k)) + w(0) x(0); Σ w(k) (x(k) - x(-k)); Σ w(k) (x(k) + x(-k) - 2 x(0)).

Those of a Gaussian and of its first two derivatives."""


def _call(builder: Any, name: str, *arguments: Any) -> Any:
    """Return what an LLVM intrinsic on vectors of 16 float32 gives."""
    whole = f"{name}.v{LANES}f32"
    known = builder.module.globals.get(whole)
    function = known or ir.Function(builder.module, ir.FunctionType(FLOATS, [FLOATS] * len(arguments)), whole)
    return builder.call(function, arguments)


def _fused(builder: Any, first: Any, second: Any, third: Any) -> Any:
    """Return first · second + third, rounded once."""
    return _call(builder, "llvm.fma", first, second, third)


def _root(builder: Any, value: Any) -> Any:
    return _call(builder, "llvm.sqrt", value)


def _emit(
    builder: Any, source: Any, step: Any, weights: Sequence[Any], reach: Any, kinds: Sequence[int]
) -> list[list[Any]]:
    """Return the filtered block at `source` for each kind, two vectors a kind.

    Tap k lies `step` bytes times k away; `weights` are addresses of reach + 1 float32 a kind.
    """
    vectors = range(BLOCK // LANES)
    centre = [load(builder, source, _BYTES * LANES * at, FLOATS) for at in vectors]
    slots: list[list[Any]] = []
    for kind, table in zip(kinds, weights, strict=True):
        first = broadcast(builder, load(builder, table, 0, F32), FLOATS)
        slots.append([])
        for at in vectors:
            slot = cgutils.alloca_once(builder, FLOATS)
            start = builder.fmul(centre[at], first) if kind == EVEN else ir.Constant(FLOATS, [0.0] * LANES)
            builder.store(start, slot)
            slots[-1].append(slot)
    doubled = [builder.fadd(one, one) for one in centre] if BEND in kinds else []
    with cgutils.for_range(builder, reach) as loop:
        tap = builder.add(loop.index, ir.Constant(I64, 1))
        offset = builder.mul(tap, step)
        before, after = builder.sub(source, offset), builder.add(source, offset)
        factors = [
            broadcast(
                builder, load(builder, builder.add(table, builder.mul(tap, ir.Constant(I64, _BYTES))), 0, F32), FLOATS
            )
            for table in weights
        ]
        for at in vectors:
            low, high = (load(builder, place, _BYTES * LANES * at, FLOATS) for place in (before, after))
            both = builder.fadd(low, high) if EVEN in kinds or BEND in kinds else None
            for kind, factor, slot in zip(kinds, factors, slots, strict=True):
                if kind == EVEN:
                    part = both
                elif kind == ODD:
                    part = builder.fsub(high, low)
                else:
                    part = builder.fsub(both, doubled[at])
                builder.store(_fused(builder, part, factor, builder.load(slot[at])), slot[at])
    return [[builder.load(one) for one in slot] for slot in slots]


def _rows(kinds: Sequence[int]) -> Any:
    """Return what numba wants of an intrinsic that filters the block at `source` by each of some kinds."""
    count = len(kinds)

    def emit(builder: Any, source: Any, step: Any, reach: Any, *places: Any) -> None:
        found = _emit(builder, source, step, places[:count], reach, kinds)
        for parts, target in zip(found, places[count:], strict=True):
            for at, part in enumerate(parts):
                store(builder, part, target, _BYTES * LANES * at)

    return void(emit, *[ADDRESS] * (3 + 2 * count))


@intrinsic
def _filter_even(typing: Any, source: Any, step: Any, reach: Any, even: Any, target: Any) -> Any:
    """Write the block at `source`, smoothed, to `target`."""
    del typing, source, step, reach, even, target
    return _rows((EVEN,))


@intrinsic
def _filter_even_odd(
    typing: Any, source: Any, step: Any, reach: Any, even: Any, odd: Any, smooth: Any, slope: Any
) -> Any:
    """Write the block at `source`, smoothed and derived once."""
    del typing, source, step, reach, even, odd, smooth, slope
    return _rows((EVEN, ODD))


@intrinsic
def _filter_all(
    typing: Any,
    source: Any,
    step: Any,
    reach: Any,
    even: Any,
    odd: Any,
    bend: Any,
    smooth: Any,
    slope: Any,
    curve: Any,
) -> Any:
    """Write the block at `source`, smoothed, derived once and derived twice."""
    del typing, source, step, reach, even, odd, bend, smooth, slope, curve
    return _rows((EVEN, ODD, BEND))


@intrinsic
def _gradient(typing: Any, smooth: Any, slope: Any, step: Any, reach: Any, even: Any, odd: Any, target: Any) -> Any:
    """Write the gradient's length from rows smoothed and derived along x."""
    del typing, smooth, slope, step, reach, even, odd, target

    def emit(builder: Any, smooth: Any, slope: Any, step: Any, reach: Any, even: Any, odd: Any, target: Any) -> None:
        (along_x,) = _emit(builder, slope, step, (even,), reach, (EVEN,))
        (along_y,) = _emit(builder, smooth, step, (odd,), reach, (ODD,))
        for at, (x, y) in enumerate(zip(along_x, along_y, strict=True)):
            length = _root(builder, _fused(builder, x, x, builder.fmul(y, y)))
            store(builder, length, target, _BYTES * LANES * at)

    return void(emit, *[ADDRESS] * 7)


@intrinsic
def _curvature(
    typing: Any,
    smooth: Any,
    slope: Any,
    curve: Any,
    step: Any,
    reach: Any,
    even: Any,
    odd: Any,
    bend: Any,
    target: Any,
) -> Any:
    """Write √(f_xx² + 4 f_xy² + f_yy²) from rows smoothed, derived once, and derived twice along x."""
    del typing, smooth, slope, curve, step, reach, even, odd, bend, target

    def emit(
        builder: Any,
        smooth: Any,
        slope: Any,
        curve: Any,
        step: Any,
        reach: Any,
        even: Any,
        odd: Any,
        bend: Any,
        target: Any,
    ) -> None:
        (xx,) = _emit(builder, curve, step, (even,), reach, (EVEN,))
        (xy,) = _emit(builder, slope, step, (odd,), reach, (ODD,))
        (yy,) = _emit(builder, smooth, step, (bend,), reach, (BEND,))
        for at, (a, b, c) in enumerate(zip(xx, xy, yy, strict=True)):
            mixed = builder.fadd(b, b)
            total = _fused(builder, a, a, _fused(builder, mixed, mixed, builder.fmul(c, c)))
            store(builder, _root(builder, total), target, _BYTES * LANES * at)

    return void(emit, *[ADDRESS] * 9)


@compiled
def filter_strip(
    strip: npt.NDArray[np.float32],
    weights: npt.NDArray[np.float32],
    order: int,
    reach: int,
    rows: int,
    scratch: npt.NDArray[np.float32],
    out: npt.NDArray[np.float32],
) -> None:
    """Write the size of the Gaussian derivative of a padded strip to `out`.

    Parameters
    ----------
    strip
        (rows + 2 reach, P) float32, rows of interleaved pixels with `reach` pixels on either side; P reaches at least
        6 · reach numbers beyond the pitch of `out`.
    weights
        (3, reach + 1) float32: the halves of the kernels of order 0, 1 and 2 from their centres on.
    order
        0: smoothed, 1: length of the gradient, 2: √(f_xx² + 4 f_xy² + f_yy²).
    reach
        Of the kernels, px.
    rows
        Rows to write.
    scratch
        (3, rows + 2 reach, TILE) float32; for order 0 and 1 the first axis may have as few as order + 1.
    out
        (rows, Q) float32, Q a multiple of `BLOCK`.
    """
    pitch = strip.shape[1] * _BYTES
    line = TILE * _BYTES
    plane = scratch.shape[1] * line
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    first = scratch.ctypes.data
    for left in range(0, out.shape[1], TILE):
        width = min(TILE, out.shape[1] - left)
        source = strip.ctypes.data + (left + 3 * reach) * _BYTES
        for y in range(rows + 2 * reach):
            for x in range(0, width, BLOCK):
                at = source + y * pitch + x * _BYTES
                to = first + y * line + x * _BYTES
                if order == 0:
                    _filter_even(at, 3 * _BYTES, reach, even, to)
                elif order == 1:
                    _filter_even_odd(at, 3 * _BYTES, reach, even, odd, to, to + plane)
                else:
                    _filter_all(at, 3 * _BYTES, reach, even, odd, bend, to, to + plane, to + 2 * plane)
        for y in range(rows):
            target = out.ctypes.data + (y * out.shape[1] + left) * _BYTES
            for x in range(0, width, BLOCK):
                smooth = first + (y + reach) * line + x * _BYTES
                to = target + x * _BYTES
                if order == 0:
                    _filter_even(smooth, line, reach, even, to)
                elif order == 1:
                    _gradient(smooth, smooth + plane, line, reach, even, odd, to)
                else:
                    _curvature(smooth, smooth + plane, smooth + 2 * plane, line, reach, even, odd, bend, to)
