"""The native solver: whole loops in C, called through ctypes, which releases Python's lock meanwhile."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import POINTER, Structure, c_double, c_float, c_int32, c_int64, c_void_p
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.native import build
from rille.stages.hfvm.native.problem import CANDIDATES, Candidates, EdgeRule, Field, LevelPair, PathCosts, Smoothing

LANES = 8
"""Pixels that the C code looks at together: lists of a row have as much room beyond their end."""


class _Image(Structure):
    _fields_ = (("words", c_void_p), ("rows", c_int32), ("cols", c_int32))


class _Band(Structure):
    _fields_ = (("f", c_double * 9), ("cost", c_double))


class _Pair(Structure):
    _fields_ = (
        *(("left", _Image), ("right", _Image), ("band", _Band)),
        *((name, c_int32) for name in ("x0", "y0", "ahead_x", "ahead_y")),
    )


class _Shift(Structure):
    _fields_ = (("u", c_int32), ("v", c_int32))


class _Field(Structure):
    _fields_ = (("shift", c_void_p), ("cost", c_void_p))


class _Fine(Structure):
    _fields_ = (("u", c_void_p), ("v", c_void_p), ("distance", c_void_p))


class _Parents(Structure):
    _fields_ = (("u", c_void_p), ("v", c_void_p), ("rows", c_int32), ("cols", c_int32))


class _Smoothing(Structure):
    _fields_ = (("smoothness", c_int32), ("beside", c_int32))


class _EdgeRule(Structure):
    _fields_ = tuple((name, c_int32) for name in EdgeRule._fields)


class _PathCosts(Structure):
    _fields_ = (("compact", c_int32), ("small", c_int32), ("large", c_int32), ("grey", c_float))


_ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "search": (POINTER(_Pair), POINTER(_Parents), _Shift, _Field, c_void_p),
    "propagate": (POINTER(_Pair), _Field, _Smoothing, c_int32, c_void_p, c_void_p),
    "sums": (POINTER(_Pair), c_void_p, c_void_p, c_void_p, _Fine),
    "edges": (POINTER(_Pair), c_void_p, c_void_p, c_void_p, POINTER(_EdgeRule), c_void_p),
    "candidates": (POINTER(_Pair), POINTER(c_void_p * 2), c_void_p, POINTER(_Parents), _PathCosts, _Field),
    "sweep": (c_int32, c_int32, _Field, c_void_p, _PathCosts, c_int32, c_void_p, c_void_p),
    "choose": (_Field, c_void_p, c_int64, c_void_p),
}


def _at(array: AnyArray, kind: DTypeLike, shape: tuple[int, ...] | None = None) -> int:
    """Address of an array's first number; refuses what C would read wrongly."""
    if array.dtype != kind or not array.flags.c_contiguous or (shape is not None and array.shape != shape):
        raise TypeError(
            f"an array of {array.dtype} {array.shape} instead of {np.dtype(kind)} {shape}, in order of rows"
        )
    return int(array.ctypes.data)


def _pair(pair: LevelPair) -> _Pair:
    images = [_Image(_at(words, np.uint64), *words.shape) for words in (pair.left, pair.right)]
    band = _Band((c_double * 9)(*np.asarray(pair.f, np.float64).ravel()), pair.mu)
    return _Pair(*images, band, pair.x0, pair.y0, pair.ahead_x, pair.ahead_y)


def _parents(up: tuple[AnyArray, AnyArray] | None) -> _Parents:
    if up is None:
        return _Parents(None, None, 0, 0)
    return _Parents(*(_at(array, np.int16, up[0].shape) for array in up), *up[0].shape)


def _field(field: Field, pair: LevelPair) -> _Field:
    return _Field(*(_at(array, np.int32, pair.left.shape) for array in field))


def _listed(listed: Candidates) -> _Field:
    return _Field(_at(listed.shift, np.int32), _at(listed.cost, np.int16, listed.shift.shape))


