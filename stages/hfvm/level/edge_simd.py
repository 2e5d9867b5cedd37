"""Vector code of the placement of depth edges: what a candidate costs, a row of the window at once (numba intrinsic).

A row of a window is seven words that follow each other in both images: two loads, one ``psadbw``.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rille.stages.hfvm.level import simd
from rille.stages.hfvm.level.simd import LANES

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_SHORTS, _INTS = (ir.VectorType(ir.IntType(n), LANES) for n in (16, 32))
GREYS = types.Array(types.int16, 1, "C")


def make_window_cost(width: int, side: int, bright: int, far: int) -> Any:
    """Intrinsic ``window_cost``, see :data:`rille.stages.hfvm.level.depth_edges.window_cost`."""

    @intrinsic
    def window_cost(typingctx, words, grey, first, columns):  # type: ignore[no-untyped-def]
        two = types.UniTuple(types.int64, 2)
        signature = types.int64(types.UniTuple(simd.WORDS, 2), GREYS, two, two)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            words, first, columns = (cgutils.unpack_tuple(builder, args[k]) for k in (0, 2, 3))
            inside = ir.Constant(simd._MASK, [lane < side for lane in range(LANES)])

            def place(kind: Any, array: Any, k: int, j: int, i: int = 0) -> Any:
                at = builder.add(first[k], builder.mul(columns[k], ir.Constant(_I64, j)))
                return simd._pointer(context, builder, kind, array, builder.add(at, ir.Constant(_I64, i)))

            def shorts(value: int) -> Any:
                return simd._vector(_SHORTS, [value] * LANES)

            def call(name: str, *given: Any) -> Any:
                return simd._call(builder, f"llvm.{name}.v8i16", _SHORTS, *given)

            own = simd._splat(builder, builder.load(place(GREYS, args[1], 0, side // 2, side // 2)))
            total = shorts(0)
            for j in range(side):
                pointers = (simd._as(builder, place(simd.WORDS, words[k], k, j), simd._WORDS) for k in (0, 1))
                # The eighth word is read as zero in both images, and so differs by nothing.
                here, there = (simd._load(builder, pointer, inside) for pointer in pointers)
                differ = builder.trunc(simd._distances(builder, here, there, width), _SHORTS)
                grey = builder.load(simd._as(builder, place(GREYS, args[1], 0, j), _SHORTS), align=2)
                unlike = call("abs", builder.sub(grey, own), ir.Constant(ir.IntType(1), 0))
                weight = call("smax", builder.sub(shorts(bright), unlike), shorts(0))
                # Sums of a column's products have no more than 16 bits.
                total = builder.add(total, builder.mul(call("umin", differ, shorts(far)), weight))
            wide = builder.zext(total, _INTS)
            return builder.zext(simd._call(builder, "llvm.vector.reduce.add.v8i32", _I32, wide), _I64)

        return signature, codegen

    return window_cost
