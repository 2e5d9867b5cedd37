"""The solver of a level in numba: the same integers as the C code, which it stands for where there is no compiler.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins. The rules are written out
pixel by pixel; what makes them fast is for the C code.
"""

from __future__ import annotations

import numpy as np

from rille.stages.core.kernel import inlined, kernel
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import distance
from rille.stages.hfvm.native.problem import CANDIDATES

FAR = 1 << 25
"""Cost above every cost."""

FARTHEST_OFF = 2047
"""Most that the band costs: as much as the greatest distance."""

SHARP = 3.0
"""Byte steps a pixel: a softer band hardly says in which row to search."""

COLUMNS = 8
"""Columns that are searched together."""

SUM_RADIUS = 2
"""Pixels: reach of the windows over which distances are summed."""


@inlined
def pack(u, v):  # type: ignore[no-untyped-def]
    """One 32-bit word of two 16-bit displacements."""
    return np.int32((v << 16) | (u & 0xFFFF))


@inlined
def columns(shift):  # type: ignore[no-untyped-def]
    """Column displacement."""
    # Through int16, so that the lower half keeps its sign.
    return np.int64(np.int16(shift))


@inlined
def rows_of(shift):  # type: ignore[no-untyped-def]
    """Row displacement."""
    return np.int64(shift) >> 16


@inlined
def _off(line, shift, most):  # type: ignore[no-untyped-def]
    """Cost of a displacement off an epipolar line, whole byte steps, at most ``most``."""
    off = abs((line[0] * np.float32(columns(shift)) + line[1] * np.float32(rows_of(shift))) + line[2])
    return np.int64(off if off < np.float32(most) else most)


# -- the top level -----------------------------------------------------------------------------------------------------


@kernel
def exhaustive(pair, reach, out):  # type: ignore[no-untyped-def]
    """Write the displacements within ``reach`` (columns, rows) whose distance, summed over 3 x 3 pixels, is least.

    Null prediction and large search area (4.3.4), for the top level, where the native solver uses it, too. Mean over
    the window's pixels that both images show; of equal ones the shorter displacement wins, then the first in row,
    column order. The cost is the distance of each pixel alone.
    """
    (rows, cols), (high, wide) = pair.left.shape, pair.right.shape
    unseen = np.int32(np.iinfo(np.int32).max)
    best = np.full((rows, cols), unseen, np.int32)
    out.shift[:] = 0
    # A frame of nothing stands for pixels that not both images show.
    single = np.zeros((rows + 2, cols + 2), np.int32)
    for v in range(-reach[1], reach[1] + 1):
        top, bottom = max(0, -v), min(rows, high - v)
        for u in range(-reach[0], reach[0] + 1):
            first, last = max(0, -u), min(cols, wide - u)
            single[:] = 0
            for y in range(top, bottom):
                row, words, others = single[y + 1], pair.left[y], pair.right[y + v]
                for x in range(first, last):
                    row[x + 1] = distance(words[x], others[x + u])
            tried, length = pack(u, v), np.int32(abs(u) + abs(v))
            for y in range(top, bottom):
                above, row, below, least, shift = single[y], single[y + 1], single[y + 2], best[y], out.shift[y]
                tall = min(bottom, y + 2) - max(top, y - 1)
                for x in range(first, last):
                    total = above[x] + above[x + 1] + above[x + 2] + row[x] + row[x + 1] + row[x + 2]
                    total += below[x] + below[x + 1] + below[x + 2]
                    seen = tall * (min(last, x + 2) - max(first, x - 1))
                    # Mean and length in one number, for one comparison of both: 2040 x 16 x 4096 is below 2^31.
                    cost = np.int32(np.float64(total) * 16.0 / np.float64(seen)) * np.int32(4096) + length
                    shift[x] = tried if cost < least[x] else shift[x]
                    least[x] = min(cost, least[x])
    for y in range(rows):
        for x in range(cols):
            j, i = y + rows_of(out.shift[y, x]), x + columns(out.shift[y, x])
            out.cost[y, x] = distance(pair.left[y, x], pair.right[j, i]) if best[y, x] < unseen else FAR


# -- search ------------------------------------------------------------------------------------------------------------


