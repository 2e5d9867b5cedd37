"""The folder of a store, and its files; nothing here knows what an artifact is.

Paths are relative to the folder, with ``/``.
"""

from __future__ import annotations

import json
import os
import re
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from rille.pipeline.engine.failures import CLOSED, FULL
from rille.pipeline.engine.runtime import atomic
from rille.stages.core.errors import ConfigError, RilleError

MARK, FORMAT = "rille.json", 2
"""File that says in which format the artifacts are."""

RACY = 0.1
"""Seconds: a file that was changed so short a time ago might change again within one tick of the clock."""

USED = 3600.0
"""Seconds after which a look-up touches a file again, well below the grace of clearing up."""


class StoreError(RilleError):
    """The cache cannot be read or written."""


class Item(NamedTuple):
    """A file; ``mark`` changes whenever its content does (empty: it might change and have the same one).

    ``modified`` is in seconds since 1970.
    """

    path: str
    size: int
    mark: str
    modified: float


def locate(cache: Path | str) -> Path:
    """Return the folder of a cache.

    Raises
    ------
    ConfigError
        It is a URL; the message does not repeat what may be a password.
    """
    text = str(cache)
    # A Path has lost the second slash of a URL.
    if "://" in text or (isinstance(cache, Path) and re.match(r"[a-z0-9]+:/", text)):
        raise ConfigError(
            "RIL-546",
            f"a cache at {text.partition(':')[0]}:// is not supported",
            remedy="give --cache a folder; machines share one by NFS, say",
        )
    return Path(cache)


class Folder:
    """Files below ``root``, which is made when the first one is written.

    Where the disk refuses, a method raises a :class:`StoreError` in one line.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def begin(self) -> None:
        """Try to write a block, and note the format."""
        with self._clear_errors():
            self.root.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.root) as file:
                # An empty file fits on a full disk; a block does not.
                file.write(b"\0" * 4096)
                file.flush()
            if not (self.root / MARK).exists():
                atomic.write(self.root / MARK, json.dumps({"format": FORMAT}))

    def earlier(self) -> bool:
        """Whether artifacts of an earlier format are here: there are some, and no mark."""
        return (self.root / "artifacts").is_dir() and not (self.root / MARK).exists()

    def status(self, path: str) -> Item | None:
        """Return the status of a file, None if there is none.

        The mark has inode, size and times; no call can set the time of change.
        """
        with self._clear_errors():
            try:
                return _item(path, os.stat(f"{self.root}/{path}"))  # no Path: a plan asks tens of thousands of times
            except FileNotFoundError:
                return None

    def use(self, item: Item) -> Item | None:
        """Touch a file that nobody touched for :data:`USED`: :meth:`clear` spares it. None if it has gone."""
        if item.modified > time.time() - USED:
            return item
        try:
            os.utime(f"{self.root}/{item.path}")
        except FileNotFoundError:
            return None
        except OSError:
            return item  # it may permit reading alone: then nobody clears it up by these rights
        return self.status(item.path)

    def read(self, path: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """Return bytes ``start`` to ``stop`` (exclusive) of a file, fewer if it ends before; None if there is no file.

        Without ``stop`` the whole file is returned. A pipe or a device is no file.
        """
        with self._clear_errors():
            try:
                with open(f"{self.root}/{path}", "rb", buffering=0, opener=_at_once) as file:
                    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                        return None
                    return os.pread(file.fileno(), stop - start, start) if stop is not None else file.read()
            except (FileNotFoundError, IsADirectoryError):
                return None

    def write(self, path: str, data: bytes) -> None:
        """Replace a file, whole or not at all."""
        with self._clear_errors():
            atomic.write(self.root / path, data)

    def create(self, path: str, pieces: Iterable[bytes]) -> bool:
        """Write a file unless there is one, durably before it can be seen. False: there is one."""
        with self._clear_errors():
            return atomic.create(self.root / path, pieces)

    def list(self, area: str) -> Iterable[Item]:
        """All files below a folder, in order of their names."""
        top = f"{self.root}/{area}".rstrip("/")
        found = []
        for folder, _, names in os.walk(top):
            within = os.path.relpath(folder, self.root).replace(os.sep, "/")
            for name in names:
                with suppress(OSError):  # gone meanwhile
                    path = name if within == "." else f"{within}/{name}"
                    found.append(_item(path, os.lstat(f"{folder}/{name}")))
        return sorted(found)

    def move(self, path: str, to: str) -> None:
        """Rename a file; nothing where it has gone."""
        with self._clear_errors(), suppress(FileNotFoundError):
            target = self.root / to
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(self.root / path, target)

    def delete(self, paths: Iterable[str]) -> None:
        """Remove files, and the folders that they leave empty; best effort, somebody else may clear away too."""
        for path in paths:
            with suppress(OSError):
                (self.root / path).unlink(missing_ok=True)
                self._prune(path)

    def clear(self, items: Iterable[Item]) -> None:
        """Remove files as :meth:`delete` does, but those that somebody used or changed since they were listed.

        Raises
        ------
        StoreError
            This user may not remove some of them; all others are gone.
        """
        refused: OSError | None = None
        for item in items:
            try:
                atomic.remove(self.root / item.path, item.modified)
            except OSError as error:  # another error: somebody else cleared it away
                refused = error if error.errno in CLOSED else refused
                continue
            with suppress(OSError):
                self._prune(item.path)
        if refused is not None:
            with self._clear_errors():
                raise refused

    def _prune(self, path: str) -> None:
        for above in list(Path(path).parents)[:-2]:  # the areas themselves stay
            # rmdir refuses a folder that is not empty; the callers suppress that error, and it ends the loop.
            (self.root / above).rmdir()

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in FULL:
                raise StoreError(
                    "RIL-574",
                    f"no space left for the cache {self.root}",
                    remedy="free space, clear the cache, or choose another folder with --cache",
                ) from error
            if error.errno in CLOSED:
                raise StoreError(
                    "RIL-575",
                    f"the cache {self.root} may not be used ({os.strerror(error.errno)})",
                    remedy="choose another folder with --cache",
                ) from error
            if isinstance(error, NotADirectoryError | FileExistsError) and not self.root.is_dir():
                raise StoreError(
                    "RIL-576", f"the cache {self.root} is not a folder", remedy="choose one with --cache"
                ) from error
            raise


def _at_once(path: str, flags: int) -> int:
    """Open a file; of a pipe, do not wait for who writes to it."""
    return os.open(path, flags | os.O_NONBLOCK)


def _item(path: str, found: os.stat_result) -> Item:
    racy = max(found.st_mtime, found.st_ctime) > time.time() - RACY
    mark = "" if racy else f"{found.st_ino:x}.{found.st_size:x}.{found.st_mtime_ns:x}.{found.st_ctime_ns:x}"
    return Item(path, found.st_size, mark, found.st_mtime)
