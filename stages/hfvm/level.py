"""One level of the matcher (paper, 4.3.4): each image matched to the other, the check of both, and the epipolar band.

A level is a list of steps, each of which improves displacements: search, propagation, paths, median, depth edges.
Displacements that fail the check are interpolated along their row for the next finer level.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import Image, Layer, thinned
from rille.stages.hfvm.native.problem import Field, LevelPair, Map, Smoothing, pack_map, unpacked
from rille.stages.hfvm.native.reference import exhaustive
from rille.stages.hfvm.native.solver import solver
from rille.stages.hfvm.native.threads import side_by_side
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.plane import Sample


@njit(cache=True, nogil=True)
def fill_rows(u, v, keep, reach, near_sign, filled):  # type: ignore[no-untyped-def]
    """Interpolate undefined disparities along rows, in place; ``filled`` gets 1 where it happened.

    A gap between values that agree within two pixels is a failed match and gets the line between them; another gap is
    an occlusion and gets its background: the side of lesser ``near_sign * u`` (-1: near things lie left in the right
    image). No value travels farther than ``reach`` pixels.
    """
    height, cols = u.shape
    for y in range(height):
        x = 0
        while x < cols:
            if keep[y, x]:
                x += 1
                continue
            start = x
            while x < cols and not keep[y, x]:
                x += 1
            a, b = start - 1, x
            for i in range(start, x):
                # Bounded, so that a tile knows how far beside it values may come from.
                from_a = a >= 0 and i - a <= reach
                from_b = b < cols and b - i <= reach
                if not from_a and not from_b:
                    continue
                if from_a and from_b:
                    if abs(u[y, a] - u[y, b]) <= 2 and abs(v[y, a] - v[y, b]) <= 2:
                        t = np.float32(i - a) / np.float32(b - a)
                        u[y, i] = u[y, a] + t * (u[y, b] - u[y, a])
                        v[y, i] = v[y, a] + t * (v[y, b] - v[y, a])
                        filled[y, i] = 1
                        continue
                    # An occlusion shows the background: measured .01 to .02 better (bad-2) than smooth diffusion.
                    from_a = near_sign * u[y, a] <= near_sign * u[y, b]
                s = a if from_a else b
                u[y, i], v[y, i] = u[y, s], v[y, s]
                filled[y, i] = 1


MAX_FIT_MATCHES = 500
"""Matches that a band or plane is fitted to; more change nothing that matters and cost time."""


@dataclass(frozen=True)
class Band:
    """Soft epipolar band of one level: fundamental matrix and cost per pixel off the line (0 = none)."""

    f: epipolar.Matrix
    mu: float

    def reverse(self) -> Band:
        """The band of the right image."""
        return Band(np.ascontiguousarray(self.f.T), self.mu)


FREE_BAND = Band(epipolar.NO_BAND, 0.0)

NEAR_SIGN = -1.0
"""Between parallel cameras nearer things have lesser column displacements (see :class:`State`)."""


@dataclass(frozen=True)
class State:
    """Result of one level: both maps, which left and right pixels are consistent, band of the next finer level, and
    sign of depth: -1 where nearer things have lesser displacements in columns, on ``upright`` lines in rows, +1
    greater, 0 unknown."""

    level: int
    left: Map
    right: Map
    left_ok: NDArray[np.bool_]
    right_ok: NDArray[np.bool_]
    band: Band
    near_sign: float

    @property
    def upright(self) -> bool:
        """Whether epipolar lines run along the columns, as far as is known: depth then shows in the rows."""
        return not epipolar.along_rows(self.band.f, self.left.u.shape)

    def reverse(self) -> State:
        """The state of the reversed pair: left and right exchanged."""
        swapped = self.right, self.left, self.right_ok, self.left_ok
        return State(self.level, *swapped, self.band.reverse(), -self.near_sign)


@dataclass(frozen=True)
class Look:
    """What the steps of a level look at: both images there, the prediction handed down (None at the top), the band, and
    the rounds of propagation. ``level``: 0 is the finest. ``near_sign``: see :class:`State`."""

    level: int
    a: Layer
    b: Layer
    up: Map | None
    band: Band
    near_sign: float
    rounds: int
    params: HfvmParams

    @property
    def pair(self) -> LevelPair:
        """What the solver takes."""
        return LevelPair(self.a.words, self.b.words, self.band.f, self.band.mu)


Step = Callable[[Look, Field], Field]


@dataclass(frozen=True)
class Recipe:
    """A preset as lists of steps: of every level, further ones of the finest, and those after fractions of a pixel.

    ``rounds``: limits of the propagation at the finest level, from left to right, and from right to left, which serves
    the check of consistency alone; each coarser level has one more, at most ``HfvmParams.rounds``. ``refinement``:
    steps of :mod:`rille.stages.hfvm.finest`. ``half``: images are matched at half their resolution.
    """

    every: tuple[Step, ...]
    finest: tuple[Step, ...]
    rounds: tuple[int, int]
    refinement: tuple[Callable[[Any, Any], Any], ...] = ()
    half: bool = False


@dataclass(frozen=True)
class PyramidPair:
    """The left and the right image as they are matched, and how; two ``threads`` match both directions side by side."""

    left: Image
    right: Image
    params: HfvmParams
    recipe: Recipe
    threads: int = 1

    def reverse(self) -> PyramidPair:
        """The images exchanged."""
        return replace(self, left=self.right, right=self.left)

    @property
    def levels(self) -> int:
        """Levels that both have."""
        return min(len(self.left.layers), len(self.right.layers))


def search(look: Look, field: Field) -> Field:
    """Best displacements around the predictions; at the top around none (4.3.1, Eq. 2 and 3)."""
    p = look.params
    if look.up is not None:
        # A row above and below: rows are nearly right from the level above on.
        solver.search(look.pair, look.up, (p.search_columns, 1), field)
        return field
    rows, cols = np.maximum(look.a.words.shape, look.b.words.shape)
    exhaustive(look.pair, (int(np.ceil(p.top_columns * cols)), int(np.ceil(p.top_rows * rows))), field)
    return field


def propagate(look: Look, field: Field) -> Field:
    """Displacements improved by the neighbours'."""
    # Row displacements are found on the coarser levels, where trying them costs little. On the finest level, which
    # costs most, a single round only tries jumps: the search has just tried the neighbouring columns.
    beside = 2 if look.level > 0 else 1 if look.rounds > 1 else 0
    solver.propagate(look.pair, field, Smoothing(look.params.smoothness, look.rounds, beside))
    return field


