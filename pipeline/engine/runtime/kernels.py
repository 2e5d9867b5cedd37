"""Compiled kernels on disk: of this user alone, found by the code that they were made from, checked before they run.

Numba keeps a kernel by the bytes of its own file. It does not notice that a callee in another file has changed
(numba#1833), it trusts what it finds (a file cut short fails every later run, a flipped bit is executed), and two
processes that compile two signatures of one function at once may both take the same number. Here, by what numba offers
for it (locators, events), a kernel

- is known by the digest of its module and of all own modules that this one reaches
  (:mod:`rille.pipeline.engine.keys`), so that an edit compiles anew what it can change, and nothing else;
- is compiled by one process at a time: the others wait, and load it;
- has its checksum in a file beside it, which is compared before numba loads anything;
- lies in a folder of its function (:func:`~rille.pipeline.engine.runtime.private.private_folder`): loading executes it.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import sys
import threading
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any

from pydantic import TypeAdapter

from rille.pipeline.engine.keys import OWN, code_digest, package_of
from rille.pipeline.engine.runtime.atomic import read_hint, write_hint
from rille.pipeline.engine.runtime.private import private_folder

LOCATORS = "NUMBA_CACHE_LOCATOR_CLASSES"
"""Numba's variable of the classes that it asks for the place of a kernel, the first of which knows one."""

LOCATORS_OF_NUMBA = (
    *("UserProvidedCacheLocator", "InTreeCacheLocator", "UserWideCacheLocator"),
    *("IPythonCacheLocator", "ZipCacheLocator"),
)

PATIENCE_SECONDS, PAUSE_SECONDS = 120.0, 0.02
"""Time that a process waits for another that compiles, and between two looks."""

CHECKSUMS, CHECKSUMS_FILE = TypeAdapter(dict[str, str]), "checksums.json"
"""SHA-256 of a kernel's files by their names; the file that holds them."""


def use_own_folder() -> None:
    """Have numba keep own kernels in :func:`folder`, in this process and those that it starts."""
    ours = f"{Locator.__module__}.{Locator.__qualname__}"
    classes = os.environ.get(LOCATORS) or ",".join(LOCATORS_OF_NUMBA)
    if ours not in classes:
        classes = os.environ[LOCATORS] = f"{ours},{classes}"
    if "numba" in sys.modules:  # it has read its variables before
        sys.modules["numba"].config.CACHE_LOCATOR_CLASSES = classes


def folder() -> Path:
    """Return the folder of compiled kernels."""
    return private_folder() / "kernels"


def unused() -> list[Path]:
    """Folders of kernels that no process asked for within thirty days: ``rille cache gc`` removes them."""
    limit, old = time.time() - 30 * 86400, []
    for path in sorted(folder().glob("*")):
        with suppress(FileNotFoundError):  # another process clears up, too
            old += [path] if path.stat().st_mtime <= limit else []
    return old


class Locator:
    """Place of an own function's kernels (the interface of numba's locators)."""

    def __init__(self, function: Any) -> None:
        import numba

        module = function.__module__
        code = (numba.__version__, module, function.__qualname__, code_digest(module), _content(function.__code__))
        self._folder = folder() / hashlib.sha256(repr(code).encode()).hexdigest()[:24]

    @classmethod
    def from_function(cls, function: Any, _: str) -> Locator | None:
        """None for functions of others: numba keeps these as it always does."""
        if package_of(function.__module__) not in OWN:
            return None
        follow_numba()
        locator = cls(function)
        COMPILING.unchecked.append(locator)
        return locator

    def ensure_cache_path(self) -> None:
        """Make the folder; numba saves a kernel next."""
        # For this user alone: whoever writes here runs code when a kernel is loaded.
        for path in (folder(), self._folder):
            path.mkdir(mode=0o700, exist_ok=True)
        COMPILING.saved.append(self)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return what files of one folder must share: its name says it all."""
        return ""

    def get_disambiguator(self) -> str:
        """Return the part of the files' names that tells code apart: their folder does."""
        return ""

    def note_checksums(self) -> None:
        """Write the checksums of the function's kernels."""
        with suppress(OSError):  # cleared away just now
            write_hint(self._folder / CHECKSUMS_FILE, {path.name: _sha256(path) for path in self._files()})

    def remove_damaged(self) -> None:
        """Remove files that are not as they were saved; mark the folder as used."""
        noted = read_hint(self._folder / CHECKSUMS_FILE, CHECKSUMS) or {}
        with suppress(OSError):  # there is none, or it was cleared away just now
            for path in self._files():
                if noted.get(path.name) != _sha256(path):
                    path.unlink()
            os.utime(self._folder)

    def _files(self) -> list[Path]:
        return [*self._folder.glob("*.nb[ic]")]


def _content(code: CodeType) -> tuple[object, ...]:
    """What tells apart two functions of one name that a factory makes; numba's key has the bytecode alone."""
    return code.co_names, [_content(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Compiling:
    """Follows numba while it looks for kernels, compiles and saves them: one process of this user at a time.

    ``seconds`` are those for which this process compiled, or waited for another one; loading alone does not count.

    Attributes
    ----------
    unchecked : functions whose files were not compared with their checksums yet.
    saved : functions of which a kernel is saved just now.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.unchecked: list[Locator] = []
        self.saved: list[Locator] = []
        self._depth, self._since, self._waited, self._change = 0, 0.0, False, threading.Lock()

    def begin(self) -> None:
        """A thread begins; kernels that call each other, and threads, may do so several times."""
        with self._change:
            if self._depth == 0:
                self._since = time.perf_counter()
                self._waited = _lock()
                while self.unchecked:
                    self.unchecked.pop().remove_damaged()
            self._depth += 1

    def end(self) -> None:
        """A thread ends, with a kernel or without one."""
        with self._change:
            self._depth -= 1
            if self._depth == 0:
                compiled = bool(self.saved)
                while self.saved:
                    self.saved.pop().note_checksums()
                _unlock()
                if compiled or self._waited:
                    self.seconds += time.perf_counter() - self._since

    def take(self) -> float:
        """The seconds since this was last asked."""
        seconds, self.seconds = self.seconds, 0.0
        return seconds


COMPILING = Compiling()


@cache
def follow_numba() -> None:
    """Let numba say from now on when it begins and ends."""
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, _: Any) -> None:
            COMPILING.begin()

        def on_end(self, _: Any) -> None:
            COMPILING.end()

    # Numba holds this lock from before it looks for a kernel until it has saved it.
    event.register("numba:compiler_lock", Listener())


@cache
def _locks() -> int:
    """Descriptor of the file that is locked; open as long as the process, for closing it frees the lock."""
    return os.open(private_folder() / "compiling", os.O_RDWR | os.O_CREAT, 0o600)


def _lock() -> bool:
    """Wait until no other process compiles; whether one did. The system frees the lock when that process ends.

    Waiting only saves time: if files cannot be locked, or the other process hangs, both compile.
    """
    begin, waited = time.monotonic(), False
    while time.monotonic() < begin + PATIENCE_SECONDS:
        try:
            # A lock of the system ends with the process; a lock file would outlive a crash.
            fcntl.lockf(_locks(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                break
        waited = True
        time.sleep(PAUSE_SECONDS)
    return waited


def _unlock() -> None:
    with suppress(OSError):
        fcntl.lockf(_locks(), fcntl.LOCK_UN)
