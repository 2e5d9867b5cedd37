"""``rille compare-dem``: figures with a known answer, and one clear line for what cannot be compared."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from terrain_runs import LATTICE, PLACE, elevation, finished, hills

from rille.pipeline import cli
from rille.pipeline.commands.results import compare_dem
from rille.pipeline.export.writers import ON_PLANE, Meaning, write_raster


def compare(a: Path, b: Path, **options: Any) -> None:
    compare_dem.compare_dem(str(a), str(b), **options)


def tiff(path: Path, values: np.ndarray, cell: float, x0: float, y0: float, **more: object) -> Path:
    """Raster of any program: upper left corner at (x0, y0)."""
    unit = more.pop("unit", "metre")
    about = {"height": values.shape[0], "width": values.shape[1], "transform": from_origin(x0, y0, cell, cell)} | more
    with rasterio.open(path, "w", driver="GTiff", count=1, dtype="float32", nodata=-9999.0, **about) as file:
        file.write(np.where(np.isfinite(values), values, -9999.0).astype(np.float32), 1)
        file.units = (unit,)
    return path


def test_a_lifted_run_against_its_own_raster(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = finished(tmp_path / "run", lift=0.25)
    compare(run, finished(tmp_path / "b") / "dem.tif", output=tmp_path / "out")
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["figures"]["bias"] == pytest.approx(0.25, abs=1e-6)
    assert found["figures"]["nmad"] == pytest.approx(0.0, abs=1e-6)
    assert found["completeness"]["of_b"] == 1.0
    assert found["resampling"] == "the same cells, nothing resampled"
    assert sum(f["cells"] for f in found["by_range"]["bins"]) == np.isfinite(elevation()).sum()
    # the camera of the run is at (0, 1): the farthest known cell
    far = np.linalg.norm(LATTICE.xy() - [0.0, 1.0], axis=-1)[np.isfinite(elevation())].max()
    assert found["by_range"]["bins"][-1]["to"] == pytest.approx(far, rel=1e-6)
    assert "before" not in capsys.readouterr().out
    with rasterio.open(tmp_path / "out.tif") as file, rasterio.open(run / "dem.tif") as dem:
        assert file.transform == dem.transform
        assert np.nanmedian(file.read(1)) == pytest.approx(0.25, abs=1e-6)


def test_a_coarse_raster_of_another_program(tmp_path: Path) -> None:
    x0, x1, _, y1 = LATTICE.bounds
    centres = np.stack(np.meshgrid(x0 + 0.1 + 0.2 * np.arange(17), y1 - 0.1 - 0.2 * np.arange(15)), axis=-1)
    coarse = tiff(tmp_path / "coarse.tif", hills(centres), 0.2, x0, y1)
    assert x1 > centres[..., 0].max()
    compare(finished(tmp_path / "run"), coarse, output=tmp_path / "out")
    found = json.loads((tmp_path / "out.json").read_text())
    assert "A averaged from 0.05 m to 0.2 m" in found["resampling"]
    # mean over a cell against its centre: h^2/24 (z_xx + z_yy), z_xx <= 0.1 * 4, z_yy <= 0.1 * 2.25
    assert found["figures"]["p95"] < 0.2**2 / 24 * 0.1 * (4 + 2.25) + 1e-6
    # the unknown corner of A, 9 x 11 fine cells, takes 2 x 2 coarse cells and those that it covers by half or more
    assert found["completeness"]["of_b"] == pytest.approx(1 - 2 * 3 / coarse_cells(found), abs=1e-9)
    assert "states no CRS" in found["warnings"][0]


def test_whole_numbers_with_a_scale_are_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Models of planets come so: 16 bits of millimetres above a datum."""
    z = 100.0 + 0.001 * np.arange(1200.0).reshape(30, 40)
    metres = tiff(tmp_path / "metres.tif", z, 0.5, 0.0, 0.0)
    scaled = tiff(tmp_path / "scaled.tif", (z - 100.0) / 0.001, 0.5, 0.0, 0.0, unit="")
    with rasterio.open(scaled, "r+") as file:
        file.scales, file.offsets = (0.001,), (100.0,)
    compare(scaled, metres, output=tmp_path / "out")
    assert json.loads((tmp_path / "out.json").read_text())["figures"]["rmse"] < 1e-5
    assert "RIL-962: " in capsys.readouterr().err  # no unit


