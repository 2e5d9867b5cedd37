"""Elevation model against truth: error and completeness together, so that leaving out hard cells is no progress.

Truth is in the frame of the model, by the true pose of its camera: an error of the vertical is not part of these
errors, but is given beside them (``tilt``). Cells that both cameras see are judged.
NMAD = 1.4826 median(\\|e - median(e)\\|) is the robust standard deviation (Hoehle and Hoehle 2009,
doi:10.1016/j.isprsjprs.2009.02.003).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.core.declare import Bundle, NoParams, raster, stage
from rille.stages.core.errors import InputError
from rille.stages.evaluation.claims import claims_held
from rille.stages.evaluation.dem_comparison import figures
from rille.stages.facts.evaluation import DemAccuracyFacts, Metric, metric
from rille.stages.geometry.lattice import Lattice, mosaic

ERRORS: Mapping[str, str] = {
    "rmse": "RMS elevation error",
    "nmad": "1.4826 times the median deviation from the median error",
    "p95": "95 % of the errors are smaller",
    "bias": "mean elevation error",
}
"""Descriptions of the reported figures of :func:`rille.stages.evaluation.dem_comparison.figures`."""


def dem_accuracy(elevation: Floats32, std: Floats32, truth: Floats32, judged: Bools) -> dict[str, Metric]:
    """Metrics by name.

    Parameters
    ----------
    elevation, std, truth : (row, col) metres, NaN unknown.
    judged : (row, col) the cells that count: seen by both cameras, and in the window.
    """
    judged = judged & np.isfinite(truth)
    errors = (elevation.astype(np.float64) - truth)[judged]
    given, wanted, error = np.isfinite(errors), errors.size, figures(errors)
    how = f"{error['cells']:.0f} of {wanted} cells that both cameras see"
    return {
        **{name: metric(error.get(name), "m", f"{what}, {how}") for name, what in ERRORS.items()},
        "completeness": metric(error["cells"] / wanted if wanted else None, "1", f"share given: {how}"),
        **claims_held(np.abs(errors[given]), std[judged][given], f"of the elevation, {how}"),
    }


def in_window(lattice: Lattice, window: Sequence[float] | None) -> Bools:
    """Cells (row, col) whose centres lie in a window x_min, y_min, x_max, y_max, metres; all without one."""
    if window is None:
        return np.ones(lattice.shape, dtype=bool)
    x_min, y_min, x_max, y_max = window
    # Centres on the border count, however they are rounded.
    slack, x, y = 1e-6 * lattice.cell, lattice.xs(), lattice.ys()[:, None]
    return (x >= x_min - slack) & (x <= x_max + slack) & (y >= y_min - slack) & (y <= y_max + slack)


@stage("dem_accuracy", outputs=[raster("error", "m", "elevation minus truth")])
def dem_accuracy_stage(
    params: NoParams, dem: Sequence[Bundle], truth: Bundle, *, window: list[float] | None = None
) -> Bundle[DemAccuracyFacts]:
    """Elevation model against truth: RMSE, NMAD, 95 %, bias, completeness, and how often its sigma holds."""
    lattice = Lattice.from_dict(truth.meta["lattice"])
    parts = [(Lattice.from_dict(one.meta["lattice"]), one) for one in dem]
    if not parts:
        raise InputError("RIL-320", "no elevation model to compare with truth")
    elevation, std = (
        mosaic([(grid, np.asarray(one[name])) for grid, one in parts], np.nan, lattice)
        for name in ("elevation", "elevation_std")
    )
    true = np.asarray(truth["elevation"])
    seen, inside = np.asarray(truth["seen"]) != 0, in_window(lattice, window)
    error = (elevation - true).astype(np.float32)
    metrics = dem_accuracy(elevation, std, true, seen & inside)
    unseen = np.isfinite(elevation) & ~seen & inside
    metrics["unseen"] = metric(int(unseen.sum()), "cells", "cells given that not both cameras see")
    if "tilt_deg" in truth.meta:
        how = "between the vertical of the model and the true one; the errors of elevation are against the tilted truth"
        metrics["tilt"] = metric(float(truth.meta["tilt_deg"]), "deg", how)
    meta: DemAccuracyFacts = {"lattice": lattice.to_dict(), "window": window, "metrics": metrics}
    return Bundle({"error": error}, meta)