@kernel
def search(pair, up, reach, out):  # type: ignore[no-untyped-def]
    """Write the best displacements around the doubled ones of the coarse parent and of the pixels beside it.

    The four pixels of a parent try the same, and share the line of their middle. Where the band is sharp each centre is
    first moved towards its line, by a pixel at most: a coarse fit may be wrong by more. With nothing inside the right
    image the prediction stays: it leads out of it.

    Parameters
    ----------
    up : columns and rows of displacement of the coarse level, int16.
    reach : columns and rows to either side.
    """
    (rows, cols), (high, wide), (up_rows, up_cols) = pair.left.shape, pair.right.shape, up[0].shape
    # Room for 5 centres, 17 rows, 17 columns, and the centre of each of 3 pieces again.
    centres, tried, one = np.empty(up[0].shape, np.int32), np.empty(2048, np.int32), np.float32(1.0)
    for j in range(up_rows):
        terms = epipolar.row_terms(pair.f, 2 * j + 0.5)
        for i in range(up_cols):
            u, v = np.float32(2 * up[0][j, i]), np.float32(2 * up[1][j, i])
            if pair.mu >= SHARP:
                a, b, c = epipolar.line(terms, np.float32(2 * i) + np.float32(0.5), one)
                off = min(max(a * u + b * v + c, -one), one)
                u, v = u - np.rint(off * a), v - np.rint(off * b)
            centres[j, i] = pack(np.int32(u), np.int32(v))
    for j in range(up_rows):
        terms = epipolar.row_terms(pair.f, 2 * j + 0.5)
        for i in range(up_cols):
            line = epipolar.line(terms, np.float32(2 * i) + np.float32(0.5), np.float32(pair.mu))
            beside = centres[j, max(i - 1, 0)], centres[j, min(i + 1, up_cols - 1)]
            near = (centres[j, i], *beside, centres[max(j - 1, 0), i], centres[min(j + 1, up_rows - 1), i])
            count = _candidates(near, reach, pair.mu, tried)
            for y in range(2 * j, min(2 * j + 2, rows)):
                for x in range(2 * i, min(2 * i + 2, cols)):
                    best, least = near[0], FAR
                    for k in range(count):
                        q, p = y + rows_of(tried[k]), x + columns(tried[k])
                        if 0 <= p < wide and 0 <= q < high:
                            cost = distance(pair.left[y, x], pair.right[q, p]) + _off(line, tried[k], FARTHEST_OFF)
                            if cost < least:
                                best, least = tried[k], cost
                    out.shift[y, x], out.cost[y, x] = best, least


@kernel
def _candidates(near, reach, mu, tried):  # type: ignore[no-untyped-def]
    """Displacements that the pixels of a parent try, in the order in which equal ones win, and how many.

    Along the rows through the ``near`` centres, and about the parent's, the first, along its column. Those of the
    parent's row whose strips touch are searched together, where eight columns hold them. With any reach piece by piece;
    where the band is soft, the whole rectangle about each centre.
    """
    u, v, n, soft = columns(near[0]), rows_of(near[0]), 0, mu < SHARP
    if soft or reach[0] > 3 or reach[1] > 1:
        for k in range(5):
            for dv in range(-reach[1], reach[1] + 1):
                if (k > 0 and near[k] == near[0]) or not (soft or k == 0 or dv == 0):
                    continue
                side = reach[0] if soft or dv == 0 else 0
                u, v = columns(near[k]), rows_of(near[k]) + dv
                for first in range(-side, side + 1, COLUMNS):
                    n = _strip(u, v, u + first, min(COLUMNS, side + 1 - first), tried, n)
        return n
    wide, low, high, apart = 2 * reach[0] + 1, u, u, 0
    for k in range(1, 5):
        other = columns(near[k])
        if rows_of(near[k]) == v and max(high - other, other - low) <= min(wide, COLUMNS - wide):
            low, high = min(low, other), max(high, other)
        else:
            apart |= 1 << k
    n = _strip(u, v, low - reach[0], high - low + wide, tried, n)
    for dv in range(-reach[1], reach[1] + 1):
        n = _strip(u, v + dv, u, 1, tried, n)
    for k in range(1, 5):
        if apart >> k & 1:
            n = _strip(columns(near[k]), rows_of(near[k]), columns(near[k]) - reach[0], wide, tried, n)
    return n


