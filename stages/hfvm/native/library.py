"""The native solver: whole loops in C, called through ctypes, which releases Python's lock meanwhile."""

from __future__ import annotations

import ctypes
from ctypes import Structure, byref, c_double, c_int32, c_void_p

import numpy as np
from numpy.typing import DTypeLike

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.native import build
from rille.stages.hfvm.native.problem import CANDIDATES, Field, LevelPair, Map, Smoothing


class _Pair(Structure):
    _fields_ = (
        *(("left", c_void_p), ("left_shape", 2 * c_int32), ("right", c_void_p), ("right_shape", 2 * c_int32)),
        *(("f", 9 * c_double), ("mu", c_double)),
    )


def _at(array: AnyArray, kind: DTypeLike) -> c_void_p:
    """Address of an array's first number; refuses what C would read wrongly."""
    if array.dtype != kind or not array.flags.c_contiguous:
        raise TypeError(f"an array of {array.dtype} {array.shape} instead of {np.dtype(kind)}, in order of rows")
    return c_void_p(array.ctypes.data)


def _pair(pair: LevelPair) -> _Pair:
    images = [part for words in (pair.left, pair.right) for part in (_at(words, np.uint64), words.shape)]
    return _Pair(*images, (9 * c_double)(*np.asarray(pair.f, np.float64).ravel()), pair.mu)


class Library:
    """The solver of :mod:`rille.stages.hfvm.native.reference`, function by function, in C."""

    def __init__(self, path: str, variant: str | None = None) -> None:
        """Load a binary; ``variant``: at most this instruction set (a suffix), None: the best of the processor."""
        self._library = ctypes.CDLL(path)
        usable = list(build.VARIANTS)[: self._library.supported() + 1]
        if variant in usable:
            usable = usable[: usable.index(variant) + 1]
        self.variant = [suffix for suffix in usable if hasattr(self._library, f"search{suffix}")][-1]

    def _call(self, name: str, pair: LevelPair, *arguments: object) -> None:
        """Call a function; structures are given by reference."""
        given = [byref(a) if isinstance(a, Structure) else a for a in (_pair(pair), *arguments)]
        getattr(self._library, f"{name}{self.variant}")(*given)

    def search(self, pair: LevelPair, up: Map, reach: tuple[int, int], out: Field) -> None:
        """Write the best displacements around those of the coarser level, see ``reference.search``."""
        room = np.empty(up.u.shape, np.int32)
        above, here = [_at(a, np.int16) for a in up], [_at(a, np.int32) for a in (*out, room)]
        self._call("search", pair, *above, (2 * c_int32)(*reach), *here)

    def propagate(self, pair: LevelPair, field: Field, smoothing: Smoothing) -> None:
        """Improve displacements in place by those of the neighbours, see ``reference.propagate``."""
        dirty = np.zeros(pair.left.shape, np.uint8)
        # The C code looks at eight pixels together, also beyond the end of a row's lists.
        room = np.empty(3 * (pair.left.shape[1] + 8), np.int32)
        here, work = [_at(a, np.int32) for a in field], (_at(dirty, np.uint8), _at(room, np.int32))
        self._call("propagate", pair, *here, (3 * c_int32)(*smoothing), *work)

    def sums(self, pair: LevelPair, u: AnyArray, v: AnyArray, wanted: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Displacements with fractions of a pixel, and distances, see ``reference.sums``."""
        fine_u, fine_v, distance = (np.empty(pair.left.shape, np.float32) for _ in range(3))
        out = [_at(a, np.float32) for a in (fine_u, fine_v, distance)]
        self._call("sums", pair, _at(u, np.int16), _at(v, np.int16), _at(wanted, np.uint8), *out)
        return fine_u, fine_v, distance

    def edges(self, pair: LevelPair, grey: AnyArray, shift: AnyArray, wanted: AnyArray, near_sign: int) -> AnyArray:
        """Displacements with depth edges placed anew, see ``reference.edges``."""
        out = shift.copy()
        given = _at(grey, np.int16), _at(shift, np.int32), _at(wanted, np.uint8)
        self._call("edges", pair, *given, c_int32(near_sign), _at(out, np.int32))
        return out

    def paths(self, pair: LevelPair, compact: LevelPair, up: AnyArray, grey: AnyArray, shift: AnyArray) -> None:
        """Write the displacements of least cost along paths, see ``reference.paths``."""
        # Three numbers of 32 bits a candidate, and six rows of one; vectors begin at multiples of 32 bytes.
        room = np.empty(4 * CANDIDATES * (3 * shift.size + 6 * shift.shape[1]) + 32, np.uint8)
        room = room[-room.ctypes.data % 32 :]
        given = _at(grey, np.float32), _at(shift, np.int32), _at(room, np.uint8)
        self._call("paths", pair, _pair(compact), _at(up, np.int32), c_int32(up.shape[1]), *given)
