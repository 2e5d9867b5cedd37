"""Moving windows over a raster: extrema, sums and fitted planes, each O(1) a cell whatever the window's size.

Windows are square, centred and of odd side ``n``, clipped at the raster's border; unknown cells are left out.

Sources: van Herk (1992), doi:10.1016/0167-8655(92)90069-C (running extrema); sums are differences of prefix sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


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
    return _sum_down(_sum_down(np.asarray(a, dtype=np.float64), n).T, n).T


def _sum_down(a: Floats, n: int) -> Floats:
    rows = a.shape[0]
    prefix = np.zeros((rows + 1, a.shape[1]))
    np.cumsum(a, axis=0, out=prefix[1:])
    index = np.arange(rows)
    return np.asarray(prefix[np.minimum(index + n // 2 + 1, rows)] - prefix[np.maximum(index - n // 2, 0)])


def window_count(mask: Mask, n: int) -> NDArray[np.int32]:
    """How many cells (row, col) of the window are set."""
    out = np.empty(mask.shape, dtype=np.int32)
    _count(np.ascontiguousarray(mask), n // 2, out)
    return out


@njit(cache=True, nogil=True)
def _count(a, half, out):  # type: ignore[no-untyped-def]
    """Columns' counts move down with the window; along a row they are added by doubling, whole lines at a time."""
    rows, cols = a.shape
    wide = cols + 2 * half
    total = np.zeros(cols, dtype=np.int32)
    line, done = np.zeros(wide, dtype=np.int32), np.zeros(wide, dtype=np.int32)
    for r in range(-half, rows):
        for row, sign in ((r + half, 1), (r - half - 1, -1)):
            if 0 <= row < rows:
                for c in range(cols):
                    total[c] += sign if a[row, c] else 0
        if r < 0:
            continue
        line[:] = 0
        line[half : half + cols] = total
        _sums(line, done, 2 * half + 1)
        out[r] = done[:cols]


@njit(cache=True, nogil=True)
def _sums(line, done, n):  # type: ignore[no-untyped-def]
    """``done[c]`` = sum of c .. c + n - 1 of ``line``, which is used up."""
    m = line.shape[0]
    done[:] = 0
    w, have = 1, 0
    while True:
        if n & w:  # ``done`` holds sums of ``have``, ``line`` those of ``w``
            for c in range(m - w):
                done[c] = line[c] + done[c + w]
            for c in range(m - w, m):
                done[c] = line[c]
            have += w
        if have == n:
            break
        for c in range(m - w):
            line[c] += line[c + w]
        w *= 2


def window_mean(a: Floats32, n: int) -> Floats32:
    """Mean (row, col) of the known cells in the window; NaN where there is none."""
    out = np.empty(a.shape, dtype=np.float32)
    _mean(np.ascontiguousarray(a), n // 2, out)
    return out


LANES = 8
"""Rows whose sums along the columns run side by side: each waits for its own last one only."""


@njit(cache=True, nogil=True)
def _mean(a, half, out):  # type: ignore[no-untyped-def]
    """Sums of the columns move down with the window, the sum over columns along each row."""
    rows, cols = a.shape
    offset = _middle(a)
    total, count = np.zeros(cols), np.zeros(cols)
    sums, counts = np.zeros((cols + 2 * half + 1, LANES)), np.zeros((cols + 2 * half + 1, LANES))
    s, n = np.zeros(LANES), np.zeros(LANES)
    means = np.empty((cols, LANES), dtype=np.float32)
    for r in range(-half, rows):
        for row, sign in ((r + half, 1.0), (r - half - 1, -1.0)):
            if 0 <= row < rows:
                _add_row(a[row], offset, sign, total, count)
        if r < 0:
            continue
        lane = r % LANES
        for c in range(cols):
            sums[c + half + 1, lane], counts[c + half + 1, lane] = total[c], count[c]
        if lane < LANES - 1 and r < rows - 1:
            continue
        s[:], n[:] = 0.0, 0.0
        for c in range(-half, cols):
            for k in range(LANES):
                s[k] += sums[c + 2 * half + 1, k]
                n[k] += counts[c + 2 * half + 1, k]
            if c > half:
                for k in range(LANES):
                    s[k] -= sums[c, k]
                    n[k] -= counts[c, k]
            if c >= 0:
                for k in range(LANES):
                    means[c, k] = s[k] / n[k] + offset if n[k] > 0.5 else np.nan
        for k in range(lane + 1):
            for c in range(cols):
                out[r - lane + k, c] = means[c, k]


@njit(cache=True, nogil=True)
def _add_row(line, offset, sign, total, count):  # type: ignore[no-untyped-def]
    for c in range(line.shape[0]):
        v = line[c] - offset
        known = v == v
        total[c] += sign * v if known else 0.0
        count[c] += sign if known else 0.0


@njit(cache=True, nogil=True)
def _middle(a):  # type: ignore[no-untyped-def]
    """Mean of the known cells; 0 where there is none."""
    total, count = np.zeros(a.shape[1]), np.zeros(a.shape[1])
    for r in range(a.shape[0]):
        _add_row(a[r], np.float32(0.0), 1.0, total, count)
    n = count.sum()
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
