"""Separable filters of vectors of 16 numbers, with sums and neighbours kept in registers: what a compiled loop calls.

Vectors lie one after the other along the axis that is filtered, so that every load is aligned: rows are filtered in
groups of 16 that are transposed first, which costs 4 shuffles a vector, where loads that begin between two cache lines
would cost 2 cycles a tap. `OUTPUTS` neighbouring vectors are found at a time. From tap to tap the neighbours they need
move on by one, so a tap loads two vectors, not two for each of them: what bounds the loop is additions and
multiplications, not loads. Taps that lie symmetrically are combined before they are multiplied: a derivative of
constant whole numbers is exactly zero. Short kernels of three orders at a time are the exception, see `beside_all`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from llvmlite import ir

from foundation.compiled import intrinsic
from generator.kernels.vector import ADDRESS, F32, FLOATS, I32, I64, LANES, LINE, broadcast, constant, load, store, void

OUTPUTS: Final = 4
"""Vectors that are found at a time: as many sums as a multiplication takes cycles, so that none waits for another."""
_BYTES: Final = 4
"""Of a float32."""
CHUNK: Final = 16
"""Interleaved pixels of a row that are three whole vectors."""
_PIXEL: Final = 3 * LINE
"""Bytes from pixel to pixel of 16 rows."""

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
    builder: Any,
    source: Any,
    step: Any,
    weights: Sequence[Any],
    reach: Any,
    kinds: Sequence[int],
    *,
    side_by_side: bool = False,
) -> list[list[Any]]:
    """Return the filtered vectors at `source` and after for each kind.

    Neighbours lie `step` bytes apart; `weights` are addresses of reach + 1 float32 a kind. Read are `reach` neighbours
    before the first and after the last vector. The vectors are `OUTPUTS` neighbours, or the three vectors of `CHUNK`
    interleaved pixels side by side, whose neighbours are loaded from wherever they begin.
    """
    from numba.core import cgutils

    def slot_of(value: Any) -> Any:
        from numba.core import cgutils

        slot = cgutils.alloca_once(builder, FLOATS)
        builder.store(value, slot)
        return slot

    def times(number: Any, count: int) -> Any:
        return builder.mul(number, ir.Constant(I64, count))

    outputs = range(3 if side_by_side else OUTPUTS)
    apart = ir.Constant(I64, LINE) if side_by_side else step
    centre = [load(builder, builder.add(source, times(apart, at)), 0, FLOATS) for at in outputs]
    sums: list[list[Any]] = []
    for kind, table in zip(kinds, weights, strict=True):
        first = broadcast(builder, load(builder, table, 0, F32), FLOATS)
        zero = ir.Constant(FLOATS, [0.0] * LANES)
        sums.append([slot_of(builder.fmul(one, first) if kind == EVEN else zero) for one in centre])
    doubled = [builder.fadd(one, one) for one in centre] if BEND in kinds else []
    lows, highs = [slot_of(one) for one in centre], [slot_of(one) for one in centre]
    last = builder.add(source, times(step, OUTPUTS - 1))
    with cgutils.for_range(builder, reach) as loop:
        tap = builder.add(loop.index, ir.Constant(I64, 1))
        offset = builder.mul(tap, step)
        below, above = builder.sub(source, offset), builder.add(last, offset)
        if side_by_side:
            low = [load(builder, below, LINE * at, FLOATS) for at in outputs]
            high = [load(builder, builder.add(source, offset), LINE * at, FLOATS) for at in outputs]
        else:
            low = [load(builder, below, 0, FLOATS), *[builder.load(slot) for slot in lows[:-1]]]
            high = [*[builder.load(slot) for slot in highs[1:]], load(builder, above, 0, FLOATS)]
            for slots, values in ((lows, low), (highs, high)):
                for slot, value in zip(slots, values, strict=True):
                    builder.store(value, slot)
        factors = [
            broadcast(builder, load(builder, builder.add(table, times(tap, _BYTES)), 0, F32), FLOATS)
            for table in weights
        ]
        for at in outputs:
            both = builder.fadd(low[at], high[at]) if EVEN in kinds or BEND in kinds else None
            for kind, factor, slots in zip(kinds, factors, sums, strict=True):
                if kind == EVEN:
                    part = both
                elif kind == ODD:
                    part = builder.fsub(high[at], low[at])
                else:
                    part = builder.fsub(both, doubled[at])
                builder.store(_fused(builder, part, factor, builder.load(slots[at])), slots[at])
    return [[builder.load(slot) for slot in slots] for slots in sums]


def _write(builder: Any, values: Sequence[Any], target: Any, step: Any) -> None:
    for at, value in enumerate(values):
        store(builder, value, builder.add(target, builder.mul(step, ir.Constant(I64, at))), 0)


def _across(kinds: Sequence[int]) -> Any:
    """Return what numba wants of an intrinsic that filters `OUTPUTS` pixels of 16 rows by each of some kinds."""
    count = len(kinds)

    def emit(builder: Any, source: Any, reach: Any, *places: Any) -> None:
        step = ir.Constant(I64, _PIXEL)
        found = _emit(builder, source, step, places[:count], reach, kinds)
        for values, target in zip(found, places[count:], strict=True):
            _write(builder, values, target, step)

    return void(emit, *[ADDRESS] * (2 + 2 * count))


@intrinsic
def across_even(typing: Any, source: Any, reach: Any, even: Any, target: Any) -> Any:
    """Write four pixels of 16 rows from `source` on, smoothed along x, to `target`."""
    del typing, source, reach, even, target
    return _across((EVEN,))


@intrinsic
def across_even_odd(typing: Any, source: Any, reach: Any, even: Any, odd: Any, smooth: Any, slope: Any) -> Any:
    """Write four pixels of 16 rows, smoothed and derived once."""
    del typing, source, reach, even, odd, smooth, slope
    return _across((EVEN, ODD))


@intrinsic
def across_all(
    typing: Any, source: Any, reach: Any, even: Any, odd: Any, bend: Any, smooth: Any, slope: Any, curve: Any
) -> Any:
    """Write four pixels of 16 rows, smoothed, derived once and derived twice."""
    del typing, source, reach, even, odd, bend, smooth, slope, curve
    return _across((EVEN, ODD, BEND))


@intrinsic
def beside_all(
    typing: Any,
    source: Any,
    reach: Any,
    even: Any,
    odd: Any,
    bend: Any,
    smooth: Any,
    slope: Any,
    curve: Any,
    column: Any,
) -> Any:
    """Write 16 interleaved pixels of a row, smoothed, derived once and twice, as vectors `column` bytes apart."""
    del typing, source, reach, even, odd, bend, smooth, slope, curve, column

    def emit(builder: Any, source: Any, reach: Any, *places: Any) -> None:
        step = ir.Constant(I64, 3 * _BYTES)
        found = _emit(builder, source, step, places[:3], reach, (EVEN, ODD, BEND), side_by_side=True)
        for values, target in zip(found, places[3:-1], strict=True):
            _write(builder, values, target, places[-1])

    return void(emit, *[ADDRESS] * 9)


@intrinsic
def down_even(typing: Any, smooth: Any, reach: Any, even: Any, target: Any, pitch: Any) -> Any:
    """Write four rows of 16 numbers, smoothed along y, `pitch` bytes apart."""
    del typing, smooth, reach, even, target, pitch

    def emit(builder: Any, smooth: Any, reach: Any, even: Any, target: Any, pitch: Any) -> None:
        (found,) = _emit(builder, smooth, ir.Constant(I64, LINE), (even,), reach, (EVEN,))
        _write(builder, found, target, pitch)

    return void(emit, *[ADDRESS] * 5)


@intrinsic
def down_gradient(
    typing: Any, smooth: Any, slope: Any, reach: Any, even: Any, odd: Any, target: Any, pitch: Any
) -> Any:
    """Write the gradient's length from rows smoothed and derived along x."""
    del typing, smooth, slope, reach, even, odd, target, pitch

    def emit(builder: Any, smooth: Any, slope: Any, reach: Any, even: Any, odd: Any, target: Any, pitch: Any) -> None:
        step = ir.Constant(I64, LINE)
        (along_x,) = _emit(builder, slope, step, (even,), reach, (EVEN,))
        (along_y,) = _emit(builder, smooth, step, (odd,), reach, (ODD,))
        lengths = [
            _root(builder, _fused(builder, x, x, builder.fmul(y, y))) for x, y in zip(along_x, along_y, strict=True)
        ]
        _write(builder, lengths, target, pitch)

    return void(emit, *[ADDRESS] * 7)


