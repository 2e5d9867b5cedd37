"""``rille runs``, ``timing`` and ``view``: the list of all runs, the time of one by stage, and its report."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from rille.datasets.text.reading import TABLE, read_text
from rille.pipeline.engine import events
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import RUNS, Run, Runs
from rille.stages.core.errors import ConfigError, RilleError
from rille.stages.core.quantities import count


def list_runs(sequence: str = "", *, runs: Runs = RUNS) -> None:
    """List runs, the latest last: name, state, tasks computed and cached, seconds, frames with a pose, and drift.

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


def describe(chosen: Iterable[Path]) -> Iterator[str]:
    """Lines of the table of runs, the latest last."""
    yield f"{'run':44s} {'state':12s} {'computed':>8s} {'cached':>8s} {'seconds':>8s} {'posed':>9s} {'drift':>8s}"
    for run in sorted(chosen, key=lambda run: run.name):
        with lookup.reading(run):
            facts = events.facts(run / lookup.LEDGER)
            outdated = set(facts.get("outdated", ()))
            statuses = Counter(row["status"] for label, row in lookup.tasks(run).items() if label not in outdated)
            # "holes": how much the report lists as missing, as the closing line of the run says.
            whole = "a part" if facts.get("part") else "complete"
            whole = f"{facts['holes']:d} missing" if facts.get("holes") else whole
            # "ok": all tasks have ended; "total": files and report are written too.
            failed = "unfinished" if facts.get("ok", True) else "failed"
            state = whole if "total" in facts else failed
            counts = f"{statuses['computed']:8d} {statuses['cached']:8d}"
            seconds = facts.get("total", facts.get("seconds"))
            took = "" if seconds is None else f"{seconds:.1f}"
            posed, drift = _trajectory(run)
            yield f"{lookup.name(run):44s} {state:12s} {counts} {took:>8s} {posed:>9s} {drift:>8s}".rstrip()


def _trajectory(run: Path) -> tuple[str, str]:
    """Frames with a pose, and drift; empty where there is no report, or not as Rille writes it."""
    with suppress(RilleError), lookup.reading(run):
        report = json.loads(read_text(run / "report.json", "report", TABLE))
        frames, drift = report["frames"], report["metrics"].get("trajectory_drift", {}).get("value")
        return f"{sum(frame['posed'] for frame in frames)}/{len(frames)}", "" if drift is None else f"{drift:.3g} %"
    return "", ""


def timing(run: Run = "latest", *, runs: Runs = RUNS) -> None:
    """Show where the time of a run went, by stage.

    Seconds of all tasks of a stage together; compiling: the part that compiled kernels, or waited for another worker
    that did. The other part of the workers' time reads and commits artifacts, starts workers and waits.
    """
    folder = lookup.find(run, runs)
    with lookup.reading(folder):
        print("\n".join(by_stage(folder)))


def by_stage(run: Path) -> Iterator[str]:
    """Lines of the table of a run's time, the stage with the most seconds first."""
    facts, stages = events.facts(run / lookup.LEDGER), defaultdict[str, Counter[str]](Counter)
    for row in lookup.tasks(run).values():
        sums = Counter({"seconds": row.get("kernel", 0.0), "compiling": row.get("compiling", 0.0), row["status"]: 1})
        stages[row["stage"]] += sums
    wall = facts.get("total", facts.get("seconds"))
    took = "it did not come to its end" if wall is None else f"{wall:.1f} s"
    yield f"run {lookup.name(run)}: {took} with {count(int(facts.get('jobs', 1)), 'worker')}"
    yield f"{'stage':19s} {'seconds':>9s} {'compiling':>9s} {'computed':>8s} {'cached':>8s}"
    largest_first = sorted(stages.items(), key=lambda stage: -stage[1]["seconds"])
    for name, sums in [*largest_first, ("all", sum(stages.values(), Counter[str]()))]:
        yield f"{name:19s} {sums['seconds']:9.1f} {sums['compiling']:9.1f} {sums['computed']:8d} {sums['cached']:8d}"


def view(run: Run = "latest", *, runs: Runs = RUNS) -> None:
    """Open the report of a run in the browser; print its path."""
    from rille.pipeline.python.runs import open_run  # imports NumPy, which a list does not need

    opened = open_run(run, runs)
    page = opened.file("report.html")
    # Over SSH a text browser might take the terminal.
    if sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        opened.show()
    print(page)
