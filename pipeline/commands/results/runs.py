"""``rille runs``: the list of all runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from rille.pipeline.commands.options import COMPLETE, RUNS, Runs
from rille.pipeline.engine import events
from rille.pipeline.runs import lookup
from rille.stages.core.errors import ConfigError


def list_runs(sequence: str = "", *, runs: Runs = RUNS) -> int:
    """List runs, the latest last: name, state, tasks computed and cached, seconds.

    Parameters
    ----------
    sequence
        Runs of this sequence only; all by default.
    """
    chosen = [run for run in lookup.all_runs(runs) if sequence in ("", run.parent.name)]
    if not chosen:
        text = f"{runs} holds no run{f' of {sequence}' if sequence else ''}"
        raise ConfigError("RIL-880", text, remedy="check --runs")
    print("\n".join(describe(chosen)))
    return COMPLETE


def describe(chosen: Iterable[Path]) -> Iterator[str]:
    """Lines of the table of runs, the latest last."""
    yield f"{'run':44s} {'state':12s} {'computed':>8s} {'cached':>8s} {'seconds':>8s}"
    for run in sorted(chosen, key=lambda run: run.name):
        with lookup.reading(run):
            statuses = Counter(row["status"] for row in events.read(run / lookup.LEDGER))
            facts = events.facts(run / lookup.LEDGER)
            seconds = facts.get("total", facts.get("seconds"))
            missing = statuses["failed"] + statuses["skipped"]
            # "ok": all tasks have ended; "total": the files and the report are written, too.
            whole = "complete" if "total" in facts else "interrupted"
            state = "interrupted" if "ok" not in facts else f"{missing} missing" if missing else whole
            took = "" if seconds is None else f"{seconds:.1f}"
            counts = f"{statuses['computed']:8d} {statuses['cached']:8d}"
            yield f"{lookup.name(run):44s} {state:12s} {counts} {took:>8s}"
