"""Folders of runs that use a cache, remembered in the cache: clearing up must keep what any of them refers to."""

from __future__ import annotations

import errno
import hashlib
import json
import platform
from collections.abc import Iterator
from pathlib import Path

from rille.datasets.text.reading import read_text
from rille.pipeline.engine.failures import CLOSED, reported
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.folder import StoreError

FOLDER = "roots"


def note(store: Store, runs: Path) -> None:
    """Remember a folder of runs, once; a cache that may only be read is used without a note."""
    folder = str(runs.resolve())
    # By machine and folder: a shared cache has users on several, and each notes itself once.
    named = hashlib.sha256(f"{platform.node()}\0{folder}".encode()).hexdigest()[:16]
    path = store.root / FOLDER / f"{named}.json"
    if path.exists():
        return
    with reported("RIL-741", f"cannot write in {store.root}", remedy="check --cache", kind=StoreError):
        try:
            atomic.write(path, json.dumps({"folder": folder, "host": platform.node()}))
        except OSError as error:
            # A run that finds everything needs no more; any other is refused by the store, which knows better words.
            if error.errno not in (*CLOSED, errno.ENOTDIR, errno.EEXIST):
                raise


def folders(store: Store, runs: Path) -> list[Path]:
    """``runs`` and all remembered folders that are there."""
    return sorted({runs.resolve(), *(folder for folder, _, _ in _noted(store) if folder.is_dir())})


def check_all_seen(store: Store) -> None:
    """Raise where another machine's runs cannot be seen from here; folders of this machine that are gone hold none.

    Raises
    ------
    StoreError
        There is such a folder, or a note cannot be read.
    """
    for folder, host, path in _noted(store):
        if not folder.is_dir() and host != platform.node():
            remedy = f"clear up there, or remove {path} if they are gone"
            raise StoreError("RIL-743", f"the runs in {folder} on {host} cannot be seen from here", remedy=remedy)


def _noted(store: Store) -> Iterator[tuple[Path, str, Path]]:
    """Folder of runs, machine, and the file that says so."""
    for path in sorted((store.root / FOLDER).glob("*.json")):
        try:
            noted = json.loads(read_text(path, "note"))
            yield Path(noted["folder"]), str(noted["host"]), path
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            remedy = "remove it, once you know that no run needs this cache"
            raise StoreError("RIL-742", f"{path} cannot be read", remedy=remedy) from error
