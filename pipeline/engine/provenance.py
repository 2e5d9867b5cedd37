"""Why a task is not in the cache, in words, against the most similar earlier artifact of the same stage and label.

A file for each sequence and choice of frames remembers the last few keys of each task. It is a hint: written once, at
the end of a run, and where it is wrong or missing only the words suffer.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from rille.pipeline.engine.plain import brief
from rille.pipeline.engine.runtime.atomic import read_hint, write_hint
from rille.stages.core.errors import told

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Handle
    from rille.pipeline.engine.store.artifact import Ref
    from rille.pipeline.engine.store.base import Store

Keys = dict[str, list[str]]
"""Stage and label to keys, the latest first."""

_KEYS = TypeAdapter(Keys)

WIDTH = 40
"""Most characters of a value."""


class History:
    """The latest keys of each task of a sequence in earlier runs.

    Parameters
    ----------
    choice : names the choice of frames. What is to be laid out follows results of the same choice alone; a reason may
        come from another one, where this one has none.
    """

    def __init__(self, store: Store, sequence: str, choice: str) -> None:
        self._store, self._path = store, store.hints(sequence) / f"keys-{choice}.json"

    @cached_property
    def _own(self) -> Keys:
        return _read(self._path)

    @cached_property
    def _others(self) -> list[Keys]:
        """Keys of runs with other choices of frames, the newest first."""
        found = [p for p in self._path.parent.glob("keys-*.json") if p != self._path]
        with suppress(OSError):  # one was removed just now
            return [_read(p) for p in sorted(found, key=os.path.getmtime, reverse=True)]
        return []

    def why_missed(self, handle: Handle, recipe: Mapping[str, Any]) -> str:
        """Why there is no artifact of a key, in words: ``params.cell_size 0.02 -> 0.01``, ``never computed`` ..."""
        name = _name(handle)
        keys = self._own.get(name) or next((k[name] for k in self._others if name in k), [])
        if handle.key in keys:
            return "was computed before, its artifact is gone or damaged"
        earlier = [m["provenance"] for k in keys if (m := self._store.manifest(handle.stage, k)) is not None]
        if not earlier:
            return "never computed" if not keys else "earlier artifacts are gone"
        now = {**recipe, "params": recipe["params"].model_dump(mode="json"), "hints": handle.spec.hints}
        # Through JSON, as the stored recipe went: tuples become lists, which would differ otherwise.
        now = json.loads(json.dumps(now))
        # The nearest of the earlier ones: a user who goes back to former settings sees what is new, not what was
        # undone.
        found = min((differences(then, now) for then in earlier), key=len)
        return told(found) or "the key has another format"

    def latest(self, handle: Handle) -> Ref | None:
        """The latest artifact of a stage and label that is still there, whatever it was made from."""
        keys = self._own.get(_name(handle), [])
        return next((ref for k in keys if (ref := self._store.lookup(handle.stage, k))), None)

    def save(self, nodes: Iterable[Handle]) -> None:
        """Note what a run used."""
        known, changed = _read(self._path), False
        for handle in nodes:
            name = _name(handle)
            before = known.get(name, [])
            if handle.ref is not None and before[:1] != [handle.key]:
                changed = True
                # Enough for a user who goes back and forth between a few settings.
                known[name] = [handle.key, *(k for k in before if k != handle.key)][:4]
        if changed:
            write_hint(self._path, known)


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """List the differences of two recipes, one phrase each: parameters first, then inputs, code and packages."""
    # Of a file that has changed the digests say little, its name does.
    files = ", ".join("/".join(Path(str(at)).parts[-2:]) for _, at in _leaves("", now.get("hints", {})) if at)
    args = (f"{files}: {text}" if files else text for text in _values("args", then.get("args"), now["args"]))
    found = [*_values("params", then.get("params"), now["params"]), *args]
    found += _inputs(then.get("inputs", {}), now["inputs"])
    old, new = then.get("code", {}), now["code"]
    found += [f"code: {name.replace('.', '/')}.py {_change(name, old, new)}" for name in _unequal(old, new)]
    old, new = then.get("env", {}), now["env"]
    found += [f"{name} {old.get(name, 'none')} -> {new.get(name, 'none')}" for name in _unequal(old, new)]
    return found + _values("format", then.get("format"), now["format"])


def _values(where: str, old: Any, new: Any) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*new, *(n for n in old if n not in new)]
        return [text for n in names for text in _values(f"{where}.{n}", old.get(n), new.get(n))]
    if old == new and type(old) is type(new):
        return []
    lists = isinstance(old, list) and isinstance(new, list)
    if lists and max(len(json.dumps(value)) for value in (old, new)) > WIDTH:
        if len(old) != len(new):
            return [f"{where} has {len(new)} values instead of {len(old)}"]
        then, now = dict(_leaves(where, old)), dict(_leaves(where, new))
        unlike = [name for name in {**now, **then} if then.get(name) != now.get(name)]
        more = f" and {len(unlike) - 1} more of {len(now)} values" if len(unlike) > 1 else ""
        return [f"{_shown(name, then.get(name), now.get(name))}{more}" for name in unlike[:1]]
    return [_shown(where, old, new)]


def _leaves(where: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Values within lists and dictionaries, with their places: ``args.steps[3].weight``."""
    if not value or not isinstance(value, list | Mapping):
        yield where, value
        return
    for name, item in value.items() if isinstance(value, Mapping) else enumerate(value):
        yield from _leaves(f"{where}.{name}" if isinstance(name, str) else f"{where}[{name}]", item)


def _shown(where: str, *values: Any) -> str:
    """Both values, of long ones the part where they begin to differ."""
    texts = [value if isinstance(value, str) else json.dumps(value) for value in values]
    alike = next((k for k, (a, b) in enumerate(zip(*texts, strict=False)) if a != b), min(map(len, texts)))
    start = max(alike - WIDTH // 2, 0) if max(map(len, texts)) > WIDTH else 0
    return f"{where} {' -> '.join(brief('...' * (start > 0) + text[start:], WIDTH) for text in texts)}"


def _inputs(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    found = []
    for port in _unequal(old, new):
        was, now, change = old.get(port), new.get(port), _change(port, old, new)
        if isinstance(was, list) and isinstance(now, list):
            changed = sum(a != b for a, b in zip(was, now, strict=False))
            same_number = len(was) == len(now)
            change = f"changed ({changed} of {len(now)})" if same_number else f"has {len(now)} instead of {len(was)}"
        found.append(f"input {port} {change}")
    return found


def _unequal(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of what is not the same in both, or in one alone."""
    return sorted(name for name in {*old, *new} if old.get(name) != new.get(name))


def _change(name: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    return "is new" if name not in old else "is gone" if name not in new else "changed"


def _name(handle: Handle) -> str:
    return f"{handle.stage} {handle.label}"


def _read(path: Path) -> Keys:
    return read_hint(path, _KEYS) or {}
