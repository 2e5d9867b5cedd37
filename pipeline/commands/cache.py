"""``rille cache``: look after the cache of artifacts."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App

from rille.pipeline.commands.options import COMPLETE, FAILED, RUNS, CacheFolder, Debug, Runs, cache_folder, flag

app = App(name="cache", help="Look after the cache of artifacts.")


def _there(cache: str | None) -> Path:
    """The folder of a cache; one that there is not was mistyped more often than it is empty."""
    from rille.stages.core.errors import ConfigError

    folder = cache_folder(cache)
    if not folder.is_dir():
        raise ConfigError("RIL-589", f"there is no cache {folder}", remedy="name it with --cache")
    return folder


@app.command
def verify(
    *,
    deep: Annotated[bool, flag("Decode every chunk too, and compare the digests of the arrays.")] = False,
    cache: CacheFolder = None,
    debug: Debug = False,
) -> int:
    """Read every artifact and compare its checksums; damaged ones are named and recomputed by the next run."""
    from rille.pipeline.engine.store import maintenance
    from rille.pipeline.engine.store.base import Store

    sound, damaged = maintenance.verify(Store(_there(cache)), deep=deep)
    for found in damaged:
        where = "set aside" if found.aside else "it stays, for the cache cannot be written"
        print(f"rille: {found.label or found.key[:12]} ({found.stage}): {found.reason}; {where}", file=sys.stderr)
    print(f"{sound} artifacts are sound, {len(damaged)} damaged")
    return FAILED if damaged else COMPLETE


@app.command
def gc(
    *,
    cache: CacheFolder = None,
    runs: Runs = RUNS,
    dry_run: Annotated[bool, flag("List by stage what would be removed, and remove nothing.")] = False,
    debug: Debug = False,
) -> int:
    """Remove artifacts that no kept run refers to, and leftovers of interrupted runs.

    What was made or used within a day stays: a run may be under way.
    """
    from rille.pipeline.engine.memory import words
    from rille.pipeline.engine.store import maintenance
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.runs import lookup, roots
    from rille.stages.core.errors import ConfigError

    store = Store(_there(cache))
    # Before any key is gathered: artifacts of runs that cannot be seen from here would count as unused.
    roots.check_all_seen(store)
    ledgers = [path for folder in roots.folders(store, runs) for path in folder.glob(f"*/*/{lookup.LEDGER}")]
    kept = set[str]().union(*(lookup.used(path.parent) for path in ledgers if path.is_file()))
    if not kept:
        raise ConfigError(
            "RIL-744",
            f"no run is known that uses the cache {store.root}: all of it would go",
            remedy="give the folder of your runs with --runs, or remove the cache yourself",
        )
    cleared = maintenance.gc(store, kept, dry_run=dry_run)
    if dry_run:
        for stage, (count, amount) in sorted(cleared.stages.items(), key=lambda item: -item[1][1]):
            print(f"{stage:18s} {count:6d} {words(amount):>8s}")
    verb = "would remove" if dry_run else "removed"
    print(f"{verb} {cleared.artifacts} artifacts and {cleared.orphans} leftovers, {cleared.bytes / 2**20:.1f} MiB")
    return COMPLETE
