"""Matches of textureless regions, such as walls, by planes on which wide windows of a whole region agree.

Where an image shows next to nothing, a pixel's own match is chance. Distances of features, summed over a wide window,
are least at the right displacement more often than at any other. So at level 1, in each large region without matches
and texture:

1. along its epipolar line each pixel takes the displacement with the least sum over a window of the region, of all
   displacements that were matched and of farther ones, and a fraction of a pixel by the sums on both sides;
2. a plane is fitted robustly: the displacement along the line is a linear function of column and row. The more a
   window's sum exceeds that of its best displacement for all others, the more it counts;
3. if clearly more windows agree with the plane than would by chance, pixels are matched at its displacement whose
   windows speak no more against it than those that agree do: their sum there exceeds their least by as little. Their
   standard deviation is that of the agreeing windows. The rest of the region is filled with the plane.

A window has a vote if most displacements leave it inside the right image, and if its match there is mutual: of all
windows that any displacement leads to the same right pixel, one with the same displacement is the most alike. What the
right image hides, such as the strip beside a near thing, has no match, and takes what belongs to another. Windows to
which two displacements are equal (a black or an overexposed sky) have no vote either. A window whose best displacement
is one of the last two on either side does not agree. Nearly half of a region must have a
vote: what lies between a near thing and the image's border may be hidden in the right image.

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
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
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
"""Steps from the best one to those that it must be distinct from."""


class Region(NamedTuple):
    """A region, by the window that holds it, and what its pixels are compared with.

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
    """What a search tells of each pixel of a region, (row, col).

    ``tried``: int32, steps that leave all of its window inside the right image. ``best, least``: float32, the step with
    the least sum of distances over the window, moved by a fraction, and that sum. ``distinct``: float32, by how much
    the sum of each step more than :data:`MIN_DISTINCT_STEPS` from the best one exceeds it, 0 where there is none.
    ``mutual``: bool, whether no step so far from it leads a window more alike to the same pixel.
    """

    tried: AnyArray
    best: AnyArray
    least: AnyArray
    distinct: AnyArray
    mutual: NDArray[np.bool_]


class SoFar(NamedTuple):
    """Of each pixel: how many steps were tried; the best one and its sum; the sums a step before and after it; the
    least one far from it. And of each right pixel the least mean distance of the windows led to it, and the step that
    did."""

    tried: AnyArray
    best: AnyArray
    least: AnyArray
    before: AnyArray
    after: AnyArray
    rival: AnyArray
    claim: AnyArray
    claimant: AnyArray


def search(region: Region, steps: AnyArray) -> Searched:
    """The best step along the line of each pixel of a region, of ``steps``: (n,) float32 pixels, ascending by 1."""
    shape = region.inside.shape
    tried, (best, least, distinct) = np.zeros(shape, np.int32), np.zeros((3, *shape), np.float32)
    found = Searched(tried, best, least, distinct, np.zeros(shape, bool))
    here, there = np.full((5, *shape), np.inf, np.float32), np.full((2, *region.right.shape), np.inf, np.float32)
    so_far = SoFar(tried, *here, *there)
    # Sums of the steps before, and the least of all that are more than MIN_DISTINCT_STEPS behind.
    last, passed, size = deque[AnyArray](), np.full(shape, np.inf, np.float32), region.size
    for step in steps:
        total = _sums(region, np.full(shape, step))
        if len(last) > MIN_DISTINCT_STEPS:
            np.minimum(passed, last.popleft(), out=passed)
        _look(region, step, (total, last[-1] if last else passed, passed, size), so_far)
        last.append(total)
    _judge(region, so_far, found)
    return found


def _sums(region: Region, at: AnyArray) -> AnyArray:
    """Sum (row, col) of the distances of a region's pixels in each window, float32; infinite outside of the region and
    where one of them leads out of the right image. ``at``: the step of each pixel along its line, float32."""
    cost, outside = np.zeros(at.shape, np.float32), np.zeros(at.shape, np.uint8)
    _distances(region, at, cost, outside)
    total = window_sum32(cost, WINDOW_SIDE_PX)
    total[(cv2.dilate(outside, np.ones(2 * (WINDOW_SIDE_PX,), np.uint8)) != 0) | ~region.inside] = np.inf
    return total


