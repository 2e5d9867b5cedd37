"""The terrain of a run as glTF, read back by another program."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from raising import raises
from terrain_runs import LATTICE, elevation, finished

from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.run_artifacts import export_run
from rille.pipeline.export.programs.terrain import write_glb
from rille.pipeline.export.read_dem import read_elevation
from rille.pipeline.export.writers import Meaning, write_raster

KNOWN = np.isfinite(elevation())


def exported(run: Path) -> tuple[Path, str]:
    """Path of the mesh of a run, and what is said of it."""
    path = run / "terrain.glb"
    return path, export_run("glb", run, path, Store(run / "cache"))


def test_equal_runs_make_equal_files(tmp_path: Path) -> None:
    made = [exported(finished(tmp_path / n))[0].read_bytes() for n in "ab"]
    assert made[0] == made[1]


def test_the_mesh_is_the_terrain_the_right_way_up(tmp_path: Path) -> None:
    path, words = exported(finished(tmp_path))
    terrain = trimesh.load(path).to_geometry()
    quads = KNOWN[:-1, :-1] & KNOWN[1:, :-1] & KNOWN[:-1, 1:] & KNOWN[1:, 1:]
    assert len(terrain.faces) == 2 * quads.sum()
    assert f"{len(terrain.faces)} triangles" in words
    assert (terrain.face_normals[:, 1] > 0).all()  # seen from above, y up
    origin = np.array(_json(path)["scenes"][0]["extras"]["origin_m"])
    x, z, y = terrain.vertices[:, 0] + origin[0], terrain.vertices[:, 1] + origin[2], origin[1] - terrain.vertices[:, 2]
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
    path, _ = exported(finished(tmp_path))
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
    monkeypatch.setattr("rille.pipeline.export.programs.terrain.MAX_FACES", 2000)
    path, words = exported(finished(tmp_path))
    assert "every 2. cell" in words
    assert len(trimesh.load(path).to_geometry().faces) <= 2000


def test_what_is_no_run_is_said(tmp_path: Path) -> None:
    with raises("RIL-635"):
        exported(tmp_path)


def texture(path: Path) -> np.ndarray:
    """Grey values of the only texture."""
    (shape,) = trimesh.load(path).geometry.values()
    return np.unique(np.asarray(shape.visual.material.baseColorTexture.convert("L")))


def test_cells_without_an_image_are_grey(tmp_path: Path) -> None:
    terrain = read_elevation(finished(tmp_path))
    look = np.full(KNOWN.shape, np.nan)
    look[KNOWN] = np.where(np.arange(KNOWN.sum()) == 0, 7.0, np.nan)
    write_glb(tmp_path / "a.glb", terrain, look)
    assert texture(tmp_path / "a.glb").tolist() == [7, 128]


def test_cells_without_an_image_are_grey_in_a_coloured_run_too(tmp_path: Path) -> None:
    run = finished(tmp_path)
    bands = np.full((3, *KNOWN.shape), 90, np.uint8)
    bands[:, 20:25] = 0  # 0 means unknown in the file
    write_raster(run / "ortho.tif", dict(zip(("red", "green", "blue"), bands, strict=True)), LATTICE, Meaning(nodata=0))
    path, _ = exported(run)
    assert texture(path).tolist() == [90, 128]
