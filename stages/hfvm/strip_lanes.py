"""Vector code of the search: a pixel's candidates side by side, four pixels at once (numba intrinsic).

Candidates that follow each other along a row are words that follow each other in the other image: one load, one
``psadbw`` against the pixel's own word eight times over. The least of eight 16-bit costs is a single instruction on x86
(``phminposuw``), which the compiler finds by itself in the generic code.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stages.hfvm import lanes
from stages.hfvm.lanes import LANES

ABOVE, BELOW = LANES + 1, LANES + 2
"""Ranks of the two candidates that lie a row less and a row more."""

NONE = 0xFFFF
"""More than any cost << 4 | rank."""

_I16, _I32, _I64 = (ir.IntType(n) for n in (16, 32, 64))
_FLOAT = ir.FloatType()
_FLOATS, _INTS, _SHORTS = (ir.VectorType(kind, LANES) for kind in (_FLOAT, _I32, _I16))
_PAIR, _FOUR = ir.VectorType(_I64, 2), ir.VectorType(_I32, 4)

_CHILDREN = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Rows and columns of the four pixels."""


def _pairs(builder: Any, one: Any, two: Any, pick: tuple[int, ...]) -> Any:
    """Elements of two vectors, those of the second one counted on."""
    return builder.shuffle_vector(one, two, ir.Constant(ir.VectorType(_I32, len(pick)), list(pick)))


