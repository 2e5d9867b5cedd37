"""Quality of one stereo pair before matching: grey values, sharpness, and digests that show repeated images.

These figures distinguish a black, blurred or repeated image from a good one (:mod:`rille.stages.imaging.image_faults`).
The decision is made over the whole sequence (:mod:`rille.stages.odometry.frame_screening`).
"""

from __future__ import annotations

import hashlib
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.imaging import QualityFacts
from rille.stages.imaging.pyramid import grey

MAX_DARK_GREY, MIN_BRIGHT_GREY = 2.0, 253.0
"""Grey values at which an 8-bit image is taken as clipped."""

MAX_GREY_ROWS = 0.1
"""Share of the rows of an image with one grey value, beyond those of the other image, that is no chance."""

STRIP_ROWS = 32
"""Rows of a strip: some ten thousand pixels, and three times the reach of the wider blur."""

ALONG = {"sharpness": (1, 1), "sharpness_rows": (1, 0), "sharpness_columns": (0, 1)}
"""Directions (column, row) in which sharpness is measured: motion blurs an image along one of them alone."""


def texture(image: NDArray[Any], valid: Bytes) -> tuple[tuple[float, ...], float]:
    """Sharpness (both ways, along rows, along columns) and detail of an image (row, col); ``valid`` not zero where
    usable. NaN: no pixel is usable.

    Sharpness is the detail between one and two pixels over that between two and four, RMS: it hardly depends on the
    scene, but decreases with blur. Detail is the latter, both ways, over the standard deviation: without it noise alone
    determines the sharpness.
    """
    level = grey(image)
    usable = (valid != 0) & np.isfinite(level)
    inner = None
    if not usable.all():
        if not usable.any():
            return (math.nan,) * len(ALONG), 0.0
        level = np.where(usable, level, level[usable].mean())
        # Three standard deviations of the wider blur, within which the mask changes the result.
        inner = cv2.erode(usable.astype(np.uint8), np.ones((13, 13), np.uint8))
    count = math.sqrt(max(level.size if inner is None else int(np.count_nonzero(inner)), 1))
    scales = list[tuple[float, float]]()
    for x, y in ALONG.values():
        # 1e-3 pixels: no blur in that direction.
        once, twice = (cv2.GaussianBlur(level, (0, 0), max(s * x, 1e-3), None, max(s * y, 1e-3)) for s in (1.0, 2.0))
        fine, coarse = (cv2.norm(a, b, cv2.NORM_L2, inner) / count for a, b in ((level, once), (once, twice)))
        scales.append((fine, coarse))
    deviation = float(cv2.meanStdDev(level, mask=None if inner is None else usable.astype(np.uint8))[1][0, 0])
    sharpness = tuple(fine / coarse if coarse > 0 else math.nan for fine, coarse in scales)
    return sharpness, scales[0][1] / deviation if deviation > 0 else 0.0


def glance(image: NDArray[Any], valid: Bytes) -> dict[str, Any]:
    """Figures of an image (row, col); ``valid`` not zero where usable.

    ``mean`` (None: no pixel is usable) and ``deviation``, grey 0..255; shares ``dark`` and ``bright`` of clipped
    pixels; of strips ``sharpness``, also along ``_rows`` and ``_columns`` (None: unknown), and ``detail``; ``digest``
    of the pixels; if large, share ``grey_rows`` of the rows that have one value, neither black nor white.
    """
    rows = image.shape[0]
    # (0.25, 0.5, 0.75): positions over the height of strips, which represent the image.
    first = sorted(
        {int(np.clip(share * rows - STRIP_ROWS / 2, 0, max(rows - STRIP_ROWS, 0))) for share in (0.25, 0.5, 0.75)}
    )
    textures = [texture(image[r : r + STRIP_ROWS], valid[r : r + STRIP_ROWS]) for r in first]
    sharp = [s for s, _ in textures if all(map(math.isfinite, s))]
    sharpness = [float(of) for of in np.median(sharp, axis=0)] if sharp else [None] * len(ALONG)
    # A quarter of the pixels is enough for mean and deviation.
    thinned = grey(np.ascontiguousarray(image[::2, ::2]))
    mask = ((valid[::2, ::2] != 0) & np.isfinite(thinned)).astype(np.uint8)
    (mean,), (deviation,) = (a.ravel() for a in cv2.meanStdDev(thinned, mask=mask))
    usable = thinned[mask != 0]
    least, most = (np.where(mask != 0, thinned, far) for far in (np.inf, -np.inf))
    least, most = least.min(axis=1), most.max(axis=1)
    one = float(((least == most) & (least > MAX_DARK_GREY) & (least < MIN_BRIGHT_GREY)).mean())
    return {
        "mean": float(mean) if usable.size else None,
        "deviation": float(deviation),
        "dark": float((usable <= MAX_DARK_GREY).mean()) if usable.size else 0.0,
        "bright": float((usable >= MIN_BRIGHT_GREY).mean()) if usable.size else 0.0,
        **dict(zip(ALONG, sharpness, strict=True)),
        "detail": float(np.median([d for _, d in textures])),
        "digest": hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest(),
        **({"grey_rows": one} if one > MAX_GREY_ROWS else {}),
    }


@stage("image_quality")
def image_quality_stage(params: NoParams, left: Bundle, right: Bundle, *, frame: int) -> Bundle[QualityFacts]:
    """Grey values and sharpness of a pair, before anything is matched."""
    glances = [
        glance(np.asarray(image["image"]), np.asarray(image["valid"])) | {"damage": image.meta.get("damage")}
        for image in (left, right)
    ]
    return Bundle({}, {"frame": frame, "left": glances[0], "right": glances[1]})
