"""Rasters of the merged terrain and of its hazards."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs import BitRound
from numpy.typing import NDArray

from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export import colour
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RUN, Names, RunView, artifact
from rille.pipeline.export.writers import ON_PLANE, Meaning, write_raster
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice, mosaic, union
from rille.stages.hazard.risk import REASONS, risk_stage
from rille.stages.terrain import merge
from rille.stages.terrain.shading import hillshade, slope_deg

GIS = "QGIS, GDAL"

NODATA = {array.name: float(array.nodata or 0) for array in merge.merge_stage.outputs}
"""Value of unknown cells by array of the merged terrain."""


def tiles_of(run: RunView) -> list[Bundle]:
    """World tiles of the merged terrain."""
    return [artifact(run, tile) for tile in run.products.world_tiles]


def whole(tiles: Sequence[Bundle], name: str) -> tuple[Lattice, NDArray[Any]]:
    """Union of the lattices of all world tiles, and one of their arrays on it."""
    lattices = [Lattice.from_dict(tile.meta["lattice"]) for tile in tiles]
    target = union(lattices)
    parts = [(part, np.asarray(tile[name])) for part, tile in zip(lattices, tiles, strict=True)]
    return target, mosaic(parts, NODATA[name], target)


Raster = tuple[Lattice, Mapping[str, NDArray[Any]], Meaning]
"""Lattice of a raster, its bands by name, and their meaning."""


def _dem(run: RunView) -> Raster:
    """Elevations, m; heights of its CRS if the sequence has a place on Earth."""
    (lattice, elevation), place = whole(tiles_of(run), "elevation"), run.sequence.georeference
    height = elevation if place is None else elevation.astype(np.float64) + place.origin[2]
    return lattice, {"elevation": height}, Meaning("m", tags=plane_tag(run))


def _sigma(run: RunView) -> Raster:
    lattice, sigma = whole(tiles_of(run), "elevation_std")
    return lattice, {"elevation_std": sigma}, Meaning("m", tags=plane_tag(run))


def _slope(run: RunView) -> Raster:
    lattice, elevation = whole(tiles_of(run), "elevation")
    return lattice, {"slope": slope_deg(elevation, lattice.cell)}, Meaning("degree", tags=plane_tag(run))


def plane_tag(run: RunView) -> dict[str, str]:
    """Tag with the frame of the terrain, if its elevations are distances from a plane other than the ground."""
    return {"frame": ON_PLANE} if any("reference" in tile.meta for tile in tiles_of(run)) else {}


def _hillshade(run: RunView) -> Raster:
    (lattice, elevation), place = whole(tiles_of(run), "elevation"), run.sequence.georeference
    # With a place on Earth the raster is turned by the azimuth; the light comes from the upper left of the map.
    shade = hillshade(elevation, lattice.cell, 0.0 if place is None else place.azimuth)
    light = {"light": "from the upper left (315 degrees), 45 degrees high"}
    return lattice, {"hillshade": shade}, Meaning(nodata=0, tags=light)


def _ortho(run: RunView) -> Raster:
    """Grey values, or red, green and blue if the images have colours."""
    tiles = tiles_of(run)
    lattice = whole(tiles, "ortho")[0]
    merged = {name: whole(tiles, name)[1] for name in ("ortho", "elevation", "source")}
    if not colour.coloured(run, merged["source"]):
        return lattice, {"ortho": merged["ortho"]}, Meaning()
    bands = np.moveaxis(colour.ortho(run, lattice, merged), 2, 0)
    return lattice, dict(zip(("red", "green", "blue"), bands, strict=True)), Meaning(nodata=0)


CLASSES = {"safe": "#a6d7c3", "caution": "#f0d68a", "hazard": "#c8501e", "unknown (never entered)": "#8d8f98"}
"""Names and colours of the classes 0, 1, 2 and 3, distinct for colour-blind eyes; printed in grey, traversable cells
are light, hazards dark, unknown ones medium."""


def _risk(run: RunView) -> Raster:
    """The class of each cell as a byte, with colours; names are in a file beside it."""
    lattice, risk = _hazards(run)
    tags = {"classes": ", ".join(f"{k} {name}" for k, name in enumerate(CLASSES))} | _vehicle(risk)
    # No nodata: class 3, unknown, is shown and counted like the others.
    meaning = Meaning(nodata=None, tags=tags, colours=list(CLASSES.values()))
    return lattice, {"class": np.asarray(risk["risk"], np.uint8)}, meaning


def _write_class_names(path: Path, run: RunView) -> None:
    # GeoTIFF has no names of classes: GDAL reads them from this file beside it (PAM).
    names = "".join(f"<Category>{name}</Category>" for name in CLASSES)
    text = f'<PAMDataset><PAMRasterBand band="1"><CategoryNames>{names}</CategoryNames></PAMRasterBand></PAMDataset>'
    atomic.write(path, text)


def _reasons(run: RunView) -> Raster:
    lattice, risk = _hazards(run)
    bands = {name: np.asarray(risk[name], np.uint16) for name in ("reason", "filled")}
    tags = {"reason_bits": ", ".join(f"{bit} {name}" for name, bit in REASONS.items())}
    return lattice, bands, Meaning(nodata=None, tags=tags)


def _hazard(run: RunView) -> Raster:
    """The probability of a hazard and the measures, in metres and degrees."""
    lattice, risk = _hazards(run)
    bands, units = {"p_hazard": risk["p_hazard"]}, {"p_hazard": ""}
    for a in risk_stage.outputs:
        if a.unit in ("m", "rad") and a.name != "elevation":
            bands[a.name] = np.degrees(risk[a.name]) if a.unit == "rad" else risk[a.name]
            units[a.name] = "degree" if a.unit == "rad" else a.unit
    # Keep 11 binary digits for compression: 0.02 %, finer than any measure is known.
    bits = BitRound(11)
    given = {name: bits.encode(np.asarray(v, np.float32)).view(np.float32) for name, v in bands.items()}
    return lattice, given, Meaning(units, tags=_vehicle(risk))


def _hazards(run: RunView) -> tuple[Lattice, Bundle]:
    risk = artifact(run, run.products.world_risk)
    return Lattice.from_dict(risk.meta["lattice"]), risk


def _vehicle(risk: Bundle) -> dict[str, str]:
    return {"vehicle": json.dumps(risk.meta["vehicle"])}


TERRAIN = (RUN.products.world_tiles,)
"""The merged terrain, as a whole: failed tiles must not look like unknown terrain."""

RISK = (RUN.products.world_risk,)


def _raster(
    name: str, what: str, make: Callable[[RunView], Raster], needs: Names = TERRAIN, reads: Names = ()
) -> Output:
    """Row of a raster."""

    def write(path: Path, run: RunView) -> None:
        lattice, bands, meaning = make(run)
        cells = {name: v.astype(np.float32) if v.dtype.kind == "f" else v for name, v in bands.items()}
        write_raster(path, cells, lattice, meaning, run.sequence.georeference)

    return Output(name, what, GIS, write, "world", needs, (RUN.sequence.georeference, *reads))


OUTPUTS = (
    _raster("dem.tif", "merged elevation, m, NaN undefined", _dem),
    _raster("dem_sigma.tif", "standard deviation of the elevation, m", _sigma),
    _raster("slope.tif", "inclination of the terrain, degrees", _slope),
    _raster("hillshade.tif", "shaded relief of the terrain", _hillshade),
    _raster(
        "ortho.tif",
        "merged ortho image, grey 0..255, or red, green and blue where the images have colours",
        _ortho,
        reads=colour.READS,
    ),
    _raster("risk.tif", "risk map: class 0 safe, 1 caution, 2 hazard, 3 unknown, with colours", _risk, RISK),
    Output("risk.tif.aux.xml", "names of the classes of risk.tif", GIS, _write_class_names, needs=RISK),
    _raster("hazard.tif", "probability of a hazard, and the measures in metres and degrees", _hazard, RISK),
    _raster("reason.tif", "bits of the limits that a cell breaks; whether it was filled", _reasons, RISK),
)
STAGE = stage("output.rasters", "Rasters of the terrain and its hazards", OUTPUTS)
