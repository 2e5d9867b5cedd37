"""Declaration of a stage: its parameters, inputs, output arrays and facts."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Concatenate, Generic, ParamSpec, TypedDict, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator
from typing_extensions import TypeVar

AnyArray = NDArray[Any]


class Facts(TypedDict, total=False):
    """Base of the facts that a stage declares: names and types of what its results' ``meta`` holds.

    A module of facts has no ``from __future__ import annotations``, with which ``NotRequired`` would have no effect.
    ``contradiction``: what the images contradict, in a line; no figure of the run may rest on it.
    """

    warnings: list[str]
    contradiction: str


F = TypeVar("F", bound=Mapping[str, Any], default=Mapping[str, Any], covariant=True)
P = ParamSpec("P")
M = TypeVar("M", bound="Params")


class Params(BaseModel):
    """Base of all parameter models: frozen, unknown keys refused, no infinities.

    The docstring of a model says under ``Attributes`` what each parameter means: a change of words changes no key.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    @field_validator("*", mode="before")
    @classmethod
    def _no_switch(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse a switch where none is expected: pydantic would take True for 1."""
        annotation = cls.model_fields[str(info.field_name)].annotation
        if isinstance(value, bool) and bool not in (annotation, *get_args(annotation)):
            raise ValueError("input should be a number, no switch")
        return value

    @classmethod
    def meanings(cls) -> dict[str, str]:
        """What each parameter means, by name, as the docstrings of the model and of its bases say."""
        texts = (inspect.cleandoc(base.__doc__ or "") for base in reversed(cls.__mro__))
        entries = (entry for text in texts for entry in re.findall(r"^(\w+) : (.*(?:\n    .*)*)", text, re.MULTILINE))
        return {name: " ".join(words.split()) for name, words in entries}


class NoParams(Params):
    """Parameters of a stage that has none."""


@dataclass(frozen=True)
class Array:
    """Description of one output array, for readers of an artifact.

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
    """Describe an output array (row, col)."""
    return Array(name, ("row", "col"), dtype, unit, long_name, nodata, frame)


@dataclass(frozen=True)
class Bundle(Generic[F]):
    """Input or result of a stage: named arrays, and facts about them that can be written as JSON.

    ``Bundle[MergeFacts]`` has the facts that a stage declares by that type.

    A fact that is undefined (of a frame without a landmark, a model without a cell) is None: JSON has neither NaN nor
    infinities, so these become None here, whoever made them, and readers of facts meet None alone.
    """

    arrays: Mapping[str, AnyArray]
    meta: F

    def __post_init__(self) -> None:
        object.__setattr__(self, "meta", _defined(self.meta))

    def __getitem__(self, name: str) -> AnyArray:
        return self.arrays[name]

    def raster(self, name: str) -> Any:
        """The array as something with ``shape`` that is read by window, ``raster[rows, columns]`` (slices).

        Of an artifact only the chunks of the window are read, and nothing of them is kept.
        """
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
    """Guess of the memory of a task.

    It is ``fixed`` bytes, and ``factor`` more for each byte of input (decoded arrays of all inputs, and what
    ``size`` adds); ``result`` is the guess of decoded bytes of result a byte of input. ``lower`` names the parameters
    that reduce the memory, as the user writes them (``hfvm.preset``).
    """

    fixed: float = 50e6
    factor: float = 6.0
    result: float = 1.0
    lower: tuple[str, ...] = ()
    size: Size | None = None


@dataclass(frozen=True)
class Stage(Generic[M, F]):
    """Declaration of one stage, made by :func:`stage` of a function; a module holds one.

    Called, it is that function. ``run(params, args, inputs)`` calls it with the tunable parameters, with what
    identifies the task (JSON-able: frame numbers, a rig ...) by keyword, and with the upstream bundles by port.
    ``inputs`` are the ports: ``name*`` takes a list, ``name?`` may be absent. ``facts`` are the names that ``meta`` of
    a result must have, and those it may have. ``memory`` never enters a key: it serves the plan and the number of
    workers.
    """

    name: str
    summary: str
    params: type[M]
    inputs: tuple[str, ...]
    outputs: tuple[Array, ...]
    run: Callable[[Any, Mapping[str, Any], Inputs], Bundle[F]]
    memory: Memory = Memory()
    facts: tuple[frozenset[str], frozenset[str]] | None = None
    function: Callable[..., Bundle[F]] | None = None

    @property
    def module(self) -> str:
        """Dotted name of the module that declares it."""
        return (self.function or self.run).__module__

    def ports(self) -> tuple[str, ...]:
        """Names of the ports."""
        return tuple(port.rstrip("*?") for port in self.inputs)

    def __call__(self, *args: Any, **kwargs: Any) -> Bundle[F]:
        """Call the function that was declared."""
        return (self.function or self.run)(*args, **kwargs)


def stage(
    name: str, *, outputs: Sequence[Array] = (), memory: Memory = Memory()
) -> Callable[[Callable[Concatenate[M, P], Bundle[F]]], Stage[M, F]]:
    """Declare a function as a stage: its signature says the parameters, the ports, the arguments and the facts.

    >>> class DoubleFacts(Facts):
    ...     pair: int
    >>> @stage("double", outputs=[raster("elevation", "m", "twice the elevation")])
    ... def double(params: NoParams, dem: Bundle, masks: Sequence[Bundle] = (), *, pair: int) -> Bundle[DoubleFacts]:
    ...     "An elevation model, doubled."
    ...     return Bundle({"elevation": 2 * dem["elevation"]}, {"pair": pair})
    >>> double.inputs, double.summary
    (('dem', 'masks*?'), 'an elevation model, doubled')

    First come the parameters (a :class:`Params`), then the ports (a bundle, or a list of bundles; one with a default
    may be absent): each by itself, or where they are many all as the fields of one ``NamedTuple``. Then follow by
    keyword the arguments that identify a task, which travel as JSON: one that is annotated with a class that has
    ``from_dict`` or ``from_matrix``, with a ``NamedTuple`` or a model of pydantic arrives as such an object. The
    docstring's first line is the summary.
    """

    def declare(function: Callable[Concatenate[M, P], Bundle[F]]) -> Stage[M, F]:
        types = get_type_hints(function)
        first, *rest = inspect.signature(function).parameters.values()
        ports = [p for p in rest if p.kind is p.POSITIONAL_OR_KEYWORD]
        named = types[ports[0].name] if ports and hasattr(types[ports[0].name], "_fields") else None
        if named is not None:
            types |= get_type_hints(named)
            ports = list(inspect.signature(named).parameters.values())
        several = {p.name for p in ports if get_origin(types[p.name]) is cast(Any, Sequence)}
        inputs = tuple(
            p.name + "*" * (p.name in several) + "?" * (p.default is not inspect.Parameter.empty) for p in ports
        )
        facts = get_args(types["return"])
        readers = {p.name: read for p in rest if (read := _reader(types[p.name])) is not None}

        def run(params: M, args: Mapping[str, Any], inputs: Inputs) -> Bundle[F]:
            typed = {n: readers[n](v) if n in readers and v is not None else v for n, v in args.items()}
            given = inputs if named is None else {rest[0].name: named(**inputs)}
            return cast(Callable[..., Bundle[F]], function)(params, **given, **typed)

        line = (function.__doc__ or "").strip().split("\n")[0].removesuffix(".")
        summary = line[:1].lower() + line[1:] if line[1:2].islower() or line[1:2] == " " else line
        return Stage(
            name,
            summary,
            types[first.name],
            inputs,
            tuple(outputs),
            run,
            memory,
            (facts[0].__required_keys__, facts[0].__optional_keys__) if facts else None,
            function,
        )

    return declare


def _reader(annotation: Any) -> Callable[[Any], Any] | None:
    """Function that makes an argument of this type (or of it or None) from JSON; None: it is JSON itself."""
    for kind in (annotation, *get_args(annotation)):
        for name in ("from_dict", "from_matrix", "model_validate"):
            if isinstance(kind, type) and hasattr(kind, name):
                reader: Callable[[Any], Any] = getattr(kind, name)
                return reader
        if isinstance(kind, type) and hasattr(kind, "_asdict"):  # a NamedTuple of plain values
            return lambda given, kind=kind: kind(**given)  # type: ignore[misc]
    return None


def declared(module: Any) -> Stage[Any, Any] | None:
    """The stage that a module declares, if it does."""
    named = vars(module).get("STAGE")
    if isinstance(named, Stage):
        return named
    return next((v for v in vars(module).values() if isinstance(v, Stage) and v.module == module.__name__), None)


def check_outputs(stage: Stage, bundle: Bundle) -> None:
    """Raise ``TypeError`` if a bundle departs from its stage's declaration (a programming error)."""
    for name, array in bundle.arrays.items():
        spec = next((a for a in stage.outputs if a.matches(name)), None)
        if spec is None:
            raise TypeError(f"{stage.name}: array {name!r} is not declared")
        if array.dtype not in (np.dtype(spec.dtype), np.dtype(spec.deep or spec.dtype)) or array.ndim != len(spec.dims):
            raise TypeError(f"{stage.name}: {name} is {array.dtype} {array.ndim}-D, declared {spec.dtype} {spec.dims}")
    missing = [a.name for a in stage.outputs if not a.optional and not any(map(a.matches, bundle.arrays))]
    if missing:
        raise TypeError(f"{stage.name}: declared arrays are missing: {', '.join(missing)}")
    if stage.facts is not None:
        required, optional = stage.facts
        if not required <= bundle.meta.keys() <= required | optional:
            missing, unknown = sorted(required - bundle.meta.keys()), sorted(bundle.meta.keys() - required - optional)
            raise TypeError(f"{stage.name}: facts that are missing: {missing}, that are not declared: {unknown}")
