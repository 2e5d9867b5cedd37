"""The solver of a level in numba: the same integers as the C code, which it stands for where there is no compiler.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import distance
from rille.stages.hfvm.native.problem import (
    CANDIDATES,
    FAR,
    NONE,
    EdgeRule,
    Field,
    LevelPair,
    PathCosts,
    Smoothing,
    unpacked,
)

FARTHEST_OFF = 2047
"""Most that the band costs: as much as the greatest distance."""

SHARP = 3.0
"""Byte steps a pixel: a softer band hardly says in which row to search."""

TRUNCATION = 2
"""Pixels: beyond this a step to a neighbour costs no more, so that depth edges stay."""

COLUMNS = 8
"""Columns that are searched together."""

MAX_STRIPS = 512
"""Room for the strips of a pixel: 5 centres, 17 rows, 3 pieces each."""

SUM_RADIUS = 2
"""Pixels: reach of the windows over which distances are summed."""

EDGE_RADIUS = 3
"""Pixels: reach of the windows that place depth edges."""

TOP_RADIUS = 1
"""Pixels: reach of the windows of the top level."""

UNSEEN = np.iinfo(np.int32).max
"""More than any cost of the top level."""

UNIT = 4
"""Cost of a byte step on a path."""

OUTSIDE = 8000
"""Cost of a candidate that leads out of the other image: that of unlike pixels."""

BESIDE = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
"""Rows and columns added to a pixel's own displacement on a path."""

AROUND = ((0, -1), (0, 1), (-1, 0), (1, 0), (-3, -3), (-3, 3), (3, -3), (3, 3), (0, -8), (0, 8), (-8, 0), (8, 0))
"""Rows and columns from a pixel to those whose displacements it tries on a path: beside it, beyond an edge, a gap."""


@njit(cache=True, nogil=True, forceinline=True)
def pack(u, v):  # type: ignore[no-untyped-def]
    """One 32-bit word of two 16-bit displacements."""
    return np.int32((v << 16) | (u & 0xFFFF))


@njit(cache=True, nogil=True, forceinline=True)
def columns(shift):  # type: ignore[no-untyped-def]
    """Column displacement."""
    # Through int16, so that the lower half keeps its sign.
    return np.int64(np.int16(shift))


@njit(cache=True, nogil=True, forceinline=True)
def rows_of(shift):  # type: ignore[no-untyped-def]
    """Row displacement."""
    return np.int64(shift) >> 16


@njit(cache=True, nogil=True, forceinline=True)
def _off_line(line, u, v):  # type: ignore[no-untyped-def]
    """Cost of displacement (u, v) off an epipolar line, whole byte steps."""
    off = abs((line[0] * np.float32(u) + line[1] * np.float32(v)) + line[2])
    return np.int64(off if off < FARTHEST_OFF else FARTHEST_OFF)


# -- the top level -----------------------------------------------------------------------------------------------------


def exhaustive(pair: LevelPair, reach: tuple[int, int], out: Field) -> None:
    """Write the displacements within ``reach`` (columns, rows) whose distance, summed over 3 x 3 pixels, is least.

    Null prediction and large search area (4.3.4), for the top level. Mean over the window's pixels that both images
    show; of equal ones the shorter displacement wins. The cost is the distance of each pixel alone.
    """
    _exhaustive(pair.left, pair.right, reach[0], reach[1], out)


@njit(cache=True, nogil=True)
def _keep_least(total, tall, first, last, tried, best, out):  # type: ignore[no-untyped-def]
    """Take ``tried`` in ``out`` where the mean of ``total``, in sixteenths, then its length, is less than ``best``.

    ``first, last``: the columns that both images show; ``tall``: how many rows of the window they show. Displacements
    are packed.
    """
    length = np.int32(abs(columns(tried)) + abs(rows_of(tried)))
    for x in range(first, last):
        inner = first + TOP_RADIUS <= x < last - TOP_RADIUS
        wide = 2 * TOP_RADIUS + 1 if inner else min(last, x + TOP_RADIUS + 1) - max(first, x - TOP_RADIUS)
        # Mean and length in one number, so that one comparison decides both: 2040 x 16 x 4096 is below 2^31.
        cost = np.int32(np.float64(total[x]) * 16.0 / np.float64(tall * wide)) * np.int32(4096) + length
        # Strictly less: of equal ones the first displacement in row, column order stays.
        if cost < best[x]:
            best[x], out[x] = cost, tried


