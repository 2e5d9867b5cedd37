"""Moving windows over a raster: extrema, sums and fitted planes, each O(1) a cell whatever the window's size.

Windows are square, centred and of odd side ``n``, clipped at the raster's border; unknown cells are left out.

Sources: van Herk (1992), doi:10.1016/0167-8655(92)90069-C (running extrema); sums are differences of prefix sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.line import copy_line

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


LANES = 4
"""Rows whose sums along the columns run side by side: each addition waits for the last one of its own row only."""


def running_max(a: Floats32, n: int) -> Floats32:
    """Largest value (row, col) in the window; NaN is left out, and -inf stands where all are NaN."""
    filled = np.where(np.isnan(a), np.float32(-np.inf), a)
    return np.ascontiguousarray(_max_down(np.ascontiguousarray(_max_down(filled, n).T), n).T)


def running_min(a: Floats32, n: int) -> Floats32:
    """Smallest value (row, col) in the window; NaN is left out, and inf stands where all are NaN."""
    return -running_max(-a, n)


def _max_down(a: Floats32, n: int) -> Floats32:
    """Running maximum along the rows: of the block's suffix and the next block's prefix (van Herk)."""
    rows, cols = a.shape
    blocks = -(-(rows + n - 1) // n)
    padded = np.full((blocks * n, cols), -np.inf, dtype=np.float32)
    padded[n // 2 : n // 2 + rows] = a
    split = padded.reshape(blocks, n, cols)
    prefix = np.maximum.accumulate(split, axis=1).reshape(-1, cols)
    suffix = np.maximum.accumulate(split[:, ::-1], axis=1)[:, ::-1].reshape(-1, cols)
    return np.maximum(suffix[:rows], prefix[n - 1 : n - 1 + rows])


def window_sum(a: NDArray, n: int) -> Floats:
    """Sum (row, col), float64, over the window."""
    values = np.ascontiguousarray(a, dtype=np.float64)
    out = np.empty(values.shape)
    _sums(values, n // 2, out)
    return out


@njit(cache=True, nogil=True)
def _sums(a, half, out):  # type: ignore[no-untyped-def]
    """Differences of prefix sums down the columns, then of theirs along the rows, :data:`LANES` rows at a time."""
    rows, cols = a.shape
    prefix = np.zeros((rows + 1, cols))
    for r in range(rows):
        _add(prefix[r], a[r], prefix[r + 1])
    # The sums along a row, with half a window of what they begin and end with.
    lines, along = np.zeros((LANES, cols)), np.zeros((LANES, cols + 2 * half + 1))
    for first in range(0, rows, LANES):
        n = min(LANES, rows - first)
        for k in range(n):
            r = first + k
            _subtract(prefix[min(r + half + 1, rows)], prefix[max(r - half, 0)], lines[k])
        _accumulate(lines, half, along)
        for k in range(n):
            _subtract(along[k, 2 * half + 1 :], along[k, :cols], out[first + k])


@njit(cache=True, nogil=True, inline="always")
def _add(a, b, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = a[c] + b[c]


@njit(cache=True, nogil=True, inline="always")
def _subtract(a, b, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = a[c] - b[c]


@njit(cache=True, nogil=True)
def _accumulate(lines, half, out):  # type: ignore[no-untyped-def]
    """Sums of the first entries of :data:`LANES` lines side by side, since an addition waits for the last."""
    cols = lines.shape[1]
    p, q, s, t = lines[0], lines[1], lines[2], lines[3]
    i, j, k, m = out[0], out[1], out[2], out[3]
    a, b, d, e = 0.0, 0.0, 0.0, 0.0
    for c in range(cols):
        a, b, d, e = a + p[c], b + q[c], d + s[c], e + t[c]
        i[c + half + 1], j[c + half + 1], k[c + half + 1], m[c + half + 1] = a, b, d, e
    for c in range(cols + half + 1, cols + 2 * half + 1):
        i[c], j[c], k[c], m[c] = a, b, d, e


def window_mean(a: Floats32, n: int) -> Floats32:
    """Mean (row, col) of the known cells in the window; NaN where there is none."""
    out = np.empty(a.shape, dtype=np.float32)
    _mean(np.ascontiguousarray(a), n // 2, out)
    return out


@njit(cache=True, nogil=True)
def _mean(a, half, out):  # type: ignore[no-untyped-def]
    """Sums of the columns move down with the window, the sum over columns along each row."""
    rows, cols = a.shape
    offset = _middle(a)
    # behind the line's start and beyond its end a window has nothing
    total, count = np.zeros((LANES, cols + 2 * half + 1)), np.zeros((LANES, cols + 2 * half + 1), dtype=np.int32)
    inner = slice(half + 1, half + 1 + cols)
    sums, counts, of = np.empty((LANES, cols)), np.empty(cols, dtype=np.int32), np.zeros_like(count[0])
    nothing = np.full(cols, np.nan, dtype=np.float32)
    for r in range(-half, rows):
        lane = r % LANES if r > 0 else 0
        before = (lane - 1) % LANES if r > 0 else 0
        enters, leaves = a[r + half] if r + half < rows else nothing, a[r - half - 1] if r > half else nothing
        _move_sums(enters, leaves, offset, total[before, inner], total[lane, inner])
        _move_counts(enters, leaves, offset, count[before, inner], count[lane, inner])
        if r >= 0 and (lane == LANES - 1 or r == rows - 1):
            _slide(total, 2 * half + 1, sums)
            for k in range(lane + 1):
                if r - lane + k == 0 or _differ(count[k], of):
                    copy_line(count[k], of)
                    _slide_counts(of, 2 * half + 1, counts)
                _divide(sums[k], counts, offset, out[r - lane + k])


@njit(cache=True, nogil=True)
def _move_sums(enters, leaves, offset, before, out):  # type: ignore[no-untyped-def]
    """Sums of the columns with what enters the window and without what leaves it."""
    none = np.float32(0.0)
    for c in range(out.shape[0]):
        v, w = enters[c] - offset, leaves[c] - offset
        out[c] = (before[c] + (v if v == v else none)) - (w if w == w else none)


@njit(cache=True, nogil=True)
def _move_counts(enters, leaves, offset, before, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        v, w = enters[c] - offset, leaves[c] - offset
        out[c] = before[c] + np.int32(v == v) - np.int32(w == w)


@njit(cache=True, nogil=True)
def _slide(lines, n, out):  # type: ignore[no-untyped-def]
    """Sums of c + 1 .. c + n of :data:`LANES` lines."""
    p, q, s, t = lines[0], lines[1], lines[2], lines[3]
    a, b, d, e = 0.0, 0.0, 0.0, 0.0
    for c in range(1, n):
        a, b, d, e = a + p[c], b + q[c], d + s[c], e + t[c]
    for c in range(out.shape[1]):
        a, b, d, e = a + p[c + n], b + q[c + n], d + s[c + n], e + t[c + n]
        a, b, d, e = a - p[c], b - q[c], d - s[c], e - t[c]
        out[0, c], out[1, c], out[2, c], out[3, c] = a, b, d, e


@njit(cache=True, nogil=True)
def _differ(p, q):  # type: ignore[no-untyped-def]
    some = np.int32(0)
    for c in range(p.shape[0]):
        some |= p[c] ^ q[c]
    return some != 0


@njit(cache=True, nogil=True)
def _slide_counts(line, n, out):  # type: ignore[no-untyped-def]
    total = np.int32(0)
    for c in range(1, n):
        total += line[c]
    for c in range(out.shape[0]):
        total += line[c + n] - line[c]
        out[c] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _divide(sums, counts, offset, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        mean = sums[c] / np.float64(counts[c]) + offset
        out[c] = mean if counts[c] > 0 else np.nan


@njit(cache=True, nogil=True)
def _add_row(line, offset, total, count):  # type: ignore[no-untyped-def]
    for c in range(line.shape[0]):
        v = line[c] - offset
        total[c] += v if v == v else np.float32(0.0)
    for c in range(line.shape[0]):
        v = line[c] - offset
        count[c] += np.int32(v == v)


@njit(cache=True, nogil=True)
def _middle(a):  # type: ignore[no-untyped-def]
    """Mean of the known cells; 0 where there is none."""
    total, count = np.zeros(a.shape[1]), np.zeros(a.shape[1], dtype=np.int32)
    for r in range(a.shape[0]):
        _add_row(a[r], np.float32(0.0), total, count)
    n = float(count.sum())
    return np.float32(total.sum() / n) if n > 0 else np.float32(0.0)


@dataclass(frozen=True)
class Planes:
    """Least-squares planes of the known cells in each window.

    ``slope`` = \\|gradient\\|, ``residual`` = standard deviation from the plane in the unit of the heights; both
    (row, col) float64, NaN where fewer than three cells, or only cells on one line, are known.
    """

    slope: Floats
    residual: Floats


def fit_planes(height: Floats32, n: int, cell: float) -> Planes:
    """Fit ``z = a + b x + c y`` to the known cells of each window.

    Parameters
    ----------
    height : (row, col) float32, metres, NaN unknown.
    n : side of the window, cells, odd.
    cell : side of a cell, metres.
    """
    known = ~np.isnan(height)
    mean = float(height[known].mean(dtype=np.float64)) if known.any() else 0.0
    z = np.where(known, height.astype(np.float64) - mean, 0.0)
    w, wz, wzz = known.astype(np.float64), z, z * z
    rows, cols = height.shape
    y, x = np.arange(rows)[:, None] - (rows - 1) / 2, np.arange(cols)[None] - (cols - 1) / 2
    count = window_sum(w, n)
    one = np.maximum(count, 1.0)
    sx, sy, sz = (window_sum(v, n) / one for v in (w * x, w * y, wz))
    cxx = window_sum(w * x * x, n) - one * sx * sx
    cyy = window_sum(w * y * y, n) - one * sy * sy
    cxy = window_sum(w * x * y, n) - one * sx * sy
    cxz = window_sum(wz * x, n) - one * sx * sz
    cyz = window_sum(wz * y, n) - one * sy * sz
    czz = window_sum(wzz, n) - one * sz * sz
    det = cxx * cyy - cxy * cxy
    # In cells, three cells that are not on one line have a determinant of at least 1/3; less is rounding.
    sound = (count > 2.5) & (det > 0.1)
    det = np.where(sound, det, np.nan)
    b, c = (cxz * cyy - cyz * cxy) / det, (cyz * cxx - cxz * cxy) / det
    variance = np.maximum((czz - b * cxz - c * cyz) / one, 0.0)
    return Planes(np.hypot(b, c) / cell, np.sqrt(variance))
