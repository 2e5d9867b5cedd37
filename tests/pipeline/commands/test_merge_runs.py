"""``rille merge``: two sessions of one ground in the frame of the first, or one clear line why not."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_runs import CELL, SIGMA, Frame, height, made_run
from raising import raises

from rille.datasets.georeference import Georeference
from rille.pipeline.commands.results.merge import merge
from rille.pipeline.export.read_dem import read_elevation, read_raster
from rille.stages.geometry.geometry import RigidTransform

FIRST, SECOND = Frame(0.0, -1.5, 0.2), Frame(0.7, -1.2, 0.5, yaw=15.0, tilt=0.4)


def facts(output: Path) -> dict[str, Any]:
    (one,) = json.loads((output / "merge.json").read_text())["runs"]
    return dict(one)


def centres_of(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    dem = read_elevation(path)
    return *np.moveaxis(dem.grid.centres(), -1, 0), dem.grid.values


def test_sessions_in_frames_of_their_own_become_one_terrain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = made_run(tmp_path / "a", FIRST), made_run(tmp_path / "b", SECOND, noise=2)
    for run, digests in ((a, "abc"), (b, "cde")):
        rows = [{"label": f"image/left/{d}", "status": "cached", "key": d, "digest": d} for d in digests]
        (run / "ledger.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    merge(str(a), str(b), output=tmp_path / "out")
    one = facts(tmp_path / "out")
    expected = FIRST.pose.inverse() @ SECOND.pose
    found = RigidTransform.from_matrix(one["T_first_world"])
    assert found.translation == pytest.approx(expected.translation, abs=0.1 * CELL)
    assert found.rotation == pytest.approx(expected.rotation, abs=5e-4)
    assert one["overlap"]["nmad"] == pytest.approx(math.sqrt(2) * SIGMA, rel=0.3)
    assert abs(one["overlap"]["median"]) < 0.2 * SIGMA
    x, y, z = centres_of(tmp_path / "out" / "dem.tif")
    error = z - (height(x, y - 1.5) - 0.2)
    known = np.isfinite(error)
    assert np.sqrt(np.mean(error[known] ** 2)) < 1.2 * SIGMA
    assert known.sum() > 1.15 * np.isfinite(read_elevation_of(a)).sum()
    sigma = read_raster(tmp_path / "out" / "dem_sigma.tif", "elevation_std").grid.values
    assert 0.6 < np.sqrt(np.nanmean((error / sigma) ** 2)) < 1.3
    assert (tmp_path / "out" / "ortho.tif").exists()
    said = capsys.readouterr()
    assert "cells in common" in said.out
    assert "RIL-848: 1 left image of " in said.err


def test_sessions_in_unlike_light_are_laid_by_their_relief(tmp_path: Path) -> None:
    a, b = made_run(tmp_path / "a", FIRST), made_run(tmp_path / "b", SECOND, noise=2, light=7)
    merge(str(a), str(b), output=tmp_path / "out")
    one = facts(tmp_path / "out")
    assert one["by"].startswith("relief, ")
    expected, found = FIRST.pose.inverse() @ SECOND.pose, RigidTransform.from_matrix(one["T_first_world"])
    assert found.translation == pytest.approx(expected.translation, abs=0.1 * CELL)
    assert found.rotation == pytest.approx(expected.rotation, abs=5e-4)


def read_elevation_of(run: Path) -> np.ndarray:
    import xarray

    return np.asarray(xarray.open_zarr(run / "terrain.zarr").elevation)


def test_georeferences_of_one_lattice_resample_nothing(tmp_path: Path) -> None:
    origin = (500000.0, 5200000.0, 700.0)
    shift = 25 * CELL
    a = made_run(tmp_path / "a", FIRST, Georeference("EPSG:32633", origin, 0.0))
    there = Georeference("EPSG:32633", (origin[0] + shift, origin[1], origin[2]), 0.0)
    # The same noise on the ground: the same cells.
    b = made_run(tmp_path / "b", Frame(FIRST.x + shift, FIRST.y, FIRST.z), there)
    merge(str(a), str(b), output=tmp_path / "out")
    assert facts(tmp_path / "out")["by"] == "georeferences"
    one, other = read_elevation_of(a), read_elevation_of(b)
    merged = read_elevation(tmp_path / "out" / "dem.tif")
    alone = merged.grid.values[:, -25:] - 700.0
    assert merged.crs.startswith("PROJCRS")
    assert merged.grid.values.shape == (one.shape[0], one.shape[1] + 25)
    assert np.nanmax(np.abs(alone - other[:, -25:])) < 0.3 * SIGMA
    assert np.nanmax(np.abs(merged.grid.values[:, :25] - 700.0 - one[:, :25])) < 1e-4  # float32 of heights


def test_georeferences_that_elevations_contradict_are_said_to_be_off(tmp_path: Path) -> None:
    a = made_run(tmp_path / "a", FIRST, Georeference("EPSG:32633", (5e5, 5.2e6, 700.0), 0.0))
    b = made_run(tmp_path / "b", FIRST, Georeference("EPSG:32633", (5e5, 5.2e6, 677.0), 0.0), noise=2)
    merge(str(a), str(b), output=tmp_path / "out")
    one = facts(tmp_path / "out")
    assert one["by"] == "georeferences, 23.0 m off by the elevations, which decide"
    assert abs(one["overlap"]["median"]) < 0.2 * SIGMA


def test_what_is_no_second_session_is_one_line_each(tmp_path: Path) -> None:
    a, b = made_run(tmp_path / "a", FIRST), made_run(tmp_path / "b", Frame(seed=9))
    coarse = made_run(tmp_path / "coarse", FIRST, cell=0.04)
    utm = made_run(tmp_path / "utm", FIRST, Georeference("EPSG:32633", (0.0, 0.0, 0.0), 0.0))
    other = made_run(tmp_path / "other", FIRST, Georeference("EPSG:32632", (0.0, 0.0, 0.0), 0.0), noise=2)
    far = made_run(tmp_path / "far", FIRST, Georeference("EPSG:32633", (900.0, 0.0, 0.0), 0.0), noise=2)
    again = made_run(tmp_path / "again", FIRST)
    for code, one, two in (
        ("RIL-849", a, a),
        ("RIL-968", a, again),
        ("RIL-327", a, b),
        ("RIL-851", a, coarse),
        ("RIL-615", utm, other),
        ("RIL-853", utm, far),
    ):
        with raises(code):
            merge(str(one), str(two), output=tmp_path / "out")
    with raises("RIL-607"):
        merge(str(a), str(b), output=coarse)
    (tmp_path / "file").write_text("")
    with raises("RIL-607", "file exists"):
        merge(str(a), str(made_run(tmp_path / "c", SECOND)), output=tmp_path / "file")
