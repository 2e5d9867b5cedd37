"""Look after the cache of artifacts."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App

from rille.pipeline.engine.memory import words
from rille.pipeline.engine.runtime import kernels
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import COMPLETE, FAILED, FLAG, RUNS, CacheFolder, Runs, cache_folder
from rille.stages.core.errors import ConfigError

app = App(name="cache", help=__doc__)


def _there(cache: str | None) -> Path:
    """The folder of a cache; refused if it does not exist, because it is probably mistyped."""
    folder = cache_folder(cache)
    if not folder.is_dir():
        raise ConfigError("RIL-589", f"there is no cache {folder}", remedy="name it with --cache")
    return folder


@app.command
def verify(*, cache: CacheFolder = None) -> int:
    """Read and decode every artifact, and compare its digest; damaged ones are named and recomputed by the next run."""
    sound, damages = maintenance.verify(Store(_there(cache)))
    for damage in damages:
        print(f"rille: {damage}", file=sys.stderr)
    print(f"{sound} artifacts are sound, {len(damages)} damaged")
    return FAILED if damages else COMPLETE


@app.command
def gc(
    *,
    cache: CacheFolder = None,
    runs: Runs = RUNS,
    dry_run: Annotated[bool, FLAG] = False,
) -> None:
    """Remove artifacts that no kept run refers to, leftovers of interrupted runs, and kernels that nothing uses.

    What was made or used within a day stays: a run may be under way.

    Parameters
    ----------
    dry_run
        List by stage what would be removed, and remove nothing.
    """
    store = Store(_there(cache))
    ledgers = [path for folder in maintenance.noted_runs(store, runs) for path in folder.glob(f"*/*/{lookup.LEDGER}")]
    kept = set[str]().union(*(lookup.used(path.parent) for path in ledgers if path.is_file()))
    if not kept:
        text = f"no run is known that uses the cache {store.root}: all of it would go"
        remedy = "give the folder of your runs with --runs, or remove the cache yourself"
        raise ConfigError("RIL-744", text, remedy=remedy)
    cleared = maintenance.gc(store, kept, dry_run=dry_run)
    leftovers = cleared.pop("", [])
    if dry_run:
        for stage, sizes in sorted(cleared.items(), key=lambda item: -sum(item[1])):
            print(f"{stage:18s} {len(sizes):6d} {words(sum(sizes)):>8s}")
    else:
        for path in kernels.unused():
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
    verb, artifacts = "would remove" if dry_run else "removed", [size for sizes in cleared.values() for size in sizes]
    size = sum(artifacts) + sum(leftovers)
    print(f"{verb} {len(artifacts)} artifacts and {len(leftovers)} leftovers, {size / 2**20:.1f} MiB")
