"""``rille check``: open everything of a sequence, match its first pair, and print one line for each finding."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rille.datasets.protocol import Sequence
from rille.pipeline.commands import complaints
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.run import Result, RunOptions, run
from rille.pipeline.engine.store.base import Store, StoreError
from rille.pipeline.flow import unread
from rille.pipeline.flow.builders import Builder, name_graph
from rille.pipeline.runs.checks.flow import CheckFlow
from rille.pipeline.runs.checks.limits import Finding
from rille.pipeline.runs.crate import resolved
from rille.pipeline.runs.options import COMPLETE, FAILED, Settings, cache_folder
from rille.pipeline.runs.session import settings
from rille.stages.core.errors import RilleError


def check(seq: str, *more: str, options: Settings = Settings()) -> int:
    """Check sequences: open everything, match the first pair of each, and print one finding a line.

    Parameters
    ----------
    seq
        As for reconstruct.
    more
        Others, which follow; the exit code is that of the worst.
    """
    if not more:
        return _check(seq, options)
    return complaints.each((seq, *more), lambda name: (_check(name, options), ""), keep_going=True)[0]


def _check(seq: str, options: Settings) -> int:
    seq, options, _ = resolved(seq, options)
    settled = settings(seq, options)
    nobody = type(settled.config).model_fields.keys() - unread.CHECKED
    unread.refuse(settled.given, settled.config, nobody, "a check")
    return inspect(settled.sequence, settled.config, settled.frames, cache_folder(options.cache))


def inspect(sequence: Sequence, config: Any, frames: tuple[int, ...], cache: Path) -> int:
    """Print a line for each finding; 0, or 1 where something fails."""
    with ExitStack() as ends:
        graph, store, kept = Graph(), Store(cache), list[Finding]()
        try:
            store.writable()
        except StoreError as error:
            # For example a read-only disk.
            kept.append(Finding("", f"{error.message}: what is computed is not kept", "cache"))
            store = Store(ends.enter_context(TemporaryDirectory(prefix="rille-")))
        name_graph(graph, sequence, frames)
        checking = CheckFlow(Builder(graph, sequence, config), frames, store)
        checking.say(*kept)
        graph.flow(checking.steps())
        # In this process, because the start of workers would take longer than most tasks.
        result = run(graph, store, RunOptions(executor="inline", keep_going=True))
    # Errors of stages are findings, already printed; any other failure is a fault of the program.
    Result(failures=[f for f in result.failures if not (f.stage and isinstance(f.error, RilleError))]).check()
    levels = checking.levels
    print(f"{sequence.name}: {levels['FAIL']} fail, {levels['WARN']} to look at, {levels['OK']} fine")
    return FAILED if levels["FAIL"] else COMPLETE
