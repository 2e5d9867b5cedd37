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

from rille.stages.hfvm.level import simd
from rille.stages.hfvm.level.simd import LANES

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
    def four(typingctx, images, line, at, sizes, strip, out):  # type: ignore[no-untyped-def]
        two, five = types.UniTuple(types.int64, 2), types.UniTuple(types.int64, 5)
        words, maps = types.UniTuple(simd.WORDS, 2), types.UniTuple(simd.PAIRS, 2)
        signature = types.void(words, types.UniTuple(types.float32, 3), two, two, five, maps)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            splat, vector = simd._splat, simd._vector
            images, line, at, sizes, strip, out = (cgutils.unpack_tuple(builder, given) for given in args)
            (left, right), (here, there), (cols, rcols), (u, count, centre, v, cross) = images, at, sizes, strip
            u, centre, v = (builder.trunc(n, _I32) for n in (u, centre, v))
            a, b, c = (splat(builder, n) for n in line)

            def load(array: Any, index: Any, kind: Any) -> Any:
                pointer = simd._pointer(context, builder, simd.WORDS, array, index)
                # Strips begin at any word: no more than a word's alignment may be promised.
                return builder.load(simd._as(builder, pointer, kind), align=8)

            def moved(index: Any, rows: int, columns: int, wide: Any) -> Any:
                index = builder.add(index, builder.mul(wide, ir.Constant(_I64, rows)))
                return builder.add(index, ir.Constant(_I64, columns))

            def band(columns: Any, rows: Any, rank: Any) -> Any:
                """What eight displacements cost by the line, << 4 | rank."""
                off = builder.fadd(
                    builder.fmul(a, builder.sitofp(columns, _FLOATS)), builder.fmul(b, builder.sitofp(rows, _FLOATS))
                )
                return shorts(simd.band_cost(builder, builder.fadd(off, c)), rank)

            def shorts(cost: Any, rank: Any) -> Any:
                # Cost above, rank below: the least number is the least cost and, of equal ones, the least rank.
                four_bits = vector(_INTS, [4] * LANES)
                return builder.trunc(builder.or_(builder.shl(cost, four_bits), rank), _SHORTS)

            def cost(distance: Any, other: Any) -> Any:
                near = builder.trunc(builder.shl(distance, vector(simd._WORDS, [4] * LANES)), _SHORTS)
                # Saturating: a lane beyond the strip stays at 0xFFFF, whatever lies there.
                return simd._call(builder, "llvm.uadd.sat.v8i16", _SHORTS, near, other)

            lane = vector(_INTS, range(LANES))
            is_own = builder.icmp_signed("==", lane, splat(builder, builder.sub(centre, u)))
            # The centre's own column ranks before the others, so that it wins ties against those to its left.
            rank = builder.select(is_own, vector(_INTS, [0] * LANES), vector(_INTS, range(1, LANES + 1)))
            taking = builder.icmp_signed("<", lane, splat(builder, builder.trunc(count, _I32)))
            other = band(builder.add(splat(builder, u), lane), splat(builder, v), rank)
            other = builder.select(taking, other, vector(_SHORTS, [-1] * LANES))
            words = [load(left, moved(here, j, i, cols), _I64) for j, i in _CHILDREN]
            key = ir.Constant(_FOUR, ir.Undefined)
            for k, word in enumerate(words):
                found = load(right, moved(there, *_CHILDREN[k], rcols), simd._WORDS)
                one = cost(simd._distances(builder, splat(builder, word), found, width), other)
                one = simd._call(builder, "llvm.vector.reduce.umin.v8i16", _I16, one)
                key = builder.insert_element(key, builder.zext(one, _I32), ir.Constant(_I32, k))
            slot = cgutils.alloca_once_value(builder, key)
            with builder.if_then(builder.icmp_signed("!=", cross, ir.Constant(_I64, 0))):
                # Lanes: four pixels, each with the row less, then the same with the row more.
                at = builder.add(there, builder.sext(builder.sub(centre, u), _I64))
                rows = [load(right, moved(at, j, 0, rcols), _PAIR) for j in (-1, 0, 1, 2)]
                less, more = (_pairs(builder, rows[k], rows[k + 1], (0, 1, 2, 3)) for k in (0, 2))
                found = _pairs(builder, less, more, tuple(range(8)))

                own = ir.Constant(simd._WORDS, ir.Undefined)
                for k, word in enumerate([*words, *words]):
                    own = builder.insert_element(own, word, ir.Constant(_I32, k))
                away = builder.add(splat(builder, v), vector(_INTS, [-1] * 4 + [1] * 4))
                other = band(splat(builder, centre), away, vector(_INTS, [ABOVE] * 4 + [BELOW] * 4))
                other = cost(simd._distances(builder, own, found, width), other)
                other = builder.zext(other, _INTS)
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
                simd._as(builder, simd._pointer(context, builder, simd.PAIRS, array, ir.Constant(_I64, 0)), _FOUR)
                for array in out
            ]
            before = builder.load(pointers[1], align=4)
            # Strictly less: of equal costs the strip that came earlier wins.
            better = builder.icmp_signed("<", total, before)
            builder.store(builder.select(better, tried, builder.load(pointers[0], align=4)), pointers[0], align=4)
            builder.store(builder.select(better, total, before), pointers[1], align=4)
            return context.get_dummy_value()

        return signature, codegen

    return four


four = make_four(simd.widest())
"""``four((left, right), line, (here, there), (cols, right cols), (u, count, centre, v, cross), (best, least))``:
the best candidate, cost << 4 | rank, of each pixel of a square of two by two.

``left[here]``: word of the first pixel; ``right[there]``: the one it meets at column displacement ``u``, row
displacement ``v``. Candidates are the column displacements ``u + k`` for k < ``count``, at most eight; where ``cross``,
also ``centre`` a row less and a row more. Eight words from the first one on are read for each pixel, whatever
``count``. ``cols``: columns of the left image; ``line``: the square's (:func:`rille.stages.hfvm.level.epipolar.line`).
Rank 0 is the candidate of column ``centre``, 1 + k the others; ABOVE and BELOW those of the other rows. Of equal ones
the least rank wins.
``best, least``: packed displacement and cost of the best so far, replaced where this one costs less.
"""
