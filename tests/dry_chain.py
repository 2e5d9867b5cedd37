"""A dry layout of the whole chain over a store that has everything: what would be computed after a change.

Nothing is computed. The chain waits for facts of some results, so these are made up here.
"""

from __future__ import annotations

import re
import typing
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rille.datasets.protocol import Sequence
from rille.datasets.registry import open_sequence
from rille.pipeline.engine import provenance
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow.closed_loop import dataflow
from rille.stages.core.declare import Params
from rille.stages.geometry.lens import Lens

FRAMES = (0, 1, 2, 3, 4)
BASIC = (0, 2, 4)
LATTICE = {"x0": -0.2, "y0": 0.4, "cell": 0.004, "rows": 60, "cols": 80}
TOUCHED = ([[0, 0, 10, 20, 60, 80]], [[0, -1, 30, -70, 60, 70], [0, 0, 30, 0, 60, 10]], [[0, -1, 40, -90, 60, 60]])
"""World tiles of the three models: the second shares one with the first, the other one with the third."""

POSITIONS = {"frames": list(FRAMES), "positions": [[0.0, 0.0, 0.0]] * len(FRAMES)}
FACTS: dict[str, dict[str, Any]] = {
    "keyframes": {
        "basic": list(BASIC),
        "segments": [[0, 1, 2], [2, 3, 4]],
        "displacement": [1.0] * 4,
        "match_rate": [1.0] * 4,
    },
    "ground_frame": {
        "T_local_left": [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0],
        "plane": [0.0, 0.0, -1.0],
        "source": "attitude",
        "ground_share": 0.6,
        "ground_reach": 4.0,
    },
    "locus": {"lattice": LATTICE},
    "frame_screening": {"asks": {"bridges": [], "sides": []}, "chain": list(FRAMES), "unfit": [], "lost": []},
    "trajectory": {**POSITIONS, "pieces": [list(range(5))], "main": 0},
    "crosscheck_join": {"frames": list(FRAMES), "pieces": [list(FRAMES)], "main": 0},
    "intrinsics": {"correction": []},
    "moving": {"share": 0.0},
    "loops": {"pairs": list(BASIC), "candidates": [[], [], [0]]},
    "loop": {"factors": [], "refused": []},
    "radiometry": {"steps": {"2": 3}},
}


class Everything(Store):
    """Has every artifact that it is asked for while it learns, and later only those."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.known: dict[str, Ref] = {}
        self.learning = True
        self.asked: Counter[str] = Counter()

    def lookup(self, stage: str, key: str, **_: Any) -> Ref | None:
        if self.learning:
            facts = FACTS.get(stage, {})
            if stage == "tile_index":
                n = self.asked[stage]  # in order of the pairs
                facts = {"pair": BASIC[n], "cell": LATTICE["cell"], "box": LATTICE, "tiles": TOUCHED[n]}
            self.asked[stage] += 1
            self.known[key] = Ref(key, stage, digest([stage, key]), facts, 0, 0.0)
        return self.known.get(key)


class Chain:
    """Layouts of a sequence over one store; ``base`` is that by which the store got everything."""

    def __init__(self, root: Path) -> None:
        self.sequence, self.store = short({}), Everything(root)
        self.config = self.configured({})
        self.base = self.plan({})
        self.nodes = {h.label: h for h in self.base.nodes}
        assert all(h.done for h in self.base.nodes)
        self.store.learning = False

    def configured(self, settings: dict[str, Any]) -> Params:
        return configuration.build(configuration.expand(self.sequence.defaults), settings)

    def plan(self, settings: dict[str, Any], sequence: Sequence | None = None) -> Graph:
        graph = Graph()
        dataflow(graph, sequence or self.sequence, self.configured(settings), FRAMES)
        assert not driver.run(graph, self.store, driver.RunOptions(dry=True)).failures
        return graph

    def earlier(self, label: str) -> Ref | None:
        return self.nodes[label].ref if label in self.nodes else None

    def rewired(self, h: Handle) -> bool:
        """Whether a task is new, or reads other tasks than before."""
        old = self.nodes.get(h.label)
        return old is None or [up.label for up in old.upstream()] != [up.label for up in h.upstream()]


@contextmanager
def laid_out(root: Path) -> Iterator[Chain]:
    """A chain of which a task that is to be computed again leads to what its label led to before."""
    chain = Chain(root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(provenance.History, "why_missed", lambda *_: "")
        patch.setattr(provenance.History, "latest", lambda history, handle: chain.earlier(handle.label))
        yield chain


def stale(graph: Graph) -> set[str]:
    """Labels of the tasks that the driver would compute."""
    return {h.label for h in graph.nodes if h.status == "planned"}


def downstream(graph: Graph, first: Callable[[Handle], bool]) -> set[str]:
    """Labels of the tasks that are ``first`` to be computed, and of all that they feed."""
    labels: set[str] = set()
    for h in graph.nodes:  # in order of creation: what feeds a task comes before it
        if first(h) or any(up.label in labels for up in h.upstream()):
            labels.add(h.label)
    return labels


def group(label: str) -> str:
    """Label without its numbers: ``locus/world`` of ``locus/world/12``."""
    return re.sub(r"[/_-]-?\d+", "", label)


def short(settings: dict[str, dict[str, Any]]) -> Sequence:
    """A mockup with distorted images, that can be matched in tiles."""
    mockup = {"frames": len(FRAMES), **settings.get("mockup", {})}
    sequence = open_sequence("mockup-short", {**settings, "mockup": mockup})
    lens = {c: Lens(getattr(sequence.rig, c), "radtan", (-0.1, 0.01, 0.0, 0.0)) for c in ("left", "right")}
    return replace(sequence, lenses=lens, defaults={**sequence.defaults, "hfvm.preset": "default", "loops.apart": 2})


def candidates(kind: Any, value: Any) -> Iterator[Any]:
    """Other values of a parameter, the nearest first."""
    if typing.get_origin(kind) is typing.Literal:
        yield from (v for v in typing.get_args(kind) if v != value)
    elif choices := [v for inner in typing.get_args(kind) for v in typing.get_args(inner) if isinstance(v, str)]:
        yield from ((v,) for v in choices) if isinstance(value, tuple) else choices
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value - 1, value + 2, 1, 2)
    elif isinstance(value, float):
        yield from (value * 1.01, value * 0.99, value + 1e-6, 0.1)
    elif isinstance(value, str):
        yield f"{value}x"
    elif isinstance(value, tuple):
        yield tuple(v * 1.01 for v in value)
        yield tuple(v + 0.1 for v in value)
    elif value is None:
        yield from (0.0123, (0.1, 0.2), (-1.0, 0.5, 1.0, 2.0), (0.1, 0.2, 0.3), 320, 1)
