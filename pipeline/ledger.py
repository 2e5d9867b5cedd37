"""Ledger of a run: JSON lines, one for each node as soon as its fate is known, so that it survives a crash."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TextIO

from pipeline.dag import Handle


class Ledger:
    """Writes to a file, or nowhere."""

    def __init__(self, path: Path | None) -> None:
        self._file: TextIO | None = None
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("w", encoding="utf-8", buffering=1)

    def write(self, handle: Handle) -> None:
        """Label, stage, status, reason of the miss, key, digest, seconds, peak memory and error of a node."""
        row: dict[str, Any] = {"label": handle.label, "stage": handle.stage, "status": handle.status}
        if handle.reason:
            row["reason"] = handle.reason
        if handle.key:
            row["key"] = handle.key
        if handle.ref is not None:
            row["digest"] = handle.ref.digest
        if handle.status == "computed":
            row |= {"seconds": round(handle.seconds, 4), "peak_rss": handle.peak_rss}
        if handle.error is not None:
            row["error"] = {"type": type(handle.error).__name__, "message": str(handle.error)}
        self._line(row)

    def note(self, label: str, status: str, reason: str) -> None:
        """A line for what is no node: an expansion that could not be made."""
        self._line({"label": label, "stage": "", "status": status, "reason": reason})

    def _line(self, row: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a ledger; a last line cut short by a crash is left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows


def keys(path: Path) -> set[str]:
    """Keys of all artifacts that the run of a ledger used: what clearing the cache must keep."""
    return {row["key"] for row in read(path) if row["status"] in ("computed", "cached") and "key" in row}
