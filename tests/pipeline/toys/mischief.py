"""Fails, dies, sleeps or answers at random, as its arguments say."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, Stage
from rille.stages.core.errors import DegenerateError


class UnpicklableError(Exception):
    """Its arguments are not those of its constructor."""

    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


def _run(params, args, inputs):
    what = args["what"]
    count = 0
    if "tally" in args:
        with Path(args["tally"]).open("a") as file:
            file.write("x")
        count = Path(args["tally"]).stat().st_size
    if what == "degenerate":
        raise DegenerateError("RIL-899", "no texture in frame 7", remedy="choose other frames")
    if what == "value":
        raise ValueError("negative depth")
    if what == "unpicklable":
        raise UnpicklableError(1, 2)
    if what == "disk" and count < 3:
        raise OSError(5, "Input/output error")
    if what == "missing":
        raise FileNotFoundError(2, "No such file or directory", "left/000003.png")
    if what == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "sleep":
        time.sleep(args["seconds"])
    value = time.time_ns() if what == "random" else 1
    return Bundle({"value": np.array([value], dtype=np.int64)}, {})


STAGE = Stage(
    name="mischief",
    summary="misbehaves",
    params=NoParams,
    inputs=("after?",),
    outputs=(Array("value", ("one",), "int64", "1", "value"),),
    run=_run,
)
