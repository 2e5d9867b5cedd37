"""The task graph: nodes that name a stage, and flows that add nodes once earlier results are known.

>>> def chain(graph: Graph) -> Generator[Wait, Any, list[Handle]]:
...     chosen = yield graph.node(keyframes, "keyframes", KeyframesParams(), {"frames": 9})
...     return [graph.node(hfvm, f"hfvm/{k}", params, {"pair": k}, inputs=images[k]) for k in chosen.meta["basic"]]
>>> graph = Graph()
>>> matched = graph.flow(chain(graph))

A flow is a generator: it yields what it waits for, and goes on with the references of that once they are there
(:meth:`Graph.flow`). Several run side by side, and one may wait for what others return.

A :class:`Handle` stands for a node; after (or during) the run its ``status`` and ``ref`` say what became of it.
Order of creation is priority: what is created first runs first.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any, Generic, TypeVar

from rille.pipeline.engine.spec import Refs, Spec, each, flat
from rille.pipeline.engine.store.manifest import Ref
from rille.stages.core.declare import Params

Expansion = Callable[..., None]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Took:
    """What a task took: ``seconds`` and peak memory [bytes] of the call, ``kernel`` seconds of the stage itself.

    ``started`` is when the call began (seconds since 1970); ``memory`` and ``rest`` are a
    :class:`~rille.pipeline.engine.memory.limits.Meter`'s figures, ``first`` says that the process had not run the stage
    before (it imports, and compiles or loads kernels); ``compiling`` are the seconds for which it compiled; ``worker``
    is the name of the dask worker that ran it.
    """

    seconds: float = 0.0
    peak_rss: int = 0
    started: float = 0.0
    kernel: float = 0.0
    memory: int | None = None
    rest: int | None = None
    first: bool = False
    compiling: float = 0.0
    worker: str = ""


NOTHING = Took()


@dataclass(eq=False, slots=True)
class Handle:
    """A node of the graph and what became of it.

    ``status`` is ``pending``, ``running``, ``computed``, ``cached``, ``failed``, ``skipped`` or, when dry, ``planned``.
    ``reason`` says in words why it was not found in the cache, or why it was skipped. ``earlier``, of a planned node,
    is what the same label led to before: a plan takes its facts for what is to come. ``expect`` are bytes (decoded)
    that it reads from outside. ``took``: of a computed node, what that took.
    """

    index: int
    spec: Spec
    inputs: dict[str, Handle | list[Handle]]
    status: str = "pending"
    ref: Ref | None = None
    earlier: Ref | None = None
    reason: str = ""
    key: str = ""
    expect: float = 0.0
    took: Took = NOTHING
    error: BaseException | None = None

    @property
    def label(self) -> str:
        """Unique name of the node, such as ``locus/world/12``."""
        return self.spec.label

    @property
    def stage(self) -> str:
        """Name of the stage."""
        return self.spec.stage.name

    @property
    def done(self) -> bool:
        """Whether there is an artifact."""
        return self.ref is not None

    def upstream(self) -> list[Handle]:
        """Handles of all inputs, in order of the ports."""
        return flat(self.inputs)

    def refs(self) -> Refs:
        """References of all inputs by port; call it when they are done."""
        return each(_ref, self.inputs)


class MissingError(Exception):
    """A flow waits for handles that will never have an artifact, because they failed or were skipped."""

    def __init__(self, handles: Sequence[Handle]) -> None:
        super().__init__(", ".join(handle.label for handle in handles))
        self.handles = list(handles)


@dataclass(frozen=True)
class Maybe:
    """Wait until every handle has succeeded or failed; a handle without an artifact gives None."""

    handles: Sequence[Handle]


@dataclass(eq=False)
class Flow(Generic[T]):
    """A generator on its way, and once it is ``done`` what it returned, or what it missed."""

    steps: Generator[Wait, Any, T]
    done: bool = False
    value: T | None = None
    missed: MissingError | None = None
    followers: list[Callable[[], None]] = field(default_factory=list)


Wait = Handle | Maybe | Sequence[Handle] | Flow[Any] | Sequence[Flow[Any]]
"""What a flow may yield."""


@dataclass
class Graph:
    """Nodes in order of creation, and expansions that wait for some of them."""

    sequence: str = ""
    """Name of the sequence it works on, and of the choice of its frames: hints of earlier runs are kept by them."""
    choice: str = ""
    nodes: list[Handle] = field(default_factory=list)
    expansions: list[tuple[list[Handle], Expansion, bool]] = field(default_factory=list)
    last: Callable[[], None] | None = None
    """Called once nothing else will be laid out: adds what reads all of it."""
    unfinished: int = 0
    """Flows that wait for something: where a plan ends with some, it does not know all tasks."""
    _labels: set[str] = field(default_factory=set)

    def node(
        self,
        stage: ModuleType | str,
        label: str,
        params: Params,
        args: Mapping[str, Any] | None = None,
        hints: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Handle | Sequence[Handle]] | None = None,
        expect: float = 0.0,
    ) -> Handle:
        """Add a task and give its handle.

        ``stage`` is the module that declares it, or its dotted name. ``inputs`` maps each port of the stage to a
        handle, or to a list of them for a port declared ``name*``; ``expect`` are decoded bytes of what it reads from
        outside, for estimates.

        Raises
        ------
        ValueError
            The label is taken.
        TypeError
            The inputs do not fit the ports of the stage, or the parameters are of another model.
        """
        if label in self._labels:
            raise ValueError(f"the label {label!r} is taken: labels of nodes are unique")
        module = stage if isinstance(stage, str) else stage.__name__
        spec = Spec(module, label, params, dict(args) if args else _NONE, dict(hints) if hints else _NONE)
        given = {p: h if isinstance(h, Handle) else list(h) for p, h in (inputs or {}).items()}
        _check_ports(spec, given)
        handle = Handle(len(self.nodes), spec, given, expect=expect)
        self._labels.add(label)
        self.nodes.append(handle)
        return handle

    def flow(self, steps: Generator[Wait, Any, T]) -> Flow[T]:
        """Run a generator on the client until it waits, and again when what it waits for is there.

        It yields a handle, a list of handles, :class:`Maybe`, a flow, or a list of flows, and gets a reference, a list
        of references, or what the flows returned. Where one will never be, ``MissingError`` is raised in it.
        """
        flow = Flow(steps)
        self.unfinished += 1
        self._go_on(flow, lambda: next(steps))
        return flow

    def _go_on(self, flow: Flow[Any], step: Callable[[], Wait]) -> None:
        try:
            wanted = step()
        except StopIteration as end:
            flow.done, flow.value = True, end.value
        except MissingError as error:
            flow.done, flow.missed = True, error
            self.expansions.append((error.handles, lambda *_: None, False))  # the run's end says what it waited for
        else:
            self._wait(flow, wanted)
        if flow.done:
            self.unfinished -= 1
            for follower in flow.followers:
                follower()

    def _wait(self, flow: Flow[Any], wanted: Wait) -> None:
        one, maybe = isinstance(wanted, Handle | Flow), isinstance(wanted, Maybe)
        several: Any = wanted.handles if isinstance(wanted, Maybe) else wanted
        parts: list[Any] = [wanted] if one else list(several)

        def answer(values: list[Any], missed: MissingError | None) -> None:
            if missed is not None:
                self._go_on(flow, lambda: flow.steps.throw(missed))
            else:
                self._go_on(flow, lambda: flow.steps.send(values[0] if one else values))

        def resume(*refs: Ref | None) -> None:
            lost = [h for h, ref in zip(parts, refs, strict=True) if ref is None]
            answer(list(refs), MissingError(lost) if lost and not maybe else None)

        if not any(isinstance(part, Flow) for part in parts):
            self.expansions.append((parts, resume, True))
            return
        # Waits for one flow after the other: the last to end wakes this one, whichever it is.
        behind = next((part for part in parts if not part.done), None)
        if behind is not None:
            behind.followers.append(lambda: self._wait(flow, wanted))
        else:
            answer([part.value for part in parts], next((p.missed for p in parts if p.missed is not None), None))


_NONE: dict[str, Any] = {}
"""One for all: an empty dictionary takes 64 bytes."""


def _check_ports(spec: Spec, given: Mapping[str, Handle | list[Handle]]) -> None:
    stage = spec.stage
    if not isinstance(spec.params, stage.params):
        raise TypeError(f"{spec.label}: params are {type(spec.params).__name__}, not {stage.params.__name__}")
    ports, needed = _ports(stage.inputs)
    if not (needed <= given.keys() <= ports.keys()):
        unknown, missing = sorted(given.keys() - ports.keys()), sorted(needed - given.keys())
        raise TypeError(f"{spec.label}: unknown inputs {unknown}, missing inputs {missing} (ports {stage.inputs})")
    for name, handle in given.items():
        if isinstance(handle, list) != ("*" in ports[name]):
            raise TypeError(f"{spec.label}: input {name} takes {'a list' if '*' in ports[name] else 'one handle'}")


@cache
def _ports(declared: tuple[str, ...]) -> tuple[dict[str, str], frozenset[str]]:
    """Ports by name, and the names of those that must be given."""
    return {port.rstrip("*?"): port for port in declared}, frozenset(p.rstrip("*") for p in declared if "?" not in p)


def _ref(handle: Handle) -> Ref:
    assert handle.ref is not None, handle.label
    return handle.ref
