"""The data of a run that report and outputs read, without the engine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle
from rille.stages.geometry import rigid
from rille.stages.geometry.geometry import Rig

if TYPE_CHECKING:
    from rille.datasets.protocol import Sequence
    from rille.pipeline.flow.products import Products

Status = Literal["computed", "cached", "failed", "skipped"]

UNSTATED = "nobody, so they are the defaults"
"""Source of the limits of a vehicle that neither the user nor the sequence has stated."""


@dataclass(frozen=True)
class TaskRow:
    """One task of the run.

    Attributes
    ----------
    label : such as ``"locus/local/4"``; tasks are grouped by its first part.
    stage : name of the stage, ``"locus"``.
    status : outcome in this run.
    seconds : time of its computation, in this run or an earlier one; None if it never was computed.
    reason : why a task failed or was skipped, in one line.
    cause : label of the task that a skipped one waits for; empty if it was skipped for another reason.
    """

    label: str
    stage: str
    status: Status
    seconds: float | None = None
    reason: str = ""
    cause: str = ""


@dataclass(frozen=True, kw_only=True)
class Settled:
    """Input of a run.

    Attributes
    ----------
    sequence : the input data (:class:`rille.datasets.protocol.Sequence`).
    frames : chosen frame numbers, in order.
    config : validated configuration with all defaults, one section a stage, and ``vehicle``.
    vehicle_source : source of the vehicle's limits, in words.
    given : dotted keys of the configuration that the user has set.
    """

    sequence: Sequence
    frames: tuple[int, ...]
    config: Any
    vehicle_source: str = ""
    given: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RunView(Settled):
    """Everything that the report reads.

    Attributes
    ----------
    run_id : name of the run's folder.
    products : handles of the run's products; those of failed tasks have no bundle.
    tasks : every task of the plan.
    bundle : returns the artifact of a handle, None if there is none (also for None); only makers of outputs need it.
    config_toml : the configuration, as written to ``config.toml``.
    seconds : wall-clock time of the run so far.
    versions : distribution or program to version.
    command : the command line that repeats this run.
    started : time of the start (ISO 8601, UTC).
    part : the options that chose a part of the run; empty: all of it.
    until, only : of a part: stages whose tasks, or files, that it is to make.
    left_out : of a part: numbers of known tasks that were not wanted, by stage.
    """

    products: Products
    run_id: str = ""
    tasks: tuple[TaskRow, ...] = ()
    bundle: Callable[[Any], Bundle | None] = lambda _: None
    config_toml: str = ""
    seconds: float = 0.0
    versions: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    started: str = ""
    part: str = ""
    until: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)


class Part(SimpleNamespace):
    """A part of a run, with the same attributes; for the writer of an output, with artifacts instead of handles."""

    def bundle(self, artifact: Bundle | None) -> Bundle | None:
        """The artifact itself."""
        return artifact


def artifact(run: RunView, handle: Any) -> Bundle:
    """The artifact of a handle that has one."""
    bundle = run.bundle(handle)
    assert bundle is not None
    return bundle


def used_rig(run: RunView, pair: int) -> Rig:
    """The rig that a basic pair was reconstructed with; as given if no other is known."""
    bundle = run.bundle(run.products.rigs.get(pair))
    return run.sequence.rig if bundle is None or "rig" not in bundle.meta else Rig.from_dict(bundle.meta["rig"])


def by_frame(run: RunView, bundle: Bundle, name: str) -> Floats:
    """An array of an artifact with one row for each chosen frame, NaN for frames without one."""
    values = np.asarray(bundle[name], dtype=np.float64)
    frames = list(bundle.meta.get("frames") or run.frames[: len(values)])
    return rigid.by_frame(values, frames, list(run.frames))


def chain(run: RunView) -> tuple[int, ...]:
    """Frames of the trajectory, in order; all chosen ones if there is no trajectory."""
    bundle = run.bundle(run.products.screening)
    return run.frames if bundle is None else tuple(int(f) for f in bundle.meta["chain"])


Names = tuple[object, ...]
"""Parts of a run, each as :data:`RUN` names it."""


def part(run: RunView, names: Names) -> RunView:
    """The named part of a run, and its frames, without access to anything else."""
    named = Part(frames=run.frames)
    for name in names:
        *path, last = str(name).split(".")
        source: Any = run
        target: Any = named
        for step in path:
            source, target = getattr(source, step, None), vars(target).setdefault(step, Part())
        setattr(target, last, getattr(source, last, None))
    return cast(RunView, named)


class _Name:
    """Dotted name of an attribute, built by attribute access, so that type checkers see it, unlike a quoted name."""

    def __init__(self, name: str = "") -> None:
        self._name = name

    def __getattr__(self, name: str) -> _Name:
        return _Name(f"{self._name}.{name}".lstrip("."))

    def __str__(self) -> str:
        return self._name


RUN = cast(RunView, _Name())
"""Stands for any run in rows of outputs: ``RUN.products.trajectory`` names that part of it."""
