"""Matches of textureless regions, such as walls, by a plane on which wide windows of the region agree.

Where an image shows hardly any texture, a single pixel matches by chance. Feature distances summed over a wide window
are least at the right displacement more often than at any other. So at level 1, in each large region without matches
and texture:

1. along its epipolar line each pixel takes the displacement with the least sum over a window of the region, of all
   displacements that were matched and of farther ones, and a fraction of a pixel by the sums on both sides;
2. a plane is fitted robustly: the displacement along the line is a linear function of column and row. The more a
   window's sum exceeds that of its best displacement for all others, the more it counts;
3. if clearly more windows agree with the plane than would by chance, those pixels are matched at its displacement
   whose windows contradict it no more than the agreeing ones do: their sum there exceeds their least sum by as little.
   Their standard deviation is that of the agreeing windows. The rest of the region is filled with the plane.

A window has a vote if most displacements leave it inside the right image, and if its match is mutual: of all windows
that any displacement leads to the same right pixel, one with the same displacement is the most similar. Ground that is
hidden in the right image, such as the strip beside a near thing, has no match there, and takes one that belongs to
other ground. Windows with two equally good displacements (a black or an overexposed sky) have no vote either. A window
whose best displacement is one of the last two on either side does not agree. Nearly half of a region must have a vote:
ground between a near thing and the image's border may be hidden in the right image.

Chosen with motorcycle, Baby1, Cloth1, Lampshade1 and Midd1, as they are and with the right image degraded: on the wall
of Midd1, three eighths of the image, wide windows are right for four in ten pixels, matches for two. That matches must
be mutual, and how many, was chosen with Monopoly as well. Blocks of JPEG images look like structure: there a plane may
be some pixels off."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.hfvm import epipolar, plane
from rille.stages.hfvm.image import Image, Window, distance, thinned, whole
from rille.stages.hfvm.level import MAX_FIT_MATCHES
from rille.stages.hfvm.native.reference import linear
from rille.stages.hfvm.refinement import BLANK_STD_PX
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import MAD_TO_SIGMA, cauchy
from rille.stages.numeric.windows import window_count, window_sum32

WINDOW_RADIUS_PX = 6
WINDOW_SIDE_PX = 2 * WINDOW_RADIUS_PX + 1
"""Side of the window, pixels."""

MIN_DISTINCT_STEPS = 2
"""Steps beside the best one that it need not be distinct from."""


class Region(NamedTuple):
    """A region: its window of the left image, and the right image that it is compared with.

    ``left``: features (row, col) of the window, whose first column and row are ``x0, y0``; ``inside``: bool, which
    pixels belong to the region; ``lines``: see :func:`rille.stages.hfvm.epipolar.lines`; ``right, valid``: features and
    mask of the right image.
    """

    left: AnyArray
    inside: AnyArray
    lines: AnyArray
    right: AnyArray
    valid: AnyArray
    x0: int
    y0: int

    @property
    def size(self) -> AnyArray:
        """Number of the region's pixels in the window around each, at least one."""
        return np.maximum(window_count(self.inside, WINDOW_SIDE_PX), 1)


class Searched(NamedTuple):
    """Result of the search for each pixel of a region, (row, col).

    ``tried``: int32, number of steps that leave its whole window inside the right image. ``best, least``: float32, the
    step with the least sum of distances over the window, sub-pixel, and that sum. ``distinct``: float32, by how much
    all sums more than :data:`MIN_DISTINCT_STEPS` from the best step exceed the least, 0 if there is none. ``mutual``:
    bool, whether no step so far from the best one leads a more similar window to the same right pixel.
    """

    tried: AnyArray
    best: AnyArray
    least: AnyArray
    distinct: AnyArray
    mutual: NDArray[np.bool_]