@njit(cache=True, nogil=True)
def _exhaustive(left, right, reach_x, reach_y, out):  # type: ignore[no-untyped-def]
    rows, cols = left.shape
    rrows, rcols = right.shape
    radius, side = TOP_RADIUS, 2 * TOP_RADIUS + 1
    best = np.full((rows, cols), UNSEEN, np.int32)
    out.shift[:] = 0
    single = np.zeros((rows + 2 * radius, cols + 2 * radius), np.int32)
    total = np.zeros(cols, np.int32)
    for v in range(-reach_y, reach_y + 1):
        top, bottom = max(0, -v), min(rows, rrows - v)
        for u in range(-reach_x, reach_x + 1):
            first, last = max(0, -u), min(cols, rcols - u)
            if top >= bottom or first >= last:
                continue
            # A frame of nothing stands for pixels that not both images show.
            single[top : top + radius] = 0
            for y in range(top, bottom):
                row, words, others = single[y + radius], left[y], right[y + v]
                row[:] = 0
                for x in range(first, last):
                    row[x + radius] = distance(words[x], others[x + u])
            single[bottom + radius : bottom + 2 * radius] = 0
            for y in range(top, bottom):
                total[:] = 0
                for j in range(y, y + side):
                    for i in range(side):
                        part = single[j, i : i + cols]
                        for x in range(cols):
                            total[x] += part[x]
                tall = min(bottom, y + radius + 1) - max(top, y - radius)
                _keep_least(total, tall, first, last, pack(u, v), best[y], out.shift[y])
    for y in range(rows):
        for x in range(cols):
            j, i = y + rows_of(out.shift[y, x]), x + columns(out.shift[y, x])
            out.cost[y, x] = distance(left[y, x], right[j, i]) if best[y, x] < UNSEEN else FAR


# -- search ------------------------------------------------------------------------------------------------------------


def search(pair: LevelPair, up: tuple[AnyArray, AnyArray], reach: tuple[int, int], out: Field) -> None:
    """Write the best displacements around the doubled ones of the coarse parent and of the pixels beside it.

    The four pixels of a parent try the same, and share the line of their middle: along the row through each centre, and
    about the parent's also along its column; where the band is not sharp, over the whole rectangle about each. Of equal
    ones the parent's own wins. Where the band is sharp each centre is first moved towards its line, by a pixel at most:
    a coarse fit may be wrong by more. With nothing inside the right image the prediction stays: it leads out of it.

    Parameters
    ----------
    up : columns and rows of displacement of the coarse level, int16.
    reach : columns and rows to either side.
    """
    centres = np.empty((up[0].shape[0] + 2, up[0].shape[1] + 2), np.int32)
    _centres(pair, up[0], up[1], centres)
    _search(pair, centres, reach, out)


@njit(cache=True, nogil=True)
def _centres(pair, up_u, up_v, centres):  # type: ignore[no-untyped-def]
    """Doubled displacements, moved towards their lines by a pixel at most; a frame repeats the edge."""
    rows, cols = up_u.shape
    one = np.float32(1.0)
    for j in range(rows):
        terms = epipolar.row_terms(pair.f, 2 * j + 0.5)
        for i in range(cols):
            u, v = np.float32(2 * up_u[j, i]), np.float32(2 * up_v[j, i])
            if pair.mu >= SHARP:
                x = np.float32(2 * i) + np.float32(0.5)
                a, b, c = epipolar.line(terms, x, one)
                off = min(max(a * u + b * v + c, -one), one)
                u, v = u - np.rint(off * a), v - np.rint(off * b)
            centres[j + 1, i + 1] = pack(np.int32(u), np.int32(v))
        centres[j + 1, 0], centres[j + 1, cols + 1] = centres[j + 1, 1], centres[j + 1, cols]
    centres[0], centres[rows + 1] = centres[1], centres[rows]


