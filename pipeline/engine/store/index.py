"""What a sequence's last run found in a folder of artifacts: manifests that nobody touched need not be read again.

A hint beside the artifacts, ``index/<sequence>``: a line for each artifact with the inode, size and times of its
manifest, and what the manifest says of digest, facts and file sizes. A look-up compares the manifest's status with the
line's, and the files' sizes with those of the line; where anything differs, or the index is damaged, the manifest is
read as if there were no index. Any writing to a file changes its time of change, which nobody can set.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import google_crc32c

RACY = 100_000_000
"""Nanoseconds: a manifest that was changed so short a time ago might change again without another time of change."""

SPARE = 3
"""Lines kept of artifacts that a run did not use, for each one that it did."""

KEY = 64
"""Digits of a key."""

Status = tuple[int, int, int, int]


def status(stat: os.stat_result) -> Status:
    """What changes whenever a file does."""
    return stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


@dataclass(frozen=True)
class Entry:
    """What a manifest says, as far as a look-up asks."""

    status: Status
    digest: str
    path: str
    nbytes: int
    stored: int
    meta: dict[str, Any]
    files: dict[str, int]

    def line(self) -> str:
        """JSON of all of it."""
        found = [*self.status, self.digest, self.path, self.nbytes, self.stored, self.meta, self.files]
        return json.dumps(found, separators=(",", ":"))

    @staticmethod
    def read(line: str) -> Entry:
        """Of such a line."""
        ino, size, modified, changed, *rest = json.loads(line)
        return Entry((ino, size, modified, changed), *rest)


@dataclass
class Catalogue:
    """Lines by key; ``found`` are those that were read from manifests since, with the manifest's time of change."""

    path: Path
    lines: dict[str, str] = field(default_factory=dict)
    found: dict[str, tuple[int, str]] = field(default_factory=dict)

    @staticmethod
    def load(path: Path) -> Catalogue:
        """Of a file; a damaged one counts as empty."""
        with suppress(OSError, ValueError):
            data = path.read_bytes()
            head, _, body = data.partition(b"\n")
            if head == _head(body):
                return Catalogue(path, {line[:KEY]: line[KEY + 1 :] for line in body.decode().splitlines()})
        return Catalogue(path)

    def get(self, key: str, now: Status) -> Entry | None:
        """The entry of a key if its manifest still has that status."""
        line = self.lines.get(key)
        if line is None or not line.startswith(f"[{now[0]},{now[1]},{now[2]},{now[3]},"):
            return None
        try:
            return Entry.read(line)
        except (ValueError, TypeError, RecursionError):
            return None

    def enter(self, key: str, entry: Entry) -> None:
        """Take in what a manifest says that was read."""
        self.found[key] = entry.status[3], entry.line()

    def save(self, used: Iterable[str]) -> None:
        """Write the file where manifests were read; ``used`` are the keys that a run asked for. Best effort."""
        settled = time.time_ns() - RACY
        new = {key: line for key, (changed, line) in self.found.items() if changed < settled}
        if not new:
            return
        lines = self.lines | new
        chosen = {key: lines[key] for key in used if key in lines}
        others = [key for key in lines if key not in chosen]
        chosen |= {key: lines[key] for key in others[: SPARE * len(chosen)]}
        body = "".join(f"{key} {line}\n" for key, line in chosen.items()).encode()
        temporary = self.path.with_name(f"{self.path.name}.{os.getpid()}.tmp")
        with suppress(OSError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(_head(body) + b"\n" + body)
            temporary.replace(self.path)
            self.lines, self.found = chosen, {}


def _head(body: bytes) -> bytes:
    return b"rille 1 %08x %d" % (google_crc32c.value(body), len(body))
