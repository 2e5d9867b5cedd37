"""Eight pixels at once: vector code for the search kernels (numba intrinsics written in LLVM IR).

A feature vector is one 64-bit word, so eight of them fill a 512-bit register, and x86 adds the absolute differences of
the bytes of each word in one instruction (``psadbw``, in 512, 256 or 128 bits). Elsewhere the same sums come from
generic vector code; both give the same integers.

Costs: distance + trunc(mu * |a u + b v + c|), with the epipolar line (a, b, c) and the sum in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped]
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic

LANES = 8

_I8, _I16, _I32, _I64 = (ir.IntType(n) for n in (8, 16, 32, 64))
_WORDS = ir.VectorType(_I64, LANES)
_INTS = ir.VectorType(_I32, LANES)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


def widest() -> int:
    """Bits of the widest ``psadbw`` that compiled code may use; 0 = none, or a CPU set by hand."""
    if config.CPU_NAME or config.CPU_FEATURES:
        return 0
    if not llvm.get_default_triple().startswith("x86_64"):
        return 0
    has = llvm.get_host_cpu_features()
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
LINES = types.Array(types.float32, 1, "C")


def _load(builder: Any, pointer: Any, inside: Any) -> Any:
    """Masked load of eight words."""
    kind = ir.FunctionType(_WORDS, [pointer.type, _I32, _MASK, _WORDS])
    f = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8i64.p0")
    return builder.call(f, [pointer, ir.Constant(_I32, 8), inside, _vector(_WORDS, [0] * LANES)])


TRUNCATION = 2
"""Pixels: beyond this a step to a neighbour costs no more, so that depth edges stay."""

FAR = 1 << 25
"""Cost above every cost."""

SHARP = 3.0
"""Byte steps a pixel: a softer band hardly says in which row to search."""

_FLOATS8 = ir.VectorType(ir.FloatType(), LANES)
_HALVES = ir.VectorType(_I16, 2 * LANES)
_ALL = ir.Constant(_MASK, [1] * LANES)


def _gather(builder: Any, data: Any, index: Any, kind: Any, inside: Any = None) -> Any:
    """Elements of vector type ``kind`` at eight 32-bit indices; anything where not ``inside``.

    Eight single loads: gather instructions take three times as long on processors with their mitigation.
    """
    if inside is not None:
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
    mu: Any
    image: Any
    rows: Any
    cols: Any

    def cost(self, tried: Any, alike: bool = False) -> tuple[Any, Any]:
        """Distance + trunc(mu |a u + b v + c|) at packed displacements, and which of them lie in the image.

        ``alike``: all displacements are equal and the pixels lie side by side, so that their words do, too.
        """
        builder, sixteen = self.builder, _vector(_INTS, [16] * LANES)
        u, v = builder.ashr(builder.shl(tried, sixteen), sixteen), builder.ashr(tried, sixteen)
        xr, yr = builder.add(self.x, u), builder.add(self.y, v)
        # Compared without sign: below zero is beyond the end.
        inside = builder.and_(builder.icmp_unsigned("<", xr, self.cols), builder.icmp_unsigned("<", yr, self.rows))
        index = builder.add(builder.mul(yr, self.cols), xr)
        if alike:
            first = builder.sext(builder.extract_element(index, ir.Constant(_I32, 0)), _I64)
            found = _load(builder, _as(builder, builder.gep(self.image, [first]), _WORDS), inside)
        else:
            found = _gather(builder, self.image, index, _WORDS, inside)
        distance = builder.trunc(_distances(builder, self.words, found, self.width), _INTS)
        a, b, c = self.line
        across = builder.fmul(a, builder.sitofp(u, _FLOATS8))
        off = builder.fadd(builder.fadd(across, builder.fmul(b, builder.sitofp(v, _FLOATS8))), c)
        band = builder.fmul(self.mu, _call(builder, "llvm.fabs.v8f32", _FLOATS8, off))
        return builder.add(distance, builder.fptosi(band, _INTS)), inside


def _rough(builder: Any, tried: Any, near: list[Any]) -> Any:
    """Sum over the neighbours of min(|du| + |dv|, TRUNCATION), eight 32-bit integers."""
    low, sixteen = _vector(_INTS, [0xFFFF] * LANES), _vector(_INTS, [16] * LANES)
    most, total = _vector(_INTS, [TRUNCATION] * LANES), _vector(_INTS, [0] * LANES)
    no_poison = ir.Constant(ir.IntType(1), 0)
    for n in near:
        d = builder.sub(builder.bitcast(n, _HALVES), builder.bitcast(tried, _HALVES))
        size = builder.bitcast(_call(builder, "llvm.abs.v16i16", _HALVES, d, no_poison), _INTS)
        both = builder.add(builder.and_(size, low), builder.lshr(size, sixteen))
        total = builder.add(total, _call(builder, "llvm.umin.v8i32", _INTS, both, most))
    return total


def _any(builder: Any, mask: Any) -> Any:
    return builder.icmp_unsigned("!=", builder.bitcast(mask, _I8), ir.Constant(_I8, 0))


def make_settle(width: int) -> Any:
    """Intrinsic ``settle``, see :data:`settle`."""

    @intrinsic
    def settle(  # type: ignore[no-untyped-def]
        typingctx, left, right, packed, data, lines, todo, at, here, above, below, y, shape, smooth, mu, new, cost
    ):
        i64 = types.int64
        sizes = types.UniTuple(i64, 5)
        signature = types.void(
            WORDS, WORDS, PAIRS, PAIRS, LINES, PAIRS, i64, i64, i64, i64, i64, sizes, i64, types.float32, PAIRS, PAIRS
        )

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            left, right, packed, data, lines = (
                context.make_array(kind)(context, builder, a).data
                for kind, a in zip(sig.args[:5], args[:5], strict=True)
            )
            at, here, above, below, y = args[6:11]
            rows, cols, left_cols, size, ahead = (
                builder.trunc(n, _I32) for n in cgutils.unpack_tuple(builder, args[11])
            )
            x = builder.load(_as(builder, _pointer(context, builder, sig.args[5], args[5], at), _INTS), align=4)
            one, nil = _vector(_INTS, [1] * LANES), _vector(_INTS, [0] * LANES)
            last = _splat(builder, builder.sub(left_cols, ir.Constant(_I32, 1)))
            # Beyond the border the pixel on the other side stands in.
            first, final = builder.icmp_signed("==", x, nil), builder.icmp_signed("==", x, last)
            west = builder.select(first, _call(builder, "llvm.smin.v8i32", _INTS, one, last), builder.sub(x, one))
            back = _call(builder, "llvm.smax.v8i32", _INTS, builder.sub(last, one), nil)
            east = builder.select(final, back, builder.add(x, one))

            def read(array: Any, row: Any, column: Any, kind: Any) -> Any:
                return _gather(builder, array, builder.add(column, _splat(builder, builder.trunc(row, _I32))), kind)

            own, stay = read(packed, here, x, _INTS), read(data, here, x, _INTS)
            near = [read(packed, row, i, _INTS) for row, i in ((above, x), (here, west), (here, east), (below, x))]
            place = builder.add(x, _splat(builder, builder.trunc(here, _I32)))
            line = []
            for _ in range(3):
                line.append(_gather(builder, lines, place, _FLOATS8))
                place = builder.add(place, _splat(builder, size))
            pixels = _Pixels(
                builder, width, builder.add(x, _splat(builder, ahead)), _splat(builder, builder.trunc(y, _I32)),
                read(left, here, x, _WORDS),
                (line[0], line[1], line[2]), _splat(builder, args[13]), right, _splat(builder, rows),
                _splat(builder, cols),
            )  # fmt: skip
            smooth = _splat(builder, builder.trunc(args[12], _I32))
            total = builder.add(stay, builder.mul(smooth, _rough(builder, own, near)))
            best, found, least = (cgutils.alloca_once_value(builder, a) for a in (own, stay, total))

            def attempt(tried: Any) -> None:
                cost, inside = pixels.cost(tried)
                total = builder.add(cost, builder.mul(smooth, _rough(builder, tried, near)))
                better = builder.and_(inside, builder.icmp_signed("<", total, builder.load(least)))
                for slot, value in ((best, tried), (found, cost), (least, total)):
                    builder.store(builder.select(better, value, builder.load(slot)), slot)

            for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                step = _vector(_INTS, [((dv & 0xFFFF) << 16) | (du & 0xFFFF)] * LANES)
                moved = builder.add(builder.bitcast(own, _HALVES), builder.bitcast(step, _HALVES))
                attempt(builder.bitcast(moved, _INTS))
            for tried in near:
                with builder.if_then(_any(builder, builder.icmp_signed("!=", tried, own))):
                    attempt(tried)
            for kind, array, slot in ((sig.args[14], args[14], best), (sig.args[15], args[15], found)):
                pointer = _as(builder, _pointer(context, builder, kind, array, at), _INTS)
                builder.store(builder.load(slot), pointer, align=4)
            return context.get_dummy_value()

        return signature, codegen

    return settle


settle = make_settle(widest())
"""``settle(left, right, packed, data, lines, todo, at, here, above, below, y, shape, smooth, mu, new, cost)``: the best
displacement of eight pixels of row ``y`` among each one's own, those a pixel beside it, and those of its four
neighbours.

