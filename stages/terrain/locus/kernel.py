"""Kernel of Locus reconstruction (paper, section 4.4): cells straight from the disparity.

For a cell with foot F and normal N let P(Z) = F + Z N, p_l and p_r its projections and d the disparity vector. The
paper minimises |g(Z)|, g = p_l(Z) + d(p_l(Z)) - p_r(Z). Here the *sign change* of s(Z) = g(Z) . e is solved, e being
the direction at p_r in which a point moves when it recedes along the left camera's ray (the local epipolar line): the
same solution with a tenth of the evaluations, and more exact, because a minimum is flat and a sign change is not.

s > 0: the surface that the left camera sees behind P is farther than P, so P is in free space; s < 0: P is behind the
surface. A terrain surface is a change from free (above) to behind (below) along the normal. Where the change happens
across a depth jump between two pixels nothing was seen: the cell is occluded there.

**Which change, where there are several.** The search begins at the top of the cell's interval. If the point there is
free, it goes down to the first change; if it is behind the surface, it first goes up to the nearest change above the
start. A change *stands* if its residual, its slope and the jump of the disparities around it are within the limits
(:func:`accept`); after one that does not, the search goes on, downwards from the start in the end. So the result is the
highest change that stands at or below the start, or the nearest one above it. A cell whose interval, handed down from
its coarse neighbours, lies wholly on another surface may so miss one that a search of the whole range would find.

A few dozen cells are followed side by side, each in its own *lane*::

    search               blocks of LANES cells: lines, clip, spans (steps of a pixel at most)
      _solve             until every lane has ended
        _look, meet      s at the next STEPS steps of each active lane
        _scan            follows s: _begin, _upwards, _downwards; a change becomes a bracket
        gather, roots    regula falsi of all brackets together
        slopes, accept   what stands is written; other lanes go on from there

Values lie in *planes* of a buffer, one behind the other, whose sizes are constants: so the compiler knows that they do
not overlap, and computes several lanes or points side by side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32

NEAR = 1e-9  # least projective depth (metres): excludes the camera's own plane

LANES = 32
"""Cells that are solved together."""
STEPS = 8
"""Steps of one cell's line that are looked at together."""
POINTS = LANES * STEPS

X, Y, X_RIGHT, Y_RIGHT, FX, FY, PIXEL, U, V, S, ACROSS, POWER = (k * POINTS for k in range(12))
"""Planes of a buffer of points: p_l and p_r; fractions of p_l in its bilinear cell, and the pixel at that cell's start;
the disparity there; and as :func:`meet` gives them s and its part across the epipolar line, both times a norm whose
square is ``POWER``."""
POINT_PLANES = 12

LEFT_A, RIGHT_A, LEFT_B, RIGHT_B = (3 * k * LANES for k in range(4))
"""Planes of a buffer of lanes that hold each cell's line: its homogeneous projections a + z b, three planes each."""
LINE = 12
"""Number of these planes."""
Z = 12 * LANES
"""Plane of the elevation that is looked at."""

STEP_PX = 1.0  # search step: disparity is bilinear between pixels, so nothing hides in a shorter one
MARGIN = 2  # steps that the interval handed down from the coarse level is widened by
MAX_STEPS = 4096.0  # of one locus: more than the diagonal of a 12 megapixel image

FOOT, NORMAL, LOW, HIGH = (k * LANES for k in (13, 16, 19, 20))
BOTTOM, TOP, DZ, COUNT, START, LAST = (k * LANES for k in range(21, 27))
"""Planes of a buffer of lanes beside the lines: foot (3) and normal (3) of each cell, the interval that the search
starts in; the part of the line that both images see, a step, how many there are, first and last one searched."""
LINE_PLANES = 27

DIRECTION, REACHED, S_REACHED, S_START = (k * LANES for k in range(LINE_PLANES, LINE_PLANES + 4))
"""Planes of the search: its direction (-1 downwards, 1 upwards, 0 not begun); the step that was looked at last, or
:data:`ENDED`; s at that step; s at the start."""
ENDED = 0.0
"""Step reached by a lane that goes no farther if its root is refused: the lowest one."""
UPPER_Z, UPPER_S, LOWER_Z, LOWER_S = (k * LANES for k in range(LINE_PLANES + 4, LINE_PLANES + 8))
"""Planes of the bracket that was found: elevation and s of both ends, as :func:`gather` copies them."""
SEARCH_PLANES = LINE_PLANES + 8
DONE, MORE, FOUND = 0, 1, 2

