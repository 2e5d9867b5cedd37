"""``rille compare-dem A B``: figures, a picture and JSON of one elevation model against a reference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rille.datasets.text.warning import warning
from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.read_dem import DemFile, read_elevation
from rille.pipeline.export.writers import ENGINEERING_CRS
from rille.stages.core.errors import InputError
from rille.stages.evaluation.dem_comparison import FREE, Alignment, Grid, align, binned, common, errors, figures

Floats = NDArray[np.float64]
SLOPES_DEG = np.array([0.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0])
RANGES = 8
"""Bins of range, of equal width."""
WORDS = {"rmse": "RMSE", "nmad": "NMAD", "p95": "95 %", "bias": "bias", "median": "median"}


def compare(path_a: Path, path_b: Path, *, align: str = "none", output: Path = Path("dem_comparison")) -> int:
    """Compare A with the reference B; gives the exit code.

    Raises
    ------
    InputError
        One of them cannot be read, or they are in different systems or do not overlap.
    DegenerateError
        The alignment that was asked for is not determined.
    """
    a, b = read_elevation(path_a), read_elevation(path_b)
    check(a, b)
    for line in (*a.warnings, *b.warnings):
        warn(line)
    found, error, slope, distance = measure(a, b, align)
    _print(found)
    # Either ending is understood as the name of both files.
    target = output.with_name(output.name.removesuffix(".png").removesuffix(".json"))
    with reported("RIL-614", f"{target} cannot be written", remedy="name others with -o", kind=InputError):
        atomic.write(target.with_name(target.name + ".json"), json.dumps(found, indent=1, allow_nan=False) + "\n")
        draw(target.with_name(target.name + ".png"), found, error, slope, distance)
    print(f"{target}.png  {target}.json")
    return 0


def check(a: DemFile, b: DemFile) -> None:
    """Refuse models that are not comparable.

    Raises
    ------
    InputError
        Their CRS differ, or their outlines do not overlap.
    """
    if a.crs and b.crs and not _same_crs(a.crs, b.crs):
        raise InputError(
            "RIL-615",
            f"{a.name} is in {_crs_name(a.crs)}, {b.name} in {_crs_name(b.crs)}",
            remedy="bring one to the other's system first, e.g. with gdalwarp -t_srs",
        )
    x0, x1, y0, y1 = a.extent
    u0, u1, v0, v1 = b.extent
    if min(x1, u1) <= max(x0, u0) or min(y1, v1) <= max(y0, v0):
        raise InputError(
            "RIL-616",
            f"no overlap: A is at x {x0:.6g}..{x1:.6g}, y {y0:.6g}..{y1:.6g} m, B at x {u0:.6g}..{u1:.6g}, "
            f"y {v0:.6g}..{v1:.6g} m",
            remedy="compare models of the same place",
        )


def _same_crs(a: str, b: str) -> bool:
    from rasterio.crs import CRS

    return a == b or CRS.from_wkt(a) == CRS.from_wkt(b) or {_crs_name(a), _crs_name(b)} == {_crs_name(ENGINEERING_CRS)}


def _crs_name(wkt: str) -> str:
    return wkt.split('"')[1] if '"' in wkt else wkt


def _grid(raster: DemFile) -> Grid:
    # A raster's transform gives the corners of its cells, the comparison wants their centres.
    t = raster.transform @ Affine.translation(0.5, 0.5)
    return Grid(raster.values, np.array([[t.a, t.b, t.c], [t.d, t.e, t.f]]))


def measure(a: DemFile, b: DemFile, kind: str = "none") -> tuple[dict[str, Any], Floats, Floats, Floats | None]:
    """All figures (JSON-able); error, slope of B in degrees and range (rows, cols) of the common cells."""
    on_a, on_b, how = common(_grid(a), _grid(b))
    found: dict[str, Any] = {
        "a": _about(a),
        "b": _about(b),
        "error": "A minus B, m",
        "resampling": how,
        "warnings": _missing_crs(a, b),
    }
    alignment = None
    if kind != "none":
        found["before_alignment"] = figures(errors(on_a, on_b))
        alignment = align(on_a, on_b, kind)  # type: ignore[arg-type]
        found["alignment"] = _alignment(alignment, kind)
    error = errors(on_a, on_b, alignment)
    known, inside = np.isfinite(on_b.values), _within(on_b, a)
    found["figures"] = figures(error)
    given = int(np.isfinite(error).sum())
    if not given:
        raise InputError(
            "RIL-617", "no cell is left that both know", remedy="leave --align out, or compare other models"
        )
    found["completeness"] = {
        "of_b": min(given / known.sum(), 1.0),
        "of_b_within_a": min(given / max(int((known & inside).sum()), 1), 1.0),
        "how": f"{given} cells compared, of {int(known.sum())} that B knows, {int((known & inside).sum())} of these "
        "within the outline of A",
    }
    slope = np.degrees(np.arctan(np.hypot(*on_b.slopes())))
    found["by_slope"] = {"unit": "degrees of B", "bins": binned(error, slope, SLOPES_DEG)}
    distance = _range(on_b, a, b, found)
    if distance is not None:
        far = float(np.nanmax(np.where(np.isfinite(error), distance, np.nan)))
        # Bins are open at their upper end: a hair more keeps the farthest cell in the last one.
        edges = np.linspace(0.0, far * (1.0 + 1e-9), RANGES + 1)
        found["by_range"] |= {"bins": binned(error, distance, edges)}
    return found, error, slope, distance


def _about(raster: DemFile) -> dict[str, Any]:
    rows, cols = raster.values.shape
    return {"path": raster.name, "rows": rows, "cols": cols, "cell_m": raster.cell, "crs": _crs_name(raster.crs)}


def _missing_crs(a: DemFile, b: DemFile) -> list[str]:
    lines = [warning("RIL-694", f"{r.name} states no CRS: taken as the other's") for r in (a, b) if not r.crs]
    for line in lines:
        warn(line)
    return [*lines, *a.warnings, *b.warnings]


def _alignment(found: Alignment, kind: str) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    angles = np.degrees(Rotation.from_matrix(found.rotation).as_rotvec())
    names = ("x_m", "y_m", "z_m", "about_x_deg", "about_y_deg", "about_z_deg")
    values = [*found.translation, *angles]
    sigma = [*found.sigma[:3], *np.degrees(found.sigma[3:])]
    return {
        "kind": kind,
        "motion_of_a": {names[k]: float(values[k]) for k in FREE[kind]},
        "sigma": {names[k]: float(sigma[k]) for k in FREE[kind]},
        "centre_m": found.centre.tolist(),
        "how": "x_b = R (x_a - centre) + centre + t; least squares of the elevation differences, Tukey's biweight",
        "iterations": found.iterations,
        "points": found.points,
    }


def _within(target: Grid, a: DemFile) -> NDArray[np.bool_]:
    """Target cells (rows, cols) whose centres lie in the outline of A."""
    rows, cols = a.values.shape
    index = _grid(a).index(target.centres())
    return np.asarray(((index >= -0.5) & (index <= np.array([rows, cols]) - 0.5)).all(axis=-1))


def _range(target: Grid, a: DemFile, b: DemFile, found: dict[str, Any]) -> Floats | None:
    """Horizontal distance (rows, cols) from the nearest camera; None (and why) where no camera is known."""
    cameras = a.viewpoints if a.viewpoints is not None else b.viewpoints
    unit = "m, from the nearest position of the left camera"
    if cameras is None and ENGINEERING_CRS.split('"')[1] in (_crs_name(a.crs), _crs_name(b.crs)):
        cameras, unit = np.zeros((1, 2)), "m, from the frame's origin (the first left camera)"
    if cameras is None or not len(cameras):
        found["by_range"] = {"unit": "no camera is known: give the folder of a run for A or B", "bins": []}
        return None
    found["by_range"] = {"unit": unit}
    centres = target.centres()
    return np.asarray(cKDTree(cameras).query(centres.reshape(-1, 2))[0], np.float64).reshape(centres.shape[:2])


def _print(found: dict[str, Any]) -> None:
    print(f"A  {found['a']['path']}  {found['a']['cell_m']:g} m cells")
    print(f"B  {found['b']['path']}  {found['b']['cell_m']:g} m cells, the reference")
    print(f"cells: {found['resampling']}; errors are A minus B")
    if "alignment" in found:
        aligned = found["alignment"]
        moved = ", ".join(f"{k} {v:.6g} (sigma {aligned['sigma'][k]:.2g})" for k, v in aligned["motion_of_a"].items())
        print(f"aligned ({aligned['kind']}): A was moved by {moved}")
        print("before  " + _line(found["before_alignment"]))
    print(("after   " if "alignment" in found else "") + _line(found["figures"]))
    share = found["completeness"]
    print(f"complete {share['of_b']:.3f}; {share['of_b_within_a']:.3f} within A's outline ({share['how']})")
    for name, words in (("by_range", "range"), ("by_slope", "slope")):
        print(f"\n{words} ({found[name]['unit']})")
        for f in found[name]["bins"]:
            print(f"{f['from']:8.3g} .. {f['to']:<8.3g} {_line(f)}  {f['cells']:.0f} cells")


def _line(f: dict[str, float]) -> str:
    return "  ".join(f"{words} {1e3 * f[k]:.3g} mm" for k, words in WORDS.items() if k in f)


def draw(path: Path, found: dict[str, Any], error: Floats, slope: Floats, distance: Floats | None) -> None:
    """Picture of the errors: map, histogram, and against range and slope."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8.5))
    axes = figure.subplots(2, 2, gridspec_kw={"left": 0.07, "right": 0.97, "bottom": 0.07, "top": 0.95, "hspace": 0.25})
    f = found["figures"]
    most = 1e3 * max(f["p95"], 1e-9)
    shown = axes[0, 0].imshow(1e3 * error, cmap="RdBu_r", vmin=-most, vmax=most, interpolation="nearest")
    figure.colorbar(shown, ax=axes[0, 0], label="A - B, mm")
    axes[0, 0].set(title="error (columns and rows of the common cells)", facecolor="0.85")
    e = 1e3 * error[np.isfinite(error)]
    axes[0, 1].hist(np.clip(e, -2 * most, 2 * most), bins=121, color="0.4")
    axes[0, 1].set(title=_line(f).replace("  ", ", "), xlabel="A - B, mm (the ends hold all beyond)", ylabel="cells")
    axes[0, 1].title.set_fontsize(8)
    for axis, name, words in ((axes[1, 0], "by_range", "range, m"), (axes[1, 1], "by_slope", "slope of B, degrees")):
        bins = found[name]["bins"]
        middle = [0.5 * (k["from"] + k["to"]) for k in bins]
        for figure_name in ("rmse", "nmad", "p95"):
            axis.plot(middle, [1e3 * k[figure_name] for k in bins], "o-", label=WORDS[figure_name])
        axis.plot(middle, [1e3 * k["bias"] for k in bins], "s--", color="0.5", label="bias")
        axis.set(xlabel=words, ylabel="mm", title=f"{found[name]['unit']}" if not bins else "")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})
