"""Rasters of the merged terrain and of its hazards."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export import colour
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RunView, part
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


Tiles = Sequence[Bundle]
"""World tiles of the merged terrain."""
Place = Georeference | None


def _height(tiles: Tiles, place: Place) -> tuple[Lattice, NDArray[Any]]:
    """Elevations, or heights where the sequence has a place, m."""
    lattice, elevation = whole(tiles, "elevation")
    return lattice, elevation if place is None else elevation.astype(np.float64) + place.origin[2]


def _slope(tiles: Tiles, place: Place) -> tuple[Lattice, NDArray[Any]]:
    lattice, elevation = whole(tiles, "elevation")
    return lattice, slope_deg(elevation, lattice.cell)


def _sigma(tiles: Tiles, place: Place) -> tuple[Lattice, NDArray[Any]]:
    return whole(tiles, "elevation_std")


def _raster(
    band: str, unit: str, values: Callable[[Tiles, Place], tuple[Lattice, NDArray[Any]]]
) -> Callable[..., None]:
    """Writer of a raster of one band: ``values`` gives its lattice and its values."""

    def write(path: Path, tiles: Tiles, place: Place = None) -> None:
        lattice, cells = values(tiles, place)
        write_raster(path, {band: np.asarray(cells, np.float32)}, lattice, Meaning(unit, tags=above(tiles)), place)

    return write


def above(tiles: Tiles) -> dict[str, str]:
    """The frame of merged terrain in words, where its elevations are distances from a plane that is no ground."""
    return {"frame": ON_PLANE} if any("reference" in tile.meta for tile in tiles) else {}


def _write_hillshade(path: Path, tiles: Tiles, place: Place = None) -> None:
    lattice, elevation = whole(tiles, "elevation")
    # The raster is turned by the azimuth where it has a place: there the light has to come from the map's upper left.
    bands = {"hillshade": hillshade(elevation, lattice.cell, 0.0 if place is None else place.azimuth)}
    light = {"light": "from the upper left (315 degrees), 45 degrees high"}
    write_raster(path, bands, lattice, Meaning(nodata=0, tags=light), place)


def write_ortho(path: Path, tiles: Tiles, run: RunView, place: Place = None) -> None:
    """Write grey values as they are, or red, green and blue where the images of ``run`` have colours."""
    lattice, grey = whole(tiles, "ortho")
    source = whole(tiles, "source")[1]
    if not colour.coloured(run, source):
        write_raster(path, {"ortho": np.asarray(grey, np.float32)}, lattice, Meaning(), place)
        return
    merged = {"ortho": grey, "elevation": whole(tiles, "elevation")[1], "source": source}
    bands = dict(zip(("red", "green", "blue"), np.moveaxis(colour.ortho(run, lattice, merged), 2, 0), strict=True))
    write_raster(path, bands, lattice, Meaning(nodata=0), place)


CLASSES = {"safe": "#a6d7c3", "caution": "#f0d68a", "hazard": "#c8501e", "unknown (never entered)": "#8d8f98"}
"""Names and colours of the classes 0, 1, 2 and 3, distinct for colour-blind eyes; in grey, what may be driven on is
light, hazards dark, unknown medium."""


def _write_risk(path: Path, risk: Bundle, place: Place = None) -> None:
    """Write the class of each cell as a byte, with its colour and, beside it, its name."""
    tags = {"classes": ", ".join(f"{k} {name}" for k, name in enumerate(CLASSES))} | _vehicle(risk)
    # No nodata: class 3, unknown, is to be seen and counted like the others.
    meaning = Meaning(nodata=None, tags=tags, colours=list(CLASSES.values()))
    bands = {"class": np.asarray(risk["risk"], np.uint8)}
    write_raster(path, bands, Lattice.from_dict(risk.meta["lattice"]), meaning, place)


def _write_class_names(path: Path, risk: Bundle) -> None:
    # GeoTIFF has no names of classes: GDAL reads them from this file beside it (PAM).
    names = "".join(f"<Category>{name}</Category>" for name in CLASSES)
    text = f'<PAMDataset><PAMRasterBand band="1"><CategoryNames>{names}</CategoryNames></PAMRasterBand></PAMDataset>'
    atomic.write(path, text)


def _write_reasons(path: Path, risk: Bundle, place: Place = None) -> None:
    bands = {name: np.asarray(risk[name], np.uint16) for name in ("reason", "filled")}
    tags = {"reason_bits": ", ".join(f"{bit} {name}" for name, bit in REASONS.items())}
    write_raster(path, bands, Lattice.from_dict(risk.meta["lattice"]), Meaning(nodata=None, tags=tags), place)


def _write_hazard(path: Path, risk: Bundle, place: Place = None) -> None:
    """Write the probability of a hazard and the measures, in metres and degrees."""
    bands, units = {"p_hazard": risk["p_hazard"]}, {"p_hazard": ""}
    for a in risk_stage.outputs:
        if a.unit in ("m", "rad") and a.name != "elevation":
            bands[a.name] = np.degrees(risk[a.name]) if a.unit == "rad" else risk[a.name]
            units[a.name] = "degree" if a.unit == "rad" else a.unit
    # Significant bits of a written measure: 0.02 %, finer than any is known
    given = {name: rounded(np.asarray(values, dtype=np.float32), 12) for name, values in bands.items()}
    write_raster(path, given, Lattice.from_dict(risk.meta["lattice"]), Meaning(units, tags=_vehicle(risk)), place)


def _vehicle(risk: Bundle) -> dict[str, str]:
    return {"vehicle": json.dumps(risk.meta.get("vehicle", {}))}


def rounded(values: NDArray[np.float32], bits: int) -> NDArray[np.float32]:
    """Round float32 to this many significant bits, so that it packs well; NaN and infinity stay."""
    # Binary digits, not decimal ones: only zero bits at the end of a number pack well.
    mantissa, exponent = np.frexp(values)
    scale = np.float32(2**bits)
    return np.asarray(np.ldexp(np.rint(mantissa * scale) / scale, exponent), dtype=np.float32)


def _terrain(run: RunView) -> dict[str, Any]:
    """Merged terrain and its place: a hole in the run must not look like unknown terrain."""
    return {"tiles": run.products.world_tiles, "place": run.sequence.georeference}


def _coloured(run: RunView) -> dict[str, Any]:
    """The same, and what the colours of the images take."""
    return _terrain(run) | {"run": part(run, colour.reads)}


def _hazards(run: RunView) -> dict[str, Any]:
    return {"risk": run.products.world_risk, "place": run.sequence.georeference}


def _of_terrain(name: str, what: str, write: Callable[..., None]) -> Output:
    """Row of a raster of the merged terrain."""
    return Output(name, what, GIS, write, _terrain, "world")


def _of_risk(name: str, what: str, write: Callable[..., None]) -> Output:
    """Row of a raster of the hazards."""
    return Output(name, what, GIS, write, _hazards, "world")


OUTPUTS = (
    _of_terrain("dem.tif", "merged elevation, m, NaN undefined", _raster("elevation", "m", _height)),
    _of_terrain("dem_sigma.tif", "standard deviation of the elevation, m", _raster("elevation_std", "m", _sigma)),
    _of_terrain("slope.tif", "inclination of the terrain, degrees", _raster("slope", "degree", _slope)),
    _of_terrain("hillshade.tif", "shaded relief of the terrain", _write_hillshade),
    Output(
        "ortho.tif",
        "merged ortho image, grey 0..255, or red, green and blue where the images have colours",
        GIS,
        write_ortho,
        _coloured,
        "world",
    ),
    _of_risk("risk.tif", "risk map: class 0 safe, 1 caution, 2 hazard, 3 unknown, with colours", _write_risk),
    Output(
        "risk.tif.aux.xml",
        "names of the classes of risk.tif",
        GIS,
        _write_class_names,
        lambda run: {"risk": run.products.world_risk},
    ),
    _of_risk("hazard.tif", "probability of a hazard, and the measures in metres and degrees", _write_hazard),
    _of_risk("reason.tif", "bits of the limits that a cell breaks; whether it was filled", _write_reasons),
)
STAGE = stage("output.rasters", "Rasters of the terrain and its hazards", OUTPUTS)
