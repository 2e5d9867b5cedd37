"""Kills the process that runs it: while it computes, in its commit, or by its memory; the first times only.

``what`` is ``task``, ``fsync:1``, ``link:1`` ... (the process dies before that call of the commit), ``linked:1`` (after
it), ``poison`` (each time), ``memory`` (it takes more than the worker may have), ``random`` (no death, but another
result in each process, once two are there).
"""

import os
import signal
import time
from pathlib import Path

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, Stage


def _die():
    os.kill(os.getpid(), signal.SIGKILL)


def _trap(name, count, after):
    """Let the ``count``-th call of ``os.name`` be the last thing that this process does."""
    real, calls = getattr(os, name), []

    def trapped(*args, **kwargs):
        calls.append(1)
        if len(calls) < count:
            return real(*args, **kwargs)
        if after:
            real(*args, **kwargs)
        return _die()

    setattr(os, name, trapped)


def _run(params, args, inputs):
    what, tally = args["what"], Path(args["tally"])
    tally.parent.mkdir(parents=True, exist_ok=True)
    with tally.open("a") as file:
        file.write("x")
    first = tally.stat().st_size == 1
    kind, _, count = what.partition(":")
    if what == "poison" or (first and what == "task"):
        _die()
    elif what == "memory":
        hog = [np.ones(20_000_000) for _ in range(8)]
        time.sleep(60)
        del hog
    elif what == "random":
        until = time.monotonic() + 30
        while tally.stat().st_size < 2 and time.monotonic() < until:
            time.sleep(0.001)
        return Bundle({"value": np.array([float(os.getpid())])}, {"what": what})
    elif first and count:
        _trap("link" if kind == "linked" else kind, int(count), after=kind == "linked")
    return Bundle({"value": np.arange(50.0)}, {"what": what})


STAGE = Stage(
    name="saboteur",
    summary="kills its process",
    params=NoParams,
    inputs=("after?",),
    outputs=(Array("value", ("one",), "float64", "1", "value"),),
    run=_run,
)
