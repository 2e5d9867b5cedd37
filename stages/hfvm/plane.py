"""Pre-alignment of the right image by the homography of the dominant plane, fitted to coarse matches.

Feature vectors compare upright windows. On ground seen obliquely the disparity changes by half a pixel from row to row,
and a 13-pixel kernel shears by several pixels: the matcher then finds plateaus instead of a slope. So the images are
first matched coarsely as they are; if one plane (which includes roll, row offset and toe-in) explains most of those
matches and distorts windows noticeably, the right image is resampled by its homography and matching starts again. The
homography comes from matches alone, without calibration; displacements refer to the original images.

Beyond a turn of some 20 degrees or a scale of 1.3 coarse matching fails. There keypoints with an orientation and scale
of their own (SIFT, Lowe 2004; compared by the square roots of their histograms, Arandjelovic and Zisserman 2012) give
the homography from which each level is searched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.geometry.cubic import cubic
from rille.stages.geometry.projection import product
from rille.stages.hfvm.epipolar import typical
from rille.stages.hfvm.image import Grey, Image, Layer, Shape, Window
from rille.stages.imaging.features import match, root_sift
from rille.stages.imaging.pyramid import filled_from
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy

Matrix = NDArray[np.float64]


class Sample(NamedTuple):
    """Sub-pixel matches of a level, in reading order: columns, rows, displacements (n,), pixels."""

    x: AnyArray
    y: AnyArray
    u: AnyArray
    v: AnyArray


KERNEL_REACH_PX = 2
"""Pixels that the cubic kernel reaches beyond a place."""


def find(sample: Sample, level: int, shapes: Sequence[Shape], few: bool = False) -> Matrix | None:
    """Homography from aligned pixels to pixels of the right image (level 0); None if alignment would not help.

    ``shapes``: of the left image's levels; ``few``: whether few pixels match.
    """
    fit = fit_points(sample, shapes[level])
    # 0.6: least share of the coarse matches on the plane; a street's ground has .44 to .55.
    # 0.5: the same where windows are so sheared that few pixels match, least of all on the ground.
    if fit is None or fit[1] < (0.5 if few else 0.6):
        return None
    h = to_level_0(fit[0], level)
    shear = distortion(h, (shapes[0][0], shapes[0][1]))
    # 0.2: shear or stretch, pixels per pixel, from which on images are aligned.
    # 3.0: shear or stretch, pixels per pixel, from which on the plane is no ground but a bad fit; views turned by 180
    # degrees have 2, and more if scaled.
    return h if 0.2 <= shear < 3.0 else None


def refitted(sample: Sample, level: int, shapes: Sequence[Shape], h: Matrix) -> Matrix | None:
    """Homography of the dominant plane, from matches with the right image aligned by ``h``; None if too few."""
    fit = fit_points(sample, shapes[level])
    return None if fit is None else to_original(h, shapes[0]) @ to_level_0(fit[0], level)


def aligned(right: Image, h: Matrix, left: Image) -> Image:
    """The right image resampled to the left one's geometry, with :func:`margin` pixels more on every side."""
    layers: list[Layer] = []
    m, levels = margin(left.shapes[0]), min(len(left.layers), len(right.layers))
    # Each aligned level is read from that level of the right image whose pixels, which are means, are of the same size:
    # larger ones blur, smaller ones alias. Blurring is worse (0.2): at 1.4 times the size fine texture is lost.
    above = round(math.log2(scale(h, left.shapes[0])) - 0.2)
    # From the top down, since masked pixels take their grey value from the level above.
    for n in range(levels - 1, -1, -1):
        source = min(max(n + above, 0), len(right.layers) - 1)
        layer = right.layers[source]
        own = np.linalg.inv(finer(source)) @ h @ finer(n) @ translation(-(m >> n))
        wide = tuple(k + 2 * (m >> n) for k in left.shapes[n])
        layers.insert(0, Layer.of(partial(_resampled, layer, own, layers[0] if layers else None), wide, layer.weights))
    return Image(tuple(layers), right.noise)


