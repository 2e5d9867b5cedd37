"""The time that a run still needs, from what it has done and from what runs like it took.

A kind of task is its label without numbers, such as ``locus/world``. The time left is the sum over kinds of *tasks to
come x seconds a task*, over the workers, and of the seconds for which kernels are still to be compiled:

- Tasks to come are those laid out already, or as many as a run of this size has: the number of tasks that are laid out
  later grows with the number at the start. If some tasks of a kind were found in the cache after computing began, the
  same share of the others is expected there.
- Seconds a task are the mean of those measured in this run. For a kind that has not run yet they are the earlier ones
  times the pace: the median of measured over earlier seconds, each kind weighed by the root of its seconds.
- Compiling is expected as before, times the share of it that the kinds so far did compile: none where the kernels
  are there.

What is earlier comes from the last run of the sequence; before the first one it is :data:`REFERENCE`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter

from rille.pipeline.engine.reference import REFERENCE
from rille.pipeline.engine.runtime.hints import read_hint, write_hint

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Handle

Kinds = Mapping[str, tuple[float, float, float]]
"""Of each kind of task: tasks laid out on the way over all those laid out when the run opened, mean seconds of a task
without compiling, and seconds of compiling."""

_KINDS = TypeAdapter(dict[str, tuple[float, float, float]])

FILE = "seconds.json"

RENDERED = ("scene", "image/", "truth_dem", "dem_accuracy", "risk/truth", "path_check")
"""Kinds of the reference that take otherwise, or are not there, where the images are not rendered."""


@dataclass
class Tally:
    """Count the tasks of one kind by outcome; ``found`` counts those found in the cache after computing began."""

    computed: int = 0
    found: int = 0
    ended: int = 0
    seconds: float = 0.0
    compiling: float = 0.0


def kind(label: str) -> str:
    """``locus/world`` of ``locus/world/12``."""
    return "/".join(part for part in label.split("/") if not any(c.isdigit() for c in part))


class Forecast:
    """Estimates the seconds left of one run. ``earlier`` is None where nothing like it is known."""

    def __init__(self, opened: Iterable[str], earlier: Kinds | None, jobs: int) -> None:
        self.at_first = Counter(map(kind, opened))
        self.known = self.at_first.copy()
        self.opened = self.at_first.total()
        self.earlier = dict(earlier or {})
        if earlier is None and self.known["motion"]:  # a reconstruction; how long a drive takes, its ground decides
            rendered = "scene" in self.known
            self.earlier = {name: row for name, row in REFERENCE.items() if rendered or not name.startswith(RENDERED)}
        self.jobs = jobs
        self.tallies: defaultdict[str, Tally] = defaultdict(Tally)
        self.begun = False

    def added(self, label: str) -> None:
        """Count a task that is laid out during the run."""
        self.known[kind(label)] += 1

    def ended(self, handle: Handle) -> None:
        """Take what became of a task."""
        tally = self.tallies[kind(handle.label)]
        tally.ended += 1
        if handle.status == "computed":
            self.begun = True
            tally.computed += 1
            tally.seconds += max(0.0, handle.took.seconds - handle.took.compiling)
            tally.compiling += handle.took.compiling
        elif self.begun:
            tally.found += 1

    def left(self) -> float | None:
        """Seconds to go; None before anything was computed, and where nothing like this run is known."""
        if not self.begun or not self.earlier:
            return None
        pace, cold = self._pace(), self._cold()
        work = compiling = 0.0
        for name in {*self.known, *self.earlier}:
            share, before, first = self.earlier.get(name, (0.0, 0.0, 0.0))
            tally = self.tallies[name]
            mean = tally.seconds / tally.computed if tally.computed else pace * before
            to_come = max(self.known[name], self.at_first[name] + int(share * self.opened + 0.01)) - tally.ended
            # One is added so that a kind of which nothing was computed yet is not taken to be all in the cache.
            missed = (tally.computed + 1) / (tally.computed + tally.found + 1)
            work += max(0.0, to_come) * missed * mean
            compiling += cold * first if to_come > 0 and not tally.computed else 0.0
        return work / self.jobs + compiling

    def _pace(self) -> float:
        """Median of measured over earlier seconds, weighed by the root of the earlier ones."""
        ratios = []
        for name, tally in self.tallies.items():
            before = self.earlier.get(name, (0.0, 0.0, 0.0))[1] * tally.computed
            if before > 0:
                ratios.append((tally.seconds / before, math.sqrt(before)))
        half = sum(weight for _, weight in ratios) / 2
        for ratio, weight in sorted(ratios):
            # Weighed median: stops at the ratio where half of the weight is passed.
            half -= weight
            if half <= 0:
                return ratio
        return 1.0

    def _cold(self) -> float:
        """Seconds of compiling over the earlier ones, of the stages that have run."""
        ran = [s for s, tally in self.tallies.items() if tally.computed and s in self.earlier]
        expected = sum(self.earlier[s][2] for s in ran)
        return sum(self.tallies[s].compiling for s in ran) / expected if expected else 0.0

    def summary(self) -> dict[str, tuple[float, float, float]]:
        """Return the figures that the next run of this sequence starts from."""
        found = {}
        for name, tally in self.tallies.items():
            _, seconds, compiling = self.earlier.get(name, (0.0, 0.0, 0.0))
            if tally.computed:
                seconds = round(tally.seconds / tally.computed, 4)
                compiling = round(max(compiling, tally.compiling), 2)
            later = self.known[name] - self.at_first[name]
            found[name] = (round(later / max(self.opened, 1), 6), seconds, compiling)
        return found


def recall(hints: Path) -> dict[str, tuple[float, float, float]] | None:
    """Read the forecast that the last run of a sequence left in ``hints``; None if there is none of use."""
    return read_hint(hints / FILE, _KINDS)


def remember(hints: Path, forecast: Forecast) -> None:
    """Leave it for the next run."""
    if forecast.begun:
        write_hint(hints / FILE, (recall(hints) or {}) | forecast.summary())
