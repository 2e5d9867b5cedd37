"""Coarse-to-fine driver (paper, 4.3.4), generic over the one-level solver.

Top level: null prediction, large search. At each level: match left to right and right to left, median-filter both,
back-match, interpolate what failed, and hand the doubled map down as search centres. Between levels the epipolar band
is fitted anew to the consistent matches, where the solver uses one.

A level is matched window by window (:func:`level_tile`), each wider than what is kept of it by as much as its steps
reach: two pixels a round of propagation, the median's half side, one pixel of the coarser level for the parents, and on
the finest level what the placement of depth edges reads. So the result does not depend on how the image is cut up; one
window that is the whole image is one way among others.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.coarse_to_fine import paths
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import Patch, Plain, Seen
from rille.stages.hfvm.images.window import (
    Raster,
    Results,
    Shape,
    Window,
    around,
    blocks,
    bounded,
    cut,
    gather,
    thinned,
    tiles,
    whole,
)
from rille.stages.hfvm.level import (
    consistency,
    depth_edges,
    epipolar,
    paper,
    search,
    subpixel_lut,
)
from rille.stages.hfvm.native.problem import Field, Pair, PathCosts, Smoothing, pack_map, unpacked
from rille.stages.hfvm.native.reference import SUM_RADIUS
from rille.stages.hfvm.native.solver import solver as native
from rille.stages.imaging.pyramid import Pyramid

FIT_SAMPLES = 500
"""Matches that a band or plane is fitted to; more change nothing that matters and cost time."""


@dataclass(frozen=True)
class Map:
    """Displacements of one direction at one level: int16 columns and rows; bool, where nothing was matchable.

    Arrays, or other rasters.
    """

    u: Any
    v: Any
    undefined: Any

    def cut(self, window: Window) -> Map:
        """The map of a window."""
        return Map(*(cut(a, window) for a in (self.u, self.v, self.undefined)))


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

    def reverse(self) -> Band:
        """The band of the right image."""
        return Band(np.ascontiguousarray(self.f.T), self.mu)


FREE = Band(epipolar.NO_BAND, 0.0)


class Solver(Protocol):
    """One-level matcher of a window of one image onto another one; the other window holds all that can be reached."""

    @property
    def uses_band(self) -> bool:
        """Whether ``match`` uses the band."""

    def rounds(self, level: int) -> int:
        """Rounds of propagation at a level; a displacement travels, and changes by, two pixels a round."""

    def reverse(self) -> Solver:
        """The matcher from right to left."""

    def match(self, level: int, a: Patch, b: Patch, shapes: tuple[Shape, Shape], up: Map | None, band: Band) -> Map:
        """Integer map of ``a`` from the filled map of the level above, of the windows' parents; None: top level."""

    def fine(self, a: Patch, b: Patch, m: Map, wanted: AnyArray) -> Fine:
        """Sub-pixel map where ``wanted`` is not zero, sound :data:`SUM_RADIUS` in from where ``a`` is cut."""


def offset(a: Patch, b: Patch) -> tuple[int, int]:
    """Column and row of the first pixel of ``a`` in the window of ``b``."""
    return a.window.x0 - b.window.x0, a.window.y0 - b.window.y0


