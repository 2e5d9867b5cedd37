"""Eight pixels at once: vector code for the search kernels (numba intrinsics written in LLVM IR).

A feature vector is one 64-bit word, so eight of them fill a 512-bit register, and x86 adds the absolute differences of
the bytes of each word in one instruction (``psadbw``, in 512, 256 or 128 bits). Elsewhere the same sums come from
generic vector code; both give the same integers.

Costs: distance + min(trunc(|a u + b v + c|), 2047), with the epipolar line (a, b, c), its normal as long as a pixel off
it costs (:func:`rille.stages.hfvm.level.epipolar.line`), and the sum in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped]
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic

from rille.stages.hfvm.level.epipolar import LEAST_NORMAL

LANES = 8

_I8, _I16, _I32, _I64 = (ir.IntType(n) for n in (8, 16, 32, 64))
_WORDS = ir.VectorType(_I64, LANES)
_INTS = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


def widest() -> int:
    """Bits of the widest ``psadbw`` that compiled code may use; 0 = none, or a CPU set by hand."""
    # Code is then made for a CPU that need not be the host, whose features are asked below.
    if config.CPU_NAME or config.CPU_FEATURES:
        return 0
    if not llvm.get_default_triple().startswith("x86_64"):
        return 0
    has = llvm.get_host_cpu_features()
    # Every x86-64 processor has the 128-bit form (SSE2).
    return 512 if has.get("avx512bw") else 256 if has.get("avx2") else 128


def _vector(kind: Any, values: Any) -> Any:
    return ir.Constant(kind, list(values))


def _splat(builder: Any, value: Any, count: int = LANES) -> Any:
    kind = ir.VectorType(value.type, count)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, count), [0] * count)
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), zeros)


def _call(builder: Any, name: str, result: Any, *args: Any) -> Any:
    kind = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)


_PSADBW = {512: "llvm.x86.avx512.psad.bw.512", 256: "llvm.x86.avx2.psad.bw", 128: "llvm.x86.sse2.psad.bw"}


def _distances(builder: Any, a: Any, b: Any, width: int) -> Any:
    """Sums of absolute byte differences of two vectors of eight words."""
    if width:
        n = width // 64
        undefined = ir.Constant(_WORDS, ir.Undefined)
        parts = []
        for start in range(0, LANES, n):
            pick = ir.Constant(ir.VectorType(_I32, n), list(range(start, start + n)))
            kind = ir.VectorType(_I8, width // 8)
            p, q = (builder.bitcast(builder.shuffle_vector(w, undefined, pick), kind) for w in (a, b))
            parts.append(_call(builder, _PSADBW[width], ir.VectorType(_I64, n), p, q))
        while len(parts) > 1:
            size = parts[0].type.count
            both = ir.Constant(ir.VectorType(_I32, 2 * size), list(range(2 * size)))
            parts = [builder.shuffle_vector(p, q, both) for p, q in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]
    kind = ir.VectorType(_I8, 8 * LANES)
    p, q = builder.bitcast(a, kind), builder.bitcast(b, kind)
    less = builder.icmp_unsigned("<", p, q)
    d = builder.bitcast(builder.select(less, builder.sub(q, p), builder.sub(p, q)), _WORDS)
    # Add neighbouring bytes to four 16-bit sums, and those by a product whose top 16 bits hold their sum.
    low = _vector(_WORDS, [0x00FF00FF00FF00FF] * LANES)
    eight = _vector(_WORDS, [8] * LANES)
    pairs = builder.add(builder.and_(d, low), builder.and_(builder.lshr(d, eight), low))
    total = builder.mul(pairs, _vector(_WORDS, [0x0001000100010001] * LANES))
    return builder.lshr(total, _vector(_WORDS, [48] * LANES))


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


def _as(builder: Any, pointer: Any, kind: Any) -> Any:
    return builder.bitcast(pointer, ir.PointerType(kind))


WORDS = types.Array(types.uint64, 1, "C")
PAIRS = types.Array(types.int32, 1, "C")
TERMS = types.UniTuple(types.float32, 8)
MAPS = types.Tuple((WORDS, WORDS, PAIRS, PAIRS))


def _load(builder: Any, pointer: Any, inside: Any) -> Any:
    """Masked load of eight words."""
    kind = ir.FunctionType(_WORDS, [pointer.type, _I32, _MASK, _WORDS])
    f = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8i64.p0")
    # Lanes beyond the window are not touched, as memory may end there; zeros in both images add no difference.
    return builder.call(f, [pointer, ir.Constant(_I32, 8), inside, _vector(_WORDS, [0] * LANES)])


TRUNCATION = 2
"""Pixels: beyond this a step to a neighbour costs no more, so that depth edges stay."""

FAR = 1 << 25
"""Cost above every cost."""

FARTHEST_OFF = 2047
"""Most that the band costs: as much as the greatest distance, so that a cost has twelve bits."""

SHARP = 3.0
"""Byte steps a pixel: a softer band hardly says in which row to search."""

_FLOATS8 = ir.VectorType(ir.FloatType(), LANES)
_HALVES = ir.VectorType(_I16, 2 * LANES)


def _gather(builder: Any, data: Any, index: Any, kind: Any, inside: Any = None) -> Any:
    """Elements of vector type ``kind`` at eight 32-bit indices; anything where not ``inside``.

    Eight single loads: gather instructions take three times as long on processors with their mitigation.
    """
    if inside is not None:
        # Word 0 always exists; what it gives is dropped by the caller.
        index = builder.select(inside, index, _vector(_INTS, [0] * LANES))
    found = ir.Constant(kind, ir.Undefined)
    for lane in range(LANES):
        i = builder.sext(builder.extract_element(index, ir.Constant(_I32, lane)), _I64)
        found = builder.insert_element(found, builder.load(builder.gep(data, [i])), ir.Constant(_I32, lane))
    return found


@dataclass
class _Pixels:
    """Eight pixels of a row in a kernel under construction: columns, words, lines, and the image to search."""

    builder: Any
    width: int
    x: Any
    y: Any
    words: Any
    line: tuple[Any, Any, Any]
    image: Any
    rows: Any
    cols: Any

    def cost(self, tried: Any) -> tuple[Any, Any]:
        """Distance and band cost at packed displacements, and which of them lie in the image."""
        builder, sixteen = self.builder, _vector(_INTS, [16] * LANES)
        # Up and arithmetically down again: the lower half has a sign, too.
        u, v = builder.ashr(builder.shl(tried, sixteen), sixteen), builder.ashr(tried, sixteen)
        xr, yr = builder.add(self.x, u), builder.add(self.y, v)
        # Compared without sign: below zero is beyond the end.
        inside = builder.and_(builder.icmp_unsigned("<", xr, self.cols), builder.icmp_unsigned("<", yr, self.rows))
        index = builder.add(builder.mul(yr, self.cols), xr)
        found = _gather(builder, self.image, index, _WORDS, inside)
        distance = builder.trunc(_distances(builder, self.words, found, self.width), _INTS)
        a, b, c = self.line
        across = builder.fmul(a, builder.sitofp(u, _FLOATS8))
        off = builder.fadd(builder.fadd(across, builder.fmul(b, builder.sitofp(v, _FLOATS8))), c)
        return builder.add(distance, band_cost(builder, off)), inside


def band_cost(builder: Any, off: Any) -> Any:
    """trunc(|off|) of eight costs of being off a line, at most :data:`FARTHEST_OFF`."""
    band = _call(builder, "llvm.fabs.v8f32", _FLOATS8, off)
    most = _vector(_FLOATS8, [float(FARTHEST_OFF)] * LANES)
    # An ordered comparison: NaN is not less and costs the most, instead of an undefined integer.
    return builder.fptosi(builder.select(builder.fcmp_ordered("<", band, most), band, most), _INTS)


def _rough(builder: Any, tried: Any, near: list[Any]) -> Any:
    """Sum over the neighbours of min(|du| + |dv|, TRUNCATION), eight 32-bit integers."""
    low, sixteen = _vector(_INTS, [0xFFFF] * LANES), _vector(_INTS, [16] * LANES)
    most, total = _vector(_INTS, [TRUNCATION] * LANES), _vector(_INTS, [0] * LANES)
    # The magnitude of -32768 wraps, which is defined only with this flag off.
    no_poison = ir.Constant(ir.IntType(1), 0)
    for n in near:
        d = builder.sub(builder.bitcast(n, _HALVES), builder.bitcast(tried, _HALVES))
        size = builder.bitcast(_call(builder, "llvm.abs.v16i16", _HALVES, d, no_poison), _INTS)
        both = builder.add(builder.and_(size, low), builder.lshr(size, sixteen))
        total = builder.add(total, _call(builder, "llvm.umin.v8i32", _INTS, both, most))
    return total


def _every_other(builder: Any, pointer: Any, kind: Any) -> Any:
    """Eight elements of vector type ``kind``, the first one at ``pointer``; the ones between are read and dropped."""
    size = kind.element.width // 8
    halves = [
        builder.load(_as(builder, builder.gep(pointer, [ir.Constant(_I64, n)]), kind), align=size) for n in (0, LANES)
    ]
    return builder.shuffle_vector(*halves, ir.Constant(_INTS, list(range(0, 2 * LANES, 2))))


def _lines(builder: Any, terms: Any, x: Any) -> tuple[Any, Any, Any]:
    """:func:`rille.stages.hfvm.level.epipolar.line` of eight columns; ``terms``: the row's, and the length."""
    *t, length = (_splat(builder, n) for n in cgutils.unpack_tuple(builder, terms))
    # The operations of ``epipolar.line`` in their order: scalar and vector code must agree to the bit.
    a, b = (builder.fadd(t[k], builder.fmul(t[k + 1], x)) for k in (0, 2))
    c = builder.fadd(t[4], builder.fmul(x, builder.fadd(t[5], builder.fmul(x, t[6]))))
    norm = _call(builder, "llvm.sqrt.v8f32", _FLOATS8, builder.fadd(builder.fmul(a, a), builder.fmul(b, b)))
    least = _vector(_FLOATS8, [float(LEAST_NORMAL)] * LANES)
    norm = builder.select(builder.fcmp_ordered(">", norm, least), norm, least)
    scale = builder.fdiv(length, norm)
    return builder.fmul(a, scale), builder.fmul(b, scale), builder.fmul(c, scale)


