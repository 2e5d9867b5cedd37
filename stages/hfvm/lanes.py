"""Eight feature distances at once: vector code for the search kernels (numba intrinsics written in LLVM IR).

A feature vector is one 64-bit word, so eight of them fill a 512-bit register, and x86 adds the absolute differences of
the bytes of each word in one instruction (``psadbw``, in 512, 256 or 128 bits). Elsewhere the same sums come from
generic vector code; both give the same integers.

Costs: distance + trunc(mu * |a u + b v + c|), with the epipolar line (a, b, c) in float32 and the sum in float64.
"""

from __future__ import annotations

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


def _band(builder: Any, u: Any, v: Any, line: Any, mu: Any) -> Any:
    """trunc(mu |a u + b v + c|) as eight 64-bit integers; ``u, v`` vectors of 32-bit integers."""
    a, b, c = (_splat(builder, builder.fpext(x, ir.DoubleType())) for x in line)
    x, y = builder.sitofp(u, _DOUBLES), builder.sitofp(v, _DOUBLES)
    e = builder.fadd(builder.fadd(builder.fmul(a, x), builder.fmul(b, y)), c)
    return builder.fptosi(builder.fmul(_splat(builder, mu), _call(builder, "llvm.fabs.v8f64", _DOUBLES, e)), _WORDS)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


def _as(builder: Any, pointer: Any, kind: Any) -> Any:
    return builder.bitcast(pointer, ir.PointerType(kind))


def _least(builder: Any, keys: Any) -> Any:
    return _call(builder, "llvm.vector.reduce.smin.v8i64", _I64, keys)


WORDS = types.Array(types.uint64, 1, "C")
PAIRS = types.Array(types.int32, 1, "C")
LINES = types.Array(types.float32, 1, "C")
ORDER = 20
"""Bits of a key below the cost: which candidate it was, so that of equal costs the first one wins."""

NOTHING = (1 << 62) - 1
"""Key above every key."""


def make_run(width: int) -> Any:
    """Intrinsic ``run(word, right, start, count, u, v, a, b, c, mu, order)``, see :data:`run`."""

    @intrinsic
    def run(typingctx, word, right, start, count, u, v, a, b, c, mu, order):  # type: ignore[no-untyped-def]
        f32, i64 = types.float32, types.int64
        signature = types.int64(types.uint64, WORDS, i64, i64, i64, i64, f32, f32, f32, types.float64, i64)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            word, right, start, count, u, v, a, b, c, mu, order = args
            steps = _vector(_WORDS, range(LANES))
            inside = builder.icmp_signed("<", steps, _splat(builder, count))
            p = _as(builder, _pointer(context, builder, sig.args[1], right, start), _WORDS)
            # Lanes beyond ``count`` are not read: they may lie behind the image.
            words = _load(builder, p, inside)
            cost = _distances(builder, _splat(builder, word), words, width)
            with_band = builder.fcmp_ordered(">", mu, ir.Constant(ir.DoubleType(), 0.0))
            slot = cgutils.alloca_once_value(builder, cost)
            with builder.if_then(with_band):
                us = builder.add(_splat(builder, builder.trunc(u, _I32)), _vector(_INTS, range(LANES)))
                vs = _splat(builder, builder.trunc(v, _I32))
                builder.store(builder.add(cost, _band(builder, us, vs, (a, b, c), mu)), slot)
            keys = builder.shl(builder.load(slot), _vector(_WORDS, [ORDER] * LANES))
            keys = builder.add(keys, builder.add(_splat(builder, order), steps))
            return _least(builder, builder.select(inside, keys, _vector(_WORDS, [NOTHING] * LANES)))

        return signature, codegen

    return run


def _load(builder: Any, pointer: Any, inside: Any) -> Any:
    """Masked load of eight words."""
    kind = ir.FunctionType(_WORDS, [pointer.type, _I32, _MASK, _WORDS])
    f = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8i64.p0")
    return builder.call(f, [pointer, ir.Constant(_I32, 8), inside, _vector(_WORDS, [0] * LANES)])


run = make_run(widest())
"""``run(word, right, start, count, u, v, a, b, c, mu, order)``: the best of ``count`` <= 8 candidates side by side.

Candidate i is word ``right[start + i]`` at displacement (u + i, v). Returns the least ``cost << ORDER | order + i``.
"""