@dataclass(frozen=True)
class FastSolver:
    """Packed features, several centres, band, propagation; of preset ``accurate`` also along paths, which cross the
    whole image."""

    params: HfvmParams
    uses_band: bool = True
    back: bool = False

    def rounds(self, level: int) -> int:
        """Rounds of propagation at a level."""
        p = self.params
        rounds = p.rounds if p.fine_rounds is None else min(p.rounds, p.fine_rounds + level)
        return min(rounds, p.back_rounds) if level == 0 and self.back else rounds

    def reverse(self) -> FastSolver:
        """The matcher from right to left."""
        return FastSolver(self.params, back=not self.back)

    def match(self, level: int, a: Patch, b: Patch, shapes: tuple[Shape, Shape], up: Map | None, band: Band) -> Map:
        """Integer map of a level."""
        p, shape = self.params, a.window.shape
        pair = Pair(a.words, b.words, band.f, band.mu, a.window.x0, a.window.y0, *offset(a, b))
        field = Field(np.empty(shape, np.int32), np.empty(shape, np.int32))
        if up is None:
            u, v = np.empty(shape, np.int16), np.empty(shape, np.int16)
            search.exhaustive((a.words, b.words), top_reach(p, *shapes), 1, (u, v, field.cost))
            field.shift[:] = pack_map(u, v)
        else:
            native.search(pair, (up.u, up.v), (p.search_columns, p.search_rows), field)
        rounds = self.rounds(level)
        # Row displacements are found on the coarser levels, where trying them costs little. On the finest level, which
        # costs most, a single round only tries jumps: the search has just tried the neighbouring columns.
        beside = 2 if level > 0 else 1 if rounds > 1 else 0
        native.propagate(pair, field, Smoothing(p.smoothness, rounds, beside))
        u, v = unpacked(field.shift)
        if p.path_rounds:
            coarse = None if up is None else (np.asarray(up.u), np.asarray(up.v))
            costs = PathCosts(p.path_compact, p.path_small, p.path_large, p.path_grey)
            left, right = (paths.LevelView(patch.words, patch.compact, patch.grey) for patch in (a, b))
            u, v = paths.propagate(left, right, (u, v), coarse, (band.f, band.mu), costs, p.path_rounds)
        return Map(u, v, np.zeros(shape, bool))

    def fine(self, a: Patch, b: Patch, m: Map, wanted: AnyArray) -> Fine:
        """Sub-pixel map from distances summed over :data:`SUM_RADIUS`."""
        ahead_x, ahead_y = offset(a, b)
        pair = Pair(a.words, b.words, epipolar.NO_BAND, 0.0, ahead_x=ahead_x, ahead_y=ahead_y)
        return Fine(*native.sums(pair, np.asarray(m.u), np.asarray(m.v), wanted.astype(np.uint8)))


@dataclass(frozen=True)
class PaperSolver:
    """Floating-point features, one centre (preset ``paper``)."""

    params: HfvmParams
    uses_band: bool = False

    def rounds(self, level: int) -> int:
        """There is no propagation."""
        return 0

    def reverse(self) -> PaperSolver:
        """The same matcher: both directions are matched alike."""
        return self

    def match(self, level: int, a: Patch, b: Patch, shapes: tuple[Shape, Shape], up: Map | None, band: Band) -> Map:
        """Integer map of a level; undefined where the least distance exceeds the threshold."""
        p, shape = self.params, a.window.shape
        if up is None:
            reach = top_reach(p, *shapes)
            centre = (np.zeros(shape, np.int16), np.zeros(shape, np.int16))
        else:
            reach = (p.search_columns, p.search_rows)
            centre = (double(np.asarray(up.u), shape), double(np.asarray(up.v), shape))
        u, v, distance, _ = self.search(a, b, *centre, *reach)
        return Map(u, v, (distance < 0) | (distance > p.threshold))

    def fine(self, a: Patch, b: Patch, m: Map, wanted: AnyArray) -> Fine:
        """Linear sub-pixel interpolation around the median-filtered map, evened by the look-up table."""
        _, _, distance, found = self.search(a, b, np.asarray(m.u), np.asarray(m.v), 0, 0)
        found = subpixel_lut.even(found)
        return Fine(m.u + found[..., 0], m.v + found[..., 1], distance)

    def search(
        self, a: Patch, b: Patch, cu: AnyArray, cv: AnyArray, reach_x: int, reach_y: int
    ) -> tuple[AnyArray, ...]:
        """Displacements, distance, and sub-pixel offsets (row, col, 2) of
        :func:`rille.stages.hfvm.level.paper.search`."""
        shape = a.window.shape
        u, v = np.empty(shape, np.int16), np.empty(shape, np.int16)
        distance, found = np.empty(shape, np.float32), np.empty((*shape, 2), np.float32)
        reach = reach_x, reach_y
        paper.search((a.words, b.words), (cu, cv), reach, (u, v, distance, found), offset(a, b))
        return u, v, distance, found


def top_reach(p: HfvmParams, a: tuple[int, ...], b: tuple[int, ...]) -> tuple[int, int]:
    """Columns and rows searched to either side at the top level."""
    return int(np.ceil(p.top_columns * max(a[1], b[1]))), int(np.ceil(p.top_rows * max(a[0], b[0])))


