"""The one body of every task: look up, and if absent compute, check, commit.

A :class:`Spec` says what to compute: a stage module (its ``STAGE`` is taken), validated parameters, the arguments that
identify the task, and hints (paths) that cannot change the result. The key is the digest of all of it but the hints
and the label, of the code and packages behind the stage, and of the *output digests* of the inputs. Between
tasks only :class:`~rille.pipeline.engine.store.manifest.Ref` travel.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import pickle
import platform
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from rille.pipeline.engine.code_digest import module_digests
from rille.pipeline.engine.keys import text
from rille.pipeline.engine.memory.cost_model import tells_more
from rille.pipeline.engine.memory.limits import Meter
from rille.pipeline.engine.packages import versions
from rille.pipeline.engine.runtime.numba_cache import COMPILING, guard
from rille.pipeline.engine.store.base import Store, at
from rille.pipeline.engine.store.manifest import Ref
from rille.stages.core.declare import Bundle, Params, Stage, check_outputs
from rille.stages.core.errors import RilleError

__all__ = ["CodeChangedError", "Outcome", "Ref", "Refs", "Spec", "ensure", "recipe", "resolve"]

FORMAT = 2
"""Enters every key: raise it when the meaning of keys or artifacts changes."""

TRIES = 3
BACK_OFF = 0.2
"""Seconds before the second try; four times as long before the third."""

PERMANENT = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)

Refs = Mapping[str, Ref | list[Ref]]
"""Input port to the artifact given there, or to the list of them."""


class CodeChangedError(RilleError):
    """The source code or the packages of a worker are not those of the client."""


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

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (self.module, self.label, _forms(self).pickled, self.args, self.hints)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: its artifact, whether it was cached, seconds and peak memory [bytes] of the call.

    ``kernel`` are the seconds of the stage itself, ``started`` is when the call began (seconds since 1970); ``memory``
    and ``rest`` are a :class:`~rille.pipeline.engine.memory.limits.Meter`'s figures, ``first`` says that the process
    had not run the stage before (it imports, and compiles or loads kernels); ``compiling`` are the seconds for which it
    compiled; ``worker`` is the name of the dask worker that ran it.
    """

    ref: Ref
    cached: bool
    seconds: float
    peak_rss: int
    started: float = 0.0
    kernel: float = 0.0
    memory: int | None = None
    rest: int | None = None
    first: bool = False
    compiling: float = 0.0
    worker: str = ""


MANY = 4096
"""Parameter models of which a process keeps the forms."""


class _Forms(NamedTuple):
    """A parameter model, held so that its id stays its own, with its canonical text and its pickle."""

    params: Params
    canonical: str
    pickled: bytes


class _Common(NamedTuple):
    """What all tasks of a stage have in common, and its canonical text in the order of the names: what stands before
    ``inputs``, and what after ``params``."""

    parts: dict[str, Any]
    before: str
    after: str


_forms_by_id: dict[int, _Forms] = {}

_run: set[str] = set()
"""Modules of the stages that this process has run."""


@cache
def resolve(module: str) -> Stage:
    """``STAGE`` of a module; its source is digested just before the import, so that both see the same files."""
    module_digests(module)
    guard()
    stage = importlib.import_module(module).STAGE
    if "cv2" in sys.modules:
        # OpenCV takes a thread a core by default, and there is a worker for each core already.
        sys.modules["cv2"].setNumThreads(1)
    if not isinstance(stage, Stage):
        raise TypeError(f"{module}.STAGE is a {type(stage).__name__}, not a Stage")
    return stage


def recipe(spec: Spec, refs: Refs) -> dict[str, Any]:
    """All that determines a result; its digest is the key."""
    return {**_shared(spec.module).parts, "params": spec.params, "args": dict(spec.args), "inputs": _digests(refs)}


def key_of(spec: Spec, refs: Refs) -> str:
    """Key of a task, ``digest(recipe(spec, refs))``; what many tasks share is put into its canonical form only once."""
    common = _shared(spec.module)
    args, inputs = text(dict(spec.args), f"{spec.label}.args"), text(_digests(refs))
    parts = f'{{"args":{args},{common.before},"inputs":{inputs},"params":{_forms(spec).canonical},{common.after}}}'
    return hashlib.sha256(parts.encode()).hexdigest()


