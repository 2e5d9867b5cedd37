"""Compiled kernels on disk: of this user alone, found by the code that they were made from, checked before they run.

Numba 0.68 keeps a kernel by the path and the bytes of its own file. It does not notice that a callee in another file
has changed (numba#1833), it trusts what it finds (a file cut short fails every later run, a flipped bit is executed),
and two processes that compile two signatures of one function at once may both take the same number. Here

- a kernel is known by the digest of its module and of all own modules that this one reaches
  (:mod:`rille.pipeline.engine.code_digest`), so that an edit compiles anew what it can change, and nothing else;
- each entry is a file of its own, named by its key; it holds the key and a checksum, against damage;
- of processes that need the same kernel at once one compiles it, the others wait and load it;
- a kernel has no wrapper for callers in C;
- all lie in :func:`rille.pipeline.engine.runtime.private.private_folder`, because loading one executes it.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import pickle
import sys
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from rille.pipeline.engine.code_digest import OWN, code_digest, package_of
from rille.pipeline.engine.runtime.apart import Execute, hook
from rille.pipeline.engine.runtime.private import private_folder

DISPATCHER = "numba.core.dispatcher"
"""Imports ``numba.core.caching``; nothing is compiled before it is there."""

UNUSED_DAYS = 30
"""A kernel that was not loaded for so long is removed by ``rille cache gc``."""


PATIENCE, PAUSE = 120.0, 0.02
"""Seconds that a process waits for another that compiles the same kernel, and between two looks."""


class Compiling:
    """Seconds for which kernels are compiled in this process, from the first that is not on disk to the last saved.

    Waiting for another process that compiles the same kernel counts as compiling.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.pending: set[str] = set()
        self.since = 0.0

    def begin(self, key: str) -> None:
        """A kernel is not on disk: numba compiles it next, and whatever it calls in between."""
        if not self.pending:
            self.since = time.perf_counter()
        self.pending.add(key)
        _lock(key)

    def end(self, key: str) -> None:
        """It is compiled and saved, by this process or another."""
        known = key in self.pending
        self.pending.discard(key)
        _unlock(key)
        if known and not self.pending:
            self.seconds += time.perf_counter() - self.since

    def take(self) -> float:
        """The seconds since this was last asked."""
        seconds, self.seconds = self.seconds, 0.0
        if self.pending:  # numba failed to compile them
            for key in self.pending:
                _unlock(key)
            self.pending.clear()
        return seconds


COMPILING = Compiling()


@cache
def _locks() -> int:
    """Descriptor of the file whose bytes are locked; open as long as the process, for closing it frees every lock."""
    return os.open(private_folder() / "compiling", os.O_RDWR | os.O_CREAT, 0o600)


def _byte(key: str) -> int:
    """The byte that stands for a kernel; the file stays empty."""
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:7], "big")


def _lock(key: str) -> None:
    """Wait until no other process compiles the kernel; the system frees the byte when that process ends.

    Waiting only saves time: if files cannot be locked, or the other process hangs, both compile. A kernel is
    locked before those that it calls, so that no two processes wait for each other.
    """
    until = time.monotonic() + PATIENCE
    while True:
        try:
            # A lock of the system ends with the process; a lock file would outlive a crash.
            fcntl.lockf(_locks(), fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _byte(key))
            return
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN) or time.monotonic() > until:
                return
        time.sleep(PAUSE)


def _unlock(key: str) -> None:
    with suppress(OSError):
        fcntl.lockf(_locks(), fcntl.LOCK_UN, 1, _byte(key))


def guard() -> None:
    """Make the cache safe in this process, now or as soon as numba is imported; it is not imported for that."""
    if DISPATCHER in sys.modules:
        _patch(sys.modules[DISPATCHER])
    else:
        hook(DISPATCHER, _run_and_patch)


def folder() -> Path:
    """Return the folder of compiled kernels."""
    return private_folder() / "kernels"


def unused() -> list[Path]:
    """Kernels that nothing loaded for :data:`UNUSED_DAYS`."""
    limit, found = time.time() - 86400 * UNUSED_DAYS, []
    for path in sorted(folder().glob("*")):
        with suppress(FileNotFoundError):  # numba renames a file as soon as it is written
            found += [path] if path.stat().st_mtime <= limit else []
    return found


def _run_and_patch(execute: Execute, module: ModuleType) -> None:
    """Patch right behind the import of the dispatcher, before the first decorator of numba can run."""
    execute(module)
    _patch(module)


class _Locator:
    """Place and stamp of an own module's kernels (the interface of numba's locators)."""

    def __init__(self, function: Any, file: str) -> None:
        module = function.__module__
        self._stamp = repr((module, function.__qualname__, code_digest(module), _content(function.__code__)))
        self._py_file = file  # numba names it in a warning

    @classmethod
    def from_function(cls, function: Any, file: str) -> _Locator | None:
        """None for functions of others: numba keeps these as it always does."""
        return cls(function, file) if _is_own(function) else None

    def ensure_cache_path(self) -> None:
        # For this user alone: whoever writes here runs code when a kernel is loaded.
        folder().mkdir(mode=0o700, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(folder())

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return "own"


def _is_own(function: Any) -> bool:
    return package_of(function.__module__) in OWN


def _content(code: CodeType) -> tuple[object, ...]:
    """What tells apart two functions of one name that a factory makes; numba's key has the bytecode alone."""
    return code.co_names, [_content(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]


def _patch(module: Any) -> None:
    from numba.core import caching

    kind = caching.IndexDataCacheFile
    if getattr(kind, "guarded", False):
        return
    cached = module.Dispatcher.enable_caching

    def enable_caching(self: Any) -> None:
        if _is_own(self.py_func):
            # Nothing in C calls a kernel; without that wrapper three kernels of the mockup compile in 0.62 s, not 0.80.
            self.targetoptions.setdefault("no_cfunc_wrapper", True)
        cached(self)

    module.Dispatcher.enable_caching = enable_caching

    def path(self: Any, key: Any) -> Path:
        content = (self._version, self._source_stamp, key)
        name = hashlib.sha256(repr(content).encode()).hexdigest()[:24]
        return Path(self._data_path(f"{self._index_name.removesuffix('.nbi')}.{name}.nbc"))

    def save(self: Any, key: Any, data: Any) -> None:
        body = self._dump((self._version, self._source_stamp, key, data))
        with self._open_for_write(str(path(self, key))) as file:
            file.write(hashlib.sha256(body).digest() + body)
        COMPILING.end(str(path(self, key)))

    def load(self: Any, key: Any) -> Any:
        file = path(self, key)
        if (data := read(self, key, file)) is None:
            COMPILING.begin(str(file))
            if (data := read(self, key, file)) is not None:  # another process compiled it meanwhile
                COMPILING.end(str(file))
        return data

    def read(self: Any, key: Any, file: Path) -> Any:
        try:
            content = file.read_bytes()
        except OSError:
            return None
        # A damaged pickle could crash the process when it is loaded.
        if hashlib.sha256(content[32:]).digest() != content[:32]:
            return None
        with suppress(OSError):
            os.utime(file)  # it is in use
        *found, data = pickle.loads(content[32:])
        return data if found == [self._version, self._source_stamp, key] else None

    kind.save, kind.load, kind.flush, kind.guarded = save, load, lambda self: None, True
    caching.CacheImpl._locator_classes.insert(0, _Locator)
