"""One-level matching to the letter of section 4.3: Eq. 1 to 3 on floating-point features, one centre, no smoothness."""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.level.subpixel import linear


def weighted(planes: AnyArray, weights: tuple[float, ...]) -> AnyArray:
    """Feature planes (8, row, col) as (row, col, 8) float32 vectors whose Euclidean distance is Eq. 1, grey levels."""
    w = np.asarray(weights, dtype=np.float32)
    # Weights of length one, so that distances are grey levels and the threshold keeps its meaning.
    w = w / np.sqrt(np.sum(w * w))
    return np.ascontiguousarray(np.moveaxis(planes * w[:, None, None], 0, -1), dtype=np.float32)


@njit(cache=True, nogil=True)
def _eq1(f, g):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for k in range(f.shape[0]):
        d = f[k] - g[k]
        total += d * d
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def search(images, centre, reach, out, at=(0, 0)):  # type: ignore[no-untyped-def]
    """Best match of every pixel in the search area around its centre (Eq. 2, Eq. 3).

    ``images``: vectors (row, col, 8) of the left and the right one. ``centre``: column and row displacement of each
    pixel; ``reach``: how far to either side. ``out``: column and row displacement found; distance by Eq. 1, -1 where
    nothing lies inside; linear sub-pixel offsets (row, col, 2) by 4.3.2, column and row, 0 at the border of the image.
    Of equal distances the first in row, column order wins. ``at``: column and row of the left window's first pixel in
    the right window.
    """
    (left, right), (centre_u, centre_v), (reach_x, reach_y), (ox, oy) = images, centre, reach, at
    out_u, out_v, out_distance, out_offset = out
    rows, cols = left.shape[:2]
    rrows, rcols = right.shape[:2]
    for y in range(rows):
        for x in range(cols):
            cu, cv = np.int64(centre_u[y, x]), np.int64(centre_v[y, x])
            best = np.float32(-1.0)
            bu, bv = cu, cv
            # The area is cut at the border, instead of each candidate clamped to it: none then comes up twice.
            for v in range(max(cv - reach_y, -y - oy), min(cv + reach_y, rrows - 1 - y - oy) + 1):
                for u in range(max(cu - reach_x, -x - ox), min(cu + reach_x, rcols - 1 - x - ox) + 1):
                    d = _eq1(left[y, x], right[y + oy + v, x + ox + u])
                    # -1 is nothing so far, as no distance is negative.
                    if best < 0 or d < best:
                        best = d
                        bu, bv = np.int64(u), np.int64(v)
            out_u[y, x], out_v[y, x], out_distance[y, x] = bu, bv, best
            out_offset[y, x, 0], out_offset[y, x, 1] = 0.0, 0.0
            xr, yr = x + ox + bu, y + oy + bv
            if best < 0:
                continue
            if xr > 0 and xr < rcols - 1:
                out_offset[y, x, 0] = linear(
                    _eq1(left[y, x], right[yr, xr - 1]), best, _eq1(left[y, x], right[yr, xr + 1])
                )
            if yr > 0 and yr < rrows - 1:
                out_offset[y, x, 1] = linear(
                    _eq1(left[y, x], right[yr - 1, xr]), best, _eq1(left[y, x], right[yr + 1, xr])
                )
