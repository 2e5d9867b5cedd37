"""Disparities of half the resolution at the full one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.core.validity import Validity


def doubled(
    arrays: Mapping[str, AnyArray], valid: AnyArray, right: tuple[int, ...], first: tuple[int, int]
) -> dict[str, AnyArray]:
    """Arrays of a window at full resolution that begins at column and row ``first``; ``right``: the image's shape.

    Both images' pixel centres shift alike, so that nothing is to be added. Slopes, which aligned images have, are
    followed. Where a displacement then leaves the right image, or a pixel is masked, it is undefined.
    """
    rows, cols = valid.shape
    rest = ("validity", "backmatch_error", "distance", "disparity_std")
    big = {name: arrays[name].repeat(2, axis=0)[:rows].repeat(2, axis=1)[:, :cols] for name in rest}
    u, v, inside = np.empty(valid.shape, np.float32), np.empty(valid.shape, np.float32), np.empty(valid.shape, bool)
    _doubled((arrays["column_disparity"], arrays["row_disparity"]), first, right, (u, v), inside)
    bits = big["validity"]
    gone = (valid == 0) | (~inside & (bits & Validity.MATCHED != 0))
    bits[gone] = bits[gone] & ~np.uint8(Validity.MATCHED | Validity.INTERPOLATED)
    bits[gone] |= np.uint8(Validity.OUT_OF_IMAGE)
    for a in (big["backmatch_error"], big["disparity_std"]):
        a *= 2
    for a in (u, v, big["disparity_std"]):
        np.copyto(a, np.float32(np.nan), where=gone)
    return {"column_disparity": u, "row_disparity": v, **big}


@njit(cache=True, nogil=True)
def _doubled(small, first, right, big, inside):  # type: ignore[no-untyped-def]
    """Displacements twice as large, along their slopes, and whether they end in the right image."""
    rows, cols = inside.shape
    u, v = big
    for k in range(2):
        a, out = small[k], big[k]
        for j in range(a.shape[0]):
            for i in range(a.shape[1]):
                along, down = _slope(a, j, i, 0, 1), _slope(a, j, i, 1, 0)
                for y in range(2 * j, min(2 * j + 2, rows)):
                    for x in range(2 * i, min(2 * i + 2, cols)):
                        # From the middle of the four pixels half a pixel to either side.
                        below, beside = np.float32(y - 2 * j - 0.5), np.float32(x - 2 * i - 0.5)
                        out[y, x] = 2 * a[j, i] + down * below + along * beside
    for y in range(rows):
        for x in range(cols):
            xr, yr = np.float32(x + first[0]) + u[y, x], np.float32(y + first[1]) + v[y, x]
            inside[y, x] = (xr >= 0) & (xr <= right[1] - 1) & (yr >= 0) & (yr <= right[0] - 1)


@njit(cache=True, nogil=True)
def _slope(a, y, x, down, along):  # type: ignore[no-untyped-def]
    """Slope of displacements where it is alike on both sides, within a pixel; else 0."""
    if y < down or x < along or y + down >= a.shape[0] or x + along >= a.shape[1]:
        return np.float32(0.0)
    before, after = a[y, x] - a[y - down, x - along], a[y + down, x + along] - a[y, x]
    return np.float32(0.5) * (before + after) if abs(before - after) <= 1 else np.float32(0.0)
