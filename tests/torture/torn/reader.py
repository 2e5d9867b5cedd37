"""Reads its input: the sum of what is in it."""

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, Stage


def _run(params, args, inputs):
    total = sum(np.asarray(inputs["values"][name]).sum() for name in inputs["values"].arrays)
    return Bundle({"total": np.array([total], dtype=np.float64)}, {})


STAGE = Stage(
    name="reader",
    summary="reads",
    params=NoParams,
    inputs=("values",),
    outputs=(Array("total", ("one",), "float64", "1", "sum"),),
    run=_run,
)
