"""``rille compare-dem A B``: figures and a raster of the differences of one elevation model from a reference."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from rille.pipeline.engine.plain import warn
from rille.pipeline.export import read_dem
from rille.pipeline.export.read_dem import DemFile, crs_name
from rille.pipeline.export.writers import ENGINEERING_CRS, ON_PLANE, Meaning, write_bands, write_json
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import FLAG, RUNS, Output, Runs, check_output, output_file
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError, warning
from rille.stages.core.quantities import metres
from rille.stages.evaluation import dem_changes
from rille.stages.evaluation.dem_comparison import assess
from rille.stages.evaluation.place import register
from rille.stages.geometry.geometry import from_above
from rille.stages.terrain.relief.grid import Grid

WORDS = {"rmse": "RMSE", "nmad": "NMAD", "p95": "95 %", "bias": "bias", "median": "median"}


def compare_dem(
    a: str,
    b: str,
    *,
    align: Literal["none", "shift", "tilt", "rigid", "place"] = "none",
    changes: Annotated[bool, FLAG] = False,
    output: Annotated[Path, Output] = Path("dem_comparison"),
    runs: Runs = RUNS,
) -> None:
    """Compare elevation model A with reference B: errors, completeness, error against range and slope.

    The finer one is brought to the coarser one's cells (means of the known cells inside, or bilinear between four known
    ones); only cells that both know are compared. Prints the figures; writes OUTPUT.json, and
    the differences as OUTPUT.tif.

    Parameters
    ----------
    a
        GeoTIFF, ESRI ASCII grid (.asc), or a run: its folder or name (mockup, latest).
    b
        Reference, likewise.
    align
        Move A onto B first: shift (x, y, z), tilt (z and two inclinations) or rigid (all six); the motion is printed.
        place: two runs of one place in frames of their own; found by their ortho images or their relief, then rigid.
    changes
        List what rose or fell from B to A.
    output
        Files to write, without ending.
    """
    paths = [lookup.elevation(text, runs) for text in (a, b)]
    raster, facts = output_file(output, ".tif"), output_file(output, ".json")
    check_output(raster, others={(p / "dem.tif" if p.is_dir() else p).resolve(): "a model" for p in paths})
    one, other = (read_dem.read_elevation(path) for path in paths)
    place = None
    if align == "place":
        motion, place = _placed(paths, one, other)
        one, align = moved(one, motion), "rigid"
    read_dem.refuse_unlike_systems({one.name: one.crs, other.name: other.crs})
    if one.frame and other.frame and (one.frame == ON_PLANE) != (other.frame == ON_PLANE):
        name = (one if one.frame == ON_PLANE else other).name
        raise read_dem.no_ground(name)
    figures, error, cells = measure(one, other, align)
    figures["place"] = place
    for line in figures["warnings"]:
        warn(line)
    lines = [*_lines(figures)]
    rasters = {"difference": error.astype(np.float32)}
    if changes:
        sigmas = [None if dem.sigma is None else dem.grid.at(cells.centres(), dem.sigma) for dem in (one, other)]
        deviation, figures["changes"] = dem_changes.listed(error, cells, sigmas)
        rasters["standard_deviation"] = deviation.astype(np.float32)
        lines += _change_table(figures["changes"])
    print("\n".join(lines))
    write_json(facts, figures)
    crs = (other if np.array_equal(cells.matrix, other.grid.matrix) else one).crs
    profile = {"driver": "COG", "crs": crs or None, "transform": read_dem.transform_of(cells)}
    write_bands(raster, rasters, Meaning("m", tags={"error": figures["error"]}), profile)
    print(f"{raster}  {facts}")


def _placed(paths: Sequence[Path], one: DemFile, other: DemFile) -> tuple[Floats, dict[str, Any]]:
    """Motion (2, 3) of x, y that aligns the terrain of a run with that of another, and its facts for the JSON file."""
    files = [path for path in paths if not path.is_dir()]
    if files:
        raise InputError("RIL-908", f"{files[0]} is no run: it has no ortho image", remedy="leave --align place out")
    image, reference = (read_dem.read_ortho(path / "ortho.tif")[0] for path in paths)
    placed = register((image, reference), (one.grid, other.grid))
    x, y, heading = from_above(placed.pose)
    cos, sin = math.cos(heading), math.sin(heading)
    motion = np.array([[cos, -sin, x], [sin, cos, y]])
    return motion, {"motion_of_a": motion.tolist(), "by": placed.by}


def moved(dem: DemFile, motion: Floats) -> DemFile:
    """The model in another frame, by a motion (2, 3) of x, y."""
    turn, shift, eyes = motion[:, :2], motion[:, 2], dem.viewpoints
    matrix = turn @ dem.grid.matrix + np.column_stack([np.zeros((2, 2)), shift])
    return replace(dem, grid=Grid(dem.grid.values, matrix), viewpoints=None if eyes is None else eyes @ turn.T + shift)


def measure(a: DemFile, b: DemFile, align: str = "none") -> tuple[dict[str, Any], Floats, Grid]:
    """Facts for the JSON file, errors, m, on the common cells (rows, cols), and B on them.

    Errors are those of :func:`rille.stages.evaluation.dem_comparison.assess`.
    """
    cameras = a.viewpoints if a.viewpoints is not None else b.viewpoints
    unit = "m, from the nearest position of the left camera"
    if cameras is None and crs_name(ENGINEERING_CRS) in (crs_name(a.crs), crs_name(b.crs)):
        cameras, unit = np.zeros((1, 2)), "m, from the frame's origin (the first left camera)"
    unit = "no camera is known: give the folder of a run for A or B" if cameras is None or not len(cameras) else unit
    found, error, cells = assess(a.grid, b.grid, None if align == "none" else align, cameras)  # type: ignore[arg-type]
    missing_crs = [warning("RIL-694", f"{r.name} states no CRS: taken as the other's") for r in (a, b) if not r.crs]
    binned = {
        name: {"unit": of, "bins": found[name]} for name, of in (("by_slope", "degrees of B"), ("by_range", unit))
    }
    figures = {
        "a": _about(a),
        "b": _about(b),
        "error": "A minus B, m",
        "warnings": [*missing_crs, *a.warnings, *b.warnings],
        **found,
        **binned,
    }
    return figures, error, cells


def _change_table(changes: Mapping[str, Any]) -> Iterator[str]:
    """Lines on the changes, the greatest volumes first."""
    yield ""
    for way, total in changes["total"].items():
        yield f"{way:5s} {1e6 * total['volume_m3']:.4g} +- {1e6 * total['sigma_m3']:.2g} cm3"
    shown = changes["patches"][:12]
    for row in shown:
        place = f"x {row['x_m']:.4f}, y {row['y_m']:.4f} m"
        size = f"{1e4 * row['area_m2']:.4g} cm2, {1e3 * row['greatest_m']:+.3g} mm at most"
        yield f"{place}: {size}, {1e6 * row['volume_m3']:+.4g} +- {1e6 * row['sigma_m3']:.2g} cm3"
    more = len(changes["patches"]) - len(shown)
    if more > 0:
        yield f"and {more} smaller ones, in the JSON file"


def _about(raster: DemFile) -> dict[str, Any]:
    rows, cols = raster.grid.values.shape
    return {"path": raster.name, "rows": rows, "cols": cols, "cell_m": raster.grid.cell, "crs": crs_name(raster.crs)}


def _lines(figures: Mapping[str, Any]) -> Iterator[str]:
    """Printed lines of the figures."""
    for name, word in (("a", ""), ("b", ", the reference")):
        yield f"{name.upper()}  {figures[name]['path']}  {figures[name]['cell_m']:g} m cells{word}"
    yield f"cells: {figures['resampling']}; errors are A minus B"
    if figures["place"]:
        (cos, _, x), (sin, _, y) = figures["place"]["motion_of_a"]
        turn = math.degrees(math.atan2(sin, cos))
        yield f"place: A turned by {turn:.3f} degrees, moved by {x:.4f}, {y:.4f} m ({figures['place']['by']})"
    after = ""
    if "alignment" in figures:
        aligned, after = figures["alignment"], "after   "
        moved = ", ".join(f"{k} {v:.6g} (sigma {aligned['sigma'][k]:.2g})" for k, v in aligned["motion_of_a"].items())
        yield f"aligned ({aligned['kind']}): A was moved by {moved}"
        yield f"before  {_line(figures['before_alignment'])}"
    yield after + _line(figures["figures"])
    share = figures["completeness"]
    yield f"complete {share['of_b']:.3f}; {share['of_b_within_a']:.3f} within A's outline ({share['how']})"
    for name, words in (("by_range", "range"), ("by_slope", "slope")):
        yield f"\n{words} ({figures[name]['unit']})"
        for f in figures[name]["bins"]:
            yield f"{f['from']:8.3g} .. {f['to']:<8.3g} {_line(f)}  {f['cells']:.0f} cells"


def _line(f: dict[str, float]) -> str:
    return "  ".join(f"{words} {metres(f[k])}" for k, words in WORDS.items() if k in f)
