"""Numba's cache of compiled kernels on disk, made safe: a damaged file, or another signature's, counts as none.

Numba 0.68 trusts what it finds there. A file cut short (the power failed before it was flushed) fails every later run
until somebody removes it, a flipped bit is executed, and two processes that compile two signatures of one function at
once may both take the same number, so that the index names the other's code. Here each entry is a file of its own,
named by its key; it holds the key and a checksum.
"""

from __future__ import annotations

import hashlib
import importlib.abc
import importlib.util
import pickle
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

CACHING = "numba.core.caching"


def guard() -> None:
    """Make the cache safe in this process, now or as soon as numba is imported; it is not imported for that."""
    if CACHING in sys.modules:
        _patch(sys.modules[CACHING])
    elif not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


class _Finder(importlib.abc.MetaPathFinder):
    """Patches the module once it is there."""

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != CACHING:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_patch(module: ModuleType) -> None:
                run(module)
                _patch(module)

            spec.loader.exec_module = run_and_patch  # type: ignore[method-assign]
        return spec


def _patch(caching: Any) -> None:
    kind = caching.IndexDataCacheFile
    if getattr(kind, "guarded", False):
        return

    def path(self: Any, key: Any) -> Path:
        name = hashlib.sha256(repr((self._version, self._source_stamp, key)).encode()).hexdigest()[:24]
        return Path(self._data_path(f"{self._index_name.removesuffix('.nbi')}.{name}.nbc"))

    def save(self: Any, key: Any, data: Any) -> None:
        body = self._dump((self._version, self._source_stamp, key, data))
        with self._open_for_write(str(path(self, key))) as file:
            file.write(hashlib.sha256(body).digest() + body)

    def load(self: Any, key: Any) -> Any:
        try:
            content = path(self, key).read_bytes()
        except OSError:
            return None
        if hashlib.sha256(content[32:]).digest() != content[:32]:
            return None
        *found, data = pickle.loads(content[32:])
        return data if found == [self._version, self._source_stamp, key] else None

    kind.save, kind.load, kind.flush, kind.guarded = save, load, lambda self: None, True
