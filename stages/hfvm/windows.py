"""Windows of images, and the tiles that a large image is cut into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Window:
    """Rows ``y0 <= y < y1`` and columns ``x0 <= x < x1`` of an image."""

    y0: int
    y1: int
    x0: int
    x1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the window in an array of the image."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def grow(self, rows: int, columns: int, shape: Shape) -> Window:
        """Wider by so much on every side, within an image of ``shape``; even borders, so that parents are whole."""
        y0, x0 = (max(a - by, 0) // 2 * 2 for a, by in ((self.y0, rows), (self.x0, columns)))
        y1, x1 = ((a + by + 1) // 2 * 2 for a, by in ((self.y1, rows), (self.x1, columns)))
        return Window(y0, min(y1, shape[0]), x0, min(x1, shape[1]))

    def parent(self) -> Window:
        """Pixels of the next coarser level that lie above these."""
        # Rounded up: an odd level's last pixel has a parent as well.
        return Window(self.y0 // 2, (self.y1 + 1) // 2, self.x0 // 2, (self.x1 + 1) // 2)

    def child(self, shape: Shape) -> Window:
        """Pixels of the next finer level, of ``shape``, that lie below these."""
        return Window(2 * self.y0, min(2 * self.y1, shape[0]), 2 * self.x0, min(2 * self.x1, shape[1]))

    def inside(self, outer: Window) -> tuple[slice, slice]:
        """Index of this window in an array that shows ``outer``."""
        return (
            slice(self.y0 - outer.y0, self.y1 - outer.y0),
            slice(self.x0 - outer.x0, self.x1 - outer.x0),
        )


def whole(shape: Shape) -> Window:
    """Window that covers an image of ``shape``."""
    return Window(0, shape[0], 0, shape[1])


def tiles(shape: Shape, side: int) -> list[Window]:
    """Square tiles in reading order, the last ones cut."""
    return [
        Window(y, min(y + side, shape[0]), x, min(x + side, shape[1]))
        for y in range(0, shape[0], side)
        for x in range(0, shape[1], side)
    ]


def thinned(marked: AnyArray, most: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns, in reading order, of ``most`` to twice as many of the pixels that are marked, if there are.

    By multiples of the golden ratio, which spread evenly: whether a pixel is taken hardly depends on the others.
    """
    places = np.flatnonzero(marked)
    step = 1 << max(0, int(np.log2(max(len(places) / most, 1.0))))
    key = (places.astype(np.uint64) * np.uint64(2654435769)) & np.uint64(0xFFFFFFFF)
    y, x = np.divmod(places[key < np.uint64((1 << 32) // step)], marked.shape[1])
    return y, x