SOLVED_PX = 1e-3  # |s| of a solution: a two-hundredth of the disparity's usual noise
TURNS = 16

# Another buffer, of the lanes whose root is solved: its planes behind the lines have other meanings.
STEP, Z0, S0, Z1, S1 = (k * LANES for k in range(13, 18))
"""Planes beside the lines: the search's step, and the bracket: s0 >= 0 at z0, s1 < 0 at z1."""
SIDE, OPEN, ROOT, UPWARDS, DOWNWARDS = (k * LANES for k in range(18, 23))
ROOT_PLANES = 23


class Line(NamedTuple):
    """The line of a cell in one image: its points F + Z N have the homogeneous projections a + Z b."""

    a0: float
    a1: float
    a2: float
    b0: float
    b1: float
    b2: float


class LineSteps(NamedTuple):
    """Points of a line that are looked at together: Z = bottom + (first + way m) dz, m < :data:`STEPS`."""

    bottom: float
    first: float
    way: float
    dz: float


class Observed(NamedTuple):
    """What is read at a pixel of the left image (rows, cols).

    ``disparity`` (2 rows cols,) column and row disparity (right minus left) of each pixel in turn, pixels, NaN where it
    must not be used; ``std`` (rows, cols) its standard deviation, pixels; ``image`` (rows, cols) grey values;
    ``limits`` (2,) greatest residual and greatest jump in the bilinear cell, pixels; ``scale`` (2,) pixels of the right
    image that one of the left one is wide and high.
    """

    disparity: Floats32
    std: Floats32
    image: Floats32
    limits: Floats
    scale: Floats