def make_four(width: int) -> Any:
    """Intrinsic ``four``, see :data:`four`."""

    @intrinsic
    def four(typingctx, left, right, lines, here, there, sizes, mu, place, counts, best, least):  # type: ignore[no-untyped-def]
        i64 = types.int64
        signature = types.void(
            lanes.WORDS, lanes.WORDS, lanes.LINES, i64, i64, types.UniTuple(i64, 3), types.float32,
            types.UniTuple(i64, 3), types.UniTuple(i64, 2), lanes.PAIRS, lanes.PAIRS,
        )  # fmt: skip

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            splat, vector = lanes._splat, lanes._vector
            left, right, lines, here, there = args[:5]
            cols, size, rcols = cgutils.unpack_tuple(builder, args[5])
            mu = splat(builder, args[6])
            u, centre, v = (builder.trunc(n, _I32) for n in cgutils.unpack_tuple(builder, args[7]))
            count, cross = cgutils.unpack_tuple(builder, args[8])

            def load(k: int, array: Any, index: Any, kind: Any) -> Any:
                pointer = lanes._pointer(context, builder, sig.args[k], array, index)
                return builder.load(lanes._as(builder, pointer, kind), align=4 if kind == _FLOAT else 8)

            def moved(index: Any, rows: int, columns: int, wide: Any) -> Any:
                index = builder.add(index, builder.mul(wide, ir.Constant(_I64, rows)))
                return builder.add(index, ir.Constant(_I64, columns))

            def line(index: Any) -> tuple[Any, ...]:
                found = []
                for _ in range(3):
                    found.append(load(2, lines, index, _FLOAT))
                    index = builder.add(index, size)
                return tuple(found)

            def cost(distance: Any, across: Any, b_v: Any, c: Any) -> Any:
                off = builder.fadd(builder.fadd(across, b_v), c)
                total = builder.add(builder.trunc(distance, _INTS), lanes.band_cost(builder, off, mu))
                return builder.shl(total, vector(_INTS, [4] * LANES))

            columns = builder.sitofp(builder.add(splat(builder, u), vector(_INTS, range(LANES))), _FLOATS)
            lane = vector(_INTS, range(LANES))
            is_own = builder.icmp_signed("==", lane, splat(builder, builder.sub(centre, u)))
            rank = builder.select(is_own, vector(_INTS, [0] * LANES), vector(_INTS, range(1, LANES + 1)))
            taking = builder.icmp_signed("<", lane, splat(builder, builder.trunc(count, _I32)))
            row = builder.sitofp(v, _FLOAT)
            normals = [line(moved(here, j, i, cols)) for j, i in _CHILDREN]
            words = [load(0, left, moved(here, j, i, cols), _I64) for j, i in _CHILDREN]
            key = ir.Constant(_FOUR, ir.Undefined)
            for k, (word, (a, b, c)) in enumerate(zip(words, normals, strict=True)):
                found = load(1, right, moved(there, *_CHILDREN[k], rcols), lanes._WORDS)
                distance = lanes._distances(builder, splat(builder, word), found, width)
                across = builder.fmul(splat(builder, a), columns)
                one = cost(distance, across, splat(builder, builder.fmul(b, row)), splat(builder, c))
                one = builder.select(taking, builder.or_(one, rank), vector(_INTS, [NONE] * LANES))
                one = lanes._call(builder, "llvm.vector.reduce.umin.v8i16", _I16, builder.trunc(one, _SHORTS))
                key = builder.insert_element(key, builder.zext(one, _I32), ir.Constant(_I32, k))
            slot = cgutils.alloca_once_value(builder, key)
            with builder.if_then(builder.icmp_signed("!=", cross, ir.Constant(_I64, 0))):
                # Lanes: four pixels, each with the row less, then the same with the row more.
                at = builder.add(there, builder.sext(builder.sub(centre, u), _I64))
                rows = [load(1, right, moved(at, j, 0, rcols), _PAIR) for j in (-1, 0, 1, 2)]
                less, more = (_pairs(builder, rows[k], rows[k + 1], (0, 1, 2, 3)) for k in (0, 2))
                found = _pairs(builder, less, more, tuple(range(8)))

                def twice(values: Any, kind: Any) -> Any:
                    total = ir.Constant(kind, ir.Undefined)
                    for k, value in enumerate(values):
                        total = builder.insert_element(total, value, ir.Constant(_I32, k))
                    return _pairs(builder, total, total, (0, 1, 2, 3, 0, 1, 2, 3))

                own = twice(words, ir.VectorType(_I64, 4))
                a, b, c = (twice([n[k] for n in normals], ir.VectorType(_FLOAT, 4)) for k in range(3))
                rows_of = builder.add(splat(builder, v), vector(_INTS, [-1] * 4 + [1] * 4))
                across = builder.fmul(a, splat(builder, builder.sitofp(centre, _FLOAT)))
                b_v = builder.fmul(b, builder.sitofp(rows_of, _FLOATS))
                other = cost(lanes._distances(builder, own, found, width), across, b_v, c)
                other = builder.or_(other, vector(_INTS, [ABOVE] * 4 + [BELOW] * 4))
                for pick in ((0, 1, 2, 3), (4, 5, 6, 7)):
                    one, least_key = _pairs(builder, other, other, pick), builder.load(slot)
                    builder.store(builder.select(builder.icmp_signed("<", one, least_key), one, least_key), slot)
            key = builder.load(slot)
            rank = builder.and_(key, vector(_FOUR, [15] * 4))

            def all_of(value: Any) -> Any:
                return splat(builder, value, 4)

            def where(sign: str, n: int, one: Any, other: Any) -> Any:
                return builder.select(builder.icmp_signed(sign, rank, vector(_FOUR, [n] * 4)), one, other)

            columns = where(">", LANES, all_of(centre), builder.add(all_of(builder.sub(u, ir.Constant(_I32, 1))), rank))
            columns = where("==", 0, all_of(centre), columns)
            away = where(
                "==", ABOVE, vector(_FOUR, [-1] * 4), where("==", BELOW, vector(_FOUR, [1] * 4), vector(_FOUR, [0] * 4))
            )
            rows = builder.shl(builder.add(all_of(v), away), vector(_FOUR, [16] * 4))
            tried = builder.or_(rows, builder.and_(columns, vector(_FOUR, [0xFFFF] * 4)))
            total = builder.lshr(key, vector(_FOUR, [4] * 4))
            pointers = [
                lanes._as(builder, lanes._pointer(context, builder, sig.args[k], args[k], ir.Constant(_I64, 0)), _FOUR)
                for k in (9, 10)
            ]
            before = builder.load(pointers[1], align=4)
            better = builder.icmp_signed("<", total, before)
            builder.store(builder.select(better, tried, builder.load(pointers[0], align=4)), pointers[0], align=4)
            builder.store(builder.select(better, total, before), pointers[1], align=4)
            return context.get_dummy_value()

        return signature, codegen

    return four


four = make_four(lanes.widest())
"""``four(left, right, lines, here, there, (cols, size, right cols), mu, (u, centre, v), (count, cross), best, least)``:
the best candidate, cost << 4 | rank, of each pixel of a square of two by two.

``left[here]``: word of the first pixel; ``right[there]``: the one it meets at column displacement ``u``, row
displacement ``v``. Candidates are the column displacements ``u + k`` for k < ``count``, at most eight; where ``cross``,
also ``centre`` a row less and a row more. Eight words from the first one on are read for each pixel, whatever
``count``. ``cols, size``: columns and pixels of the left image; ``lines, mu`` as in ``lanes``. Rank 0 is the candidate
of column ``centre``, 1 + k the others; ABOVE and BELOW those of the other rows. Of equal ones the least rank wins.
``best, least``: packed displacement and cost of the best so far, replaced where this one costs less.
"""
