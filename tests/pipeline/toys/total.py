"""Many in, one out."""

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, Stage


def _run(params, args, inputs):
    sums = np.array([np.nansum(b["level_0"], dtype=np.float64) for b in inputs["parts"]])
    return Bundle({"sums": sums}, {"count": len(sums), "extra": "extra" in inputs})


STAGE = Stage(
    name="total",
    summary="sums",
    params=NoParams,
    inputs=("parts*", "extra?"),
    outputs=(Array("sums", ("part",), "float64", "m", "sum of each part"),),
    run=_run,
)