def _forms(spec: Spec) -> _Forms:
    """Forms of a task's parameters, which many tasks share."""
    known = _forms_by_id.get(id(spec.params))
    if known is None or known.params is not spec.params:
        if len(_forms_by_id) > MANY:
            _forms_by_id.clear()
        known = _Forms(spec.params, text(spec.params, f"{spec.label}.params"), pickle.dumps(spec.params))
        _forms_by_id[id(spec.params)] = known
    return known


def _unpickled(module: str, label: str, params: bytes, *more: Any) -> Spec:
    return Spec(module, label, _model(params), *more)


_model = lru_cache(MANY)(pickle.loads)
"""Tasks that shared a model share one again in the process that they are sent to, where its forms are kept as well."""


@cache
def _shared(module: str) -> _Common:
    stage = resolve(module)
    found = (module_digests(module), versions(module), FORMAT, stage.name, stage.version)
    fixed = dict(zip(("code", "env", "format", "stage", "version"), found, strict=True))
    texts = [f'"{name}":{text(value)}' for name, value in fixed.items()]
    return _Common(fixed, ",".join(texts[:3]), ",".join(texts[3:]))


def _digests(refs: Refs) -> dict[str, Any]:
    return {p: [r.digest for r in ref] if isinstance(ref, list) else ref.digest for p, ref in refs.items()}


def ensure(root: Path | str, spec: Spec, refs: Refs, *, key: str | None = None, force: bool = False) -> Outcome:
    """Give the artifact of a task, computing and committing it where it is absent (or ``force`` is set).

    ``key`` is what the client expects; a worker that would compute another thing refuses. Failures of input and
    output (``OSError``, ``TimeoutError``) are tried three times; what a stage raises otherwise is not tried again.
    """
    begin, started = time.perf_counter(), time.time()
    # Computed here as well, from this process's own source files: the client's may be newer.
    own = key_of(spec, refs)
    if key is not None and key != own:
        raise CodeChangedError(
            "RIL-581",
            f"{spec.label}: source code or packages of the worker are not those the run began with",
            remedy="run again, and edit nothing meanwhile",
        )
    store = at(root)
    for trial in range(TRIES):
        try:
            ref = None if force else store.lookup(spec.stage.name, own)
            if ref is not None:
                return Outcome(ref, True, time.perf_counter() - begin, _peak_rss(), started)
            first = spec.module not in _run
            COMPILING.take()  # of what ran before in this process
            size = sum(r.nbytes for ref in refs.values() for r in (ref if isinstance(ref, list) else [ref]))
            with Meter(measure=tells_more((spec.module, _forms(spec).canonical), size)) as meter:
                ref, kernel = _compute(store, spec, refs, own)
            seconds = time.perf_counter() - begin
            _run.add(spec.module)
            measured = (started, kernel, meter.memory, meter.rest, first, COMPILING.take())
            return Outcome(ref, False, seconds, _peak_rss(), *measured)
        except (OSError, TimeoutError) as error:
            # A missing file does not appear by waiting; a network drive that stumbled recovers.
            if isinstance(error, PERMANENT) or trial == TRIES - 1:
                raise
            time.sleep(BACK_OFF * 4**trial)
    raise AssertionError("unreachable")


def _compute(store: Store, spec: Spec, refs: Refs, key: str) -> tuple[Ref, float]:
    stage = spec.stage
    inputs = {p: [store.open(r) for r in ref] if isinstance(ref, list) else store.open(ref) for p, ref in refs.items()}
    started = time.time()
    begin = time.perf_counter()
    result = stage.run(spec.params, {**spec.args, **spec.hints}, inputs)
    kernel = time.perf_counter() - begin
    if not isinstance(result, Bundle):
        raise TypeError(f"{stage.name}: run gave a {type(result).__name__}, not a Bundle")
    # Before anything is stored: a wrong dtype or shape would be found by the next stage, under this key, for ever.
    check_outputs(stage, result)
    provenance = {
        **recipe(spec, refs),
        "params": spec.params.model_dump(mode="json"),
        "hints": {k: str(v) for k, v in spec.hints.items()},
        "host": {"name": platform.node(), "machine": platform.machine(), "cpus": os.cpu_count()},
        "python": platform.python_version(),
        "started": started,
        "seconds": kernel,
        "peak_rss": _peak_rss(),
    }
    ref = store.commit(stage, key, result, label=spec.label, provenance=json.loads(json.dumps(provenance)))
    return ref, kernel


def _peak_rss() -> int:
    """Peak resident memory of this process, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
