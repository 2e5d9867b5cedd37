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
from rille.pipeline.export.output import Output, Writer, stage
from rille.pipeline.export.view import Reads, RunView, there
from rille.pipeline.export.writers import ON_PLANE, Meaning, write_raster
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice, mosaic, union
from rille.stages.hazard.risk import REASONS, risk_stage
from rille.stages.terrain import merge
from rille.stages.terrain.shading import hillshade, slope_deg

GIS = "QGIS, GDAL"

NODATA = {array.name: float(array.nodata or 0) for array in merge.merge_stage.outputs}
"""Of the arrays of merged terrain."""


def whole(tiles: Sequence[Bundle], name: str) -> tuple[Lattice, NDArray[Any]]:
    """One array of all world tiles put together, and the union of their lattices, which it is on."""
    lattices = [Lattice.from_dict(tile.meta["lattice"]) for tile in tiles]
    target = union(lattices)
    parts = [(part, np.asarray(tile[name])) for part, tile in zip(lattices, tiles, strict=True)]
    return target, mosaic(parts, NODATA[name], target)


def tiles_of(run: RunView) -> list[Bundle]:
    """World tiles of the merged terrain."""
    return [there(run, tile) for tile in run.products.world_tiles]


Raster = tuple[Lattice, NDArray[Any]]


def _height(run: RunView) -> Raster:
    """Elevations, or heights where the sequence has a place, m."""
    (lattice, elevation), place = whole(tiles_of(run), "elevation"), run.sequence.georeference
    return lattice, elevation if place is None else elevation.astype(np.float64) + place.origin[2]


def _slope(run: RunView) -> Raster:
    lattice, elevation = whole(tiles_of(run), "elevation")
    return lattice, slope_deg(elevation, lattice.cell)


def _sigma(run: RunView) -> Raster:
    return whole(tiles_of(run), "elevation_std")


def _raster(band: str, unit: str, values: Callable[[RunView], Raster]) -> Writer:
    """Writer of a raster of one band: ``values`` gives its lattice and its values."""

    def write(path: Path, run: RunView) -> None:
        lattice, cells = values(run)
        meaning = Meaning(unit, tags=above(tiles_of(run)))
        write_raster(path, {band: np.asarray(cells, np.float32)}, lattice, meaning, run.sequence.georeference)

    return write


def above(tiles: Sequence[Bundle]) -> dict[str, str]:
    """The frame of merged terrain in words, where its elevations are distances from a plane that is no ground."""
    return {"frame": ON_PLANE} if any("reference" in tile.meta for tile in tiles) else {}


def _write_hillshade(path: Path, run: RunView) -> None:
    (lattice, elevation), place = whole(tiles_of(run), "elevation"), run.sequence.georeference
    # The raster is turned by the azimuth where it has a place: there the light has to come from the map's upper left.
    bands = {"hillshade": hillshade(elevation, lattice.cell, 0.0 if place is None else place.azimuth)}
    light = {"light": "from the upper left (315 degrees), 45 degrees high"}
    write_raster(path, bands, lattice, Meaning(nodata=0, tags=light), place)


def write_ortho(path: Path, run: RunView) -> None:
    """Write grey values as they are, or red, green and blue where the images of ``run`` have colours."""
    tiles, place = tiles_of(run), run.sequence.georeference
    merged = {name: whole(tiles, name)[1] for name in ("ortho", "elevation", "source")}
    lattice = whole(tiles, "ortho")[0]
    if not colour.coloured(run, merged["source"]):
        write_raster(path, {"ortho": np.asarray(merged["ortho"], np.float32)}, lattice, Meaning(), place)
        return
    bands = dict(zip(("red", "green", "blue"), np.moveaxis(colour.ortho(run, lattice, merged), 2, 0), strict=True))
    write_raster(path, bands, lattice, Meaning(nodata=0), place)


CLASSES = {"safe": "#a6d7c3", "caution": "#f0d68a", "hazard": "#c8501e", "unknown (never entered)": "#8d8f98"}
"""Names and colours of the classes 0, 1, 2 and 3, distinct for colour-blind eyes; in grey, what may be driven on is
light, hazards dark, unknown medium."""


def _write_cells(path: Path, run: RunView, bands: Mapping[str, NDArray[Any]], meaning: Meaning) -> None:
    """Write bands on the lattice of the risk map."""
    lattice = Lattice.from_dict(there(run, run.products.world_risk).meta["lattice"])
    write_raster(path, bands, lattice, meaning, run.sequence.georeference)


