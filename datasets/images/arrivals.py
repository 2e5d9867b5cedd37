"""Image files that are still being written: detect which are complete."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from rille.datasets.images.files import Digests, read_grey
from rille.stages.core.errors import InputError

SETTLE_SECONDS = 0.5
"""Seconds without a change of size and modification time before a file is read."""

WRITTEN = "is still being written"


@dataclass
class _Seen:
    """A file as it was seen last; ``trouble``: why it is incomplete; empty: it is complete."""

    size: int
    changed_ns: int
    since: float
    trouble: str = WRITTEN


class Arrivals(Digests):
    """Files of a sequence whose images arrive: a file counts once it no longer changes, and decodes.

    Attributes
    ----------
    changed : time when a file was last new or changed, by the monotonic clock, s.
    """

    growing = True

    def __init__(self, memory: Path | None = None) -> None:
        super().__init__(memory)
        self.changed = time.monotonic()
        self._seen: dict[Path, _Seen] = {}

    def whole(self, path: Path) -> bool:
        """Whether the file no longer changes, and decodes."""
        try:
            status = path.stat()
        except OSError:  # removed since the folder was listed
            return False
        now, path = time.monotonic(), path.resolve()
        seen = self._seen.get(path)
        if seen is None or (seen.size, seen.changed_ns) != (status.st_size, status.st_mtime_ns):
            self.changed = now
            self._seen[path] = _Seen(status.st_size, status.st_mtime_ns, now)
            return False
        if seen.trouble == WRITTEN and now - seen.since >= SETTLE_SECONDS:
            seen.trouble = ""
            try:
                read_grey(path)
            except InputError as error:
                seen.trouble = error.message
        return not seen.trouble

    def first_seen(self, path: Path) -> float:
        """Time when the file was first seen in its present state, by the monotonic clock, s."""
        return self._seen[path.resolve()].since

    def troubles(self) -> list[str]:
        """Why files are incomplete, one line each."""
        there = ((path, seen.trouble) for path, seen in self._seen.items() if seen.trouble and path.exists())
        return [f"{path} {WRITTEN}" if trouble == WRITTEN else trouble for path, trouble in there]
