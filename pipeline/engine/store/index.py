"""Index of a store: what the manifests of earlier runs' artifacts state, so that these need not be read again.

One table of a SQLite file beside the artifacts. A row has the mark of the artifact's file
(:func:`rille.pipeline.engine.store.folder.mark`), and counts only while the file has the same one. The index is a hint:
where it is missing or locked, manifests are read; one that is damaged or none of ours is set aside.
"""

from __future__ import annotations

import os
import sqlite3
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from rille.pipeline.engine.store.folder import mark, quarantine
from rille.pipeline.engine.store.manifest import Ref

NAME = "index.sqlite"

TABLE = "artifacts (sequence, key, stated, checksum, PRIMARY KEY (sequence, key)) WITHOUT ROWID"
"""``stated`` is JSON, of :data:`STATED`; ``checksum`` is its CRC-32: SQLite sees no flipped bit."""

STATED = TypeAdapter(tuple[str, Ref])
"""Mark of the artifact's file, and the reference to it."""

MAX_INDEX_BYTES = 500_000_000
"""A greater index is set aside, and begun anew: some 350 000 artifacts."""

TIMEOUT_S = 5.0
"""Seconds to wait for another process that writes."""


class Index:
    """Rows of one sequence, read once."""

    def __init__(self, root: Path, sequence: str) -> None:
        self._root, self._sequence = root, sequence
        self._rows: dict[str, tuple[Any, Any]] = {}
        query = "SELECT key, stated, checksum FROM artifacts WHERE sequence = ?"
        try:
            with self._connected("ro") as database:
                self._rows = {key: (stated, checksum) for key, stated, checksum in database.execute(query, [sequence])}
        except (OSError, sqlite3.OperationalError):
            pass  # there is none, or it is locked
        except (sqlite3.Error, ValueError):
            with suppress(OSError):
                quarantine(root / NAME, root, NAME)

    def get(self, stage: str, key: str, at: str) -> Ref | None:
        """Reference to an artifact if its file has the same mark, ``at``, as when it was entered, else None."""
        stated, checksum = self._rows.get(key, ("", None))
        with suppress(ValueError):
            if checksum == zlib.crc32(str(stated).encode()):
                noted, ref = STATED.validate_json(stated)
                if at and (noted, ref.stage, ref.key) == (at, stage, key):
                    return ref
        return None

    def note(self, used: Iterable[Ref]) -> None:
        """Enter artifacts that have no row, or another one. Best effort: it may be locked, or read-only."""
        rows = [row for ref in used for row in self._row(ref) if self._rows.get(ref.key) != row[2:]]
        with suppress(OSError, sqlite3.Error, ValueError):
            if rows:
                (self._root / NAME).touch()  # SQLite itself would deny a shared folder's group to write it
                with self._connected("rw") as database, database:
                    database.executemany("INSERT OR REPLACE INTO artifacts VALUES (?, ?, ?, ?)", rows)

    def _row(self, ref: Ref) -> Iterator[tuple[str, str, str, int]]:
        """Row of an artifact; none if its file has changed, or might have."""
        with suppress(OSError):
            status = os.stat(self._root / ref.path)
            if mark(status) and status.st_size == ref.stored:
                stated = STATED.dump_json((mark(status), ref)).decode()
                yield self._sequence, ref.key, stated, zlib.crc32(stated.encode())

    @contextmanager
    def _connected(self, mode: str) -> Iterator[sqlite3.Connection]:
        """The table, open. Raises ValueError where the file is none of ours."""
        path = self._root / NAME
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_INDEX_BYTES:
            raise ValueError(f"it is not a file of at most {MAX_INDEX_BYTES / 1e6:.0f} MB")
        with closing(sqlite3.connect(f"{path.as_uri()}?mode={mode}", timeout=TIMEOUT_S, uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            if mode == "rw":
                database.execute(f"CREATE TABLE IF NOT EXISTS {TABLE}")
            # A view or a trigger of somebody else's would be a program.
            if database.execute("SELECT sql FROM sqlite_master LIMIT 2").fetchall() != [(f"CREATE TABLE {TABLE}",)]:
                raise ValueError("it has another table")
            yield database