class SearchState(NamedTuple):
    """State of a search, updated step by step. Of each pixel: the number of steps tried; the best step and its sum; the
    sums one step before and after it; the least sum far from it. Of each right pixel: the least mean distance of the
    windows led to it, and the step of that window."""

    tried: AnyArray
    best: AnyArray
    least: AnyArray
    before: AnyArray
    after: AnyArray
    rival: AnyArray
    claim: AnyArray
    claimant: AnyArray


def search(region: Region, steps: AnyArray) -> Searched:
    """The best of ``steps`` ((n,) float32 pixels, ascending by 1) along the epipolar line of each pixel of a region."""
    shape = region.inside.shape
    tried, (best, least, distinct) = np.zeros(shape, np.int32), np.zeros((3, *shape), np.float32)
    found = Searched(tried, best, least, distinct, np.zeros(shape, bool))
    here, there = np.full((5, *shape), np.inf, np.float32), np.full((2, *region.right.shape), np.inf, np.float32)
    state = SearchState(tried, *here, *there)
    # Sums of the last steps, and the least sum of those more than MIN_DISTINCT_STEPS behind.
    last, passed, size = deque[AnyArray](), np.full(shape, np.inf, np.float32), region.size
    for step in steps:
        total = _sums(region, np.full(shape, step))
        if len(last) > MIN_DISTINCT_STEPS:
            np.minimum(passed, last.popleft(), out=passed)
        _update(region, step, (total, last[-1] if last else passed, passed, size), state)
        last.append(total)
    _judge(region, state, found)
    return found


def _sums(region: Region, at: AnyArray) -> AnyArray:
    """Sum (row, col) of the distances of a region's pixels over the window of each pixel, float32; infinite outside of
    the region, and where a pixel of the window is led out of the right image. ``at``: the step of each pixel along its
    line, float32."""
    cost, outside = np.zeros(at.shape, np.float32), np.zeros(at.shape, np.uint8)
    _distances(region, at, cost, outside)
    total = window_sum32(cost, WINDOW_SIDE_PX)
    total[(cv2.dilate(outside, np.ones(2 * (WINDOW_SIDE_PX,), np.uint8)) != 0) | ~region.inside] = np.inf
    return total


@kernel
def _end(region, y, x, step):  # type: ignore[no-untyped-def]
    """Row and column of the right image to which a step along its line leads a pixel."""
    line = region.lines[y, x]
    u, v = epipolar.on_line((line[0], line[1], line[2]), step)
    return np.int64(np.rint(y + region.y0 + v)), np.int64(np.rint(x + region.x0 + u))


@kernel
def _distances(region, at, cost, outside):  # type: ignore[no-untyped-def]
    """Distances of a region's pixels to those their step away along their lines."""
    rows, cols = region.right.shape
    for y in range(at.shape[0]):
        for x in range(at.shape[1]):
            if region.inside[y, x]:
                j, i = _end(region, y, x, at[y, x])
                outside[y, x] = i < 0 or i >= cols or j < 0 or j >= rows or not region.valid[j, i]
                if not outside[y, x]:
                    # At most about three times the distance [byte steps] of noise.
                    cost[y, x] = min(distance(region.left[y, x], region.right[j, i]), 60)


@kernel
def _update(region, step, sums, state):  # type: ignore[no-untyped-def]
    """Update ``state`` with the sums of one more step; ``sums``: those of the step before, the least of those far
    behind, and the windows' sizes besides."""
    total, previous, passed, size = sums
    # Arrays of a structure would be looked up for each pixel, one at a time: so they have names of their own.
    best, least, rival, tried = state.best, state.least, state.rival, state.tried
    before, after, claim, claimant = state.before, state.after, state.claim, state.claimant
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            if total[y, x] < least[y, x]:
                best[y, x], least[y, x] = step, total[y, x]
                before[y, x], after[y, x], rival[y, x] = previous[y, x], np.inf, passed[y, x]
            elif step - best[y, x] == 1:
                after[y, x] = total[y, x]
            elif step - best[y, x] > MIN_DISTINCT_STEPS:
                rival[y, x] = min(rival[y, x], total[y, x])
        for x in range(total.shape[1]):
            if total[y, x] < np.inf:
                tried[y, x] += 1
                j, i = _end(region, y, x, step)
                mean = total[y, x] / size[y, x]
                if mean < claim[j, i]:
                    claim[j, i], claimant[j, i] = mean, step


