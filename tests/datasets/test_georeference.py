"""Where a sequence lies: axes, and what a manifest may not say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from raising import raises

from rille.datasets.georeference import georeference
from rille.datasets.manifest.model import World

ORIGIN = (500100.0, 5200200.0, 1800.0)


def test_axes_by_hand() -> None:
    east = georeference("EPSG:32633", ORIGIN, 90.0, "m.toml")  # the camera looks east: y is east, x (right) is south
    assert east is not None
    np.testing.assert_allclose(east.apply([[0, 10, -2], [3, 0, 0]]), [[500110, 5200200, 1798], [500100, 5200197, 1800]])
    north = georeference("EPSG:32633", ORIGIN, 0.0, "m.toml")
    assert north is not None
    np.testing.assert_allclose(north.apply([3.0, 10.0, 0.0]), [500103, 5200210, 1800])
    assert np.linalg.det(east.rotation) == pytest.approx(1.0)
    assert east.to_dict() == {"crs": "EPSG:32633", "origin": list(ORIGIN), "azimuth": math.pi / 2}
    assert georeference(None, None, None, "m.toml") is None


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (("EPSG:32633", None, None), ("RIL-180", "world.azimuth_deg")),
        ((None, ORIGIN, 3.0), ("RIL-180",)),
        (("EPSG:999999", ORIGIN, 0.0), ("RIL-181",)),
        (("EPSG:4326", ORIGIN, 0.0), ("RIL-182",)),
        (("EPSG:2263", ORIGIN, 0.0), ("RIL-183", "0.3048")),
    ],
)
def test_what_is_refused(given: tuple, expected: tuple[str, ...]) -> None:
    with raises(*expected) as error:
        georeference(*given, "m.toml")
    assert "EPSG:32633" in error.value.remedy


def test_a_manifest_states_it_in_degrees() -> None:
    world = World(crs="EPSG:32633", origin=ORIGIN, azimuth_deg=-45)
    place = georeference(world.crs, world.origin, world.azimuth_deg, "m.toml")
    assert place is not None
    assert place.azimuth == pytest.approx(-math.pi / 4)
