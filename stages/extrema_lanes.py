"""Greatest values of rows below each other, 16 cells at a time: what :mod:`stages.extrema` does most.

Loops over lines are not enough there: they compare lines for overlaps and end in single cells, and what neighbouring
windows share is stored and loaded again. Values are of a flat array in which rows follow each other; where cells lie
beyond the end of a row, they are those of the next one. No value may be NaN.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16

FLAT = types.Array(types.float32, 1, "C")
BYTES = types.Array(types.uint8, 1, "C")
_VECTOR = ir.VectorType(ir.FloatType(), LANES)


def _pointer(context: Any, builder: Any, array: Any, at: Any) -> Any:
    data = context.make_array(FLAT)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer())


def _most(builder: Any, *values: Any) -> Any:
    """The greatest, cell by cell, in pairs."""
    while len(values) > 1:
        pairs = [(values[k], values[k + 1]) for k in range(0, len(values) - 1, 2)]
        found = [builder.select(builder.fcmp_ordered(">", a, b), a, b) for a, b in pairs]
        values = (*found, *values[2 * len(pairs) :])
    return values[0]


@intrinsic
def raise4(typingctx, flat, at, first, second, third):  # type: ignore[no-untyped-def]
    """Raise the cells from ``at`` on to the greatest of them and of those that lie three distances behind them."""
    i64 = types.int64
    signature = types.void(FLAT, i64, i64, i64, i64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        array, at, *away = args
        places = [at, *(builder.add(at, n) for n in away)]
        pointers = [_pointer(context, builder, array, place) for place in places]
        builder.store(_most(builder, *(builder.load(p, align=4) for p in pointers)), pointers[0], align=4)
        return context.get_dummy_value()

    return signature, codegen


def _make_four(n: int) -> Any:
    """Intrinsic of windows of ``n`` rows, see :data:`nine`."""

    @intrinsic
    def four(typingctx, flat, at, step):  # type: ignore[no-untyped-def]
        signature = types.void(FLAT, types.int64, types.int64)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            array, at, step = args
            pointers = []
            for _ in range(n + 3):
                pointers.append(_pointer(context, builder, array, at))
                at = builder.add(at, step)
            row = [builder.load(p, align=4) for p in pointers]
            if n == 3:
                above, below = _most(builder, *row[1:3]), _most(builder, *row[3:5])
                pairs = ((row[0], above), (above, row[3]), (row[2], below), (below, row[5]))
                found = [_most(builder, *pair) for pair in pairs]
            else:
                shared = _most(builder, *row[3:n])
                two = _most(builder, row[2], shared)
                one = _most(builder, row[1], two)
                behind = _most(builder, *row[n : n + 2])
                pairs = ((row[0], one), (one, row[n]), (two, behind), (shared, _most(builder, behind, row[n + 2])))
                found = [_most(builder, *pair) for pair in pairs]
            for value, pointer in zip(found, pointers, strict=False):
                builder.store(value, pointer, align=4)
            return context.get_dummy_value()

        return signature, codegen

    return four


three, five, seven, nine = (_make_four(n) for n in (3, 5, 7, 9))
"""``nine(flat, at, step)``: the cells from ``at`` on, and those one, two and three steps behind them, become the
greatest of themselves and of those up to eight steps behind each; in the same way windows of three, five and seven."""


def _make_along(n: int) -> Any:
    """Intrinsic of windows of ``n`` cells of a row, see :data:`along_nine`."""
    shifts: list[int] = []
    while sum(shifts) < n - 1:
        shifts.append(min(sum(shifts) + 1, n - 1 - sum(shifts)))

    @intrinsic
    def along(typingctx, flat, at, count):  # type: ignore[no-untyped-def]
        signature = types.void(FLAT, types.int64, types.int64)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            array, at, count = args
            lanes, one = ir.Constant(count.type, LANES), ir.Constant(count.type, 1)
            nothing = ir.Constant(_VECTOR, [float("-inf")] * LANES)
            # of each step what the vector to the right had before it
            beside = [cgutils.alloca_once_value(builder, nothing) for _ in shifts]
            with cgutils.for_range(builder, count) as loop:
                k = builder.sub(builder.sub(count, loop.index), one)
                pointer = _pointer(context, builder, array, builder.add(at, builder.mul(k, lanes)))
                value = builder.load(pointer, align=4)
                for shift, slot in zip(shifts, beside, strict=True):
                    pick = ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(range(shift, shift + LANES)))
                    moved = builder.shuffle_vector(value, builder.load(slot), pick)
                    builder.store(value, slot)
                    value = _most(builder, value, moved)
                builder.store(value, pointer, align=4)
            return context.get_dummy_value()

        return signature, codegen

    return along


along_three, along_five, along_seven, along_nine = (_make_along(n) for n in (3, 5, 7, 9))
"""``along_nine(flat, at, count)``: of ``count`` vectors from ``at`` on, which are a row, each cell becomes the greatest
of itself and of the eight that follow in the row; in the same way windows of three, five and seven."""


def _least(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _middle(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Of three the one between."""
    low, high = _least(builder, a, b), _most(builder, a, b)
    return _most(builder, _least(builder, high, c), low)


@intrinsic
def median_row(typingctx, flat, at, cols, count, out, to, patchy):  # type: ignore[no-untyped-def]
    """``out[to + k]``: median of the nine cells around ``at + k``, whose rows have ``cols`` columns, of ``count``
    vectors. One of nine is NaN, or the sum of all is: then it means nothing, and ``patchy[k]`` is 1, else 0.

    The columns of three are sorted, and the median is the middle one of the greatest least, the middle middle and the
    least greatest (Paeth, Graphics Gems, 1990).
    """
    i64 = types.int64
    signature = types.void(FLAT, i64, i64, i64, FLAT, i64, BYTES)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        array, at, cols, count, out, to, patchy = args
        lanes = ir.Constant(at.type, LANES)
        marks = context.make_array(BYTES)(context, builder, patchy).data
        octets = ir.VectorType(ir.IntType(8), LANES)

        def sorted_columns(place: Any) -> tuple[Any, ...]:
            a, b, c = (
                builder.load(_pointer(context, builder, array, where), align=4)
                for where in (builder.sub(place, cols), place, builder.add(place, cols))
            )
            low, high = _least(builder, a, b), _most(builder, a, b)
            middle = _most(builder, _least(builder, high, c), low)
            total = builder.fadd(builder.fadd(a, b), c)
            return _least(builder, low, c), middle, _most(builder, high, c), total

        one = ir.Constant(at.type, 1)
        with cgutils.for_range(builder, count) as loop:
            shift = builder.mul(loop.index, lanes)
            place = builder.add(at, shift)
            low, middle, high, total = (
                [west, here, east]
                for west, here, east in zip(
                    *(sorted_columns(where) for where in (builder.sub(place, one), place, builder.add(place, one))),
                    strict=True,
                )
            )
            x = _most(builder, *low)
            y = _least(builder, _least(builder, high[0], high[1]), high[2])
            median = _middle(builder, x, _middle(builder, *middle), y)
            builder.store(median, _pointer(context, builder, out, builder.add(to, shift)), align=4)
            known = builder.fadd(builder.fadd(total[0], total[1]), total[2])
            unknown = builder.zext(builder.fcmp_unordered("uno", known, known), octets)
            mark = builder.bitcast(builder.gep(marks, [shift]), octets.as_pointer())
            builder.store(unknown, mark, align=1)
        return context.get_dummy_value()

    return signature, codegen