@kernel
def _judge(region, state, found):  # type: ignore[no-untyped-def]
    """Write the results of all steps. Near their minimum sums of absolute differences are two lines, no parabola."""
    for y in range(found.mutual.shape[0]):
        for x in range(found.mutual.shape[1]):
            step, least = state.best[y, x], state.least[y, x]
            before, after = state.before[y, x], state.after[y, x]
            found.best[y, x], found.least[y, x] = step, least
            if least < np.inf:
                j, i = _end(region, y, x, step)
                found.mutual[y, x] = abs(state.claimant[j, i] - step) <= MIN_DISTINCT_STEPS
                if max(before, after) < np.inf:  # no end of the steps
                    found.best[y, x] += linear(before, least, after)
                if state.rival[y, x] < np.inf:
                    found.distinct[y, x] = state.rival[y, x] - least


REGION_LEVEL = 1
"""One halving halves the noise and leaves a quarter of the pixels to search."""


MIN_REGION_PX = 6 * WINDOW_SIDE_PX * WINDOW_SIDE_PX
"""Least size of a region, and of the part of it that has a vote, pixels of the level."""

MAX_VOTE_DISTANCE_PX = 1.25
"""Pixels of the level: the plane with the most votes within this distance is chosen; with twice as much, tilted planes
were. No whole number, so that no integer displacement lies on the limit."""

MAX_AGREE_DISTANCE_PX = 2.5
"""Pixels of the level: windows within this distance agree with the plane. No whole number, either."""

MAX_SLOPE = MAX_VOTE_DISTANCE_PX / WINDOW_RADIUS_PX
"""Displacement a pixel: on a steeper plane no single displacement is right for a whole window."""


