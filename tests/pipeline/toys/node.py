"""A node of a random graph: a sum of all that it reads and its own number, or no answer."""

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, Stage
from rille.stages.core.errors import DegenerateError


def _run(params, args, inputs):
    if args["degenerate"]:
        raise DegenerateError("RIL-899", "no answer", remedy="none")
    return Bundle({"value": np.array([args["own"] + sum(int(b["value"][0]) for b in inputs["read"])])}, {})


STAGE = Stage(
    name="node",
    summary="sums",
    params=NoParams,
    inputs=("read*",),
    outputs=(Array("value", ("one",), "int64", "1", "value"),),
    run=_run,
)
