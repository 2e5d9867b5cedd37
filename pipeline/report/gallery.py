"""List of a report's figures: a task each, with what it reads of a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rille.pipeline.export import colour
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RUN, Names, RunView
from rille.pipeline.report import canvas, figures, gather, strips, tables, terrain_map
from rille.pipeline.report.canvas import FIGURE, Block, Figure, spread
from rille.pipeline.report.figures import Curve, Plot
from rille.pipeline.report.gather import Scene
from rille.stages.core.errors import RilleError

Maker = Callable[[Scene], Block | None]


def _trajectory(scene: Scene) -> Block | None:
    """Top view, and what is off along the path; None for fewer than two poses."""
    track, other, view = scene.track, scene.comparison, scene.view
    if int(track.in_world.sum()) < 2:
        return None
    tracks, along = [Curve("left camera", canvas.ESTIMATE, track.left)], [Curve("σ", canvas.INK, track.sigma)]
    flagged, plots = np.zeros(len(view.frames), dtype=bool), []
    if track.truth is not None and track.error is not None:
        tracks.insert(0, Curve("truth", canvas.REFERENCE, track.truth))
        along.append(Curve("error", canvas.ESTIMATE, track.error))
    if other is not None and other.registered.any():
        tracks.insert(-1, Curve("COLMAP", canvas.OTHER, other.poses[:, :, 3]))
        if np.isfinite(other.error_crosscheck).any():
            along.append(Curve("COLMAP's error", canvas.OTHER, other.error_crosscheck))
        apart, turned = (Curve("disagreement", canvas.INK, v) for v in (other.distance, np.degrees(other.angle)))
        flagged, limits = other.flagged, other.meta.get("limits") or {}
        plots.append(Plot("from COLMAP", (apart,), limits.get("distance"), metres=True))
        plots.append(Plot("rotation, °", (turned,), limits.get("angle")))
    plots.insert(0, Plot("position", tuple(along), metres=True))
    alt = f"Along the path: {', '.join(f'{c.name} {spread(c.values)} m' for c in along)}"
    above = f"Positions from above: {', '.join(c.name for c in tracks)}"
    marked = gather.frames_of(view, flagged)
    return Block(
        (
            figures.trajectory(tracks, track.left[flagged], above),
            figures.curves(view.frames, plots, "frame", alt, marked=marked),
        )
    )


CURVES_OF_PAIRS = (
    ("share, %", "matched pixels", "matched", canvas.OTHER),
    ("share, %", "cells with an elevation", "defined", canvas.ESTIMATE),
    ("share, %", "overlap with the pair before", "overlap", canvas.INK),
    ("share, %", "completeness against truth", "completeness", canvas.REFERENCE),
    ("elevation", "σ", "sigma_m", canvas.INK),
    ("elevation", "RMS against truth", "rmse_m", canvas.REFERENCE),
    ("elevation", "above the model before", "difference_m", canvas.ESTIMATE),
    ("elevation", "deviation from it", "difference_deviation_m", canvas.OTHER),
)
"""Label of the axis, name of the curve, key of a row of :func:`rille.pipeline.report.tables.pairs`, colour."""


def _pairs(scene: Scene) -> Block | None:
    """How much each basic pair gave, and how far its elevations may be off."""
    rows, plots = tables.pairs(scene), []
    for axis in dict.fromkeys(axis for axis, *_ in CURVES_OF_PAIRS):
        factor = 100.0 if axis == "share, %" else 1.0
        curves = [
            Curve(name, color, factor * np.array([row[key] for row in rows], dtype=np.float64))
            for of, name, key, color in CURVES_OF_PAIRS
            if of == axis and any(row[key] is not None for row in rows)
        ]
        plots += [Plot(axis, tuple(curves), metres=axis == "elevation")] if curves else []
    if len(rows) < 2 or not plots:
        return None
    alt = "; ".join(f"{curve.name} {spread(curve.values)}" for plot in plots for curve in plot.curves)
    return Block((figures.curves([row["frame"] for row in rows], plots, "basic pair", alt),))


def _rig(scene: Scene) -> Block | None:
    """Epipolar residuals over the left image under the given and the used rig."""
    calibration, left = scene.calibration, scene.view.sequence.rig.left
    if calibration is None or not len(calibration.before):
        return None
    bound = max(0.3, canvas.limits(np.abs(calibration.before), 0, 99)[1])
    panels = []
    for name, values in (("given", calibration.before), ("used", calibration.after))[: 1 + calibration.changed]:
        label, alt = f"distance from epipolar line, px: {name} rig", f"Residuals, {name} rig: {spread(values)} px"
        cells = figures.medians(calibration.points, values, (left.width, left.height))
        panels.append(figures.raster(cells, label, alt, bound=bound))
    return Block(tuple(panels))


def _elevation_error(scene: Scene) -> Block | None:
    """Merged elevation minus the exact one, by cell."""
    error = gather.terrain(scene.view.bundle(scene.view.products.dem_accuracy), "error")
    if error is None:
        return None
    factor, unit = figures.metres_or_mm(error.arrays["error"])
    values = error.arrays["error"] * factor
    alt, bound = f"Elevation minus truth, {spread(values)} {unit}", canvas.limits(np.abs(values), 0, 97)[1]
    label = f"elevation minus truth, {unit}"
    return Block((figures.raster(values, label, alt, extent=error.lattice.bounds, bound=bound),))


def draw(title: str, maker: Maker, view: RunView) -> Figure:
    """Draw a figure of the page; none where the run does not have what it shows."""
    try:
        return Figure(title, maker(Scene(view)))
    except (OSError, MemoryError, RilleError):  # not the figure's own fault: another try may draw it
        raise
    except Exception as error:  # a figure must not cost the run its report; the failure is shown in it
        return Figure(title, why=f"drawing failed, {type(error).__name__}: {error}")


def _drawing(title: str, maker: Maker, reads: Names) -> Output:
    """Row of a figure: a part of the page, kept as JSON."""

    def write(path: Path, run: RunView) -> None:
        path.write_bytes(FIGURE.dump_json(draw(title, maker, run)))

    return Output(title, "", "", write, reads=reads)


P = RUN.products
OF_MAP = (
    *(P.world_tiles, P.world_risk, P.world_path, P.drive, P.disparity, P.accuracy, RUN.config.vehicle),
    *colour.READS,
)
OF_STOPS = (P.disparity, P.images, P.local_dem, P.local_risk, P.local_path, RUN.sequence.rig)

OUTPUTS = (
    _drawing("Map", terrain_map.block, OF_MAP),
    _drawing("Drive", strips.drive, (P.drive, P.images, P.trajectory, P.accuracy)),
    _drawing("Stops", strips.pairs, OF_STOPS),
    _drawing("Rig", _rig, (P.rigs, P.orientations, RUN.sequence.rig)),
    _drawing("Trajectory", _trajectory, (P.trajectory, P.agreement, P.accuracy, P.crosscheck_accuracy)),
    _drawing("Pairs", _pairs, tables.OF_PAIRS),
    _drawing("Elevation error", _elevation_error, (P.dem_accuracy,)),
)
"""All figures of the page, each with what it reads of a run; the template places them."""
STAGE = stage("output.figures", "Figures of the report", OUTPUTS)
