"""The task of an output: what its writer takes of a run as arguments and inputs of a node of the graph.

No module that declares outputs imports this one: what it makes a task of is in the task's key, the graph's code is not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from inspect import Parameter, signature
from types import ModuleType
from typing import Any

from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.export.output import FORMS, Output
from rille.pipeline.export.view import Part, RunView
from rille.stages.core.declare import NoParams


def handles(output: Output, run: RunView) -> list[Handle]:
    """Handles of all artifacts that an output takes, each once."""
    return _handles(dict(output.inputs(run)))


def add(graph: Graph, module: ModuleType, output: Output, run: RunView) -> Handle | None:
    """Add the task that makes an output of ``module``; None where something that it needs is not there."""
    assert output.write is not None
    taken = output.inputs(run)
    parameters = signature(output.write).parameters
    if not all(_whole(value) for name, value in taken.items() if parameters[name].default is Parameter.empty):
        return None
    there: dict[Handle, int] = {}
    forms = {name: _form(value, there, _due) for name, value in taken.items()}
    args = {"file": output.name, "inputs": forms}
    return graph.node(module.__name__, f"output/{output.name}", NoParams(), args, {}, {"read": list(there)})


def _due(handle: Handle) -> bool:
    """Whether there is an artifact; a plan counts on those that are to be computed."""
    return handle.ref is not None or handle.status == "planned"


def _whole(value: Any) -> bool:
    """Whether an input is there, with all its artifacts; a part of a run may have holes."""
    empty = value is None or (isinstance(value, list | dict) and not value)
    return isinstance(value, Part) or (not empty and all(map(_due, _handles(value))))


def _handles(value: Any) -> list[Handle]:
    there: dict[Handle, int] = {}
    _form(value, there, lambda _: True)
    return list(there)


def _form(value: Any, there: dict[Handle, int], wanted: Callable[[Handle], bool]) -> Any:
    """Plain form of an input; wanted handles are collected in ``there`` and replaced by their number, others by None.

    A dictionary is sorted: tasks are laid out in the order in which results come, which is not always the same.
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
