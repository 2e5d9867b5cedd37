"""Progress of a run on stderr: a bar on a terminal, plain lines elsewhere, or nothing.

Both count the tasks that have ended, of those that are laid out by then: most are laid out on the way. The time that is
left is estimated by rich, from the pace of the last half minute.
"""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, TextIO

from rille.pipeline.engine.plain import plain, raw

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Handle
    from rille.pipeline.engine.task import Took

INTERVAL = 5.0
"""Seconds between plain lines."""


def make(mode: str = "auto", stream: TextIO | None = None) -> Progress:
    """``auto`` (bar on a terminal, else plain), ``bar``, ``plain``, ``quiet``."""
    if mode == "auto":
        mode = "bar" if (stream or sys.stderr).isatty() else "plain"
    return {"bar": Bar, "plain": Lines, "quiet": Progress}[mode](stream)


class Progress:
    """Receives the run's progress: counts the tasks that have ended, and says nothing."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
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
        print(f"rille: {text}", file=self.stream, flush=True)


class Bar(Lines):
    """A bar of the tasks that have ended."""

    def __init__(self, stream: TextIO | None = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        super().__init__(stream)
        columns = MofNCompleteColumn(), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        named = TextColumn("{task.description}", markup=False)
        self.rich = RichProgress(*columns, named, console=Console(file=raw(self.stream)), transient=True)
        self.task = self.rich.add_task("", total=None)

    def open(self) -> None:
        """Show the bar."""
        self.rich.start()

    def _show(self, handle: Handle, total: int) -> None:
        self.rich.update(self.task, completed=self.done, total=total, description=plain(handle.label))

    def close(self) -> None:
        """Take the bar away."""
        self.rich.stop()

    def _say(self, text: str) -> None:
        self.rich.console.print(f"rille: {plain(text)}", markup=False, highlight=False, soft_wrap=True)
