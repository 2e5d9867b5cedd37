"""Index of a store: what the manifests of earlier runs' artifacts state, so that they need not be read again.

A text file for each sequence, a line an artifact: the CRC-32 of the rest, the artifact's key, the mark of its file
(:func:`rille.pipeline.engine.store.folder.mark`), and the reference to it as JSON. A line counts only while the file
has the same mark. The index is a hint: what is missing or damaged of it is read from manifests, and written anew.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pydantic import TypeAdapter

from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.folder import mark
from rille.pipeline.engine.store.manifest import Ref

NAME = "index.txt"

MAX_INDEX_BYTES = 500_000_000
"""A greater index is not read, and begun anew: some 350 000 artifacts."""

REFERENCE = TypeAdapter(Ref)


class Index:
    """Lines of one sequence, read once; ``hints`` is the sequence's folder of hints."""

    def __init__(self, root: Path, hints: Path) -> None:
        self._root, self._path = root, hints / NAME
        self._lines: dict[str, str] = {}
        with suppress(OSError):
            # A pipe would block for ever.
            if self._path.is_file() and self._path.stat().st_size <= MAX_INDEX_BYTES:
                lines = self._path.read_text(encoding="utf-8", errors="replace").split("\n")
                self._lines = {line.split(" ", 2)[1]: line for line in lines if line.count(" ") > 1}

    def get(self, stage: str, key: str, at: str) -> Ref | None:
        """Reference to an artifact if its file has the same mark, ``at``, as when it was entered, else None."""
        with suppress(ValueError):
            checksum, rest = self._lines.get(key, "").split(" ", 1)
            if at and checksum == _checksum(rest):
                _, noted, stated = rest.split(" ", 2)
                ref = REFERENCE.validate_json(stated)
                if (noted, ref.stage, ref.key) == (at, stage, key):
                    return ref
        return None

    def note(self, used: Iterable[Ref]) -> None:
        """Enter artifacts that have no line, or another one. Best effort: the cache may be read-only."""
        lines = dict(self._lines)
        for ref in used:
            with suppress(OSError):
                status = os.stat(self._root / ref.path)
                if mark(status) and status.st_size == ref.stored:  # else it has changed, or might have
                    rest = f"{ref.key} {mark(status)} {REFERENCE.dump_json(ref).decode()}"
                    lines[ref.key] = f"{_checksum(rest)} {rest}"
        with suppress(OSError):
            if lines != self._lines:
                atomic.write(self._path, "\n".join(lines.values()))


def _checksum(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"
