"""Matches of textureless regions, such as walls: what no window tells, a whole region does.

Where an image shows next to nothing, a pixel's own match is chance. Distances of features, summed over a wide window,
are least at the right displacement more often than at any other. So at level 1, in each large region without matches
and texture:

1. along its epipolar line each pixel takes the displacement with the least sum over :data:`SIDE` x :data:`SIDE` pixels
   of the region, of all displacements that were matched and of farther ones (:data:`BEYOND`);
2. a plane is fitted robustly: the displacement along the line is a linear function of column and row. The more a
   window's sum exceeds that of its best displacement for all others, the more it counts;
3. if clearly more windows agree with the plane than would by chance, the pixels whose windows do are matched, at the
   plane's displacement. Their standard deviation is that of the agreeing windows.

Windows that any of these displacements leads out of the right image have no vote, nor have those to which two are equal
(a black or an overexposed sky). A window whose best displacement is one of the last two on either side does not agree.
Half of a region must have a vote: what lies between a near thing and the image's border may be hidden in the right
image.

Chosen with motorcycle, Baby1, Cloth1, Lampshade1 and Midd1, as they are and with the right image degraded: on the wall
of Midd1, three eighths of the image, wide windows are right for four in ten pixels, matches for two. Blocks of JPEG
images look like structure: there a plane may be some pixels off.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.coarse_to_fine.hierarchy import Prepared
from rille.stages.hfvm.finish.uncertainty import BLANK
from rille.stages.hfvm.images import plane
from rille.stages.hfvm.images.window import Raster, Window, cut, whole
from rille.stages.hfvm.level import epipolar
from rille.stages.hfvm.level.features import distance
from rille.stages.numeric.robust import MAD_TO_SIGMA
from rille.stages.numeric.windows import window_sum32

LEVEL = 1
"""Halving once halves noise, and a quarter of the pixels is to be searched."""

DEVIATION = 1.0
"""Grey levels of local deviation below which a pixel of the level may belong to a region."""

RADIUS = 6
SIDE = 2 * RADIUS + 1
"""Side of the window, pixels of the level."""

LEAST = 6 * SIDE * SIDE
"""Least size of a region, and of the part of it that has a vote, pixels of the level."""

MOST = 255
"""Regions of an image; their numbers fit a byte."""

CAP = 60
"""Greatest distance of two features [byte steps]: about three times that of noise."""

BEYOND = 0.5, 4
"""Share of the range of the matched displacements that is searched beyond its far end, and pixels of the level: a wall
is often farther than all else."""

NEAR, TOLERANCE = 1.25, 2.5
"""Pixels of the level: the plane is that with the most votes nearer than the one (with the other tilted planes were
chosen); windows agree with it that are nearer than the other. No whole numbers, as displacements are."""

APART = 2
"""Steps from the best one to those that it must be distinct from."""

SURE = 6.0
"""Standard deviations by which more windows agree than by chance: of a range of 40 displacements at each of three
corners there are some 10^5 different planes, and the best one is taken."""

SAMPLES = 1000
"""Displacements that a plane is fitted to."""

TRIALS = 500
"""Planes that are tried: where four in ten windows are right, 32 of them are."""

ITERATIONS = 10


class Planes(NamedTuple):
    """Matches on the planes of textureless regions.

    ``region``: (row, col) of level 1, uint8, number of the region from 1 on, 0 where nothing is matched. ``terms``: of
    each region, pixels of level 0: terms (1, x, y) of the displacement along the lines of ``f``, and its standard
    deviation.
    """

    region: Raster
    terms: list[list[float]]
    f: epipolar.Matrix

    def cut(self, window: Window) -> tuple[NDArray[np.bool_], AnyArray, AnyArray, AnyArray]:
        """Of the pixels of a window of level 0: whether they are matched, columns, rows and standard deviations."""
        twice = cut(self.region, window.parent()).repeat(2, axis=0).repeat(2, axis=1)
        rows, cols = window.shape
        region = twice[window.y0 % 2 :, window.x0 % 2 :][:rows, :cols]
        y, x = np.nonzero(region)
        g = np.array([4 * [0.0], *self.terms])[region[y, x]]
        x0, y0 = x + window.x0, y + window.y0
        along = g[:, 0] + g[:, 1] * x0 + g[:, 2] * y0
        u, v, std = np.zeros((3, *window.shape), np.float32)
        u[y, x], v[y, x] = epipolar.on_line(epipolar.lines_at(self.f, x0, y0), along)
        std[y, x] = g[:, 3]
        return np.asarray(region != 0), u, v, std


def find(pair: Prepared, f: epipolar.Matrix, unmatched: AnyArray, along: AnyArray, far_sign: float) -> Planes:
    """Find the planes of the left image's textureless regions.

    Parameters
    ----------
    f : fundamental matrix of level 0, see :func:`rille.stages.hfvm.level.epipolar.oriented`.
    unmatched : (row, col) bool of level 1: of the pixels of level 0 below none is matched.
    along : displacements (n,) of matches along their lines, pixels of level 0.
    far_sign : sign of the column displacement of far things against near ones; 0 unknown.
    """
    shape, other = pair.shapes(LEVEL)
    label, terms = np.zeros(shape, np.uint8), list[list[float]]()
    patch, valid = pair.left.patch(LEVEL, whole(shape), deviation=True), pair.left.view.valid(LEVEL, whole(shape))
    assert patch.deviation is not None
    steps = _steps(along, far_sign if epipolar.along_rows(f, pair.shapes(0)[0]) else 0.0)
    up, right = plane.finer(LEVEL), None
    for window, region in _regions(unmatched & (patch.deviation < DEVIATION) & (valid != 0)):
        right = right or (pair.right.patch(LEVEL, whole(other)).words, pair.right.view.valid(LEVEL, whole(other)))
        its_lines = epipolar.lines(up.T @ f @ up, window.shape, window.x0, window.y0)
        images = np.ascontiguousarray(patch.words[window.slices]), right
        seen, best, distinct = search(images, region, its_lines, steps, window)
        y, x = np.nonzero(seen & (distinct > 0))
        if len(y) < max(LEAST, 0.5 * np.count_nonzero(region)):
            continue
        votes, step = distinct[y, x].astype(np.float64), best[y, x].astype(np.float64)
        g, error = _fit(x + window.x0, y + window.y0, step, votes)
        agree = (error <= TOLERANCE) & (steps[1] < step) & (step < steps[-2])
        if _sure(agree, votes, len(steps)):
            terms.append(_at_level_0(g, error[agree]))
            label[window.slices][y[agree], x[agree]] = len(terms)
    return Planes(label, terms, f)


def _sure(agree: AnyArray, votes: AnyArray, steps: int) -> bool:
    """Whether clearly more windows agree than of so many steps would by chance."""
    chance = 2 * TOLERANCE / steps
    # Windows that do not overlap and are equally distinct would have to be as many to tell as much.
    windows = votes.sum() ** 2 / np.sum(votes**2) / SIDE**2
    spread = np.sqrt(chance * (1 - chance) / windows)
    return bool(np.average(agree, weights=votes) >= chance + SURE * spread)


def _at_level_0(g: AnyArray, error: AnyArray) -> list[float]:
    """Terms of a plane in pixels of level 0, and the standard deviation of steps with this ``error``."""
    # Pixel x of the level is (x + 1/2) 2^level - 1/2 of level 0, where displacements are 2^level as long.
    scale = 2.0**LEVEL
    middle = 0.5 / scale - 0.5
    std = np.hypot(scale * MAD_TO_SIGMA * epipolar.typical(error), BLANK)
    return [float(t) for t in (scale * (g[0] + middle * (g[1] + g[2])), g[1], g[2], std)]


def _steps(along: AnyArray, far_sign: float) -> AnyArray:
    """Displacements along the lines that are tried, pixels of the level; ``far_sign``: of farther ones, 0 unknown."""
    low, high = np.quantile(along, (0.005, 0.995)) * 0.5**LEVEL
    beyond = BEYOND[0] * (high - low) + BEYOND[1]
    # Those at the ends do not count.
    low, high = low - (2 if far_sign > 0 else beyond), high + (2 if far_sign < 0 else beyond)
    return np.arange(np.floor(low), np.ceil(high) + 1, dtype=np.float32)


def _regions(weak: NDArray[np.bool_]) -> Iterator[tuple[Window, NDArray[np.bool_]]]:
    """Windows of the large regions that hang together, and which of their pixels belong to them; the largest first."""
    # What hangs together by a pixel or two is not one region.
    opened = cv2.morphologyEx(weak.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, number, about, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    sizes = about[1:, cv2.CC_STAT_AREA]
    for n in np.argsort(-sizes, kind="stable")[:MOST]:
        if sizes[n] < LEAST:
            return
        x, y, wide, high, _ = (int(k) for k in about[n + 1])
        window = Window(y, y + high, x, x + wide)
        yield window, number[window.slices] == n + 1


def search(
    images: tuple[AnyArray, tuple[AnyArray, AnyArray]],
    region: NDArray[np.bool_],
    lines: AnyArray,
    steps: AnyArray,
    window: Window,
) -> tuple[NDArray[np.bool_], AnyArray, AnyArray]:
    """Search for the best step along the line of each pixel of a region.

    Parameters
    ----------
    images : features of the left window; features and mask of the whole right image.
    region : (row, col) bool, pixels of the window.
    lines : of these pixels, see :func:`rille.stages.hfvm.level.epipolar.lines`.
    steps : (n,) float32 pixels, ascending by 1.
    window : where the left window lies.

    Returns
    -------
    (row, col) bool, pixels of whose window no step leads out of the right image; float32, their best steps; float32,
    by how much the sum is less than that of each step more than :data:`APART` from the best.
    """
    cost, best, outside = (np.zeros(region.shape, kind) for kind in (np.float32, np.float32, np.uint8))
    least, least_passed, least_behind, least_ahead = np.full((4, *region.shape), np.inf, np.float32)
    passed: deque[AnyArray] = deque()
    for step in steps:
        _distances(images, region, lines, (step, window.x0, window.y0), (cost, outside))
        total = window_sum32(cost, SIDE)
        if len(passed) > APART:
            np.minimum(least_passed, passed.popleft(), out=least_passed)
        passed.append(total)
        _keep(total, step, least_passed, (least, best, least_behind, least_ahead))
    seen = cv2.dilate(outside, np.ones((SIDE, SIDE), np.uint8)) == 0
    return region & seen, best, np.minimum(least_behind, least_ahead) - least


@njit(cache=True, nogil=True)
def _distances(images, region, lines, at, out):  # type: ignore[no-untyped-def]
    """Distances of a region's pixels to those a step away along their lines; ``outside`` is set where there is none."""
    (left, (right, valid)), (step, x0, y0), (cost, outside) = images, at, out
    rows, cols = right.shape
    for y in range(region.shape[0]):
        for x in range(region.shape[1]):
            if region[y, x]:
                u, v = epipolar.on_line((lines[y, x, 0], lines[y, x, 1], lines[y, x, 2]), step)
                i, j = np.int64(np.rint(x + x0 + u)), np.int64(np.rint(y + y0 + v))
                if i >= 0 and i < cols and j >= 0 and j < rows and valid[j, i]:
                    cost[y, x] = min(distance(left[y, x], right[j, i]), CAP)
                else:
                    outside[y, x] = 1


