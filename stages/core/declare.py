"""How a stage declares itself: parameters, inputs and the arrays it produces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

AnyArray = NDArray[Any]


class Params(BaseModel):
    """Base of all parameter models: frozen, unknown keys refused, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


class NoParams(Params):
    """For stages that have nothing to set."""


@dataclass(frozen=True)
class Array:
    """One output array: what an artifact's reader needs to know.

    ``name`` may end in ``*`` for a family (``level_*``). ``nodata`` is ``"nan"``, a number as text or empty.
    ``deep`` is another type that the array may have instead of ``dtype``.
    """

    name: str
    dims: tuple[str, ...]
    dtype: str
    unit: str
    long_name: str
    nodata: str = ""
    frame: str = ""
    optional: bool = False
    deep: str = ""

    def matches(self, name: str) -> bool:
        """Whether ``name`` is this array or one of its family."""
        return name.startswith(self.name[:-1]) if self.name.endswith("*") else name == self.name


def raster(name: str, unit: str, long_name: str, dtype: str = "float32", nodata: str = "nan", frame: str = "") -> Array:
    """An output (row, col)."""
    return Array(name, ("row", "col"), dtype, unit, long_name, nodata, frame)


@dataclass(frozen=True)
class Bundle:
    """Input or result of a stage: named arrays, and facts about them that can be written as JSON.

    A fact that is undefined (of a frame without a landmark, a model without a cell) is None: JSON has neither NaN nor
    infinities, so these become None here, whoever made them, and readers of facts meet None alone.
    """

    arrays: Mapping[str, AnyArray]
    meta: Mapping[str, Any]

    def __post_init__(self) -> None:
        object.__setattr__(self, "meta", _defined(self.meta))

    def __getitem__(self, name: str) -> AnyArray:
        return self.arrays[name]

    def part(self, name: str, window: tuple[slice, ...]) -> AnyArray:
        """Part of an array; of an artifact only that part is read, and nothing of it is kept."""
        # Arrays in memory have no such method; those of an artifact read the chunks of the window alone.
        read = getattr(self.arrays, "part", None)
        found: AnyArray = self.arrays[name][window] if read is None else read(name, window)
        return found

    def raster(self, name: str) -> Any:
        """The array as something with ``shape`` that is read by window, ``raster[rows, columns]`` (slices)."""
        opened = getattr(self.arrays, "raster", None)
        return self.arrays[name] if opened is None else opened(name)


def _defined(fact: Any) -> Any:
    """The fact with None in place of each number that is not finite."""
    if isinstance(fact, float):
        return fact if math.isfinite(fact) else None
    if isinstance(fact, dict):
        return {name: _defined(item) for name, item in fact.items()}
    if isinstance(fact, list | tuple):
        return [_defined(item) for item in fact]
    return fact


Inputs = Mapping[str, Any]
"""Port name to a :class:`Bundle`, or to a list of them for a port declared with a trailing ``*``."""


Size = Callable[[Any, Mapping[str, Any], Mapping[str, Any]], float]
"""``size(params, args, metas)``: bytes of work that the inputs' own bytes do not show (``metas``: meta by port)."""


@dataclass(frozen=True)
class Memory:
    """Guess of the memory of a task, used until tasks of the stage have been measured.

    The guess is ``fixed`` bytes, and ``factor`` more for each byte of input (decoded arrays of all inputs, and what
    ``size`` adds); ``result`` is the guess of decoded bytes of result a byte of input. ``lower`` names the parameters
    that reduce the memory, as the user writes them (``hfvm.preset``).
    """

    fixed: float = 50e6
    factor: float = 6.0
    result: float = 1.0
    lower: tuple[str, ...] = ()
    size: Size | None = None


@dataclass(frozen=True)
class Stage:
    """Declaration of one stage; every stage module holds one as ``STAGE``.

    ``run(params, args, inputs)`` gets the tunable parameters, what identifies this task (JSON-able: frame numbers,
    a rig ...), and the upstream bundles by port. A port ``name*`` takes a list, ``name?`` may be absent.
    ``memory`` never enters a key by itself: it serves the plan and the admission of tasks.
    """

    name: str
    version: int
    summary: str
    params: type[Params]
    inputs: tuple[str, ...]
    outputs: tuple[Array, ...]
    run: Callable[[Any, Mapping[str, Any], Inputs], Bundle]
    memory: Memory = Memory()


def check_outputs(stage: Stage, bundle: Bundle) -> None:
    """Raise ``TypeError`` where a bundle departs from its stage's declaration (a programming error)."""
    for name, array in bundle.arrays.items():
        spec = next((a for a in stage.outputs if a.matches(name)), None)
        if spec is None:
            raise TypeError(f"{stage.name}: array {name!r} is not declared")
        if array.dtype not in (np.dtype(spec.dtype), np.dtype(spec.deep or spec.dtype)) or array.ndim != len(spec.dims):
            raise TypeError(f"{stage.name}: {name} is {array.dtype} {array.ndim}-D, declared {spec.dtype} {spec.dims}")
    missing = missing_outputs(stage, list(bundle.arrays))
    if missing:
        raise TypeError(f"{stage.name}: declared arrays are missing: {', '.join(missing)}")


def missing_outputs(stage: Stage, names: Sequence[str]) -> list[str]:
    """Declared, not optional arrays that ``names`` lacks."""
    return [a.name for a in stage.outputs if not a.optional and not any(a.matches(n) for n in names)]