@njit(cache=True, nogil=True)
def _search(pair, centres, reach, out):  # type: ignore[no-untyped-def]
    left, right, shift, costs = pair.left, pair.right, out.shift, out.cost
    near, best, least = np.empty(5, np.int32), np.empty(4, np.int32), np.empty(4, np.int64)
    (rows, cols), (right_rows, right_cols) = left.shape, right.shape
    strips, words = np.empty((MAX_STRIPS, 5), np.int64), np.empty(4, np.uint64)
    for j in range(1, centres.shape[0] - 1):
        terms = epipolar.row_terms(pair.f, 2 * (j - 1) + 0.5)
        for i in range(1, centres.shape[1] - 1):
            near[0], near[1], near[2] = centres[j, i], centres[j, i - 1], centres[j, i + 1]
            near[3], near[4] = centres[j - 1, i], centres[j + 1, i]
            x, y = 2 * (i - 1), 2 * (j - 1)
            line = epipolar.line(terms, np.float32(x) + np.float32(0.5), np.float32(pair.mu))
            for n in range(4):
                best[n], least[n] = near[0], FAR
                words[n] = left[min(y + (n >> 1), rows - 1), min(x + (n & 1), cols - 1)]
            planned = _plan(near, reach, pair.mu, strips)
            for m in range(planned):
                u, count, centre, v, cross = strips[m, 0], strips[m, 1], strips[m, 2], strips[m, 3], strips[m, 4]
                for k in range(0 if u <= centre < u + count else 1, count + 1 + 2 * cross):
                    du = centre if k == 0 or k > count else u + k - 1
                    dv = v if k <= count else v + 2 * (k - count) - 3
                    xr, yr = x + du, y + dv
                    off, tried = _off_line(line, du, dv), pack(du, dv)
                    for n in range(4):
                        p, q = xr + (n & 1), yr + (n >> 1)
                        if 0 <= p < right_cols and 0 <= q < right_rows:
                            cost = distance(words[n], right[np.uint64(q), np.uint64(p)]) + off
                            best[n] = tried if cost < least[n] else best[n]
                            least[n] = min(cost, least[n])
            for n in range(4):
                p, q = x + (n & 1), y + (n >> 1)
                if p < cols and q < rows:
                    shift[q, p], costs[q, p] = best[n], least[n]


@njit(cache=True, nogil=True)
def _plan(near, reach, mu, strips):  # type: ignore[no-untyped-def]
    """Strips to search, and how many: first column, number of columns, the centre's column, row, and whether crossed.

    Candidates of a strip, in this order: the centre's column, the others; where it is crossed, the rows above and below
    the centre. Along the rows through the centres those of the parent's row whose strips touch are searched together,
    where eight columns hold them; with any reach, or a soft band, piece by piece.
    """
    u, v = columns(near[0]), rows_of(near[0])
    if mu < SHARP or reach[0] > 3 or reach[1] > 1:
        return _rectangles(near, reach, mu < SHARP, strips)
    wide = 2 * reach[0] + 1
    most, low, high, n = min(wide, COLUMNS - wide), u, u, 1
    for k in range(1, 5):
        cu, cv = columns(near[k]), rows_of(near[k])
        if cv == v and high - cu <= most and cu - low <= most:
            low, high = min(low, cu), max(high, cu)
        else:
            strips[n] = cu - reach[0], wide, cu, cv, 0
            n += 1
    # Put last, since only now its ends are known, but tried first: of equal costs the parent's strip wins.
    strips[0] = low - reach[0], high - low + wide, u, v, reach[1]
    return n