def grid(path: Path, values: np.ndarray, cell: float, x0: float, y0: float) -> Path:
    """ESRI ASCII grid: lower left corner at (x0, y0)."""
    head = {"ncols": values.shape[1], "nrows": values.shape[0], "xllcorner": x0, "yllcorner": y0, "cellsize": cell}
    lines = [f"{key} {value}" for key, value in {**head, "NODATA_value": -9999}.items()]
    rows = (" ".join(f"{v:.6f}" for v in row) for row in np.where(np.isfinite(values), values, -9999.0))
    path.write_text("\n".join([*lines, *rows]) + "\n")
    return path


def test_an_ascii_grid_is_as_good_as_a_tiff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    x0, _, y0, y1 = LATTICE.bounds
    z = elevation()
    compare(
        tiff(tmp_path / "a.tif", z, 0.05, x0, y1), grid(tmp_path / "b.ASC", z, 0.05, x0, y0), output=tmp_path / "out"
    )
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["figures"]["rmse"] < 1e-5
    assert found["completeness"]["of_b"] == 1.0
    assert "RIL-962: " in capsys.readouterr().err  # no unit
    (tmp_path / "b.prj").write_text(rasterio.crs.CRS.from_epsg(4326).to_wkt())
    assert "is in degrees" in refused(capsys, tmp_path / "a.tif", tmp_path / "b.ASC")


