"""Validity of a pixel's disparity: a documented bit mask, never a magic value (paper, 4.3.1 and 4.3.3).

A pixel's disparity is defined where ``MATCHED`` or ``INTERPOLATED`` is set, never both. The other bits say why a pixel
is not ``MATCHED``; they stay set when it was interpolated.
"""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.uint8]


class Validity(IntFlag):
    """Bits of the ``validity`` arrays (uint8)."""

    MATCHED = 1
    """Found, and consistent under back-matching; or, without that, on the plane of a textureless region."""
    INTERPOLATED = 2
    """Filled from consistent neighbours; not a measurement."""
    BACKMATCH_FAILED = 4
    """Matching back from the other image does not return to this pixel."""
    OVER_THRESHOLD = 8
    """The least feature distance is too great: not matchable."""
    OUT_OF_IMAGE = 16
    """Masked here, or the search or its best match lies on a border or on masked pixels there."""
    NO_TEXTURE = 32
    """Too little grey value variation to match."""
    SPECKLE = 64
    """Removed as part of a small isolated patch."""


def mark(validity: Mask, where: NDArray[np.bool_], bit: Validity) -> None:
    """Set a bit where ``where``, in place."""
    validity |= where * np.uint8(bit)


def matched(validity: Mask) -> NDArray[np.bool_]:
    """Pixels with a measured disparity."""
    return has(validity, Validity.MATCHED)


def matched_back(validity: Mask, backmatch_error: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels whose own match was confirmed by matching back.

    ``backmatch_error`` (row, col): float32 pixels. It is NaN on planes of textureless regions, whose displacements lie
    on the matcher's epipolar lines by construction: they say nothing about cameras.
    """
    return np.asarray(matched(validity) & np.isfinite(backmatch_error))


def defined(validity: Mask) -> NDArray[np.bool_]:
    """Pixels with a disparity, interpolated ones included."""
    return has(validity, Validity.MATCHED | Validity.INTERPOLATED)


def matched_share(validity: Mask) -> float:
    """Share of the pixels with texture that are matched; 0 where nothing has texture."""
    textured = ~has(validity, Validity.OUT_OF_IMAGE | Validity.NO_TEXTURE)
    count = int(np.count_nonzero(textured))
    return int(np.count_nonzero(matched(validity) & textured)) / count if count else 0.0


def has(validity: Mask, bits: Validity) -> NDArray[np.bool_]:
    """Pixels with any of the bits."""
    return np.asarray((validity & np.uint8(bits)) != 0)