def _write_risk(path: Path, run: RunView) -> None:
    """Write the class of each cell as a byte, with its colour and, beside it, its name."""
    risk = there(run, run.products.world_risk)
    tags = {"classes": ", ".join(f"{k} {name}" for k, name in enumerate(CLASSES))} | _vehicle(risk)
    # No nodata: class 3, unknown, is to be seen and counted like the others.
    meaning = Meaning(nodata=None, tags=tags, colours=list(CLASSES.values()))
    _write_cells(path, run, {"class": np.asarray(risk["risk"], np.uint8)}, meaning)


def _write_class_names(path: Path, run: RunView) -> None:
    # GeoTIFF has no names of classes: GDAL reads them from this file beside it (PAM).
    names = "".join(f"<Category>{name}</Category>" for name in CLASSES)
    text = f'<PAMDataset><PAMRasterBand band="1"><CategoryNames>{names}</CategoryNames></PAMRasterBand></PAMDataset>'
    atomic.write(path, text)


def _write_reasons(path: Path, run: RunView) -> None:
    risk = there(run, run.products.world_risk)
    bands = {name: np.asarray(risk[name], np.uint16) for name in ("reason", "filled")}
    tags = {"reason_bits": ", ".join(f"{bit} {name}" for name, bit in REASONS.items())}
    _write_cells(path, run, bands, Meaning(nodata=None, tags=tags))


def _write_hazard(path: Path, run: RunView) -> None:
    """Write the probability of a hazard and the measures, in metres and degrees."""
    risk = there(run, run.products.world_risk)
    bands, units = {"p_hazard": risk["p_hazard"]}, {"p_hazard": ""}
    for a in risk_stage.outputs:
        if a.unit in ("m", "rad") and a.name != "elevation":
            bands[a.name] = np.degrees(risk[a.name]) if a.unit == "rad" else risk[a.name]
            units[a.name] = "degree" if a.unit == "rad" else a.unit
    # Binary digits that are kept, so that measures pack well: 0.02 %, finer than any is known
    bits = BitRound(11)
    given = {name: bits.encode(np.asarray(v, np.float32)).view(np.float32) for name, v in bands.items()}
    _write_cells(path, run, given, Meaning(units, tags=_vehicle(risk)))


def _vehicle(risk: Bundle) -> dict[str, str]:
    return {"vehicle": json.dumps(risk.meta.get("vehicle", {}))}


def _of_terrain(name: str, what: str, write: Writer, reads: Reads = lambda _: ()) -> Output:
    """Row of a raster of the merged terrain: a hole in the run must not look like unknown terrain."""
    return Output(
        name,
        what,
        GIS,
        write,
        "world",
        lambda run: (run.products.world_tiles,),
        lambda run: (run.sequence.georeference, *reads(run)),
    )


def _of_risk(name: str, what: str, write: Writer, frame: str = "world") -> Output:
    """Row of a raster of the hazards."""
    needs, reads = lambda run: (run.products.world_risk,), lambda run: (run.sequence.georeference,)
    return Output(name, what, GIS, write, frame, needs, reads)


OUTPUTS = (
    _of_terrain("dem.tif", "merged elevation, m, NaN undefined", _raster("elevation", "m", _height)),
    _of_terrain("dem_sigma.tif", "standard deviation of the elevation, m", _raster("elevation_std", "m", _sigma)),
    _of_terrain("slope.tif", "inclination of the terrain, degrees", _raster("slope", "degree", _slope)),
    _of_terrain("hillshade.tif", "shaded relief of the terrain", _write_hillshade),
    _of_terrain(
        "ortho.tif",
        "merged ortho image, grey 0..255, or red, green and blue where the images have colours",
        write_ortho,
        colour.reads,
    ),
    _of_risk("risk.tif", "risk map: class 0 safe, 1 caution, 2 hazard, 3 unknown, with colours", _write_risk),
    _of_risk("risk.tif.aux.xml", "names of the classes of risk.tif", _write_class_names, frame=""),
    _of_risk("hazard.tif", "probability of a hazard, and the measures in metres and degrees", _write_hazard),
    _of_risk("reason.tif", "bits of the limits that a cell breaks; whether it was filled", _write_reasons),
)
STAGE = stage("output.rasters", "Rasters of the terrain and its hazards", OUTPUTS)
