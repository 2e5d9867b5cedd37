"""Takes memory for a while."""

import time

import numpy as np

from rille.stages.core.declare import Array, Bundle, Memory, NoParams, Stage


def _run(params, args, inputs):
    array = np.ones(args["bytes"], dtype=np.uint8)
    time.sleep(args.get("seconds", 0.0))
    return Bundle({"value": np.array([int(array[-1]) + args["i"]])}, {})


STAGE = Stage(
    name="hog",
    summary="takes memory",
    params=NoParams,
    inputs=("after?",),
    outputs=(Array("value", ("one",), "int64", "1", "value"),),
    run=_run,
    memory=Memory(fixed=1e6, factor=1.0, lower=("hog.bytes",), size=lambda params, args, metas: args["bytes"]),
)