@intrinsic
def down_curvature(
    typing: Any,
    smooth: Any,
    slope: Any,
    curve: Any,
    reach: Any,
    even: Any,
    odd: Any,
    bend: Any,
    target: Any,
    pitch: Any,
) -> Any:
    """Write √(f_xx² + 4 f_xy² + f_yy²) from rows smoothed, derived once, and derived twice along x."""
    del typing, smooth, slope, curve, reach, even, odd, bend, target, pitch

    def emit(
        builder: Any,
        smooth: Any,
        slope: Any,
        curve: Any,
        reach: Any,
        even: Any,
        odd: Any,
        bend: Any,
        target: Any,
        pitch: Any,
    ) -> None:
        step = ir.Constant(I64, LINE)
        (xx,) = _emit(builder, curve, step, (even,), reach, (EVEN,))
        (xy,) = _emit(builder, slope, step, (odd,), reach, (ODD,))
        (yy,) = _emit(builder, smooth, step, (bend,), reach, (BEND,))
        sizes: list[Any] = []
        for a, b, c in zip(xx, xy, yy, strict=True):
            mixed = builder.fadd(b, b)
            total = _fused(builder, a, a, _fused(builder, mixed, mixed, builder.fmul(c, c)))
            sizes.append(_root(builder, total))
        _write(builder, sizes, target, pitch)

    return void(emit, *[ADDRESS] * 9)