def _resampled(layer: Layer, h: Matrix, above: Layer | None, window: Window) -> Grey:
    source = _source(h, window, layer.shape)
    part = layer.cut(source)
    # The kernel reads repeated edges, so that no pixel of a coarse level, which has few, is lost.
    grey, mask = np.pad(part.grey, KERNEL_REACH_PX, mode="edge"), np.pad(part.valid, KERNEL_REACH_PX)
    image, valid = np.empty(window.shape, np.float32), np.empty(window.shape, np.uint8)
    there = translation(KERNEL_REACH_PX - source.x0, KERNEL_REACH_PX - source.y0)
    warp(grey, mask, there @ h @ translation(window.x0, window.y0), image, valid)
    seen = valid != 0
    if seen.all():
        return image, valid
    if above is None:
        # The same for every window.
        return np.where(seen, image, layer.grey.mean()), valid
    outer = window.parent()
    return filled_from(above.cut(outer).grey, image, seen, window.y0 - 2 * outer.y0, window.x0 - 2 * outer.x0), valid


def _source(h: Matrix, window: Window, shape: Shape) -> Window:
    """Window of an image of ``shape`` that :func:`warp` reads for a window of its result."""
    y, x = np.meshgrid([window.y0, window.y1 - 1], [window.x0, window.x1 - 1], indexing="ij")
    p, q, w = product(h, x, y)
    if (w <= 1e-3).any():  # the horizon crosses it: a quadrangle does not hold it
        return Window(0, shape[0], 0, shape[1])
    # Near the horizon ends run off to numbers that no index holds; four pixels hold the cubic kernel.
    y0, x0 = (int(np.clip(np.floor(a.min()) - 4, 0, n - 1)) for a, n in zip((q / w, p / w), shape, strict=True))
    y1, x1 = (int(np.clip(np.ceil(a.max()) + 5, 1, n)) for a, n in zip((q / w, p / w), shape, strict=True))
    return Window(y0, max(y1, y0 + 1), x0, max(x1, x0 + 1))


def to_original(h: Matrix, left_shape: Shape) -> Matrix:
    """Homography to the original right image from aligned pixels in coordinates of the left image."""
    return h @ translation(-margin(left_shape))


@kernel
def carried(g, u, v, x0=0, y0=0):  # type: ignore[no-untyped-def]
    """Displacements (row, col) float32 whose ends are those of ``u, v``, mapped by the homography ``g``.

    ``x0, y0``: first column and row of the left image's window. NaN beyond the horizon.
    """
    out_u, out_v = np.empty(u.shape, np.float32), np.empty(u.shape, np.float32)
    for row in range(u.shape[0]):
        for col in range(u.shape[1]):
            # In double precision: differences of columns lose digits.
            x, y = np.float64(col + x0), np.float64(row + y0)
            p, q, w = product(g, x + u[row, col], y + v[row, col])
            # Points beyond the horizon would come back mirrored.
            w = w if w > 0.0 else np.nan
            out_u[row, col], out_v[row, col] = p / w - x, q / w - y
    return out_u, out_v


def margin(left_shape: tuple[int, ...]) -> int:
    """Pixels added on every side of the aligned image: a multiple of 32, whole pixels down to the sixth level."""
    # A sixteenth of the width, for things that stand out of the plane.
    return int(np.ceil(left_shape[1] / 16.0 / 32.0)) * 32


