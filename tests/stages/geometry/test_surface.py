from __future__ import annotations

import numpy as np

from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.surface import plane


def test_plane_is_the_lattice() -> None:
    lattice = Lattice.at(-2, 5, 0.1, 4, 6)
    feet, normals = plane(lattice).block(np.array([1, 3]), np.array([0, 2, 5]))
    np.testing.assert_array_equal(feet[..., :2], lattice.xy()[[1, 3]][:, [0, 2, 5]])
    assert (feet[..., 2] == 0).all()
    assert (normals == [0, 0, 1]).all()
    assert feet.flags.c_contiguous
    assert normals.flags.c_contiguous
