"""Progress of a run on stderr: a bar with an estimate on a terminal, plain lines elsewhere, or nothing.

The estimate of the time left is that of :mod:`rille.pipeline.engine.estimate`.
"""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, TextIO

from rille.pipeline.engine.estimate import Earlier, TimeEstimate
from rille.pipeline.engine.plain import plain, raw
from rille.stages.core.errors import ConfigError

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Graph, Handle
    from rille.pipeline.engine.run import Result

INTERVAL = 5.0
"""Seconds between plain lines."""


SLOW_COMPILE = 1.0
"""Seconds of compilation from which on it is reported to the user."""


def make(mode: str = "auto", stream: TextIO | None = None, *, verbose: bool = False) -> Progress:
    """``auto`` (bar on a terminal, else plain), ``bar``, ``plain``, ``quiet``; ``verbose``: with details."""
    stream = stream or sys.stderr
    if mode == "auto":
        mode = "bar" if stream.isatty() else "plain"
    kinds: dict[str, type[Progress]] = {"bar": Bar, "plain": Lines, "quiet": Progress}
    if mode not in kinds:
        raise ConfigError("RIL-568", f"progress {mode!r} is unknown", remedy=f"one of auto, {', '.join(kinds)}")
    progress = kinds[mode](stream)
    progress.verbose = verbose
    return progress


class Progress:
    """Receives the run's progress: keeps the account that others show, and says nothing."""

    verbose = False

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.graph: Graph | None = None
        self.estimate = TimeEstimate([], {}, 1)
        self.seen = 0
        self.done = 0

    def open(self, graph: Graph, earlier: Earlier, jobs: int) -> None:
        """The run begins: begin the estimate with the tasks that are laid out; the graph may still grow."""
        self.graph, self.seen = graph, len(graph.nodes)
        self.estimate = TimeEstimate([h.stage for h in graph.nodes], earlier, max(jobs, 1))

    def detail(self, text: str) -> None:
        """A word for who asks for more of them."""
        if self.verbose:
            print(f"rille: {plain(text)}", file=self.stream, flush=True)

    def running(self, handle: Handle) -> None:
        """A task was given to a worker."""

    def resolved(self, handle: Handle) -> None:
        """The outcome of a node is known: count it, and what was laid out meanwhile."""
        self.done += 1
        if self.graph is not None:
            for added in self.graph.nodes[self.seen :]:
                self.estimate.added(added.stage)
            self.seen = len(self.graph.nodes)
        self.estimate.end(handle)

    def failed(self, label: str, error: BaseException) -> None:
        """A task or an expansion failed."""

    def close(self, result: Result) -> None:
        """The run has ended."""

    def total(self) -> int:
        """Nodes that are known and wanted by now."""
        if self.graph is None:
            return 0
        return len(self.graph.nodes if self.graph.cut is None else self.graph.asked)


class Lines(Progress):
    """A line every few seconds, and one for each failure: for logs."""

    def open(self, graph: Graph, earlier: Earlier, jobs: int) -> None:
        """Begin the clock."""
        super().open(graph, earlier, jobs)
        self.shown = time.monotonic()

    def resolved(self, handle: Handle) -> None:
        """Say where we are, now and then, and at once what was compiled."""
        super().resolved(handle)
        self._compiled(handle)
        if time.monotonic() - self.shown >= INTERVAL:
            self.shown = time.monotonic()
            self._say(f"{self.done}/{self.total()} tasks, {handle.label} {handle.status}{to_go(self.estimate)}")

    def _compiled(self, handle: Handle) -> None:
        if handle.took.compiling >= SLOW_COMPILE:
            self._say(f"{handle.stage}: compiling, once: {handle.took.compiling:.0f} s")

    def failed(self, label: str, error: BaseException) -> None:
        """Say so at once."""
        self._say(f"{label} failed ({type(error).__name__})")

    def close(self, result: Result) -> None:
        """One closing line."""
        self._say(summary(result))

    def _say(self, text: str) -> None:
        print(f"rille: {text}", file=self.stream, flush=True)


class Bar(Lines):
    """A bar that moves with the estimated work done."""

    def open(self, graph: Graph, earlier: Earlier, jobs: int) -> None:
        """Show the bar."""
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress

        super().open(graph, earlier, jobs)
        columns = (
            TextColumn("{task.fields[count]}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
        )
        self.rich = RichProgress(*columns, console=Console(file=raw(self.stream)), transient=True)
        self.task = self.rich.add_task("", total=None, count="")
        self.begin = time.monotonic()
        self.rich.start()

    def running(self, handle: Handle) -> None:
        """Name what runs."""
        self._move(handle.label)

    def resolved(self, handle: Handle) -> None:
        """Move the bar."""
        Progress.resolved(self, handle)
        self._compiled(handle)
        self._move(handle.label)

    def _move(self, label: str) -> None:
        left = self.estimate.left()
        gone = time.monotonic() - self.begin
        self.rich.update(
            self.task,
            completed=gone,
            total=None if left is None else gone + left,
            count=f"{self.done}/{self.total()}",
            description=plain(label) + to_go(self.estimate),
        )

    def close(self, result: Result) -> None:
        """Take the bar away."""
        if hasattr(self, "rich"):
            self.rich.stop()
        super().close(result)

    def _say(self, text: str) -> None:
        if hasattr(self, "rich"):
            self.rich.console.print(f"rille: {plain(text)}", markup=False, highlight=False, soft_wrap=True)


def summary(result: Result) -> str:
    """``12 computed, 388 cached in 14.2 s``, with what failed or was left out."""
    total = result.total()
    parts = [f"{total.computed} computed", f"{total.cached} cached"]
    parts += [f"{n} {what}" for what, n in (("planned", total.planned), ("failed", total.failed)) if n]
    parts += [f"{total.skipped} left out"] if total.skipped else []
    return f"{', '.join(parts)} in {result.seconds:.1f} s"


def to_go(estimate: TimeEstimate) -> str:
    """``, about 42 s left``; empty where nothing is known."""
    left = estimate.left()
    return "" if left is None else f", about {clock(left)} left"


def clock(seconds: float) -> str:
    """``42 s``, ``7 min``."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