class Planes(NamedTuple):
    """Planes of textureless regions.

    ``region``: (row, col) of level 1, int8, number of the region from 1 on, negative where a pixel is filled but not
    matched; 0 elsewhere. ``terms``: of each region, pixels of level 0: terms (1, x, y) of the displacement along the
    lines of ``f``, and its standard deviation.
    """

    region: AnyArray
    terms: list[list[float]]
    f: epipolar.Matrix

    def cut(self, window: Window) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Region, as above, of the pixels of a window of level 0; column and row displacements of its plane, and their
        standard deviations."""
        twice = self.region[window.parent().slices].repeat(2, axis=0).repeat(2, axis=1)
        rows, cols = window.shape
        region = twice[window.y0 % 2 :, window.x0 % 2 :][:rows, :cols]
        y, x = np.nonzero(region)
        g = np.array([4 * [0.0], *self.terms])[np.abs(region[y, x])]
        x0, y0 = x + window.x0, y + window.y0
        along = g[:, 0] + g[:, 1] * x0 + g[:, 2] * y0
        u, v, std = np.zeros((3, *window.shape), np.float32)
        u[y, x], v[y, x] = epipolar.on_line(epipolar.lines_at(self.f, x0, y0), along)
        std[y, x] = g[:, 3]
        return region, u, v, std


def find(images: tuple[Image, Image], matches: Mapping[str, AnyArray], f: epipolar.Matrix, near_sign: float) -> Planes:
    """Find the planes of the left image's textureless regions.

    Parameters
    ----------
    matches : displacements ``u, v`` (row, col) of level 0, pixels, and ``validity``, 0 where matched.
    f : fundamental matrix of level 0, see :func:`rille.stages.hfvm.epipolar.oriented`.
    near_sign : sign of the displacement along the lines of near things against far ones; 0 unknown.
    """
    left, right = (image.layers[REGION_LEVEL] for image in images)
    label, terms = np.zeros(left.shape, np.int8), list[list[float]]()
    up = plane.finer(REGION_LEVEL)
    coarse = up.T @ f @ up
    steps = _steps(matches, f, near_sign)
    # A pixel of the level counts as unmatched if none of its four pixels is matched.
    unmatched = np.ones((2 * left.shape[0], 2 * left.shape[1]), bool)
    np.not_equal(matches["validity"], 0, out=unmatched[whole(matches["validity"].shape).slices])
    weak = (unmatched[::2, ::2] & unmatched[::2, 1::2]) & (unmatched[1::2, ::2] & unmatched[1::2, 1::2])
    # 1.0: grey levels of local deviation below which a pixel of the level may belong to a region.
    for window, inside in _regions(weak & (left.deviation < 1.0) & (left.valid != 0)):
        x0, y0 = window.x0, window.y0
        lines = epipolar.lines(epipolar.moved(coarse, (x0, y0), (x0, y0)), inside.shape)
        words = np.ascontiguousarray(left.words[window.slices])
        region = Region(words, inside, lines, right.words, right.valid, x0, y0)
        found = search(region, steps)
        # A window has a vote if at least half of the displacements leave it inside the right image.
        usable = (found.tried >= 0.5 * len(steps)) & (found.distinct > 0)
        y, x = np.nonzero(usable & found.mutual)
        # 0.45: share of a region's pixels that must have a vote. The wall of Midd1 has .47 and more in all degradations
        # but noise; a wall of Monopoly that is largely hidden at most .39, and where blocks of a JPEG image of
        # Lampshade1 agree .44.
        if len(y) < max(MIN_REGION_PX, 0.45 * np.count_nonzero(inside)):
            continue
        votes, step = found.distinct[y, x].astype(np.float64), found.best[y, x].astype(np.float64)
        g, error = _fit(x + x0, y + y0, step, votes)
        rows, cols = np.indices(inside.shape)
        on_plane = (g[0] + g[1] * (cols + x0) + g[2] * (rows + y0)).astype(np.float32)
        # By how much the mean distance of a window on the plane exceeds its least one.
        more = np.full(inside.shape, np.inf)
        more[usable] = (_sums(region, on_plane)[usable] - found.least[usable]) / region.size[usable]
        inner = (steps[1] + 0.5 < step) & (step < steps[-2] - 0.5)
        agree = (error <= MAX_AGREE_DISTANCE_PX) & inner & np.isfinite(more[y, x])
        if _sure(agree, votes, found.tried[y, x]):
            terms.append(_at_level_0(g, error[agree]))
            # 0.95: share of the agreeing windows that contradict the plane no more than a matched pixel's window may.
            alike = more <= np.quantile(more[y[agree], x[agree]], 0.95)
            # Pixels with another match of their own are not on this plane.
            label[window.slices][inside & ~(usable & found.mutual)] = -len(terms)
            label[window.slices][usable & alike] = len(terms)
    return Planes(label, terms, f)


def _sure(agree: AnyArray, votes: AnyArray, tried: AnyArray) -> bool:
    """Whether more windows agree than would by chance with any plane, with so many steps ``tried`` in each."""
    chance, share = np.average(2 * MAX_AGREE_DISTANCE_PX / tried, weights=votes), np.average(agree, weights=votes)
    # Effective number of windows: as many independent and equally distinct ones would have the same weight.
    windows = votes.sum() ** 2 / np.sum(votes**2) / WINDOW_SIDE_PX**2
    # Binomial: the chance that as large a share of as many windows, or a larger one, agrees with one plane; the normal
    # distribution makes it far too small where windows are few.
    tail = scipy.special.betainc(share * windows, (1.0 - share) * windows + 1.0, chance)
    # 10**-5.5: of a range of 40 displacements at each of three corners there are some 10^5 different planes, and the
    # best one is taken. Of the chosen half right planes have at most 10^-5.7, wrong ones 10^-5.2 and more.
    return bool(tail < 10**-5.5)


def _at_level_0(g: AnyArray, error: AnyArray) -> list[float]:
    """Terms of a plane in pixels of level 0, and the standard deviation of steps with this ``error``."""
    # Pixel x of the level is (x + 1/2) 2^level - 1/2 of level 0, where displacements are 2^level as long.
    scale = 2.0**REGION_LEVEL
    middle = 0.5 / scale - 0.5
    std = np.hypot(scale * MAD_TO_SIGMA * epipolar.typical(error), BLANK_STD_PX)
    return [float(t) for t in (scale * (g[0] + middle * (g[1] + g[2])), g[1], g[2], std)]


def _steps(matches: Mapping[str, AnyArray], f: epipolar.Matrix, near_sign: float) -> AnyArray:
    """Displacements along the lines to be tried, pixels of the level; ``near_sign``: sign of nearer ones, 0 unknown."""
    y, x = thinned(matches["validity"] == 0, MAX_FIT_MATCHES)
    a, b, _ = epipolar.lines_at(f, x, y)
    # Distance of the matches along their lines: the inverse of ``epipolar.on_line``.
    along = b * matches["u"][y, x] - a * matches["v"][y, x]
    low, high = np.quantile(along, (0.005, 0.995)) * 0.5**REGION_LEVEL
    # Half of the range, and some pixels, beyond its far end: a wall is often farther than everything else.
    beyond = 0.5 * (high - low) + 4
    # The outermost steps do not count as agreeing.
    low, high = low - (2 if near_sign < 0 else beyond), high + (2 if near_sign > 0 else beyond)
    return np.arange(np.floor(low), np.ceil(high) + 1, dtype=np.float32)


def _regions(weak: NDArray[np.bool_]) -> Iterator[tuple[Window, NDArray[np.bool_]]]:
    """Windows of the large connected regions, and their pixels in it; the largest first."""
    # Opening parts regions that one or two pixels connect.
    opened = cv2.morphologyEx(weak.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, number, about, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    sizes = about[1:, cv2.CC_STAT_AREA]
    # 127: region numbers are int8.
    for n in np.argsort(-sizes, kind="stable")[:127]:
        if sizes[n] < MIN_REGION_PX:
            return
        x, y, wide, high, _ = (int(k) for k in about[n + 1])
        window = Window(y, y + high, x, x + wide)
        yield window, number[window.slices] == n + 1


def _fit(x: AnyArray, y: AnyArray, step: AnyArray, votes: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Terms (1, x, y) of the plane with the most ``votes``, and the distance of each step from it.

    Random sample consensus with a fixed seed, then least squares with the weights of Cauchy squared. Votes are whole
    numbers, so that their sums are exact.
    """
    terms, rng = np.stack([np.ones(len(x)), x, y]), np.random.default_rng(0)
    # A plane is fitted to a thousand windows at most.
    sample = rng.choice(len(x), min(1000, len(x)), replace=False)
    t, d, weight = np.ascontiguousarray(terms[:, sample]), step[sample], votes[sample]
    # Of 500 planes 32 are right where four in ten windows are.
    three = rng.choice(len(sample), (500, 3), p=weight / weight.sum())
    # The prior keeps the system regular where three windows lie on a line, or one was drawn twice.
    planes = np.linalg.solve(t.T[three] + 1e-6 * np.eye(3), d[three][..., None])[..., 0]
    # The flat plane stays if all others are too steep.
    planes = np.vstack([[np.median(d), 0.0, 0.0], planes[(np.abs(planes[:, 1:]) <= MAX_SLOPE).all(axis=1)]])
    near = np.abs(sum(g[:, None] * term for g, term in zip(planes.T, t, strict=True)) - d) <= MAX_VOTE_DISTANCE_PX
    g = planes[np.argmax(near @ weight)]
    g = irls(t.T, d, lambda error: weight * cauchy(error, MAX_VOTE_DISTANCE_PX) ** 2, 1e-6 * np.eye(3), g, rounds=10)
    return g, np.abs(g @ terms - step)
