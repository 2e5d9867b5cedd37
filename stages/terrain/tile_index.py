"""Which tiles of the world an elevation model touches: known only once its pose is, and small enough to plan by.

The world is cut once for all models, at multiples of a number of cells of the infinite lattice: tile (tx, ty) holds the
columns ``tx * side .. (tx + 1) * side`` and the lines ``-y / cell`` of ``ty * side .. (ty + 1) * side``. A tile is the
same one whatever models there are, and depends on those alone that have a defined cell in it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.terrain import DemFacts, TileIndexFacts
from rille.stages.geometry.lattice import Lattice

Tile = tuple[int, int]
Box = tuple[int, int, int, int]
"""First column, first line, columns and lines, cells of the infinite lattice (lines count downwards)."""


def footprint(defined: Bools, lattice: Lattice, side: int, margin: int = 0) -> dict[Tile, Box]:
    """Tiles that have a defined cell, and the box of the defined cells in each.

    Parameters
    ----------
    defined : (rows, cols) on ``lattice``.
    side : cells; side of a tile.
    margin : cells around a tile that count as its own: what its result may depend on. The box is cut to the tile.
    """
    boxes = {}
    # Lines count downwards, against y, as rows do.
    first_col, first_line = lattice.i0, -lattice.j0
    for ty in range((first_line - margin) // side, (first_line + lattice.rows - 1 + margin) // side + 1):
        rows = _span(ty, side, margin, first_line, lattice.rows)
        for tx in range((first_col - margin) // side, (first_col + lattice.cols - 1 + margin) // side + 1):
            cols = _span(tx, side, margin, first_col, lattice.cols)
            inside = defined[rows, cols]
            if inside.any():
                lines, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
                top, height = _extent(lines + first_line + rows.start, ty * side, side)
                left, width = _extent(columns + first_col + cols.start, tx * side, side)
                boxes[tx, ty] = (left, top, width, height)
    return boxes


def _span(tile: int, side: int, margin: int, first: int, count: int) -> slice:
    start = max(tile * side - margin - first, 0)
    return slice(start, max(min((tile + 1) * side + margin - first, count), start))


def _extent(where: NDArray[np.intp], tile: int, side: int) -> tuple[int, int]:
    """Start and length of what is there, cut to the tile; of what is there in the margin alone, a bare edge cell."""
    low = min(max(int(where[0]), tile), tile + side - 1)
    high = max(min(int(where[-1]), tile + side - 1), low)
    return low, high - low + 1


def tile_lattice(boxes: Iterable[Box], cell: float) -> Lattice:
    """Return the smallest lattice that holds the boxes: the part of a tile that has to be computed."""
    every = list(boxes)
    left, top = min(b[0] for b in every), min(b[1] for b in every)
    right, foot = max(b[0] + b[2] for b in every), max(b[1] + b[3] for b in every)
    return Lattice.at(left, -top, cell, foot - top, right - left)


@stage("tile_index")
def tile_index_stage(params: NoParams, dem: Bundle[DemFacts], *, side: int, margin: int) -> Bundle[TileIndexFacts]:
    """Tiles of the world that an elevation model touches."""
    lattice = Lattice.from_dict(dem.meta["lattice"])
    defined = np.isfinite(dem["elevation"])
    tiles = footprint(defined, lattice, side, margin)
    rows, cols = (np.flatnonzero(defined.any(axis=axis)) for axis in (1, 0))
    box = None
    if rows.size:
        shape = int(rows[-1] - rows[0]) + 1, int(cols[-1] - cols[0]) + 1
        box = Lattice.at(lattice.i0 + int(cols[0]), lattice.j0 - int(rows[0]), lattice.cell, *shape).to_dict()
    listed = [[*tile, *tiles[tile]] for tile in sorted(tiles)]
    return Bundle({}, {"pair": dem.meta["pair"], "cell": lattice.cell, "box": box, "tiles": listed})