def _any(builder: Any, mask: Any) -> Any:
    return builder.icmp_unsigned("!=", builder.bitcast(mask, _I8), ir.Constant(_I8, 0))


def make_settle(width: int, dense: bool = False) -> Any:
    """Intrinsic ``settle``, see :data:`settle`; ``dense``: of every other pixel of a row, see :data:`settle_dense`."""

    @intrinsic
    def settle(typingctx, maps, line, todo, place, level, out):  # type: ignore[no-untyped-def]
        i64 = types.int64
        places, whole = types.UniTuple(i64, 5), types.UniTuple(i64, 7)
        signature = types.void(MAPS, TERMS, PAIRS, places, whole, types.UniTuple(PAIRS, 2))

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            maps, line, todo, place, level, out = args
            left, right, packed, data = (
                context.make_array(kind)(context, builder, a).data
                for kind, a in zip(MAPS, cgutils.unpack_tuple(builder, maps), strict=True)
            )
            at, here, above, below, y = cgutils.unpack_tuple(builder, place)
            rows, cols, left_cols, ahead, begin, beside, smooth = (
                builder.trunc(n, _I32) for n in cgutils.unpack_tuple(builder, level)
            )
            columns = _pointer(context, builder, PAIRS, todo, at)
            if dense:
                start = builder.load(columns)
                x = builder.add(_splat(builder, start), _vector(_INTS, range(0, 2 * LANES, 2)))
            else:
                x = builder.load(_as(builder, columns, _INTS), align=4)
            one, nil = _vector(_INTS, [1] * LANES), _vector(_INTS, [0] * LANES)
            last = _splat(builder, builder.sub(left_cols, ir.Constant(_I32, 1)))
            # Beyond the border the pixel on the other side stands in.
            first, final = builder.icmp_signed("==", x, nil), builder.icmp_signed("==", x, last)
            west = builder.select(first, _call(builder, "llvm.smin.v8i32", _INTS, one, last), builder.sub(x, one))
            back = _call(builder, "llvm.smax.v8i32", _INTS, builder.sub(last, one), nil)
            east = builder.select(final, back, builder.add(x, one))

            def read(array: Any, row: Any, column: Any, kind: Any, side: int = 0) -> Any:
                if dense:
                    place = builder.add(row, builder.sext(builder.add(start, ir.Constant(_I32, side)), _I64))
                    return _every_other(builder, builder.gep(array, [place]), kind)
                return _gather(builder, array, builder.add(column, _splat(builder, builder.trunc(row, _I32))), kind)

            own, stay = read(packed, here, x, _INTS), read(data, here, x, _INTS)
            around = ((above, x, 0), (here, west, -1), (here, east, 1), (below, x, 0))
            near = [read(packed, row, i, _INTS, side) for row, i, side in around]
            absolute = builder.sitofp(builder.add(x, _splat(builder, begin)), _FLOATS8)
            pixels = _Pixels(
                builder, width, builder.add(x, _splat(builder, ahead)), _splat(builder, builder.trunc(y, _I32)),
                read(left, here, x, _WORDS), _lines(builder, line, absolute), right, _splat(builder, rows),
                _splat(builder, cols),
            )  # fmt: skip
            smooth = _splat(builder, smooth)
            total = builder.add(stay, builder.mul(smooth, _rough(builder, own, near)))
            best, found, least = (cgutils.alloca_once_value(builder, a) for a in (own, stay, total))

            def attempt(tried: Any, fresh: Any = None) -> None:
                cost, inside = pixels.cost(tried)
                total = builder.add(cost, builder.mul(smooth, _rough(builder, tried, near)))
                # Strictly less: of equal totals the one tried first stays.
                better = builder.and_(inside, builder.icmp_signed("<", total, builder.load(least)))
                if fresh is not None:
                    better = builder.and_(better, fresh)
                for slot, value in ((best, tried), (found, cost), (least, total)):
                    builder.store(builder.select(better, value, builder.load(slot)), slot)

            def attempt_beside(du: int, dv: int) -> None:
                step = _vector(_INTS, [((dv & 0xFFFF) << 16) | (du & 0xFFFF)] * LANES)
                # Added as 16-bit halves, so that no carry runs from the column into the row.
                moved = builder.add(builder.bitcast(own, _HALVES), builder.bitcast(step, _HALVES))
                attempt(builder.bitcast(moved, _INTS))

            with builder.if_then(builder.icmp_signed(">", beside, ir.Constant(_I32, 0))):
                attempt_beside(-1, 0)
                attempt_beside(1, 0)
            with builder.if_then(builder.icmp_signed(">", beside, ir.Constant(_I32, 1))):
                attempt_beside(0, -1)
                attempt_beside(0, 1)
            for k, tried in enumerate(near):
                # What lies a column beside the own one has been tried or is left out; and what came before.
                away = builder.sub(builder.bitcast(tried, _HALVES), builder.bitcast(own, _HALVES))
                # One more makes 0, 1, 2 of -1, 0, 1 in the same row: a single unsigned comparison finds the rest.
                columns = builder.bitcast(builder.add(away, _vector(_HALVES, [1, 0] * LANES)), _INTS)
                fresh = builder.icmp_unsigned(">", columns, _vector(_INTS, [2] * LANES))
                for other in near[:k]:
                    fresh = builder.and_(fresh, builder.icmp_signed("!=", tried, other))
                with builder.if_then(_any(builder, fresh)):
                    attempt(tried, fresh)
            for array, slot in zip(cgutils.unpack_tuple(builder, out), (best, found), strict=True):
                pointer = _as(builder, _pointer(context, builder, PAIRS, array, at), _INTS)
                builder.store(builder.load(slot), pointer, align=4)
            return context.get_dummy_value()

        return signature, codegen

    return settle


