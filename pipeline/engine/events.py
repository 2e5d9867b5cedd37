"""What a run tells: a ledger for programs, and on stderr a bar on a terminal, plain lines elsewhere, or nothing.

The ledger is a file of JSON lines, one line a node with its outcome (computed, cached, failed, skipped). Each line is
written as soon as the outcome is known, so a killed run leaves the lines written until then.

Bar and lines count the tasks that have ended, of those that are laid out by then: most are laid out on the way. The
time that is left is estimated by rich, from the pace of the last half minute.
"""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

from rille.pipeline.engine.graph import Handle
from rille.pipeline.engine.plain import plain, raw
from rille.pipeline.engine.runtime.atomic import named
from rille.pipeline.engine.task import Took, map_ports


class Ledger:
    """The ledger file, open for writing; None: nowhere."""

    def __init__(self, path: Path | None) -> None:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
        # Line by line: what a killed run had done by then is in the file.
        self._file = (path or Path(os.devnull)).open("w", encoding="utf-8", buffering=1)

    def write(self, handle: Handle, took: Took) -> None:
        """Write the outcome of a node: sources of its inputs, reason of the cache miss, what it took."""
        row: dict[str, Any] = {
            "label": handle.label,
            "stage": handle.stage,
            "status": handle.status,
            "inputs": map_ports(lambda h: h.label, handle.inputs),
            "reason": handle.reason,
            "key": handle.key,
            "digest": handle.ref and handle.ref.digest,
            "error": handle.error and {"type": type(handle.error).__name__, "message": str(handle.error)},
        }
        figures = asdict(took) if handle.status == "computed" else {}
        figures = {name: round(value, 4) if isinstance(value, float) else value for name, value in figures.items()}
        self._line({name: value for name, value in row.items() if value} | figures)

    def note(self, label: str, status: str, reason: str) -> None:
        """Write a line about a flow that could not go on."""
        self._line({"label": label, "stage": "", "status": status, "reason": reason})

    def run(self, **facts: Any) -> None:
        """A line of facts about the run as a whole."""
        self._line({"run": facts})

    def _line(self, row: dict[str, Any]) -> None:
        with named(Path(self._file.name)):
            self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a ledger, one a node: the last of each, whose artifact may have been found damaged and computed again.

    A last line cut short by a crash is left out.
    """
    return list({row["label"]: row for row in _lines(path) if "label" in row}.values())


def facts(path: Path) -> dict[str, Any]:
    """Read the facts about the run as a whole; a killed run has only those known at its start."""
    found: dict[str, Any] = {}
    for row in _lines(path):
        found |= row.get("run", {})
    return found


def add_facts(path: Path, **facts: Any) -> None:
    """Add a line about the run as a whole to a ledger that is closed."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({"run": facts}) + "\n")


def _lines(path: Path) -> list[dict[str, Any]]:
    rows = []
    with path.open("rb") as file:
        # Bytes of a line; one that reads a million artifacts has less. A file of holes is one line without an end.
        while line := file.readline(100_000_000):
            # The last one may be cut short by a crash; where another is damaged, those behind it count.
            with suppress(ValueError, RecursionError):
                rows.append(json.loads(line.decode()))
    return rows


# -- progress ----------------------------------------------------------------------------------------------------------

INTERVAL = 5.0
"""Seconds between plain lines."""


def make(mode: str = "auto", stream: TextIO | None = None, name: str = "") -> Progress:
    """``auto`` (bar on a terminal, else plain), ``bar``, ``plain``, ``quiet``; ``name``: whose progress it is."""
    if mode == "auto":
        mode = "bar" if (stream or sys.stderr).isatty() else "plain"
    return {"bar": Bar, "plain": Lines, "quiet": Progress}[mode](stream, name)


class Progress:
    """Receives the run's progress: counts the tasks that have ended, and says nothing."""

    def __init__(self, stream: TextIO | None = None, name: str = "") -> None:
        # Lines of several runs, one after another or in threads, stand in one stream.
        self.stream, self.of = stream or sys.stderr, f"{name}: " if name else ""
        self.done, self.shown = 0, time.monotonic()

    def open(self) -> None:
        """The run begins."""

    def resolved(self, handle: Handle, total: int, took: Took) -> None:
        """The outcome of a node is known, and what it took, of so many that are known and wanted by now."""
        self.done += 1

    def failed(self, label: str, error: BaseException) -> None:
        """A task or a flow failed."""

    def close(self) -> None:
        """The run has ended."""


class Lines(Progress):
    """A line every few seconds, and one for each failure: for logs."""

    def resolved(self, handle: Handle, total: int, took: Took) -> None:
        """Say at once what was compiled, and show where the run is."""
        super().resolved(handle, total, took)
        if took.compiling >= 1.0:
            self._say(f"{handle.stage}: compiling, once: {took.compiling:.0f} s")
        self._show(handle, total)

    def _show(self, handle: Handle, total: int) -> None:
        if time.monotonic() - self.shown >= INTERVAL:
            self.shown = time.monotonic()
            self._say(f"{self.done}/{total} tasks, {handle.label} {handle.status}")

    def failed(self, label: str, error: BaseException) -> None:
        """Say so at once."""
        self._say(f"{label} failed ({type(error).__name__})")

    def _say(self, text: str) -> None:
        print(f"rille: {self.of}{text}", file=self.stream, flush=True)


class Bar(Lines):
    """A bar of the tasks that have ended."""

    def __init__(self, stream: TextIO | None = None, name: str = "") -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        super().__init__(stream, name)
        columns = MofNCompleteColumn(), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        named = TextColumn("{task.description}", markup=False)
        self.rich = RichProgress(*columns, named, console=Console(file=raw(self.stream)), transient=True)
        self.task = self.rich.add_task("", total=None)

    def open(self) -> None:
        """Show the bar."""
        self.rich.start()

    def _show(self, handle: Handle, total: int) -> None:
        self.rich.update(self.task, completed=self.done, total=total, description=plain(f"{self.of}{handle.label}"))

    def close(self) -> None:
        """Take the bar away."""
        self.rich.stop()

    def _say(self, text: str) -> None:
        self.rich.console.print(f"rille: {plain(self.of + text)}", markup=False, highlight=False, soft_wrap=True)
