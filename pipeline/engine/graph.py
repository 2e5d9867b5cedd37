"""The task graph: nodes that name a stage, and flows that add nodes once earlier results are known.

>>> def chain(graph: Graph) -> Generator[Wait, Any, None]:
...     chosen = yield graph.node(keyframes, "keyframes", KeyframesParams(), {"frames": 9})
...     for k in chosen.meta["basic"]:
...         graph.node(hfvm, f"hfvm/{k}", params, {"pair": k}, inputs=images[k])
>>> graph = Graph()
>>> graph.flow(chain(graph))

A flow is a generator: it yields what it waits for, and goes on with the references of that once they are there
(:meth:`Graph.flow`). Several flows run side by side; ``yield from`` runs a part of one.

A :class:`Handle` stands for a node; after (or during) the run its ``status`` and ``ref`` say what became of it.
Order of creation is priority: what is created first runs first.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, NamedTuple, cast

from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.engine.task import Refs, Spec, flatten_ports, map_ports
from rille.stages.core.declare import F, Params, Stage


@dataclass(eq=False, slots=True)
class Handle(Generic[F]):
    """A node of the graph and what became of it.

    ``status`` is ``pending``, ``computed``, ``cached``, ``failed``, ``skipped`` or, when dry, ``planned``.
    ``reason`` says in words why it was not in the cache, or was skipped; ``cause`` is the label of the input that
    caused this. ``earlier``, of a planned node, is the artifact of the same label in an earlier run, whose facts the
    plan assumes. ``expect`` are decoded bytes that it reads besides its inputs, as from a file.
    """

    index: int
    spec: Spec
    inputs: dict[str, Handle | list[Handle]]
    status: str = "pending"
    ref: Ref[F] | None = None
    earlier: Ref[F] | None = None
    reason: str = ""
    cause: str = ""
    key: str = ""
    expect: float = 0.0
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

    @property
    def lost(self) -> bool:
        """Whether there will never be an artifact."""
        return self.status in ("failed", "skipped")

    def upstream(self) -> list[Handle]:
        """Handles of all inputs, in order of the ports."""
        return flatten_ports(self.inputs)

    def refs(self) -> Refs:
        """References of all inputs by port; call it when they are done."""
        return map_ports(lambda h: cast(Ref, h.ref), self.inputs)


class MissingError(Exception):
    """A flow waits for handles that will never have an artifact, because they failed or were skipped."""

    def __init__(self, handles: Sequence[Handle]) -> None:
        super().__init__(", ".join(handle.label for handle in handles))
        self.handles = list(handles)


@dataclass(frozen=True)
class Maybe:
    """Wait until every handle has succeeded or failed; a handle without an artifact gives None."""

    handles: Sequence[Handle]


class Waiting(NamedTuple):
    """A flow that waits for handles: ``go_on`` takes their references, None of those that failed; None: it never goes
    on."""

    handles: list[Handle]
    go_on: Callable[..., None] | None


class Complete(frozenset[str]):
    """Names of stages of which a flow lays out no more tasks: if nothing else is wanted, the flow ends there."""


Wait = Handle | Maybe | Sequence[Handle] | Complete
"""What a flow may yield."""


@dataclass(frozen=True)
class Cut:
    """The part of a graph that is wanted: tasks, and everything that these need.

    ``wants`` says of a node whether it is wanted for itself; ``stages`` are the names of the stages whose tasks must
    all be laid out before that is known. No other task is computed than the wanted ones, those that they read, and
    those that a flow waits for before it can lay out wanted ones.
    """

    stages: frozenset[str]
    wants: Callable[[Handle], bool]


def done(handle: Handle[F]) -> Generator[Wait, Any, Ref[F]]:
    """In a flow, ``ref = yield from done(handle)``: wait for a handle; its facts are typed."""
    ref: Ref[F] = yield handle
    return ref


ANEW = "/anew"
"""Ends the label of a task that takes the place of an outdated one."""


def first_label(label: str) -> str:
    """The label of the task that was laid out first in the place of this one."""
    return label.partition(ANEW)[0]


@dataclass
class Graph:
    """Nodes in order of creation, and flows that wait for some of them (``waiting``).

    Attributes
    ----------
    sequence, choice : name of the sequence it works on, and of the choice of its frames: hints of earlier runs are kept
        by them.
    last : called once nothing else will be laid out; adds the tasks that read all of it.
    cut : the wanted part; None: all.
    needed : numbers of the nodes that a cut graph computes, as far as it is known.
    outdated : numbers of nodes of a calibration that has been corrected since; one that is laid out again counts again.
    """

    sequence: str = ""
    choice: str = ""
    nodes: list[Handle] = field(default_factory=list)
    waiting: list[Waiting] = field(default_factory=list)
    last: Callable[[], None] | None = None
    cut: Cut | None = None
    needed: set[int] = field(default_factory=set)
    outdated: set[int] = field(default_factory=set)
    _labels: dict[str, Handle] = field(default_factory=dict)
    _complete: set[str] = field(default_factory=set)

    def node(
        self,
        stage: Stage[Any, F] | str,
        label: str,
        params: Params,
        args: Mapping[str, Any] | None = None,
        hints: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Handle | Sequence[Handle]] | None = None,
        expect: float = 0.0,
    ) -> Handle[F]:
        """Add a task and return its handle.

        ``stage`` may be the dotted name of its module. ``inputs`` maps each port of the stage to a handle, or to a list
        of them for a port declared ``name*``; ``expect``: see :class:`Handle`.

        Raises
        ------
        ValueError
            The label is taken.
        TypeError
            The inputs do not fit the ports of the stage, or the parameters are of another model.
        """
        module = stage if isinstance(stage, str) else stage.module
        spec = Spec(module, label, params, dict(args or {}), dict(hints or {}))
        given = {p: h if isinstance(h, Handle) else list(h) for p, h in (inputs or {}).items()}
        while (taken := self._labels.get(spec.label)) is not None:
            if not self.outdated:
                raise ValueError(f"the label {label!r} is taken: labels of nodes are unique")
            if taken.spec == spec and taken.inputs == given:
                self.outdated.discard(taken.index)
                return cast(Handle[F], taken)
            spec = replace(spec, label=spec.label + ANEW)
        _check_ports(spec, given)
        handle: Handle[F] = Handle(len(self.nodes), spec, given, expect=expect)
        self._labels[spec.label] = handle
        self.nodes.append(handle)
        return handle

    def call(self, stage: Stage[Any, F], label: str, params: Params, /, **given: Any) -> Handle[F]:
        """Add a task; ``given`` are its inputs (handles) and arguments, None for an absent one."""
        args = {name: value for name, value in given.items() if value is not None}
        inputs = {name: args.pop(name) for name in stage.ports() if name in args}
        return self.node(stage, label, params, args, inputs=inputs)

    def flow(self, steps: Generator[Wait, Any, None]) -> None:
        """Run a generator on the client until it waits, and go on once the results that it waits for are there.

        It yields a handle, a list of handles, or :class:`Maybe`, and gets a reference, or a list of references. If a
        task has failed, ``MissingError`` is raised in it. It does not wait after it yields :class:`Complete`.
        """
        self._go_on(steps, lambda: next(steps))

    def _go_on(self, steps: Generator[Wait, Any, None], step: Callable[[], Wait]) -> None:
        try:
            wanted: Wait | None = step()
            while isinstance(wanted, Complete):
                self._complete |= wanted
                unwanted = self.cut is not None and self.cut.stages <= self._complete
                wanted = None if unwanted else next(steps)
        except StopIteration:
            wanted = None
        except MissingError as error:
            # The flow never goes on; the end of the run names the tasks that it waited for.
            self.waiting.append(Waiting(error.handles, None))
            return
        if wanted is None:
            return
        one, maybe = isinstance(wanted, Handle), isinstance(wanted, Maybe)
        several = wanted.handles if isinstance(wanted, Maybe) else wanted
        handles = [several] if isinstance(several, Handle) else list(several)

        def resume(*refs: Ref | None) -> None:
            lost = [handle for handle, ref in zip(handles, refs, strict=True) if ref is None]
            if lost and not maybe:
                self._go_on(steps, lambda: steps.throw(MissingError(lost)))
            else:
                self._go_on(steps, lambda: steps.send(refs[0] if one else list(refs)))

        self.waiting.append(Waiting(handles, resume))


def _check_ports(spec: Spec, given: Mapping[str, Handle | list[Handle]]) -> None:
    stage = spec.stage
    if not isinstance(spec.params, stage.params):
        raise TypeError(f"{spec.label}: params are {type(spec.params).__name__}, not {stage.params.__name__}")
    ports = {port.rstrip("*?"): port for port in stage.inputs}
    needed = {name for name, port in ports.items() if "?" not in port}
    if not (needed <= given.keys() <= ports.keys()):
        unknown, missing = sorted(given.keys() - ports.keys()), sorted(needed - given.keys())
        raise TypeError(f"{spec.label}: unknown inputs {unknown}, missing inputs {missing} (ports {stage.inputs})")
    for name, handle in given.items():
        if isinstance(handle, list) != ("*" in ports[name]):
            raise TypeError(f"{spec.label}: input {name} takes {'a list' if '*' in ports[name] else 'one handle'}")