# Functions that take arrays and run once a cell are inlined where they are called: to count the references of their
# arguments takes longer than their work.
@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def line_of(lanes, a, b, m):  # type: ignore[no-untyped-def]
    """The line of lane ``m`` whose terms begin at planes ``a`` and ``b``."""
    return Line(
        lanes[a + m], lanes[a + LANES + m], lanes[a + 2 * LANES + m],
        lanes[b + m], lanes[b + LANES + m], lanes[b + 2 * LANES + m],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def project(line, z):  # type: ignore[no-untyped-def]
    """x, y of the line's point at elevation z, pixels, and its projective depth."""
    w = line.a2 + z * line.b2
    return (line.a0 + z * line.b0) / w, (line.a1 + z * line.b1) / w, w


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _put_point(left, right, z, shape, points, k):  # type: ignore[no-untyped-def]
    """Point ``k`` of a buffer: p_l and p_r of the lines' point at elevation z, and the bilinear cell of p_l."""
    x, y, w_left = project(left, z)
    xr, yr, w_right = project(right, z)
    rows, cols = shape
    inside = (w_left >= NEAR) & (w_right >= NEAR) & (x >= 0.0) & (y >= 0.0) & (x < cols - 1.0) & (y < rows - 1.0)
    # A point outside reads pixel 0, so that the loop over the disparity needs no branch; its NaN makes s one.
    x, y, xr = x if inside else 0.0, y if inside else 0.0, xr if inside else np.nan
    c, r = np.floor(x), np.floor(y)
    points[X + k], points[Y + k], points[X_RIGHT + k], points[Y_RIGHT + k] = x, y, xr, yr
    points[FX + k], points[FY + k], points[PIXEL + k] = x - c, y - r, r * float(cols) + c


@njit(cache=True, nogil=True, error_model="numpy")
def climb(lanes, m, steps, shape, points):  # type: ignore[no-untyped-def]
    """Project the next steps of lane ``m`` into both images; ``shape`` (rows, cols) of the left one."""
    left, right = line_of(lanes, LEFT_A, LEFT_B, m), line_of(lanes, RIGHT_A, RIGHT_B, m)
    for k in range(STEPS):
        _put_point(left, right, steps.bottom + (steps.first + steps.way * k) * steps.dz, shape, points, k)


@njit(cache=True, nogil=True, error_model="numpy")
def raise_to(lanes, n, shape, points):  # type: ignore[no-untyped-def]
    """Project the point at elevation :data:`Z` of each of ``n`` lanes."""
    for m in range(n):
        left, right = line_of(lanes, LEFT_A, LEFT_B, m), line_of(lanes, RIGHT_A, RIGHT_B, m)
        _put_point(left, right, lanes[Z + m], shape, points, m)


@njit(cache=True, nogil=True, error_model="numpy")
def meet(n, epipole, seen, points):  # type: ignore[no-untyped-def]
    """s of ``n`` projected points; NaN where a point is outside an image or disparity is undefined."""
    # To read the disparity at scattered pixels is what vectors cannot do, so it is a loop of its own.
    disparity, width = seen.disparity, seen.image.shape[1]
    for k in range(n):
        i = 2 * int(points[PIXEL + k])
        j = i + 2 * width
        fx, fy = points[FX + k], points[FY + k]
        w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
        points[U + k] = w00 * disparity[i] + w01 * disparity[i + 2] + w10 * disparity[j] + w11 * disparity[j + 2]
        points[V + k] = (
            w00 * disparity[i + 1] + w01 * disparity[i + 3] + w10 * disparity[j + 1] + w11 * disparity[j + 3]
        )
    e0, e1, e2 = epipole[0], epipole[1], epipole[2]
    for k in range(n):
        # g = p_l + d(p_l) - p_r
        xr, yr = points[X_RIGHT + k], points[Y_RIGHT + k]
        gx, gy = points[X + k] + points[U + k] - xr, points[Y + k] + points[V + k] - yr
        # On the ray of p_l, p_r(t) = (epipole + t q) / w for a fixed q: d p_r / d t is parallel to
        # p_r * epipole_2 - epipole_01.
        ex, ey = xr * e2 - e0, yr * e2 - e1
        # s = g . e / |e|: the search asks for its sign alone, so the root and the division are left to ``pixels``.
        power = ex * ex + ey * ey
        s = gx * ex + gy * ey
        points[S + k] = s if power > 0.0 else np.nan
        points[ACROSS + k], points[POWER + k] = gy * ex - gx * ey, power


@njit(cache=True, nogil=True, error_model="numpy")
def pixels(points, plane, k):  # type: ignore[no-untyped-def]
    """:data:`S` or :data:`ACROSS` of point ``k`` in pixels."""
    return points[plane + k] / math.sqrt(points[POWER + k])


@njit(cache=True, nogil=True, error_model="numpy")
def lines(n, left, right, lanes):  # type: ignore[no-untyped-def]
    """Projections of the lines of ``n`` cells by the (3, 4) projections of both images."""
    for side in range(2):
        p = right if side else left
        for k in range(3):
            p0, p1, p2, p3 = p[k, 0], p[k, 1], p[k, 2], p[k, 3]
            a, b = (RIGHT_A if side else LEFT_A) + k * LANES, (RIGHT_B if side else LEFT_B) + k * LANES
            for m in range(n):
                x, y, z = lanes[FOOT + m], lanes[FOOT + LANES + m], lanes[FOOT + 2 * LANES + m]
                lanes[a + m] = p3 + p0 * x + p1 * y + p2 * z
                x, y, z = lanes[NORMAL + m], lanes[NORMAL + LANES + m], lanes[NORMAL + 2 * LANES + m]
                lanes[b + m] = p0 * x + p1 * y + p2 * z


@njit(cache=True, nogil=True, error_model="numpy")
def clip(n, sizes, z_min, z_max, lanes):  # type: ignore[no-untyped-def]
    """The part of z_min..z_max where each line projects into both images; empty (bottom > top) where there is none."""
    wl, hl, wr, hr = sizes[0] - 1.0, sizes[1] - 1.0, sizes[2] - 1.0, sizes[3] - 1.0
    for m in range(n):
        low, high = _inside(line_of(lanes, LEFT_A, LEFT_B, m), wl, hl, z_min, z_max)
        lanes[BOTTOM + m], lanes[TOP + m] = _inside(line_of(lanes, RIGHT_A, RIGHT_B, m), wr, hr, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(line, w, h, low, high):  # type: ignore[no-untyped-def]
    """The part of low..high where 0 <= x <= w, 0 <= y <= h in front of the camera: x = X / W with W > 0 is X >= 0."""
    low, high = _bound(line.a0, line.b0, low, high)
    low, high = _bound(w * line.a2 - line.a0, w * line.b2 - line.b0, low, high)
    low, high = _bound(line.a1, line.b1, low, high)
    low, high = _bound(h * line.a2 - line.a1, h * line.b2 - line.b1, low, high)
    return _bound(line.a2 - NEAR, line.b2, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _bound(p, q, low, high):  # type: ignore[no-untyped-def]
    """The part of low..high where p + z q >= 0."""
    z = -p / q
    from_below, from_above = (q > 0.0) & (z > low), (q < 0.0) & (z < high)
    nowhere = (q == 0.0) & (p < 0.0)
    return z if from_below else low, z if from_above else (-np.inf if nowhere else high)


@njit(cache=True, nogil=True, error_model="numpy")
def spans(n, lanes):  # type: ignore[no-untyped-def]
    """Divide the lines into steps of a pixel at most where they are seen fastest."""
    for m in range(n):
        bottom, top = lanes[BOTTOM + m], lanes[TOP + m]
        # d p / d Z = (a_2 b - b_2 a) / w^2 with w linear in Z: the speed is greatest at one of the ends.
        left, right = line_of(lanes, LEFT_A, LEFT_B, m), line_of(lanes, RIGHT_A, RIGHT_B, m)
        fastest = max(_speed(left, bottom), _speed(left, top))
        fastest = max(fastest, _speed(right, bottom), _speed(right, top))
        steps = max(1.0, min(np.ceil(fastest * (top - bottom) / STEP_PX), MAX_STEPS))
        dz = (top - bottom) / steps
        lanes[DZ + m], lanes[COUNT + m] = dz, steps
        lanes[START + m] = max(0.0, min(steps, np.ceil((lanes[HIGH + m] - bottom) / dz) + MARGIN))
        lanes[LAST + m] = np.floor((lanes[LOW + m] - bottom) / dz) - MARGIN


@njit(cache=True, nogil=True, error_model="numpy")
def _speed(line, z):  # type: ignore[no-untyped-def]
    """Image speed |d p / d Z|, pixels per metre: with p = (a + Z b) / w it is |b - p b_2| / w."""
    w = max(line.a2 + z * line.b2, NEAR)
    x, y = (line.a0 + z * line.b0) / w, (line.a1 + z * line.b1) / w
    dx, dy = (line.b0 - x * line.b2) / w, (line.b1 - y * line.b2) / w
    return math.sqrt(dx * dx + dy * dy)


class BlockCells(NamedTuple):
    """Cells of a block.

    ``feet``, ``normals`` (r, c, 3) metres, frame of the surface; ``low``, ``high`` (r, c) interval of Z in which the
    search starts, metres, NaN: the cell is left out. The search may leave it: upwards while the point is behind the
    surface, downwards while it is free.
    """

    feet: Floats
    normals: Floats
    low: Floats32
    high: Floats32


class PairCameras(NamedTuple):
    """``left``, ``right`` (3, 4) projections from the frame of the surface to pixels; ``epipole`` (3,) homogeneous
    projection of the left camera's centre into the right image; ``sizes`` (4,) width and height of the left, then of
    the right image."""

    left: Floats
    right: Floats
    epipole: Floats
    sizes: Floats


class _Buffers(NamedTuple):
    """What the search works in: planes of the lanes that search, of those whose root is solved, and of points; numbers
    of the lanes that go on, and of those with a bracket; the cell of each lane."""

    lanes: Floats
    solved: Floats
    points: Floats
    active: NDArray[np.int64]
    found: NDArray[np.int64]
    cells: NDArray[np.int64]


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    cells: BlockCells,
    z_range: tuple[float, float],
    cameras: PairCameras,
    seen: Observed,
    out: tuple[Floats32, Floats32, Floats32, Floats32],
) -> None:
    """Solve every cell of a block.

    Parameters
    ----------
    z_range : limits of Z, metres.
    out : (r, c) each: elevation (m), its standard deviation (m), residual (px) and grey value of the change from free
        to behind that was chosen (see the module); contiguous, and to be filled with NaN before.
    """
    lanes, solved, points = (
        np.zeros(SEARCH_PLANES * LANES),
        np.zeros(ROOT_PLANES * LANES),
        np.zeros(POINT_PLANES * POINTS),
    )
    active, found, chosen = np.empty(LANES, np.int64), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    buffers = _Buffers(lanes, solved, points, active, found, chosen)
    foot, normal = cells.feet.reshape(-1, 3), cells.normals.reshape(-1, 3)
    flat = out[0].ravel(), out[1].ravel(), out[2].ravel(), out[3].ravel()
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
            _solve(n, buffers, cameras.epipole, seen, flat)
            n = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(n, buffers, epipole, seen, out):  # type: ignore[no-untyped-def]
    """Follow ``n`` lanes to the end."""
    lanes, solved, points, active, found, cells = buffers
    count = 0
    for m in range(n):
        lanes[DIRECTION + m], lanes[REACHED + m] = 0.0, lanes[START + m] + 1.0
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
            if lanes[REACHED + found[t]] > ENDED:
                active[count] = found[t]
                count += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _look(active, count, lanes, shape, points):  # type: ignore[no-untyped-def]
    """Project the next steps of the active lanes."""
    for t in range(count):
        m = active[t]
        # A lane that has not begun looks downwards: its first point is the start, which tells the way.
        way = 1.0 if lanes[DIRECTION + m] > 0.0 else -1.0
        climb(
            lanes,
            m,
            LineSteps(lanes[BOTTOM + m], lanes[REACHED + m] + way, way, lanes[DZ + m]),
            shape,
            points[STEPS * t :],
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _scan(active, count, found, hits, lanes, points):  # type: ignore[no-untyped-def]
    """Follow s over the steps looked at: lanes that go on stay active, those with a bracket are added to ``found``."""
    keep = 0
    for t in range(count):
        m, first = active[t], STEPS * t
        fresh = lanes[DIRECTION + m] == 0.0
        if lanes[DIRECTION + m] > 0.0:
            outcome = _upwards(lanes, m, points, first)
        elif fresh and _begin(lanes, m, points, first):
            outcome = MORE
        else:
            outcome = _downwards(lanes, m, points, first, 1 if fresh else 0)
        if outcome == MORE:
            active[keep] = m
            keep += 1
        elif outcome == FOUND:
            found[hits] = m
            hits += 1
    return keep, hits


@njit(cache=True, nogil=True, error_model="numpy")
def _begin(lanes, m, points, k):  # type: ignore[no-untyped-def]
    """Take s at the start from point ``k``; whether the search begins upwards, because the point is behind."""
    lanes[S_START + m] = lanes[S_REACHED + m] = pixels(points, S, k)
    lanes[REACHED + m] = lanes[START + m]
    upwards = (lanes[S_REACHED + m] < 0.0) & (lanes[START + m] < lanes[COUNT + m])
    lanes[DIRECTION + m] = 1.0 if upwards else -1.0
    return upwards


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _downwards(lanes, m, points, first, begin):  # type: ignore[no-untyped-def]
    """Go down from free to behind, beyond the last step only while free."""
    place, last, above, outcome = lanes[REACHED + m], lanes[LAST + m], lanes[S_REACHED + m], MORE
    for i in range(begin, STEPS):
        place -= 1.0
        s = points[S + first + i]
        if place < 0.0:
            outcome = DONE
            break
        if above >= 0.0 and s < 0.0:
            upper = pixels(points, S, first + i - 1) if i else lanes[S_REACHED + m]
            lanes[S_REACHED + m] = pixels(points, S, first + i)
            _bracket(lanes, m, place + 1.0, upper, lanes[S_REACHED + m])
            # Below the last step the search goes on through free ground only.
            lanes[REACHED + m] = place if place > last else ENDED
            outcome = FOUND
            break
        if place <= last and not s >= 0.0:
            outcome = DONE
            break
        above = s
    if outcome == MORE:
        lanes[REACHED + m], lanes[S_REACHED + m] = place, pixels(points, S, first + STEPS - 1)
    return outcome


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _upwards(lanes, m, points, first):  # type: ignore[no-untyped-def]
    """Go up while behind, to a bracket or to the end of what is known; after either the lane is sent back to its start,
    to go down from there (``turned``)."""
    place, outcome, turned = lanes[REACHED + m], MORE, False
    for i in range(STEPS):
        place += 1.0
        s = points[S + first + i]
        turned = place > lanes[COUNT + m] or not s < 0.0
        if turned:
            if place <= lanes[COUNT + m] and s >= 0.0:
                below = pixels(points, S, first + i - 1) if i else lanes[S_REACHED + m]
                _bracket(lanes, m, place, pixels(points, S, first + i), below)
                outcome = FOUND
            break
    if turned:
        lanes[DIRECTION + m], lanes[REACHED + m], lanes[S_REACHED + m] = -1.0, lanes[START + m], lanes[S_START + m]
    else:
        lanes[REACHED + m], lanes[S_REACHED + m] = place, pixels(points, S, first + STEPS - 1)
    return outcome


@njit(cache=True, nogil=True, error_model="numpy")
def _bracket(lanes, m, step, upper, lower):  # type: ignore[no-untyped-def]
    """The step below ``step``, with s at both ends."""
    lanes[UPPER_Z + m], lanes[UPPER_S + m] = lanes[BOTTOM + m] + step * lanes[DZ + m], upper
    lanes[LOWER_Z + m], lanes[LOWER_S + m] = lanes[BOTTOM + m] + (step - 1.0) * lanes[DZ + m], lower


@njit(cache=True, nogil=True, error_model="numpy")
def roots(n, lanes, epipole, seen, points):  # type: ignore[no-untyped-def]
    """Regula falsi (Illinois); NaN at undefined disparity. Leaves the roots in ``points``."""
    for m in range(n):
        lanes[SIDE + m], lanes[OPEN + m] = 0.0, 1.0
    for _ in range(TURNS):
        for m in range(n):
            z0, s0, z1, s1 = lanes[Z0 + m], lanes[S0 + m], lanes[Z1 + m], lanes[S1 + m]
            z = (z0 * s1 - z1 * s0) / (s1 - s0)
            lanes[Z + m] = z if lanes[OPEN + m] > 0.0 else lanes[Z + m]
        raise_to(lanes, n, seen.image.shape, points)
        meet(n, epipole, seen, points)
        if not _halve(n, lanes, points):
            break
    for m in range(n):
        lanes[ROOT + m] = lanes[Z + m]


@njit(cache=True, nogil=True, error_model="numpy")
def _halve(n, lanes, points):  # type: ignore[no-untyped-def]
    """Narrow each bracket by the point looked at; how many are not solved yet."""
    unsolved = 0
    for m in range(n):
        s, z = pixels(points, S, m), lanes[Z + m]
        z0, s0, z1, s1, side = lanes[Z0 + m], lanes[S0 + m], lanes[Z1 + m], lanes[S1 + m], lanes[SIDE + m]
        still = (lanes[OPEN + m] > 0.0) & (abs(s) >= SOLVED_PX)
        lanes[OPEN + m] = 1.0 if still else 0.0
        unsolved += 1 if still else 0
        free = s > 0.0
        # Illinois: an end that stays twice counts half, else the chord would creep towards the root from one side.
        lanes[Z0 + m], lanes[S0 + m] = (z if free else z0), (s if free else (s0 * 0.5 if side < 0.0 else s0))
        lanes[Z1 + m], lanes[S1 + m] = (z1 if free else z), ((s1 * 0.5 if side > 0.0 else s1) if free else s)
        lanes[SIDE + m] = 1.0 if free else -1.0
        lanes[Z + m] = z if s == s else np.nan
    return unsolved


@njit(cache=True, nogil=True, error_model="numpy")
def slopes(n, lanes, epipole, seen, points):  # type: ignore[no-untyped-def]
    """One-sided ds/dZ at the roots, pixels per metre; ``points`` of the roots themselves stay what they are."""
    beside = points[LANES:]
    for m in range(n):
        lanes[Z + m] = lanes[ROOT + m] + lanes[STEP + m]
    raise_to(lanes, n, seen.image.shape, beside)
    meet(n, epipole, seen, beside)
    for m in range(n):
        lanes[UPWARDS + m] = pixels(beside, S, m) / lanes[STEP + m]
        lanes[Z + m] = lanes[ROOT + m] - lanes[STEP + m]
    raise_to(lanes, n, seen.image.shape, beside)
    meet(n, epipole, seen, beside)
    for m in range(n):
        lanes[DOWNWARDS + m] = -pixels(beside, S, m) / lanes[STEP + m]


@njit(cache=True, nogil=True, error_model="numpy")
def accept(n, found, cells, lanes, seen, points, out):  # type: ignore[no-untyped-def]
    """Write ``out`` of the roots that stand; give how many do not.

    ``found``: number of each root's lane in the search; afterwards it begins with those of the roots that do not stand.
    ``cells``: the place in ``out`` of each lane of the search.
    """
    disparity, std, image, limits, scale = seen
    width, refused = image.shape[1], 0
    for m in range(n):
        s, across = pixels(points, S, m), pixels(points, ACROSS, m)
        residual = math.sqrt(s * s + across * across)
        # The lesser slope: beside a jump the other side is steep, and would make the elevation look certain.
        up, down = lanes[UPWARDS + m], lanes[DOWNWARDS + m]
        slope = up if down != down else (down if up != up else min(up, down))
        at = 2 * int(points[PIXEL + m])
        if residual <= limits[0] and slope > 0.0 and not _is_jump(at, at + 2 * width, disparity, scale, limits[1]):
            c, r, fx, fy = int(points[X + m]), int(points[Y + m]), points[FX + m], points[FY + m]
            top = image[r, c] * (1.0 - fx) + image[r, c + 1] * fx
            bottom = image[r + 1, c] * (1.0 - fx) + image[r + 1, c + 1] * fx
            i, own = cells[found[m]], std[int(np.rint(points[Y + m])), int(np.rint(points[X + m]))]
            # sigma_Z = sigma_d / |ds/dZ|
            out[0][i], out[1][i], out[2][i] = lanes[ROOT + m], own / slope, residual
            out[3][i] = top * (1.0 - fy) + bottom * fy
        else:
            found[refused] = found[m]  # refused <= m: none is lost
            refused += 1
    return refused


@njit(cache=True, nogil=True, error_model="numpy")
def _is_jump(i, j, disparity, scale, max_jump):  # type: ignore[no-untyped-def]
    """Whether the disparities of a bilinear cell differ by more than ``max_jump`` (a depth discontinuity).

    In pixels of the left image: what an unlike scale of the right one adds from pixel to pixel is no jump.
    """
    wide, high = scale
    a, b = wide - 1.0, high - 1.0
    u = _range(disparity[i], disparity[i + 2] - a, disparity[j], disparity[j + 2] - a) / wide
    v = _range(disparity[i + 1], disparity[i + 3], disparity[j + 1] - b, disparity[j + 3] - b) / high
    return u * u + v * v > max_jump * max_jump


@njit(cache=True, nogil=True, error_model="numpy")
def _range(a, b, c, d):  # type: ignore[no-untyped-def]
    return float(max(max(a, b), max(c, d))) - float(min(min(a, b), min(c, d)))


@njit(cache=True, nogil=True, error_model="numpy")
def gather(chosen, n, source, step, bracket, lanes):  # type: ignore[no-untyped-def]
    """Put the lines, steps and brackets (from plane ``bracket`` on) of ``n`` chosen lanes of the search in a row."""
    for t in range(n):
        m = chosen[t]
        for k in range(LINE):
            lanes[k * LANES + t] = source[k * LANES + m]
        lanes[STEP + t] = source[step + m]
        for k in range(4):
            lanes[Z0 + k * LANES + t] = source[bracket + k * LANES + m]
