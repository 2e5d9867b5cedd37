"""A small world model: a disk of cells around its middle, heights of its own."""

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, Stage
from rille.stages.geometry.lattice import Lattice


def _run(params, args, inputs):
    lattice = Lattice.at(args["i0"], args["j0"], 0.5, 20, 20)
    rng = np.random.default_rng(args["pair"])
    maps = {
        "elevation": rng.normal(size=lattice.shape),
        "elevation_std": rng.uniform(0.1, 0.3, lattice.shape),
        "ortho": rng.uniform(0, 255, lattice.shape),
    }
    r, c = np.mgrid[:20, :20] - 9.5
    maps["elevation"][r**2 + c**2 > 81] = np.nan
    meta = {"pair": args["pair"], "lattice": lattice.to_dict(), "frame": "world"}
    return Bundle({k: v.astype(np.float32) for k, v in maps.items()}, meta)


STAGE = Stage(
    name="toy_dem",
    summary="disk",
    params=NoParams,
    inputs=(),
    outputs=tuple(Array(n, ("row", "col"), "float32", "m", n, "nan") for n in ("elevation", "elevation_std", "ortho")),
    run=_run,
)
