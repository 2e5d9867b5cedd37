"""The merged terrain as xarray opens it."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pyproj
import xarray
from terrain_runs import LATTICE, PLACE, elevation

from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.terrain_zarr import write_terrain
from rille.stages.core.declare import Bundle
from rille.stages.terrain import merge
from rille.stages.terrain.merge import Layer, MergeParams


def arrays() -> dict:
    z = elevation()
    layer = Layer(4, LATTICE, z, np.full_like(z, 0.01), np.zeros_like(z), np.full_like(z, 90))
    found = vars(merge.merge([layer], LATTICE, MergeParams()))
    return {spec.name: (spec, found[spec.name]) for spec in merge.STAGE.outputs if spec.name in found}


def write(path: Path, bundle: Bundle) -> str:
    store = Store(path)
    return store.path(store.commit(merge.STAGE, "a" * 64, bundle))


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


def test_a_place_on_earth_gives_every_cell_its_easting_and_northing(tmp_path: Path) -> None:
    write_terrain(tmp_path / "t.zarr", arrays(), LATTICE, PLACE, {})
    data = opened(tmp_path / "t.zarr")
    x, y = LATTICE.xs()[40], LATTICE.ys()[20]
    expected = PLACE.apply([x, y, 0.0])
    assert data.elevation.easting.values[20, 40] == expected[0]
    assert data.elevation.northing.values[20, 40] == expected[1]
    assert data.easting.attrs["crs"] == "EPSG:32633"
    assert data.attrs["georeference"]["azimuth"] == 0.6


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
