"""Windows of images, and rasters that are read by window: arrays, or tiles that lie elsewhere.

Whatever is computed from a window that reaches far enough is, bit for bit, what is computed from the whole image: no
step knows where its window begins but by absolute rows and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray

BLOCK = 1024
"""Pixels: side of the pieces in which scattered pixels of a raster are read."""

Shape = tuple[int, ...]


class Raster(Protocol):
    """Array that is read by window, ``raster[rows, columns]``: in memory or on disk."""

    @property
    def shape(self) -> Shape:
        """Rows and columns."""

    def __getitem__(self, at: tuple[slice, slice]) -> Any:
        """Values (row, col) of two slices."""


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
        """Wider by so much on every side, within an image of ``shape``."""
        return Window(
            max(self.y0 - rows, 0),
            min(self.y1 + rows, shape[0]),
            max(self.x0 - columns, 0),
            min(self.x1 + columns, shape[1]),
        )

    def align(self, n: int, shape: Shape) -> Window:
        """Widened to multiples of ``n``, within an image of ``shape``."""
        return Window(
            self.y0 // n * n, min(-(-self.y1 // n) * n, shape[0]), self.x0 // n * n, min(-(-self.x1 // n) * n, shape[1])
        )

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


def tiles(shape: Shape, side: int | None) -> list[Window]:
    """Square tiles in reading order, the last ones cut; None: the image is one."""
    if side is None or max(shape) <= side:
        return [whole(shape)]
    return [
        Window(y, min(y + side, shape[0]), x, min(x + side, shape[1]))
        for y in range(0, shape[0], side)
        for x in range(0, shape[1], side)
    ]


def strips(raster: Raster) -> list[Window]:
    """Full rows in pieces that are read one after the other; an array is one piece."""
    rows, cols = raster.shape
    step = rows if isinstance(raster, np.ndarray) else BLOCK
    # A raster without rows has no strips, but a step of 0 is refused.
    return [Window(y, min(y + step, rows), 0, cols) for y in range(0, rows, max(step, 1))]


def cut(raster: Raster, window: Window) -> AnyArray:
    """Values of a window, contiguous; not to be written to."""
    return np.ascontiguousarray(raster[window.slices])


def around(y: AnyArray, x: AnyArray, shape: Shape, margin: int = 0, wanted: NDArray[np.bool_] | None = None) -> Window:
    """Window of an image of ``shape`` with all the given places that lie in it, and ``margin`` pixels around them.

    ``y, x``: rows and columns. At least one pixel, wherever the places are.
    """
    if wanted is not None:
        y, x = y[wanted], x[wanted]
    if y.size == 0:
        # A pixel rather than nothing, which no mosaic can be asked for.
        return Window(0, min(1, shape[0]), 0, min(1, shape[1]))
    return bounded(int(y.min()), int(y.max()), int(x.min()), int(x.max()), shape, margin)


def bounded(top: int, bottom: int, first: int, last: int, shape: Shape, margin: int = 0) -> Window:
    """Window of these rows and columns, ends included, grown by ``margin`` and cut to an image; at least one pixel."""
    y0, x0 = (max(0, min(low - margin, n - 1)) for low, n in ((top, shape[0]), (first, shape[1])))
    y1, x1 = min(max(bottom + margin + 1, y0 + 1), shape[0]), min(max(last + margin + 1, x0 + 1), shape[1])
    return Window(y0, y1, x0, x1)


def blocks(raster: Raster, y: AnyArray, x: AnyArray, wanted: NDArray[np.bool_]) -> Iterator[Window]:
    """Pieces of a raster that hold the wanted places (row ``y``, column ``x``, inside); an array is one piece."""
    if isinstance(raster, np.ndarray):
        yield whole(raster.shape)
        return
    rows, cols = raster.shape
    across = -(-cols // BLOCK)
    hit = np.unique((y[wanted] // BLOCK) * across + x[wanted] // BLOCK)
    for block in hit:
        j, i = divmod(int(block), across)
        yield Window(j * BLOCK, min((j + 1) * BLOCK, rows), i * BLOCK, min((i + 1) * BLOCK, cols))


def pick(raster: Raster, y: AnyArray, x: AnyArray) -> AnyArray:
    """Values at rows ``y`` and columns ``x`` (n,), inside."""
    if isinstance(raster, np.ndarray):
        return np.asarray(raster[y, x])
    found: AnyArray | None = None
    for block in blocks(raster, y, x, np.ones(len(y), bool)):
        here = (y >= block.y0) & (y < block.y1) & (x >= block.x0) & (x < block.x1)
        values = cut(raster, block)[y[here] - block.y0, x[here] - block.x0]
        if found is None:
            found = np.empty(len(y), values.dtype)
        found[here] = values
    return np.zeros(0, np.float32) if found is None else found


def thinned(marked: Raster, most: int, chosen: Callable[[AnyArray], AnyArray], up: bool = False) -> NDArray[np.int64]:
    """Flat indices, in reading order, of evenly strided pixels where ``chosen`` of the values is true; about ``most``.

    ``up``: at most so many, else at least. The pixels do not depend on how the raster is cut up.
    """
    cols = marked.shape[1]
    count = sum(int(np.count_nonzero(chosen(cut(marked, w)))) for w in strips(marked))
    step = 1 + count // most if up else max(1, count // most)
    found, passed = [np.zeros(0, np.int64)], 0
    for w in strips(marked):
        here = np.flatnonzero(chosen(cut(marked, w))) + w.y0 * cols
        # The stride goes on from the strip above, so that cuts do not show in the choice.
        found.append(here[-passed % step :: step])
        passed += len(here)
    return np.concatenate(found)


@dataclass(frozen=True)
class Mosaic:
    """A raster of tiles, each a raster itself that is read where it is needed."""

    shape: Shape
    windows: Sequence[Window]
    parts: Sequence[Raster]

    def __getitem__(self, at: tuple[slice, slice]) -> AnyArray:
        """Values of two slices without steps."""
        rows, cols = at
        want = Window(rows.start or 0, rows.stop, cols.start or 0, cols.stop)
        found: AnyArray | None = None
        for window, part in zip(self.windows, self.parts, strict=True):
            both = Window(
                max(want.y0, window.y0), min(want.y1, window.y1), max(want.x0, window.x0), min(want.x1, window.x1)
            )
            if both.y0 < both.y1 and both.x0 < both.x1:
                values = np.asarray(part[both.inside(window)])
                if found is None:
                    found = np.empty(want.shape, values.dtype)
                found[both.inside(want)] = values
        assert found is not None
        return found


Results = dict[str, AnyArray]


def gather(shape: Shape, found: Iterable[tuple[Window, Results]]) -> Results:
    """Arrays of a whole image from those of its tiles, given in any order."""
    total: Results = {}
    for window, arrays in found:
        for name, values in arrays.items():
            # A single tile is the image: it is not copied.
            if window == whole(shape):
                total[name] = values
                continue
            if name not in total:
                total[name] = np.empty(shape, values.dtype)
            total[name][window.slices] = values
    return total
