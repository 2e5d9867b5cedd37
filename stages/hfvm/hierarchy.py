"""Coarse-to-fine driver (paper, 4.3.4), generic over the one-level solver.

Top level: null prediction, large search. At each level: match left to right and right to left, median-filter both,
back-match, interpolate what failed, and hand the doubled map down as search centres. Between levels the epipolar band
is fitted anew to the consistent matches, where the solver uses one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stages import features
from stages.declare import AnyArray
from stages.hfvm import consistency, epipolar, lanes, lookup, paper, propagation, search, subpixel
from stages.hfvm.params import HfvmParams
from stages.pyramid import Pyramid, filled

SUM_RADIUS = 2
"""Pixels: sub-pixel distances are summed over 5 x 5."""

FIT_SAMPLES = 1000
"""Matches that a band or plane is fitted to; more change nothing that matters and cost time."""


@dataclass(frozen=True)
class Map:
    """Displacements of one direction at one level: int16 columns and rows; bool, where nothing was matchable."""

    u: AnyArray
    v: AnyArray
    undefined: NDArray[np.bool_]


@dataclass(frozen=True)
class Fine:
    """Sub-pixel displacements, float32 pixels, and feature distance (-1: outside)."""

    u: AnyArray
    v: AnyArray
    distance: AnyArray


@dataclass(frozen=True)
class Band:
    """Soft epipolar band of one level: fundamental matrix and cost per pixel off the line (0 = none)."""

    f: epipolar.Matrix
    mu: float

    def lines(self, shape: tuple[int, ...]) -> AnyArray:
        """Line of every pixel, nothing where there is no band."""
        return epipolar.lines(self.f, shape if self.mu > 0 else (1, 1))

    def reverse(self) -> Band:
        """The band of the right image."""
        return Band(np.ascontiguousarray(self.f.T), self.mu)


FREE = Band(epipolar.NO_BAND, 0.0)


class Solver(Protocol):
    """One-level matcher of a pyramid onto another one; ``match`` with ``up`` None is the top level."""

    @property
    def uses_band(self) -> bool:
        """Whether ``match`` heeds the band."""

    def match(self, level: int, up: Map | None, band: Band) -> Map:
        """Integer map of a level from the filled map of the level above."""

    def fine(self, level: int, m: Map, wanted: AnyArray) -> Fine:
        """Sub-pixel map where ``wanted`` is not zero."""

    def reverse(self) -> Solver:
        """The matcher from right to left."""


ROOM = (("packed", np.int32), ("data", np.int32), ("dirty", np.uint8))


@dataclass(frozen=True)
class FastSolver:
    """Packed features, several centres, band, propagation (preset ``default``)."""

    left: Sequence[features.Words]
    right: Sequence[features.Words]
    params: HfvmParams
    uses_band: bool = True
    back: bool = False
    room: dict[str, AnyArray] = field(default_factory=dict)

    def match(self, level: int, up: Map | None, band: Band) -> Map:
        """Integer map of a level."""
        p, a, b = self.params, self.left[level], self.right[level]
        u, v = np.zeros(a.shape, np.int16), np.zeros(a.shape, np.int16)
        packed, data, dirty = (self._room(name, a.shape, kind) for name, kind in ROOM)
        lines, mu = self._room("lines", (3, *a.shape), np.float32), np.float32(band.mu)
        epipolar.write_lines(band.f, lines)
        if up is None:
            reach_x, reach_y = top_reach(p, a.shape, b.shape)
            search.exhaustive(a, b, reach_x, reach_y, 1, u, v)
            propagation.pack_map(u, v, packed)
            data[:] = lanes.FAR
        else:
            propagation.descend(a, b, up.u, up.v, p.search_columns, p.search_rows, p.centres, lines, mu, packed, data)
        rounds = p.rounds if level > 0 or p.fine_rounds is None else p.fine_rounds
        if level == 0 and self.back:
            rounds = min(rounds, p.back_rounds)
        propagation.checkerboard(a, b, packed, data, dirty, lines, mu, p.smoothness, rounds)
        propagation.unpack(packed, u, v)
        return Map(u, v, np.zeros(a.shape, bool))

    def _room(self, name: str, shape: tuple[int, ...], kind: type) -> AnyArray:
        """Array to write to, for both directions and all levels: fresh memory costs more than filling it."""
        size = int(np.prod(shape))
        held = self.room.get(name)
        if held is None or held.size < size:
            held = self.room[name] = np.empty(size, kind)
        return held[:size].reshape(shape)

    def fine(self, level: int, m: Map, wanted: AnyArray) -> Fine:
        """Sub-pixel map from summed distances."""
        u, v, d = (np.empty(m.u.shape, np.float32) for _ in range(3))
        subpixel.summed(self.left[level], self.right[level], m.u, m.v, wanted.astype(np.uint8), SUM_RADIUS, u, v, d)
        return Fine(u, v, d)

    def reverse(self) -> FastSolver:
        """The matcher from right to left."""
        return FastSolver(self.right, self.left, self.params, room=self.room, back=not self.back)


@dataclass(frozen=True)
class PaperSolver:
    """Floating-point features, one centre (preset ``paper``)."""

    left: Sequence[AnyArray]
    right: Sequence[AnyArray]
    params: HfvmParams
    uses_band: bool = False

    def match(self, level: int, up: Map | None, band: Band) -> Map:
        """Integer map of a level; undefined where the least distance exceeds the threshold."""
        p, a, b = self.params, self.left[level], self.right[level]
        shape = a.shape[:2]
        if up is None:
            reach = top_reach(p, shape, b.shape[:2])
            centre = (np.zeros(shape, np.int16), np.zeros(shape, np.int16))
        else:
            reach = (p.search_columns, p.search_rows)
            centre = (double(up.u, shape), double(up.v, shape))
        u, v, distance, _ = self._search(level, *centre, *reach)
        return Map(u, v, (distance < 0) | (distance > p.threshold))

    def fine(self, level: int, m: Map, wanted: AnyArray) -> Fine:
        """Linear sub-pixel interpolation around the median-filtered map, evened by the look-up table."""
        _, _, distance, offset = self._search(level, m.u, m.v, 0, 0)
        offset = lookup.even(offset)
        return Fine(m.u + offset[..., 0], m.v + offset[..., 1], distance)

    def _search(self, level: int, cu: AnyArray, cv: AnyArray, reach_x: int, reach_y: int) -> tuple[AnyArray, ...]:
        a, b = self.left[level], self.right[level]
        u, v = np.empty(a.shape[:2], np.int16), np.empty(a.shape[:2], np.int16)
        distance, offset = np.empty(a.shape[:2], np.float32), np.empty((*a.shape[:2], 2), np.float32)
        paper.search(a, b, cu, cv, reach_x, reach_y, u, v, distance, offset)
        return u, v, distance, offset

    def reverse(self) -> PaperSolver:
        """The matcher from right to left."""
        return PaperSolver(self.right, self.left, self.params)


def top_reach(p: HfvmParams, a: tuple[int, ...], b: tuple[int, ...]) -> tuple[int, int]:
    """Columns and rows searched to either side at the top level."""
    return int(np.ceil(p.top_columns * max(a[1], b[1]))), int(np.ceil(p.top_rows * max(a[0], b[0])))


def double(up: AnyArray, shape: tuple[int, ...]) -> AnyArray:
    """Prediction for the level below: doubled values, each for its 2 x 2 pixels."""
    big: AnyArray = (2 * up).repeat(2, axis=0)[: shape[0]].repeat(2, axis=1)[:, : shape[1]]
    return np.ascontiguousarray(big)


@dataclass(frozen=True)
class Prepared:
    """Features of both images, as the solver of a preset wants them, and the local deviation of the left one."""

    solver: Solver
    left_valid: tuple[AnyArray, ...]
    right_valid: tuple[AnyArray, ...]
    deviation: Sequence[AnyArray]


class Levels(Sequence[AnyArray]):
    """Something of every level of a pyramid, made when it is first asked for."""

    def __init__(self, count: int, make: Callable[[int], AnyArray]) -> None:
        self._made: list[AnyArray | None] = [None] * count
        self._make = make

    def __len__(self) -> int:
        return len(self._made)

    def __getitem__(self, level: int) -> AnyArray:  # type: ignore[override]
        found = self._made[level]
        if found is None:
            found = self._made[level] = self._make(level)
        return found


@dataclass(frozen=True)
class Features:
    """Features of every level of an image, and local deviations (grey levels)."""

    words: Levels
    deviation: Levels


def find_features(pyramid: Pyramid, params: HfvmParams) -> Features:
    """Features of a pyramid, as the solver of a preset wants them."""
    images, n = filled(pyramid), pyramid.levels
    if params.preset == "paper":
        planes = Levels(n, lambda level: features.planes(images[level]))
        return Features(
            Levels(n, lambda k: paper.weighted(planes[k], params.weights)), Levels(n, lambda k: planes[k][6])
        )
    both: dict[int, tuple[AnyArray, AnyArray]] = {}

    def packed(level: int, which: int) -> AnyArray:
        if level not in both:
            both[level] = features.pack(images[level], params.weights)
        return both[level][which]

    return Features(Levels(n, lambda level: packed(level, 0)), Levels(n, lambda level: packed(level, 1)))


def prepare(left: Pyramid, right: Pyramid, params: HfvmParams, known: Features | None = None) -> Prepared:
    """Features of two pyramids; ``known``: those of the left one, where they are known already."""
    a, b = known or find_features(left, params), find_features(right, params)
    kind: type[PaperSolver] | type[FastSolver] = PaperSolver if params.preset == "paper" else FastSolver
    solver: Solver = kind(a.words, b.words, params)
    return Prepared(solver, left.valid, right.valid, a.deviation)


@dataclass(frozen=True)
class State:
    """What one level knows: both maps, which left and right pixels are consistent, and what to hand down."""

    level: int
    left: Map
    right: Map
    left_ok: NDArray[np.bool_]
    right_ok: NDArray[np.bool_]
    band: Band
    near_sign: float


def run(pair: Prepared, params: HfvmParams, stop: int, start: State | None = None, near_sign: float = 0.0) -> State:
    """Match from the top level (or below ``start``) down to level ``stop``.

    ``near_sign``: -1 where nearer things have lesser column displacements, +1 greater; 0 = find out.
    """
    state = start
    top = len(pair.deviation) - 1 if start is None else start.level - 1
    top = min(top, len(pair.right_valid) - 1)
    for level in range(top, min(stop, top) - 1, -1):
        state = _level(pair, params, level, state, near_sign)
    assert state is not None
    return state


def _level(pair: Prepared, params: HfvmParams, level: int, above: State | None, near_sign: float) -> State:
    forward, backward = pair.solver, pair.solver.reverse()
    band = above.band if above else FREE
    sign = above.near_sign if above else near_sign
    a = forward.match(level, _hand_down(above.left, above.left_ok, sign, params) if above else None, band)
    b = backward.match(level, _hand_down(above.right, above.right_ok, -sign, params) if above else None, band.reverse())
    a, b = (
        Map(consistency.median(m.u, params.median), consistency.median(m.v, params.median), m.undefined) for m in (a, b)
    )
    if level == 0 and above:  # _finish checks sub-pixel maps
        nothing = np.zeros((1, 1), bool)
        return State(level, a, b, nothing, nothing, FREE, sign)
    left_ok = _agree(a, b, pair.left_valid[level], pair.right_valid[level], params.backmatch)
    right_ok = _agree(b, a, pair.right_valid[level], pair.left_valid[level], params.backmatch)
    state = State(level, a, b, left_ok, right_ok, FREE, sign)
    return _with_band(pair, params, state) if forward.uses_band and params.band > 0 and level > 0 else state


def _agree(a: Map, b: Map, a_valid: AnyArray, b_valid: AnyArray, limit: float) -> NDArray[np.bool_]:
    """Usable pixels of an integer map that the other one confirms."""
    found = np.empty(a.u.shape, bool)
    consistency.agree(a.u, a.v, b.u, b.v, a_valid, b_valid, limit, found)
    return found & ~a.undefined


def _hand_down(m: Map, ok: AnyArray, near_sign: float, params: HfvmParams) -> Map:
    """Map whose inconsistent pixels are interpolated along their row (4.3.4)."""
    u, v = m.u.astype(np.float32), m.v.astype(np.float32)
    consistency.fill_rows(u, v, ok, params.fill_reach, near_sign or -1.0, np.zeros(ok.shape, np.uint8))
    return Map(np.rint(u).astype(np.int16), np.rint(v).astype(np.int16), m.undefined)


def sample(ok: AnyArray, count: int) -> NDArray[np.bool_]:
    """About ``count`` evenly strided pixels of a mask."""
    found = np.flatnonzero(ok)
    chosen = np.zeros(ok.shape, dtype=bool)
    chosen.reshape(-1)[found[:: max(1, len(found) // count)]] = True
    return chosen


def _with_band(pair: Prepared, params: HfvmParams, state: State) -> State:
    wanted = sample(state.left_ok, FIT_SAMPLES)
    fine = pair.solver.fine(state.level, state.left, wanted)
    right_shape = state.right.u.shape
    found = epipolar.fit(fine.u, fine.v, wanted, right_shape)
    if found is None:
        return state
    f, spread = found
    # Where lenses bend the lines, or the fit is poor, the band gives way.
    mu = params.band * min(1.0, epipolar.SHARP / max(spread, 1e-9))
    sign = state.near_sign or epipolar.near_sign(f, fine.u, wanted, right_shape)
    return State(state.level, state.left, state.right, state.left_ok, state.right_ok, Band(epipolar.finer(f), mu), sign)
