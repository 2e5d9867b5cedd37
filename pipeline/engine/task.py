"""A task: what it computes, its key, and the one body of all tasks: look up, and if absent compute, check, commit.

A :class:`Spec` names a stage by its module, validated parameters, the arguments that
identify the task, and hints (paths) that cannot change the result. The key is the digest of all of it but the hints
and the label, of the code and packages behind the stage, and of the *output digests* of the inputs. Between tasks only
:class:`~rille.pipeline.engine.store.artifact.Ref` travel.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from rille.pipeline.engine.keys import digest, module_digests, versions
from rille.pipeline.engine.runtime.kernels import COMPILING, use_own_folder
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import Params, Stage, check_outputs, declared
from rille.stages.core.errors import RilleError

FORMAT = 5
"""Enters every key: raise it when the meaning of keys or artifacts changes."""

PAUSES_SECONDS = 0.2, 0.8
"""Before the second try, and before the third."""

PERMANENT = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


Refs = Mapping[str, Ref | list[Ref]]
"""Input port to the artifact given there, or to the list of them."""

A = TypeVar("A")
B = TypeVar("B")


def map_ports(change: Callable[[A], B], ports: Mapping[str, A | list[A]]) -> dict[str, B | list[B]]:
    """Apply ``change`` to each item that is given to a port; a list stays a list."""
    return {p: [change(g) for g in given] if isinstance(given, list) else change(given) for p, given in ports.items()}


def flatten_ports(ports: Mapping[str, A | list[A]]) -> list[A]:
    """All items, in order of the ports."""
    return [g for given in ports.values() for g in (given if isinstance(given, list) else [given])]


@dataclass(frozen=True, slots=True)
class Spec:
    """One task without its inputs. ``label`` names it to people (``locus/12``) and is not part of the key."""

    module: str
    label: str
    params: Params
    args: Mapping[str, Any] = field(default_factory=dict)
    hints: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stage(self) -> Stage:
        """The declaration behind the module."""
        return resolve(self.module)


@cache
def resolve(module: str) -> Stage:
    """The stage of a module; its source is digested just before the import, so that both see the same files."""
    module_digests(module)
    use_own_folder()
    stage = declared(importlib.import_module(module))
    if "cv2" in sys.modules:
        # OpenCV takes a thread a core by default, and there is a worker for each core already.
        sys.modules["cv2"].setNumThreads(1)
    if stage is None:
        raise TypeError(f"{module} declares no stage")
    return stage


def recipe(spec: Spec, refs: Refs) -> dict[str, Any]:
    """All that determines a result, by name."""
    return {**_shared(spec.module), **_own(spec, refs)}


def key_of(spec: Spec, refs: Refs) -> str:
    """Key of a task: the digest of its recipe, in which one digest stands for what all tasks of a stage share."""
    return digest({"stage": _shared_digest(spec.module), **_own(spec, refs)}, spec.label)


def _own(spec: Spec, refs: Refs) -> dict[str, Any]:
    return {"params": spec.params, "args": dict(spec.args), "inputs": map_ports(attrgetter("digest"), refs)}


@cache
def _shared(module: str) -> dict[str, Any]:
    """What all tasks of a stage have in common."""
    stage, code, env = resolve(module), module_digests(module), versions(module)
    return {"code": code, "env": env, "format": FORMAT, "stage": stage.name}


@cache
def _shared_digest(module: str) -> str:
    return digest(_shared(module), module)


@dataclass(frozen=True, slots=True)
class Took:
    """What a task took: ``seconds`` and peak memory [bytes] of the call, ``kernel`` seconds of the stage itself.

    ``started`` is when the call began (seconds since 1970); ``compiling`` are the seconds for which it compiled;
    ``worker`` is the name of the dask worker that ran it.
    """

    seconds: float = 0.0
    peak_rss: int = 0
    started: float = 0.0
    kernel: float = 0.0
    compiling: float = 0.0
    worker: str = ""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: its artifact, whether it was cached, and what it took."""

    ref: Ref
    cached: bool
    took: Took


def code_changed() -> RilleError:
    """The error of a task whose key is another one on the worker."""
    text = "source code or packages of the worker are not those the run began with"
    return RilleError("RIL-581", text, remedy="run again, and edit nothing meanwhile")


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
