"""``rille timing RUN``: where the time of a run went, by stage, from its ledger."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

from rille.datasets.text.count import count
from rille.pipeline.commands.options import COMPLETE, RUNS, Run, Runs
from rille.pipeline.engine import events
from rille.pipeline.runs import lookup


def timing(run: Run = "latest", *, runs: Runs = RUNS) -> int:
    """Show where the time of a run went, by stage.

    Seconds of all tasks of a stage together; compiling: the part that compiled kernels, or waited for another worker
    that did. The other part of the workers' time reads and commits artifacts, starts workers and waits.
    """
    folder = lookup.find(run, runs)
    with lookup.reading(folder):
        print("\n".join(table(folder)))
    return COMPLETE


def table(run: Path) -> Iterator[str]:
    """Lines of the table, the stage with the most seconds first."""
    rows, facts = events.read(run / lookup.LEDGER), events.facts(run / lookup.LEDGER)
    by_stage = defaultdict[str, Counter[str]](Counter)
    for row in rows:
        sums = Counter({"seconds": row.get("kernel", 0.0), "compiling": row.get("compiling", 0.0), row["status"]: 1})
        by_stage[row["stage"]] += sums
    wall = facts.get("total", facts.get("seconds"))
    took = "it did not come to its end" if wall is None else f"{wall:.1f} s"
    yield f"run {lookup.name(run)}: {took} with {count(int(facts.get('jobs', 1)), 'worker')}"
    yield f"{'stage':19s} {'seconds':>9s} {'compiling':>9s} {'computed':>8s} {'cached':>8s}"
    stages = sorted(by_stage.items(), key=lambda stage: -stage[1]["seconds"])
    for name, sums in [*stages, ("all", sum(by_stage.values(), Counter[str]()))]:
        yield (f"{name:19s} {sums['seconds']:9.1f} {sums['compiling']:9.1f} {sums['computed']:8d} {sums['cached']:8d}")
