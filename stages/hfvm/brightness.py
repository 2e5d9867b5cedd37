"""The ratio of the brightness of two images, left over right, and images with it corrected.

Where texture is weak, matches follow the gradient of brightness, and if this gradient differs between the images, they
are wrong. The logarithm of the ratio (vignetting, exposure) is a polynomial in the coordinates of the right image. It
is fitted to the grey values of matches of a coarse level. Before there are matches, it is guessed from the grey values
of each image as a whole, since both show nearly the same scene; the guess is used only if it gives more matches.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import Grey, Image, Shape, Window, thinned
from rille.stages.hfvm.level import State
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy

MIN_FIT_PIXELS = 100
"""Pixels that a polynomial needs at least."""

MIN_GREY, MAX_GREY = 4.0, 250.0
"""Grey levels between which pixels are used for the ratio."""

MIN_LOG_RATIO = 0.1
"""Logarithm of the ratio that must be reached somewhere in the image for it to be corrected."""


def terms(x: AnyArray, y: AnyArray, level: int, shape: Shape) -> Floats:
    """Terms (7, ...) of the polynomial at pixels of a level of an image of ``shape`` (level 0).

    1, x, y, x^2, xy, y^2 and (x^2 + y^2)^2, in half sides from the middle.
    """
    k = 2.0**level
    # Counted from the image's outer corner, where pixel x of any level has its centre at k (x + 0.5).
    p = ((x + 0.5) * k) / (0.5 * shape[1]) - 1.0
    q = ((y + 0.5) * k) / (0.5 * shape[0]) - 1.0
    p, q = np.broadcast_arrays(p, q)
    return np.stack([np.ones_like(p), p, q, p * p, p * q, q * q, (p * p + q * q) ** 2])


def levelled(image: Image, ratio: Floats | None) -> Image:
    """The image with the ratio corrected; None: the image as it is."""
    if ratio is None:
        return image
    # Noise is multiplied as the middle of the image is.
    return image.changed(partial(_brighter, ratio, image.shapes[0]), image.noise * float(np.exp(ratio[0])))


def _brighter(g: Floats, shape: Shape, read: Callable[[Window], Grey], level: int, window: Window) -> Grey:
    grey, mask = read(window)
    y, x = np.arange(window.y0, window.y1)[:, None], np.arange(window.x0, window.x1)
    p, q = terms(x, 0 * x, level, shape)[1], terms(0 * y, y, level, shape)[2]
    # Horner's form, a row of terms each: seven planes of the whole image would take longer than all else.
    radial = (p * p + q * q).astype(np.float32)
    log = (g[0] + p * (g[1] + g[3] * p)).astype(np.float32) + (q * (g[2] + g[5] * q)).astype(np.float32)
    log += np.float32(g[4]) * (p.astype(np.float32) * q.astype(np.float32)) + np.float32(g[6]) * radial * radial
    return grey * np.exp(log), mask


def guess(left: Image, right: Image, level: int) -> Floats:
    """Ratio of the polynomials that either image's own brightness follows at a level; zeros of dark or tiny images."""
    polynomials = []
    for image in (left, right):
        layer = image.layers[level]
        y, x = np.nonzero((layer.valid != 0) & (layer.grey > MIN_GREY))
        if len(y) < MIN_FIT_PIXELS:
            return np.zeros(7)
        polynomials.append(_fit(terms(x, y, level, image.shapes[0]), np.log(layer.grey[y, x].astype(np.float64))))
    return polynomials[0] - polynomials[1]


def ratio_of_matches(left: Image, right: Image, state: State) -> Floats | None:
    """Ratio of the grey values of the consistent matches of a level; None where they are too few."""
    y, x = thinned(state.left_ok, 4000)
    p, q = x + state.left.u[y, x].astype(np.int64), y + state.left.v[y, x].astype(np.int64)
    a, b = left.layers[state.level].grey[y, x], right.layers[state.level].grey[q, p]
    # At MIN_GREY one grey level is a quarter of the value, five times the least scatter; at the top values are clipped.
    good = (np.minimum(a, b) > MIN_GREY) & (np.maximum(a, b) < MAX_GREY)
    if np.count_nonzero(good) < MIN_FIT_PIXELS:
        return None
    # Places of the right image, since that is the one to be multiplied.
    basis = terms(p[good], q[good], state.level, right.shapes[0])
    return _fit(basis, np.log(a[good].astype(np.float64) / b[good]))


def _fit(basis: Floats, target: Floats) -> Floats:
    """Factors of the terms, by Cauchy weights; weakly held at zero."""

    def weigh(off: AnyArray) -> AnyArray:
        # 1.5 times the median magnitude is about the standard deviation of normal scatter.
        # 0.05: least scatter of the logarithms of matched grey values.
        return cauchy(off, max(0.05, 1.5 * epipolar.typical(off)))

    # Terms that the matches leave open stay near zero instead of growing outside of them.
    hold = 1e-3 * target.size * np.eye(len(basis))
    return irls(basis.T, target, weigh, hold, np.zeros(len(basis)), rounds=8)


def greatest(ratio: Floats) -> float:
    """Greatest logarithm, either way, in the image."""
    side = np.linspace(0, 1, 9)
    # Nine places from edge to edge of an image of 9 x 9: terms are in half sides, so that any size stands for all.
    return float(np.abs(np.tensordot(ratio, terms(side * 9 - 0.5, (side * 9 - 0.5)[:, None], 0, (9, 9)), 1)).max())
