"""The merged terrain as xarray opens it."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import xarray
from terrain_runs import LATTICE, PLACE, elevation

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.terrain_zarr import write_terrain
from rille.stages.core.declare import Bundle
from rille.stages.terrain import merge
from rille.stages.terrain.merge import MergeParams, ModelLayer


def arrays() -> dict:
    z = elevation()
    model = {"elevation": z, "elevation_std": np.full_like(z, 0.01), "ortho": np.full_like(z, 90)}
    layer = ModelLayer(4, LATTICE, lambda name, window: model[name][window])
    found = merge.merge([layer], LATTICE, MergeParams())._asdict()
    return {spec.name: (spec, found[spec.name]) for spec in merge.merge_stage.outputs if spec.name in found}


def write(path: Path, bundle: Bundle) -> str:
    store = Store(path)
    return f"zip::{store.root / store.commit(merge.merge_stage, 'a' * 64, bundle).path}"


def opened(path: Path | str) -> xarray.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return xarray.open_zarr(path)


def test_plain_open_zarr_gives_units_sigma_source_and_place(tmp_path: Path) -> None:
    write_terrain(tmp_path / "terrain.zarr", arrays(), LATTICE, None, {"title": "t", "source": "stereo"})
    data = opened(tmp_path / "terrain.zarr")
    assert data.elevation.dims == ("y", "x")
    assert data.elevation.attrs["units"] == "m"
    assert set(data.elevation.attrs["ancillary_variables"].split()) >= {"elevation_std", "spread", "count", "source"}
    assert data.elevation_std.attrs["units"] == "m"
    assert data.attrs["source"] == "stereo"
    assert data.attrs["Conventions"] == "CF-1.11"
    np.testing.assert_array_equal(data.elevation.values, elevation())
    np.testing.assert_array_equal(data.x.values, LATTICE.xs())
    assert data.y.attrs["units"] == "m"
    # selecting by coordinates finds the cell
    assert data.elevation.sel(x=0.5, y=3.0, method="nearest").values.item() == elevation()[30, 30]
    assert np.isnan(data.source.values[0, 0]) == (data.source.values.dtype.kind == "f")
    assert data.source.values[30, 30] == 4
    crs = pyproj.CRS.from_wkt(data.spatial_ref.attrs["crs_wkt"])
    assert crs.is_engineering
    assert [(a.direction, a.unit_name) for a in crs.axis_info] == [("east", "metre"), ("north", "metre")]
    assert [p.name for p in tmp_path.iterdir()] == ["terrain.zarr"]


def test_a_place_on_earth_is_stated(tmp_path: Path) -> None:
    write_terrain(tmp_path / "t.zarr", arrays(), LATTICE, PLACE, {})
    data = opened(tmp_path / "t.zarr")
    assert pyproj.CRS(data.attrs["georeference_crs"]).to_epsg() == 32633
    assert data.attrs["georeference_azimuth"] == 0.6


@pytest.mark.parametrize("place", [None, PLACE])
def test_gdal_opens_every_array_at_its_place(tmp_path: Path, place: Georeference | None) -> None:
    write_terrain(tmp_path / "t.zarr", arrays(), LATTICE, place, {})
    for name in ("elevation", "elevation_std", "count", "source"):
        with rasterio.open(f'ZARR:"{tmp_path / "t.zarr"}":/{name}') as found:
            assert found.shape == LATTICE.shape
            assert 'UNIT["metre",1' in found.crs.to_wkt()
            assert found.crs.to_wkt().startswith('LOCAL_CS["Rille world frame')
            corner = LATTICE.x0 - LATTICE.cell / 2, LATTICE.y0 + LATTICE.cell / 2
            assert found.transform * (0, 0) == pytest.approx(corner, abs=1e-9)
            assert found.transform * (1, 1) == pytest.approx((corner[0] + 0.05, corner[1] - 0.05), abs=1e-9)
            np.testing.assert_array_equal(found.read(1), arrays()[name][1])


@pytest.mark.parametrize("place", [None, PLACE])
def test_the_rules_of_cf_hold(tmp_path: Path, place: Georeference | None) -> None:
    """CF 1.11: sections 2.6.1, 3.1-3.4, 4, 5 and 5.6, as far as these variables come under them."""
    write_terrain(tmp_path / "t.zarr", arrays(), LATTICE, place, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xarray.open_zarr(tmp_path / "t.zarr", decode_cf=False)
    assert data.attrs["Conventions"] == "CF-1.11"
    for name, variable in data.variables.items():
        about = variable.attrs
        assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", str(name))
        assert about.get("long_name"), name
        if variable.dims:
            assert about["units"] in ("m", "1", "degree"), name
        for other in about.get("ancillary_variables", "").split() + about.get("coordinates", "").split():
            assert other in data.variables
        assert "grid_mapping" not in about, "one is claimed where there is a projection only"
    for axis in "xy":
        steps = np.diff(data[axis].values)
        assert (steps > 0).all() or (steps < 0).all()
        assert data[axis].attrs["axis"] == axis.upper()


def test_an_artifact_on_a_lattice_has_coordinates_too(tmp_path: Path) -> None:
    found = {name: values for name, (_, values) in arrays().items()}
    data = opened(write(tmp_path / "a", Bundle(found, {"lattice": LATTICE.to_dict(), "frame": "world"})))
    assert set(data.elevation.coords) == {"x", "y"}
    np.testing.assert_array_equal(data.x.values, LATTICE.xs())
    assert data.y.dims == ("row",)
    assert data.y.attrs == {"units": "m", "frame": "world", "long_name": "y of the cell centre (ahead)"}
    assert data.elevation.attrs["ancillary_variables"] == "elevation_std"
    assert data.attrs["source"].startswith("Rille, stage merge")


def test_an_artifact_without_a_lattice_is_left_alone(tmp_path: Path) -> None:
    found = {name: values[:3] for name, (_, values) in arrays().items()}
    assert not opened(write(tmp_path / "a", Bundle(found, {"lattice": "none"}))).coords
