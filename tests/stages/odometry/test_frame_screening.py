"""Which frames are lost: by hand-made figures, and the stage on known displacements."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from motion_scenes import motion, shift, tables
from raising import raises

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.imaging.image_quality import ALONG
from rille.stages.odometry.frame_screening import FrameScreeningParams, frame_screening_stage, judge

PARAMS = FrameScreeningParams()


def sight(k, **left):
    good = {"mean": 100.0, "deviation": 40.0, **dict.fromkeys(ALONG, 0.5), "detail": 0.1}
    return {"left": good | {"digest": f"L{k}"} | left, "right": good | {"digest": f"R{k}"}}


def found(steps, qualities=None, jumps=(), sides=None, n=7):
    """Judgement of ``n`` frames; steps not given match well."""
    rates = dict.fromkeys(itertools.pairwise(range(n)), 0.7) | steps
    return judge(range(n), qualities or {k: sight(k) for k in range(n)}, rates, jumps, sides or {}, PARAMS)


def test_good_frames_are_kept_and_nothing_is_asked():
    out = found({})
    assert not out.lost
    assert not out.unfit
    assert not any(out.asks.values())


def test_a_frame_that_neither_neighbour_is_found_in_is_bridged_if_the_bridge_holds():
    alone = {(2, 3): 0.05, (3, 4): 0.04}
    assert found(alone).asks["bridges"] == [(2, 4)]
    out = found(alone | {(2, 4): 0.5})
    assert out.lost == {3: "not found in its neighbours: 5% of its pixels match the frame before, 4% the one after"}
    # nothing speaks against the frame itself where the bridge is as bad: the camera may have jumped
    assert not found(alone | {(2, 4): 0.05}).lost


def test_two_foreign_frames_are_bridged_together():
    alone = {(2, 3): 0.05, (3, 4): 0.1, (4, 5): 0.04}
    assert found(alone).asks["bridges"] == [(2, 5)]
    assert list(found(alone | {(2, 5): 0.5}).lost) == [3, 4]


def test_one_doubtful_step_is_a_jump_and_loses_no_frame():
    out = found({(2, 3): 0.01})
    assert not out.lost
    assert not out.asks["bridges"]


def test_a_black_frame_is_lost_whatever_matches_and_is_bridged():
    qualities = {k: sight(k) for k in range(7)} | {3: sight(3, mean=0.0, deviation=0.2)}
    assert found({}, qualities).asks["bridges"] == [(2, 4)]
    out = found({(2, 4): 0.6}, qualities)
    assert out.lost == {3: "black left image (grey values deviate by 0.2 levels)"}
    qualities[3] = sight(3, mean=None, deviation=0.0, damage="left image 3.png is damaged")
    assert found({(2, 4): 0.6}, qualities).lost == {3: "left image 3.png is damaged"}


@pytest.mark.parametrize(("what", "words"), [("sharpness", ""), ("sharpness_rows", " along the rows")])
def test_a_blurred_frame_is_posed_but_not_basic_unless_nothing_matches_it(what, words):
    qualities = {k: sight(k) for k in range(7)} | {3: sight(3, **{what: 0.2})}
    out = found({}, qualities)
    assert out.unfit == {3: f"blurred left image (40% of the usual sharpness{words})"}
    assert not out.lost
    alone = {(2, 3): 0.05, (3, 4): 0.05, (2, 4): 0.1}
    assert "blurred left image" in found(alone, qualities).lost[3]


def test_frames_of_noise_alone_make_no_pairs_however_many_and_blur_none_of_the_others():
    noise = {"mean": 3.0, "deviation": 1.5, "sharpness": 4.6, "detail": 0.19}
    qualities = {k: sight(k) for k in range(7)}
    for k in range(3, 7):  # more than half: a cap on the right lens
        qualities[k]["right"] |= noise
    out = found({}, qualities)
    assert out.unfit == dict.fromkeys(range(3, 7), "right image of noise alone")
    assert not out.lost
    assert found({}, {k: sight(k, **(noise if k == 6 else {})) for k in range(7)}).lost == {
        6: "left image of noise alone"
    }


def test_what_a_camera_comes_to_see_is_no_blur():
    """Level ground before stairs, whose edges are sharp: 0.45 of the sequence's median, never of the images around."""
    qualities = {k: sight(k, sharpness=min(0.5 + 0.04 * k, 1.2)) for k in range(40)}
    assert not found({}, qualities).unfit
    qualities[5] = sight(5, sharpness=0.3)
    assert list(found({}, qualities).unfit) == [5]


