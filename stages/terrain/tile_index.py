"""World tiles that an elevation model touches: known once its pose is, and small enough to lay out tasks by.

The world is cut once for all models, at multiples of a number of cells of the infinite lattice: tile (tx, ty) holds the
columns ``tx * side .. (tx + 1) * side`` and the lines ``-y / cell`` of ``ty * side .. (ty + 1) * side``. A tile is the
same one whatever models there are, and depends on those alone that have a defined cell in it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rille.stages.core.arrays import Bools
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.terrain import DemFacts, TileIndexFacts
from rille.stages.geometry.lattice import Lattice

Tile = tuple[int, int]
Box = tuple[int, int, int, int]
"""First column, first line, columns and lines, cells of the infinite lattice (lines count downwards)."""


def footprint(defined: Bools, lattice: Lattice, side: int) -> dict[Tile, Box]:
    """Tiles of ``side`` cells that have a defined cell (rows, cols) of a lattice, and the box of those in each."""
    boxes = {}
    for tile in lattice.tiles(side):
        inside = defined[lattice.window(tile)]
        lines, columns = (np.flatnonzero(inside.any(axis=axis)).tolist() for axis in (1, 0))
        if lines:
            # Lines count downwards, against y, as rows do.
            first_col, first_line = tile.i0, -tile.j0
            size = columns[-1] - columns[0] + 1, lines[-1] - lines[0] + 1
            boxes[first_col // side, first_line // side] = (first_col + columns[0], first_line + lines[0], *size)
    return boxes


def tile_lattice(boxes: Iterable[Box], cell: float) -> Lattice:
    """Return the smallest lattice that holds the boxes: the part of a tile that has to be computed."""
    every = list(boxes)
    left, top = min(b[0] for b in every), min(b[1] for b in every)
    right, foot = max(b[0] + b[2] for b in every), max(b[1] + b[3] for b in every)
    return Lattice.at(left, -top, cell, foot - top, right - left)


@stage("tile_index")
def tile_index_stage(params: NoParams, dem: Bundle[DemFacts], *, side: int) -> Bundle[TileIndexFacts]:
    """Tiles of the world that an elevation model touches."""
    lattice = Lattice.from_dict(dem.meta["lattice"])
    tiles = footprint(np.isfinite(dem["elevation"]), lattice, side)
    box = tile_lattice(tiles.values(), lattice.cell).to_dict() if tiles else None
    listed = [[*tile, *tiles[tile]] for tile in sorted(tiles)]
    return Bundle({}, {"pair": dem.meta["pair"], "cell": lattice.cell, "box": box, "tiles": listed})