def test_a_grid_that_breaks_off_is_named_as_that(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = grid(tmp_path / "whole.asc", elevation(), 0.05, -1.0, 1.0)
    (tmp_path / "cut.asc").write_bytes(whole.read_bytes()[:9000])
    assert "RIL-629" in (said := refused(capsys, tmp_path / "cut.asc", whole))
    assert "copy it again" in said


def test_a_tiff_without_a_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    z = elevation()
    placed, bare = tiff(tmp_path / "a.tif", z, 0.05, -1.0, 4.5), tiff(tmp_path / "b.tif", z, 1, 0, 0, transform=None)
    assert "has no geotransform" in refused(capsys, placed, bare)


def coarse_cells(found: dict) -> int:
    return int(found["b"]["rows"] * found["b"]["cols"])


def test_alignment_is_told_and_never_silent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = finished(tmp_path / "a", lift=0.25), finished(tmp_path / "b")
    compare(a, b, align="tilt", output=tmp_path / "out.tif")
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["alignment"]["motion_of_a"]["z_m"] == pytest.approx(-0.25, abs=1e-6)
    assert set(found["alignment"]["motion_of_a"]) == {"z_m", "about_x_deg", "about_y_deg"}
    assert found["before_alignment"]["bias"] == pytest.approx(0.25, abs=1e-6)
    assert abs(found["figures"]["bias"]) < 1e-6
    printed = capsys.readouterr().out
    assert "aligned (tilt): A was moved by z_m -0.25" in printed
    assert "before  RMSE 0.250 m " in printed


def test_georeferenced_runs_compare_in_their_own_system(tmp_path: Path) -> None:
    a, b = finished(tmp_path / "a", PLACE, lift=0.5), finished(tmp_path / "b", PLACE)
    compare(a, b, output=tmp_path / "out")
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["figures"]["median"] == pytest.approx(0.5, abs=2e-4)
    assert found["a"]["crs"] == "WGS 84 / UTM zone 33N"
    assert found["by_range"]["bins"][-1]["to"] < 6.0


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as stop:
        cli.main(["compare-dem", *(str(w) for w in words)])
    assert stop.value.code in (1, 2)
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1
    return err


def test_one_clear_line_for_what_cannot_be_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, z = finished(tmp_path / "run"), elevation()
    away = tiff(tmp_path / "away.tif", z, 0.05, 1000.0, 2000.0)
    utm = tiff(tmp_path / "utm.tif", z, 0.05, -1.0, 4.5, crs="EPSG:32633")
    degrees = tiff(tmp_path / "degrees.tif", z, 0.05, -1.0, 4.5, crs="EPSG:4326")
    feet = tiff(tmp_path / "feet.tif", z, 0.05, -1.0, 4.5, unit="foot")
    empty = tiff(tmp_path / "empty.tif", np.full_like(z, np.nan), 0.05, -1.0, 4.5)
    (tmp_path / "text.tif").write_text("no raster")
    (tmp_path / "folder").mkdir()
    assert "none.tif does not exist" in refused(capsys, run, tmp_path / "none.tif")
    assert "no known cell in common: A is at x -1..2.45" in refused(capsys, run, away)
    told = refused(capsys, run, utm)
    assert "Rille world frame" in told
    assert "UTM zone 33N" in told
    assert "EPSG:4326" in refused(capsys, degrees, run)
    assert "elevations in 'foot'" in refused(capsys, feet, run)
    assert f"no known cell among {z.size}" in refused(capsys, empty, run)
    assert "cannot be read as a raster" in refused(capsys, tmp_path / "text.tif", run)
    assert "has no dem.tif" in refused(capsys, tmp_path / "folder", run)
    assert "RIL-043" in refused(capsys, run, away, "-o", tmp_path / "away")
    assert "RIL-043" in refused(capsys, run, away, "-o", run / "dem")
    for other, band in (("dem_sigma.tif", "elevation_std"), ("ortho.tif", "ortho")):
        assert f"{other} has {band}, no elevation" in refused(capsys, run / other, run)
    compare(run, run, output=tmp_path / "before")
    capsys.readouterr()
    assert "before.tif has difference" in refused(capsys, tmp_path / "before.tif", run)
    shutil.copy(run / "dem.tif", tmp_path / "same.tif")
    assert "too flat" not in refused(capsys, run, run, "--align", "nothing")


def test_distances_from_a_plane_are_not_compared_with_ground(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, wall = finished(tmp_path / "run"), finished(tmp_path / "wall")
    write_raster(wall / "dem.tif", {"elevation": elevation()}, LATTICE, Meaning("m", tags={"frame": ON_PLANE}))
    assert "RIL-842" in refused(capsys, run, wall)
    compare(wall, wall, output=tmp_path / "out")


def test_changes_are_listed_with_their_places_and_volumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(5)
    ground = 0.2 * rng.normal(size=(60, 80)).cumsum(0).cumsum(1) / 80 + 0.001 * rng.normal(size=(60, 80))
    after = ground + 0.001 * rng.normal(size=ground.shape)
    after[10:20, 30:40] += 0.05
    before = tiff(tmp_path / "b.tif", ground, 0.1, 100.0, 50.0)
    compare(tiff(tmp_path / "a.tif", after, 0.1, 100.0, 50.0), before, changes=True, output=tmp_path / "out")
    patches = json.loads((tmp_path / "out.json").read_text())["changes"]["patches"]
    assert len(patches) == 1
    assert (patches[0]["x_m"], patches[0]["y_m"]) == pytest.approx((103.5, 48.5), abs=0.05)
    assert patches[0]["volume_m3"] == pytest.approx(100 * 0.1**2 * 0.05, rel=0.05)
    assert "rose" in capsys.readouterr().out
    with rasterio.open(tmp_path / "out.tif") as file:
        assert file.descriptions == ("difference", "standard_deviation")
        assert file.read(1)[15, 35] == pytest.approx(0.05, abs=0.005)
    compare(before, before, changes=True, output=tmp_path / "same")
    assert json.loads((tmp_path / "same.json").read_text())["changes"]["patches"] == []
