"""Files that appear whole or not at all: the one place that writes beside, flushes, and moves into place.

A file that an interruption leaves behind is named ``.tmp-...``: nobody reads it, and ``rille cache gc`` removes it.
Hints are JSON files that speed up or explain later runs; where one is missing or damaged, nothing else suffers.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

LEFTOVER = ".tmp-"

T = TypeVar("T")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Temporary path of the same name, of a file or folder that becomes ``path`` if the block ends without an error.

    A folder takes the place of one that was there, which is removed first: for a moment there is none, but never a
    mixture. A file never does: that would be a user's folder, with all that is in it.

    Raises
    ------
    IsADirectoryError, NotADirectoryError
        A file was made, and ``path`` is a folder, or the other way round.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    apart = _beside(path)
    # A folder of its own: writers that choose the format by the file name see the final name, and files that they put
    # beside it (GDAL does) are removed with the folder.
    with named(path):
        apart.mkdir()
    try:
        with named(path):
            yield apart / path.name
        if path.exists() and path.is_dir() != (apart / path.name).is_dir():
            number = errno.EISDIR if path.is_dir() else errno.ENOTDIR
            raise OSError(number, os.strerror(number), str(path))
        if path.is_dir() and not path.is_symlink():
            # os.replace cannot replace a folder that is not empty.
            shutil.rmtree(path)
        os.replace(apart / path.name, path)
    finally:
        shutil.rmtree(apart, ignore_errors=True)


def write(path: Path, data: bytes | str) -> None:
    r"""Replace a file. It is not flushed: for what may be lost, but not be half.

    Text is UTF-8; bytes of file names that are none are spelt out (``\udce9``).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _beside(path)  # without a folder of its own, which takes ten times as long
    try:
        with named(path):
            temporary.write_bytes(data.encode(errors="backslashreplace") if isinstance(data, str) else data)
            os.replace(temporary, path)
    finally:
        with suppress(OSError):  # it may not be there; what goes wrong first is said
            temporary.unlink()


def create(path: Path, content: bytes | memoryview) -> bool:
    """Write a file unless there is one, and flush it to the disk before it can be seen; whether it was written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _beside(path)
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            # Contents before name: without this, a power failure could leave the name of an artifact over empty blocks.
            os.fsync(file.fileno())
        try:
            # link, not rename: rename would silently replace the artifact that another process has just published.
            os.link(temporary, path)
        except FileExistsError:
            return False
    finally:
        with suppress(OSError):
            temporary.unlink()
    # Folders are not flushed, which takes as long again: a power failure may take back the last artifacts, each as a
    # whole, and they are computed again.
    return True


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name the file in errors of a block: that of a write to a full disk has no name, others that of a leftover."""
    try:
        yield
    except OSError as error:
        # Without a number its words would be lost.
        if error.errno is not None and (not error.filename or LEFTOVER in str(error.filename)):
            error.filename = str(path)
        raise


def _beside(path: Path) -> Path:
    return path.with_name(f"{LEFTOVER}{uuid.uuid4().hex[:16]}")


def read_hint(path: Path, kind: TypeAdapter[T]) -> T | None:
    """What was left in a file; None if there is none, or something else."""
    # A pipe would block for ever, a device never ends.
    with suppress(OSError, ValueError):
        return None if not path.is_file() else kind.validate_json(path.read_bytes())
    return None


def write_hint(path: Path, value: Any) -> None:
    """Leave a value for later runs; best effort."""
    with suppress(OSError):
        write(path, json.dumps(value))