@kernel
def _strip(u, v, first, count, tried, n):  # type: ignore[no-untyped-def]
    """Add ``count`` displacements of row ``v``, that of the centre's column ``u`` before the others, to ``n``."""
    if first <= u < first + count:
        tried[n], n = pack(u, v), n + 1
    for k in range(count):
        tried[n + k] = pack(first + k, v)
    return n + count


# -- propagation -------------------------------------------------------------------------------------------------------


@kernel
def propagate(pair, field, smoothing):  # type: ignore[no-untyped-def]
    """Improve displacements in place: each pixel tries its neighbours' and those beside its own.

    Cost: that of the displacement + smoothness times the sum over the four neighbours of min(|du| + |dv|, 2); beyond
    the border the neighbour on the other side stands in. A neighbour's that is just a column beside the own one is for
    ``beside`` to try; where the band is not sharp, rows are tried, too. The two colours of a checkerboard take turns,
    which settles in half the rounds of all at once; from the second round on only the neighbourhoods of what changed
    are looked at. A round reaches two pixels.
    """
    (rows, cols), (high, wide), shift = pair.left.shape, pair.right.shape, field.shift
    beside, dirty = 2 if pair.mu < SHARP else smoothing.beside, np.zeros(shift.shape, np.bool_)
    for turn in range(2 * smoothing.rounds):
        for y in range(rows):
            terms, up, down = epipolar.row_terms(pair.f, np.float64(y)), _mirrored(y - 1, rows), _mirrored(y + 1, rows)
            for x in range((y + turn) & 1, cols, 2):
                # The first turn of each colour looks at every pixel; later ones at what was marked.
                if turn >= 2 and not dirty[y, x]:
                    continue
                dirty[y, x] = False
                line = epipolar.line(terms, np.float32(x), np.float32(pair.mu))
                near = shift[up, x], shift[y, _mirrored(x - 1, cols)], shift[y, _mirrored(x + 1, cols)], shift[down, x]
                own, cost = shift[y, x], np.int64(field.cost[y, x])
                u, v, best, least = columns(own), rows_of(own), own, cost + smoothing.smoothness * _roughness(own, near)
                tried = (pack(u - 1, v), pack(u + 1, v), pack(u, v - 1), pack(u, v + 1), *near)
                for k in range(8):
                    one = tried[k]
                    du, dv = columns(one), rows_of(one)
                    known = k < 4 or (dv == v and abs(du - u) <= 1)
                    if (k >= 2 * beside and known) or not (0 <= x + du < wide and 0 <= y + dv < high):
                        continue
                    its_cost = distance(pair.left[y, x], pair.right[y + dv, x + du]) + _off(line, one, FARTHEST_OFF)
                    total = its_cost + smoothing.smoothness * _roughness(one, near)
                    if total < least:
                        best, cost, least = one, its_cost, total
                shift[y, x], field.cost[y, x] = best, cost
                if best != own and smoothing.rounds > 1:
                    # The pixel itself as well: displacements beside its new one have not been tried.
                    dirty[y, max(x - 1, 0) : x + 2] = True
                    dirty[up, x] = dirty[down, x] = True


@inlined
def _mirrored(index, size):  # type: ignore[no-untyped-def]
    """Index of the pixel that stands for one beyond the border: the one on the other side."""
    return min(1, size - 1) if index < 0 else max(size - 2, 0) if index >= size else index


@inlined
def _apart(a, b):  # type: ignore[no-untyped-def]
    """|du| + |dv| of the difference of two displacements."""
    return abs(columns(a) - columns(b)) + abs(rows_of(a) - rows_of(b))


@inlined
def _roughness(shift, near):  # type: ignore[no-untyped-def]
    """Sum over the neighbours of min(|du| + |dv|, 2 pixels): depth edges, where a step is longer, stay."""
    total = 0
    for k in range(4):
        total += min(_apart(shift, near[k]), 2)
    return total


# -- fractions of a pixel ----------------------------------------------------------------------------------------------


