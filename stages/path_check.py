"""A planned path against the risk map of the exact elevations: does it cross what is truly hazardous?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.accuracy_parts import Metric, metric
from stages.declare import Array, Bundle, Inputs, NoParams, Stage
from stages.lattice import Lattice
from stages.risk import HAZARDOUS, UNKNOWN

Floats = NDArray[np.float64]


def crossed_cells(path: Floats, lattice: Lattice) -> NDArray[np.int64]:
    """Cells (n, 2) row, column, each once, that a polyline (vertex, x y ...), metres, passes; it may leave the lattice.

    The line is sampled at a quarter of a cell, so that it cannot pass more than a cell's corner unseen.
    """
    points = [path[:1, :2]]
    for a, b in zip(path[:-1, :2], path[1:, :2], strict=True):
        n = max(1, int(np.ceil(4.0 * np.hypot(*(b - a)) / lattice.cell)))
        points.append(a + (b - a) * (np.arange(1, n + 1) / n)[:, None])
    cells = np.rint(lattice.index(np.concatenate(points))).astype(np.int64)
    return np.unique(cells, axis=0)


def path_check(path: Floats, risk: NDArray[np.uint8], lattice: Lattice) -> tuple[NDArray[np.int64], dict[str, Metric]]:
    """Crossed hazardous cells (n, 2) row, column, and metrics by name.

    Parameters
    ----------
    path : (vertex, xyz) float64, metres, in the frame of the lattice; empty where no path was found.
    risk : (row, col) classes from the exact elevations, on ``lattice``.
    """
    truth = "in the risk map of the exact elevations, same vehicle"
    share = metric(float((risk == HAZARDOUS).mean()), "1", f"hazardous share of all cells {truth}")
    if len(path) == 0:
        names = {"hazard_cells": "cells", "unknown_cells": "cells", "crossed_cells": "cells", "path_length": "m"}
        none = {name: metric(None, unit, "not applicable: no path was found") for name, unit in names.items()}
        return np.empty((0, 2), dtype=np.int64), none | {"hazardous_share": share}
    cells = crossed_cells(path, lattice)
    inside = ((cells >= 0) & (cells < lattice.shape)).all(axis=1)
    kinds = np.full(len(cells), UNKNOWN, dtype=np.uint8)
    kinds[inside] = risk[cells[inside, 0], cells[inside, 1]]
    hit = cells[kinds == HAZARDOUS]
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    return hit, {
        "hazard_cells": metric(len(hit), "cells", f"crossed cells that are hazardous {truth}"),
        "unknown_cells": metric(int((kinds == UNKNOWN).sum()), "cells", f"crossed cells that are unknown {truth}"),
        "crossed_cells": metric(len(cells), "cells", "cells that the path crosses"),
        "path_length": metric(length, "m", "length of the path, climbs included"),
        "hazardous_share": share,
    }


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    path, risk = inputs["path"], inputs["risk"]
    lattice = Lattice.from_dict(risk.meta["lattice"])
    hit, metrics = path_check(np.asarray(path["path"]), np.asarray(risk["risk"]), lattice)
    return Bundle({"hazard_cell": hit.astype(np.int32)}, {"metrics": metrics})


STAGE = Stage(
    name="path_check",
    version=1,
    summary="planned path against the risk map of the exact elevations",
    params=NoParams,
    inputs=("path", "risk"),
    outputs=(Array("hazard_cell", ("cell", "rowcol"), "int32", "1", "crossed cells that are truly hazardous"),),
    requires=("numpy",),
    run=_run,
)
