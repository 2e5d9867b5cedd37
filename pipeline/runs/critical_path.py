"""``rille timing RUN``: where the time of a run went, against the least possible time.

The least possible time is the greater of two figures: the sum of all stages' seconds over the number of workers, and
the critical path (the longest chain of tasks that wait for each other). All else is overhead: starting workers, reading
inputs, committing results, waiting.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from rille.datasets.text.count import count
from rille.pipeline.engine import events
from rille.pipeline.runs import lookup

FACTOR, START = 1.15, 5.0
"""A good cold run: this factor over the least possible time, and these seconds to start workers and draw results."""


@dataclass(frozen=True)
class RunTiming:
    """Seconds of a run: ``kernel`` of all stages together, ``tasks`` with reading and committing, the longest chain.

    ``compiling`` is the part of ``kernel`` that compiled kernels (or waited for another worker that did), by stage,
    the most first.
    """

    wall: float
    workers: int
    kernel: float
    tasks: float
    computed: int
    chain: tuple[tuple[str, float], ...]
    compiling: tuple[tuple[str, float], ...]

    @property
    def longest(self) -> float:
        """The longest chain."""
        return sum(seconds for _, seconds in self.chain)

    @property
    def least(self) -> float:
        """Least possible time [s]: no schedule is faster."""
        return max(self.kernel / self.workers, self.longest)

    @property
    def good(self) -> float:
        """Time [s] that a good run does not exceed."""
        return FACTOR * self.least + START


def timing(path: Path) -> RunTiming:
    """Timing of a ledger."""
    rows, facts = events.read(path), events.facts(path)
    took = {r["label"]: float(r["kernel"]) for r in rows if r["status"] == "computed" and "kernel" in r}
    span = [(r["started"], r["ended"]) for r in rows if "started" in r]
    wall = facts.get("total", facts.get("seconds"))
    if wall is None:  # it was killed
        wall = max((end for _, end in span), default=0.0) - min((start for start, _ in span), default=0.0)
    return RunTiming(
        float(wall),
        int(facts.get("jobs", 1)),
        sum(took.values()),
        sum(float(r["seconds"]) for r in rows if r["status"] == "computed"),
        len(took),
        _longest(rows, took, events.expansions(path)),
        _compiling(rows),
    )


def _compiling(rows: Iterable[Mapping[str, Any]]) -> tuple[tuple[str, float], ...]:
    """Seconds of compiling by stage, the most first; none of stages that compiled nothing."""
    seconds: dict[str, float] = defaultdict(float)
    for row in rows:
        if row.get("compiling"):
            seconds[row["stage"]] += row["compiling"]
    return tuple(sorted(seconds.items(), key=lambda item: (-item[1], item[0])))


def _longest(
    rows: list[dict[str, Any]], took: Mapping[str, float], expansions: Iterable[tuple[list[str], list[str]]]
) -> tuple[tuple[str, float], ...]:
    """The chain of tasks, each waiting for the one before, with the greatest sum of seconds."""
    waits: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        own = waits[row["label"]]
        for given in row.get("inputs", {}).values():
            own += given if isinstance(given, list) else [given]
    for number, (after, nodes) in enumerate(expansions):
        waits[f"\0{number}"] += after  # one name for all, else it is each with each
        for node in nodes:
            waits[node].append(f"\0{number}")
    until: dict[str, float] = {}
    via: dict[str, str] = {}
    for label in TopologicalSorter(waits).static_order():
        # Topological order: whatever a task waits for has its time by now.
        before = max(waits.get(label, ()), key=lambda w: until.get(w, 0.0), default="")
        until[label] = took.get(label, 0.0) + until.get(before, 0.0)
        via[label] = before
    chain, at = [], max(until, key=lambda label: until[label], default="")
    while at:
        if took.get(at):
            chain.append((at, took[at]))
        at = via.get(at, "")
    return tuple(reversed(chain))


def describe(run: Path) -> Iterable[str]:
    """Lines on the time of a run."""
    t = timing(run / lookup.LEDGER)
    done = f"{count(t.computed, 'task')} computed with {count(t.workers, 'worker')}"
    yield f"run {lookup.name(run)}: {t.wall:.1f} s, {done}"
    if not t.computed:
        yield "nothing was computed"
        return
    yield f"stages {t.kernel:.1f} s, over the workers {t.kernel / t.workers:.1f} s"
    yield f"longest chain {t.longest:.1f} s: {_chain(t.chain)}"
    share = 100 / (t.wall * t.workers)
    yield (
        f"of the workers' time: stages {share * t.kernel:.0f} %, reading and committing "
        f"{share * (t.tasks - t.kernel):.0f} %, starting, waiting and drawing {100 - share * t.tasks:.0f} %"
    )
    yield f"least possible {t.least:.1f} s; the run took {t.wall / max(t.least, 0.001):.2f} times as long"
    verdict = "kept" if t.wall <= t.good else f"exceeded by {t.wall - t.good:.1f} s"
    yield f"limit of a good run {t.good:.1f} s ({FACTOR} times the least possible and {START:.0f} s): {verdict}"
    if t.compiling:
        yield f"compiling, once a user, {sum(s for _, s in t.compiling):.1f} s of the stages': {_chain(t.compiling)}"


def _chain(chain: tuple[tuple[str, float], ...]) -> str:
    """The chain's tasks, short ones only counted."""
    shown = [f"{label} {seconds:.1f}" for label, seconds in chain if seconds >= 0.05]
    short = len(chain) - len(shown)
    return ", ".join(shown) + (f" and {short} of less than 0.05 s" if short else "")
