"""Image pyramid: each level is the mean of 2 x 2 pixels of the one below (paper, 4.3.4).

Pixel centres are at integers, so column ``x`` of level 0 lies at ``x_n = (x + 0.5) / 2**n - 0.5`` on level n. Odd sizes
are completed by repeating the last row or column. A coarse pixel is valid if at least three of its four pixels are
(:data:`MIN_VALID`); its value is the mean of the valid ones. A black frame, as left by warping, is masked
(:func:`frame`); then two of four are enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import cv2
import numpy as np
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.core.declare import AnyArray, Array, Bundle, Params, stage
from rille.stages.core.errors import InputError
from rille.stages.core.validity import Mask
from rille.stages.facts.imaging import PyramidFacts
from rille.stages.imaging import noise


class PyramidParams(Params):
    """Parameters of the image pyramid.

    Attributes
    ----------
    levels : number of images, level 0 included; three are too few beyond a megapixel.
    min_side : shortest side of a level [pixels]; features of 13 taps need context.
    """

    levels: int = Field(6, ge=1, le=10)
    min_side: int = Field(8, ge=1)


MIN_VALID = 3
"""Fewest valid pixels of four that make a coarse pixel valid. So a frame one pixel wide at least doubles its width, in
pixels of the image, from level to level."""


@dataclass(frozen=True)
class Pyramid:
    """Grey images (0..255, float32) and masks (uint8, 1 = usable), level 0 first.

    ``noise``: standard deviation of level 0, grey levels (see :mod:`rille.stages.imaging.noise`).
    """

    images: Sequence[Floats32]
    valid: Sequence[Mask]
    noise: float = 0.0

    @property
    def levels(self) -> int:
        """Number of images."""
        return len(self.images)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of level 0."""
        rows, cols = self.images[0].shape
        return rows, cols

    @staticmethod
    def from_bundle(bundle: Bundle) -> Pyramid:
        """Pyramid out of the artifact of stage ``pyramid``; a level is read at its first access."""
        levels = range(int(bundle.meta["levels"]))
        images, valid = (_Read(bundle, [f"{name}_{n}" for n in levels]) for name in ("level", "valid"))
        return Pyramid(images, valid, float(bundle.meta.get("noise", 0.0)))

    def above(self, level: int) -> Pyramid:
        """The pyramid from a level up; noise halves from level to level."""
        return Pyramid(self.images[level:], self.valid[level:], self.noise * 0.5**level)


@dataclass(frozen=True)
class _Read(Sequence[AnyArray]):
    """Arrays of an artifact, each read at its first access, since coarse matching needs no fine level."""

    bundle: Bundle
    names: Sequence[str]

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, at: int) -> AnyArray: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[AnyArray]: ...
    def __getitem__(self, at: int | slice) -> AnyArray | Sequence[AnyArray]:
        if isinstance(at, slice):
            return _Read(self.bundle, self.names[at])
        return np.ascontiguousarray(self.bundle[self.names[at]])


def grey(image: AnyArray) -> Floats32:
    """Image (row, col) as float32 grey 0..255: uint8 unchanged, uint16 over 257, floating point as 0..255.

    Raises
    ------
    InputError
        The array is not two-dimensional, is empty, or has another type.
    """
    if image.ndim != 2 or image.size == 0:
        raise InputError("RIL-411", f"image of shape {image.shape} is not (row, col)", remedy="give one grey channel")
    if np.issubdtype(image.dtype, np.uint16):  # of either byte order: archives have the big end first
        return image.astype(np.float32) * np.float32(1.0 / 257.0)
    if image.dtype == np.uint8 or image.dtype.kind == "f":
        return np.ascontiguousarray(image, dtype=np.float32)
    raise InputError(
        "RIL-412", f"image of type {image.dtype} has no known grey scale", remedy="give uint8, uint16 or float 0..255"
    )


def usable(image: Floats32, valid: AnyArray | None) -> Bools:
    """Pixels (row, col) of a grey image that are finite and, where ``valid`` is given, not zero there.

    Raises
    ------
    InputError
        ``valid`` has another shape.
    """
    mask: Bools = np.isfinite(image)
    if valid is not None:
        if valid.shape != image.shape:
            text = f"mask {valid.shape} and image {image.shape} differ"
            raise InputError("RIL-413", text, remedy="give a mask of the image's size")
        mask &= valid != 0
    return mask


def levels_of(shape: tuple[int, ...], params: PyramidParams) -> int:
    """Number of levels of the pyramid of an image of this shape."""
    levels, side = 1, min(shape)
    while levels < params.levels and side >= 2 * params.min_side:
        levels, side = levels + 1, (side + 1) // 2
    return levels


