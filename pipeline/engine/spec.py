"""What a task computes, and its key.

A :class:`Spec` names a stage by its module, validated parameters, the arguments that
identify the task, and hints (paths) that cannot change the result. The key is the digest of all of it but the hints
and the label, of the code and packages behind the stage, and of the *output digests* of the inputs.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from operator import attrgetter
from typing import Any, TypeVar

from rille.pipeline.engine.code_digest import module_digests
from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.packages import versions
from rille.pipeline.engine.runtime.kernels import use_own_folder
from rille.pipeline.engine.store.manifest import Ref
from rille.stages.core.declare import Params, Stage, declared

FORMAT = 5
"""Enters every key: raise it when the meaning of keys or artifacts changes."""

Refs = Mapping[str, Ref | list[Ref]]
"""Input port to the artifact given there, or to the list of them."""

A = TypeVar("A")
B = TypeVar("B")


def map_ports(change: Callable[[A], B], ports: Mapping[str, A | list[A]]) -> dict[str, B | list[B]]:
    """Apply ``change`` to each item that is given to a port; a list stays a list."""
    return {p: [change(g) for g in given] if isinstance(given, list) else change(given) for p, given in ports.items()}


def flatten_ports(ports: Mapping[str, A | list[A]]) -> list[A]:
    """All items, in order of the ports."""
    return [g for given in ports.values() for g in (given if isinstance(given, list) else [given])]


@dataclass(frozen=True, slots=True)
class Spec:
    """One task without its inputs. ``label`` names it to people (``locus/12``) and is not part of the key."""

    module: str
    label: str
    params: Params
    args: Mapping[str, Any] = field(default_factory=dict)
    hints: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stage(self) -> Stage:
        """The declaration behind the module."""
        return resolve(self.module)


@cache
def resolve(module: str) -> Stage:
    """The stage of a module; its source is digested just before the import, so that both see the same files."""
    module_digests(module)
    use_own_folder()
    stage = declared(importlib.import_module(module))
    if "cv2" in sys.modules:
        # OpenCV takes a thread a core by default, and there is a worker for each core already.
        sys.modules["cv2"].setNumThreads(1)
    if stage is None:
        raise TypeError(f"{module} declares no stage")
    return stage


def recipe(spec: Spec, refs: Refs) -> dict[str, Any]:
    """All that determines a result, by name."""
    return {**_shared(spec.module), **_own(spec, refs)}


def key_of(spec: Spec, refs: Refs) -> str:
    """Key of a task: the digest of its recipe, in which one digest stands for what all tasks of a stage share."""
    return digest({"stage": _shared_digest(spec.module), **_own(spec, refs)}, spec.label)


def _own(spec: Spec, refs: Refs) -> dict[str, Any]:
    return {"params": spec.params, "args": dict(spec.args), "inputs": map_ports(attrgetter("digest"), refs)}


@cache
def _shared(module: str) -> dict[str, Any]:
    """What all tasks of a stage have in common."""
    stage, code, env = resolve(module), module_digests(module), versions(module)
    return {"code": code, "env": env, "format": FORMAT, "stage": stage.name}


@cache
def _shared_digest(module: str) -> str:
    return digest(_shared(module), module)