settle = make_settle(widest())
"""``settle((left, right, packed, data), line, todo, (at, here, above, below, y), level, (new, cost))``: the best
displacement of eight pixels of row ``y`` among each one's own, those a pixel beside it, and those of its four
neighbours.

``todo[at : at + 8]``: columns of the pixels, no two of them neighbours. All arrays are flat: words of both images;
``packed`` displacements, v << 16 | u, and their costs without smoothness. ``line``: the row's terms of
:func:`rille.stages.hfvm.level.epipolar.line`, and the length of a normal. ``here, above, below``: index at which the
row and its neighbours begin. ``level``: rows and columns of the right image, columns of the left one, the column of the
left one's first pixel in the right one, as ``y`` is the row there (both may be windows), its column in the whole left
image, what beside the own one is tried: nothing, columns (1), rows too (2); and ``smooth``. In this order: own, own a
column less, more, a row less, more, then up, west, east, down, but for those that lie a column beside the own one; the
first of equal ones wins. Costs have ``smooth`` times the roughness added. ``new[at : at + 8]`` gets the best ones and
``cost`` their costs without smoothness.
"""

settle_dense = make_settle(widest(), dense=True)
"""As ``settle``, of the eight pixels ``todo[at]``, ``todo[at] + 2``, ... none of which nor of their neighbours lies
beyond the row: whole vectors are read. A column more than those is read, too.
"""


