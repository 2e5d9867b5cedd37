"""Schedulers and workers that others have started: what they must be, and whether they are still there.

Every worker must have the source code, the Python and the packages of the client, use one thread a library, and see
the same cache: each reads a probe of the client there, and writes beside it. One that differs is named with the
difference, and the run does not begin. One that joins later computes the key of each task itself, and fails where it
differs.
"""

from __future__ import annotations

import os
import platform
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from rille.pipeline.engine.code_digest import OWN, tree_digest
from rille.pipeline.engine.packages import version
from rille.pipeline.engine.runtime import atomic
from rille.stages.core.errors import ConfigError, RilleError

PACKAGES = (
    *("dask", "distributed", "google-crc32c", "llvmlite", "numba", "numcodecs", "numpy", "pydantic", "zarr"),
    *("opencv-python-headless", "pycolmap", "rasterio", "scipy"),
)
"""Distributions whose version must be the client's, and the kind of processor that they work for."""

NO_WORKERS_SECONDS = 30.0
"""Time that a scheduler may be without workers, at the beginning or later, before the run is given up."""

SILENCE_SECONDS = 20.0
"""Time without an answer of the scheduler before it counts as gone, and of a worker before the user is warned."""

Identity = Mapping[str, str]


class ClusterError(RilleError):
    """The scheduler or all of its workers are gone."""


def identity() -> dict[str, str]:
    """Return by name the facts that client and workers must share; a missing package has no version."""
    found = {"Python": platform.python_version(), "source code": tree_digest((*OWN, "rille.pipeline"))[:12]}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except metadata.PackageNotFoundError:
            found[name] = "none"
    return found


def compare(ours: Identity, probe: Path) -> None:
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
        text = f"does not share the cache {probe.parents[1]}: {' '.join(str(error).split())}"
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
        for address, answer in sorted(answers.items()):
            name = worker_name(client, address)
            if isinstance(answer, ConfigError):
                raise answer.at(name)
            if isinstance(answer, BaseException):
                text = f"{name} cannot run Rille: {type(answer).__name__}: {' '.join(str(answer).split())[:200]}"
                remedy = "install the same version there, and start the workers with it"
                raise ConfigError("RIL-520", text, remedy=remedy)
    finally:
        for left in probe.parent.glob(f"{probe.name}*"):
            with suppress(OSError):
                left.unlink()


def worker_name(client: Any, address: str) -> str:
    """Name of a worker for messages."""
    known = client.scheduler_info(n_workers=-1)["workers"].get(address, {}).get("name", "")
    return f"worker {known} ({address})" if known not in ("", address) else f"worker {address}"


class Presence:
    """Whether the scheduler answers, and has workers.

    Attributes
    ----------
    _heard : when the scheduler heard of each worker last, by its clock, and since when we know that, by ours.
    """

    def __init__(self, client: Any, patience: float) -> None:
        self._client, self._address, self._patience = client, client.scheduler.address, patience
        self._answered = self._manned = time.monotonic()
        self._heard: dict[tuple[str, float], float] = {}

    def threads(self) -> int:
        """Threads of all workers now.

        Raises
        ------
        ClusterError
            The scheduler is gone, or had no workers for too long.
        """
        now = time.monotonic()
        try:
            identity = self._client.scheduler.identity
            workers = self._client.sync(identity, n_workers=-1, callback_timeout=SILENCE_SECONDS / 2)["workers"]
        except Exception as error:
            # One question without an answer is a busy scheduler; only a long silence is a lost one.
            if self._client.status in ("closing", "closed") or time.monotonic() - self._answered > SILENCE_SECONDS:
                raise self.gone() from error
            return 0
        self._answered = now
        heard = [(address, worker["last_seen"]) for address, worker in workers.items()]
        self._heard = {word: self._heard.get(word, now) for word in heard}
        threads = sum(worker["nthreads"] for worker in workers.values())
        if threads:
            self._manned = now
        elif now - self._manned > self._patience:
            text = f"the dask scheduler at {self._address} had no workers for {self._patience:.0f} s"
            remedy = "start workers, and run the same command: what is committed stays"
            raise ClusterError("RIL-525", text, remedy=remedy)
        return int(threads)

    def silent(self) -> set[str]:
        """Addresses of the workers from which nothing was heard for long, by the last look."""
        return {address for (address, _), since in self._heard.items() if self._answered - since > SILENCE_SECONDS}

    def gone(self) -> ClusterError:
        """The scheduler is."""
        return ClusterError(
            "RIL-526",
            f"the dask scheduler at {self._address} is gone",
            remedy="start it again with its workers, and run the same command: what is committed stays",
        )