@njit(cache=True, nogil=True)
def _rectangles(near, reach, soft, strips):  # type: ignore[no-untyped-def]
    """Rows and column about each centre; where the band is ``soft``, the whole rectangle."""
    n = 0
    for k in range(5):
        u, v = columns(near[k]), rows_of(near[k])
        for dv in range(-reach[1], reach[1] + 1):
            if (k > 0 and near[k] == near[0]) or not (soft or k == 0 or dv == 0):
                continue
            side = reach[0] if soft or dv == 0 else 0
            for first in range(-side, side + 1, COLUMNS):
                strips[n] = u + first, min(COLUMNS, side + 1 - first), u, v + dv, 0
                n += 1
    return n


@njit(cache=True, nogil=True, forceinline=True)
def _off(line, shift, most):  # type: ignore[no-untyped-def]
    """Cost of a displacement off an epipolar line, whole byte steps, at most ``most``."""
    off = abs((line[0] * np.float32(columns(shift)) + line[1] * np.float32(rows_of(shift))) + line[2])
    return np.int64(off if off < np.float32(most) else most)


# -- propagation -------------------------------------------------------------------------------------------------------


def propagate(pair: LevelPair, field: Field, smoothing: Smoothing) -> None:
    """Improve displacements in place: each pixel tries its neighbours' and those beside its own.

    Cost: that of the displacement + smoothness times the sum over the four neighbours of min(|du| + |dv|, 2); beyond
    the border the neighbour on the other side stands in. A neighbour's that is just a column beside the own one is for
    ``beside`` to try; where the band is not sharp, rows are tried, too. The two colours of a checkerboard take turns,
    which settles in half the rounds of all at once; from the second round on only the neighbourhoods of what changed
    are looked at. A round reaches two pixels.
    """
    beside = 2 if pair.mu < SHARP else smoothing.beside
    _propagate(pair, field, (smoothing.smoothness, smoothing.rounds, beside), np.zeros(pair.left.shape, np.uint8))


@njit(cache=True, nogil=True)
def _propagate(pair, field, smoothing, dirty):  # type: ignore[no-untyped-def]
    left, right, shift, costs = pair.left, pair.right, field.shift, field.cost
    (rows, cols), (right_rows, right_cols), (smoothness, rounds, beside) = left.shape, right.shape, smoothing
    mu = np.float32(pair.mu)
    lines, tried = np.empty((cols, 3), np.float32), np.empty(8, np.int32)
    for turn in range(2 * rounds):
        for y in range(rows):
            terms = epipolar.row_terms(pair.f, np.float64(y))
            for x in range(cols):
                lines[x, 0], lines[x, 1], lines[x, 2] = epipolar.line(terms, np.float32(x), mu)
            up, down = np.uint64(_mirrored(y - 1, rows)), np.uint64(_mirrored(y + 1, rows))
            for x in range((y + turn) & 1, cols, 2):
                # The first turn of each colour looks at every pixel; later ones at what was marked.
                if turn >= 2 and not dirty[y, x]:
                    continue
                dirty[y, x] = 0
                west, east = np.uint64(_mirrored(x - 1, cols)), np.uint64(_mirrored(x + 1, cols))
                own, near = shift[y, x], (shift[up, x], shift[y, west], shift[y, east], shift[down, x])
                best, cost, word = own, np.int64(costs[y, x]), left[y, x]
                least = cost + smoothness * _roughness(own, near)
                line = lines[x, 0], lines[x, 1], lines[x, 2]
                for k in range(_listed(own, near, beside, tried)):
                    one = tried[k]
                    xr, yr = x + columns(one), y + rows_of(one)
                    if xr < 0 or xr >= right_cols or yr < 0 or yr >= right_rows:
                        continue
                    its_cost = distance(word, right[np.uint64(yr), np.uint64(xr)])
                    its_cost += _off_line(line, columns(one), rows_of(one))
                    total = its_cost + smoothness * _roughness(one, near)
                    if total < least:
                        best, cost, least = one, its_cost, total
                shift[y, x], costs[y, x] = best, cost
                if best != own and rounds > 1:
                    # The pixel itself as well: what lies beside its new displacement has not been tried.
                    dirty[y, x] = dirty[y, max(x - 1, 0)] = dirty[y, min(x + 1, cols - 1)] = 1
                    dirty[up, x] = dirty[down, x] = 1


