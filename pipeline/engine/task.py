"""The one body of every task: look up, and if absent compute, check, commit.

Between tasks only :class:`~rille.pipeline.engine.store.manifest.Ref` travel.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rille.pipeline.engine.graph import Took
from rille.pipeline.engine.runtime.kernels import COMPILING
from rille.pipeline.engine.spec import Refs, Spec, key_of, map_ports, recipe
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.manifest import Ref
from rille.stages.core.declare import check_outputs
from rille.stages.core.errors import RilleError

PAUSES_SECONDS = 0.2, 0.8
"""Before the second try, and before the third."""

PERMANENT = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


def code_changed() -> RilleError:
    """The error of a task whose key is another one on the worker."""
    text = "source code or packages of the worker are not those the run began with"
    return RilleError("RIL-581", text, remedy="run again, and edit nothing meanwhile")


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: its artifact, whether it was cached, and what it took."""

    ref: Ref
    cached: bool
    took: Took


def ensure(root: Path | str, spec: Spec, refs: Refs, *, key: str | None = None, force: bool = False) -> Outcome:
    """Give the artifact of a task, computing and committing it where it is absent (or ``force`` is set).

    ``key`` is what the client expects; a worker that would compute another thing refuses. Failures of input and
    output (``OSError``) are tried three times; what a stage raises otherwise is not tried again.
    """
    begin, started = time.perf_counter(), time.time()
    # Computed here as well, from this process's own source files: the client's may be newer.
    own = key_of(spec, refs)
    if key is not None and key != own:
        raise code_changed()
    store = Store(root)
    for pause in (*PAUSES_SECONDS, None):
        try:
            ref = None if force else store.lookup(spec.stage.name, own)
            if ref is not None:
                return Outcome(ref, True, Took(time.perf_counter() - begin, _peak_rss(), started))
            COMPILING.take()  # of what ran before in this process
            ref, kernel = _compute(store, spec, refs, own)
            return Outcome(
                ref, False, Took(time.perf_counter() - begin, _peak_rss(), started, kernel, COMPILING.take())
            )
        except OSError as error:
            # A missing file does not appear by waiting; a network drive that stumbled recovers.
            if pause is None or isinstance(error, PERMANENT):
                raise
            time.sleep(pause)
    raise AssertionError("unreachable")


def _compute(store: Store, spec: Spec, refs: Refs, key: str) -> tuple[Ref, float]:
    stage = spec.stage
    inputs = map_ports(store.open, refs)
    started = time.time()
    begin = time.perf_counter()
    result = stage.run(spec.params, {**spec.args, **spec.hints}, inputs)
    kernel = time.perf_counter() - begin
    # Before anything is stored: a wrong dtype or shape would be found by the next stage, under this key, for ever.
    check_outputs(stage, result)
    provenance = {
        **recipe(spec, refs),
        "params": spec.params.model_dump(mode="json"),
        "hints": json.loads(json.dumps(dict(spec.hints), default=str)),
        "host": {"name": platform.node(), "machine": platform.machine(), "cpus": os.cpu_count()},
        "python": platform.python_version(),
        "started": started,
        "seconds": kernel,
        "peak_rss": _peak_rss(),
    }
    return store.commit(stage, key, result, label=spec.label, provenance=provenance), kernel


def _peak_rss() -> int:
    """Peak resident memory of this process, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
