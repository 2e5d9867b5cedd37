"""Stage ``mockup.overview``: a coarse elevation model of the whole bed, as from an orbiter's camera."""

from __future__ import annotations

import math

import numpy as np

from rille.datasets.mockup.facts import ElevationFacts, SceneFacts
from rille.datasets.mockup.rover import RoverParams
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.geometry.lattice import Lattice


@stage(
    "mockup.overview",
    outputs=[Array("elevation", ("row", "col"), "float32", "m", "mean elevation of the cell", "nan", "bed")],
)
def overview_stage(params: RoverParams, scene: Bundle[SceneFacts], *, cell: float) -> Bundle[ElevationFacts]:
    """A coarse elevation model of the whole simulated bed."""
    at, z = scene.meta["lattice"], np.asarray(scene["height"], dtype=np.float64)
    n = max(1, round(cell / at["cell"]))
    # Cells at multiples of their size that lie wholly within the bed.
    i0, j0 = math.ceil(at["x0"] / cell + 0.5), math.floor(at["y0"] / cell - 0.5)
    cols = math.floor((at["x0"] + at["cell"] * (at["cols"] - 1)) / cell - 0.5) - i0 + 1
    rows = j0 - math.ceil((at["y0"] - at["cell"] * (at["rows"] - 1)) / cell + 0.5) + 1
    lattice = Lattice.at(i0, j0, cell, rows, cols)
    row, col = (
        np.round(far / at["cell"] - 0.5 * (n - 1)).astype(int)
        for far in (at["y0"] - lattice.ys(), lattice.xs() - at["x0"])
    )
    out = np.lib.stride_tricks.sliding_window_view(z, (n, n))[np.ix_(row, col)].mean(axis=(2, 3))
    # The map's elevations err by 2 mm.
    out += 0.002 * np.random.default_rng([params.seed, 72]).standard_normal(out.shape)
    return Bundle({"elevation": out.astype(np.float32)}, {"lattice": lattice.to_dict(), "frame": "bed"})
