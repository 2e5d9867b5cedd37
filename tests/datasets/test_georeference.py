"""Where a sequence lies: axes, and what a manifest may not say."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from raising import raises

from rille.datasets.georeference import Georeference
from rille.datasets.manifest.model import World
from rille.datasets.text.validation import validated

GEODETIC = (
    'GEODCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]],CS[ellipsoidal,2],'
    'AXIS["latitude",north],AXIS["longitude",east],ANGLEUNIT["degree",0.0174532925199433]]'
)
ORIGIN = (500100.0, 5200200.0, 1800.0)


def test_axes_by_hand() -> None:
    east = World(crs="EPSG:32633", origin=ORIGIN, azimuth_deg=90.0).place  # the camera looks east: x (right) is south
    assert east is not None
    np.testing.assert_allclose(east.apply([[0, 10, -2], [3, 0, 0]]), [[500110, 5200200, 1798], [500100, 5200197, 1800]])
    north = World(crs="EPSG:32633", origin=ORIGIN, azimuth_deg=0.0).place
    assert north is not None
    np.testing.assert_allclose(north.apply([3.0, 10.0, 0.0]), [500103, 5200210, 1800])
    assert np.linalg.det(east.rotation) == pytest.approx(1.0)
    assert east.to_dict() == {"crs": "EPSG:32633", "origin": list(ORIGIN), "azimuth": math.pi / 2}
    assert World().place is None


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        ({"crs": "EPSG:32633", "origin": ORIGIN}, ("azimuth_deg missing",)),
        ({"origin": ORIGIN, "azimuth_deg": 3.0}, ("crs missing",)),
        ({"crs": "EPSG:999999"}, ("crs", "no known")),
        ({"crs": "EPSG:32633", "origin": (47.07, 15.44, 350.0), "azimuth_deg": 3.0}, ("47.07", "degrees", "easting")),
        ({"crs": "EPSG:32633", "origin": ORIGIN[1::-1] + ORIGIN[2:], "azimuth_deg": 3.0}, ("exchanged", "EPSG:32633")),
        ({"crs": "EPSG:32633", "origin": (5e7, 5.2e6, 0), "azimuth_deg": 3.0}, ("does not exist", "EPSG:32633")),
        ({"crs": "EPSG:3857", "origin": (1814000, 6140000, 0), "azimuth_deg": 3.0}, ("0.67 m", "UTM")),
        ({"crs": "EPSG:4326"}, ("crs", "projected")),
        ({"crs": "WGS84"}, ("crs", "projected")),
        ({"crs": GEODETIC}, ("crs", "projected")),
        ({"crs": "EPSG:2263"}, ("crs", "0.3048")),
        ({"crs": "http://127.0.0.1:1/crs"}, ("crs", "address")),
        ({"crs": "/vsistdin/"}, ("crs", "file")),
    ],
)
def test_what_is_refused(given: dict[str, object], facts: tuple[str, ...]) -> None:
    with raises("RIL-223", "m.toml", *facts):
        validated("RIL-223", World, given, file="m.toml")


def test_a_crs_of_ones_own_may_begin_at_the_site() -> None:
    own = "+proj=tmerc +lat_0=47.07 +lon_0=15.44 +ellps=WGS84 +units=m"
    assert World(crs=own, origin=(12.5, 7.25, 350.0), azimuth_deg=0.0).place is not None


@pytest.mark.parametrize(
    ("crs", "east", "north"),
    [("EPSG:3413", 0, -3300000), ("EPSG:5070", 0, 2000000), ("EPSG:31256", 10000, 340000), ("IAU_2015:49910", 0, 0)],
)
def test_grids_of_other_places_and_bodies_are_taken(crs: str, east: float, north: float) -> None:
    """North polar stereographic at 60 degrees, of the United States, of Austria, of Mars."""
    assert World(crs=crs, origin=(east, north, 0.0), azimuth_deg=0.0).place is not None


def test_a_crs_is_known_whatever_files_lie_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "EPSG:32633").write_text("another")
    monkeypatch.chdir(tmp_path)
    assert World(crs="EPSG:32633", origin=ORIGIN, azimuth_deg=0.0).place is not None


def test_no_file_is_opened_for_a_crs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "EPSG")
    monkeypatch.chdir(tmp_path)
    with raises("RIL-223", "file"):
        validated("RIL-223", World, {"crs": "EPSG"}, file="m.toml")
    with pytest.raises(ValueError, match="file"):  # as a run's folder of somebody else's may state it
        Georeference.from_dict({"crs": str(tmp_path / "EPSG"), "origin": ORIGIN, "azimuth": 0.0})