@njit(cache=True, nogil=True)
def _end(region, y, x, step):  # type: ignore[no-untyped-def]
    """Row and column of the right image that its step along its line leads a pixel of the window to."""
    line = region.lines[y, x]
    u, v = epipolar.on_line((line[0], line[1], line[2]), step)
    return np.int64(np.rint(y + region.y0 + v)), np.int64(np.rint(x + region.x0 + u))


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _look(region, step, sums, so_far):  # type: ignore[no-untyped-def]
    """Update ``so_far`` with the sums of one more step; ``sums``: those of the step before, the least of those far
    behind, and the windows' sizes besides."""
    total, previous, passed, size = sums
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            since = step - so_far.best[y, x]
            if total[y, x] < so_far.least[y, x]:
                so_far.best[y, x], so_far.least[y, x] = step, total[y, x]
                so_far.before[y, x], so_far.after[y, x], so_far.rival[y, x] = previous[y, x], np.inf, passed[y, x]
            elif since == 1:
                so_far.after[y, x] = total[y, x]
            elif since > MIN_DISTINCT_STEPS:
                so_far.rival[y, x] = min(so_far.rival[y, x], total[y, x])
            if total[y, x] < np.inf:
                so_far.tried[y, x] += 1
                j, i = _end(region, y, x, step)
                if total[y, x] / size[y, x] < so_far.claim[j, i]:
                    so_far.claim[j, i], so_far.claimant[j, i] = total[y, x] / size[y, x], step


@njit(cache=True, nogil=True)
def _judge(region, so_far, found):  # type: ignore[no-untyped-def]
    """Write what all steps together tell. Sums of absolute differences are more like two lines than like a parabola."""
    for y in range(found.mutual.shape[0]):
        for x in range(found.mutual.shape[1]):
            step, least = so_far.best[y, x], so_far.least[y, x]
            before, after = so_far.before[y, x], so_far.after[y, x]
            found.best[y, x], found.least[y, x] = step, least
            if least < np.inf:
                j, i = _end(region, y, x, step)
                found.mutual[y, x] = abs(so_far.claimant[j, i] - step) <= MIN_DISTINCT_STEPS
                if max(before, after) < np.inf:  # no end of the steps
                    found.best[y, x] += linear(before, least, after)
                if so_far.rival[y, x] < np.inf:
                    found.distinct[y, x] = so_far.rival[y, x] - least


REGION_LEVEL = 1
"""Halving once halves noise, and a quarter of the pixels is to be searched."""


MIN_REGION_PX = 6 * WINDOW_SIDE_PX * WINDOW_SIDE_PX
"""Least size of a region, and of the part of it that has a vote, pixels of the level."""

MAX_VOTE_DISTANCE_PX = 1.25
"""Pixels of the level: the plane is that with the most votes nearer than this; with twice of it tilted planes were
chosen. No whole number, as displacements are."""

MAX_AGREE_DISTANCE_PX = 2.5
"""Pixels of the level: windows agree with the plane that are nearer than this. No whole number, either."""

MAX_SLOPE = MAX_VOTE_DISTANCE_PX / WINDOW_RADIUS_PX
"""Displacements a pixel: across the windows of a steeper plane no displacement is right."""