def translation(x: float, y: float | None = None) -> Matrix:
    """Homography that adds ``x`` to columns and ``y`` (None: as much) to rows, pixels."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, x if y is None else y], [0.0, 0.0, 1.0]])


def fit_points(sample: Sample, shape: Shape) -> tuple[Matrix, float] | None:
    """Homography of the dominant plane, and the share of matches within two pixels of it; None: too few.

    Parameters
    ----------
    sample : matches of one level, which has ``shape``.

    Returns
    -------
    (3, 3) float64 H with ``(x + u, y + v, 1) ~ H (x, y, 1)``, and the share.
    """
    x, y, u, v = sample
    if len(y) < 60:
        return None
    # In half image sides all eight terms are of similar size, so that one weak prior suits them all.
    scale = 0.5 * max(shape)
    middle = (0.5 * shape[1] / scale, 0.5 * shape[0] / scale)
    to_unit = np.array([[1 / scale, 0.0, -middle[0]], [0.0, 1 / scale, -middle[1]], [0.0, 0.0, 1.0]])
    p = np.stack([x / scale - middle[0], y / scale - middle[1]])
    d = np.stack([u, v]).astype(np.float64) / scale
    # A match that lies a pixel of the level off the plane has a quarter of the weight.
    unit, error = _solve(p, d, 1.0 / scale)
    return np.linalg.inv(to_unit) @ unit @ to_unit, float(np.mean(error <= 2.0 / scale))


def _solve(p: AnyArray, d: AnyArray, tolerance: float) -> tuple[Matrix, AnyArray]:
    """Robust homography of points (2, n) that move by ``d`` (2, n), and the error of each point.

    ``q = p + d`` with q ~ H p is linear in the eight terms of H - I where H[2, 2] = 1; a weak prior holds them at zero.
    """
    one, nil, q = np.ones_like(p[0]), np.zeros_like(p[0]), p + d
    along = [p[0], p[1], one, nil, nil, nil, -q[0] * p[0], -q[0] * p[1]]
    across = [nil, nil, nil, p[0], p[1], one, -q[1] * p[0], -q[1] * p[1]]
    terms, target, spread = np.hstack([along, across]), d.ravel(), math.inf

    def weigh(residual: AnyArray) -> AnyArray:
        nonlocal spread
        error = np.hypot(*residual.reshape(2, -1))
        # Equal weights at first; then from the scatter of the matches on, narrowing to the dominant plane.
        if math.isinf(spread):
            spread = 1e6  # half image sides: no error is greater
            return np.ones(len(target))
        spread = max(tolerance, min(1.5 * typical(error), 0.7 * spread))
        # Squared Cauchy weights: other surfaces, off by many pixels, must not pull the plane.
        return np.tile(cauchy(error, spread) ** 2, 2)

    h = irls(terms.T, target, weigh, 1e-6 * len(one) * np.eye(8), rounds=15)
    error = np.hypot(*(h @ terms - target).reshape(2, -1))
    return np.append(h, 0.0).reshape(3, 3) + np.eye(3), error


def to_level_0(h: Matrix, level: int) -> Matrix:
    """Homography of pixels of level 0, from that of pixels of ``level``."""
    up = finer(level)
    return np.asarray(up @ h @ np.linalg.inv(up), dtype=np.float64)


def finer(level: int) -> Matrix:
    """Homography from pixels of a level to those of level 0, whose centres lie half a pixel inside their corners."""
    k = 2.0**level
    # Pixel x of the level covers k pixels from k x on, whose middle is k x + (k - 1) / 2: at level 1 it is 2x + 0.5.
    return np.array([[k, 0.0, 0.5 * k - 0.5], [0.0, k, 0.5 * k - 0.5], [0.0, 0.0, 1.0]])


def scale(h: Matrix, shape: Shape) -> float:
    """Size of the aligned image's middle pixel in pixels of the right image, geometric mean of both sides."""
    w = product(h, 0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))[2]
    # The determinant of the derivative of a homography.
    return math.sqrt(abs(float(np.linalg.det(h))) / abs(w) ** 3)


