"""Cost of tasks in memory and bytes: remembered from earlier runs of a sequence, foreseen for new tasks.

Each run leaves, for each stage and each set of its parameters, samples of what its tasks took: bytes of their inputs,
memory, bytes of the result decoded and on disk (``costs.json``, a hint like the explanations: where it is missing or
wrong, only estimates suffer). A task is foreseen from samples of like size, else by a line through all of them, else
from other parameters of its stage, else by the guess of the stage's declaration; :attr:`Foreseen.source` says by which.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean, linear_regression, median
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from rille.datasets.text.count import count
from rille.pipeline.engine.runtime.hints import read_hint, write_hint
from rille.pipeline.engine.spec import Spec, each

if TYPE_CHECKING:
    from rille.pipeline.engine.graph import Handle

FILE = "costs.json"
KEPT = 64
"""Samples kept of a stage with one set of parameters, the newest."""

EACH_RUN = 16
"""Samples that one run adds to them, from the greatest to the least."""

GROUPS = 6
"""Sets of parameters remembered of a stage."""

SIMILAR = 1.25
"""Tasks are of like size if their inputs differ by no more than this factor."""

SPREAD = 0.1
"""Least relative uncertainty stated: allocators and the system do not repeat themselves better."""

MEASURED = 3
"""Tasks of one kind that a process measures: the first, which imports and compiles, and two that foretell others."""

FEW = 0.4
"""Added to it, over the number of like tasks that were measured."""

GUESS = 0.5
"""Relative uncertainty of a guess."""

SLACK = 8e6
"""Bytes added to each task's upper bound: the granularity of allocators."""

REST = 250e6
"""Bytes that a worker process holds between tasks, while none was measured: Python with NumPy, SciPy and numba."""

Sample = tuple[float, float | None, float, float]
"""Bytes of input, memory (None: not measured), bytes of result decoded, and on disk."""


@dataclass(frozen=True)
class Foreseen:
    """Foreseen cost of a task [bytes]: memory beyond an idle worker's, relative uncertainty, result, and the reason."""

    memory: float
    spread: float
    result: float
    stored: float
    source: str
    measured: bool

    @property
    def most(self) -> float:
        """Memory that it will hardly exceed."""
        return self.memory * (1 + self.spread) + SLACK


@dataclass
class Group:
    """Samples of one stage with one set of parameters, out of how many tasks and runs."""

    runs: int = 0
    tasks: int = 0
    samples: list[Sample] = field(default_factory=list)


@dataclass
class Kept:
    """What the file holds: groups by stage and parameters, and the memory of workers between tasks [bytes]."""

    stages: dict[str, dict[str, Group]]
    rests: list[float]


_KEPT = TypeAdapter(Kept)


class Costs:
    """Costs remembered with a cache."""

    def __init__(self, groups: dict[str, dict[str, Group]] | None = None, rests: list[float] | None = None) -> None:
        self.groups = groups or {}
        self.rests = rests or []
        self._foreseen: dict[tuple[str, str, float], Foreseen] = {}

    @property
    def rest(self) -> float:
        """Bytes that a worker holds between tasks: the greatest of nine in ten, or an assumption."""
        known = sorted(self.rests)
        return known[int(0.9 * (len(known) - 1))] if known else REST

    def foresee(self, spec: Spec, size: float) -> Foreseen:
        """Foresee the cost of a task with ``size`` bytes of input."""
        stage, params = spec.stage, _name(spec)
        asked = (stage.name, params, size)
        if asked not in self._foreseen:
            self._foreseen[asked] = self._compute(spec, params, size)
        return self._foreseen[asked]

    def _compute(self, spec: Spec, params: str, size: float) -> Foreseen:
        stage = spec.stage
        groups = self.groups.get(stage.name, {})
        same, others = groups.get(params), [g for name, g in groups.items() if name != params]
        guess = stage.memory
        for group, remark in ((same, ""), (_joined(others), " with other parameters")):
            measured = [] if group is None else [(s[0], s[1]) for s in group.samples if s[1] is not None]
            if group is None or not measured:
                continue
            memory, spread = _at(measured, size)
            result, _ = _at([(s[0], s[2]) for s in group.samples], size)
            stored, _ = _at([(s[0], s[3]) for s in group.samples], size)
            source = f"from {count(group.tasks, 'task')} of {count(group.runs, 'run')}{remark}"
            if remark:
                spread = max(spread, GUESS)
            return Foreseen(memory, spread, result, stored, source, not remark)
        result = guess.result * size
        source = "no earlier run: a guess of the stage's declaration"
        return Foreseen(guess.fixed + guess.factor * size, GUESS, result, result, source, False)

    def learn(self, handles: Iterable[Handle]) -> None:
        """Take in what was computed now."""
        new: dict[tuple[str, str], list[Sample]] = defaultdict(list)
        computed = [h for h in handles if h.status == "computed" and h.ref is not None]
        warm = {(h.stage, _name(h.spec)) for h in computed if not h.took.first and h.took.memory is not None}
        for h in computed:
            assert h.ref is not None
            name, took = (h.stage, _name(h.spec)), h.took
            # Imports and compiling are not its own.
            measured = took.memory if not took.first or name not in warm else None
            new[name].append((input_bytes(h), measured, float(h.ref.nbytes), float(h.ref.stored)))
            self.rests += [] if took.rest is None else [float(took.rest)]
        self.rests = self.rests[-KEPT:]
        for (stage, params), samples in new.items():
            groups = self.groups.setdefault(stage, {})
            group = groups.pop(params, Group())
            groups[params] = group  # the newest last
            group.runs, group.tasks = group.runs + 1, group.tasks + len(samples)
            group.samples = (group.samples + _thinned(samples))[-KEPT:]
            for old in list(groups)[:-GROUPS]:
                del groups[old]
        self._foreseen.clear()