def double(up: AnyArray, shape: tuple[int, ...]) -> AnyArray:
    """Prediction for the level below: doubled values, each for its 2 x 2 pixels."""
    # Repeated, not interpolated: means of two depths at an edge are depths that nothing has.
    big: AnyArray = (2 * up).repeat(2, axis=0)[: shape[0]].repeat(2, axis=1)[:, : shape[1]]
    return np.ascontiguousarray(big)


@dataclass(frozen=True)
class Prepared:
    """Two images and what matches the first one onto the second one. ``side``: pixels of a tile; None: whole."""

    left: Seen
    right: Seen
    solver: Solver
    params: HfvmParams
    side: int | None = None

    def reverse(self) -> Prepared:
        """The matcher from right to left."""
        return Prepared(self.right, self.left, self.solver.reverse(), self.params, self.side)

    def shapes(self, level: int) -> tuple[Shape, Shape]:
        """Rows and columns of both images."""
        return self.left.view.shapes[level], self.right.view.shapes[level]

    @property
    def levels(self) -> int:
        """Levels that both have."""
        return min(len(self.left.view.shapes), len(self.right.view.shapes))

    def deviation(self, level: int, window: Window) -> AnyArray:
        """Local deviation of the left image, grey levels."""
        patch = self.left.patch(level, window, deviation=True)
        assert patch.deviation is not None
        return patch.deviation[window.inside(patch.window)]


def prepare(left: Pyramid, right: Pyramid, params: HfvmParams) -> Prepared:
    """The matcher of two pyramids in memory."""
    seen = [Seen(Plain.of(pyramid).quiet(params), params) for pyramid in (left, right)]
    return Prepared(seen[0], seen[1], solver(params), params)


def solver(params: HfvmParams) -> Solver:
    """One-level matcher of a preset."""
    return PaperSolver(params) if params.preset == "paper" else FastSolver(params)


@dataclass(frozen=True)
class State:
    """Result of one level: both maps, which left and right pixels are consistent, band and sign of depth."""

    level: int
    left: Map
    right: Map
    left_ok: Any
    right_ok: Any
    band: Band
    near_sign: float

    def reverse(self) -> State:
        """The state of the reversed pair: left and right exchanged."""
        return State(
            self.level, self.right, self.left, self.right_ok, self.left_ok, self.band.reverse(), -self.near_sign
        )


def run(pair: Prepared, params: HfvmParams, stop: int, start: State | None = None, near_sign: float = 0.0) -> State:
    """Match from the top level (or below ``start``) down to level ``stop``, or the top if that is below, all in memory.

    ``near_sign``: -1 where nearer things have lesser column displacements, +1 greater; 0 = find out.
    """
    state, above = start, pair.levels if start is None else start.level
    for level in range(above - 1, min(stop, pair.levels - 1) - 1, -1):
        state = _level(pair, level, state, near_sign)
    assert state is not None
    return state


def _level(pair: Prepared, level: int, above: State | None, near_sign: float) -> State:
    maps = []
    for way, up in ((pair, above), (pair.reverse(), above.reverse() if above else None)):
        shape = way.shapes(level)[0]
        found = gather(shape, ((w, level_tile(way, level, w, up)) for w in level_tiles(way, level)))
        maps.append(Map(found["u"], found["v"], found["undefined"]))
    return settle(pair, level, maps[0], maps[1], above.near_sign if above else near_sign)


def settle(pair: Prepared, level: int, left: Map, right: Map, near_sign: float) -> State:
    """The state of a level whose maps are in memory, with the band for the next finer one.

    At the finest level, below others, sub-pixel maps are checked instead.
    """
    if level == 0 and pair.levels > 1:
        nothing = np.zeros((1, 1), bool)
        return State(level, left, right, nothing, nothing, FREE, near_sign)
    both = []
    for way, a, b in ((pair, left, right), (pair.reverse(), right, left)):
        shape = way.shapes(level)[0]
        windows = tiles(shape, way.side)
        both.append(gather(shape, ((w, {"ok": consistent(way, level, a, b, w)}) for w in windows))["ok"])
    state = State(level, left, right, both[0], both[1], FREE, near_sign)
    return with_band(pair, state)


