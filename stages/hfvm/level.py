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
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import Image, Layer, thinned
from rille.stages.hfvm.native.problem import Field, LevelPair, Map, Smoothing, pack_map, unpacked
from rille.stages.hfvm.native.reference import exhaustive
from rille.stages.hfvm.native.solver import solver
from rille.stages.hfvm.native.threads import side_by_side
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.plane import Sample


@kernel
def fill_rows(u, v, keep, reach, near_sign, filled):  # type: ignore[no-untyped-def]
    """Interpolate undefined disparities along rows, in place; ``filled`` is set to 1 at the interpolated pixels.

    A gap between values that agree within two pixels is a failed match: it is interpolated linearly. Any other gap is
    an occlusion: it takes the background's value, that of the side with the lesser ``near_sign * u`` (-1: nearer
    things have lesser displacements). Values are carried at most ``reach`` pixels.
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
                # Bounded, so that the halo of a tile holds all values that are carried into it.
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
"""Matches that a band or a plane is fitted to; more cost time and hardly change the fit."""


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
    """Result of one level: displacements of both images, their consistent pixels, the band of the next finer level,
    and the sign of depth: -1 where nearer things have lesser displacements (of columns; of rows where lines are
    ``upright``), +1 where they have greater ones, 0 unknown."""

    level: int
    left: Map
    right: Map
    left_ok: NDArray[np.bool_]
    right_ok: NDArray[np.bool_]
    band: Band
    near_sign: float

    @property
    def upright(self) -> bool:
        """Whether epipolar lines run along the columns, so that depth shows in the rows; False without a band."""
        return not epipolar.along_rows(self.band.f, self.left.u.shape)

    def reverse(self) -> State:
        """The state of the reversed pair: left and right exchanged."""
        swapped = self.right, self.left, self.right_ok, self.left_ok
        return State(self.level, *swapped, self.band.reverse(), -self.near_sign)


@dataclass(frozen=True)
class LevelInput:
    """Input of the steps of a level: both images, the prediction of the level above (None at the top), the epipolar
    band, and the rounds of propagation. ``level``: 0 is the finest. ``near_sign``: see :class:`State`."""

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
        """Features and band, as the solver takes them."""
        return LevelPair(self.a.words, self.b.words, self.band.f, self.band.mu)


Step = Callable[[LevelInput, Field], Field]


@dataclass(frozen=True)
class Recipe:
    """A preset as lists of steps: of every level, additional ones of the finest level, and of the sub-pixel refinement.

    ``rounds``: most rounds of propagation at the finest level, from left to right, and from right to left, which only
    the consistency check needs; each coarser level has one more, at most ``HfvmParams.rounds``. ``refinement``: steps
    of :mod:`rille.stages.hfvm.finest`. ``half``: images are matched at half their resolution.
    """

    every: tuple[Step, ...]
    finest: tuple[Step, ...]
    rounds: tuple[int, int]
    refinement: tuple[Callable[[Any, Any], Any], ...] = ()
    half: bool = False


@dataclass(frozen=True)
class PyramidPair:
    """The left and the right image, as they are matched, with parameters and preset. With two ``threads`` both
    directions are matched side by side."""

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
        """Number of levels that both images have."""
        return min(len(self.left.layers), len(self.right.layers))


def search(given: LevelInput, field: Field) -> Field:
    """Displacements of least cost around the predictions; at the top of the whole range (4.3.1, Eq. 2 and 3)."""
    p = given.params
    if given.up is not None:
        # One row above and below: the level above has rows nearly right.
        solver.search(given.pair, given.up, (p.search_columns, 1), field)
        return field
    rows, cols = np.maximum(given.a.words.shape, given.b.words.shape)
    exhaustive(given.pair, (int(np.ceil(p.top_columns * cols)), int(np.ceil(p.top_rows * rows))), field)
    return field


def propagate(given: LevelInput, field: Field) -> Field:
    """Displacements after propagation: a pixel takes a neighbour's displacement where it costs less."""
    # Row displacements are tried on the coarser levels, where that costs little. On the finest level, which costs most,
    # a single round tries jumps alone: the search has just tried the neighbouring columns.
    beside = 2 if given.level > 0 else 1 if given.rounds > 1 else 0
    solver.propagate(given.pair, field, Smoothing(given.params.smoothness, given.rounds, beside))
    return field


def paths(given: LevelInput, field: Field) -> Field:
    """Displacements chosen by costs gathered along paths from the borders of the image.

    Candidates of a pixel are its own displacement and those beside it by a pixel, those of near and farther pixels, and
    those of the level above, without which a wrong plane can prevail in images of unlike brightness. Along six
    directions (all eight but the two within a row) each candidate sums up the least cost of a path that ends in it,
    smoothness included; so evidence is carried over weak texture and stops at depth edges.
    """
    handed = np.zeros((0, 0), np.int32) if given.up is None else pack_map(2 * given.up.u, 2 * given.up.v)
    solver.paths(given.pair, LevelPair(given.a.compact, given.b.compact), handed, given.a.grey, field.shift)
    return field