def make_around(width: int) -> Any:
    """Intrinsic ``around``, see :data:`around`."""

    @intrinsic
    def around(typingctx, word, right, rows, cols, x, y, own, data, up, west, east, down, smooth, a, b, c, mu):  # type: ignore[no-untyped-def]
        f32, i64, i32 = types.float32, types.int64, types.int32
        signature = types.int64(
            types.uint64, WORDS, i64, i64, i64, i64, i32, i64, i32, i32, i32, i32, i64, f32, f32, f32, types.float64
        )

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            word, right, rows, cols, x, y, own, data, up, west, east, down, smooth, a, b, c, mu = args
            halves = ir.VectorType(_I16, 2 * LANES)
            near = [up, west, east, down]
            packed = _splat(builder, own)
            for lane, value in enumerate(near, 4):
                packed = builder.insert_element(packed, value, ir.Constant(_I32, lane))
            mine = _own_roughness(builder, packed, own)
            steps = [-1, 0, 1, 0, 0, -1, 0, 1] + [0] * 8
            tried = builder.add(builder.bitcast(packed, halves), _vector(halves, steps))
            cost = _roughness(builder, tried, near)
            cost = builder.zext(builder.mul(cost, _splat(builder, builder.trunc(smooth, _I32))), _WORDS)
            pairs = builder.bitcast(tried, _INTS)
            sixteen = _vector(_INTS, [16] * LANES)
            u, v = builder.ashr(builder.shl(pairs, sixteen), sixteen), builder.ashr(pairs, sixteen)
            rows, cols, x, y = (_splat(builder, builder.trunc(n, _I32)) for n in (rows, cols, x, y))
            xr, yr = builder.add(x, u), builder.add(y, v)
            # Compared without sign: below zero is beyond the end.
            inside = builder.and_(builder.icmp_unsigned("<", xr, cols), builder.icmp_unsigned("<", yr, rows))
            index = builder.add(builder.mul(yr, cols), xr)
            image = context.make_array(sig.args[1])(context, builder, right).data
            words = _gather(builder, image, index, inside)
            cost = builder.add(cost, _distances(builder, _splat(builder, word), words, width))
            slot = cgutils.alloca_once_value(builder, cost)
            with builder.if_then(builder.fcmp_ordered(">", mu, ir.Constant(ir.DoubleType(), 0.0))):
                builder.store(builder.add(cost, _band(builder, u, v, (a, b, c), mu)), slot)
            keys = builder.shl(builder.load(slot), _vector(_WORDS, [COST] * LANES))
            keys = builder.or_(keys, _vector(_WORDS, [(i + 1) << 32 for i in range(LANES)]))
            keys = builder.or_(keys, builder.zext(pairs, _WORDS))
            best = _least(builder, builder.select(inside, keys, _vector(_WORDS, [NOTHING] * LANES)))
            total = builder.add(data, builder.mul(smooth, builder.zext(mine, _I64)))
            stay = builder.or_(builder.shl(total, ir.Constant(_I64, COST)), builder.zext(own, _I64))
            return builder.select(builder.icmp_signed("<", best, stay), best, stay)

        return signature, codegen

    return around


COST = 36
"""Bits of a key of ``around`` below the cost: four for the order, 32 for the packed displacement."""

TRUNCATION = 2
"""Pixels: beyond this a step to a neighbour costs no more, so that depth edges stay."""


def _roughness(builder: Any, tried: Any, near: list[Any]) -> Any:
    """Sum over the neighbours of min(|du| + |dv|, TRUNCATION), eight 32-bit integers."""
    halves = ir.VectorType(_I16, 2 * LANES)
    low, sixteen = _vector(_INTS, [0xFFFF] * LANES), _vector(_INTS, [16] * LANES)
    most = _vector(_INTS, [TRUNCATION] * LANES)
    total = _vector(_INTS, [0] * LANES)
    no_poison = ir.Constant(ir.IntType(1), 0)
    for n in near:
        d = builder.sub(builder.bitcast(_splat(builder, n), halves), tried)
        size = builder.bitcast(_call(builder, "llvm.abs.v16i16", halves, d, no_poison), _INTS)
        both = builder.add(builder.and_(size, low), builder.lshr(size, sixteen))
        total = builder.add(total, _call(builder, "llvm.umin.v8i32", _INTS, both, most))
    return total


