"""Search of one level: several centres, a soft epipolar band, propagation with weak smoothness.

A map is one array of packed displacements, v << 16 | u (int32), beside the cost of each without smoothness. All costs
are integers, candidates come in a fixed order and only a strictly lower cost wins, so that results do not depend on
the machine. Eight candidates are looked at together (``strip_simd`` one pixel's, ``simd`` eight pixels').
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.hfvm.level import epipolar, simd, strip_simd
from rille.stages.hfvm.level.features import distance
from rille.stages.hfvm.level.simd import LANES, SHARP
from rille.stages.numeric.line import copy_line

HERE = 0, 0, 0, 0
"""Place of a left window: column and row of its first pixel in the right window, and in the whole left image (the
latter even)."""

MOST_STRIPS = 512
"""Room for the strips that a pixel searches: 9 centres, 17 rows each, 17 columns in three pieces."""


@njit(cache=True, nogil=True, inline="always")
def pack(u, v):  # type: ignore[no-untyped-def]
    """One 32-bit word of two 16-bit displacements."""
    return np.int32((v << 16) | (u & 0xFFFF))


@njit(cache=True, nogil=True, inline="always")
def columns(packed):  # type: ignore[no-untyped-def]
    """Column displacement."""
    # Through int16, so that the lower half keeps its sign.
    return np.int64(np.int16(packed))


@njit(cache=True, nogil=True, inline="always")
def rows_of(packed):  # type: ignore[no-untyped-def]
    """Row displacement."""
    # An arithmetic shift carries the sign along.
    return np.int64(packed) >> 16


@njit(cache=True, nogil=True)
def descend(images, up, reach, count, band, out, at=HERE):  # type: ignore[no-untyped-def]
    """Search around the doubled displacements of the coarse parent and of its nearest neighbours.

    ``images``: words of the left and the right one, (row, col); ``up``: column and row displacements of the coarse
    level. The four pixels of a parent try the same. ``count``: centres, of the parent, its neighbours along the row,
    along the column and on the diagonals. ``reach``: how far to either side, along the row, and about the parent also
    along its column; where the band is not sharp, over the whole rectangle about each. Of equal ones the parent's own
    wins. ``band``: fundamental matrix, zeros without one, and the cost per pixel off the line, float32; the four pixels
    share the line of their middle. Where the band is sharp each centre is first moved towards its line, by a pixel at
    most: a coarse fit may be wrong by more than that. ``out`` (row, col) int32: packed displacements and their costs.
    With nothing inside the other image the prediction stays: it leads out of it. ``at``: see :data:`HERE`. Reads a
    coarse pixel around each.
    """
    (left, right), (up_u, up_v), (reach_x, reach_y), (f, mu), (packed, data) = images, up, reach, band, out
    ox, oy, x0, y0 = at
    rows, cols = left.shape
    crows, ccols = up_u.shape
    centres = np.empty((crows + 2, ccols + 2), np.int32)
    _centres(up_u, up_v, f, mu, x0, y0, centres)
    wide = ccols + 2
    plan, best, least = np.empty((MOST_STRIPS, 5), np.int64), np.empty(4, np.int32), np.empty(4, np.int32)
    flat, near, lines = (left.reshape(-1), right.reshape(-1)), centres.reshape(-1), np.empty((3, ccols), np.float32)
    rrows, rcols = right.shape
    sizes = cols, rcols
    # A row about a centre fits into eight lanes up to a reach of 3, and ``cross`` holds one row to either side.
    in_rows = mu >= SHARP and 2 * reach_x < LANES and reach_y <= 1
    for j in range(crows):
        _lines(f, x0, y0 + 2 * j, mu, lines)
        for i in range(ccols):
            parent = (j + 1) * wide + i + 1
            if in_rows:
                planned = _rows(near, parent, wide, count, reach_x, reach_y, plan)
            else:
                planned = _rectangles(near, parent, wide, count, reach_x, reach_y, mu < SHARP, plan)
            x, y = 2 * i, 2 * j
            whole = x + 1 < cols and y + 1 < rows
            # Above every cost: the first candidate inside wins, and without any the prediction stays.
            best[0] = best[1] = best[2] = best[3] = near[parent]
            least[0] = least[1] = least[2] = least[3] = simd.FAR
            line = lines[0, i], lines[1, i], lines[2, i]
            for k in range(planned):
                strip = plan[k, 0], plan[k, 1], plan[k, 2], plan[k, 3], plan[k, 4]
                u, _, _, v, cross = strip
                xr, yr = x + ox + u, y + oy + v
                # Eight words are read for either column, whatever the strip's size: all must lie in the image.
                if whole and xr >= 0 and xr + LANES < rcols and yr >= cross and yr + 1 + cross < rrows:
                    strip_simd.four(flat, line, (y * cols + x, yr * rcols + xr), sizes, strip, (best, least))
                else:
                    _singly(flat, line, (x, y), (rows, cols, rrows, rcols), (ox, oy), strip, (best, least))
            packed[y, x], data[y, x] = best[0], least[0]
            if whole:
                packed[y, x + 1], data[y, x + 1] = best[1], least[1]
                packed[y + 1, x], data[y + 1, x] = best[2], least[2]
                packed[y + 1, x + 1], data[y + 1, x + 1] = best[3], least[3]
            elif x + 1 < cols:
                packed[y, x + 1], data[y, x + 1] = best[1], least[1]
            elif y + 1 < rows:
                packed[y + 1, x], data[y + 1, x] = best[2], least[2]


@njit(cache=True, nogil=True)
def _singly(flat, line, first_pixel, shapes, offset, strip, out):  # type: ignore[no-untyped-def]
    """What ``strip_simd.four`` does, candidate by candidate: near the borders."""
    (here, there), (x0, y0), (ox, oy), (best, least) = flat, first_pixel, offset, out
    u, count, centre, v, cross = strip
    rows, cols, rrows, rcols = shapes
    most = np.float32(simd.FARTHEST_OFF)
    for n in range(4):
        x, y = x0 + (n & 1), y0 + (n >> 1)
        if x >= cols or y >= rows:
            continue
        word = here[y * cols + x]
        first, last = max(u, -x - ox) - u, min(u + count, rcols - x - ox) - u
        own = centre - u
        # The order of the vector code's ranks, the centre's column first: ties must fall alike here and there.
        for k in range(-1, count + 2 * cross):
            du, dv = (centre, v) if k < 0 else (u + k, v) if k < count else (centre, v + 2 * (k - count) - 1)
            lane, yr = du - u, y + oy + dv
            if first <= lane < last and 0 <= yr < rrows and (k >= 0 or 0 <= own < count):
                off = abs((line[0] * np.float32(du) + line[1] * np.float32(dv)) + line[2])
                cost = distance(word, there[yr * rcols + x + ox + du]) + np.int64(min(off, most))
                # Strictly less: of equal costs the earlier candidate stays.
                if cost < least[n]:
                    best[n], least[n] = pack(du, dv), cost


@njit(cache=True, nogil=True, inline="always")
def _neighbour(near, at, wide, k):  # type: ignore[no-untyped-def]
    """Centre k of a coarse pixel: its own, those along the row, along the column, the others."""
    if k < 3:
        return near[at + (0 if k == 0 else 2 * k - 3)]
    if k < 5:
        return near[at + (2 * k - 7) * wide]
    return near[at + (wide if k > 6 else -wide) + 1 - 2 * (k & 1)]


@njit(cache=True, nogil=True, inline="always")
def _put(plan, at, u, size, centre, v, cross):  # type: ignore[no-untyped-def]
    """Write strip ``at`` of a plan: ``size`` displacements from column ``u`` on, row ``v``; ``cross``: see ``four``."""
    plan[at, 0], plan[at, 1], plan[at, 2], plan[at, 3], plan[at, 4] = u, size, centre, v, cross


@njit(cache=True, nogil=True, inline="always")
def _rows(near, at, wide, count, reach_x, reach_y, plan):  # type: ignore[no-untyped-def]
    """Strips to search: along the rows through the centres, and the column through the parent's; how many.

    Centres of the parent's row whose strips touch are searched together, where they fit.
    """
    own = near[at]
    u, v = columns(own), rows_of(own)
    low = high = u
    planned = 1
    reach = 2 * reach_x + 1
    # Strips of centres farther apart than ``reach`` do not touch, and more than eight columns do not fit.
    widest = min(reach, LANES - reach)
    if count == 5:
        west, east, north, south = near[at - 1], near[at + 1], near[at - wide], near[at + wide]
        # Rows are the upper halves: none of their bits is left where all agree.
        same_row = (((west ^ own) | (east ^ own) | (north ^ own) | (south ^ own)) >> 16) == 0
        least = min(min(columns(west), columns(east)), min(columns(north), columns(south)))
        most = max(max(columns(west), columns(east)), max(columns(north), columns(south)))
        # What is true nearly everywhere: all fit into one strip.
        if same_row and max(most, u) - min(least, u) <= widest:
            low, high, count = min(least, u), max(most, u), 1
    for k in range(1, count):
        other = _neighbour(near, at, wide, k)
        if other == own:
            continue
        cu, cv = columns(other), rows_of(other)
        if cv == v and high - cu <= widest and cu - low <= widest:
            low, high = min(low, cu), max(high, cu)
        else:
            _put(plan, planned, cu - reach_x, reach, cu, cv, 0)
            planned += 1
    # Put last, since only now its ends are known, but tried first: of equal costs the parent's strip wins.
    _put(plan, 0, low - reach_x, high - low + reach, u, v, reach_y)
    return planned


@njit(cache=True, nogil=True)
def _rectangles(near, at, wide, count, reach_x, reach_y, square, plan):  # type: ignore[no-untyped-def]
    """The same for any reach: rows and column about each centre, or where ``square`` the whole rectangle."""
    planned = 0
    for k in range(count):
        other = _neighbour(near, at, wide, k)
        if k > 0 and other == near[at]:
            continue
        u, v = columns(other), rows_of(other)
        for dv in range(-reach_y, reach_y + 1):
            if not (square or k == 0 or dv == 0):
                continue
            side = reach_x if square or dv == 0 else 0
            for first in range(-side, side + 1, LANES):
                _put(plan, planned, u + first, min(LANES, side + 1 - first), u, v + dv, 0)
                planned += 1
    return planned


@njit(cache=True, nogil=True)
def _lines(f, x0, y, length, lines):  # type: ignore[no-untyped-def]
    """Lines (3, col) of the middles of a row of squares of 2 x 2 pixels that begin in column ``x0``, row ``y``."""
    terms, first, half = epipolar.row_terms(f, y + 0.5), np.float32(x0), np.float32(0.5)
    for i in range(lines.shape[1]):
        a, b, c = epipolar.line(terms, first + (np.float32(2 * i) + half), length)
        lines[0, i], lines[1, i], lines[2, i] = a, b, c


@njit(cache=True, nogil=True)
def _centres(up_u, up_v, f, mu, x0, y0, centres):  # type: ignore[no-untyped-def]
    """Doubled displacements, each moved towards its epipolar line by a pixel at most; a border repeats the edge."""
    crows, ccols = up_u.shape
    one, lines = np.float32(1.0), np.empty((3, ccols), np.float32)
    for j in range(crows):
        us, vs, row = up_u[j], up_v[j], centres[j + 1, 1 : ccols + 1]
        if mu >= SHARP:
            _lines(f, x0, y0 + 2 * j, one, lines)
            a, b, c = lines[0], lines[1], lines[2]
            for i in range(ccols):
                pu, pv = np.float32(2 * us[i]), np.float32(2 * vs[i])
                # A coarse fit may itself be wrong by more than a pixel, so it moves no centre farther.
                e = min(max(a[i] * pu + b[i] * pv + c[i], -one), one)
                u, v = np.int32(pu - np.rint(e * a[i])), np.int32(pv - np.rint(e * b[i]))
                row[i] = (v << np.int32(16)) | (u & np.int32(0xFFFF))
        else:
            for i in range(ccols):
                u, v = np.int32(2 * us[i]), np.int32(2 * vs[i])
                row[i] = (v << np.int32(16)) | (u & np.int32(0xFFFF))
        centres[j + 1, 0], centres[j + 1, ccols + 1] = row[0], row[ccols - 1]
    copy_line(centres[1], centres[0])
    copy_line(centres[crows], centres[crows + 1])


@njit(cache=True, nogil=True)
def checkerboard(images, maps, band, smoothness, rounds, beside, at=HERE):  # type: ignore[no-untyped-def]
    """Rounds of propagation in place: each pixel tries its neighbours' displacements, and what lies beside its own.

    ``maps`` (row, col): packed displacements and their costs, int32, and room for marks, uint8: from the second round
    on only the neighbourhoods of what changed are looked at. ``images``, ``band``, ``at``: as in :func:`descend`.
    ``beside``: nothing (0), a column to either side (1), also a row (2); the latter always where the band is not sharp
    and hardly says in which row to search. A neighbour's that is just a column beside is for ``beside`` to try.

    Cost: that of the displacement + ``smoothness`` times the sum over the four neighbours of min(|du| + |dv|, 2);
    beyond the border the neighbour on the other side stands in. The two colours of a checkerboard take turns, which
    settles in half the rounds of all at once. Each turn follows the one before at a row's distance, so that all of them
    pass over the image while it is at hand. A round reaches two pixels.
    """
    (left, right), (packed, data, dirty), (f, mu), (ox, oy, x0, y0) = images, maps, band, at
    rows, cols = left.shape
    flat = left.reshape(-1), right.reshape(-1), packed.reshape(-1), data.reshape(-1)
    beside = 2 if mu < SHARP else np.int64(beside)
    level = (right.shape[0], right.shape[1], cols, ox, x0, beside, np.int64(smoothness))
    room = np.empty((4, cols + LANES), np.int32)
    dirty[:] = 0
    turns = 2 * rounds
    for step in range(rows + turns - 1 if turns else 0):
        for turn in range(max(0, step - rows + 1), min(turns, step + 1)):
            y = step - turn
            # The absolute row: lines must not depend on where the window begins.
            line = (*epipolar.row_terms(f, np.float64(y + y0)), mu)
            _turn(flat, dirty, (y, turn, y + oy, turns == 2), line, level, room)


@njit(cache=True, nogil=True)
def _turn(flat, dirty, which, line, level, room):  # type: ignore[no-untyped-def]
    """One colour of a row; ``which``: row, turn, the row in the right window, and whether no turn will look again."""
    y, turn, yr, once = which
    rows, cols = dirty.shape
    packed, cost = flat[2], flat[3]
    todo, new, found, moved = room[0], room[1], room[2], room[3]
    above, below = (y - 1 if y > 0 else min(1, rows - 1)), (y + 1 if y < rows - 1 else max(rows - 2, 0))
    flags, before, after = dirty[y], dirty[above], dirty[below]
    n, first = 0, (y + turn) & 1
    # The first turn of each colour looks at every pixel; later ones at what was marked.
    if turn < 2:
        n = (cols - first + 1) // 2
        for k in range(n):
            todo[k] = first + 2 * k
        flags[first::2] = 0
    else:
        # What to look at and what changes cannot be predicted: lists, written always and kept by counting.
        for x in range(first, cols, 2):
            todo[n] = x
            n += 1 if flags[x] else 0
            flags[x] = 0
    if n == 0:
        return
    # Vectors run past the end of the list; settling the last pixel again does no harm.
    todo[n : n + LANES] = todo[n - 1]
    start = y * cols
    for k in range(0, n, LANES):
        a, b = np.int64(todo[k]), np.int64(todo[k + LANES - 1])
        place = k, start, above * cols, below * cols, yr
        # Without a gap between the eight columns two plain loads stand for eight gathered ones.
        if k + LANES <= n and b - a == 2 * LANES - 2 and a > 0 and b + 2 < cols:
            simd.settle_dense(flat, line, todo, place, level, (new, found))
        else:
            simd.settle(flat, line, todo, place, level, (new, found))
    if once:
        for k in range(n):
            packed[start + todo[k]], cost[start + todo[k]] = new[k], found[k]
        return
    m = 0
    for k in range(n):
        moved[m] = k
        m += 1 if new[k] != packed[start + todo[k]] else 0
    for k in range(m):
        i = np.int64(todo[moved[k]])
        packed[start + i], cost[start + i] = new[moved[k]], found[moved[k]]
        # The pixel itself as well: what lies beside its new displacement has not been tried.
        before[i] = after[i] = flags[i] = flags[max(i - 1, 0)] = flags[min(i + 1, cols - 1)] = 1


@njit(cache=True, nogil=True)
def unpack(packed, u, v):  # type: ignore[no-untyped-def]
    """Displacements as two int16 maps."""
    for y in range(packed.shape[0]):
        for x in range(packed.shape[1]):
            u[y, x], v[y, x] = columns(packed[y, x]), rows_of(packed[y, x])


@njit(cache=True, nogil=True)
def pack_map(u, v, packed):  # type: ignore[no-untyped-def]
    """The reverse of :func:`unpack`."""
    for y in range(packed.shape[0]):
        for x in range(packed.shape[1]):
            packed[y, x] = pack(np.int64(u[y, x]), np.int64(v[y, x]))