def test_a_blur_beyond_all_detail_is_told_though_noise_looks_sharp():
    qualities = {k: sight(k) for k in range(7)} | {3: sight(3, detail=0.02, sharpness=0.9)}
    assert found({}, qualities).unfit == {3: "blurred left image (20% of the usual detail)"}


def test_blurred_frames_before_the_first_good_pair_are_lost():
    qualities = {k: sight(k, **({"sharpness": 0.2} if k < 2 else {})) for k in range(7)}
    out = found({}, qualities)
    assert list(out.lost) == [0, 1]
    assert "no good pair before it" in out.lost[0]


def test_a_sequence_without_a_good_pair_is_refused():
    qualities = {k: sight(k) for k in range(7)}
    for k in range(7):
        qualities[k]["right"] = qualities[k]["right"] | {"deviation": 0.0, "mean": 0.0}
    with raises("RIL-316", "frame 0"):
        found({}, qualities)


def test_a_repeated_frame_is_told_and_a_stuck_camera_makes_no_basic_pair():
    qualities = {k: sight(k) for k in range(7)}
    qualities[3] = {side: qualities[3][side] | {"digest": qualities[2][side]["digest"]} for side in ("left", "right")}
    out = found({}, qualities)
    assert out.repeated == [(2, 3)]
    assert not out.unfit
    qualities[5]["right"] = qualities[5]["right"] | {"digest": qualities[4]["right"]["digest"]}
    assert found({}, qualities).unfit == {5: "its right image is that of frame 4"}


def test_exchanged_sides_are_looked_for_at_jumps_and_beside_each_other():
    looked = {"swapped": False, "as_given": 0.9, "exchanged": 0.0}
    swapped = {"swapped": True, "as_given": 0.02, "exchanged": 0.95}
    assert found({}, jumps=[3]).asks["sides"] == [3]
    asked = found({}, jumps=[3], sides={3: swapped}).asks
    assert asked == {"sides": [2, 4], "bridges": [(2, 4)]}
    out = found({(2, 4): 0.6}, jumps=[3], sides={2: looked, 3: swapped, 4: looked})
    assert list(out.lost) == [3]
    assert "swapped, or both upside down or mirrored (95%" in out.lost[3]
    assert not found({}, jumps=[3], sides={3: looked}).lost


def test_frames_whose_left_image_is_of_another_time_are_lost_beside_frames_that_fit_the_rig():
    fits, apart = ({"swapped": False, "as_given": share, "exchanged": 0.08} for share in (0.97, 0.35))
    tested = {2: fits, 3: apart, 4: fits}
    out = found({(2, 4): 0.6}, jumps=[3], sides=tested)
    assert list(out.lost) == [3]
    assert "not of one time (35%" in out.lost[3]
    # a rig that fits no frame speaks against itself, not against a frame
    assert not found({}, jumps=[3], sides=dict.fromkeys((2, 3, 4), apart)).lost
    half, least = apart | {"as_given": 0.59}, apart | {"as_given": 0.1}
    assert not found({}, jumps=[3], sides={2: half, 3: least, 4: half}).lost
    # a mount that moved keeps its frame; on a straight lift images of two times look nearly like one
    assert not found({}, jumps=[3], sides={2: fits, 3: apart | {"as_turned": 0.95}, 4: fits}).lost
    assert list(found({(2, 4): 0.6}, jumps=[3], sides={2: fits, 3: apart | {"as_turned": 0.88}, 4: fits}).lost) == [3]
    # nor does one that fits somewhat less
    assert not found({}, jumps=[3], sides={2: fits, 3: fits | {"as_given": 0.6}, 4: fits}).lost