def median(given: LevelInput, field: Field) -> Field:
    """Median of 3 x 3 pixels, since an outlier of one map fails right matches of the other in the consistency check."""
    return Field(pack_map(*(cv2.medianBlur(plane, 3) for plane in unpacked(field.shift))), field.cost)


def edges(given: LevelInput, field: Field) -> Field:
    """Displacements with depth edges refined: near an edge a pixel takes that of either side, by small windows.

    Each candidate d of a pixel p costs

        C(d) = sum over q near p of w(p, q) min(D(q, q + d), far),   w(p, q) = max(grey - |I(p) - I(q)|, 0),

    with D the distance of the compact features, which reach one pixel, and I the grey values: pixels of like grey have
    weight, since most of them lie on the same surface. Adaptive support weights: Yoon and Kweon (2006),
    doi:10.1109/TPAMI.2006.70.
    """
    wanted = (given.a.deviation >= given.params.texture) & (given.a.valid != 0)
    pair, grey = LevelPair(given.a.compact, given.b.compact), np.rint(given.a.grey).astype(np.int16)
    # On upright lines column displacements do not show depth.
    sign = int(given.near_sign) if epipolar.along_rows(given.band.f, wanted.shape) else 0
    return Field(solver.edges(pair, grey, field.shift, wanted.view(np.uint8), sign), field.cost)


def match_level(images: PyramidPair, level: int, above: State | None, near_sign: float = 0.0) -> State:
    """State of a level, from that of the level above (None: the top): search, propagate, check, band.

    ``near_sign``: sign of depth, where it is known beforehand (aligned images do not show it); 0 unknown.
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
    """Usable pixels whose displacement the other map inverts to within ``limit`` pixels (4.3.3), bool.

    ``own, other``: maps, ``u`` and ``v`` int16.
    """
    agreeing = np.zeros(own.u.shape, bool)
    _agree(own, other, own_valid, other_valid, np.float32(limit * limit), agreeing)
    return agreeing


@kernel
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
    """Displacements from the left image to the right one at a level, from the state ``above`` (None: the top).

    ``fine_rounds``: rounds of propagation at the finest level."""
    up = None if above is None else hand_down(above, images.params)
    rounds = min(images.params.rounds, fine_rounds if level == 0 else images.recipe.rounds[0] + level)
    band = FREE_BAND if above is None else above.band
    a, b = images.left.layers[level], images.right.layers[level]
    given = LevelInput(level, a, b, up, band, near_sign, rounds, images.params)
    field = Field(np.empty(a.words.shape, np.int32), np.empty(a.words.shape, np.int32))
    for step in images.params.kept((*images.recipe.every, *(images.recipe.finest if level == 0 and above else ()))):
        field = step(given, field)
    return unpacked(field.shift)


def hand_down(state: State, params: HfvmParams) -> Map:
    """Prediction of the next finer level: inconsistent pixels are interpolated along rows, then along columns."""
    u, v = (a.astype(np.float32) for a in (state.left.u, state.left.v))
    # An unknown sign counts as that of the usual rig.
    sign, filled = state.near_sign or -1.0, np.zeros(u.shape, np.uint8)
    fill_rows(u, v, state.left_ok, params.fill_reach, sign, filled)
    # Rows without any match, as at the border of the common view, are filled along the columns.
    fill_rows(u.T, v.T, (state.left_ok | (filled != 0)).T, params.fill_reach, sign, filled.T)
    # Interpolated values are fractions; a search centre is a whole pixel.
    return Map(*(np.rint(a).astype(np.int16) for a in (u, v)))


def textured(layer: Layer, params: HfvmParams) -> NDArray[np.bool_]:
    """Usable pixels with texture (bool); black ones, as of space, match everywhere."""
    return np.asarray((layer.valid != 0) & (layer.deviation >= params.texture))


def sample(images: PyramidPair, state: State) -> Sample:
    """About :data:`MAX_FIT_MATCHES` evenly spread consistent matches of a level, sub-pixel."""
    a, b = images.left.layers[state.level], images.right.layers[state.level]
    y, x = thinned(state.left_ok & textured(a, images.params), MAX_FIT_MATCHES)
    wanted = np.zeros(state.left_ok.shape, np.uint8)
    wanted[y, x] = 1
    u, v, _ = solver.sums(LevelPair(a.words, b.words), state.left.u, state.left.v, wanted)
    return Sample(x, y, u[y, x], v[y, x])


def with_band(images: PyramidPair, state: State, above: State | None) -> State:
    """The state with the epipolar band for the next finer level, where one can be fitted.

    ``above``: state of the level above; if the lines now run the other way, the sign of depth is determined anew.
    """
    if images.params.band == 0 or state.level == 0:
        return state
    s, shapes = sample(images, state), (state.left.u.shape, state.right.u.shape)
    fit = epipolar.fit_points(*s, *shapes)
    if fit is None:
        return state
    f, spread = fit
    # The band is softened where lenses bend the lines, or the fit is poor.
    mu = images.params.band * min(1.0, epipolar.SHARP_SPREAD_PX / max(spread, 1e-9)) ** 2
    known = replace(state, band=Band(epipolar.finer(f), mu))
    # The first level with a band determines the sign; finer levels keep it while lines run the same way.
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
