"""Why a task is not in the cache, in words, against the most similar earlier artifact of the same stage and label.

A file for each sequence and choice of frames remembers the last few keys of each task. It is a hint: written once, at
the end of a run, and where it is wrong or missing only the words suffer.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from rille.pipeline.engine.plain import brief
from rille.pipeline.engine.runtime.hints import read_hint, write_hint

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Handle
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.engine.store.manifest import Ref

SHOWN = 3
"""Largest number of differences stated for a node."""

Keys = dict[str, list[str]]
"""Stage and label to keys, the latest first."""

_KEYS = TypeAdapter(Keys)


class Known:
    """The latest keys of each task of a sequence.

    Parameters
    ----------
    hints : the sequence's folder of hints.
    choice : names the choice of frames. What is to be laid out follows results of the same choice alone; a reason may
        come from another one, where this one has none.
    """

    def __init__(self, hints: Path, choice: str) -> None:
        self._path = hints / f"keys-{choice}.json"

    @cached_property
    def _own(self) -> Keys:
        return _read(self._path)

    @cached_property
    def _others(self) -> list[Keys]:
        """Of other choices of frames, the newest first."""
        found = [p for p in self._path.parent.glob("keys-*.json") if p != self._path]
        with suppress(OSError):  # one was removed just now
            return [_read(p) for p in sorted(found, key=os.path.getmtime, reverse=True)]
        return []

    def reason(self, store: Store, stage: str, label: str, key: str, recipe: Mapping[str, Any]) -> str:
        """Why ``key`` is missed, in words: ``params.cell_size 0.02 -> 0.01``, ``never computed`` ..."""
        name = _name(stage, label)
        keys = self._own.get(name) or next((k[name] for k in self._others if name in k), [])
        if key in keys:
            return "was computed before, its artifact is gone or damaged"
        earlier = [m["provenance"] for k in keys if (m := store.manifest(stage, k)) is not None]
        if not earlier:
            return "never computed" if not keys else "earlier artifacts are gone"
        now = {**recipe, "params": recipe["params"].model_dump(mode="json")}
        # Through JSON, as the stored recipe went: tuples become lists, which would differ otherwise.
        now = json.loads(json.dumps(now))
        # The nearest of the earlier ones: a user who goes back to former settings sees what is new, not what was
        # undone.
        found = min((differences(then, now) for then in earlier), key=len)
        shown = found[:SHOWN] + ([f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else [])
        return "; ".join(shown) or "the key has another format"

    def latest(self, store: Store, stage: str, label: str) -> Ref | None:
        """The latest artifact of a stage and label that is still there, whatever it was made from."""
        return next((ref for k in self._own.get(_name(stage, label), []) if (ref := store.lookup(stage, k))), None)

    def save(self, nodes: Iterable[Handle]) -> None:
        """Note what a run used."""
        known = _read(self._path)
        used = {_name(h.stage, h.label): h.key for h in nodes if h.ref is not None}
        if all(known.get(name, [""])[0] == key for name, key in used.items()):
            return
        # Earlier keys remembered per label: enough for a user who goes back and forth between a few settings
        known |= {name: [key, *(k for k in known.get(name, []) if k != key)][:4] for name, key in used.items()}
        write_hint(self._path, known)


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """List the differences of two recipes, one phrase each: parameters first, then inputs, code and packages."""
    found = _values("params", then.get("params"), now["params"]) + _values("args", then.get("args"), now["args"])
    found += _inputs(then.get("inputs", {}), now["inputs"])
    old, new = then.get("code", {}), now["code"]
    found += [
        f"code: {m.replace('.', '/')}.py {_change(m, old, new)}"
        for m in sorted({*old, *new})
        if old.get(m) != new.get(m)
    ]
    old, new = then.get("env", {}), now["env"]
    found += [
        f"{d} {old.get(d, 'none')} -> {new.get(d, 'none')}" for d in sorted({*old, *new}) if old.get(d) != new.get(d)
    ]
    for what in ("version", "format"):
        found += _values(what, then.get(what), now[what])
    return found


def _values(where: str, old: Any, new: Any) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*new, *(n for n in old if n not in new)]
        return [text for n in names for text in _values(f"{where}.{n}", old.get(n), new.get(n))]
    if old == new and type(old) is type(new):
        return []
    return [f"{where} {brief(old, 40)} -> {brief(new, 40)}"]


def _inputs(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    found = []
    for port in sorted({*old, *new}):
        was, now = old.get(port), new.get(port)
        if was == now:
            continue
        if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
            changed = sum(a != b for a, b in zip(was, now, strict=True))
            found.append(f"input {port} changed ({changed} of {len(now)})")
        elif isinstance(was, list) and isinstance(now, list):
            found.append(f"input {port} has {len(now)} instead of {len(was)}")
        else:
            found.append(f"input {port} {'added' if was is None else 'dropped' if now is None else 'changed'}")
    return found


def _change(name: str, old: Mapping[str, str], new: Mapping[str, str]) -> str:
    return "is new" if name not in old else "is gone" if name not in new else "changed"


def _name(stage: str, label: str) -> str:
    return f"{stage} {label}"


def _read(path: Path) -> Keys:
    return read_hint(path, _KEYS) or {}