@njit(cache=True, nogil=True)
def _listed(own, near, beside, tried):  # type: ignore[no-untyped-def]
    """Number of displacements to try: those beside the own one, then those of the neighbours, each once."""
    u, v = columns(own), rows_of(own)
    n = 0
    if beside > 0:
        tried[0], tried[1], n = pack(u - 1, v), pack(u + 1, v), 2
    if beside > 1:
        tried[2], tried[3], n = pack(u, v - 1), pack(u, v + 1), 4
    above, west, east, below = near
    # What cannot be predicted is written always, and kept by counting.
    tried[n] = above
    n += _apart(above, u, v)
    tried[n] = west
    n += _apart(west, u, v) & (west != above)
    tried[n] = east
    n += _apart(east, u, v) & (east != above) & (east != west)
    tried[n] = below
    return n + (_apart(below, u, v) & (below != above) & (below != west) & (below != east))


@njit(cache=True, nogil=True)
def _apart(shift, u, v):  # type: ignore[no-untyped-def]
    """Whether a displacement is more than a column beside (u, v)."""
    return (rows_of(shift) != v) | (abs(columns(shift) - u) > 1)


@njit(cache=True, nogil=True, forceinline=True)
def _mirrored(index, size):  # type: ignore[no-untyped-def]
    """Index of the pixel that stands for one beyond the border: the one on the other side."""
    return min(1, size - 1) if index < 0 else max(size - 2, 0) if index >= size else index


@njit(cache=True, nogil=True, forceinline=True)
def _roughness(shift, near):  # type: ignore[no-untyped-def]
    """Sum over the neighbours of min(|du| + |dv|, TRUNCATION)."""
    u, v = columns(shift), rows_of(shift)
    a, b, c, d, most = near[0], near[1], near[2], near[3], np.int64(TRUNCATION)
    total = min(abs(u - columns(a)) + abs(v - rows_of(a)), most) + min(abs(u - columns(b)) + abs(v - rows_of(b)), most)
    total += min(abs(u - columns(c)) + abs(v - rows_of(c)), most)
    return total + min(abs(u - columns(d)) + abs(v - rows_of(d)), most)


# -- fractions of a pixel ----------------------------------------------------------------------------------------------


