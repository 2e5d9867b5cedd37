"""Source: an array from a seed, with a NaN in it."""

import numpy as np
from pydantic import Field

from rille.stages.core.declare import Array, Bundle, Params, Stage


class NumbersParams(Params):
    """Parameters of the source: ``seed`` of the generator, and ``size``, the edge, pixels."""

    seed: int = Field(0, ge=0)
    size: int = Field(40, ge=1)


def _run(params, args, inputs):
    rng = np.random.default_rng([params.seed, args["frame"]])
    values = rng.normal(size=(params.size, params.size)).astype(np.float32)
    values[0, 0] = np.nan
    return Bundle({"values": values, "mask": (values > 0).astype(np.uint8)}, {"frame": args["frame"], "mean": 0.5})


STAGE = Stage(
    name="numbers",
    summary="random numbers",
    params=NumbersParams,
    inputs=(),
    outputs=(
        Array("values", ("row", "col"), "float32", "m", "values", nodata="nan"),
        Array("mask", ("row", "col"), "uint8", "1", "positive"),
    ),
    run=_run,
)
