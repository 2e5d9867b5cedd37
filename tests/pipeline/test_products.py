"""Written files, read back by the programs they are for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from evo.tools import file_interface

from pipeline.products import (
    replacing,
    write_path_geojson,
    write_raster,
    write_trajectory_kitti,
    write_trajectory_tum,
)
from stages.errors import InputError
from stages.geometry import rotation_exp
from stages.lattice import Lattice

LATTICE = Lattice.at(-40, 700, 0.001, 600, 700)


def poses(n: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.array([np.hstack([rotation_exp(rng.normal(size=3)), rng.normal(size=(3, 1))]) for _ in range(n)])


def test_an_elevation_raster_keeps_values_place_and_crs(tmp_path: Path) -> None:
    z = np.random.default_rng(0).normal(size=LATTICE.shape).astype(np.float32)
    z[100:200, 50:90] = np.nan
    write_raster(tmp_path / "run" / "dem.tif", {"elevation": z}, LATTICE, unit="m", nodata=float("nan"))
    with rasterio.open(tmp_path / "run" / "dem.tif") as file:
        np.testing.assert_array_equal(file.read(1), z)
        np.testing.assert_array_equal(file.read_masks(1) == 0, np.isnan(z))
        # the centre of row 0, column 0, and the middle of the last cell
        assert file.xy(0, 0) == pytest.approx((-0.040, 0.700), abs=1e-9)
        assert file.index(-0.040 + 0.699, 0.700 - 0.599) == (599, 699)
        assert np.isnan(file.nodata)
        wkt = file.crs.to_wkt(version="WKT2_2019")
        assert wkt.startswith('ENGCRS["Rille world frame')
        assert "metre" in wkt
        assert file.descriptions == ("elevation",)
        assert file.units == ("metre",)
        assert "z up" in file.tags()["FRAME"]
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.overviews(1)


def test_classes_are_not_averaged_in_overviews(tmp_path: Path) -> None:
    risk = np.zeros(LATTICE.shape, dtype=np.uint8)
    risk[:, 351:] = 2  # not on the border of an overview's cells
    bands = {"class": risk, "reason": risk * 4, "filled": np.zeros_like(risk)}
    write_raster(tmp_path / "risk.tif", bands, LATTICE, unit="1", nodata=None, tags={"classes": "0 safe"})
    with rasterio.open(tmp_path / "risk.tif") as file:
        assert file.descriptions == ("class", "reason", "filled")
        np.testing.assert_array_equal(file.read(2), risk * 4)
        assert file.nodata is None
        assert file.tags()["CLASSES"] == "0 safe"
    with rasterio.open(tmp_path / "risk.tif", overview_level=0) as small:
        assert set(np.unique(small.read(1))) == {0, 2}


def test_a_raster_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not fit its lattice"):
        write_raster(tmp_path / "a.tif", {"a": np.zeros((2, 2), np.uint8)}, LATTICE, unit="1", nodata=None)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")

    def fail() -> None:
        with replacing(target) as temporary:
            temporary.write_text("half")
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        fail()
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_the_path_says_that_it_is_not_wgs84(tmp_path: Path) -> None:
    vertices = np.array([[0.1, 0.2, -0.18], [0.1, 0.3, -0.181], [0.11, 0.4, -0.18]])
    write_path_geojson(tmp_path / "path.geojson", vertices, {"found": True, "length_m": 0.2})
    data = json.loads((tmp_path / "path.geojson").read_text())
    line, start, target = data["features"]
    assert line["geometry"] == {"type": "LineString", "coordinates": vertices.tolist()}
    assert line["properties"]["length_m"] == 0.2
    assert "not WGS 84" in line["properties"]["crs_name"]
    assert start["geometry"]["coordinates"] == vertices[0].tolist()
    assert target["geometry"]["coordinates"] == vertices[-1].tolist()


def test_no_path_has_no_geometry_but_a_reason(tmp_path: Path) -> None:
    write_path_geojson(tmp_path / "p.geojson", np.empty((0, 3)), {"found": False, "blocking_row": 7})
    (feature,) = json.loads((tmp_path / "p.geojson").read_text())["features"]
    assert feature["geometry"] is None
    assert feature["properties"]["blocking_row"] == 7


def test_evo_reads_the_trajectories(tmp_path: Path) -> None:
    P = poses(7)
    write_trajectory_kitti(tmp_path / "trajectory.kitti", P)
    read = np.array(file_interface.read_kitti_poses_file(tmp_path / "trajectory.kitti").poses_se3)
    np.testing.assert_allclose(read[:, :3], P, atol=1e-14)
    P[3] = np.nan
    write_trajectory_tum(tmp_path / "trajectory.tum", P, [0.5 * k for k in range(7)])
    tum = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    kept = [0, 1, 2, 4, 5, 6]
    np.testing.assert_array_equal(tum.timestamps, [0.5 * k for k in kept])
    # seven digits of time and place would not do: quaternions are written with fifteen
    np.testing.assert_allclose(np.array(tum.poses_se3)[:, :3], P[kept], atol=1e-13)
