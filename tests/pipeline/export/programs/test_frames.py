"""Rasters of each pair in the geometry of its left image, read back by rasterio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from test_cloud import CAMERA, DEPTH, POSES, Recorded

from rille.pipeline.export.programs.frames import write_run

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.filterwarnings("error")
def test_walls(tmp_path: Path) -> None:
    words = write_run(tmp_path / "frames", Recorded(tmp_path / "run"))
    assert "2 pairs" in words
    assert "1 without a pose" in words
    names = {path.name for path in (tmp_path / "frames").iterdir()}
    kinds = ("XYZ", "RNG", "RNE", "UVW", "SLP", "RUF", "DSP")
    assert names == {f"{pair:06d}_{kind}.tif" for pair in (3, 5) for kind in kinds}


@pytest.mark.parametrize("pair", [3, 5])
def test_values_and_what_the_file_says(tmp_path: Path, pair: int) -> None:
    write_run(tmp_path / "frames", Recorded(tmp_path / "run"))
    read = {}
    for kind in ("XYZ", "RNG", "UVW", "SLP", "RUF", "DSP"):
        with rasterio.open(tmp_path / "frames" / f"{pair:06d}_{kind}.tif") as file:
            read[kind], tags, units = file.read(), file.tags(), file.units
            assert file.dtypes[0] == "float32"
            assert np.isnan(file.nodata)
    v, u = 20, 30
    ray = CAMERA.rays(np.array([[u, v]], float))[0] * DEPTH[pair]
    np.testing.assert_allclose(read["XYZ"][:, v, u], POSES[pair].apply(ray), rtol=1e-5)
    assert read["RNG"][0, v, u] == pytest.approx(np.linalg.norm(ray), rel=1e-5)
    towards = -POSES[pair].rotation[:, 2]
    np.testing.assert_allclose(read["UVW"][:, v, u], towards, atol=1e-3)
    assert read["SLP"][0, v, u] == pytest.approx(np.degrees(np.arccos(towards[2])), abs=0.1)
    assert read["RUF"][0, v, u] < 1e-3
    assert read["DSP"][0, v, u] == pytest.approx(-0.2 * CAMERA.fx / DEPTH[pair])
    # Interpolated pixels are no measurements.
    assert all(np.isnan(values[:, 0]).all() for values in read.values())
    assert units == ("pixel",) * 3
    np.testing.assert_allclose(np.fromstring(tags["CAMERA_T_WORLD_LEFT"], sep=" "), POSES[pair].matrix34.ravel())