@kernel
def sums(pair, us, vs, wanted):  # type: ignore[no-untyped-def]
    """Displacements with fractions of a pixel, and distances, from distances summed over 5 x 5 pixels (paper, 4.3.2).

    Only where ``wanted`` is not zero and the window, moved by a pixel, lies inside both images; elsewhere the
    displacement is copied. The distance is the mean of a window at the whole displacement, or the pixel's own where the
    window is not inside; -1 outside the right image and where not wanted.

    Parameters
    ----------
    us, vs : (row, col) int16 displacements, pixels.
    wanted : (row, col) uint8.
    """
    left, right, radius = pair.left, pair.right, SUM_RADIUS
    (rows, cols), (high, wide) = left.shape, right.shape
    out_u, out_v, apart = us.astype(np.float32), vs.astype(np.float32), np.full(us.shape, np.float32(-1.0))
    for y in range(rows):
        for x in range(cols):
            q, p = y + np.int64(vs[y, x]), x + np.int64(us[y, x])
            if not wanted[y, x] or p < 0 or p >= wide or q < 0 or q >= high:
                continue
            if min(x, y, cols - 1 - x, rows - 1 - y) < radius or min(p, q, wide - 1 - p, high - 1 - q) <= radius:
                apart[y, x] = distance(left[y, x], right[q, p])
                continue
            window = left[y - radius : y + radius + 1, x - radius : x + radius + 1]
            at = _summed(window, right, q, p)
            out_u[y, x] += linear(_summed(window, right, q, p - 1), at, _summed(window, right, q, p + 1))
            out_v[y, x] += linear(_summed(window, right, q - 1, p), at, _summed(window, right, q + 1, p))
            apart[y, x] = np.float32(at) / np.float32(window.size)
    return out_u, out_v, apart


@kernel
def _summed(window, right, q, p):  # type: ignore[no-untyped-def]
    """Distances of a window summed, its middle at row ``q`` and column ``p`` of the right image."""
    total = 0
    for j in range(2 * SUM_RADIUS + 1):
        for i in range(2 * SUM_RADIUS + 1):
            total += distance(window[j, i], right[q + j - SUM_RADIUS, p + i - SUM_RADIUS])
    return total


@inlined
def linear(before, at, after):  # type: ignore[no-untyped-def]
    """Where two lines of equal and opposite slope through three distances meet, within half a pixel."""
    steep = np.float32(max(before, after) - at)
    # Neither side costs more: after propagation and median the middle need not be the least.
    if steep <= 0:
        return np.float32(0.0)
    d = np.float32(before - after) / steep * np.float32(0.5)
    # Where one side costs less than the middle the lines meet more than half a pixel away.
    return min(max(d, np.float32(-0.5)), np.float32(0.5))


# -- depth edges -------------------------------------------------------------------------------------------------------

# Features put an edge a few pixels too far out: EDGE_REACH_PX, to the farthest pixel whose displacement is tried, and
# half of it. With displacements MIN_APART_PX apart by 2 the errors among the matched were 6 % fewer still, and the time
# doubled: slopes count then, too. What is hidden differs by any amount: MAX_EDGE_DISTANCE. Of weak evidence none
# changes: OWN_FACTOR of the cost against OTHER_FACTOR; a farther one need only cost less: with the ratio for it, too,
# bad-2 after filling was 1 % more on both halves of the Middlebury pairs, and that of the matched 8 %. EDGE_GREY: grey
# levels of difference from which on a pixel does not count. Windows of 5 to 9 pixels, distances of 70 to 200, grey
# levels of 16 to 32 and a reach of 4 to 8 differ by less than 3 %.
EDGE_REACH_PX, EDGE_RADIUS_PX, MIN_APART_PX = 4, 3, 4
EDGE_GREY, MAX_EDGE_DISTANCE, OWN_FACTOR, OTHER_FACTOR = 16, 100, 9, 10


