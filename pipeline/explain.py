"""Why a task is not in the cache, in words, against the most similar earlier artifact of the same stage and label.

A small file per stage and label remembers the last few keys. It is a hint: written without care for crashes, and
where it is wrong or missing only the words suffer.
"""

from __future__ import annotations

import json
import os
import uuid
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

if TYPE_CHECKING:
    from pipeline.store import Ref, Store

KEPT = 4
"""Earlier keys remembered per label: enough for a user who goes back and forth between a few settings."""

SHOWN = 3
"""Differences told per node."""


def remember(store: Store, stage: str, label: str, key: str) -> None:
    """Note that ``key`` was the latest of this stage and label."""
    path = _index(store, stage, label)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        keys = [key, *(k for k in _recall(path) if k != key)][:KEPT]
        temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.tmp")
        temporary.write_text(json.dumps(keys), encoding="utf-8")
        os.replace(temporary, path)


def reason(store: Store, stage: str, label: str, key: str, recipe: Mapping[str, Any]) -> str:
    """Why ``key`` is missed, in words: ``params.cell_size 0.02 -> 0.01``, ``never computed`` ..."""
    keys = _recall(_index(store, stage, label))
    if key in keys:
        return "was computed before, its artifact is gone or damaged"
    earlier = [m["provenance"] for k in keys if (m := store.manifest(stage, k)) is not None]
    if not earlier:
        return "never computed" if not keys else "earlier artifacts are gone"
    now = {**recipe, "params": recipe["params"].model_dump(mode="json")}
    now = json.loads(json.dumps(now))
    found = min((differences(then, now) for then in earlier), key=len)
    told = found[:SHOWN] + ([f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else [])
    return "; ".join(told) or "the key has another format"


def latest(store: Store, stage: str, label: str) -> Ref | None:
    """The latest artifact of a stage and label that is still there, whatever it was made from."""
    return next((ref for k in _recall(_index(store, stage, label)) if (ref := store.lookup(stage, k))), None)


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What two recipes differ in, one phrase each: parameters first, then inputs, code and packages."""
    told = _values("params", then.get("params"), now["params"]) + _values("args", then.get("args"), now["args"])
    told += _inputs(then.get("inputs", {}), now["inputs"])
    old, new = then.get("code", {}), now["code"]
    told += [f"code: {_file(m)} {_change(m, old, new)}" for m in sorted({*old, *new}) if old.get(m) != new.get(m)]
    old, new = then.get("env", {}), now["env"]
    told += [
        f"{d} {old.get(d, 'none')} -> {new.get(d, 'none')}" for d in sorted({*old, *new}) if old.get(d) != new.get(d)
    ]
    for what in ("version", "format"):
        told += _values(what, then.get(what), now[what])
    return told


def _values(where: str, old: Any, new: Any) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*new, *(n for n in old if n not in new)]
        return [text for n in names for text in _values(f"{where}.{n}", old.get(n), new.get(n))]
    if old == new and type(old) is type(new):
        return []
    return [f"{where} {_short(old)} -> {_short(new)}"]


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _inputs(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    told = []
    for port in sorted({*old, *new}):
        was, now = old.get(port), new.get(port)
        if was == now:
            continue
        if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
            changed = sum(a != b for a, b in zip(was, now, strict=True))
            told.append(f"input {port} changed ({changed} of {len(now)})")
        elif isinstance(was, list) and isinstance(now, list):
            told.append(f"input {port} has {len(now)} instead of {len(was)}")
        else:
            told.append(f"input {port} {'added' if was is None else 'dropped' if now is None else 'changed'}")
    return told


def _file(module: str) -> str:
    return module.replace(".", "/") + ".py"


def _change(name: str, old: Mapping[str, str], new: Mapping[str, str]) -> str:
    return "is new" if name not in old else "is gone" if name not in new else "changed"


def _index(store: Store, stage: str, label: str) -> Path:
    name = quote(label, safe="")
    return store.root / "labels" / stage / f"{zlib.crc32(name.encode()) & 0xFF:02x}" / f"{name}.json"


def _recall(path: Path) -> list[str]:
    try:
        keys = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [k for k in keys if isinstance(k, str)] if isinstance(keys, list) else []
