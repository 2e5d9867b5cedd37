"""Folders of runs that use a cache, remembered in the cache: clearing up must keep what any of them refers to."""

from __future__ import annotations

import hashlib
import json
import platform
from contextlib import suppress
from pathlib import Path

from rille.datasets.text.reading import read_text
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.folder import StoreError

FOLDER = "roots"


def note(store: Store, runs: Path) -> None:
    """Remember a folder of runs, once. Best effort: a cache may be read-only."""
    folder = str(runs.resolve())
    # By machine and folder: a shared cache has users on several, and each notes itself once.
    named = hashlib.sha256(f"{platform.node()}\0{folder}".encode()).hexdigest()[:16]
    path = store.root / FOLDER / f"{named}.json"
    with suppress(OSError):
        if not path.exists():
            atomic.write(path, json.dumps({"folder": folder, "host": platform.node()}))


def folders(store: Store, runs: Path) -> list[Path]:
    """``runs`` and all remembered folders; those of this machine that are gone hold no runs.

    Raises
    ------
    StoreError
        Runs of another machine cannot be seen from here, so that their artifacts would count as unused; or a note
        cannot be read.
    """
    seen = {runs.resolve()}
    for path in (store.root / FOLDER).glob("*.json"):
        try:
            noted = json.loads(read_text(path, "note"))
            folder, host = Path(noted["folder"]), str(noted["host"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            remedy = "remove it, once you know that no run needs this cache"
            raise StoreError("RIL-742", f"{path} cannot be read", remedy=remedy) from error
        if folder.is_dir():
            seen.add(folder)
        elif host != platform.node():
            remedy = f"clear up there, or remove {path} if they are gone"
            raise StoreError("RIL-743", f"the runs in {folder} on {host} cannot be seen from here", remedy=remedy)
    return sorted(seen)