@kernel
def edges(pair, grey, shift, wanted, near_sign):  # type: ignore[no-untyped-def]
    """Packed displacements (row, col) int32, depth edges placed anew, see :mod:`rille.stages.hfvm.level`.

    Parameters
    ----------
    pair : words of compact features.
    grey : (row, col) int16 grey values of the left image.
    shift : (row, col) int32 packed displacements.
    wanted : (row, col) uint8, the pixels that may change.
    near_sign : sign of the columns of nearer things, 0 unknown; int.
    """
    (rows, cols), (high, wide), radius = grey.shape, pair.right.shape, EDGE_RADIUS_PX
    out, tried = shift.copy(), np.empty(9, np.int32)
    for y in range(EDGE_REACH_PX, rows - EDGE_REACH_PX):
        for x in range(EDGE_REACH_PX, cols - EDGE_REACH_PX):
            count = _sides(shift, y, x, tried) if wanted[y, x] else 1
            best = np.int64(1 << 40)
            for k in range(count if count > 1 else 0):
                q, p = y + rows_of(tried[k]), x + columns(tried[k])
                if not (radius <= q < high - radius and radius <= p < wide - radius):
                    if k == 0:
                        break
                    continue
                # The pixel's own displacement comes first.
                farther = near_sign * (columns(tried[k]) - columns(tried[0])) < 0
                cost = (OWN_FACTOR if k == 0 or farther else OTHER_FACTOR) * _edge_cost(pair, grey, y, x, q, p)
                if cost < best:
                    best, out[y, x] = cost, tried[k]
    return out