``todo[at : at + 8]``: columns of the pixels, no two of them neighbours. All arrays are flat: words of both images;
``packed`` displacements, v << 16 | u, and their costs without smoothness; ``lines``: three planes of the left image's
size. ``here, above, below``: index at which the row and its neighbours begin. ``shape``: rows and columns of the right
image, columns and size of the left one, and the column of the left one's first pixel in the right one, as ``y`` is the
row there: both may be windows. In this order: own, own a column less, more, a row less, more, then up, west, east,
down; the first of equal ones wins. Costs have
``smooth`` times the roughness added. ``new[at : at + 8]`` gets the best ones and
``cost`` their costs without smoothness.
"""


def make_seek(width: int) -> Any:
    """Intrinsic ``seek``, see :data:`seek`."""

    @intrinsic
    def seek(typingctx, left, right, centres, lines, x, y, here, parents, beside, shape, reach, mu, packed, data):  # type: ignore[no-untyped-def]
        i64 = types.int64
        signature = types.void(
            WORDS, WORDS, PAIRS, LINES, i64, i64, i64, i64, i64, types.UniTuple(i64, 5), types.UniTuple(i64, 3),
            types.float32, PAIRS, PAIRS,
        )  # fmt: skip

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            _, right, centres = (
                context.make_array(kind)(context, builder, a).data
                for kind, a in zip(sig.args[:3], args[:3], strict=True)
            )
            start, y, here, parents, beside = args[4:9]
            rows, cols, left_cols, size, ahead = cgutils.unpack_tuple(builder, args[9])
            reach_x, reach_y, count = cgutils.unpack_tuple(builder, args[10])

            def narrow(n: Any) -> Any:
                return _splat(builder, builder.trunc(n, _I32))

            x = builder.add(narrow(start), _vector(_INTS, range(LANES)))
            valid = builder.icmp_signed("<", x, narrow(left_cols))
            first = builder.add(here, start)

            def read(k: int, at: Any, kind: Any, name: str) -> Any:
                pointer = _as(builder, _pointer(context, builder, sig.args[k], args[k], at), kind)
                f = ir.FunctionType(kind, [pointer.type, _I32, _MASK, kind])
                load = cgutils.get_or_insert_function(builder.module, f, f"llvm.masked.load.{name}.p0")
                nothing = ir.Constant(kind, [0.0 if kind == _FLOATS8 else 0] * LANES)
                return builder.call(load, [pointer, ir.Constant(_I32, 8 if kind == _WORDS else 4), valid, nothing])

            words = read(0, first, _WORDS, "v8i64")
            line = []
            for _ in range(3):
                line.append(read(3, first, _FLOATS8, "v8f32"))
                first = builder.add(first, size)
            pixels = _Pixels(
                builder, width, builder.add(x, narrow(ahead)), narrow(y), words, (line[0], line[1], line[2]),
                _splat(builder, args[11]), right,
                narrow(rows), narrow(cols),
            )  # fmt: skip
            one = _vector(_INTS, [1] * LANES)
            middle = builder.ashr(x, one)
            middle_0 = builder.ashr(narrow(start), one)
            odd = builder.and_(x, one)
            side = builder.sub(builder.add(middle, builder.add(odd, odd)), one)
            away = builder.sub(builder.add(middle, middle), side)
            places = [(parents, middle), (parents, side), (beside, middle), (beside, side), (parents, away)]
            held = cgutils.alloca_once(builder, _INTS, size=len(places))
            for k, (row, i) in enumerate(places):
                index = builder.add(builder.add(builder.select(valid, i, middle_0), one), narrow(row))
                builder.store(_gather(builder, centres, index, _INTS), builder.gep(held, [ir.Constant(_I32, k)]))
            own = builder.load(held)
            cost, inside = pixels.cost(own)
            far = _vector(_INTS, [FAR] * LANES)
            best, least = (cgutils.alloca_once_value(builder, a) for a in (own, builder.select(inside, cost, far)))
            one_more = ir.Constant(_I64, 1)
            square = builder.fcmp_ordered("<", args[11], ir.Constant(ir.FloatType(), SHARP))
            with cgutils.for_range(builder, count) as loop:
                centre = builder.load(builder.gep(held, [loop.index]))
                is_own = builder.icmp_signed("==", loop.index, ir.Constant(_I64, 0))
                new = builder.or_(is_own, _any(builder, builder.icmp_signed("!=", centre, own)))
                with builder.if_then(new):
                    up_reach = builder.select(builder.or_(is_own, square), reach_y, ir.Constant(_I64, 0))

                    def around(alike: bool) -> None:
                        with cgutils.for_range(builder, builder.add(builder.add(up_reach, up_reach), one_more)) as loop:
                            up = builder.sub(loop.index, up_reach)
                            level = builder.icmp_signed("==", up, ir.Constant(_I64, 0))
                            reach = builder.select(builder.or_(level, square), reach_x, ir.Constant(_I64, 0))
                            upward = builder.shl(up, ir.Constant(_I64, 16))
                            with cgutils.for_range(builder, builder.add(builder.add(reach, reach), one_more)) as loop:
                                step = builder.and_(builder.sub(loop.index, reach), ir.Constant(_I64, 0xFFFF))
                                moved = builder.bitcast(narrow(builder.or_(upward, step)), _HALVES)
                                tried = builder.bitcast(builder.add(builder.bitcast(centre, _HALVES), moved), _INTS)
                                cost, inside = pixels.cost(tried, alike)
                                better = builder.and_(inside, builder.icmp_signed("<", cost, builder.load(least)))
                                for slot, value in ((best, tried), (least, cost)):
                                    builder.store(builder.select(better, value, builder.load(slot)), slot)

                    lane_0 = _splat(builder, builder.extract_element(centre, ir.Constant(_I32, 0)))
                    mixed = _any(builder, builder.icmp_signed("!=", centre, lane_0))
                    with builder.if_else(mixed) as (differing, equal):
                        with differing:
                            around(False)
                        with equal:
                            around(True)
            for k, slot in ((12, best), (13, least)):
                pointer = _as(
                    builder, _pointer(context, builder, sig.args[k], args[k], builder.add(here, start)), _INTS
                )
                f = ir.FunctionType(ir.VoidType(), [_INTS, pointer.type, _I32, _MASK])
                store = cgutils.get_or_insert_function(builder.module, f, "llvm.masked.store.v8i32.p0")
                builder.call(store, [builder.load(slot), pointer, ir.Constant(_I32, 4), valid])
            return context.get_dummy_value()

        return signature, codegen

    return seek


seek = make_seek(widest())
"""``seek(left, right, centres, lines, x, y, here, parents, beside, shape, reach, mu, packed, data)``: the best
displacement of the eight pixels from (``x``, ``y``) on around the displacements of their coarse parents.