def level_tiles(pair: Prepared, level: int) -> list[Window]:
    """Tiles that a level is matched in; the top level, whose search is exhaustive, is one."""
    top = level == pair.levels - 1
    return tiles(pair.shapes(level)[0], None if top else pair.side)


def level_tile(pair: Prepared, level: int, window: Window, above: State | None) -> Results:
    """Map of the left image's window: ``u``, ``v`` int16, ``undefined`` bool."""
    p, rounds, (shape, other) = pair.params, pair.solver.rounds(level), pair.shapes(level)
    # Two pixels for each round, half a median, and for the parents' neighbours a coarse pixel, two pixels wide.
    reach = 2 * rounds + p.median // 2 + 2
    edges = level == 0 and p.depth_edges
    if edges:
        reach += depth_edges.REACH + depth_edges.READ
    # Even borders: the four pixels of a parent are searched together.
    outer = window.grow(reach, reach, shape).align(2, shape)
    a = pair.left.patch(level, outer, deviation=edges)
    if above is None:
        b, up, band = pair.right.patch(level, whole(other)), None, FREE
    else:
        up, band = hand_down(above, outer.parent(), p), above.band
        # A centre is moved by a pixel at most, searched around, and changed by one in each half round.
        change = 1 + 2 * rounds + (depth_edges.READ if edges else 0)
        x, y = p.search_columns + change, p.search_rows + change
        target = bounded(
            outer.y0 + 2 * int(np.min(up.v)) - y,
            outer.y1 + 2 * int(np.max(up.v)) + y,
            outer.x0 + 2 * int(np.min(up.u)) - x,
            outer.x1 + 2 * int(np.max(up.u)) + x,
            other,
        )
        b = pair.right.patch(level, target)
    found = pair.solver.match(level, a, b, (shape, other), up, band)
    # Before the check of consistency, which asks one pixel of the other map: an outlier there refutes a match.
    u, v = (consistency.median(np.asarray(plane), p.median) for plane in (found.u, found.v))
    if edges:
        u, v = _edges_placed(pair, a, b, (u, v), above.near_sign if above else 0.0)
    arrays = {"u": u, "v": v, "undefined": np.asarray(found.undefined)}
    inner = window.inside(outer)
    return {name: array[inner] for name, array in arrays.items()}


def _edges_placed(
    pair: Prepared, a: Patch, b: Patch, given: tuple[AnyArray, AnyArray], near_sign: float
) -> tuple[AnyArray, AnyArray]:
    """Displacements of a left window of the finest level, depth edges placed anew where there is texture."""
    assert a.deviation is not None
    left, right = (depth_edges.EdgeView(patch.compact, patch.grey) for patch in (a, b))
    wanted = (a.deviation >= pair.params.texture) & (pair.left.view.valid(0, a.window) != 0)
    return depth_edges.place(left, right, given, wanted, offset(a, b), near_sign)


def consistent(pair: Prepared, level: int, a: Map, b: Map, window: Window) -> NDArray[np.bool_]:
    """Usable left pixels of a window whose integer displacement the other map confirms."""
    own, found = a.cut(window), np.zeros(window.shape, bool)
    usable = pair.left.view.valid(level, window)
    for block in _landing(own.u, own.v, window, b.u):
        bu, bv, valid = cut(b.u, block), cut(b.v, block), pair.right.view.valid(level, block)
        at = window.x0 - block.x0, window.y0 - block.y0
        consistency.agree((own.u, own.v), (bu, bv), usable, valid, pair.params.backmatch, found, at)
    return np.asarray(found & (own.undefined == 0))


def _landing(u: AnyArray, v: AnyArray, window: Window, raster: Raster) -> Iterable[Window]:
    """Pieces of the other image's raster on which the pixels of a window land."""
    if isinstance(raster, np.ndarray):
        return [whole(raster.shape)]
    y, x = np.indices(window.shape, np.int32)
    y, x = y + (window.y0 + v.astype(np.int32)), x + (window.x0 + u.astype(np.int32))
    return blocks(raster, y, x, (y >= 0) & (y < raster.shape[0]) & (x >= 0) & (x < raster.shape[1]))