class Planes(NamedTuple):
    """Planes of textureless regions.

    ``region``: (row, col) of level 1, int8, number of the region from 1 on, negative where it is not matched but filled
    alone; 0 elsewhere. ``terms``: of each region, pixels of level 0: terms (1, x, y) of the displacement along the
    lines of ``f``, and its standard deviation.
    """

    region: AnyArray
    terms: list[list[float]]
    f: epipolar.Matrix

    def cut(self, window: Window) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Region, as above, of the pixels of a window of level 0; columns, rows, standard deviations of its plane."""
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
    # Of the pixels below none is matched.
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
        # Half of the displacements leave a window with a vote inside the right image.
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
        # By how much a pixel's distance, mean of its window, exceeds there that of the window's least sum.
        more = np.full(inside.shape, np.inf)
        more[usable] = (_sums(region, on_plane)[usable] - found.least[usable]) / region.size[usable]
        inner = (steps[1] + 0.5 < step) & (step < steps[-2] - 0.5)
        agree = (error <= MAX_AGREE_DISTANCE_PX) & inner & np.isfinite(more[y, x])
        if _sure(agree, votes, found.tried[y, x]):
            terms.append(_at_level_0(g, error[agree]))
            # 0.95: share of the agreeing windows that speak no more against the plane than a window may whose pixel is
            # matched.
            alike = more <= np.quantile(more[y[agree], x[agree]], 0.95)
            # What has another match of its own is not of this plane.
            label[window.slices][inside & ~(usable & found.mutual)] = -len(terms)
            label[window.slices][usable & alike] = len(terms)
    return Planes(label, terms, f)


def _sure(agree: AnyArray, votes: AnyArray, tried: AnyArray) -> bool:
    """Whether clearly more windows agree than would by chance of the steps ``tried`` in each."""
    chance = np.average(2 * MAX_AGREE_DISTANCE_PX / tried, weights=votes)
    # Windows that do not overlap and are equally distinct would have to be as many to tell as much.
    windows = votes.sum() ** 2 / np.sum(votes**2) / WINDOW_SIDE_PX**2
    spread = np.sqrt(chance * (1 - chance) / windows)
    # 6.0: standard deviations by which more windows agree than by chance: of a range of 40 displacements at each of
    # three corners there are some 10^5 different planes, and the best one is taken.
    return bool(np.average(agree, weights=votes) >= chance + 6.0 * spread)


def _at_level_0(g: AnyArray, error: AnyArray) -> list[float]:
    """Terms of a plane in pixels of level 0, and the standard deviation of steps with this ``error``."""
    # Pixel x of the level is (x + 1/2) 2^level - 1/2 of level 0, where displacements are 2^level as long.
    scale = 2.0**REGION_LEVEL
    middle = 0.5 / scale - 0.5
    std = np.hypot(scale * MAD_TO_SIGMA * epipolar.typical(error), BLANK_STD_PX)
    return [float(t) for t in (scale * (g[0] + middle * (g[1] + g[2])), g[1], g[2], std)]


def _steps(matches: Mapping[str, AnyArray], f: epipolar.Matrix, near_sign: float) -> AnyArray:
    """Displacements along the lines that are tried, pixels of the level; ``near_sign``: of nearer ones, 0 unknown."""
    y, x = thinned(matches["validity"] == 0, MAX_FIT_MATCHES)
    a, b, _ = epipolar.lines_at(f, x, y)
    # How far along their lines matches lead: what ``epipolar.on_line`` undoes.
    along = b * matches["u"][y, x] - a * matches["v"][y, x]
    low, high = np.quantile(along, (0.005, 0.995)) * 0.5**REGION_LEVEL
    # Half of the range beyond its far end, and some pixels: a wall is often farther than all else.
    beyond = 0.5 * (high - low) + 4
    # Those at the ends do not count.
    low, high = low - (2 if near_sign < 0 else beyond), high + (2 if near_sign > 0 else beyond)
    return np.arange(np.floor(low), np.ceil(high) + 1, dtype=np.float32)


def _regions(weak: NDArray[np.bool_]) -> Iterator[tuple[Window, NDArray[np.bool_]]]:
    """Windows of the large regions that hang together, and which of their pixels belong to them; the largest first."""
    # What hangs together by a pixel or two is not one region.
    opened = cv2.morphologyEx(weak.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, number, about, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    sizes = about[1:, cv2.CC_STAT_AREA]
    # Their numbers fit a byte with a sign.
    for n in np.argsort(-sizes, kind="stable")[:127]:
        if sizes[n] < MIN_REGION_PX:
            return
        x, y, wide, high, _ = (int(k) for k in about[n + 1])
        window = Window(y, y + high, x, x + wide)
        yield window, number[window.slices] == n + 1


def _fit(x: AnyArray, y: AnyArray, step: AnyArray, votes: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Terms (1, x, y) of the plane that steps with the most ``votes`` agree with, and how far each step is from it.

    Random sample consensus with a fixed seed, then least squares with the weights of Cauchy squared. Votes are whole
    numbers, so that their sums are exact.
    """
    terms, rng = np.stack([np.ones(len(x)), x, y]), np.random.default_rng(0)
    # A plane is fitted to a thousand windows at most.
    sample = rng.choice(len(x), min(1000, len(x)), replace=False)
    t, d, weight = np.ascontiguousarray(terms[:, sample]), step[sample], votes[sample]
    # Of 500 planes 32 are right where four in ten windows are.
    three = rng.choice(len(sample), (500, 3), p=weight / weight.sum())
    # The hold gives a plane, which has few votes, to three windows on a line, and to one that was drawn twice.
    planes = np.linalg.solve(t.T[three] + 1e-6 * np.eye(3), d[three][..., None])[..., 0]
    # Should all be steep, the flat one is left.
    planes = np.vstack([[np.median(d), 0.0, 0.0], planes[(np.abs(planes[:, 1:]) <= MAX_SLOPE).all(axis=1)]])
    near = np.abs(sum(g[:, None] * term for g, term in zip(planes.T, t, strict=True)) - d) <= MAX_VOTE_DISTANCE_PX
    g = planes[np.argmax(near @ weight)]
    g = irls(t.T, d, lambda error: weight * cauchy(error, MAX_VOTE_DISTANCE_PX) ** 2, 1e-6 * np.eye(3), g, rounds=10)
    return g, np.abs(g @ terms - step)