class Library:
    """The solver of :mod:`rille.stages.hfvm.native.reference`, function by function, in C."""

    def __init__(self, path: str, variant: str | None = None) -> None:
        """Load a binary; ``variant``: at most this instruction set (a suffix), None: the best of the processor."""
        library = ctypes.CDLL(path)
        usable = list(build.VARIANTS)[: library.supported() + 1]
        if variant in usable:
            usable = usable[: usable.index(variant) + 1]
        self.variant = [suffix for suffix in usable if hasattr(library, f"search{suffix}")][-1]
        for name, arguments in _ARGUMENTS.items():
            function: Callable[..., None] = getattr(library, f"{name}{self.variant}")
            function.argtypes, function.restype = arguments, None  # type: ignore[attr-defined]
            setattr(self, f"_{name}", function)

    def _call(self, name: str, *arguments: Any) -> None:
        getattr(self, f"_{name}")(*arguments)

    def search(self, pair: LevelPair, up: tuple[AnyArray, AnyArray], reach: tuple[int, int], out: Field) -> None:
        """Write the best displacements around those of the coarser level, see ``reference.search``."""
        room = np.empty((up[0].shape[0] + 2, up[0].shape[1] + 2), np.int32)
        self._call("search", _pair(pair), _parents(up), _Shift(*reach), _field(out, pair), room.ctypes.data)

    def propagate(self, pair: LevelPair, field: Field, smoothing: Smoothing) -> None:
        """Improve displacements in place by those of the neighbours, see ``reference.propagate``."""
        dirty = np.empty(pair.left.shape, np.uint8)
        room = np.empty(3 * (pair.left.shape[1] + LANES), np.int32)
        how = _Smoothing(smoothing.smoothness, smoothing.beside)
        given = _field(field, pair), how, smoothing.rounds, dirty.ctypes.data, room.ctypes.data
        self._call("propagate", _pair(pair), *given)

    def sums(self, pair: LevelPair, u: AnyArray, v: AnyArray, wanted: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Displacements with fractions of a pixel, and distances, see ``reference.sums``."""
        shape = pair.left.shape
        out = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
        given = _at(u, np.int16, shape), _at(v, np.int16, shape), _at(wanted, np.uint8, shape)
        self._call("sums", _pair(pair), *given, _Fine(*(array.ctypes.data for array in out)))
        return out

    def edges(self, pair: LevelPair, grey: AnyArray, shift: AnyArray, wanted: AnyArray, rule: EdgeRule) -> AnyArray:
        """Displacements with depth edges placed anew, see ``reference.edges``."""
        shape, out = pair.left.shape, shift.copy()
        given = _at(grey, np.int16, shape), _at(shift, np.int32, shape), _at(wanted, np.uint8, shape)
        self._call("edges", _pair(pair), *given, _EdgeRule(*rule), out.ctypes.data)
        return out

    def candidates(
        self,
        pair: LevelPair,
        compact: tuple[AnyArray, AnyArray],
        shift: AnyArray,
        up: tuple[AnyArray, AnyArray] | None,
        costs: PathCosts,
    ) -> Candidates:
        """Candidates of each pixel and their costs, see ``reference.candidates``."""
        shape = pair.left.shape
        listed = Candidates(np.empty((*shape, CANDIDATES), np.int32), np.empty((*shape, CANDIDATES), np.int16))
        words = (c_void_p * 2)(_at(compact[0], np.uint64, shape), _at(compact[1], np.uint64, pair.right.shape))
        given = _at(shift, np.int32, shape), _parents(up), _PathCosts(*costs), _listed(listed)
        self._call("candidates", _pair(pair), words, *given)
        return listed

    def sweep(self, listed: Candidates, grey: AnyArray, costs: PathCosts, backward: bool, total: AnyArray) -> None:
        """Add the costs along three directions to ``total``, see ``reference.sweep``."""
        rows, cols, _ = listed.cost.shape
        room = np.empty(6 * cols * CANDIDATES, np.int32)
        given = (
            _at(grey, np.float32, (rows, cols)),
            _PathCosts(*costs),
            backward,
            _at(total, np.int32, listed.cost.shape),
        )
        self._call("sweep", rows, cols, _listed(listed), *given, room.ctypes.data)

    def choose(self, listed: Candidates, total: AnyArray, shift: AnyArray) -> None:
        """Write the candidates of least total to ``shift``, see ``reference.choose``."""
        given = _at(total, np.int32, listed.cost.shape), shift.size, _at(shift, np.int32, listed.cost.shape[:2])
        self._call("choose", _listed(listed), *given)