def paths(look: Look, field: Field) -> Field:
    """Displacements chosen by costs gathered along paths from the borders of the image.

    A pixel's candidates are its own displacement and those a pixel beside it, those of near and farther pixels, and
    those handed down, without which a wrong plane can take hold in images of unlike brightness. Along six directions
    (eight but for those within a row) each gathers the least cost of getting there, smoothness included; so evidence
    travels over weak texture as far as it must, and stops at depth edges.
    """
    handed = np.zeros((0, 0), np.int32) if look.up is None else pack_map(2 * look.up.u, 2 * look.up.v)
    solver.paths(look.pair, LevelPair(look.a.compact, look.b.compact), handed, look.a.grey, field.shift)
    return field


def median(look: Look, field: Field) -> Field:
    """Plain median of 3 x 3 pixels: before the check of consistency, where an outlier of one map refutes the other."""
    return Field(pack_map(*(cv2.medianBlur(plane, 3) for plane in unpacked(field.shift))), field.cost)


def edges(look: Look, field: Field) -> Field:
    """Depth edges placed anew: near one a pixel chooses between the displacements on both sides, by small windows.

    Each candidate d of a pixel p costs

        C(d) = sum over q near p of w(p, q) min(D(q, q + d), far),   w(p, q) = max(grey - |I(p) - I(q)|, 0),

    with D the distance of the compact features, which reach one pixel, and I the grey values: pixels like p count,
    since they mostly lie on its surface. Adaptive support weights: Yoon and Kweon (2006), doi:10.1109/TPAMI.2006.70.
    """
    wanted = (look.a.deviation >= look.params.texture) & (look.a.valid != 0)
    pair, grey = LevelPair(look.a.compact, look.b.compact), np.rint(look.a.grey).astype(np.int16)
    # On upright lines columns do not tell near from far.
    sign = int(look.near_sign) if epipolar.along_rows(look.band.f, wanted.shape) else 0
    return Field(solver.edges(pair, grey, field.shift, wanted.view(np.uint8), sign), field.cost)


def match_level(images: PyramidPair, level: int, above: State | None, near_sign: float = 0.0) -> State:
    """The state of a level, from that of the level above (None: the top): search, propagate, check, band.

    ``near_sign``: sign of depth that is known beforehand, as of aligned images, which do not tell it; 0: it is not.
    """
    known, rounds = near_sign or (0.0 if above is None else above.near_sign), images.recipe.rounds
    back = None if above is None else above.reverse()
    ahead = partial(one_way, images, level, above, known, rounds[0])
    left, right = side_by_side(
        [ahead, partial(one_way, images.reverse(), level, back, -known, rounds[1])], images.threads
    )
    a, b = images.left.layers[level].valid, images.right.layers[level].valid
    ok = agree(left, right, a, b, images.params.backmatch), agree(right, left, b, a, images.params.backmatch)
    return with_band(images, State(level, left, right, *ok, FREE_BAND, known), None if near_sign else above)


def agree(own: Any, other: Any, own_valid: AnyArray, other_valid: AnyArray, limit: float) -> NDArray[np.bool_]:
    """Usable pixels whose whole displacement is undone by the other map within ``limit`` pixels (4.3.3).

    ``own, other``: maps, ``u`` and ``v`` int16.
    """
    agreeing = np.zeros(own.u.shape, bool)
    _agree(own, other, own_valid, other_valid, np.float32(limit * limit), agreeing)
    return agreeing


