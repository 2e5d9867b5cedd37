"""Kernel of Locus reconstruction (paper, section 4.4): cells straight from the disparity.

For a cell with foot F and normal N let P(Z) = F + Z N, p_l and p_r its projections and d the disparity vector. The
paper minimises |g(Z)|, g = p_l(Z) + d(p_l(Z)) - p_r(Z). Here the *sign change* of s(Z) = g(Z) . e is solved, e being
the direction at p_r in which a point moves when it recedes along the left camera's ray (the local epipolar line): the
same solution with a tenth of the evaluations, and more exact, because a minimum is flat and a sign change is not.

s > 0: the surface that the left camera sees behind P is farther than P, so P is in free space; s < 0: P is behind the
surface. A terrain surface is a change from free (above) to behind (below) along the normal. Where the change happens
across a depth jump between two pixels nothing was seen: the cell is occluded there.

A few dozen cells are followed side by side, each in its own *lane*: their lines are divided into steps
(:mod:`rille.stages.terrain.locus.lines`), steps are looked at several at once
(:mod:`rille.stages.terrain.locus.points`) until s changes its sign, and the roots of all the changes found are solved
together (:mod:`rille.stages.terrain.locus.roots`). A lane whose root does not stand goes on from there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.terrain.locus.lines import (
    BOTTOM,
    COUNT,
    DZ,
    FOOT,
    HIGH,
    LAST,
    LOW,
    NORMAL,
    START,
    TOP,
    clip,
    lines,
    spans,
)
from rille.stages.terrain.locus.lines import PLANES as LINE_PLANES
from rille.stages.terrain.locus.points import (
    LANES,
    POINT_PLANES,
    POINTS,
    STEPS,
    LineSteps,
    Observed,
    S,
    climb,
    meet,
    pixels,
)
from rille.stages.terrain.locus.roots import PLANES as ROOT_PLANES
from rille.stages.terrain.locus.roots import accept, gather, roots, slopes

WAY, PLACE, LEVEL, FIRST = (k * LANES for k in range(LINE_PLANES, LINE_PLANES + 4))
"""Planes of the search: -1 downwards, 1 upwards, 0 not begun; the step looked at last, and s there; s at the start."""
UPPER_Z, UPPER_S, LOWER_Z, LOWER_S = (k * LANES for k in range(LINE_PLANES + 4, LINE_PLANES + 8))
"""Planes of the bracket that was found: elevation and s of both ends, as :func:`gather` copies them."""
PLANES = LINE_PLANES + 8
DONE, MORE, FOUND = 0, 1, 2


class BlockCells(NamedTuple):
    """Cells of a block.

    ``feet``, ``normals`` (r, c, 3) metres, frame of the surface; ``low``, ``high`` (r, c) interval of Z in which the
    search starts, metres, NaN: the cell is left out. The search may leave it: upwards while the point is behind the
    surface, downwards while it is free.
    """

    feet: Floats
    normals: Floats
    low: Floats
    high: Floats


class PairCameras(NamedTuple):
    """``left``, ``right`` (3, 4) projections from the frame of the surface to pixels; ``epipole`` (3,) homogeneous
    projection of the left camera's centre into the right image; ``sizes`` (4,) width and height of the left, then of
    the right image."""

    left: Floats
    right: Floats
    epipole: Floats
    sizes: Floats


class _Room(NamedTuple):
    """Room to work in: planes of the lanes that search, of those whose root is solved, and of points; numbers of the
    lanes that go on and of those with a bracket; the cell of each lane."""

    lanes: Floats
    solved: Floats
    points: Floats
    active: NDArray[np.int64]
    found: NDArray[np.int64]
    cells: NDArray[np.int64]


@njit(cache=True, nogil=True, error_model="numpy")
def search(cells: BlockCells, z_range: tuple[float, float], cameras: PairCameras, seen: Observed, out: Floats) -> None:
    """Solve every cell of a block.

    Parameters
    ----------
    z_range : limits of Z, metres.
    out : (r, c, 4) elevation (m), its standard deviation (m), residual (px) and grey value of the highest change from
        free to behind that stands; to be filled with NaN before.
    """
    lanes, solved, points = np.zeros(PLANES * LANES), np.zeros(ROOT_PLANES * LANES), np.zeros(POINT_PLANES * POINTS)
    active, found, chosen = np.empty(LANES, np.int64), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    room = _Room(lanes, solved, points, active, found, chosen)
    foot, normal, rows = cells.feet.reshape(-1, 3), cells.normals.reshape(-1, 3), out.reshape(-1, 4)
    low, high = cells.low.ravel(), cells.high.ravel()
    n, last = 0, low.size - 1
    for i in range(low.size):
        if not math.isnan(low[i]):
            chosen[n], lanes[LOW + n], lanes[HIGH + n] = i, low[i], high[i]
            for k in range(3):
                lanes[FOOT + k * LANES + n], lanes[NORMAL + k * LANES + n] = foot[i, k], normal[i, k]
            n += 1
        if n == LANES or (n > 0 and i == last):
            lines(n, cameras.left, cameras.right, lanes)
            clip(n, cameras.sizes, z_range[0], z_range[1], lanes)
            spans(n, lanes)
            _solve(n, room, cameras.epipole, seen, rows)
            n = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(n, room, epipole, seen, out):  # type: ignore[no-untyped-def]
    """Follow ``n`` lanes to the end."""
    lanes, solved, points, active, found, cells = room
    count = 0
    for m in range(n):
        lanes[WAY + m], lanes[PLACE + m] = 0.0, lanes[START + m] + 1.0
        if lanes[TOP + m] > lanes[BOTTOM + m]:
            active[count] = m
            count += 1
    while count:
        hits = 0
        while count:
            _look(active, count, lanes, seen.image.shape, points)
            meet(STEPS * count, epipole, seen, points)
            count, hits = _scan(active, count, found, hits, lanes, points)
        gather(found, hits, lanes, DZ, UPPER_Z, solved)
        roots(hits, solved, epipole, seen, points)
        slopes(hits, solved, epipole, seen, points)
        refused = accept(hits, found, cells, solved, seen, points, out)
        for t in range(refused):
            if lanes[PLACE + found[t]] > 0.0:
                active[count] = found[t]
                count += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _look(active, count, lanes, shape, room):  # type: ignore[no-untyped-def]
    """Project the next steps of the active lanes."""
    for t in range(count):
        m = active[t]
        # A lane that has not begun looks downwards: its first point is the start, which tells the way.
        way = 1.0 if lanes[WAY + m] > 0.0 else -1.0
        climb(
            lanes, m, LineSteps(lanes[BOTTOM + m], lanes[PLACE + m] + way, way, lanes[DZ + m]), shape, room[STEPS * t :]
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _scan(active, count, found, hits, lanes, room):  # type: ignore[no-untyped-def]
    """Follow s over the steps looked at: lanes that go on stay active, those with a bracket are added to ``found``."""
    keep = 0
    for t in range(count):
        m, first = active[t], STEPS * t
        fresh = lanes[WAY + m] == 0.0
        if lanes[WAY + m] > 0.0:
            outcome = _upwards(lanes, m, room, first)
        elif fresh and _begin(lanes, m, room, first):
            outcome = MORE
        else:
            outcome = _downwards(lanes, m, room, first, 1 if fresh else 0)
        if outcome == MORE:
            active[keep] = m
            keep += 1
        elif outcome == FOUND:
            found[hits] = m
            hits += 1
    return keep, hits


@njit(cache=True, nogil=True, error_model="numpy")
def _begin(lanes, m, room, k):  # type: ignore[no-untyped-def]
    """Take s at the start from point ``k``; whether the search begins upwards, because the point is behind."""
    lanes[FIRST + m] = lanes[LEVEL + m] = pixels(room, S, k)
    lanes[PLACE + m] = lanes[START + m]
    upwards = (lanes[LEVEL + m] < 0.0) & (lanes[START + m] < lanes[COUNT + m])
    lanes[WAY + m] = 1.0 if upwards else -1.0
    return upwards


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _downwards(lanes, m, room, first, begin):  # type: ignore[no-untyped-def]
    """Go down from free to behind, beyond the last step only while free."""
    place, last, above, outcome = lanes[PLACE + m], lanes[LAST + m], lanes[LEVEL + m], MORE
    for i in range(begin, STEPS):
        place -= 1.0
        s = room[S + first + i]
        if place < 0.0:
            outcome = DONE
            break
        if above >= 0.0 and s < 0.0:
            upper = pixels(room, S, first + i - 1) if i else lanes[LEVEL + m]
            lanes[LEVEL + m] = pixels(room, S, first + i)
            _bracket(lanes, m, place + 1.0, upper, lanes[LEVEL + m])
            # 0 ends a lane whose root is refused: below the last step only free ground is searched on.
            lanes[PLACE + m] = place if place > last else 0.0
            outcome = FOUND
            break
        if place <= last and not s >= 0.0:
            outcome = DONE
            break
        above = s
    if outcome == MORE:
        lanes[PLACE + m], lanes[LEVEL + m] = place, pixels(room, S, first + STEPS - 1)
    return outcome


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _upwards(lanes, m, room, first):  # type: ignore[no-untyped-def]
    """Go up while behind; what comes after that, or after a bracket, is the way down from the start."""
    place, outcome, turned = lanes[PLACE + m], MORE, False
    for i in range(STEPS):
        place += 1.0
        s = room[S + first + i]
        turned = place > lanes[COUNT + m] or not s < 0.0
        if turned:
            if place <= lanes[COUNT + m] and s >= 0.0:
                below = pixels(room, S, first + i - 1) if i else lanes[LEVEL + m]
                _bracket(lanes, m, place, pixels(room, S, first + i), below)
                outcome = FOUND
            break
    if turned:
        lanes[WAY + m], lanes[PLACE + m], lanes[LEVEL + m] = -1.0, lanes[START + m], lanes[FIRST + m]
    else:
        lanes[PLACE + m], lanes[LEVEL + m] = place, pixels(room, S, first + STEPS - 1)
    return outcome


@njit(cache=True, nogil=True, error_model="numpy")
def _bracket(lanes, m, step, upper, lower):  # type: ignore[no-untyped-def]
    """The step below ``step``, with s at both ends."""
    lanes[UPPER_Z + m], lanes[UPPER_S + m] = lanes[BOTTOM + m] + step * lanes[DZ + m], upper
    lanes[LOWER_Z + m], lanes[LOWER_S + m] = lanes[BOTTOM + m] + (step - 1.0) * lanes[DZ + m], lower
