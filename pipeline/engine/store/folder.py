"""The folder of a store, and its files; nothing here knows what an artifact is."""

from __future__ import annotations

import errno
import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rille.pipeline.engine.failures import CLOSED, FULL, remedy_of
from rille.stages.core.errors import ConfigError, RilleError


class StoreError(RilleError):
    """The cache cannot be read or written."""


def locate(cache: Path | str) -> Path:
    """Folder of a cache.

    Raises
    ------
    ConfigError
        It is a URL; the message does not repeat what may be a password.
    """
    if re.match(r"\w+:/", str(cache)):  # a Path has lost the second slash
        text = f"a cache at {str(cache).partition(':')[0]}:// is not supported"
        raise ConfigError("RIL-546", text, remedy="give --cache a folder; machines share one by NFS, say")
    return Path(cache)


@contextmanager
def clear_errors(root: Path) -> Iterator[None]:
    """Raise as a :class:`StoreError` where the disk below ``root`` is full, or refuses; other errors may be passing."""
    try:
        yield
    except OSError as error:
        if error.errno not in (*FULL, *CLOSED, errno.ENOTDIR):
            raise
        text = f"the cache {root} cannot be used ({os.strerror(error.errno)})"
        raise StoreError("RIL-575", text, remedy=remedy_of(error.errno)) from error


def files(root: Path, area: str) -> list[tuple[str, os.stat_result]]:
    """All files below a folder in ``root``: their paths relative to ``root``, in order, and their status."""
    listed = []
    for folder, _, names in os.walk(root / area):
        for path in (Path(folder, name) for name in names):
            with suppress(OSError):  # gone meanwhile
                listed.append((path.relative_to(root).as_posix(), path.lstat()))
    return sorted(listed)


def quarantine(path: Path, root: Path, name: str) -> Path:
    """Move a file aside; its new path, whose name begins with ``name``."""
    aside = root / "quarantine" / f"{name}-{uuid.uuid4().hex[:8]}"
    aside.parent.mkdir(parents=True, exist_ok=True)
    os.rename(path, aside)
    return aside