def hand_down(state: State, window: Window, params: HfvmParams) -> Map:
    """Map of a left window whose inconsistent pixels are interpolated along their row (4.3.4)."""
    # Filling looks along rows alone.
    outer = window.grow(0, params.fill_reach, state.left.u.shape)
    own, ok = state.left.cut(outer), cut(state.left_ok, outer)
    u, v = (np.asarray(a).astype(np.float32) for a in (own.u, own.v))
    # While the sign is unknown, the usual rig's stands.
    consistency.fill_rows(u, v, ok, params.fill_reach, state.near_sign or -1.0, np.zeros(ok.shape, np.uint8))
    inner = window.inside(outer)
    # Interpolated values are fractions; a search centre is a whole pixel.
    columns, rows = (np.ascontiguousarray(np.rint(a[inner]).astype(np.int16)) for a in (u, v))
    return Map(columns, rows, np.asarray(own.undefined)[inner])


def fine_tile(pair: Prepared, level: int, a: Map, window: Window, wanted: AnyArray | None) -> Fine:
    """Sub-pixel map of a left window, distance -1 outside or where not ``wanted`` (None: everywhere).

    Reach: :data:`SUM_RADIUS`.
    """
    shape, other = pair.shapes(level)
    outer = window.grow(SUM_RADIUS, SUM_RADIUS, shape)
    own = a.cut(outer)
    use = np.zeros(outer.shape, bool)
    use[window.inside(outer)] = True if wanted is None else wanted
    target = whole(other)
    if outer != whole(shape):
        # One more than the window, since sub-pixel search moves it by a pixel to every side; the paper's heeds no wish.
        target = landing(own, outer, other, SUM_RADIUS + 1, None if pair.params.preset == "paper" else use)
    found = pair.solver.fine(pair.left.patch(level, outer), pair.right.patch(level, target), own, use)
    inner = window.inside(outer)
    return Fine(*(np.ascontiguousarray(plane[inner]) for plane in (found.u, found.v, found.distance)))


def landing(m: Map, window: Window, shape: Shape, margin: int, wanted: AnyArray | None) -> Window:
    """Window of the other image, of ``shape``, on which the ``wanted`` pixels (None: all) of a window land."""
    y, x = np.indices(window.shape, np.int32)
    return around(y + (window.y0 + m.v), x + (window.x0 + m.u), shape, margin, wanted)


def fine(pair: Prepared, state: State) -> Fine:
    """Sub-pixel map of a whole level in memory."""
    return fine_tile(pair, state.level, state.left, whole(state.left.u.shape), None)


@dataclass(frozen=True)
class Sample:
    """Sub-pixel matches of a level, in reading order: columns, rows, displacements (n,)."""

    x: AnyArray
    y: AnyArray
    u: AnyArray
    v: AnyArray


def sample(pair: Prepared, state: State) -> Sample:
    """About :data:`FIT_SAMPLES` evenly strided consistent matches of a level."""
    shape = state.left.u.shape
    y, x = np.divmod(thinned(state.left_ok, FIT_SAMPLES, lambda ok: ok != 0), shape[1])
    u, v = np.empty(len(y), np.float32), np.empty(len(y), np.float32)
    for w in tiles(shape, pair.side):
        here = (y >= w.y0) & (y < w.y1) & (x >= w.x0) & (x < w.x1)
        if not here.any():
            continue
        wanted = np.zeros(w.shape, bool)
        at = y[here] - w.y0, x[here] - w.x0
        wanted[at] = True
        found = fine_tile(pair, state.level, state.left, w, wanted)
        u[here], v[here] = found.u[at], found.v[at]
    return Sample(x, y, u, v)


def with_band(pair: Prepared, state: State) -> State:
    """The state with the epipolar band for the next finer level, where there is one and it can be fitted."""
    if not (pair.solver.uses_band and pair.params.band > 0 and state.level > 0):
        return state
    s, (shape, other) = sample(pair, state), pair.shapes(state.level)
    found = epipolar.fit_points(s.x, s.y, s.u, s.v, shape, other)
    if found is None:
        return state
    f, spread = found
    # Where lenses bend the lines, or the fit is poor, the band gives way.
    mu = pair.params.band * min(1.0, epipolar.SHARP / max(spread, 1e-9)) ** 2
    # Told once, by the first level that has a band; finer ones keep it.
    sign = state.near_sign or epipolar.near_sign(f, s.u, shape, other)
    return replace(state, band=Band(epipolar.finer(f), mu), near_sign=sign)