``centres``: flat, packed, a border of one all round; ``parents``: where the row of the parents begins, ``beside``: the
coarse row next to this one's other side. ``reach``: columns and rows to either side, and the number of centres: of the
parent, the coarse pixels nearest along the row, the column and the diagonal, and the one at the parent's other side.
A search reaches along the row, about the parent also along the column; where the band is not sharp, over the whole
rectangle about each. The other arrays as in :data:`settle`;
``packed, data`` are written.
"""


SUM_RADIUS = 2
"""Pixels: reach of the windows of ``sums``."""


def make_sums(width: int) -> Any:
    """Intrinsic ``sums``, see :data:`sums`."""

    @intrinsic
    def sums(typingctx, left, right, at_left, at_right, left_cols, right_cols):  # type: ignore[no-untyped-def]
        i64 = types.int64
        result = types.UniTuple(i64, 5)
        signature = result(WORDS, WORDS, i64, i64, i64, i64)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            left, right, at_left, at_right, left_cols, right_cols = args
            five = ir.Constant(_MASK, [1] * 5 + [0] * (LANES - 5))

            def row(kind: Any, array: Any, at: Any, cols: Any, j: int, i: int) -> Any:
                shift = builder.add(builder.mul(cols, ir.Constant(_I64, j)), ir.Constant(_I64, i - 2))
                pointer = _pointer(context, builder, kind, array, builder.add(at, shift))
                return _load(builder, _as(builder, pointer, _WORDS), five)

            lefts = [row(sig.args[0], left, at_left, left_cols, j, 0) for j in range(-2, 3)]
            rights = [row(sig.args[1], right, at_right, right_cols, j, 0) for j in range(-3, 4)]
            wests = [row(sig.args[1], right, at_right, right_cols, j, -1) for j in range(-2, 3)]
            easts = [row(sig.args[1], right, at_right, right_cols, j, 1) for j in range(-2, 3)]
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
            four, last = (_call(builder, "llvm.vector.reduce.add.v8i64", _I64, t) for t in (packed, totals[4]))
            low = ir.Constant(_I64, 0xFFFF)
            found = [builder.and_(builder.lshr(four, ir.Constant(_I64, 16 * k)), low) for k in range(4)] + [last]
            return context.make_tuple(builder, sig.return_type, found)

        return signature, codegen

    return sums


sums = make_sums(widest())
"""``sums(left, right, at_left, at_right, left_cols, right_cols)``: five distances summed over 5 x 5 pixels.

