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


SUM_RADIUS = 2
"""Pixels: reach of the windows over which distances are summed."""

EDGE_RADIUS = 3
"""Pixels: reach of the windows that place depth edges."""


UNSEEN = np.iinfo(np.int32).max
"""More than any cost of the top level."""

UNIT = 4
"""Cost of a byte step on a path."""

OUTSIDE = 8000
"""Cost of a candidate that leads out of the other image: that of unlike pixels."""

BESIDE = ((0, -1), (0, 1), (-1, 0), (1, 0))
"""Rows and columns added to a pixel's own displacement."""

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


# -- the top level -----------------------------------------------------------------------------------------------------


def exhaustive(pair: LevelPair, reach: tuple[int, int], out: Field) -> None:
    """Write the displacements within ``reach`` (columns, rows) whose distance, summed over 3 x 3 pixels, is least.

    Null prediction and large search area (4.3.4), for the top level. Mean over the window's pixels that both images
    show; of equal ones the shorter displacement wins. The cost is the distance of each pixel alone.
    """
    _exhaustive(pair.left, pair.right, reach, out)


@njit(cache=True, nogil=True)
def _exhaustive(left, right, reach, out):  # type: ignore[no-untyped-def]
    (rows, cols), (right_rows, right_cols) = left.shape, right.shape
    best = np.full((rows, cols), UNSEEN, np.int32)
    single = np.empty((rows + 2, cols + 2), np.int32)
    out.shift[:], out.cost[:] = 0, FAR
    for v in range(-reach[1], reach[1] + 1):
        for u in range(-reach[0], reach[0] + 1):
            top, bottom = max(0, -v), min(rows, right_rows - v)
            first, last = max(0, -u), min(cols, right_cols - u)
            # Zeros stand for pixels that not both images show.
            single[:] = 0
            for y in range(top, bottom):
                for x in range(first, last):
                    single[y + 1, x + 1] = distance(left[y, x], right[y + v, x + u])
            for y in range(top, bottom):
                for x in range(first, last):
                    total = np.int32(0)
                    for j in range(y, y + 3):
                        total += single[j, x] + single[j, x + 1] + single[j, x + 2]
                    shown = (min(bottom, y + 2) - max(top, y - 1)) * (min(last, x + 2) - max(first, x - 1))
                    # Mean, in sixteenths, and length in one number: 2040 x 16 x 4096 is below 2^31.
                    cost = np.int32(16 * total // shown * 4096 + abs(u) + abs(v))
                    if cost < best[y, x]:
                        best[y, x], out.shift[y, x], out.cost[y, x] = cost, pack(u, v), single[y + 1, x + 1]


# -- search ------------------------------------------------------------------------------------------------------------


def search(pair: LevelPair, up: tuple[AnyArray, AnyArray], reach: tuple[int, int], out: Field) -> None:
    """Write the best displacements around the doubled ones of the coarse parent and of the pixels beside it.

    The four pixels of a parent try the same, and share the line of their middle: each centre and the row through it,
    and about the parent's also the column; where the band is not sharp, the whole rectangle about each. Where it is,
    each centre is first moved towards its line, by a pixel at most: a coarse fit may be wrong by more. With nothing
    inside the right image the prediction stays: it leads out of it.

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
        terms = epipolar.row_terms(pair.f, pair.y0 + 2 * j + 0.5)
        for i in range(cols):
            u, v = np.float32(2 * up_u[j, i]), np.float32(2 * up_v[j, i])
            if pair.mu >= SHARP:
                x = np.float32(pair.x0) + (np.float32(2 * i) + np.float32(0.5))
                a, b, c = epipolar.line(terms, x, one)
                off = min(max(a * u + b * v + c, -one), one)
                u, v = u - np.rint(off * a), v - np.rint(off * b)
            centres[j + 1, i + 1] = pack(np.int32(u), np.int32(v))
        centres[j + 1, 0], centres[j + 1, cols + 1] = centres[j + 1, 1], centres[j + 1, cols]
    centres[0], centres[rows + 1] = centres[1], centres[rows]


@njit(cache=True, nogil=True)
def _search(pair, centres, reach, out):  # type: ignore[no-untyped-def]
    (rows, cols), soft = pair.left.shape, pair.mu < SHARP
    for y in range(rows):
        terms = epipolar.row_terms(pair.f, pair.y0 + 2 * (y // 2) + 0.5)
        for x in range(cols):
            j, i = y // 2 + 1, x // 2 + 1
            middle = np.float32(pair.x0) + (np.float32(2 * (x // 2)) + np.float32(0.5))
            line = epipolar.line(terms, middle, np.float32(pair.mu))
            near = centres[j, i], centres[j, i - 1], centres[j, i + 1], centres[j - 1, i], centres[j + 1, i]
            best, least = near[0], np.int64(FAR)
            for k in range(5):
                u, v = columns(near[k]), rows_of(near[k])
                best, least = _tried(pair, line, (y, x), pack(u, v), (best, least))
                tall = reach[1] if soft or k == 0 else 0
                for dv in range(-tall, tall + 1):
                    wide = reach[0] if soft or dv == 0 else 0
                    for du in range(-wide, wide + 1):
                        best, least = _tried(pair, line, (y, x), pack(u + du, v + dv), (best, least))
            out.shift[y, x], out.cost[y, x] = best, least


@njit(cache=True, nogil=True, forceinline=True)
def _tried(pair, line, at, shift, so_far):  # type: ignore[no-untyped-def]
    """The best displacement so far and its cost, after one more is tried for the pixel ``at`` (row, column)."""
    cost = _cost(pair, line, at, shift)
    return (shift, cost) if cost < so_far[1] else so_far


@njit(cache=True, nogil=True, forceinline=True)
def _cost(pair, line, at, shift):  # type: ignore[no-untyped-def]
    """Distance of a pixel to that its displacement leads to, and the cost off the line; FAR outside."""
    y, x = at[0] + pair.ahead_y + rows_of(shift), at[1] + pair.ahead_x + columns(shift)
    if y < 0 or y >= pair.right.shape[0] or x < 0 or x >= pair.right.shape[1]:
        return np.int64(FAR)
    own, other = pair.left[at[0], at[1]], pair.right[np.uint64(y), np.uint64(x)]
    return distance(own, other) + _off(line, shift, FARTHEST_OFF)


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
    shift, costs, (rows, cols), (smoothness, rounds, beside) = field.shift, field.cost, pair.left.shape, smoothing
    for turn in range(2 * rounds):
        for y in range(rows):
            terms = epipolar.row_terms(pair.f, np.float64(y + pair.y0))
            up, down = _mirrored(y - 1, rows), _mirrored(y + 1, rows)
            for x in range((y + turn) & 1, cols, 2):
                # The first turn of each colour looks at every pixel; later ones at what was marked.
                if turn >= 2 and not dirty[y, x]:
                    continue
                dirty[y, x] = 0
                near = shift[up, x], shift[y, _mirrored(x - 1, cols)], shift[y, _mirrored(x + 1, cols)], shift[down, x]
                own, best, cost = shift[y, x], shift[y, x], np.int64(costs[y, x])
                least = cost + smoothness * _roughness(own, near)
                line = epipolar.line(terms, np.float32(x + pair.x0), np.float32(pair.mu))
                for k in range(2 * beside + 4):
                    if k < 2 * beside:
                        tried = pack(columns(own) + BESIDE[k][1], rows_of(own) + BESIDE[k][0])
                    else:
                        tried = near[k - 2 * beside]
                        if rows_of(tried) == rows_of(own) and abs(columns(tried) - columns(own)) <= 1:
                            continue
                    its_cost = _cost(pair, line, (y, x), tried)
                    total = its_cost + smoothness * _roughness(tried, near)
                    if its_cost < FAR and total < least:
                        best, cost, least = tried, its_cost, total
                shift[y, x], costs[y, x] = best, cost
                if best != own and rounds > 1:
                    # The pixel itself as well: what lies beside its new displacement has not been tried.
                    dirty[y, x] = dirty[y, max(x - 1, 0)] = dirty[y, min(x + 1, cols - 1)] = 1
                    dirty[up, x] = dirty[down, x] = 1


@njit(cache=True, nogil=True, forceinline=True)
def _mirrored(index, size):  # type: ignore[no-untyped-def]
    """Index of the pixel that stands for one beyond the border: the one on the other side."""
    return min(1, size - 1) if index < 0 else max(size - 2, 0) if index >= size else index


@njit(cache=True, nogil=True, forceinline=True)
def _roughness(shift, near):  # type: ignore[no-untyped-def]
    """Sum over the neighbours of min(|du| + |dv|, TRUNCATION)."""
    total = np.int64(0)
    for k in range(4):
        total += min(_gap(shift, near[k]), TRUNCATION)
    return total


@njit(cache=True, nogil=True, forceinline=True)
def _gap(a, b):  # type: ignore[no-untyped-def]
    """|du| + |dv| of the difference of two displacements."""
    return abs(columns(a) - columns(b)) + abs(rows_of(a) - rows_of(b))


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


@njit(cache=True, nogil=True)
def _window_sum(pair, y, x, q, p):  # type: ignore[no-untyped-def]
    """Distances, summed, between the window of the left pixel at row y, column x, and that of the right at q, p."""
    total = np.int64(0)
    for j in range(-SUM_RADIUS, SUM_RADIUS + 1):
        for i in range(-SUM_RADIUS, SUM_RADIUS + 1):
            total += distance(pair.left[y + j, x + i], pair.right[q + j, p + i])
    return total


@njit(cache=True, nogil=True)
def _sums(pair, maps, wanted, out):  # type: ignore[no-untyped-def]
    (us, vs), (out_u, out_v, out_distance) = maps, out
    (rows, cols), (high, wide), far = pair.left.shape, pair.right.shape, SUM_RADIUS + 1
    for y in range(rows):
        for x in range(cols):
            u, v = np.int64(us[y, x]), np.int64(vs[y, x])
            q, p = y + pair.ahead_y + v, x + pair.ahead_x + u
            out_u[y, x], out_v[y, x], out_distance[y, x] = u, v, -1.0
            if not wanted[y, x] or p < 0 or p >= wide or q < 0 or q >= high:
                continue
            if min(x, y, cols - 1 - x, rows - 1 - y) < SUM_RADIUS or min(p, q, wide - 1 - p, high - 1 - q) < far:
                out_distance[y, x] = distance(pair.left[y, x], pair.right[q, p])
                continue
            at = _window_sum(pair, y, x, q, p)
            west, east = _window_sum(pair, y, x, q, p - 1), _window_sum(pair, y, x, q, p + 1)
            above, below = _window_sum(pair, y, x, q - 1, p), _window_sum(pair, y, x, q + 1, p)
            out_u[y, x] = np.float32(u) + linear(west, at, east)
            out_v[y, x] = np.float32(v) + linear(above, at, below)
            out_distance[y, x] = np.float32(at) / np.float32((2 * SUM_RADIUS + 1) ** 2)


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
                q, p = y + pair.ahead_y + vs[k], x + pair.ahead_x + us[k]
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
    q, p = y + pair.ahead_y + v, x + pair.ahead_x + u
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
        terms = epipolar.row_terms(pair.f, np.float64(y + pair.y0))
        for x in range(cols):
            line = epipolar.line(terms, np.float32(x + pair.x0), np.float32(UNIT + share) * np.float32(pair.mu))
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
