"""The task of an output: its writer's part of a run as arguments and inputs of a node of the graph.

Modules that declare outputs do not import this one, so that keys of outputs do not depend on the code of the graph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from types import ModuleType
from typing import Any

from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.export.output import FORMS, Output
from rille.pipeline.export.view import Part, RunView, part
from rille.stages.core.declare import NoParams


def handles(output: Output, run: RunView) -> list[Handle]:
    """Distinct handles of the artifacts that an output takes."""
    return _handles(part(run, output.names))


def add(graph: Graph, module: ModuleType, output: Output, run: RunView) -> Handle | None:
    """Add the task that makes an output of ``module``; None if a product that it needs is missing."""
    if not all(needed and all(map(_due, _handles(needed))) for needed in output.needs(run)):
        return None
    there: dict[Handle, int] = {}
    args = {"file": output.name, "run": _form(part(run, output.names), there, _due)}
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