def sums(pair: LevelPair, u: AnyArray, v: AnyArray, wanted: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Displacements with fractions of a pixel, and distances, from distances summed over 5 x 5 pixels (paper, 4.3.2).

    Only where ``wanted`` is not zero and the window, moved by a pixel, lies inside both images; elsewhere the
    displacement is copied. The distance is the mean of a window at the whole displacement, or the pixel's own where the
    window is not inside; -1 outside the right image and where not wanted.

    Parameters
    ----------
    u, v : (row, col) int16 displacements, pixels.
    wanted : (row, col) uint8.
    """
    out = np.empty(u.shape, np.float32), np.empty(u.shape, np.float32), np.empty(u.shape, np.float32)
    _sums(pair, (u, v), wanted, out)
    return out


@njit(cache=True, nogil=True, inline="always")
def linear(before, at, after):  # type: ignore[no-untyped-def]
    """Where two lines of equal and opposite slope through three distances meet, within half a pixel."""
    steep = np.float32(max(before, after) - at)
    # Neither side costs more: after propagation and median the middle need not be the least.
    if steep <= 0:
        return np.float32(0.0)
    d = np.float32(before - after) / steep * np.float32(0.5)
    # Where one side costs less than the middle the lines meet more than half a pixel away.
    return min(max(d, np.float32(-0.5)), np.float32(0.5))


@njit(cache=True, nogil=True, forceinline=True)
def _column(left, right, at, to):  # type: ignore[no-untyped-def]
    """Distances summed over a column of the window: undisplaced, west, east, north (16 bits each), and south."""
    (y, x), (q, p) = at, to
    packed, south = np.uint64(0), np.uint64(0)
    for j in range(-SUM_RADIUS, SUM_RADIUS + 1):
        word, row = left[np.uint64(y + j), np.uint64(x)], right[np.uint64(q + j)]
        packed += np.uint64(distance(word, row[np.uint64(p)]))
        packed += np.uint64(distance(word, row[np.uint64(p - 1)])) << np.uint64(16)
        packed += np.uint64(distance(word, row[np.uint64(p + 1)])) << np.uint64(32)
        packed += np.uint64(distance(word, right[np.uint64(q + j - 1), np.uint64(p)])) << np.uint64(48)
        south += np.uint64(distance(word, right[np.uint64(q + j + 1), np.uint64(p)]))
    return packed, south


@njit(cache=True, nogil=True)
def _sums(pair, maps, wanted, out):  # type: ignore[no-untyped-def]
    """Neighbours of equal displacement share the columns of their windows."""
    (us, vs), (out_u, out_v, out_distance) = maps, out
    left, right = pair.left, pair.right
    rows, cols = left.shape
    far, size = SUM_RADIUS + 1, 2 * SUM_RADIUS + 1
    packed, south = np.zeros(size, np.uint64), np.zeros(size, np.uint64)
    low = np.uint64(0xFFFF)
    for y in range(rows):
        held = -1  # last column whose sums are there, at displacement (u, v)
        u = v = np.int64(0)
        for x in range(cols):
            if us[y, x] != u or vs[y, x] != v:
                u, v, held = np.int64(us[y, x]), np.int64(vs[y, x]), -1
            q, p = y + v, x + u
            out_u[y, x], out_v[y, x], out_distance[y, x] = u, v, -1.0
            if not wanted[y, x] or p < 0 or p >= right.shape[1] or q < 0 or q >= right.shape[0]:
                continue
            inside = min(x, y, cols - 1 - x, rows - 1 - y) >= SUM_RADIUS
            if not inside or min(p, q, right.shape[1] - 1 - p, right.shape[0] - 1 - q) < far:
                out_distance[y, x] = distance(left[y, x], right[q, p])
                continue
            for i in range(max(held + 1, x - SUM_RADIUS), x + SUM_RADIUS + 1):
                packed[i % size], south[i % size] = _column(left, right, (y, i), (q, i - x + p))
            held = x + SUM_RADIUS
            total = packed[0] + packed[1] + packed[2] + packed[3] + packed[4]
            below = np.int64(south[0] + south[1] + south[2] + south[3] + south[4])
            at, west = np.int64(total & low), np.int64((total >> np.uint64(16)) & low)
            east, above = np.int64((total >> np.uint64(32)) & low), np.int64(total >> np.uint64(48))
            out_u[y, x] = np.float32(u) + linear(west, at, east)
            out_v[y, x] = np.float32(v) + linear(above, at, below)
            out_distance[y, x] = np.float32(at) / np.float32(size * size)


# -- depth edges -------------------------------------------------------------------------------------------------------


def edges(pair: LevelPair, grey: AnyArray, shift: AnyArray, wanted: AnyArray, rule: EdgeRule) -> AnyArray:
    """Packed displacements (row, col) int32, depth edges placed anew, see :mod:`rille.stages.hfvm.level`.

    Parameters
    ----------
    pair : words of compact features.
    grey : (row, col) int16 grey values of the left image.
    shift : (row, col) int32 packed displacements.
    wanted : (row, col) uint8, the pixels that may change.
    """
    out = shift.copy()
    _edges(pair, grey, unpacked(shift), wanted, rule, out)
    return out


@njit(cache=True, nogil=True)
def _edges(pair, grey, maps, wanted, rule, out):  # type: ignore[no-untyped-def]
    (rows, cols), (high, wide) = grey.shape, pair.right.shape
    us, vs = np.empty(9, np.int64), np.empty(9, np.int64)
    for y in range(rule.reach, rows - rule.reach):
        for x in range(rule.reach, cols - rule.reach):
            if not wanted[y, x]:
                continue
            count = _sides(maps, (y, x), rule, us, vs)
            if count == 1:
                continue
            best, chosen = np.int64(1 << 40), 0
            for k in range(count):
                q, p = y + vs[k], x + us[k]
                if not (EDGE_RADIUS <= q < high - EDGE_RADIUS and EDGE_RADIUS <= p < wide - EDGE_RADIUS):
                    if k == 0:
                        break
                    continue
                # The pixel's own displacement comes first.
                factor = rule.own if k == 0 or rule.near * (us[k] - us[0]) < 0 else rule.other
                cost = factor * _window_cost(pair, grey, y, x, us[k], vs[k], rule)
                if cost < best:
                    best, chosen = cost, k
            out[y, x] = pack(us[chosen], vs[chosen])


@njit(cache=True, nogil=True)
def _sides(maps, at, rule, us, vs):  # type: ignore[no-untyped-def]
    """Number of different displacements at a pixel and around it, its own first."""
    (u, v), (y, x) = maps, at
    count, us[0], vs[0] = 1, u[y, x], v[y, x]
    for reach in (rule.reach // 2, rule.reach):
        for j, i in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            column, row, k = np.int64(u[y + j * reach, x + i * reach]), np.int64(v[y + j * reach, x + i * reach]), 0
            while k < count and max(abs(us[k] - column), abs(vs[k] - row)) >= rule.apart:
                k += 1
            if k == count:
                us[count], vs[count] = column, row
                count += 1
    return count


@njit(cache=True, nogil=True)
def _window_cost(pair, grey, y, x, u, v, rule):  # type: ignore[no-untyped-def]
    """Sum over a window of the distances, limited, by how alike in grey a pixel is to the middle."""
    q, p = y + v, x + u
    left, right = pair.left, pair.right
    own, total = np.int32(grey[y, x]), np.int32(0)
    far, bright, nil = np.int64(rule.far), np.int32(rule.grey), np.int32(0)
    for j in range(-EDGE_RADIUS, EDGE_RADIUS + 1):
        here, there = left[np.uint64(y + j)], right[np.uint64(q + j)]
        greys = grey[np.uint64(y + j)]
        for i in range(-EDGE_RADIUS, EDGE_RADIUS + 1):
            weight = max(bright - abs(np.int32(greys[np.uint64(x + i)]) - own), nil)
            total += weight * np.int32(min(distance(here[np.uint64(x + i)], there[np.uint64(p + i)]), far))
    return np.int64(total)


# -- paths -------------------------------------------------------------------------------------------------------------


def paths(
    pair: LevelPair,
    compact: LevelPair,
    up: tuple[AnyArray, AnyArray] | None,
    grey: AnyArray,
    costs: PathCosts,
    shift: AnyArray,
) -> None:
    """Write to ``shift`` the candidates of each pixel of least cost along paths; of equal ones the first.

    Candidates are at most :data:`CANDIDATES`, in this order and each once: the pixel's own displacement, those
    :data:`BESIDE` it, those of the pixels :data:`AROUND` it, those of the coarser level, doubled. All but the first
    lead into the right image. At the border the nearest pixel inside stands for one outside.

    Parameters
    ----------
    compact : words of both images' compact features.
    up : columns and rows of displacement of the coarser level, int16, or None.
    grey : (row, col) float32, of the left image.
    shift : (row, col) int32 packed displacements.
    """
    listed = np.empty((*shift.shape, CANDIDATES), np.int32), np.empty((*shift.shape, CANDIDATES), np.int32)
    none = np.zeros((0, 0), np.int16)
    _candidates(pair, (compact, costs.compact), up or (none, none), shift, listed)
    total = np.zeros(listed[1].shape, np.int32)
    for backward in (False, True):
        _sweep(listed, grey, costs, backward, total)
    total[listed[1] == NONE] = UNSEEN
    np.copyto(shift, np.take_along_axis(listed[0], total.argmin(-1)[..., None], -1)[..., 0])


@njit(cache=True, nogil=True)
def _candidates(pair, second, up, shift, listed):  # type: ignore[no-untyped-def]
    (compact, share), (rows, cols), (high, wide) = second, shift.shape, pair.right.shape
    for y in range(rows):
        terms = epipolar.row_terms(pair.f, np.float64(y))
        for x in range(cols):
            line = epipolar.line(terms, np.float32(x), np.float32(UNIT + share) * np.float32(pair.mu))
            known, cost, count = listed[0][y, x], listed[1][y, x], 0
            known[:], cost[:] = shift[y, x], NONE
            near = 1 + len(BESIDE) + len(AROUND)
            for n in range(near + (9 if up[0].size else 0)):
                tried = shift[y, x]
                if n >= near:
                    j = min(max(y // 2 + (n - near) // 3 - 1, 0), up[0].shape[0] - 1)
                    i = min(max(x // 2 + (n - near) % 3 - 1, 0), up[0].shape[1] - 1)
                    tried = pack(2 * np.int64(up[0][j, i]), 2 * np.int64(up[1][j, i]))
                elif 0 < n <= len(BESIDE):
                    tried = pack(columns(tried) + BESIDE[n - 1][1], rows_of(tried) + BESIDE[n - 1][0])
                elif n > 0:
                    j, i = AROUND[n - 1 - len(BESIDE)]
                    tried = shift[min(max(y + j, 0), rows - 1), min(max(x + i, 0), cols - 1)]
                q, p = y + rows_of(tried), x + columns(tried)
                inside = 0 <= p < wide and 0 <= q < high
                # Each once: there is room for few, and equal ones would take it from others.
                if count == CANDIDATES or (n > 0 and (not inside or (known == tried).any())):
                    continue
                apart = np.int64(OUTSIDE)
                if inside:
                    apart = UNIT * distance(pair.left[y, x], pair.right[q, p])
                    apart += share * distance(compact.left[y, x], compact.right[q, p])
                # Leaves room below NONE for the greatest step, 10000.
                known[count], cost[count] = tried, min(apart + _off(line, tried, 2 * OUTSIDE), 2 * OUTSIDE)
                count += 1


@njit(cache=True, nogil=True, forceinline=True)
def _gap(a, b):  # type: ignore[no-untyped-def]
    """|du| + |dv| of the difference of two displacements."""
    return abs(columns(a) - columns(b)) + abs(rows_of(a) - rows_of(b))


@njit(cache=True, nogil=True)
def _sweep(listed, grey, costs, backward, total):  # type: ignore[no-untyped-def]
    """Add the costs along three directions: from the upper left, above, the upper right; ``backward``: their opposites.

    Those of a pixel's candidates, from those of the pixel before on a path:
    cost + min over m (before[m] + min(small |difference to m|, far)) - min over m before[m].
    """
    (shift, cost), (rows, cols) = listed, grey.shape
    before, after = np.zeros((2, 3, cols, CANDIDATES), np.int64)
    s = -1 if backward else 1
    for row in range(rows):
        y = rows - 1 - row if backward else row
        for x in range(cols):
            for d in range(3):
                i = x + s * (d - 1)
                after[d, x] = cost[y, x]
                if row > 0 and 0 <= i < cols:
                    far, least = _jump(abs(grey[y, x] - grey[y - s, i]), costs), before[d, i].min()
                    for k in range(CANDIDATES):
                        best = least + far
                        for m in range(CANDIDATES):
                            step = costs.small * _gap(shift[y, x, k], shift[y - s, i, m])
                            best = min(best, before[d, i, m] + min(step, far))
                        after[d, x, k] = min(after[d, x, k] + best - least, NONE)
                for k in range(CANDIDATES):
                    total[y, x, k] += after[d, x, k]
        before, after = after, before


@njit(cache=True, nogil=True, forceinline=True)
def _jump(change, costs):  # type: ignore[no-untyped-def]
    """The most that a difference costs between pixels whose grey values differ by ``change``."""
    jump = np.float32(costs.large) / (np.float32(1.0) + change / np.float32(costs.grey))
    # Small differences cost less than jumps even where the grey step is greatest.
    return np.int64(max(jump, np.float32(2 * costs.small)))
