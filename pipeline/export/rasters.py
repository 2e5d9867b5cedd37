"""Rasters of the merged terrain and of its hazards, with the styles by which QGIS shows them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export import ranges, styles
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.writers import write_raster, write_style
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice, mosaic, union
from rille.stages.hazard.risk import REASONS
from rille.stages.hazard.risk import STAGE as RISK
from rille.stages.terrain.shading import hillshade, slope_deg

NAN = float("nan")
LIGHT = {"light": "from the upper left (315 degrees), 45 degrees high"}
CRS = {
    "crs": "engineering CRS, metres",
    "raster": "row 0 at the greatest y; the geotransform gives the corner of the first cell; north is y",
}
GIS = "QGIS, GDAL"


def whole(tiles: list[Bundle], name: str, nodata: float = NAN) -> tuple[Lattice, NDArray[Any]]:
    """One array of all world tiles put together, and the lattice it is on."""
    lattices = [Lattice.from_dict(tile.meta["lattice"]) for tile in tiles]
    lattice = union(lattices)
    parts = [(part, np.asarray(tile[name])) for part, tile in zip(lattices, tiles, strict=True)]
    return lattice, mosaic(parts, nodata, lattice)


def _height(view: Any) -> tuple[Lattice, NDArray[Any]]:
    """Elevations, or heights where the sequence has a place, m."""
    lattice, elevation = whole(list(map(view.bundle, view.products.tiles)), "elevation")
    place = view.sequence.georeference
    return lattice, elevation if place is None else elevation.astype(np.float64) + place.origin[2]


Values = Callable[[Any], tuple[Lattice, NDArray[Any]]]
"""Values of a raster, and the lattice they are on, of a view."""


def _raster(file: str, band: str, unit: str, values: Values) -> Callable[..., None]:
    """Writer of a raster of one band."""

    def write(folder: Path, view: Any) -> None:
        lattice, found = values(view)
        bands = {band: np.asarray(found, np.float32)}
        write_raster(folder / file, bands, lattice, unit=unit, nodata=NAN, place=view.sequence.georeference)

    return write


def _merged(name: str) -> Values:
    return lambda view: whole(list(map(view.bundle, view.products.tiles)), name)


def _slope(view: Any) -> tuple[Lattice, NDArray[Any]]:
    lattice, elevation = _merged("elevation")(view)
    return lattice, slope_deg(elevation, lattice.cell)


def _write_hillshade(folder: Path, view: Any) -> None:
    lattice, elevation = _merged("elevation")(view)
    bands, place = {"hillshade": hillshade(elevation, lattice.cell)}, view.sequence.georeference
    write_raster(folder / "hillshade.tif", bands, lattice, unit="", nodata=0, tags=LIGHT, place=place)


def _write_dem_style(folder: Path, view: Any) -> None:
    low, high = ranges.ground_limits(_height(view)[1])
    write_style(folder / "dem.qml", styles.DEM, {f"e{k}": low + (high - low) * k / 8 for k in range(9)})


def _write_risk(folder: Path, view: Any) -> None:
    """Class, measures in metres and degrees, probability and reasons in one file, so all of one type (float32)."""
    risk = view.bundle(view.products.risk)
    units = {a.name: a.unit for a in RISK.outputs if a.unit in ("m", "rad") and a.name != "elevation"}
    bands = {"class": risk["risk"], "reason": risk["reason"], "p_hazard": risk["p_hazard"], "filled": risk["filled"]}
    bands |= {name: np.degrees(risk[name]) if unit == "rad" else risk[name] for name, unit in units.items()}
    unit = {name: {"rad": "degree"}.get(units.get(name, ""), units.get(name, "")) for name in bands}
    tags = {
        "classes": "0 safe, 1 caution, 2 hazard, 3 unknown (never entered)",
        "reason_bits": ", ".join(f"{bit} {name}" for name, bit in REASONS.items()),
        "vehicle": json.dumps(risk.meta.get("vehicle", {})),
    }
    given = {name: np.asarray(values, dtype=np.float32) for name, values in bands.items()}
    lattice, place = Lattice.from_dict(risk.meta["lattice"]), view.sequence.georeference
    write_raster(
        folder / "risk.tif", given, lattice, unit=unit, nodata=NAN, tags=tags, place=place, overviews="nearest"
    )


def _write_risk_style(folder: Path, view: Any) -> None:
    write_style(folder / "risk.qml", styles.RISK)


def _of_terrain(name: str, what: str, write: Callable[..., None], values: str, missing: str = "nan") -> Output:
    """Record of a raster of the merged terrain: a hole in the run must not look like unknown terrain."""
    facts = {**CRS, "values": values, "missing": missing}
    return Output(name, what, GIS, write, ("tiles",), (), ("sequence.georeference",), "world", facts)


OUTPUTS = (
    _of_terrain(
        "dem.tif",
        "merged elevation, m, NaN undefined",
        _raster("dem.tif", "elevation", "m", _height),
        "elevation z of the cell centre, m",
    ),
    Output(
        "dem.qml",
        "colours of dem.tif, which QGIS applies by itself",
        "QGIS",
        _write_dem_style,
        ("tiles",),
        knows=("sequence.georeference",),
    ),
    _of_terrain(
        "dem_sigma.tif",
        "standard deviation of the elevation, m",
        _raster("dem_sigma.tif", "elevation_std", "m", _merged("elevation_std")),
        "standard deviation of the elevation, m",
    ),
    _of_terrain(
        "slope.tif",
        "inclination of the terrain, degrees",
        _raster("slope.tif", "slope", "degree", _slope),
        "inclination of the terrain, degrees",
    ),
    _of_terrain(
        "hillshade.tif",
        "shaded relief of the terrain",
        _write_hillshade,
        "shaded relief 1..255, light from the upper left",
        "0",
    ),
    _of_terrain(
        "ortho.tif",
        "merged ortho image, grey 0..255",
        _raster("ortho.tif", "ortho", "", _merged("ortho")),
        "grey value 0..255",
    ),
    Output(
        "risk.tif",
        "risk map; bands: class (0 safe, 1 caution, 2 hazard, 3 unknown), reason (bits), p_hazard, filled, measures",
        GIS,
        _write_risk,
        ("risk",),
        knows=("sequence.georeference",),
        frame="world",
        facts={**CRS, "values": "class 0 safe, 1 caution, 2 hazard, 3 unknown; reason bits; p_hazard; measures"},
    ),
    Output(
        "risk.qml",
        "colours and names of the classes of risk.tif, which QGIS applies by itself",
        "QGIS",
        _write_risk_style,
        ("risk",),
    ),
)
STAGE = stage("output.rasters", "Rasters of the terrain and its hazards", OUTPUTS)