@kernel
def _sides(shift, y, x, tried):  # type: ignore[no-untyped-def]
    """Number of the different displacements at a pixel and around it, its own first."""
    count, tried[0] = 1, shift[y, x]
    for reach in (EDGE_REACH_PX // 2, EDGE_REACH_PX):
        for j, i in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            one, k = shift[y + j * reach, x + i * reach], 0
            u, v = columns(one), rows_of(one)
            while k < count and max(abs(columns(tried[k]) - u), abs(rows_of(tried[k]) - v)) >= MIN_APART_PX:
                k += 1
            if k == count:
                tried[count], count = one, count + 1
    return count


@kernel
def _edge_cost(pair, grey, y, x, q, p):  # type: ignore[no-untyped-def]
    """Sum over a window of the distances, limited, by how alike in grey a pixel is to the middle."""
    own, total = np.int32(grey[y, x]), np.int64(0)
    for j in range(-EDGE_RADIUS_PX, EDGE_RADIUS_PX + 1):
        here, there, greys = pair.left[y + j], pair.right[q + j], grey[y + j]
        for i in range(-EDGE_RADIUS_PX, EDGE_RADIUS_PX + 1):
            weight = max(EDGE_GREY - abs(greys[x + i] - own), 0)
            total += weight * min(distance(here[x + i], there[p + i]), MAX_EDGE_DISTANCE)
    return total


# -- paths -------------------------------------------------------------------------------------------------------------

# Costs in quarters of a byte step, UNIT: COMPACT of a byte step of compact features (larger: depth edges less
# fattened); SMALL of a pixel of difference to the pixel before (smoother); LARGE the most that a difference costs
# (fewer depth steps), half of it at a step of LARGE_GREY levels (larger: depth steps follow image edges less).
UNIT, COMPACT, SMALL, LARGE, LARGE_GREY = 4, 8, 36, 240, 10

NO_CANDIDATE, OUTSIDE = 32767, 8000
"""Costs: where there is no candidate; of one that leads out of the other image, as much as of unlike pixels."""

BESIDE = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
"""Rows and columns added to a pixel's own displacement, which is the first."""

AROUND = ((0, -1), (0, 1), (-1, 0), (1, 0), (-3, -3), (-3, 3), (3, -3), (3, 3), (0, -8), (0, 8), (-8, 0), (8, 0))
"""Rows and columns from a pixel to those whose displacements it tries on a path: beside it, beyond an edge, a gap."""


@kernel
def paths(pair, compact, up, grey, shift):  # type: ignore[no-untyped-def]
    """Write to ``shift`` the candidates of each pixel of least cost along paths; of equal ones the first.

    Candidates are at most :data:`CANDIDATES`, in this order and each once: the pixel's own displacement and those
    :data:`BESIDE` it, those of the pixels :data:`AROUND` it, and of 3 x 3 of the coarser level. All but the first lead
    into the right image. At the border the nearest pixel inside stands for one outside.

    Parameters
    ----------
    compact : words of both images' compact features.
    up : (row, col) int32 packed displacements of the coarser level, doubled; (0, 0): there is none.
    grey : (row, col) float32, of the left image.
    shift : (row, col) int32 packed displacements.
    """
    rows, cols = shift.shape
    tried, cost = np.empty((2, rows, cols, CANDIDATES), np.int32)
    for y in range(rows):
        _list(pair, compact, up, shift, y, tried[y], cost[y])
    total = np.zeros(cost.shape, np.int32)
    for s in (1, -1):
        _sweep(tried, cost, grey, s, total)
    for y in range(rows):
        for x in range(cols):
            shift[y, x] = tried[y, x, np.where(cost[y, x] == NO_CANDIDATE, FAR, total[y, x]).argmin()]


@kernel
def _sweep(tried, cost, grey, s, total):  # type: ignore[no-untyped-def]
    """Add the costs along three directions: from the upper left, above, the upper right; ``s`` = -1: their opposites.

    Those of a pixel's candidates, from those of the pixel before on a path:
    cost + min over m (before[m] + min(SMALL |difference to m|, far)) - min over m before[m].
    """
    rows, cols = grey.shape
    before, after = np.zeros((2, 3, cols, CANDIDATES), np.int64)
    for row in range(rows):
        y = row if s > 0 else rows - 1 - row
        for x in range(cols):
            for d in range(3):
                i = x + s * (d - 1)
                after[d, x] = cost[y, x]
                if row > 0 and 0 <= i < cols:
                    steep = abs(grey[y, x] - grey[y - s, i]) / np.float32(LARGE_GREY)
                    jump = np.float32(LARGE) / (np.float32(1.0) + steep)
                    # Small differences cost less than jumps even where the grey step is greatest.
                    far, least = max(np.int64(jump), 2 * SMALL), before[d, i].min()
                    for k in range(CANDIDATES):
                        best = least + far
                        for m in range(CANDIDATES):
                            step = SMALL * _apart(tried[y, x, k], tried[y - s, i, m])
                            best = min(best, before[d, i, m] + min(step, far))
                        after[d, x, k] = min(after[d, x, k] + best - least, NO_CANDIDATE)
                total[y, x] += after[d, x]
        before, after = after, before


@kernel
def _list(pair, compact, up, shift, y, tried, cost):  # type: ignore[no-untyped-def]
    """Write the candidates of the pixels of a row, and their costs."""
    (rows, cols), (high, wide) = shift.shape, pair.right.shape
    terms, length = epipolar.row_terms(pair.f, np.float64(y)), np.float32(UNIT + COMPACT) * np.float32(pair.mu)
    near, all_of = len(BESIDE), len(BESIDE) + len(AROUND)
    for x in range(cols):
        own, count, line = shift[y, x], 0, epipolar.line(terms, np.float32(x), length)
        tried[x], cost[x] = own, NO_CANDIDATE
        for n in range(all_of + (9 if up.size else 0)):
            if n < near:
                one = pack(columns(own) + BESIDE[n][1], rows_of(own) + BESIDE[n][0])
            elif n < all_of:
                j, i = AROUND[n - near]
                one = shift[min(max(y + j, 0), rows - 1), min(max(x + i, 0), cols - 1)]
            else:
                j, i = y // 2 + (n - all_of) // 3 - 1, x // 2 + (n - all_of) % 3 - 1
                one = up[min(max(j, 0), up.shape[0] - 1), min(max(i, 0), up.shape[1] - 1)]
            q, p = y + rows_of(one), x + columns(one)
            inside = 0 <= p < wide and 0 <= q < high
            # Each once: there is room for few, and equal ones would take it from others.
            if count == CANDIDATES or (n > 0 and (not inside or (tried[x, :count] == one).any())):
                continue
            apart = OUTSIDE
            if inside:
                apart = UNIT * distance(pair.left[y, x], pair.right[q, p])
                apart += COMPACT * distance(compact.left[y, x], compact.right[q, p])
            # Leaves room below NO_CANDIDATE for the greatest step, 10000.
            tried[x, count], cost[x, count] = one, min(apart + _off(line, one, 2 * OUTSIDE), 2 * OUTSIDE)
            count += 1
