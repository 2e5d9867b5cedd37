"""The time that a run still needs: tasks to come of each stage times mean seconds of one, divided by the workers.

The means are those of this run; of a stage that has not run yet, those of the last run of the sequence. Tasks to come
are those laid out, or as many as the last run had for its size: most are laid out on the way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter

from rille.pipeline.engine.runtime.hints import read_hint, write_hint

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Handle

Earlier = Mapping[str, tuple[float, float]]
"""Of each stage: its tasks over those of all stages that were laid out when the run opened; mean seconds of a task."""

_EARLIER = TypeAdapter(dict[str, tuple[float, float]])

FILE = "seconds.json"


class TimeEstimate:
    """Estimates the seconds left of one run; ``opened`` are the stages of the tasks that are laid out first."""

    def __init__(self, opened: Iterable[str], earlier: Earlier, jobs: int) -> None:
        self.known = Counter(opened)
        self.opened = max(self.known.total(), 1)
        self.earlier, self.jobs = earlier, jobs
        self.ended: Counter[str] = Counter()
        self.computed: Counter[str] = Counter()
        self.seconds: Counter[str] = Counter()

    def added(self, stage: str) -> None:
        """Count a task that is laid out during the run."""
        self.known[stage] += 1

    def end(self, handle: Handle) -> None:
        """Count a task that has ended. The seconds for which it compiled are no measure of those that follow."""
        self.ended[handle.stage] += 1
        if handle.status == "computed":
            self.computed[handle.stage] += 1
            self.seconds[handle.stage] += max(0.0, handle.took.seconds - handle.took.compiling)  # type: ignore[assignment]

    def mean(self, stage: str) -> float:
        """Seconds of a task; 0 where none was ever computed."""
        computed = self.computed[stage]
        return self.seconds[stage] / computed if computed else self.earlier.get(stage, (0.0, 0.0))[1]

    def left(self) -> float | None:
        """Seconds to go; None before anything was computed, and where the sequence has had no run."""
        if not self.computed or not self.earlier:
            return None
        work = 0.0
        for stage in {*self.known, *self.earlier}:
            before = round(self.earlier.get(stage, (0.0, 0.0))[0] * self.opened)
            work += max(0, max(self.known[stage], before) - self.ended[stage]) * self.mean(stage)
        return work / self.jobs

    def summary(self) -> dict[str, tuple[float, float]]:
        """Return the figures that the next run of this sequence starts from."""
        return {stage: (self.known[stage] / self.opened, self.mean(stage)) for stage in self.known}


def recall(hints: Path) -> dict[str, tuple[float, float]]:
    """Read what the last run of a sequence left in ``hints``; empty if there is nothing of use."""
    return read_hint(hints / FILE, _EARLIER) or {}


def remember(hints: Path, estimate: TimeEstimate) -> None:
    """Leave the figures of a run for the next one."""
    if estimate.computed:
        write_hint(hints / FILE, recall(hints) | estimate.summary())
