"""The task graph: nodes that name a stage, and expansions that add nodes once earlier results are known.

>>> graph = Graph()
>>> select = graph.node("stages.odometry.keyframes", "select", SelectParams(), {"frames": 9})
>>> def pairs(selected: Ref) -> None:
...     for k in selected.meta["basic"]:
...         graph.node("stages.hfvm", f"hfvm/{k}", params, {"pair": k}, inputs={"left": left[k], "right": right[k]})
>>> graph.expand([select], pairs)

A :class:`Handle` stands for a node; after (or during) the run its ``status`` and ``ref`` say what became of it.
Order of creation is priority: what is created first runs first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from pipeline.engine.store.folder import Ref
from pipeline.engine.task import Refs, Spec
from stages.core.declare import Params

Expansion = Callable[..., None]


@dataclass(eq=False)
class Handle:
    """A node of the graph and what became of it.

    ``status`` is ``pending``, ``running``, ``computed``, ``cached``, ``failed``, ``skipped`` or, when dry, ``planned``.
    ``reason`` says in words why it was not found in the cache, or why it was skipped. ``earlier``, of a planned node,
    is what the same label led to before: a plan takes its facts for what is to come. ``expect`` are bytes (decoded)
    that it reads from outside. Of a computed node: ``seconds`` of the call and of the stage's own ``kernel``, when it
    ``started`` (seconds since 1970), and the figures of a :class:`pipeline.engine.memory.limits.Meter` (``first``:
    with imports and kernels; ``compiling``: seconds for which kernels were compiled).
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
    seconds: float = 0.0
    kernel: float = 0.0
    started: float = 0.0
    peak_rss: int = 0
    memory: int | None = None
    rest: int | None = None
    first: bool = False
    compiling: float = 0.0
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
        return [h for given in self.inputs.values() for h in (given if isinstance(given, list) else [given])]

    def refs(self) -> Refs:
        """References of all inputs by port; call it when they are done."""
        return {p: [_ref(h) for h in g] if isinstance(g, list) else _ref(g) for p, g in self.inputs.items()}


@dataclass
class Graph:
    """Nodes in order of creation, and expansions that wait for some of them."""

    sequence: str = ""
    """Name of the sequence it works on, and of the choice of its frames: hints of earlier runs are kept by them."""
    choice: str = ""
    nodes: list[Handle] = field(default_factory=list)
    expansions: list[tuple[list[Handle], Expansion, bool]] = field(default_factory=list)
    _labels: set[str] = field(default_factory=set)

    def node(
        self,
        module: str,
        label: str,
        params: Params,
        args: Mapping[str, Any] | None = None,
        hints: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Handle | Sequence[Handle]] | None = None,
        expect: float = 0.0,
    ) -> Handle:
        """Add a task and give its handle.

        ``inputs`` maps each port of the stage to a handle, or to a list of them for a port declared ``name*``;
        ``expect`` are decoded bytes of what it reads from outside, for estimates.

        Raises
        ------
        ValueError
            The label is taken.
        TypeError
            The inputs do not fit the ports of the stage, or the parameters are of another model.
        """
        if label in self._labels:
            raise ValueError(f"the label {label!r} is taken: labels of nodes are unique")
        spec = Spec(module, label, params, dict(args or {}), dict(hints or {}))
        given = {p: h if isinstance(h, Handle) else list(h) for p, h in (inputs or {}).items()}
        _check_ports(spec, given)
        handle = Handle(len(self.nodes), spec, given, expect=expect)
        self._labels.add(label)
        self.nodes.append(handle)
        return handle

    def expand(self, handles: Sequence[Handle], fn: Expansion, *, holes: bool = False) -> None:
        """Call ``fn(ref, ref, ...)`` on the client as soon as all ``handles`` have artifacts; it adds nodes.

        With ``holes`` it is called, too, when some of them will never have one: it gets None for each of these.
        """
        self.expansions.append((list(handles), fn, holes))


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