@njit(cache=True, nogil=True)
def _keep(total, step, least_passed, out):  # type: ignore[no-untyped-def]
    """The best step so far of each pixel, and the least sums of the steps far enough behind it and ahead of it.

    ``least_passed``: the least sum of all steps more than APART behind this one.
    """
    least, best, least_behind, least_ahead = out
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            if total[y, x] < least[y, x]:
                least[y, x], best[y, x] = total[y, x], step
                least_behind[y, x], least_ahead[y, x] = least_passed[y, x], np.inf
            elif step - best[y, x] > APART:
                least_ahead[y, x] = min(least_ahead[y, x], total[y, x])


def _fit(x: AnyArray, y: AnyArray, step: AnyArray, votes: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Terms (1, x, y) of the plane that steps with the most ``votes`` agree with, and how far each step is from it.

    Random sample consensus with a fixed seed, then least squares with the weights of Cauchy squared. Votes are whole
    numbers, so that their sums are exact.
    """
    terms, rng = np.stack([np.ones(len(x)), x, y]), np.random.default_rng(0)
    some = rng.choice(len(x), min(SAMPLES, len(x)), replace=False)
    t, d, weight = np.ascontiguousarray(terms[:, some]), step[some], votes[some]
    three = rng.choice(len(some), (TRIALS, 3), p=weight / weight.sum())
    # The hold gives a plane, which has few votes, to three windows on a line, and to one that was drawn twice.
    planes = np.linalg.solve(t.T[three] + 1e-6 * np.eye(3), d[three][..., None])[..., 0]
    g = planes[np.argmax(_support(planes, t, d, weight))]
    for _ in range(ITERATIONS):
        error = epipolar.residuals(t, d, -g)
        normal, side = epipolar.weighted_normal(t, d, weight / (1.0 + (error / NEAR) ** 2) ** 2)
        g = np.linalg.solve(normal + 1e-6 * np.eye(3), side)
    return g, np.abs(epipolar.residuals(terms, step, -g))


@njit(cache=True, nogil=True)
def _support(planes, terms, step, votes):  # type: ignore[no-untyped-def]
    """Votes (n,) of the steps that are near each plane."""
    found = np.zeros(len(planes))
    for n in range(len(planes)):
        g = planes[n]
        for k in range(len(step)):
            if abs(g[0] * terms[0, k] + g[1] * terms[1, k] + g[2] * terms[2, k] - step[k]) <= NEAR:
                found[n] += votes[k]
    return found
