"""Folders of runs that use a cache, noted in the cache, so that garbage collection keeps their artifacts."""

from __future__ import annotations

import hashlib
import json
import platform
from contextlib import suppress
from pathlib import Path

from rille.datasets.text.reading import read_text
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store, StoreError

FOLDER = "roots"


def note(store: Store, runs: Path) -> None:
    """Note a folder of runs, once, if the cache can be written."""
    folder = str(runs.resolve())
    # By machine and folder, since users of a shared cache may be on several machines.
    named = hashlib.sha256(f"{platform.node()}\0{folder}".encode()).hexdigest()[:16]
    path = store.root / FOLDER / f"{named}.json"
    with suppress(OSError):
        if not path.exists():
            atomic.write(path, json.dumps({"folder": folder, "host": platform.node()}))


def folders(store: Store, runs: Path) -> list[Path]:
    """``runs`` and all noted folders, without those of this machine that are gone.

    Raises
    ------
    StoreError
        Runs of another machine cannot be read from here, so that their artifacts would count as unused; or a note
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
