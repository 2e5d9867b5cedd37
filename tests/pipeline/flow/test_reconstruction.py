"""The dataflow where frames are lost and trajectories break: which tasks there are, and what they read."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from raising import raises

from rille.datasets.registry import open_sequence
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.flow import config
from rille.pipeline.flow.builders import PYRAMID_BYTES, Builder, other_plane
from rille.pipeline.flow.closed_loop import dataflow
from rille.pipeline.flow.products import Products
from rille.pipeline.flow.selection import spread
from rille.pipeline.flow.world import cells_in_both, overlaps
from rille.stages.geometry.lens import Lens
from rille.stages.terrain.ground_frame import SCENE
from rille.stages.terrain.tile_index import Box

FRAMES = 8
ASKS_NOTHING = {"asks": {"bridges": [], "sides": []}}

WALL: Any = {"no_ground": "a wall", "plane": None}
GROUND: Any = {
    "plane": [0.0, 0.0, -1.0],
    "T_local_left": [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0],
    "source": "attitude",
    "ground_share": 0.6,
    "ground_reach": 4.0,
}


def lay_out(
    asked: list[dict[str, Any]],
    answer: dict[str, Any],
    chosen: dict[str, Any],
    trajectory: dict[str, Any],
    doubts: list[tuple[str, dict[str, Any]]] | None = None,
    jumps: dict[str, dict[str, Any]] | None = None,
    ground: dict[str, Any] | None = None,
    cameras: list[list[float]] | None = None,
    **given: Any,
) -> tuple[Graph, Products]:
    """The graph as it grows with these facts of the stages; ``doubts`` are those behind the first choice, in order."""
    sequence = open_sequence("mockup-short", {"mockup": {"frames": FRAMES}})
    graph, settings = Graph(), config.build(config.expand(sequence.defaults), given)
    products, _ = dataflow(graph, sequence, settings, tuple(range(FRAMES)))
    steps = len(answer["chain"]) - 1
    found = chosen | {"displacement": [1.0] * steps, "match_rate": [1.0] * steps}
    for meta in [*({"asks": asks} for asks in asked), ASKS_NOTHING | answer, found]:
        deciding = [w for w in graph.waiting if w[0][0].stage in ("frame_screening", "keyframes")]
        deciding[-1][1](SimpleNamespace(meta=meta))
    for stage, meta in doubts or [("rig", {})]:
        handles, go_on = [w for w in graph.waiting if w[0][0].stage == stage][-1]
        facts = found | meta if stage == "keyframes" else meta
        for handle in handles:
            handle.error = ValueError() if handle.label in facts.get("failed", ()) else None
        go_on(*(None if h.error else SimpleNamespace(meta=facts) for h in handles))
    for turn, correction in enumerate([*(cameras or []), [0.0, 0.0, 0.0, 0.0]]):
        asked = {"correction": correction, "corrected": correction}
        facts = {"keyframes": found, "ground_frame": ground or GROUND, "intrinsics": asked}
        for stage in [*(("keyframes", "rig") if turn else ()), "ground_frame", "resect", "intrinsics"]:
            of = (jumps or {}) if stage == "resect" else {}
            for handles, go_on in [w for w in graph.waiting if w[0][0].stage == stage][-1:]:
                go_on(*(SimpleNamespace(meta=of.get(h.label, facts.get(stage, {}))) for h in handles))
    for name in ("ground_frame", "trajectory"):
        for handles, go_on in list(graph.waiting):
            if handles[0].label.startswith(name) and len(handles) == 1:
                go_on(SimpleNamespace(meta=trajectory if name == "trajectory" else ground or GROUND))
    return graph, products


def labels(graph: Graph, stage: str) -> list[str]:
    return [h.label for h in graph.nodes if h.stage == stage]


def test_a_lost_frame_is_bridged_and_no_pyramid_is_made_twice() -> None:
    graph, products = lay_out(
        [{"bridges": [(2, 4)], "sides": [2, 3, 4]}, {"bridges": [], "sides": [5]}],
        {"chain": [0, 1, 2, 4, 5, 6, 7], "lost": [{"frame": 3, "cause": "black"}], "unfit": [5]},
        {"basic": [0, 3, 5], "segments": [[0, 1, 2, 3], [3, 4, 5], [5, 6]]},
        {"frames": list(range(8)), "pieces": [list(range(8))], "main": 0, "positions": [[0, 0, k] for k in range(8)]},
    )
    assert labels(graph, "frame_screening") == ["frame_screening", "frame_screening/1", "frame_screening/2"]
    assert labels(graph, "swap_check") == ["swap_check/2", "swap_check/3", "swap_check/4", "swap_check/5"]
    assert products.keyframes is not None
    assert products.keyframes.spec.args == {"frames": 7, "unfit": [4], "behind": [3]}
    track = products.resections[0].inputs["track"]
    assert isinstance(track, Handle)
    motions = track.inputs["motions"]
    assert isinstance(motions, list)
    assert [h.label for h in motions] == ["motion/0-1", "motion/1-2", "motion/2-4"]
    assert products.trajectory is not None
    assert products.trajectory.spec.args["lost"] == [{"frame": 3, "cause": "black"}]
    assert list(products.world_dem) == [0, 4, 6]
    assert labels(graph, "accuracy") == ["accuracy", "accuracy/crosscheck"]


def test_wrong_cameras_are_corrected_in_all_that_rests_on_them_and_nothing_else_is_made_twice() -> None:
    graph, products = lay_out(
        [],
        {"chain": list(range(8)), "lost": [], "unfit": []},
        {"basic": [0, 4], "segments": [[0, 1, 2, 3, 4], [4, 5, 6, 7]]},
        {"frames": list(range(8)), "pieces": [list(range(8))], "main": 0, "positions": [[0, 0, k] for k in range(8)]},
        cameras=[[-0.1, 0.0, 0.0, 0.0]],
    )
    assert labels(graph, "intrinsics") == ["intrinsics", "intrinsics/anew"]
    asked = [h for h in graph.nodes if h.label in ("orientation/0", "orientation/0/anew")]
    given, again = (h.spec.args["rig"]["left"]["fx"] for h in asked)
    assert again == pytest.approx(0.9 * given)
    (anew,) = [h for h in graph.nodes if h.label == "calibration/anew"]
    using = [*products.resections, *products.local_dem.values(), *products.world_dem.values()]
    assert [h.inputs["rig"] for h in using] == [anew] * 6
    assert len(labels(graph, "hfvm")) == 2
    assert labels(graph, "locus")[:2] == ["locus/local/0", "locus/local/4"]
    assert products.intrinsics in products.contradictions


@pytest.mark.parametrize("sees_ground", [True, False])
def test_nothing_is_asked_of_a_vehicle_where_no_pair_sees_ground(sees_ground: bool) -> None:
    graph, products = lay_out(
        [],
        {"chain": list(range(8)), "lost": [], "unfit": []},
        {"basic": [0, 4], "segments": [[0, 1, 2, 3, 4], [4, 5, 6, 7]]},
        {"frames": list(range(8)), "pieces": [list(range(8))], "main": 0, "positions": [[0, 0, k] for k in range(8)]},
        ground=GROUND if sees_ground else WALL,
    )
    kind = "ground_frame" if sees_ground else "reference_plane"
    assert [level.label for level in products.level.values()] == [f"{kind}/0", f"{kind}/4"]
    assert (len(products.local_risk), len(products.local_path)) == ((2, 2) if sees_ground else (0, 0))
    assert list(products.world_dem) == [0, 4]
    assert labels(graph, "ground_frame")[:2] == ["ground_frame/0", "ground_frame/4"]


def test_a_plane_that_is_no_ground_has_no_place_on_earth() -> None:
    chosen = config.build({"terrain": {"reference": [0.0, 0.0, -1.0, 0.0, 0.0, 2.0]}})
    assert other_plane(chosen, [], placed=False) == {"reference": [0.0, 0.0, -1.0, 0.0, 0.0, 2.0]}
    with raises("RIL-052"):
        other_plane(chosen, [], placed=True)
    scene = {"reference": SCENE, "why": "0 of 1 pairs show ground"}
    assert [other_plane(config.build(), [WALL], placed=placed) for placed in (False, True)] == [scene, None]


def test_a_small_right_image_is_expected_to_take_the_room_of_a_left_one() -> None:
    sequence = open_sequence("mockup-short", {})
    rig = sequence.rig
    small = replace(rig.right, width=rig.right.width // 4, height=rig.right.height // 4)
    expected = []
    for right in (rig.right, small):
        make = Builder(Graph(), replace(sequence, rig=replace(rig, right=right)), config.build({}))
        node, sizes = make.disparity(0), [one.width * one.height for one in (rig.left, right)]
        expected.append(node.expect + PYRAMID_BYTES * sum(sizes))
        # The other way the large image is the right one: what is there is enough.
        assert make.backward(0).expect == 0.0
    assert expected[0] == pytest.approx(expected[1])


def test_the_report_shows_images_free_of_distortion() -> None:
    sequence = open_sequence("mockup-short", {})
    make = Builder(Graph(), sequence, config.build({}))
    assert make.image(0, "left") is make.products.images[0] is make.raw_image(0, "left")
    lens = Lens(sequence.rig.left, "radtan", (0.1, 0.0, 0.0, 0.0, 0.0))
    make = Builder(Graph(), replace(sequence, lenses={"left": lens, "right": lens}), config.build({}))
    make.image(0, "right")
    assert not make.products.images
    assert make.image(0, "left") is make.products.images[0]
    assert make.products.images[0].stage == "undistort"


def test_a_model_is_compared_with_those_that_share_most_ground_however_often_a_place_is_seen() -> None:
    make = Builder(Graph(), open_sequence("mockup-short", {}), config.build({}))
    named: Any = [SimpleNamespace(label=str(k)) for k in range(60)]
    make.products.world_dem = {k: Handle(k, spec, {}) for k, spec in enumerate(named)}
    shifts = [3 * (k % 30) for k in range(60)]  # there and there again: each place is seen twice
    seams = overlaps(make, [{"pair": k, "tiles": [[0, 0, shift, 0, 100, 50]]} for k, shift in enumerate(shifts)])
    assert list(seams) == list(range(1, 60)), "the first has no earlier one"
    others = {pair: [int(handle.label) for handle in seam.upstream()[1:]] for pair, seam in seams.items()}
    assert others[20] == list(range(20))
    assert others[59] == [*range(18, 30), *range(47, 59)], "the nearest of both times"
    assert len(others[59]) == 24


@pytest.mark.parametrize(
    ("a", "b", "cells"),
    [((0, 0, 10, 5), (7, 3, 10, 5), 6), ((0, 0, 10, 5), (12, 0, 10, 5), 0), ((0, 0, 10, 5), (2, 1, 3, 2), 6)],
)
def test_cells_of_two_boxes(a: Box, b: Box, cells: int) -> None:
    assert cells_in_both(a, b) == cells_in_both(b, a) == cells


@pytest.mark.parametrize(("count", "found"), [(1, 1), (200, 200), (201, 101), (5000, 200)])
def test_a_rig_is_found_from_pairs_over_the_whole_sequence(count: int, found: int) -> None:
    some = spread(list(range(count)), 200)
    assert len(some) == found
    assert some[0] == 0
    assert some[-1] >= count - max(count // found + 1, 1)


def test_the_world_is_that_of_the_largest_piece() -> None:
    graph, products = lay_out(
        [],
        {"chain": list(range(8)), "lost": [], "unfit": []},
        {"basic": [0, 3, 6], "segments": [[0, 1, 2, 3], [3, 4, 5, 6], [6, 7]]},
        {
            "frames": list(range(8)),
            "pieces": [[0, 1, 2], [3, 4, 5, 6, 7]],
            "main": 1,
            "positions": [[0, 0, k] for k in range(8)],
        },
        resect={"joint": False},
    )
    assert list(products.world_dem) == [3, 6]
    assert products.world_dem[6].inputs["reference"] is products.level[3]
    assert labels(graph, "intrinsics") == []


def test_a_first_frame_that_is_lost_leaves_no_pair_behind() -> None:
    _, products = lay_out(
        [],
        {"chain": list(range(1, 8)), "lost": [{"frame": 0, "cause": "black"}], "unfit": []},
        {"basic": [0, 3], "segments": [[0, 1, 2, 3], [3, 4, 5, 6]]},
        {"frames": list(range(8)), "pieces": [[1, 7]], "main": 0, "positions": [None, *([0, 0, k] for k in range(7))]},
    )
    assert list(products.disparity) == [1, 4]
    assert products.trajectory is not None
    segments = products.trajectory.inputs["segments"]
    assert isinstance(segments, list)
    assert [h.label for h in segments] == ["resect/1", "resect/4"]


def test_what_many_tasks_are_given_is_held_once() -> None:
    graph, _ = lay_out(
        [],
        {"chain": list(range(FRAMES)), "lost": [], "unfit": []},
        {"basic": [0, 3, 5], "segments": [[0, 1, 2, 3], [3, 4, 5], [5, 6, 7]]},
        {"frames": list(range(8)), "pieces": [list(range(8))], "main": 0, "positions": [[0, 0, k] for k in range(8)]},
    )
    for name, least in (("rig", 3), ("vehicle", 3)):
        # The simulator's truth is of the true rig, which is another one.
        given = [h.spec.args[name] for h in graph.nodes if name in h.spec.args and h.stage != "mockup.truth"]
        assert len(given) >= least
        assert len({id(value) for value in given}) == 1, name


WHOLE = {"chain": list(range(FRAMES)), "lost": [], "unfit": []}
CHOICE = {"basic": [0, 3, 5, 6], "segments": [[0, 1, 2, 3], [3, 4, 5], [5, 6], [6, 7]]}
POSED = {"frames": list(range(8)), "pieces": [list(range(8))], "main": 0, "positions": [[0, 0, k] for k in range(8)]}


def test_a_pair_of_two_moments_is_no_basic_pair() -> None:
    again = {"basic": [0, 2, 5, 6], "segments": [[0, 1, 2], [2, 3, 4, 5], [5, 6], [6, 7]]}
    exchanged = ("synchrony", {"partners": [[3, 4]], "contradiction": "left 3 with right 4"})
    as_before = ("frame_screening", ASKS_NOTHING | WHOLE)
    doubts = [("rig", {"suspects": [3]}), exchanged, as_before, ("keyframes", again), ("rig", {})]
    graph, products = lay_out([], WHOLE, CHOICE, POSED, doubts=doubts)
    assert products.keyframes is not None
    assert products.keyframes.spec.args["unfit"] == [3]
    assert list(products.disparity) == [0, 2, 5, 6]
    right = next(h for h in graph.nodes if h.stage == "synchrony").inputs["right"]
    assert isinstance(right, list)
    assert [h.label for h in right] == [f"features/right/{k}" for k in range(7)]
    assert list(products.world_dem) == [0, 2, 5, 6]


@pytest.mark.parametrize("late", [True, False])
def test_where_most_pairs_contradict_their_rig_nothing_is_measured(late: bool) -> None:
    line = {"contradiction": "left i with right i+1"}
    rig = {"suspects": [0, 3, 5, 6]} | ({} if late else line)
    found = ("synchrony", {"partners": [[k, k + 1] for k in (0, 3, 5)] if late else []} | (line if late else {}))
    as_before = [("frame_screening", ASKS_NOTHING | WHOLE)] if late else []
    graph, products = lay_out([], WHOLE, CHOICE, POSED, doubts=[("rig", rig), found, *as_before])
    assert products.trajectory is None
    assert bool(products.rigs) != late
    assert labels(graph, "resect") == labels(graph, "locus") == []


def test_behind_an_image_that_one_camera_lost_all_frames_are_lost_and_those_before_are_kept() -> None:
    """Most basic pairs are wrong: the others go on, and the rig that the wrong ones showed is of no account."""
    late = {"chain": [0, 1, 2], "lost": [{"frame": k, "cause": "late"} for k in range(3, 8)], "unfit": []}
    doubts = [
        ("rig", {"suspects": [3, 5, 6]}),
        ("synchrony", {"partners": [[5, 4], [6, 5]], "contradiction": "left 5 with right 4"}),
        ("frame_screening", ASKS_NOTHING | late | {"late": [3, 4, 5, 6, 7]}),
        ("keyframes", {"basic": [0, 2], "segments": [[0, 1, 2]], "displacement": [1.0] * 2, "match_rate": [1.0] * 2}),
        ("rig", {}),
    ]
    graph, products = lay_out([], WHOLE, CHOICE, POSED, doubts=doubts)
    assert len(labels(graph, "swap_check")) == FRAMES
    assert products.trajectory is not None
    assert products.trajectory.spec.args["lost"] == late["lost"]
    assert [h.label for h in products.contradictions] == ["synchrony/lost/5", "intrinsics"]
    assert products.contradictions[0].spec.args["pairs"] == [3, 4, 5, 6, 7]
    assert {h.label for h in graph.nodes if h.index in graph.outdated} == {"rig", "synchrony"}


@pytest.mark.parametrize("few", [True, False], ids=["few matches", "bad rows"])
def test_one_pair_that_does_not_fit_the_rig_of_its_neighbours_is_lost_and_bridged(few: bool) -> None:
    """A torn image, or one of another scene or time, in one camera."""
    judged = {"per_pair": [{"pair": k} for k in (0, 5, 6)]} if few else {"suspects": [3]}
    if not few:
        judged["per_pair"] = [{"pair": k} for k in (0, 3, 5, 6)]
    again: dict[str, Any] = {"basic": [0, 2, 5], "segments": [[0, 1, 2], [2, 3, 4, 5], [5, 6]]}
    doubts = [
        ("rig", judged),
        *([] if few else [("synchrony", {"partners": []})]),
        ("keyframes", again | {"displacement": [1.0] * 6, "match_rate": [1.0] * 6}),
        ("rig", {"per_pair": [{"pair": k} for k in (0, 2, 6)]}),
    ]
    graph, products = lay_out([], WHOLE, CHOICE, POSED, doubts=doubts)
    assert products.trajectory is not None
    (lost,) = products.trajectory.spec.args["lost"]
    assert lost["frame"] == 3
    assert "do not fit each other" in lost["cause"]
    assert list(products.world_dem) == [0, 2, 6]
    assert "motion/2-4" in labels(graph, "motion")
    assert "rig" in {h.label for h in graph.nodes if h.index in graph.outdated}


def test_a_pair_whose_matches_fit_no_rig_is_lost_where_most_fit() -> None:
    """The first one, say, whose right image is torn."""
    impossible = ("ground_frame", GROUND | {"failed": ["ground_frame/0"]})
    again: dict[str, Any] = {"basic": [0, 3, 5], "segments": [[0, 1, 2, 3], [3, 4, 5], [5, 6]]}
    anew = [("keyframes", again | {"displacement": [1.0] * 6, "match_rate": [1.0] * 6}), ("rig", {})]
    _, products = lay_out([], WHOLE, CHOICE, POSED, doubts=[("rig", {}), impossible, *anew])
    assert products.trajectory is not None
    (lost,) = products.trajectory.spec.args["lost"]
    assert lost["frame"] == 0
    assert "do not fit each other" in lost["cause"]
    assert list(products.disparity) == [1, 4, 6]


def test_two_pairs_in_a_row_that_do_not_fit_may_be_a_rig_that_moved() -> None:
    doubts: list[tuple[str, dict[str, Any]]] = [("rig", {"per_pair": [{"pair": 0}, {"pair": 6}]})]
    _, products = lay_out([], WHOLE, CHOICE, POSED, doubts=doubts)
    assert list(products.world_dem) == [0, 3, 5, 6]


def test_rows_that_no_other_moment_explains_change_nothing() -> None:
    doubts = [("rig", {"suspects": [0, 3, 5, 6]}), ("synchrony", {"partners": []})]
    _, products = lay_out([], WHOLE, CHOICE, POSED, doubts=doubts)
    assert list(products.world_dem) == [0, 3, 5, 6]


def test_each_pair_of_a_rig_that_moves_in_the_rows_has_its_own() -> None:
    doubts = [("rig", {"knocked": "the rig moved at pair 5"}), ("keyframes", CHOICE), ("rig", {})]
    _, products = lay_out([], WHOLE, CHOICE, POSED, doubts=doubts)
    assert len({id(handle) for handle in products.rigs.values()}) == 4
    assert products.contradictions[0].label == "rig"


@pytest.mark.parametrize(
    ("back", "refused", "world"), [(False, [5, 6], [0, 3]), (True, [5], [0, 3, 6])], ids=["knocked", "and back"]
)
def test_what_a_knocked_rig_measures_is_worth_no_pose(back: bool, refused: list[int], world: list[int]) -> None:
    jumps = {"resect/3": {"jump": [3.0, 0.0], "knocked": "the rig moved at pair 5"}}
    if back:
        jumps["resect/5"] = {"jump": [-2.6, 0.1], "knocked": "the rig moved at pair 6"}
    _, products = lay_out([], WHOLE, CHOICE, POSED, jumps=jumps, rig={"mode": "fixed"})
    said = [h.spec.args.get("refused") for h in products.resections]
    assert [int(h.label.split("/")[1]) for h, cause in zip(products.resections, said, strict=True) if cause] == refused
    assert set(said) == {None, "the rig moved at pair 5"}
    assert list(products.world_dem) == list(products.local_dem) == world
    # The given calibration is judged by what was measured with it.
    assert products.intrinsics is not None
    assert products.intrinsics.inputs["segments"] == [
        h for h, cause in zip(products.resections, said, strict=True) if cause is None
    ]


def test_each_pair_of_a_rig_that_shakes_has_its_own() -> None:
    """A knock that stays although it was followed: rows show it, which the turn along the lines does not change."""
    knock = {"jump": [0.0, 1.4], "knocked": "the rig moved at pair 5"}
    jumps = {"resect/3": knock, "resect/3/anew": knock}
    _, products = lay_out([], WHOLE, CHOICE, POSED, jumps=jumps, cameras=[[0.0] * 4, [0.0] * 4])
    assert len({id(handle) for handle in products.rigs.values()}) == 4
    assert [h.spec.args.get("refused") for h in products.resections] == [None] * 4
    assert products.contradictions[0].label == "resect/3/anew"
    assert list(products.world_dem) == [0, 3, 5, 6]


def test_from_a_knock_on_the_rig_that_it_left_is_used() -> None:
    knock = {"jump": [3.0, 0.0], "knocked": "the rig moved at pair 5"}
    _, products = lay_out([], WHOLE, CHOICE, POSED, jumps={"resect/3": knock}, cameras=[[0.0] * 4])
    assert [h.label for h in products.rigs.values()] == ["rig", "rig", "knocked/5/5", "knocked/5/5"]
    assert products.rigs[5].spec.args == {"jump": [3.0, 0.0], "cause": "the rig moved at pair 5"}
    known = [h.inputs["rig"] for h in products.local_dem.values()]
    assert [one.inputs["rig"] for one in known if isinstance(one, Handle)] == list(products.rigs.values())
    assert [h.spec.args.get("refused") for h in products.resections] == [None] * 4
    assert not products.contradictions or products.contradictions == [products.intrinsics]
