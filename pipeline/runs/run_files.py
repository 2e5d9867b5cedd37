"""Files of a run: the tasks of its outputs, copies of what these have made, and the report.

The code that lays out the tasks is no part of their keys: modules that declare outputs do not import it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import is_dataclass
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

from rille.pipeline.engine.graph import Graph, Handle, Maybe, Wait
from rille.pipeline.engine.plain import one_line, warn
from rille.pipeline.engine.run import Failure
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.arrays import DamagedError
from rille.pipeline.engine.store.base import GoneError, Store
from rille.pipeline.engine.task import ensure
from rille.pipeline.export import catalogue
from rille.pipeline.export.output import FORMS, Output, unpack
from rille.pipeline.export.view import Part, RunView, TaskRow, part
from rille.pipeline.export.writers import write_json
from rille.pipeline.report import gallery, summary
from rille.pipeline.report.canvas import FIGURE
from rille.pipeline.report.page import write_report
from rille.stages.core.declare import NoParams

MODULES = (*catalogue.MADE, gallery, summary)
Made = dict[str, Handle]
"""Handles of outputs by name."""


def lay_out(graph: Graph, view: RunView, made: Made) -> None:
    """Add the task of each output, to ``made`` too, once the outcome of all tasks that it reads is known.

    They are the last ones of the graph, so all other tasks go first; an output whose artifacts are there early is made
    early. A part of a run makes the wanted files, files that read nothing outside of the part, and the facts of the
    part, but no figures.
    """
    for module in MODULES if graph.cut is None else catalogue.MADE:
        for output in module.OUTPUTS:
            if graph.cut is None or _is_wanted(output, view, graph):
                graph.flow(_make(graph, view, module, output, made))
    if graph.cut is not None:
        # Laid out last, since its facts cover the tasks of all files.
        graph.last = lambda: graph.flow(_make(graph, view, summary, *summary.OUTPUTS, made))


def _is_wanted(output: Output, view: RunView, graph: Graph) -> bool:
    read = handles(output, view)
    if view.only:
        return output.name in view.only
    return bool(read) and all(handle.index in graph.needed for handle in read)


def plan(graph: Graph, view: RunView) -> None:
    """Add the task of each output that a run would make; ``view`` is known without a computation."""
    for module in MODULES:
        for output in module.OUTPUTS:
            add(graph, module, output, view)


def _make(graph: Graph, view: RunView, module: ModuleType, output: Output, made: Made) -> Generator[Wait, Any, None]:
    # Last ones first, since tasks laid out last end last.
    read = handles(output, view)[::-1]
    if graph.cut is not None and output.name not in view.only:
        read = [handle for handle in read if handle.index in graph.needed]
    yield Maybe(read)
    node = add(graph, module, output, view)
    if node is not None:
        made[output.name] = node


def handles(output: Output, run: RunView) -> list[Handle]:
    """Distinct handles of the artifacts that an output takes."""
    return _handles(part(run, output.names))


def add(graph: Graph, module: ModuleType, output: Output, run: RunView) -> Handle | None:
    """Add the task that makes an output of ``module``; None if a product that it needs is missing."""
    taken, there = part(run, output.names), dict[Handle, int]()
    needed = (attrgetter(str(name))(taken) for name in output.needs)
    if not all(value and all(map(_due, _handles(value))) for value in needed):
        return None
    args = {"file": output.name, "run": _form(taken, there, _due)}
    return graph.node(module.__name__, f"output/{output.name}", NoParams(), args, {}, {"read": list(there)})


def _due(handle: Handle) -> bool:
    """Whether there is an artifact, or a plan is to compute it."""
    return handle.ref is not None or handle.status == "planned"


def _handles(value: Any) -> list[Handle]:
    there: dict[Handle, int] = {}
    _form(value, there, lambda _: True)
    return list(there)


def _form(value: Any, there: dict[Handle, int], wanted: Callable[[Handle], bool]) -> Any:
    """Plain form of an input; wanted handles are collected in ``there`` and replaced by their number, others by None.

    Dictionaries are sorted, because the order of tasks follows that of results, which varies.
    """
    if isinstance(value, Handle):
        return {"artifact": there.setdefault(value, len(there))} if wanted(value) else None
    if (form := FORMS.get(type(value).__name__)) is not None:
        return {type(value).__name__: form.write(value)}
    if isinstance(value, Mapping):
        return {"by": [[key, _form(value[key], there, wanted)] for key in sorted(value)]}
    if isinstance(value, list | tuple):
        return [_form(item, there, wanted) for item in value]
    if isinstance(value, Part) or is_dataclass(value):
        return {"part": {name: _form(item, there, wanted) for name, item in vars(value).items()}}
    return value


def task_rows(graph: Graph, failures: Iterable[Failure]) -> tuple[TaskRow, ...]:
    """One row for each task, with the seconds of its computation in any run, and one for each flow that failed."""
    rows = []
    for h in graph.nodes:
        seconds = None if h.ref is None else h.ref.seconds
        reason = one_line(h.error) if h.error is not None else h.reason
        rows.append(TaskRow(h.label, h.stage, h.status, seconds, reason, h.cause))  # type: ignore[arg-type]
    known = {row.label for row in rows}
    rows += [TaskRow(f.label, "", "failed", None, one_line(f.error)) for f in failures if f.label not in known]
    return tuple(rows)


def write(folder: Path, view: RunView, made: Made, store: Store) -> dict[str, Any]:
    """Write all files of a run that have an artifact; return the content of ``report.json``."""
    # Copies, not links, because a user may edit the files of a run.
    for output in (output for module in catalogue.MADE for output in module.OUTPUTS):
        for name, content in _files(made.get(output.name), store).items():
            atomic.write(folder / name, content)
    trajectory = view.products.trajectory
    meta = None if trajectory is None or trajectory.ref is None else trajectory.ref.meta
    vertical = "" if meta is None else meta["verticals"][meta["main"]]
    frames = catalogue.describe([p.name for p in folder.iterdir()], view, vertical)
    write_json(folder / "frames.json", frames)
    (facts,) = _files(made["facts"], store).values()
    drawn = (content for o in gallery.OUTPUTS for content in _files(made.get(o.name), store).values())
    return write_report(folder, view, json.loads(facts), list(map(FIGURE.validate_json, drawn)))


def _files(handle: Handle | None, store: Store) -> dict[str, bytes]:
    """Content of each file of an output by its name; empty if it was not made."""
    if handle is None or handle.ref is None:
        return {}
    try:
        return unpack(store.open(handle.ref))
    except (DamagedError, GoneError) as error:  # it is set aside by now
        warn(f"{error.code}: {error.message}; computing it again")
        return unpack(store.open(ensure(store.root, handle.spec, handle.refs()).ref))
