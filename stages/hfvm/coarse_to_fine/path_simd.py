"""Vector code of the propagation along paths: a pixel's eight candidates side by side (a numba intrinsic).

Costs and displacements are 16-bit integers, so that eight of them fill a 128-bit register, which every processor has.
Additions saturate, hence :data:`NONE` plus anything is NONE. Plain loops take five times as long in float32 and twenty
times in integers: numba widens 16-bit integers, and the compiler then finds no vectors.
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

_I16, _I32, _I64 = (ir.IntType(n) for n in (16, 32, 64))
_SHORTS, _INTS = ir.VectorType(_I16, MOST), ir.VectorType(_I32, MOST)

SHORTS = types.Array(types.int16, 1, "C")
TOTALS = types.Array(types.int32, 1, "C")


def _at(context: Any, builder: Any, kind: Any, array: Any, index: Any, as_kind: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), ir.PointerType(as_kind))


@intrinsic
def step(typingctx, candidates, places, path, out, total, penalty):  # type: ignore[no-untyped-def]
    """One step of one direction: costs of getting to the candidates of a pixel from those of the pixel before.

    ``candidates``: column and row displacements and costs of those of all pixels; ``places``: where those of the pixel
    (``at``) and of the pixel before begin. ``path``: costs of the latter, none below 0. ``penalty``: (small, far).
    Candidate k costs

        cost[k] + min over m (path[m] + min(small * |difference of k and m|, far)) - min over m path[m]

    which is written to ``out`` and added to ``total[at:]``.
    """
    i64 = types.int64
    three, two = types.UniTuple(SHORTS, 3), types.UniTuple(i64, 2)
    signature = types.void(three, two, SHORTS, SHORTS, TOTALS, two)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        candidates, places, path, out, total, penalty = args
        cu, cv, cost = cgutils.unpack_tuple(builder, candidates)
        (at, there), (small, far) = (cgutils.unpack_tuple(builder, given) for given in (places, penalty))

        def load(kind: Any, array: Any, index: Any, vector: Any) -> Any:
            return builder.load(_at(context, builder, kind, array, index, vector), align=2)

        def call(name: str, *operands: Any) -> Any:
            return simd._call(builder, f"llvm.{name}.v{MOST}i16", _SHORTS, *operands)

        zero = ir.Constant(_I64, 0)
        u, v, own = (load(SHORTS, array, at, _SHORTS) for array in (cu, cv, cost))
        before = load(SHORTS, path, zero, _SHORTS)
        least = simd._call(builder, f"llvm.vector.reduce.smin.v{MOST}i16", _I16, before)
        far16, small16 = builder.trunc(far, _I16), builder.trunc(small, _I16)
        most = simd._splat(builder, far16, MOST)
        # Beyond this many pixels the difference costs the most anyway, and the product would not fit.
        reach = builder.trunc(builder.add(builder.sdiv(far, small), ir.Constant(_I64, 1)), _I16)
        reach, cost_of_one = simd._splat(builder, reach, MOST), simd._splat(builder, small16, MOST)
        # From the cheapest candidate before, any other is reached at the greatest cost.
        best = call("sadd.sat", simd._splat(builder, least, MOST), most)
        no_poison = ir.Constant(ir.IntType(1), 0)
        for m in range(MOST):
            k = ir.Constant(_I64, m)
            gap = None
            for array, mine in ((cu, u), (cv, v)):
                one = builder.load(_at(context, builder, SHORTS, array, builder.add(there, k), _I16))
                # Saturating: two displacements of opposite sign may differ by more than 16 bits hold.
                part = call("ssub.sat", simd._splat(builder, one, MOST), mine)
                part = simd._call(builder, f"llvm.abs.v{MOST}i16", _SHORTS, part, no_poison)
                gap = part if gap is None else call("umin", call("uadd.sat", gap, part), reach)
            way = call("smin", builder.mul(gap, cost_of_one), most)
            so_far = builder.load(_at(context, builder, SHORTS, path, k, _I16))
            best = call("smin", best, call("sadd.sat", simd._splat(builder, so_far, MOST), way))
        # Less the least, so that costs do not grow along the path and 16 bits go on holding them.
        best = builder.sub(best, simd._splat(builder, least, MOST))
        result = call("sadd.sat", own, best)
        builder.store(result, _at(context, builder, SHORTS, out, zero, _SHORTS), align=2)
        pointer = _at(context, builder, TOTALS, total, at, _INTS)
        # In 32 bits: the sum of six directions does not fit into 16.
        builder.store(builder.add(builder.load(pointer, align=4), builder.sext(result, _INTS)), pointer, align=4)
        return context.get_dummy_value()

    return signature, codegen