def build(image: AnyArray, params: PyramidParams, valid: AnyArray | None = None) -> Pyramid:
    """Pyramid of one grey image.

    Parameters
    ----------
    image : (row, col) uint8, uint16 or floating point (0..255; not finite = not usable).
    valid : (row, col), not zero where usable; None: everywhere but in a black frame.

    Raises
    ------
    InputError
        The image is not grey, or the mask has another shape.
    """
    level = grey(image)
    mask = usable(level, valid)
    # Masked pixels, often black too, do not count as a frame.
    black = frame(level, mask)
    if black is not None:
        mask &= ~black
    if not (image.dtype.kind == "u" and valid is None and black is None):
        level = np.where(mask, level, np.float32(0.0))
    # 2: with a black frame, because pixels half outside of a warped image mislead matches.
    least = MIN_VALID if black is None else 2
    pyramid = halved(level, mask.view(np.uint8), levels_of(level.shape, params), least)
    return Pyramid(pyramid.images, pyramid.valid, noise.standard_deviation(pyramid.images, pyramid.valid))


def frame(image: Floats32, valid: Bools) -> Bools | None:
    """Black frame (row, col) that warping left around the valid pixels of an image; None: there is none.

    It consists of connected pixels of grey 0 that cover a good part of a side and stay near it; darkness that reaches
    into the image is a shadow or the sky. Pixels beside the frame that interpolation has mixed with black belong to it,
    and then also the outermost pixels of the sides that it touches.
    """
    dark = (image == 0) & valid
    sides: tuple[Any, ...] = (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1])
    # A frame touches a tenth of a side, eight pixels at least, and reaches in by a tenth of the shorter side at most.
    least = [max(0.1 * dark[side].size, 8) for side in sides]
    if all(np.count_nonzero(dark[side]) < n for side, n in zip(sides, least, strict=True)):
        return None
    count, label = cv2.connectedComponents(dark.view(np.uint8), connectivity=4)
    deep = int(np.ceil(0.1 * min(image.shape)))
    inside = np.unique(label[deep:-deep, deep:-deep])
    framed, touched = np.zeros(image.shape, bool), np.zeros(image.shape, bool)
    for side, n in zip(sides, least, strict=True):
        long = np.bincount(label[side], minlength=count) >= n
        long[0] = long[inside] = False
        framed |= long[label]
        touched[side] |= long.any()
    if not framed.any():
        return None
    near, far = (cv2.dilate(framed.view(np.uint8), np.ones((k, k), np.uint8)).view(bool) for k in (3, 5))
    beside, farther = image[near & ~framed], image[far & ~near]
    # Pixels that are mixed with black are darker than those beyond them.
    if farther.size and np.median(beside) < 0.8 * np.median(farther):
        framed = near | touched
    return framed


def halved(image: Floats32, mask: Mask, levels: int, least: int = MIN_VALID) -> Pyramid:
    """Pyramid (``levels``) of a float32 image (0 where masked) and its mask; ``least`` of four make one valid."""
    images, masks = [image], [mask]
    for _ in range(levels - 1):
        odd = [n % 2 for n in image.shape]
        wide, known = (
            cv2.copyMakeBorder(a, 0, odd[0], 0, odd[1], cv2.BORDER_REPLICATE) if any(odd) else a
            for a in (image, masks[-1])
        )
        half = wide.shape[1] // 2, wide.shape[0] // 2
        mean = cv2.resize(wide, half, interpolation=cv2.INTER_AREA)
        # The mean of four numbers that are 0 or 4.
        count = cv2.resize(4 * known, half, interpolation=cv2.INTER_AREA)
        valid = count >= least
        image = np.where(valid, 4 * mean / np.maximum(count, 1).astype(np.float32), np.float32(0.0))
        images.append(image)
        masks.append(valid.view(np.uint8))
    return Pyramid(tuple(images), tuple(masks))


def filled_from(above: Floats32, image: Floats32, mask: Bools, y: int = 0, x: int = 0) -> Floats32:
    """Image (row, col) whose masked pixels (``mask`` false) have the grey of the level above.

    ``y, x``: row and column of the image's first pixel, where pixel (0, 0) lies under the first one of ``above``.
    """
    image = image.copy()
    for i, j in np.ndindex(2, 2):  # one of the four pixels below each pixel of the level above
        part = image[i::2, j::2]
        rows, cols = part.shape
        np.copyto(part, above[(i + y) // 2 :, (j + x) // 2 :][:rows, :cols], where=~mask[i::2, j::2])
    return image


@stage(
    "pyramid",
    outputs=[
        Array("level_*", ("row", "col"), "float32", "1", "grey value 0..255, 0 where masked"),
        Array("valid_*", ("row", "col"), "uint8", "1", "1 = usable"),
    ],
)
def pyramid_stage(params: PyramidParams, image: Bundle) -> Bundle[PyramidFacts]:
    """Grey image pyramid by means of 2 x 2 pixels."""
    pyramid = build(image["image"], params, image["valid"])
    arrays: dict[str, AnyArray] = {f"level_{n}": level for n, level in enumerate(pyramid.images)}
    arrays |= {f"valid_{n}": mask for n, mask in enumerate(pyramid.valid)}
    return Bundle(arrays, {"levels": pyramid.levels, "noise": pyramid.noise})
