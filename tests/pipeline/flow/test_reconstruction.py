"""The dataflow where frames are lost and trajectories break: which tasks there are, and what they read."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rille.datasets.registry import open_sequence
from rille.pipeline.engine.graph import Graph
from rille.pipeline.flow import config
from rille.pipeline.flow.closed_loop import dataflow
from rille.pipeline.flow.products import Products

FRAMES = 8


def lay_out(
    asked: list[dict[str, Any]],
    answer: dict[str, Any],
    chosen: dict[str, Any],
    trajectory: dict[str, Any],
    tilted: bool = False,
    **given: Any,
) -> tuple[Graph, Products]:
    """The graph as it grows with these facts of the stages."""
    sequence = open_sequence("mockup-short", {"mockup": {"frames": FRAMES}})
    graph, settings = Graph(), config.build(config.expand(sequence.defaults), given)
    products, _ = dataflow(graph, sequence, settings, tuple(range(FRAMES)))
    nothing = {"asks": {"bridges": [], "sides": []}}
    steps = len(answer["chain"]) - 1
    found = chosen | {"displacement": [1.0] * steps, "match_rate": [1.0] * steps}
    for meta in [*({"asks": asks} for asks in asked), nothing | answer, found]:
        deciding = [w for w in graph.expansions if w[0][0].stage in ("continuity", "select")]
        deciding[-1][1](SimpleNamespace(meta=meta))
    for stage, meta in (("common_tilt", {"undone": tilted}), ("trajectory", trajectory)):
        for handles, go_on, _ in list(graph.expansions):
            if handles[0].label == stage:
                go_on(SimpleNamespace(meta=meta))
    return graph, products


def labels(graph: Graph, stage: str) -> list[str]:
    return [h.label for h in graph.nodes if h.stage == stage]


def test_a_lost_frame_is_bridged_and_no_pyramid_is_made_twice() -> None:
    graph, products = lay_out(
        [{"bridges": [(2, 4)], "sides": [2, 3, 4]}, {"bridges": [], "sides": [5]}],
        {"chain": [0, 1, 2, 4, 5, 6, 7], "lost": [{"frame": 3, "cause": "black"}], "unfit": [5]},
        {"basic": [0, 3, 5], "segments": [[0, 1, 2, 3], [3, 4, 5], [5, 6]]},
        {"frames": list(range(8)), "pieces": [[0, 7]], "main": 0, "positions": [[0, 0, k] for k in range(8)]},
    )
    assert labels(graph, "continuity") == ["continuity", "continuity/1", "continuity/2"]
    assert labels(graph, "sides") == ["sides/2", "sides/3", "sides/4", "sides/5"]
    assert products.select is not None
    assert products.select.spec.args == {"frames": 7, "unfit": [4], "behind": [3]}
    motions = products.tracks[0].inputs["motions"]
    assert isinstance(motions, list)
    assert [h.label for h in motions] == ["motion/0-1", "motion/1-2", "motion/2-4"]
    assert products.trajectory is not None
    assert products.trajectory.spec.args["lost"] == [{"frame": 3, "cause": "black"}]
    assert list(products.world_dem) == [0, 4, 6]
    assert labels(graph, "accuracy") == ["accuracy"]


def test_the_world_is_that_of_the_largest_piece_and_each_piece_is_judged() -> None:
    graph, products = lay_out(
        [],
        {"chain": list(range(8)), "lost": [], "unfit": []},
        {"basic": [0, 3, 6], "segments": [[0, 1, 2, 3], [3, 4, 5, 6], [6, 7]]},
        {"frames": list(range(8)), "pieces": [[0, 2], [3, 7]], "main": 1, "positions": [[0, 0, k] for k in range(8)]},
        resect={"landmarks": "dem"},
    )
    assert list(products.world_dem) == [3, 6]
    assert products.world_dem[6].inputs["reference"] is products.level[3]
    assert labels(graph, "accuracy") == ["accuracy/piece/1", "accuracy"]
    assert products.accuracy is products.accuracy_pieces[1]
    assert labels(graph, "refine") == []  # it needs landmarks of the disparity


def test_a_first_frame_that_is_lost_leaves_no_pair_behind() -> None:
    graph, products = lay_out(
        [],
        {"chain": list(range(1, 8)), "lost": [{"frame": 0, "cause": "black"}], "unfit": []},
        {"basic": [0, 3], "segments": [[0, 1, 2, 3], [3, 4, 5, 6]]},
        {"frames": list(range(8)), "pieces": [[1, 7]], "main": 0, "positions": [None, *([0, 0, k] for k in range(7))]},
        tilted=True,
    )
    assert list(products.disparity) == [1, 4]
    assert labels(graph, "refine") == ["refine/1", "refine/4", "refine/untilted/1", "refine/untilted/4"]
    assert products.trajectory is not None
    refined = products.trajectory.inputs["refined"]
    assert isinstance(refined, list)
    assert [h.label for h in refined] == ["refine/untilted/1", "refine/untilted/4"]
