"""Pins: runs whose artifacts stay, whatever is cleared away, and even if the run's own folder goes."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from rille.datasets.text.reading import TABLE, read_text
from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.folder import StoreError
from rille.pipeline.runs import lookup
from rille.stages.core.errors import ConfigError

FOLDER = "pins"


def pin(store: Store, run: Path) -> int:
    """Keep all artifacts that a run used; gives their number."""
    keys = sorted(lookup.used(run))
    path = _path(store, lookup.name(run))
    body = json.dumps({"run": lookup.name(run), "pinned": round(time.time()), "keys": keys})
    with reported("RIL-562", f"cannot pin in {store.root}", remedy="check --cache", kind=StoreError):
        atomic.write(path, body)
    return len(keys)


def unpin(store: Store, text: str) -> str:
    """Take the pin of a run away, given as ``SEQUENCE`` (its latest pin), ``SEQUENCE/ID``, ``ID`` or its folder.

    Returns
    -------
    The name of the run.


    Raises
    ------
    ConfigError
        It is not pinned.
    """
    pinned = [found["run"] for found in pins(store)]
    wanted = {text, "/".join(Path(text).resolve().parts[-2:])}
    # Names end in the time of their run: the latest comes first.
    for name in sorted(pinned, reverse=True):
        if wanted & {name, *name.split("/")}:
            _path(store, name).unlink(missing_ok=True)
            return str(name)
    remedy = f"pinned are {', '.join(pinned)}" if pinned else "nothing is pinned in this cache"
    raise ConfigError("RIL-563", f"run {text!r} is not pinned", remedy=remedy)


def pins(store: Store) -> list[dict[str, Any]]:
    """All pins: ``run``, ``pinned`` (seconds since 1970) and ``keys``.

    Raises
    ------
    StoreError
        A pin cannot be read: what it keeps is not known, so nothing may be cleared away.
    """
    found = []
    for path in sorted((store.root / FOLDER).glob("*.json")):
        try:
            one = json.loads(read_text(path, "pin", TABLE))
            found.append({"run": str(one["run"]), "pinned": float(one["pinned"]), "keys": list(one["keys"])})
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise StoreError(
                "RIL-564", f"the pin {path} cannot be read", remedy="pin that run again, or remove the file"
            ) from error
    return found


def keys(store: Store) -> set[str]:
    """Keys of all that pinned runs need."""
    return {key for found in pins(store) for key in found["keys"]}


def _path(store: Store, name: str) -> Path:
    # Sequences' names hold no slash, so that the file's name says which run it is.
    return store.root / FOLDER / f"{name.replace('/', '--')}.json"
