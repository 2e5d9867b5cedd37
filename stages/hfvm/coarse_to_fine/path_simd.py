"""Vector code of the propagation along paths: a pixel's eight candidates side by side (numba intrinsics).

Costs and displacements are 16-bit integers, so that eight of them fill a 128-bit register, which every processor has.
Additions saturate, hence :data:`NONE` plus anything is NONE. The code is generic vector code; only feature distances
use what ``lanes`` knows of the processor.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rille.stages.hfvm.level import simd

MOST = 8
"""Candidates a pixel; further ones are left out. Sixteen cost twice the time and change bad-2 by less than .002."""

NONE = 32767
"""Cost where there is no candidate."""

UNIT = 4
"""Cost of a byte step of Table 1's features, so that weaker ones can be weighed as integers."""

OUTSIDE = 8000
"""Cost of a candidate that leads out of the other image: about that of unlike pixels, so that neighbours decide."""

OWN = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
"""Rows and columns added to a pixel's own displacement."""

NOWHERE = -0x7FFF8000
"""A packed displacement that no pixel has: -32768 in both directions."""

_I16, _I32, _I64 = (ir.IntType(n) for n in (16, 32, 64))
_SHORTS, _INTS = ir.VectorType(_I16, MOST), ir.VectorType(_I32, MOST)

WORDS = types.Array(types.uint64, 1, "C")
PACKED = types.Array(types.int32, 1, "C")
PLACES = types.Array(types.int64, 1, "C")
SHORTS = types.Array(types.int16, 1, "C")
TOTALS = types.Array(types.int32, 1, "C")


def _all(kind: Any, value: int) -> Any:
    return ir.Constant(kind, [value] * kind.count)


def _at(context: Any, builder: Any, kind: Any, array: Any, index: Any, as_kind: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), ir.PointerType(as_kind))


def _costs(context: Any, builder: Any, sig: Any, views: Any, place: Any, found: Any) -> Any:
    """Costs (eight 32-bit integers) of eight packed displacements ``found``, before those of lines and absence."""
    left, right, near, right_near, share = views
    rows, cols, x, y, at = place
    sixteen = _all(found.type, 16)
    u, v = builder.ashr(builder.shl(found, sixteen), sixteen), builder.ashr(found, sixteen)
    splat = simd._splat
    rows, cols, x, y = (splat(builder, builder.trunc(n, _I32)) for n in (rows, cols, x, y))
    xr, yr = builder.add(x, u), builder.add(y, v)
    inside = builder.and_(builder.icmp_unsigned("<", xr, cols), builder.icmp_unsigned("<", yr, rows))
    index = builder.add(builder.mul(yr, cols), xr)
    total = None
    for (here, there), kinds, factor in (
        ((left, right), sig.args[:2], ir.Constant(_I64, UNIT)),
        ((near, right_near), sig.args[2:4], share),
    ):
        word = builder.load(_at(context, builder, kinds[0], here, at, _I64))
        data = context.make_array(kinds[1])(context, builder, there).data
        words = simd._gather(builder, data, index, simd._WORDS, inside)
        d = simd._distances(builder, splat(builder, word), words, simd.widest())
        d = builder.mul(d, splat(builder, factor))
        total = d if total is None else builder.add(total, d)
    total = builder.trunc(total, found.type)
    return builder.select(inside, total, _all(found.type, OUTSIDE)), u, v


def _band(builder: Any, u: Any, v: Any, line: Any, mu: Any) -> Any:
    """trunc(mu |a u + b v + c|) as eight 64-bit integers; ``u, v`` vectors of 32-bit integers."""
    doubles = ir.VectorType(ir.DoubleType(), MOST)
    a, b, c = (simd._splat(builder, builder.fpext(x, ir.DoubleType())) for x in line)
    x, y = builder.sitofp(u, doubles), builder.sitofp(v, doubles)
    e = builder.fadd(builder.fadd(builder.fmul(a, x), builder.fmul(b, y)), c)
    size = simd._call(builder, f"llvm.fabs.v{MOST}f64", doubles, e)
    return builder.fptosi(builder.fmul(simd._splat(builder, mu), size), ir.VectorType(_I64, MOST))