@intrinsic
def copy_line(typing: Any, source: Any, target: Any) -> Any:
    """Copy 16 numbers."""
    del typing, source, target

    def emit(builder: Any, source: Any, target: Any) -> None:
        store(builder, load(builder, source, 0, FLOATS), target, 0)

    return void(emit, ADDRESS, ADDRESS)


@intrinsic
def transpose(typing: Any, source: Any, pitch: Any, target: Any) -> Any:
    """Write the 16 x 16 numbers whose rows stand `pitch` bytes apart, transposed, to 16 cache lines at `target`."""
    del typing, source, pitch, target

    def emit(builder: Any, source: Any, pitch: Any, target: Any) -> None:
        rows = [
            load(builder, builder.add(source, builder.mul(pitch, ir.Constant(I64, row))), 0, FLOATS)
            for row in range(LANES)
        ]
        size = LANES // 2
        while size:
            # Squares of `size` numbers change places across the diagonal.
            upper = [lane if not lane & size else LANES + lane - size for lane in range(LANES)]
            lower = [lane + size if not lane & size else LANES + lane for lane in range(LANES)]
            for row in range(LANES):
                if not row & size:
                    pair = rows[row], rows[row + size]
                    for at, lanes in ((row, upper), (row + size, lower)):
                        rows[at] = builder.shuffle_vector(*pair, constant(ir.VectorType(I32, LANES), lanes))
            size //= 2
        for row, value in enumerate(rows):
            store(builder, value, target, LINE * row)

    return void(emit, *[ADDRESS] * 3)