def _name(spec: Spec) -> str:
    """The digest of a task's parameters, shortened."""
    return hashlib.sha256(spec.canonical.encode()).hexdigest()[:16]


_sizes: dict[Hashable, list[float]] = {}
"""Of each kind the greatest inputs [bytes] that this process has measured tasks with, in ascending order."""


def tells_more(kind: Hashable, size: float) -> bool:
    """Whether a task with ``size`` bytes of input is worth measuring; it then counts as measured.

    It is unless :data:`MEASURED` tasks of its kind, a stage with its parameters, had inputs of like size or greater.
    """
    known = _sizes.setdefault(kind, [])
    if len(known) == MEASURED and size <= SIMILAR * known[0]:
        return False
    known[:] = sorted([*known, size])[-MEASURED:]
    return True


def _thinned(samples: list[Sample]) -> list[Sample]:
    """A few of them, from the least to the greatest memory."""
    # A sample without measured memory ranks least but stays: it tells the bytes of inputs and results all the same.
    ranked = sorted(samples, key=lambda s: (s[1] is not None, s[1] or 0.0))
    if len(ranked) <= EACH_RUN:
        return ranked
    return [ranked[round(k * (len(ranked) - 1) / (EACH_RUN - 1))] for k in range(EACH_RUN)]


def _joined(groups: list[Group]) -> Group | None:
    if not groups:
        return None
    runs = max(g.runs for g in groups)
    return Group(runs, sum(g.tasks for g in groups), [s for g in groups for s in g.samples])


def _at(samples: list[tuple[float, float]], size: float) -> tuple[float, float]:
    """Value at a size, and its relative uncertainty, of samples ``(size, value)``."""
    # Like sizes first: cost is seldom a straight line over a wide range of sizes.
    near = [y for x, y in samples if x == size or (x and size and 1 / SIMILAR <= x / size <= SIMILAR)]
    if near:
        middle = median(near)
        off = max(abs(y - middle) for y in near) / middle if middle else 0.0
        return middle, max(SPREAD + FEW / len(near), off)
    sizes = [x for x, _ in samples]
    if size > max(sizes) < 2 * min(sizes):  # too much of a kind to tell a slope: in proportion, which is safe
        return median(y for _, y in samples) * size / median(sizes), GUESS
    intercept, slope = _line(samples)
    value = intercept + slope * size
    # In bytes, not as a share of each: a tiny sample beside the line would make gigabytes of what is foreseen.
    off = max(abs(y - intercept - slope * x) for x, y in samples) / value if value else 0.0
    typical = median(x for x, _ in samples)
    # The farther from the measured sizes, the less a straight line through them is believed.
    beyond = max(size, typical) / max(min(size, typical), 1.0)
    return value, max(2 * SPREAD, off) + 0.1 * min(beyond - 1, 5.0)


def _line(samples: list[tuple[float, float]]) -> tuple[float, float]:
    """Least squares with neither intercept nor slope below zero; of one size only, in proportion."""
    x, y = zip(*samples, strict=True)
    if min(x) == max(x):
        return (0.0, fmean(y) / x[0]) if x[0] else (fmean(y), 0.0)
    slope, intercept = linear_regression(x, y)
    if slope < 0:
        return fmean(y), 0.0
    # Refitted through the origin: with the intercept merely cut to 0 the slope would stay too steep.
    return (intercept, slope) if intercept >= 0 else (0.0, linear_regression(x, y, proportional=True).slope)


def input_bytes(handle: Handle, expected: Mapping[int, float] | None = None) -> float:
    """Bytes that a task works on: its inputs decoded, what it reads from outside, and what its stage adds.

    ``expected`` are bytes of results still to come, by index of the node.
    """
    parts = (float(ref.nbytes) if (ref := h.ref) else (expected or {}).get(h.index, 0.0) for h in handle.upstream())
    size = handle.expect + sum(parts)
    more = handle.spec.stage.memory.size
    if more is not None:
        with suppress(Exception):  # an estimate only, and facts may be still to come
            size += more(handle.spec.params, handle.spec.args, each(_meta, handle.inputs))
    return size


def _meta(handle: Handle) -> Any:
    ref = handle.ref or handle.earlier
    return ref.meta if ref is not None else {}


def recall(hints: Path) -> Costs:
    """Read the costs from a sequence's folder of hints; empty if they cannot be read."""
    found = read_hint(hints / FILE, _KEPT)
    return Costs() if found is None else Costs(found.stages, found.rests)


def remember(hints: Path, handles: Iterable[Handle]) -> None:
    """Add what was computed now."""
    computed = [h for h in handles if h.status == "computed"]
    if not computed:
        return
    costs = recall(hints)
    costs.learn(computed)
    write_hint(hints / FILE, asdict(Kept(costs.groups, costs.rests)))