SUM_RADIUS = 2
"""Pixels: reach of the windows of ``sums``."""


# Eight words are the columns of four pixels with two more to either side.
SIDE_BY_SIDE = 4
"""Pixels of a row whose windows are summed together."""


def make_sums(width: int) -> Any:
    """Intrinsic ``sums``, see :data:`sums`."""

    @intrinsic
    def sums(typingctx, images, at, sizes, count, out, index):  # type: ignore[no-untyped-def]
        i64 = types.int64
        two = types.UniTuple(i64, 2)
        words = types.UniTuple(WORDS, 2)
        signature = types.void(words, two, two, i64, words, i64)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            images, at, sizes, out = (cgutils.unpack_tuple(builder, args[k]) for k in (0, 1, 2, 4))
            (left, right), (at_left, at_right), (left_cols, right_cols) = images, at, sizes
            count, index = args[3], args[5]
            reach = builder.add(count, ir.Constant(_I64, 2 * SUM_RADIUS))
            inside = builder.icmp_signed("<", _vector(_WORDS, range(LANES)), _splat(builder, reach))

            def row(array: Any, at: Any, cols: Any, j: int, i: int = 0) -> Any:
                shift = builder.add(builder.mul(cols, ir.Constant(_I64, j)), ir.Constant(_I64, i - SUM_RADIUS))
                pointer = _pointer(context, builder, WORDS, array, builder.add(at, shift))
                return _load(builder, _as(builder, pointer, _WORDS), inside)

            lefts = [row(left, at_left, left_cols, j) for j in range(-2, 3)]
            rights = [row(right, at_right, right_cols, j) for j in range(-3, 4)]
            wests, easts = ([row(right, at_right, right_cols, j, i) for j in range(-2, 3)] for i in (-1, 1))
            totals = []
            for others in (rights[1:6], wests, easts, rights[:5], rights[2:]):
                total = _vector(_WORDS, [0] * LANES)
                for p, q in zip(lefts, others, strict=True):
                    total = builder.add(total, _distances(builder, p, q, width))
                totals.append(total)
            # A sum of 25 distances has 16 bits: four of them are added up in one word.
            packed = totals[0]
            for k in range(1, 4):
                packed = builder.or_(packed, builder.shl(totals[k], _vector(_WORDS, [16 * k] * LANES)))
            nothing = _vector(_WORDS, [0] * LANES)

            def moved(value: Any, n: int) -> Any:
                pick = ir.Constant(_INTS, list(range(n, n + LANES)))
                return builder.shuffle_vector(value, nothing, pick)

            for total, array in zip((packed, totals[4]), out, strict=True):
                # Five columns by three additions: two pairs and one; integers allow any order.
                pairs = builder.add(total, moved(total, 1))
                found = builder.add(builder.add(pairs, moved(pairs, 2)), moved(total, 4))
                first = ir.Constant(ir.VectorType(_I32, SIDE_BY_SIDE), list(range(SIDE_BY_SIDE)))
                pointer = _as(
                    builder,
                    _pointer(context, builder, WORDS, array, index),
                    ir.VectorType(_I64, SIDE_BY_SIDE),
                )
                builder.store(builder.shuffle_vector(found, nothing, first), pointer, align=8)
            return context.get_dummy_value()

        return signature, codegen

    return sums


sums = make_sums(widest())
"""``sums((left, right), (at_left, at_right), (left cols, right cols), count, (four, last), index)``: five distances
summed over 5 x 5 pixels, of ``count`` pixels side by side, at most four.

Around word ``at_left`` of the left image, and those after it, and ``at_right`` of the right one, displaced by nothing,
one to the west, east, north, south. The windows must lie inside. ``four[index + k]``: the first four sums, 16 bits
each, the first one lowest; ``last[index + k]``: the fifth one; four elements are written whatever ``count``.
"""
