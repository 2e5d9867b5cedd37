"""Checks of workers that others have started.

Every worker must have the source code, the Python and the packages of the client, use one thread a library, and see
the same cache: each reads a probe of the client there, and writes beside it. One that differs is named with the
difference, and the run does not begin. One that joins later computes the key of each task itself, and fails where it
differs.
"""

from __future__ import annotations

import os
import platform
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rille.pipeline.engine.keys import NAMED, OWN, tree_digest, version
from rille.pipeline.engine.plain import one_line
from rille.pipeline.engine.runtime import atomic
from rille.stages.core.errors import ConfigError


def identity() -> dict[str, str]:
    """Return by name the facts that client and workers must share: packages with the processor that they work for."""
    code = tree_digest((*OWN, "rille.pipeline"))[:12]
    return {"Python": platform.python_version(), "source code": code} | {name: version(name) for name in NAMED}


def compare(ours: Mapping[str, str], probe: Path) -> None:
    """Run on a worker: compare it with the client, which has left a probe in the cache.

    Raises
    ------
    ConfigError
        It differs, may use several threads a library, or does not share the cache.
    """
    theirs = identity()
    differs = [f"{n} {theirs.get(n, 'none')} instead of {ours[n]}" for n in ours if theirs.get(n) != ours[n]]
    if differs:
        remedy = "install the same there, and start it again"
        raise ConfigError("RIL-521", f"differs: {', '.join(differs)}", remedy=remedy)
    if threads := [name for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS") if os.environ.get(name) != "1"]:
        text = f"may use several threads a library ({threads[0]} is not 1)"
        raise ConfigError("RIL-522", text, remedy="start it with OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1")
    try:
        probe.read_bytes()
        probe.with_name(f"{probe.name}-{uuid.uuid4().hex}").touch()
    except OSError as error:
        text = f"does not share the cache {probe.parents[1]}: {one_line(error)}"
        raise ConfigError("RIL-523", text, remedy="give --cache a folder that all machines share") from error


def examine(client: Any, cache: Path) -> None:
    """Refuse a cluster one of whose workers is not like this process, or does not share the cache.

    Raises
    ------
    ConfigError
        The first such worker, with the difference.
    """
    probe = cache / "probe" / uuid.uuid4().hex
    try:
        atomic.write(probe, "")
        answers = client.run(compare, identity(), probe, on_error="return")
        workers = client.scheduler_info(n_workers=-1)["workers"]
        for address, answer in sorted(answers.items()):
            known = workers.get(address, {}).get("name", "")
            name = f"worker {known} ({address})" if known not in ("", address) else f"worker {address}"
            if isinstance(answer, ConfigError):
                raise answer.at(name)
            if isinstance(answer, BaseException):
                text = f"{name} cannot run Rille: {type(answer).__name__}: {one_line(answer)[:200]}"
                remedy = "install the same version there, and start the workers with it"
                raise ConfigError("RIL-520", text, remedy=remedy)
    finally:
        for left in probe.parent.glob(f"{probe.name}*"):
            with suppress(OSError):
                left.unlink()