@njit(cache=True, nogil=True)
def _agree(own, other, own_valid, other_valid, most, agreeing):  # type: ignore[no-untyped-def]
    rows, cols = agreeing.shape
    brows, bcols = np.uint64(other_valid.shape[0]), np.uint64(other_valid.shape[1])
    for y in range(rows):
        for x in range(cols):
            # Unsigned: a negative index becomes greater than any column.
            i, j = np.uint64(x + np.int64(own.u[y, x])), np.uint64(y + np.int64(own.v[y, x]))
            if own_valid[y, x] and i < bcols and j < brows and other_valid[j, i]:
                du, dv = np.int64(own.u[y, x]) + other.u[j, i], np.int64(own.v[y, x]) + other.v[j, i]
                agreeing[y, x] = du * du + dv * dv <= most


def one_way(images: PyramidPair, level: int, above: State | None, near_sign: float, fine_rounds: int) -> Map:
    """Displacements from the left image to the right one, at a level below that of the state ``above``, by the rounds
    ``fine_rounds`` at the finest; ``above`` None: the top."""
    up = None if above is None else hand_down(above, images.params)
    rounds = min(images.params.rounds, fine_rounds if level == 0 else images.recipe.rounds[0] + level)
    band = FREE_BAND if above is None else above.band
    a, b = images.left.layers[level], images.right.layers[level]
    look = Look(level, a, b, up, band, near_sign, rounds, images.params)
    field = Field(np.empty(a.words.shape, np.int32), np.empty(a.words.shape, np.int32))
    for step in images.params.kept((*images.recipe.every, *(images.recipe.finest if level == 0 and above else ()))):
        field = step(look, field)
    return unpacked(field.shift)


def hand_down(state: State, params: HfvmParams) -> Map:
    """Prediction of the next level: the map, its inconsistent pixels interpolated along their row, else column."""
    u, v = (a.astype(np.float32) for a in (state.left.u, state.left.v))
    # While the sign is unknown, the usual rig's stands.
    sign, filled = state.near_sign or -1.0, np.zeros(u.shape, np.uint8)
    fill_rows(u, v, state.left_ok, params.fill_reach, sign, filled)
    # A row may hold no match, as at the border of the common view: its columns are filled from other rows.
    fill_rows(u.T, v.T, (state.left_ok | (filled != 0)).T, params.fill_reach, sign, filled.T)
    # Interpolated values are fractions; a search centre is a whole pixel.
    return Map(*(np.rint(a).astype(np.int16) for a in (u, v)))


def textured(layer: Layer, params: HfvmParams) -> NDArray[np.bool_]:
    """Pixels that tell something: what is black in both images, as space is, agrees everywhere."""
    return np.asarray((layer.valid != 0) & (layer.deviation >= params.texture))


def sample(images: PyramidPair, state: State) -> Sample:
    """About :data:`MAX_FIT_MATCHES` evenly strided consistent matches of a level, with fractions of a pixel."""
    a, b = images.left.layers[state.level], images.right.layers[state.level]
    y, x = thinned(state.left_ok & textured(a, images.params), MAX_FIT_MATCHES)
    wanted = np.zeros(state.left_ok.shape, np.uint8)
    wanted[y, x] = 1
    u, v, _ = solver.sums(LevelPair(a.words, b.words), state.left.u, state.left.v, wanted)
    return Sample(x, y, u[y, x], v[y, x])


def with_band(images: PyramidPair, state: State, above: State | None) -> State:
    """The state with the epipolar band for the next finer level, where there is one and it can be fitted.

    ``above``: the state whose sign of depth is looked for anew where lines turn out to run the other way.
    """
    if images.params.band == 0 or state.level == 0:
        return state
    s, shapes = sample(images, state), (state.left.u.shape, state.right.u.shape)
    fit = epipolar.fit_points(*s, *shapes)
    if fit is None:
        return state
    f, spread = fit
    # Where lenses bend the lines, or the fit is poor, the band gives way.
    mu = images.params.band * min(1.0, epipolar.SHARP_SPREAD_PX / max(spread, 1e-9)) ** 2
    known = replace(state, band=Band(epipolar.finer(f), mu))
    # Found once, by the first level that has a band; finer ones keep it while lines run the same way.
    if state.near_sign and (above is None or above.upright == known.upright):
        return known
    if known.upright:
        f, s, shapes = epipolar.transposed(f), s._replace(u=s.v), (shapes[0][::-1], shapes[1][::-1])
    return replace(known, near_sign=epipolar.near_sign(f, s.u, *shapes))


def descend(images: PyramidPair, stop: int, above: State | None = None, near_sign: float = 0.0) -> State:
    """Match from the top (or below ``above``) down to level ``stop``, or to the top if that is below."""
    first, state = (images.levels if above is None else above.level) - 1, above
    for level in range(first, min(stop, images.levels - 1) - 1, -1):
        state = match_level(images, level, state, near_sign)
    assert state is not None
    return state
