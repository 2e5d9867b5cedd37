from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.surface import cylinder, plane, sphere


def test_plane_is_the_lattice() -> None:
    lattice = Lattice.at(-2, 5, 0.1, 4, 6)
    feet, normals = plane(lattice).block([1, 3], [0, 2, 5])
    np.testing.assert_array_equal(feet[..., :2], lattice.xy()[[1, 3]][:, [0, 2, 5]])
    assert (feet[..., 2] == 0).all()
    assert (normals == [0, 0, 1]).all()
    assert feet.flags.c_contiguous
    assert normals.flags.c_contiguous


@pytest.mark.parametrize("inside", [True, False])
def test_feet_lie_on_the_surface_and_normals_are_radial(inside: bool) -> None:
    centre, radius = np.array([1.0, -2.0, 0.5]), 3.0
    a, b = np.linspace(-1, 1, 5), np.linspace(-0.4, 0.4, 3)
    sign = -1.0 if inside else 1.0
    feet, normals = sphere(centre, radius, a, b, inside=inside).block(np.arange(3), np.arange(5))
    np.testing.assert_allclose(feet - centre, sign * radius * normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    feet, normals = cylinder(centre, radius, a, b, inside=inside).block(np.arange(3), np.arange(5))
    np.testing.assert_allclose((feet - centre)[..., :2], sign * radius * normals[..., :2], atol=1e-12)
    np.testing.assert_allclose((feet - centre)[..., 2], np.repeat(b[:, None], 5, 1))
    np.testing.assert_allclose(feet[0, 2, :2], [4.0, -2.0])  # azimuth 0 is x


def test_radius_must_be_positive() -> None:
    with raises("RIL-444"):
        sphere([0, 0, 0], 0.0, [0.0], [0.0], inside=False)
