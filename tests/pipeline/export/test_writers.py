"""Written files, read back by the programs they are for."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
from evo.tools import file_interface
from toys.finished import FRAMES, sequence, view

from rille.datasets.georeference import Georeference
from rille.pipeline.export.catalogue import describe
from rille.pipeline.export.paths import write_path
from rille.pipeline.export.writers import (
    Meaning,
    write_image,
    write_raster,
    write_trajectory_kitti,
    write_trajectory_tum,
)
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import rotation_exp
from rille.stages.geometry.lattice import Lattice

LATTICE = Lattice.at(-40, 700, 0.001, 600, 700)


def poses(n: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.array([np.hstack([rotation_exp(rng.normal(size=3)), rng.normal(size=(3, 1))]) for _ in range(n)])


def test_an_elevation_raster_keeps_values_place_and_crs(tmp_path: Path) -> None:
    z = np.random.default_rng(0).normal(size=LATTICE.shape).astype(np.float32)
    z[100:200, 50:90] = np.nan
    write_raster(tmp_path / "run" / "dem.tif", {"elevation": z}, LATTICE, Meaning("m"))
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


def test_a_tag_may_name_a_file_that_is_no_utf8(tmp_path: Path) -> None:
    write_image(tmp_path / "d.tif", {"a": np.zeros((2, 3))}, Meaning("pixel", tags={"LEFT": "caf\udce9.png"}))
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.tags()["LEFT"] == "caf\\udce9.png"


def test_the_engineering_crs_is_in_metres_and_says_how_axes_lie(tmp_path: Path) -> None:
    write_raster(tmp_path / "a.tif", {"a": np.zeros(LATTICE.shape, np.uint8)}, LATTICE, Meaning("1", nodata=None))
    with rasterio.open(tmp_path / "a.tif") as file:
        crs = pyproj.CRS.from_wkt(file.crs.to_wkt(version="WKT2_2019"))
        assert "x and y are the world frame's" in file.tags()["AXES"]
    assert crs.is_engineering
    # GeoTIFF has no key for the names of axes: GDAL reads every local system back as easting and northing
    assert [(a.direction, a.unit_name) for a in crs.axis_info] == [("east", "metre"), ("north", "metre")]
    write_path(tmp_path / "path.gpkg", Bundle({"path": VERTICES}, {"found": True}))
    # Nor may the path's file have better ones: programs would take path and rasters for two systems.
    again = pyproj.CRS.from_wkt(pyogrio.raw.read(tmp_path / "path.gpkg", layer="path")[0]["crs"])
    assert again.to_wkt("WKT1_GDAL") == crs.to_wkt("WKT1_GDAL")


def test_a_raster_with_a_place_is_turned_and_not_resampled(tmp_path: Path) -> None:
    place = Georeference("EPSG:32633", (500100.0, 5200200.0, 1800.0), 0.7)
    z = np.random.default_rng(0).normal(size=LATTICE.shape).astype(np.float32)
    write_raster(tmp_path / "dem.tif", {"elevation": z}, LATTICE, Meaning("m"), place)
    with rasterio.open(tmp_path / "dem.tif") as file:
        assert file.crs.to_epsg() == 32633
        np.testing.assert_array_equal(file.read(1), z)
        at = LATTICE.xs()[123], LATTICE.ys()[45], 0.0
        assert file.xy(45, 123) == pytest.approx(tuple(place.apply(at)[:2]), abs=1e-6)
        assert "clockwise from grid north" in file.tags()["AXES"]
    write_path(tmp_path / "path.gpkg", Bundle({"path": VERTICES}, {"found": True}), place)
    meta, _, geometry, _ = pyogrio.raw.read(tmp_path / "path.gpkg", layer="path")
    assert meta["crs"] == "EPSG:32633"
    np.testing.assert_allclose(np.frombuffer(geometry[0][9:], "<f8").reshape(-1, 3), place.apply(VERTICES), atol=1e-9)


def test_classes_are_not_averaged_in_overviews(tmp_path: Path) -> None:
    risk = np.zeros(LATTICE.shape, dtype=np.uint8)
    risk[:, 351:] = 2  # not on the border of an overview's cells
    bands = {"class": risk, "reason": risk * 4, "filled": np.zeros_like(risk)}
    write_raster(tmp_path / "risk.tif", bands, LATTICE, Meaning("1", nodata=None, tags={"classes": "0 safe"}))
    with rasterio.open(tmp_path / "risk.tif") as file:
        assert file.descriptions == ("class", "reason", "filled")
        np.testing.assert_array_equal(file.read(2), risk * 4)
        assert file.nodata is None
        assert file.tags()["CLASSES"] == "0 safe"
    with rasterio.open(tmp_path / "risk.tif", overview_level=0) as small:
        assert set(np.unique(small.read(1))) == {0, 2}


def test_classes_have_colours(tmp_path: Path) -> None:
    risk = np.zeros(LATTICE.shape, dtype=np.uint8)
    write_raster(tmp_path / "a.tif", {"class": risk}, LATTICE, Meaning(nodata=None, colours=["#a6d7c3", "#0001ff"]))
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.colorinterp == (rasterio.enums.ColorInterp.palette,)
        assert [file.colormap(1)[k] for k in (0, 1)] == [(0xA6, 0xD7, 0xC3, 255), (0, 1, 255, 255)]


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


VERTICES = np.array([[0.1, 0.2, -0.18], [0.1, 0.3, -0.181], [0.11, 0.4, -0.18]])


def test_gdal_reads_the_path_in_its_own_coordinate_system(tmp_path: Path) -> None:
    facts = {"found": True, "length_m": 0.2, "reason": None, "grid": {"cell": 1}}
    write_path(tmp_path / "path.gpkg", Bundle({"path": VERTICES}, facts))
    meta, _, geometry, values = pyogrio.raw.read(tmp_path / "path.gpkg", layer="path")
    assert meta["geometry_type"] == "LineString Z"
    assert "local metres" in meta["crs"]
    assert "WGS" not in meta["crs"]
    np.testing.assert_array_equal(np.frombuffer(geometry[0][9:], "<f8").reshape(-1, 3), VERTICES)
    fields = dict(zip(meta["fields"], values, strict=True))
    assert fields["length_m"][0] == 0.2
    assert fields["found"][0]
    assert {"reason", "grid"}.isdisjoint(fields)
    _, _, ends, (names,) = pyogrio.raw.read(tmp_path / "path.gpkg", layer="ends")
    assert list(names) == ["start", "target"]
    np.testing.assert_array_equal([np.frombuffer(p[5:], "<f8") for p in ends], VERTICES[[0, -1]])


def test_no_path_is_a_layer_without_geometry(tmp_path: Path) -> None:
    write_path(tmp_path / "path.gpkg", Bundle({"path": np.empty((0, 3))}, {"found": False, "reason": "blocked"}))
    meta, _, geometry, values = pyogrio.raw.read(tmp_path / "path.gpkg")
    assert geometry[0] is None
    assert dict(zip(meta["fields"], values, strict=True))["reason"][0] == "blocked"
    assert [name for name, _ in pyogrio.list_layers(tmp_path / "path.gpkg")] == ["path"]


def test_equal_paths_make_equal_files(tmp_path: Path) -> None:
    for name in "ab":
        write_path(tmp_path / name / "path.gpkg", Bundle({"path": VERTICES}, {"found": True}))
    digests = {hashlib.sha256((tmp_path / name / "path.gpkg").read_bytes()).hexdigest() for name in "ab"}
    assert len(digests) == 1
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["path.gpkg"]


def test_a_trajectory_keeps_all_digits_of_its_times(tmp_path: Path) -> None:
    times = [1305031102.175304, 1403636579.7635555]
    write_trajectory_tum(tmp_path / "a.tum", np.tile(np.eye(3, 4), (2, 1, 1)), times)
    rows = [line.split() for line in (tmp_path / "a.tum").read_text().splitlines()[1:]]
    assert [float(row[0]) for row in rows] == times
    assert rows[0] == ["1305031102.175304", *["0", "0", "0", "0", "0", "0", "1"]]


def test_only_what_was_written_is_described() -> None:
    timed = replace(sequence(truth=False), times=tuple(0.5 * frame for frame in FRAMES))
    facts = describe(["dem.tif", "notes.txt"], view(sequence=timed))
    assert list(facts["files"]) == ["dem.tif"]
    assert facts["units"]["time"] == "s"
    assert facts["frames"][3] == {"frame": 3, "name": "left003", "time": 1.5}
    assert facts["georeference"] is None
    place = Georeference("EPSG:32633", (1.0, 2.0, 3.0), 0.5)
    placed = describe(["dem.tif", "trajectory.tum"], view(sequence=replace(timed, georeference=place)))
    assert placed["files"]["dem.tif"]["frame"] == "georeference"
    assert placed["files"]["trajectory.tum"]["frame"] == "world"
    assert facts["files"]["dem.tif"]["frame"] == "world"
    assert placed["georeference"]["origin"] == [1.0, 2.0, 3.0]
