"""What images of a camera that moves have in common: noise of its sensor, reflections before it, and mixed frames."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np

from rille.stages.core.declare import AnyArray

BLOCK = 16
"""Side of a block, in pixels of an image or a reduced one, in which detail is compared."""


def fixed_pattern(images: list[AnyArray]) -> float:
    """Share of the finest detail that stays in place in some images (row, col) of a camera, in the median block.

    0 if coarser detail does too, as with a camera at rest.
    The mean of n images keeps one n-th of the variance of a moving scene, and all of a fixed pattern's.
    """

    def kept(factor: int) -> float:
        """The share in images reduced by a factor."""
        details = _details(images, factor)
        mean, all_ = _blocks(details.mean(axis=0) ** 2), _blocks((details**2).mean(axis=0))
        return float(np.median((len(details) * mean / np.maximum(all_, 1e-6) - 1) / (len(details) - 1)))

    fine = kept(1) if _comparable(images) else 0.0
    return fine if fine and kept(2) < 0.75 * fine else 0.0


def overlaid(images: list[AnyArray]) -> float:
    """Share of the detail, fine and coarse, that any two of some images have in common in place, in the median block,
    as with a reflection on a window; 0 if they have nothing in common, or all of it, as with a camera at rest."""

    def common(factor: int) -> float:
        """The share in images reduced by a factor."""
        details = _details(images, factor)
        powers = [np.maximum(_blocks(one * one), 1e-6) for one in details]
        pairs = combinations(range(len(details)), 2)
        alike = [_blocks(details[i] * details[j]) / np.sqrt(powers[i] * powers[j]) for i, j in pairs]
        return float(np.median(np.min(alike, axis=0)))

    fine, coarse = map(common, (1, 2)) if _comparable(images) else (0.0, 0.0)
    # Of a pattern that repeats 0.1 of the fine detail agrees by chance; of a camera at rest noise hides the fine one.
    return fine if min(fine, coarse) > 0.25 and max(fine, coarse) < 0.75 and coarse < 1.2 * fine else 0.0


def mixed(images: list[AnyArray]) -> list[int]:
    """Indices of successive images (row, col) that are sums of the image before and the one after, as a conversion of
    the frame rate makes them.

    Only blocks count whose detail moves by more than its size from the image before to the one after, so that none of
    the two would tell of a true image between them.
    """
    if not _comparable(images):
        return []
    size = tuple(side // max(1, round(images[0].shape[1] / 400)) for side in reversed(images[0].shape))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    if not _comparable(small):
        return []
    fine = _details(small, 1)
    coarse = np.stack([cv2.blur(image, (3, 3)) for image in _details(small, 1, 11)])
    powers, found = [_blocks(one * one) for one in fine], []
    for k in range(1, len(fine) - 1):
        moves = np.minimum(powers[k - 1], powers[k + 1]) > 0.25 * np.median(powers[k - 1])
        for one in (fine, coarse):
            before, after = one[k - 1], one[k + 1]
            alike = np.abs(_blocks(before * after)) / np.sqrt(_blocks(before**2) * _blocks(after**2) + 1e-6)
            moves &= alike < 0.15
        inside = np.repeat(np.repeat(moves, BLOCK, 0), BLOCK, 1)
        before, here, after = (one[: len(inside), : inside.shape[1]][inside] for one in fine[k - 1 : k + 2])
        parts, left, *_ = np.linalg.lstsq(np.stack([before, after], axis=1), here, rcond=None)
        # Of true images less of the detail is explained, mostly none of it, or by parts of more in sum, or by one.
        if moves.mean() > 0.05 and parts.min() > 0.3 and parts.sum() < 1.2 and left.sum() < 0.25 * (here**2).sum():
            found.append(k)
    return found


def _comparable(images: list[AnyArray]) -> bool:
    """Whether these are three images or more, of one size, and large enough for some blocks."""
    return len(images) > 2 and len({image.shape for image in images}) == 1 and min(images[0].shape) >= 4 * BLOCK


def _details(images: list[AnyArray], factor: int, side: int = 5) -> AnyArray:
    """Detail of images (n, row, col), reduced by a factor: departures from means over ``side`` pixels.

    Coarser detail is measured without single pixels, since hot ones would outweigh a dark scene in the means of their
    surroundings.
    """
    size = images[0].shape[1] // factor, images[0].shape[0] // factor
    taken = [image.astype(np.float32) for image in images]
    taken = taken if factor == 1 else [cv2.medianBlur(image, 3) for image in taken]
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in taken]
    return np.stack([np.asarray(image - cv2.blur(image, (side, side))) for image in small])


def _blocks(square: AnyArray) -> AnyArray:
    """Means over blocks of an array (row, col)."""
    rows, cols = square.shape
    return np.asarray(cv2.resize(square, (cols // BLOCK, rows // BLOCK), interpolation=cv2.INTER_AREA))
