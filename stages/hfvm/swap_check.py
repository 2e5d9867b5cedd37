"""Whether two images were given in the wrong order: what their disparities alone can tell.

With the right camera on the right, nothing has a column displacement greater than infinitely far things have (right
minus left). Without calibration that of far things is not known: cameras that converge by an angle t move them by
D = f t. But they also make a keystone, a row displacement (t / f) x y about the image's middle, which matches show.
The focal length f is between half and three times the image width, so D is k f^2 with k = t / f within bounds. Images
are swapped for certain where nearly all displacements lie beyond the upper one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray

FOCAL = 0.5, 3.0
"""Bounds of the focal length in image widths: fields of view of 90 and 19 degrees."""

SAMPLES, LEAST = 2000, 100
ITERATIONS = 8
MARGIN = 1.0
"""Pixels: displacements that are no more than this beyond the bound prove nothing."""

NEARLY_ALL = 10.0
"""Percentile of displacements that has to lie beyond the bound."""


def swapped(column: AnyArray, row: AnyArray, matched: NDArray[np.bool_]) -> bool:
    """Whether left and right image of a stereo rig must have been swapped; False also where nobody can know.

    Parameters
    ----------
    column, row : (row, col) disparities, pixels, right minus left.
    matched : (row, col) bool, which to trust.
    """
    found = np.flatnonzero(matched)
    if len(found) < LEAST:
        return False
    found = found[:: 1 + len(found) // SAMPLES]
    y, x = np.unravel_index(found, matched.shape)
    u, v = (np.asarray(a).reshape(-1)[found].astype(np.float64) for a in (column, row))
    width = matched.shape[1]
    k, sigma = _keystone((x - 0.5 * (width - 1)) / width, (y - 0.5 * (matched.shape[0] - 1)) / width, u, v)
    # In units of the image width k is D in pixels for a focal length of one width.
    most = k + 3.0 * sigma
    # A keystone may be negative: then the short focal length gives the upper bound.
    bound = max(most * FOCAL[0] ** 2, most * FOCAL[1] ** 2)
    return bool(np.percentile(u, NEARLY_ALL) > bound + MARGIN)


def _keystone(x: AnyArray, y: AnyArray, u: AnyArray, v: AnyArray) -> tuple[float, float]:
    """Factor of x y in the row displacements, pixels, and its standard deviation, robustly (Cauchy weights).

    Other terms: row offset, roll, scale, relative pitch, baseline across the rows, one camera before the other.
    """
    depth = (u - u.mean()) / max(float(u.std()), 1e-6)
    terms = np.stack([x * y, np.ones_like(x), x, y, y * y, depth, depth * y], -1)
    weight = np.ones_like(x)
    for _ in range(ITERATIONS):
        # A flat scene has no depth, whose terms are zero: without the last part the matrix would be singular.
        normal = (terms * weight[:, None]).T @ terms + 1e-9 * len(x) * np.eye(terms.shape[1])
        solution = np.linalg.solve(normal, (terms * weight[:, None]).T @ v)
        residual = v - terms @ solution
        # Rows that agree exactly leave residuals of zero to divide by.
        spread = max(1.5 * float(np.median(np.abs(residual))), 1e-3)
        weight = 1.0 / (1.0 + (residual / spread) ** 2)
    return float(solution[0]), spread * float(np.sqrt(np.linalg.inv(normal)[0, 0]))
