"""``rille compare-dem A B``: figures and a raster of the differences of one elevation model from a reference."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
from rille.stages.evaluation import dem_comparison as evaluation
from rille.stages.evaluation.place import register
from rille.stages.geometry.geometry import from_above, rotation_log
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
        rasters["standard_deviation"], figures["changes"] = changed(one, other, error, cells)
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
    """Figures (JSON-able) of A against the reference B, errors, m, on the common cells (rows, cols), and B on them.

    Raises
    ------
    InputError
        There is no common known cell.
    DegenerateError
        The terrain does not determine the alignment.
    """
    on_a, on_b, how = evaluation.common(a.grid, b.grid)
    missing_crs = [warning("RIL-694", f"{r.name} states no CRS: taken as the other's") for r in (a, b) if not r.crs]
    figures: dict[str, Any] = {
        "a": _about(a),
        "b": _about(b),
        "error": "A minus B, m",
        "resampling": how,
        "warnings": [*missing_crs, *a.warnings, *b.warnings],
    }
    pose = None
    if align != "none":
        figures["before_alignment"] = evaluation.figures(evaluation.errors(on_a, on_b))
        alignment = evaluation.align(on_a, on_b, align)  # type: ignore[arg-type]
        figures["alignment"], pose = _alignment(alignment, align), alignment.pose
    error = evaluation.errors(on_a, on_b, pose)
    figures["figures"] = evaluation.figures(error)
    if not np.isfinite(error).any():
        text = "no cell is left that both know"
        raise InputError("RIL-617", text, remedy="leave --align out, or compare other models")
    figures["completeness"] = _completeness(error, on_b, a)
    slope = np.degrees(np.arctan(np.hypot(*on_b.slopes())))
    edges = np.array([0.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0])
    figures["by_slope"] = {"unit": "degrees of B", "bins": evaluation.binned(error, slope, edges)}
    figures["by_range"] = _by_range(error, on_b, a, b)
    return figures, error, on_b


def changed(a: DemFile, b: DemFile, error: Floats, grid: Grid) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Standard deviation of the ``error`` of :func:`measure` on a grid, and list (JSON-able) of the changes."""
    sigma = [np.zeros(error.shape) if one.sigma is None else one.grid.at(grid.centres(), one.sigma) for one in (a, b)]
    deviation = dem_changes.standard_deviation(error, np.hypot(*sigma), np.hypot(*grid.slopes()), grid.cell)
    found = dem_changes.changes(error, deviation, grid)
    total = {}
    for way, sign in (("rose", 1), ("fell", -1)):
        of = [one for one in found if sign * one.volume_m3 > 0]
        sigma_m3 = math.hypot(*(one.sigma_m3 for one in of))
        total[way] = {"volume_m3": sum(one.volume_m3 for one in of), "sigma_m3": sigma_m3}
    how = (
        f"patches of cells that differ one way by {dem_changes.BESIDE:g} standard deviations, one of them by "
        f"{dem_changes.SURE:g}, their volume by {dem_changes.SURE_VOLUME:g} of its own; standard deviations of both "
        f"models and of a shift by {dem_changes.SHIFT_CELLS:g} cells, scaled up where most differences spread more"
    )
    return deviation.astype(np.float32), {"total": total, "patches": [asdict(one) for one in found], "how": how}


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


def _alignment(alignment: evaluation.Alignment, kind: str) -> dict[str, Any]:
    names = ("x_m", "y_m", "z_m", "about_x_deg", "about_y_deg", "about_z_deg")
    start = alignment.pose.inverse().apply(alignment.centre)
    values = [*(alignment.centre - start), *np.degrees(rotation_log(alignment.pose.rotation))]
    sigma = [*alignment.sigma[:3], *np.degrees(alignment.sigma[3:])]
    return {
        "kind": kind,
        "motion_of_a": {names[k]: float(values[k]) for k in evaluation.FREE[kind]},
        "sigma": {names[k]: float(sigma[k]) for k in evaluation.FREE[kind]},
        "centre_m": start.tolist(),
        "how": "x_b = R (x_a - centre) + centre + t; least squares of the elevation differences, Tukey's biweight",
        "iterations": alignment.rounds,
        "points": alignment.points,
    }


def _completeness(error: Floats, on_b: Grid, a: DemFile) -> dict[str, Any]:
    """Share of compared cells of B: of all, and of those whose centres lie in the outline of A."""
    compared, known, index = int(np.isfinite(error).sum()), np.isfinite(on_b.values), a.grid.index(on_b.centres())
    inside = ((index >= -0.5) & (index <= np.array(a.grid.values.shape) - 0.5)).all(axis=-1)
    within = int((known & inside).sum())
    return {
        "of_b": min(compared / known.sum(), 1.0),
        "of_b_within_a": min(compared / max(within, 1), 1.0),
        "how": f"{compared} cells compared, of {int(known.sum())} that B knows, {within} of these "
        "within the outline of A",
    }


def _by_range(error: Floats, target: Grid, a: DemFile, b: DemFile) -> dict[str, Any]:
    """Errors by the horizontal distance from the nearest camera; no bins if no camera is known."""
    cameras = a.viewpoints if a.viewpoints is not None else b.viewpoints
    unit = "m, from the nearest position of the left camera"
    if cameras is None and crs_name(ENGINEERING_CRS) in (crs_name(a.crs), crs_name(b.crs)):
        cameras, unit = np.zeros((1, 2)), "m, from the frame's origin (the first left camera)"
    if cameras is None or not len(cameras):
        return {"unit": "no camera is known: give the folder of a run for A or B", "bins": []}
    distance = np.asarray(cKDTree(cameras).query(target.centres())[0], np.float64)
    far = float(np.nanmax(np.where(np.isfinite(error), distance, np.nan)))
    # Bins are open at their upper end: 1e-9 more, so that the last one holds the farthest cell.
    return {"unit": unit, "bins": evaluation.binned(error, distance, np.linspace(0.0, far * (1.0 + 1e-9), 9))}


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
