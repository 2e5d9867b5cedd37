"""A folder that only this user can write: what is executed or believed unchecked is read from nowhere else.

Compiled kernels are unpickled, so who can write them runs code as the user who loads them. They lie in
``$XDG_CACHE_HOME/rille`` (``~/.cache/rille``), outside of every artifact cache, because a cache may be shared.
"""

from __future__ import annotations

import os
import stat
import tempfile
from functools import cache
from pathlib import Path


@cache
def private_folder() -> Path:
    """``$XDG_CACHE_HOME/rille``, else ``rille-<uid>`` in the temporary folder, else one of this process alone.

    The first that can be made, has room, and that nobody else can write; each process makes the same choice.
    """
    for path in _places():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
            # Looked at after it was made: a folder that somebody else prepared under this name is passed over.
            if _is_private(path):
                with tempfile.TemporaryFile(dir=path) as file:
                    # An empty file fits on a full disk, and into a quota that is used up.
                    file.write(bytes(64_000))
                return path
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="rille-"))


def _places() -> list[Path]:
    base = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    temporary = Path(tempfile.gettempdir()).absolute() / f"rille-{os.geteuid()}"
    return [base / "rille", temporary] if base.is_absolute() else [temporary]


def _is_private(path: Path) -> bool:
    """Whether the folder is this user's and nobody else can write into it, or replace it in its parent.

    Above the parent the permissions are the system's, and are trusted.
    """
    own, parent = path.lstat(), path.parent.stat()  # lstat: a link may lead anywhere
    others = stat.S_IWGRP | stat.S_IWOTH
    return (
        stat.S_ISDIR(own.st_mode)
        and own.st_uid == os.geteuid()
        and not own.st_mode & others
        and parent.st_uid in (0, os.geteuid())
        and (not parent.st_mode & others or bool(parent.st_mode & stat.S_ISVTX))
    )