def distortion(h: Matrix, shape: tuple[int, int]) -> float:
    """Largest element of the derivative less the identity, each element the median over the image."""
    y, x = np.meshgrid(np.linspace(0, shape[0] - 1, 5), np.linspace(0, shape[1] - 1, 5), indexing="ij")
    p, q, w = product(h, x, y)
    # A plane whose horizon comes so near is no ground but a bad fit: infinity has it refused.
    if (w <= 0.1).any():
        return np.inf
    p, q = p / w, q / w
    parts = [
        (h[0, 0] - p * h[2, 0]) / w - 1,
        (h[0, 1] - p * h[2, 1]) / w,
        (h[1, 0] - q * h[2, 0]) / w,
        (h[1, 1] - q * h[2, 1]) / w - 1,
    ]
    return float(max(np.median(np.abs(d)) for d in parts))


@kernel
def warp(image, valid, h, out, out_valid):  # type: ignore[no-untyped-def]
    """``out(x, y) = image(H (x, y))``, Catmull-Rom; ``out_valid`` 0 where that is outside or masked."""
    height, width = image.shape
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x], out_valid[y, x] = 0.0, 0
            p, q, w = product(h, x, y)
            if w <= 1e-6:
                continue
            p, q = p / w, q / w
            # The cubic kernel reads one pixel before and two after.
            if not (p >= 1 and p < width - 2 and q >= 1 and q < height - 2):
                continue
            # The nearest pixel decides: masked ones beside it carry grey from above and do not darken the kernel.
            if valid[int(q + 0.5), int(p + 0.5)]:
                out[y, x] = cubic(image, np.float32(p), np.float32(q))
                out_valid[y, x] = 1


MIN_AGREEING = 15
"""Least number of agreeing keypoints; in unrelated images, and under another sun, 6 agree."""


def find_turn(left: Image, right: Image) -> Matrix | None:
    """Homography from left to right pixels (level 0) on which enough keypoints agree, or None."""
    levels = [_level(view) for view in (left, right)]
    (p, _, a), (q, _, b) = (_keypoints(view, level) for view, level in zip((left, right), levels, strict=True))
    first, second = match(a.astype(np.float32), b.astype(np.float32)).T
    if len(first) < MIN_AGREEING:
        return None
    # Relief moves keypoints off the dominant surface by as much.
    limit = 0.01 * max(right.shapes[levels[1]])
    h, agree = cv2.findHomography(p[first], q[second], cv2.USAC_MAGSAC, limit, maxIters=5000, confidence=0.999)
    # 0.2: share of the unambiguous keypoints that must agree.
    if h is None or agree.sum() < max(MIN_AGREEING, 0.2 * len(first)) or not _upright(h, left.shapes[levels[0]]):
        return None
    # Images of unlike size have keypoints of unlike levels.
    return np.asarray(finer(levels[1]) @ h @ np.linalg.inv(finer(levels[0])), dtype=np.float64)


def _level(view: Image) -> int:
    """Level of the keypoints: the finest whose longer side is at most 1024 pixels, else the coarsest."""
    return next((n for n, shape in enumerate(view.shapes) if max(shape) <= 1024), len(view.shapes) - 1)


def _keypoints(view: Image, level: int) -> tuple[Floats, Floats, Bytes]:
    """Keypoints of a level: columns and rows, pixels of the level, sizes, and descriptors (:func:`root_sift`)."""
    layer = view.layers[level]
    grey = np.clip(np.rint(layer.grey), 0, 255).astype(np.uint8)
    # At most 4000: the time of comparing all with all grows with the square.
    # 0.02: least contrast of a keypoint; half of OpenCV's default, for sand and haze.
    sift = cv2.SIFT.create(nfeatures=4000, contrastThreshold=0.02)
    return root_sift(sift, grey, (layer.valid != 0).astype(np.uint8))


def _upright(h: Matrix, shape: Shape) -> bool:
    """Whether the whole image stays on this side of the horizon and is not mirrored."""
    rows, cols = shape
    corners = np.array([[0, 0, 1], [cols - 1, 0, 1], [0, rows - 1, 1], [cols - 1, rows - 1, 1]], np.float64).T
    # The horizon is a line: with all corners on this side no pixel lies beyond it.
    return bool(((h @ corners)[2] > 0).all() and np.linalg.det(h) > 0)
