"""LAZ and glTF of a run, read back by other programs."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import trimesh
from raising import raises
from terrain_runs import LATTICE, PLACE, elevation, finished

from rille.datasets.georeference import Georeference
from rille.pipeline.export.programs import point_cloud
from rille.pipeline.export.read_dem import read_elevation
from rille.pipeline.export.writers import Meaning, write_raster

KNOWN = np.isfinite(elevation())


def test_laspy_reads_every_known_cell(tmp_path: Path) -> None:
    path, words = point_cloud.export(finished(tmp_path), "laz", None)
    assert path == tmp_path / "cloud.laz"
    assert words == f"{KNOWN.sum()} points"
    las = laspy.read(path)
    assert las.header.are_points_compressed
    assert np.abs(las.xyz - np.column_stack([LATTICE.xy()[KNOWN], elevation()[KNOWN]])).max() <= 0.5e-5 + 1e-9
    np.testing.assert_array_equal(np.asarray(las.red) // 257, np.nonzero(KNOWN)[1] * 3)
    np.testing.assert_array_equal(np.asarray(las.sigma), np.float32(0.004))
    (wkt,) = [v.string for v in las.header.vlrs if v.record_id == 2112]
    assert wkt.startswith("LOCAL_CS[")  # LAS 1.4 knows WKT 1 alone
    crs = pyproj.CRS.from_wkt(wkt)
    assert crs.is_engineering
    assert {a.unit_name for a in crs.axis_info} == {"metre"}
    assert las.header.global_encoding.wkt


def test_a_georeferenced_run_gives_points_on_earth(tmp_path: Path) -> None:
    las = laspy.read(point_cloud.export(finished(tmp_path, PLACE), "laz", tmp_path / "a.laz")[0])
    expected = PLACE.apply(np.column_stack([LATTICE.xy()[KNOWN], elevation()[KNOWN]]))
    # float32 heights near 1800 m have steps of 0.12 mm
    np.testing.assert_allclose(las.xyz, expected, atol=1.3e-4)
    (wkt,) = [v.string for v in las.header.vlrs if v.record_id == 2112]
    assert wkt.startswith("PROJCS[")
    assert las.header.parse_crs().to_epsg() == 32633


@pytest.mark.parametrize("place", [None, PLACE])
def test_trimesh_reads_the_points_with_colour_and_sigma(tmp_path: Path, place: Georeference | None) -> None:
    path, words = point_cloud.export(finished(tmp_path, place), "ply", None)
    assert words == f"{KNOWN.sum()} points"
    cloud = trimesh.load(path)
    expected = np.column_stack([LATTICE.xy()[KNOWN], elevation()[KNOWN]])
    # float32 heights near 1800 m have steps of 0.12 mm
    np.testing.assert_allclose(cloud.vertices, expected if place is None else place.apply(expected), atol=1.3e-4)
    for band in range(3):
        np.testing.assert_array_equal(cloud.colors[:, band], np.nonzero(KNOWN)[1] * 3)
    found = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.asarray(found["sigma"]).ravel(), np.float32(0.004))
    header = path.read_bytes().split(b"end_header")[0].decode()
    crs = pyproj.CRS.from_wkt(header.split("comment crs ")[1].splitlines()[0])
    assert crs.is_engineering if place is None else crs.to_epsg() == 32633


def test_a_ply_of_colours_has_the_image_bands_in_order(tmp_path: Path) -> None:
    terrain = read_elevation(finished(tmp_path))
    look = np.stack([np.full(KNOWN.shape, v) for v in (10.0, 20.4, 300.0)], axis=-1)
    point_cloud.write_ply(tmp_path / "a.ply", terrain, look, None)
    np.testing.assert_array_equal(np.unique(trimesh.load(tmp_path / "a.ply").colors[:, :3], axis=0), [[10, 20, 255]])
    point_cloud.write_ply(tmp_path / "b.ply", terrain, None, None)
    assert (tmp_path / "b.ply").read_bytes().count(b"property") == 3


def test_equal_runs_make_equal_files(tmp_path: Path) -> None:
    for kind in point_cloud.FORMATS:
        made = [point_cloud.export(finished(tmp_path / n), kind, None)[0].read_bytes() for n in "ab"]
        assert made[0] == made[1]


def test_the_mesh_is_the_terrain_the_right_way_up(tmp_path: Path) -> None:
    path, words = point_cloud.export(finished(tmp_path), "glb", None)
    mesh = trimesh.load(path).to_geometry()
    quads = KNOWN[:-1, :-1] & KNOWN[1:, :-1] & KNOWN[:-1, 1:] & KNOWN[1:, 1:]
    assert len(mesh.faces) == 2 * quads.sum()
    assert f"{len(mesh.faces)} triangles" in words
    assert (mesh.face_normals[:, 1] > 0).all()  # seen from above, y up
    origin = np.array(_json(path)["scenes"][0]["extras"]["origin_m"])
    x, z, y = mesh.vertices[:, 0] + origin[0], mesh.vertices[:, 1] + origin[2], origin[1] - mesh.vertices[:, 2]
    index = np.rint(LATTICE.index(np.column_stack([x, y]))).astype(int)
    np.testing.assert_allclose(z, elevation()[index[:, 0], index[:, 1]], atol=1e-6)
    # the texture's pixel at a vertex is that of its cell: glTF's (0, 0) is the upper left corner
    document = _json(path)
    uv = _floats(path, document, document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"], 2)
    np.testing.assert_allclose(uv[:, 0] * LATTICE.cols - 0.5, index[:, 1], atol=1e-4)
    np.testing.assert_allclose(uv[:, 1] * LATTICE.rows - 0.5, index[:, 0], atol=1e-4)


def _json(path: Path) -> dict:
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + length])


def _floats(path: Path, document: dict, accessor: int, width: int) -> np.ndarray:
    data = path.read_bytes()
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8
    a = document["accessors"][accessor]
    view = document["bufferViews"][a["bufferView"]]
    at = start + view.get("byteOffset", 0) + a.get("byteOffset", 0)
    return np.frombuffer(data, "<f4", a["count"] * width, at).reshape(-1, width)


def test_accessors_are_within_their_views_and_state_their_bounds(tmp_path: Path) -> None:
    path, _ = point_cloud.export(finished(tmp_path), "glb", None)
    document = _json(path)
    (buffer,) = document["buffers"]
    sizes = {5125: 4, 5126: 4, 5123: 2}
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
    for view in document["bufferViews"]:
        assert view.get("byteOffset", 0) + view["byteLength"] <= buffer["byteLength"]
    for accessor in document["accessors"]:
        size = accessor["count"] * sizes[accessor["componentType"]] * width[accessor["type"]]
        assert accessor.get("byteOffset", 0) + size <= document["bufferViews"][accessor["bufferView"]]["byteLength"]
    (primitive,) = document["meshes"][0]["primitives"]
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    values = _floats(path, document, primitive["attributes"]["POSITION"], 3)
    np.testing.assert_array_equal(values.min(axis=0), np.float32(position["min"]))
    np.testing.assert_array_equal(values.max(axis=0), np.float32(position["max"]))
    assert document["accessors"][primitive["indices"]]["max"] == [len(values) - 1]


def test_large_terrain_is_thinned_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_cloud, "MAX_FACES", 2000)
    path, words = point_cloud.export(finished(tmp_path), "glb", None)
    assert "every 2. cell" in words
    assert len(trimesh.load(path).to_geometry().faces) <= 2000


def test_what_is_no_run_is_said(tmp_path: Path) -> None:
    with raises("RIL-635"):
        point_cloud.export(tmp_path, "laz", None)
    (finished(tmp_path / "run") / "file").write_text("")
    with raises("RIL-601"):
        point_cloud.export(tmp_path / "run", "laz", tmp_path / "run" / "file" / "a.laz")


def test_cells_without_an_image_are_grey(tmp_path: Path) -> None:
    terrain = read_elevation(finished(tmp_path))
    look = np.full(KNOWN.shape, np.nan)
    look[KNOWN] = np.where(np.arange(KNOWN.sum()) == 0, 7.0, np.nan)
    point_cloud.write_ply(tmp_path / "a.ply", terrain, look, None)
    assert np.unique(trimesh.load(tmp_path / "a.ply").colors[:, 0]).tolist() == [7, point_cloud.UNSEEN_GREY]
    point_cloud.write_laz(tmp_path / "a.laz", terrain, look, None)
    assert np.unique(np.asarray(laspy.read(tmp_path / "a.laz").red) // 257).tolist() == [7, point_cloud.UNSEEN_GREY]
    point_cloud.write_glb(tmp_path / "a.glb", terrain, look, None)
    (mesh,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("L"))
    assert np.unique(texture).tolist() == [7, point_cloud.UNSEEN_GREY]


def test_cells_without_an_image_are_grey_in_a_coloured_run_too(tmp_path: Path) -> None:
    run = finished(tmp_path)
    bands = np.full((3, *KNOWN.shape), 90, np.uint8)
    bands[:, 20:25] = 0  # 0 means unknown in the file
    write_raster(run / "ortho.tif", dict(zip(("red", "green", "blue"), bands, strict=True)), LATTICE, Meaning(nodata=0))
    path, _ = point_cloud.export(run, "ply", None)
    assert np.unique(trimesh.load(path).colors[:, :3]).tolist() == [90, point_cloud.UNSEEN_GREY]