@pytest.mark.parametrize(
    ("columns", "asked"),
    [
        ((9.0, 9.0, -40.0, 58.0, 9.0), {1, 2, 3, 4, 5}),
        ((-40.0, 58.0, -40.0, 58.0, -40.0), {0, 1, 2, 3, 4, 5}),
        ((30.0, 23.0, 31.0, 24.0, 30.0), set()),
    ],
    ids=["one exchanged", "every other exchanged", "none, uneven"],
)
def test_exchanged_frames_stand_out_among_six(columns, asked):
    frames = list(range(6))
    qualities = [Bundle({}, {"frame": k} | sight(k)) for k in frames]
    inputs = {"qualities": qualities, "steps": tables([motion(shift(c)) for c in columns]), "bridges": [], "sides": []}
    assert set(frame_screening_stage.run(PARAMS, {"frames": frames}, inputs).meta["asks"]["sides"]) == asked


def test_the_stage_asks_then_answers():
    frames = list(range(5))
    blind = motion(shift(0.0), unmatched=lambda x, y: x > 20)
    motions = [motion(shift(9.0)), blind, blind, motion(shift(9.0))]
    qualities = [Bundle({}, {"frame": k} | sight(k)) for k in frames]
    sides = [Bundle({}, {"frame": k, "swapped": False, "as_given": 0.9, "exchanged": 0.0}) for k in frames]
    inputs = {"qualities": qualities, "steps": tables(motions), "bridges": [], "sides": sides}
    first = frame_screening_stage.run(PARAMS, {"frames": frames}, inputs)
    check_outputs(frame_screening_stage, first)
    assert first.meta["asks"]["bridges"] == [[1, 3]]
    args = {"frames": frames, "bridged": [[1, 3]]}
    last = frame_screening_stage.run(PARAMS, args, inputs | {"bridges": [motion(shift(18.0))]})
    assert last.meta["chain"] == [0, 1, 3, 4]
    assert [item["frame"] for item in last.meta["lost"]] == [2]
    assert not any(last.meta["asks"].values())


def test_a_run_is_told_of_a_camera_that_shows_grey_rows():
    qualities = [Bundle({}, {"frame": k} | sight(k)) for k in range(3)]
    for k in (1, 2):
        qualities[k].meta["right"]["grey_rows"] = 0.5
    inputs = {"qualities": qualities, "steps": tables([motion(shift(9.0))] * 2), "bridges": [], "sides": []}
    (line,) = frame_screening_stage.run(PARAMS, {"frames": [0, 1, 2]}, inputs).meta["warnings"]
    assert line.startswith("2 of 3 right images show one grey value in 50% of their rows")


def test_a_run_is_told_of_a_camera_whose_images_are_faint():
    qualities = [Bundle({}, {"frame": k} | sight(k)) for k in range(3)]
    for k in (1, 2):
        qualities[k].meta["right"]["deviation"] = 2.0
    inputs = {"qualities": qualities, "steps": tables([motion(shift(9.0))] * 2), "bridges": [], "sides": []}
    (line,) = frame_screening_stage.run(PARAMS, {"frames": [0, 1, 2]}, inputs).meta["warnings"]
    assert line.startswith("the right images are faint: their grey values deviate by 2.0")


def test_the_stage_looks_at_the_sides_where_displacements_jump():
    steps = [motion(shift(u)) for u in (9.0, 9.5, 9.0, 60.0, -42.0, 9.0)]
    qualities = [Bundle({}, {"frame": k} | sight(k)) for k in range(7)]
    inputs = {"qualities": qualities, "steps": tables(steps), "bridges": [], "sides": []}
    asks = frame_screening_stage.run(PARAMS, {"frames": list(range(7))}, inputs).meta["asks"]
    assert 4 in asks["sides"]
    assert 0 not in asks["sides"]
    still = frame_screening_stage.run(
        PARAMS, {"frames": list(range(7))}, inputs | {"steps": tables([motion(shift(9.0))] * 6)}
    ).meta
    assert not still["asks"]["sides"]
    assert still["match_rate"] == pytest.approx([np.mean(still["match_rate"])] * 6)
