"""Coarse displacements between two frames at points, and the affinities fitted to them; windows about points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import AnyArray, Bundle
from rille.stages.core.validity import Mask
from rille.stages.facts.odometry import MotionFacts
from rille.stages.geometry.scale import common_similarity
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy

NEIGHBOURS = 12
"""Number of tracks that an affinity is fitted to: four times the three that it needs, and still local."""


def known(points: Floats) -> Bools:
    """Which points (n, k) are not NaN."""
    return np.asarray(np.isfinite(points).all(axis=1))


def windows_at(points: Floats, half: int, *images: AnyArray) -> tuple[Bools, list[AnyArray]]:
    """Whether the window of each point (n, 2) column, row is inside the images (rows, cols), and each image's windows.

    These are (n, side, side) of ``2 half + 1`` pixels about the nearest pixel; undefined for other points.
    """
    side, shape = 2 * half + 1, images[0].shape
    if min(shape) < side:
        return np.zeros(len(points), bool), [np.zeros((len(points), side, side), image.dtype) for image in images]
    first = np.floor(np.where(np.isfinite(points), points, -1e6) + 0.5).astype(np.intp) - half
    inside = np.asarray((first >= 0).all(1) & (first <= [shape[1] - side, shape[0] - side]).all(1))
    x, y = np.where(inside[:, None], first, 0).T
    return inside, [sliding_window_view(image, (side, side))[y, x] for image in images]


def known_median(values: NDArray[Any], known: NDArray[Any]) -> NDArray[Any]:
    """Median (n,) of the values (n, k) that are not NaN, of which there are ``known`` (n,); NaN where there are none.

    NumPy's own takes twenty times as long on many short rows.
    """
    # NaN is sorted to the end, so the first ``known`` of a row are its values.
    ordered, row = np.sort(values, axis=-1), np.arange(len(values))
    low, high = ordered[row, np.maximum(known - 1, 0) // 2], ordered[row, known // 2]
    return np.asarray(np.where(known > 0, (low + high) * values.dtype.type(0.5), values.dtype.type(np.nan)))


def fit_affinity(origin: Floats, moved: Floats, use: Bools, at: Floats) -> tuple[Floats, Floats]:
    """Affinity (n, 2, 2) and displacement (n, 2) at points ``at`` (n, 2) from the nearest pairs ``origin -> moved``.

    Least squares, reweighted by Cauchy's weights of one pixel, so that a neighbour on another surface counts little. A
    weak pull towards the rotation and scale that all pairs share keeps neighbours on a line from inventing a change of
    shape. Too few pairs: no change.
    """
    n = len(at)
    identity, nothing = np.tile(np.eye(2), (n, 1, 1)), np.zeros((n, 2))
    p, q = origin[use], moved[use]
    # Six numbers need three pairs; with fewer than twice that, a wrong pair is not seen.
    if len(p) < 6 or n == 0:
        return identity, nothing
    common = common_similarity(p, q)
    # A lost point gets an affinity like any other, which is not used.
    at = np.nan_to_num(at)
    _, near = scipy.spatial.cKDTree(p).query(at, k=min(NEIGHBOURS, len(p)))
    offset = p[near] - at[:, None]
    # Less the common similarity: so the pull is towards it, not towards no change.
    shift = (q - p)[near] - offset @ (common - np.eye(2)).T
    count = near.shape[1]

    def weights(residual: Floats) -> Floats:
        weight = cauchy(residual, 1.0)
        # The pull is that of a spread in pixels whatever the neighbours' weights.
        return np.asarray(weight * count / weight.sum(-1, keepdims=True))

    design = np.concatenate([offset, np.ones((n, count, 1))], -1)
    # 5.0: spread [pixels] of the neighbours below which they do not determine a change of shape.
    fitted = irls(design, shift, weights, count * np.diag([5.0**2, 5.0**2, 0.0]), rounds=4)
    return common + np.swapaxes(fitted[:, :2], 1, 2), fitted[:, 2]


@dataclass(frozen=True)
class Motion:
    """Displacements of the grid of pyramid level ``level`` of frame a, in pixels of **level 0**.

    Grid pixel (row, col) stands for level-0 position ``(col + 0.5) * 2**level - 0.5`` (rows likewise). All arrays are
    (row, col): ``column_disparity, row_disparity`` float32, b minus a, NaN undefined, interpolated ones
    included; ``validity`` bits of :class:`~rille.stages.core.validity.Validity`.
    """

    level: int
    column_disparity: Floats32
    row_disparity: Floats32
    validity: Mask

    @staticmethod
    def of(bundle: Bundle[MotionFacts]) -> Motion:
        """Result of stage ``motion``."""
        names = "column_disparity", "row_disparity", "validity"
        return Motion(bundle.meta["level"], *(np.asarray(bundle[name]) for name in names))

    def at(self, points: Floats) -> Floats:
        """Displacement (n, 2) at points (n, 2), pixels: median of the defined ones among 3 x 3; NaN none."""
        k = 0.5**self.level
        rows, cols = self.validity.shape
        # Pixel of the coarse level that holds the point: edges lie half a pixel before the centres.
        centre = np.floor((np.nan_to_num(points) + 0.5) * k).astype(np.intp)
        dy, dx = (o.ravel() for o in np.mgrid[-1:2, -1:2])
        y, x = np.clip(centre[:, 1:] + dy, 0, rows - 1), np.clip(centre[:, :1] + dx, 0, cols - 1)
        both = np.stack([self.column_disparity[y, x], self.row_disparity[y, x]], -1).astype(np.float64)
        there = np.asarray(np.isfinite(both).all(axis=-1))
        count = there.sum(axis=1)
        both = np.where(there[..., None], both, np.nan)
        value = np.stack([known_median(both[..., k], count) for k in range(2)], axis=-1)
        return np.where(known(points)[:, None], value, np.nan)