Around word ``at_left`` of the left image and ``at_right`` of the right one, displaced by nothing, one to the west,
east, north, south. The windows must lie inside.
"""

_FLOATS = ir.VectorType(ir.FloatType(), 4)
_CUBIC = ((0.0, 1.0, 0.0, 0.0), (-0.5, 0.0, 0.5, 0.0), (1.0, -2.5, 2.0, -0.5), (-0.5, 1.5, -1.5, 0.5))
"""Catmull-Rom weights of four samples: coefficients of 1, t, t^2, t^3."""

GREY = types.Array(types.float32, 1, "C")


def _polynomial(builder: Any, coefficients: Any, t: Any) -> Any:
    """Vector polynomial of a vector that holds ``t`` four times."""
    total = _vector(_FLOATS, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = builder.fadd(builder.fmul(total, t), _vector(_FLOATS, c))
    return total


def _dot(builder: Any, a: Any, b: Any) -> Any:
    """Sum of four products, in pairs."""
    product = builder.fmul(a, b)
    for pick in ([2, 3, 2, 3], [1, 1, 1, 1]):
        moved = builder.shuffle_vector(product, product, ir.Constant(ir.VectorType(_I32, 4), pick))
        product = builder.fadd(product, moved)
    return builder.extract_element(product, ir.Constant(_I32, 0))


@intrinsic
def cubic(typingctx, image, at, width, t, s):  # type: ignore[no-untyped-def]
    """Catmull-Rom value of a flat float32 image of ``width`` columns.

    ``at``: index of the pixel above and left of the point's own; ``t, s``: the point's distance right of and below it,
    within a pixel. 4 x 4 pixels from ``at - width - 1`` on are read.
    """
    f32, i64 = types.float32, types.int64
    signature = f32(GREY, i64, i64, f32, f32)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        image, at, width, t, s = args
        start = builder.sub(builder.sub(at, width), ir.Constant(_I64, 1))
        weights = _polynomial(builder, _CUBIC, _splat(builder, s, 4))
        column = ir.Constant(_FLOATS, [0.0] * 4)
        for k in range(4):
            pointer = _as(builder, _pointer(context, builder, sig.args[0], image, start), _FLOATS)
            each = builder.shuffle_vector(weights, weights, ir.Constant(ir.VectorType(_I32, 4), [k] * 4))
            column = builder.fadd(column, builder.fmul(each, builder.load(pointer, align=4)))
            start = builder.add(start, width)
        return _dot(builder, _polynomial(builder, _CUBIC, _splat(builder, t, 4)), column)

    return signature, codegen
