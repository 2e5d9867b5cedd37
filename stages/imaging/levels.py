"""Spread the grey values of 16-bit images that use a small part of their range, equally for a whole sequence."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import warning

Levels = tuple[int | None, int]
"""Black and gain: samples become ``(sample - black) * gain``; those beyond the range are clipped. Black None: each
image's own, which makes its median the middle of the range."""

WHITE = 65535


MIN_DRIFT = 4
"""Range of all images over the largest of one, from which on it is the offset of a camera that drifts, as a thermal
camera's counts do with its temperature."""

OUTLYING = (0.5, 99.5)
"""Percentiles of an image's samples between which they count."""


def levels_of(images: Iterable[AnyArray]) -> Levels | None:
    """Levels for all images of a sequence by some of them; None if they use their range, or show nothing but noise.

    The gain is the power of two that spreads the samples of these images to about half of the range, since others may
    be brighter.
    """
    deep = _deep(images)
    if not deep:
        return None
    ends = np.array([np.percentile(image, OUTLYING) for image in deep])
    dark, bright, own = int(ends[:, 0].min()), int(ends[:, 1].max()), max(int(np.ptp(ends, axis=1).max()), 1)
    drifts = bright - dark >= MIN_DRIFT * own
    span, top = own if drifts else max(bright - dark, 1), max(int(image.max()) for image in deep)
    # 1 / 8: share of the range, from dark to bright, up to which samples are spread.
    # 1 / 4: share of the range, up to the brightest sample, up to which samples are spread, as of a camera of 14 bits.
    if span > 1 / 8 * WHITE and top > 1 / 4 * WHITE:
        return None
    gain = 1 << (WHITE // (2 * span)).bit_length() - 1
    if drifts:
        return (None, gain) if gain > 1 else None
    # Their middle becomes that of the range; black is never raised.
    return (max((dark + bright) // 2 - WHITE // (2 * gain), 0), gain) if gain > 1 else None


def levels_of_sides(left: Iterable[AnyArray], right: Iterable[AnyArray]) -> tuple[Levels | None, Levels | None]:
    """Levels of the left and of the right images: the same, unless one camera uses at least two bits more than the
    other one.

    One driver leaves 12 bits as they are, another one shifts them: with common levels one side would keep 16 grey
    values.
    """
    sides = _deep(left), _deep(right)
    tops = [max((float(np.percentile(image, OUTLYING[1])) for image in side), default=0.0) for side in sides]
    if min(tops) > 0 and max(tops) >= 4 * min(tops):
        return levels_of(sides[0]), levels_of(sides[1])
    both = levels_of([*sides[0], *sides[1]])
    return both, both


def spread(image: AnyArray, levels: Levels | None) -> AnyArray:
    """A uint16 image with its samples spread; any other image unchanged."""
    if levels is None or not np.issubdtype(image.dtype, np.uint16):
        return image
    black, gain = levels
    black = int(np.median(image)) - WHITE // (2 * gain) if black is None else black
    return np.clip((image.astype(np.int64) - black) * gain, 0, WHITE).astype(np.uint16)


def words(sides: tuple[Levels | None, Levels | None]) -> list[str]:
    """Changes of the left and of the right images, in words, one line each, or one for both."""
    named = {"all": sides[0]} if sides[0] == sides[1] else dict(zip(("left", "right"), sides, strict=True))
    spread_ones = [(name, *levels) for name, levels in named.items() if levels is not None]
    text = "16-bit samples use a small part of their range: (sample - {}) x {} is taken of {} images"
    drift = "its image's median"
    return [text.format(drift if black is None else black, gain, name) for name, black, gain in spread_ones]


def swapped(image: AnyArray) -> bool:
    """Whether a grey image (row, col) of 16 bits looks like noise, but not with the bytes of its samples exchanged."""
    if image.dtype != np.uint16 or image.shape[1] < 2 or not image.std():
        return False
    rough = [float(np.abs(np.diff(a, axis=1)).mean() / a.std()) for a in map(np.float64, (image, image.byteswap()))]
    # Mean difference of neighbouring samples over their standard deviation: noise has 1.1, images have 0.1 to 0.3.
    return rough[0] > 0.5 > 2 * rough[1]


def _deep(images: Iterable[AnyArray]) -> list[AnyArray]:
    return [image for image in images if np.issubdtype(image.dtype, np.uint16) and _shows(image)]


def _shows(image: AnyArray) -> bool:
    # A few dead pixels of a thermal camera deviate more than the whole scene.
    image = np.clip(image, *np.percentile(image, OUTLYING)).astype(np.float32)
    # Means of 4 x 4 pixels reduce the standard deviation of noise to a quarter.
    return bool(cv2.blur(image, (4, 4)).std() > 0.5 * image.std())


def levelled(images: Sequence[AnyArray]) -> tuple[list[AnyArray], list[str]]:
    """Left and right image, with 16-bit samples spread if they use a small part of their range; and warnings."""
    used = levels_of_sides(images[:1], images[1:])
    lines = [warning("RIL-705", line) for line in words(used)]
    return [spread(i, of) for i, of in zip(images, used, strict=True)], lines
