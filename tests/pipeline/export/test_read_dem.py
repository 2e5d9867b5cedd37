"""Elevation models of others: what marks the unknown without a word, and what is only far away."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from rille.pipeline.export.read_dem import read_elevation


def hills(base: float, height: float = 20.0) -> np.ndarray:
    """Terrain (60, 80) of hills, metres, around ``base``."""
    row, col = np.mgrid[:60, :80]
    return np.asarray(base + height * np.sin(row / 9) * np.cos(col / 7) + 0.01 * row)


def tiff(path: Path, values: np.ndarray, cell: float = 1.0) -> Path:
    about = {"height": values.shape[0], "width": values.shape[1], "transform": from_origin(0, 0, cell, cell)}
    with rasterio.open(path, "w", driver="GTiff", count=1, dtype=values.dtype, **about) as file:
        file.write(values, 1)
        file.units = ("metre",)
    return path


def asc(path: Path, values: np.ndarray) -> Path:
    rows = "\n".join(" ".join(f"{z:.3f}" for z in row) for row in values)
    path.write_text(f"ncols {values.shape[1]}\nnrows {values.shape[0]}\nxllcorner 0\nyllcorner 0\ncellsize 1\n{rows}\n")
    return path


HOLE = (slice(10, 20), slice(5, 50))


@pytest.mark.parametrize(
    ("mark", "base", "kind"),
    [
        (-9999.0, 500.0, "float32"),
        (-9999.0, -200.0, "float64"),
        (-32768, 1500.0, "int16"),
        (32767, 1500.0, "int16"),
        (0, 800.0, "uint16"),
        (-3.4028235e38, 20.0, "float32"),
        (1e20, 3.0, "float32"),
        (9.96921e36, -1.5, "float32"),
        (-np.inf, 3.0, "float32"),
        (0.0, 2500.0, "float32"),
        (-999.0, 30.0, "float32"),
    ],
    ids=str,
)
def test_a_value_that_marks_the_unknown_is_no_elevation(tmp_path, mark, base, kind):
    values = hills(base)
    values[HOLE] = mark
    found = read_elevation(tiff(tmp_path / "dem.tif", values.astype(kind)))
    expected = np.full(values.shape, True)
    expected[HOLE] = False
    assert (np.isfinite(found.grid.values) == expected).all()
    (line,) = found.warnings
    assert "RIL-725" in line
    assert "450 cells" in line


def test_so_in_an_ascii_grid_without_its_line_and_where_two_values_do(tmp_path):
    values = hills(100.0)
    values[HOLE], values[40, :] = -9999.0, 1e20
    found = read_elevation(asc(tmp_path / "dem.asc", values))
    assert np.isnan(found.grid.values).sum() == 450 + 80
    assert sum("RIL-725" in line for line in found.warnings) == 2


def test_so_where_mountains_extend_further_than_the_value_is_off(tmp_path):
    values = hills(2600.0, 1500.0)
    values[HOLE] = -999.0
    assert np.isnan(read_elevation(asc(tmp_path / "dem.asc", values)).grid.values).sum() == 450


def test_so_over_level_ground(tmp_path):
    values = np.full((60, 80), 12.5, np.float32)
    values[HOLE] = -9999.0
    assert np.isnan(read_elevation(tiff(tmp_path / "dem.tif", values)).grid.values).sum() == 450


def sea(z: np.ndarray) -> np.ndarray:
    return np.maximum(z, 0.0)


def cliff_over_a_sea(z: np.ndarray) -> np.ndarray:
    return np.where(np.arange(80) < 30, 0.0, z + 200.0)


def quarry(z: np.ndarray) -> np.ndarray:
    z[HOLE] = -80.0
    return z


def plateau(z: np.ndarray) -> np.ndarray:
    z[HOLE] = 150.0
    return z


def spike(z: np.ndarray) -> np.ndarray:
    z[3, 3] = 900.0
    return z


def steps(z: np.ndarray) -> np.ndarray:
    return np.round(z / 10.0) * 10.0


def mountains(z: np.ndarray) -> np.ndarray:
    return sea(200.0 * z)


def floor(z: np.ndarray) -> np.ndarray:
    return np.where(np.arange(80) < 40, 0.0 * z, 0.3)


@pytest.mark.parametrize("cell", [1.0, 30.0])
@pytest.mark.parametrize("shape", [sea, cliff_over_a_sea, quarry, plateau, spike, steps, mountains, floor])
def test_what_is_only_flat_or_far_stays(tmp_path, shape, cell):
    values = shape(hills(0.0)).astype(np.float32)
    found = read_elevation(tiff(tmp_path / "dem.tif", values, cell))
    assert (found.grid.values == values).all()
    # A cliff of 200 m within a metre, upright all along the sea, is doubted.
    doubted = [shape is cliff_over_a_sea and cell == 1.0]
    assert ["RIL-726" in line for line in found.warnings] == [one for one in doubted if one]


@pytest.mark.parametrize(("mark", "kind"), [(0.0, "float32"), (-1, "int16"), (255, "uint8"), (-99.0, "float64")])
def test_a_usual_mark_in_scattered_cells_is_no_elevation(tmp_path, mark, kind):
    values = hills(100.0)
    values[::7, ::5] = mark
    found = read_elevation(tiff(tmp_path / "dem.tif", values.astype(kind), 0.5))
    assert np.isnan(found.grid.values).sum() == 9 * 16
    assert [line.split(":")[0] for line in found.warnings] == ["RIL-725"]


@pytest.mark.parametrize("ending", ["txt", "grd", "ASC"])
def test_an_ascii_grid_is_known_by_its_content(tmp_path, ending):
    path = asc(tmp_path / "dem.asc", hills(100.0)).rename(tmp_path / f"dem.{ending}")
    assert np.isfinite(read_elevation(path).grid.values).all()


def test_a_box_in_a_simulated_bed_stays(tmp_path):
    values = hills(0.0, 0.02)
    values[HOLE] = 0.25
    assert np.isfinite(read_elevation(tiff(tmp_path / "dem.tif", values, 0.002)).grid.values).all()
