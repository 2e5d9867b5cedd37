"""A recorded sequence and a drive are one chain: each stage that both have gets the same ports in both."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rille.datasets.registry import open_sequence
from rille.pipeline.engine.graph import Graph
from rille.pipeline.flow import config
from rille.pipeline.flow.closed_loop import Drive, dataflow

HERE = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
BOX = {"x0": 0.0, "y0": 0.0, "cell": 0.01, "rows": 4, "cols": 4}
LEG = {"start": [0.0, 0.0, 0.0], "where": None, "reason": "", "left_m": 1.0, "way_m": 1.0}

SEEN = {"ground_share": 0.6, "ground_reach": 4.0}

FACTS: dict[str, dict[str, Any]] = {
    "frame_screening": {"asks": {"bridges": [], "sides": []}, "chain": [0, 1, 2], "lost": [], "unfit": []},
    "keyframes": {"basic": [0, 2], "segments": [[0, 1, 2]], "displacement": [1.0, 1.0], "match_rate": [1.0, 1.0]},
    "intrinsics": {"correction": []},
    "moving": {"share": 0.0},
    "trajectory": {"pieces": [[0, 1, 2]], "main": 0, "frames": [0, 1, 2], "positions": [[0, k, 0] for k in range(3)]},
    "radiometry": {"steps": {}},
    "tile_index": {"tiles": [(0, 0, 0, 0, 4, 4)], "box": BOX, "cell": 0.01},
    "ground_frame": {"T_local_left": HERE, "plane": [0.0, 0.0, -1.0], "source": "attitude"} | SEEN,
    "locus": {"lattice": BOX},
    "mockup.drive": {"poses": [HERE, HERE]},
    "mockup.sense": {"up": [[0.0, 0.0, 1.0]] * 2, "odometry": [[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]]},
    "motion": {"match_rate": 1.0},
    "fault_monitor": {"stop": None, "kind": None, "reason": ""},
    "obstacle_monitor": {"stop": None, "reason": ""},
}
"""What each stage would have found: enough that the graph grows to its end."""

APART = {"trajectory": {"intrinsics"}, "resect": {"after", "rig_after"}, "locus": {"moving"}}
"""Ports that one flow alone has, by stage: a drive goes on before there is anything to be adjusted jointly, a pair
after a segment to compare its rig with, or a frame that shows what moved."""


def grown(graph: Graph, failing: str = "") -> Graph:
    """All tasks of a dataflow, none of them run; those of a stage that fails have no results, nor what reads them."""
    waiting, legs = graph.waiting, 0
    while waiting:
        handles, grow = waiting.pop(0)
        facts: list[SimpleNamespace | None] = []
        for handle in graph.nodes:
            if handle.stage == failing or any(up.status == "failed" for up in handle.upstream()):
                handle.status = "failed"
        for handle in handles:
            if handle.status == "failed":
                facts.append(None)
                continue
            meta = FACTS.get(handle.stage, {})
            if handle.stage == "tile_index":
                meta = meta | {"pair": int(handle.label.split("/")[1])}
            if handle.stage == "local_planner":
                meta, legs = LEG | {"verdict": "goal" if legs else "drive"} | meta, legs + 1
            handle.ref = SimpleNamespace(meta=meta)  # type: ignore[assignment]
            facts.append(handle.ref)  # type: ignore[arg-type]
        if grow is not None:
            grow(*facts)
    return graph


def driving() -> Drive:
    """The closed loop as the program drives it by default, at its start."""
    sequence = open_sequence("mockup-loop")
    flow = Drive(Graph(), sequence, config.build(config.expand(sequence.defaults)))
    flow.graph.flow(flow.steps())
    return flow


def test_a_drive_that_fails_on_a_leg_is_judged_with_that_leg() -> None:
    flow = driving()
    grown(flow.graph, failing="fault_monitor")
    check = flow.driven.check
    assert check is not None
    drives = check.inputs["drives"]
    assert isinstance(drives, list)
    assert [handle.label for handle in drives] == ["drive/start", "drive/0"]
    assert check.spec.args["rows"] == [0, -1], "all of what was driven"


def test_a_drive_that_fails_at_the_start_is_judged_where_it_stands() -> None:
    flow = driving()
    grown(flow.graph, failing="ground_frame")
    check = flow.driven.check
    assert check is not None
    assert set(check.inputs) == {"drives"}
    assert check.spec.args["rows"] == [0]


@pytest.mark.parametrize(("way_m", "verdict"), [(0.0, "no path"), (0.7, "safety stop")])
def test_a_safety_stop_of_a_look_around_where_there_is_no_way_is_no_path(
    way_m: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flow = driving()
    found = {"verdict": "look", "way_m": way_m, "reason": "hazards close every way"}
    monkeypatch.setitem(FACTS, "local_planner", found)
    monkeypatch.setitem(FACTS, "fault_monitor", {"stop": 1, "kind": "lost", "reason": "0 landmarks"})
    grown(flow.graph)
    assert flow.driven.verdict == verdict
    assert flow.driven.reason.endswith("0 landmarks")
    assert flow.driven.check is not None


def ports(graph: Graph) -> dict[str, set[frozenset[str]]]:
    """Which ports the tasks of each stage have: more than one set where its tasks are of more than one kind."""
    found: dict[str, set[frozenset[str]]] = {}
    for handle in graph.nodes:
        if not any(upstream.stage.endswith("truth_dem") for upstream in handle.upstream()):
            found.setdefault(handle.stage, set()).add(frozenset(handle.inputs) - APART.get(handle.stage, set()))
    return found


@pytest.mark.parametrize("both", [True, False])
def test_each_stage_gets_the_same_ports_in_a_drive_as_in_a_reconstruction(both: bool) -> None:
    driven, recorded = open_sequence("mockup-loop"), open_sequence("mockup-short", {"mockup": {"frames": 3}})
    more = {"locus": {"both": both}}
    settings = config.build(config.expand(driven.defaults), more)
    graphs = Graph(), Graph()
    dataflow(graphs[0], driven, settings, (0,))
    dataflow(graphs[1], recorded, settings, (0, 1, 2))
    loop, chain = (ports(grown(graph)) for graph in graphs)
    shared = set(loop) & set(chain)
    assert shared >= {
        "hfvm",
        "ground_frame",
        "locus",
        "motion",
        "track",
        "resect",
        "pose",
        "risk",
        "merge",
        "trajectory",
        "rig",
    }
    assert {stage: loop[stage] for stage in shared} == {stage: chain[stage] for stage in shared}
    assert all(("back" in given) is both and "right" in given for given in loop["locus"])
