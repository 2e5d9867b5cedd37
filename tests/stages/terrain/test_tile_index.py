"""Which tiles a model touches: by its cells, not by its outline."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain import tile_index as stage
from rille.stages.terrain.tile_index import footprint, tile_lattice


def test_by_hand() -> None:
    """A model of 4 x 6 cells over the corner of four tiles, of which its cells touch two."""
    lattice = Lattice.at(-3, 2, 0.5, 4, 6)  # columns -3..2, lines -2..1
    defined = np.zeros(lattice.shape, dtype=bool)
    defined[0, 1] = defined[1, 2] = True  # columns -2, -1, lines -2, -1
    defined[3, 5] = True  # column 2, line 1
    assert footprint(defined, lattice, 10) == {(-1, -1): (-2, -2, 2, 2), (0, 0): (2, 1, 1, 1)}
    assert footprint(np.zeros(lattice.shape, dtype=bool), lattice, 10) == {}


@settings(max_examples=40, deadline=None)
@given(st.integers(-40, 40), st.integers(-40, 40), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_every_cell_lies_in_the_box_of_its_tile_and_nothing_else_is_there(i0: int, j0: int, n: int, seed: int) -> None:
    lattice = Lattice.at(i0, j0, 0.25, n, n + 3)
    defined = np.random.default_rng(seed).random(lattice.shape) < 0.05
    tiles = footprint(defined, lattice, 7)
    boxes = [tile_lattice([box], 0.25) for box in tiles.values()]
    left = defined.copy()
    for (tx, ty), box in zip(tiles, boxes, strict=True):
        assert (box.i0 // 7, -box.j0 // 7) == (tx, ty)
        assert ((box.i0 + box.cols - 1) // 7, (-box.j0 + box.rows - 1) // 7) == (tx, ty)
        window = lattice.window(box)
        assert defined[window].any(axis=0)[[0, -1]].all()
        assert defined[window].any(axis=1)[[0, -1]].all()
        left[window] = False
    assert not left.any()


def test_the_stage_gives_tiles_and_the_box_of_all_cells() -> None:
    lattice = Lattice.at(0, 0, 0.1, 6, 8)
    z = np.full(lattice.shape, np.nan, np.float32)
    z[2, 3] = z[4, 4] = 1.0
    dem = Bundle({"elevation": z}, {"pair": 7, "lattice": lattice.to_dict()})
    meta = stage.tile_index_stage.run(NoParams(), {"side": 4}, {"dem": dem}).meta
    assert meta["pair"] == 7
    assert meta["tiles"] == [[0, 0, 3, 2, 1, 1], [1, 1, 4, 4, 1, 1]]
    box = Lattice.from_dict(meta["box"])
    assert (box.i0, box.j0, box.rows, box.cols) == (3, -2, 3, 2)
    empty = stage.tile_index_stage.run(NoParams(), {"side": 4}, {"dem": Bundle({"elevation": z * np.nan}, dem.meta)})
    assert (empty.meta["tiles"], empty.meta["box"]) == ([], None)
    assert tile_lattice([(0, 0, 2, 1), (-1, 3, 1, 1)], 0.1).bounds == pytest.approx((-0.15, 0.15, -0.35, 0.05))