def _own_roughness(builder: Any, packed: Any, own: Any) -> Any:
    """Roughness of a pixel's own displacement, its neighbours being lanes 4 to 7 of ``packed``."""
    four, eight = ir.VectorType(_I32, 4), ir.VectorType(_I16, 8)
    last = ir.Constant(four, [4, 5, 6, 7])
    near = builder.bitcast(builder.shuffle_vector(packed, packed, last), eight)
    d = builder.sub(near, builder.bitcast(_splat(builder, own, 4), eight))
    size = builder.bitcast(_call(builder, "llvm.abs.v8i16", eight, d, ir.Constant(ir.IntType(1), 0)), four)
    both = builder.add(builder.and_(size, _vector(four, [0xFFFF] * 4)), builder.lshr(size, _vector(four, [16] * 4)))
    steps = _call(builder, "llvm.umin.v4i32", four, both, _vector(four, [TRUNCATION] * 4))
    return _call(builder, "llvm.vector.reduce.add.v4i32", _I32, steps)


def _gather(builder: Any, data: Any, index: Any, inside: Any) -> Any:
    """Words at eight indices where ``inside``, else 0."""
    offset = builder.shl(builder.sext(index, _WORDS), _vector(_WORDS, [3] * LANES))
    address = builder.add(_splat(builder, builder.ptrtoint(data, _I64)), offset)
    pointers = builder.inttoptr(address, ir.VectorType(ir.PointerType(), LANES))
    kind = ir.FunctionType(_WORDS, [pointers.type, _I32, _MASK, _WORDS])
    f = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.gather.v8i64.v8p0")
    return builder.call(f, [pointers, ir.Constant(_I32, 8), inside, _vector(_WORDS, [0] * LANES)])


around = make_around(widest())
"""``around(word, right, rows, cols, x, y, own, data, up, west, east, down, smooth, a, b, c, mu)``: the best
displacement among a pixel's own, that +-1, and those of its four neighbours, in the image ``right`` (rows x cols).

Displacements are packed, v << 16 | u; ``data`` is the cost of ``own`` without smoothness. In this order: own, own
u - 1, u + 1, v - 1, v + 1, up, west, east, down; the first of equal ones wins. Costs have ``smooth`` times the
roughness added. Returns ``cost << COST | order << 32 | packed``.
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
            found = []
            for others in (rights[1:6], wests, easts, rights[:5], rights[2:]):
                total = _vector(_WORDS, [0] * LANES)
                for p, q in zip(lefts, others, strict=True):
                    total = builder.add(total, _distances(builder, p, q, width))
                found.append(_call(builder, "llvm.vector.reduce.add.v8i64", _I64, total))
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
_SLOPE = (_CUBIC[1], (2.0, -5.0, 4.0, -1.0), (-1.5, 4.5, -4.5, 1.5))
"""Of their derivatives: coefficients of 1, t, t^2."""

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
    """Catmull-Rom value and gradient (x, y) of a flat float32 image of ``width`` columns.

    ``at``: index of the pixel above and left of the point's own; ``t, s``: the point's distance right of and below it,
    within a pixel. 4 x 4 pixels from ``at - width - 1`` on are read.
    """
    f32, i64 = types.float32, types.int64
    signature = types.UniTuple(f32, 3)(GREY, i64, i64, f32, f32)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        image, at, width, t, s = args
        across, down = _splat(builder, t, 4), _splat(builder, s, 4)
        start = builder.sub(builder.sub(at, width), ir.Constant(_I64, 1))
        weights, slopes = _polynomial(builder, _CUBIC, down), _polynomial(builder, _SLOPE, down)
        column = gradient = ir.Constant(_FLOATS, [0.0] * 4)
        for k in range(4):
            pointer = _as(builder, _pointer(context, builder, sig.args[0], image, start), _FLOATS)
            row = builder.load(pointer, align=4)
            each = ir.Constant(ir.VectorType(_I32, 4), [k] * 4)
            column = builder.fadd(column, builder.fmul(builder.shuffle_vector(weights, weights, each), row))
            gradient = builder.fadd(gradient, builder.fmul(builder.shuffle_vector(slopes, slopes, each), row))
            start = builder.add(start, width)
        w = _polynomial(builder, _CUBIC, across)
        found = [_dot(builder, w, column), _dot(builder, _polynomial(builder, _SLOPE, across), column)]
        return context.make_tuple(builder, sig.return_type, [*found, _dot(builder, w, gradient)])

    return signature, codegen