@intrinsic
def gather(  # type: ignore[no-untyped-def]
    typingctx, left, right, near, right_near, share, rows, cols, x, y, at, maps, up, places, a, b, c, mu, cu, cv, cost
):
    """Candidates of one pixel, and what each costs by itself; written to ``cu, cv, cost`` (MOST values).

    Candidates in this order, each once: the pixel's own displacement, :data:`OWN` steps from it, those of ``maps`` at
    ``places[:12]``, those of ``up`` at ``places[12:]``; all but the first must lead into the right image (rows x cols).
    ``maps``, ``up``: packed displacements, v << 16 | u. ``at``: index of the pixel in the left image and in ``maps``.
    """
    i64, f32 = types.int64, types.float32
    signature = types.void(
        WORDS, WORDS, WORDS, WORDS, i64, i64, i64, i64, i64, i64, PACKED, PACKED, PLACES, f32, f32, f32, types.float64,
        SHORTS, SHORTS, SHORTS,
    )  # fmt: skip

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        (left, right, near, right_near, share, rows, cols, x, y, at, maps, up, places, a, b, c, mu, cu, cv, cost) = args
        own = builder.load(_at(context, builder, sig.args[10], maps, at, _I32))
        low, high = ir.Constant(_I32, 0xFFFF), ir.Constant(_I32, -0x10000)
        values = []
        for j, i in OWN:
            u = builder.and_(builder.add(own, ir.Constant(_I32, i)), low)
            v = builder.and_(builder.add(own, ir.Constant(_I32, j * 0x10000)), high)
            values.append(builder.or_(u, v))
        for kind, array, first, last in ((sig.args[10], maps, 0, 12), (sig.args[11], up, 12, 21)):
            for k in range(first, last):
                place = builder.load(_at(context, builder, sig.args[12], places, ir.Constant(_I64, k), _I64))
                values.append(builder.load(_at(context, builder, kind, array, place, _I32)))
        lane = ir.Constant(_INTS, list(range(MOST)))
        found, count = _all(_INTS, NOWHERE), ir.Constant(_I32, 0)
        rows32, cols32, x32, y32 = (builder.trunc(n, _I32) for n in (rows, cols, x, y))
        sixteen = ir.Constant(_I32, 16)
        for k, value in enumerate(values):
            all_of_it = simd._splat(builder, value, MOST)
            wanted = ir.Constant(ir.IntType(1), 1)
            if k:
                u = builder.ashr(builder.shl(value, sixteen), sixteen)
                v = builder.ashr(value, sixteen)
                wanted = builder.and_(
                    builder.icmp_unsigned("<", builder.add(x32, u), cols32),
                    builder.icmp_unsigned("<", builder.add(y32, v), rows32),
                )
                equal = builder.icmp_signed("==", found, all_of_it)
                same = builder.bitcast(equal, ir.IntType(MOST))
                wanted = builder.and_(wanted, builder.icmp_signed("==", same, ir.Constant(ir.IntType(MOST), 0)))
            slot = builder.select(wanted, count, ir.Constant(_I32, MOST))
            here = builder.icmp_signed("==", lane, simd._splat(builder, slot, MOST))
            found = builder.select(here, all_of_it, found)
            count = builder.add(count, builder.zext(wanted, _I32))
        views, place = (left, right, near, right_near, share), (rows, cols, x, y, at)
        with_band = builder.fcmp_ordered(">", mu, ir.Constant(ir.DoubleType(), 0.0))
        total, u, v = _costs(context, builder, sig, views, place, found)
        slot = cgutils.alloca_once_value(builder, total)
        with builder.if_then(with_band):
            more = builder.trunc(_band(builder, u, v, (a, b, c), mu), total.type)
            builder.store(builder.add(total, more), slot)
        most = _all(_INTS, 2 * OUTSIDE)
        total = simd._call(builder, f"llvm.smin.v{MOST}i32", _INTS, builder.load(slot), most)
        there = builder.icmp_signed("<", lane, simd._splat(builder, count, MOST))
        total = builder.select(there, total, _all(_INTS, NONE))
        zero = ir.Constant(_I64, 0)
        for array, kind, value in (
            (cu, sig.args[17], u),
            (cv, sig.args[18], v),
            (cost, sig.args[19], total),
        ):
            pointer = _at(context, builder, kind, array, zero, _SHORTS)
            builder.store(builder.trunc(value, _SHORTS), pointer, align=2)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def step(typingctx, cu, cv, cost, path, there, out, here, total, at, small, far):  # type: ignore[no-untyped-def]
    """One step of one direction: costs of getting to the candidates of a pixel from those of the pixel before.

    ``cu, cv, cost`` hold the candidates of all pixels; ``at`` and ``there`` are where those of the pixel and of the
    pixel before begin. ``path``, at ``path[0]``: costs of the latter, none below 0. Candidate k costs

        cost[k] + min over m (path[m] + min(small * |difference of k and m|, far)) - min over m path[m]

    which is written to ``out[here:]`` and added to ``total[at:]``.
    """
    i64 = types.int64
    signature = types.void(SHORTS, SHORTS, SHORTS, SHORTS, i64, SHORTS, i64, TOTALS, i64, i64, i64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        cu, cv, cost, path, there, out, here, total, at, small, far = args

        def load(kind: Any, array: Any, index: Any, vector: Any) -> Any:
            return builder.load(_at(context, builder, kind, array, index, vector), align=2)

        def call(name: str, *operands: Any) -> Any:
            return simd._call(builder, f"llvm.{name}.v{MOST}i16", _SHORTS, *operands)

        zero = ir.Constant(_I64, 0)
        u, v, own = (load(kind, array, at, _SHORTS) for kind, array in zip(sig.args[:3], (cu, cv, cost), strict=True))
        before = load(sig.args[3], path, zero, _SHORTS)
        least = simd._call(builder, f"llvm.vector.reduce.smin.v{MOST}i16", _I16, before)
        far16, small16 = builder.trunc(far, _I16), builder.trunc(small, _I16)
        most = simd._splat(builder, far16, MOST)
        # Beyond this many pixels the difference costs the most anyway, and the product would not fit.
        reach = builder.trunc(builder.add(builder.sdiv(far, small), ir.Constant(_I64, 1)), _I16)
        reach, cost_of_one = simd._splat(builder, reach, MOST), simd._splat(builder, small16, MOST)
        best = call("sadd.sat", simd._splat(builder, least, MOST), most)
        no_poison = ir.Constant(ir.IntType(1), 0)
        for m in range(MOST):
            k = ir.Constant(_I64, m)
            gap = None
            for kind, array, mine in ((sig.args[0], cu, u), (sig.args[1], cv, v)):
                one = builder.load(_at(context, builder, kind, array, builder.add(there, k), _I16))
                part = call("ssub.sat", simd._splat(builder, one, MOST), mine)
                part = simd._call(builder, f"llvm.abs.v{MOST}i16", _SHORTS, part, no_poison)
                gap = part if gap is None else call("umin", call("uadd.sat", gap, part), reach)
            way = call("smin", builder.mul(gap, cost_of_one), most)
            so_far = builder.load(_at(context, builder, sig.args[3], path, k, _I16))
            best = call("smin", best, call("sadd.sat", simd._splat(builder, so_far, MOST), way))
        best = builder.sub(best, simd._splat(builder, least, MOST))
        result = call("sadd.sat", own, best)
        builder.store(result, _at(context, builder, sig.args[5], out, here, _SHORTS), align=2)
        pointer = _at(context, builder, sig.args[7], total, at, _INTS)
        builder.store(builder.add(builder.load(pointer, align=4), builder.sext(result, _INTS)), pointer, align=4)
        return context.get_dummy_value()

    return signature, codegen
