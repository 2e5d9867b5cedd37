"""Basic pairs and segments: by stride, by overlap, and where there is little to go by."""

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_scenes import CAMERA, drive, motion, share_kept, shift, tables, turned

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.geometry import rotation_exp
from rille.stages.imaging.pyramid import PyramidParams, build
from rille.stages.odometry import keyframes
from rille.stages.odometry.keyframes import KeyframesParams, segments
from rille.stages.odometry.motion import MotionParams
from rille.stages.odometry.motion import motion_stage as motion_task


def run(motions, frames=None, **params):
    """Meta of the stage for motions between successive frames."""
    args = {"frames": len(motions) + 1 if frames is None else frames}
    out = keyframes.keyframes_stage.run(KeyframesParams(**params), args, {"steps": tables(motions)})
    check_outputs(keyframes.keyframes_stage, out)
    return out.meta


def blind():
    """A motion of which nearly nothing matched."""
    return motion(shift(0.0), unmatched=lambda x, y: x > 20)


def test_the_papers_stride_on_forty_frames():
    meta = run([motion(shift(1.0))] * 39, rule="stride", stride=4)
    assert meta["basic"] == [0, 4, 8, 12, 16, 20, 24, 28, 32, 36]
    assert meta["segments"][0] == [0, 1, 2, 3, 4]
    assert meta["segments"][-1] == [36, 37, 38, 39]
    assert len(meta["segments"]) == 10
    assert meta["overlap"][0] is None
    np.testing.assert_allclose(meta["overlap"][1:], 1 - 4 / 480, atol=1e-3)


@pytest.mark.parametrize(("frames", "stride"), [(2, 1), (9, 4), (51, 2), (5, 9)])
def test_segments_cover_every_step_once(frames, stride):
    parts = segments(list(range(0, frames, stride)), frames)
    steps = [(a, b) for part in parts for a, b in itertools.pairwise(part)]
    assert steps == [(i, i + 1) for i in range(frames - 1)]
    assert all(len(part) > 1 for part in parts)


def test_even_motion_gives_the_stride_that_leaves_the_wanted_overlap():
    """Each step loses a tenth of the width."""
    steps = [motion(shift(48.0))] * 12
    meta = run(steps, overlap=0.68)
    assert meta["basic"] == [0, 3, 6, 9]  # 0.7 is left after three steps; the last frame bounds an open segment
    assert meta["why"] == ["first frame"] + ["overlap"] * 3
    np.testing.assert_allclose(meta["overlap"][1:], 0.7, atol=0.015)
    assert run(steps, overlap=0.85)["basic"] == list(range(12))
    assert run(steps, overlap=0.48)["basic"] == [0, 5, 10]
    assert meta["displacement"] == [48.0] * 12
    assert not meta["warnings"]


def test_basic_pairs_follow_the_speed():
    steps = [motion(shift(24.0))] * 6 + [motion(shift(96.0))] * 3 + [motion(shift(0.0))] * 6
    # 0.95, 0.90 ... 0.70 after six slow steps; then 0.8 a fast step; at rest nothing.
    assert run(steps, overlap=0.69)["basic"] == [0, 6, 7, 8]


def test_a_camera_that_rests_needs_no_new_pair_until_the_longest_gap():
    steps = [motion(shift(0.2))] * 12
    assert run(steps)["basic"] == [0]
    assert run(steps)["segments"] == [list(range(13))]
    meta = run(steps, max_gap=5)
    assert meta["basic"] == [0, 5, 10]
    assert meta["why"][1:] == ["max_gap"] * 2


def test_one_frame_is_a_basic_pair_without_a_segment():
    for rule in ("overlap", "stride"):
        meta = run([], rule=rule)
        assert (meta["basic"], meta["segments"], meta["overlap"]) == ([0], [], [None])


def gap(share, wanted=0.7):
    """Steps after which ``share(steps)`` is the last that is not below the wanted one."""
    return next(n for n in itertools.count(1) if share(n + 1) < wanted)


def test_a_camera_that_turns_on_the_spot_gets_new_pairs():
    def heading(n):
        return turned(rotation_exp([0.0, np.radians(-6.0 * n), 0.0]))

    expected = gap(lambda n: min(share_kept(heading(n)), share_kept(heading(-n))))
    assert expected > 1
    assert set(np.diff(run([motion(heading(1))] * 10)["basic"])) == {expected}
    roll = motion(turned(rotation_exp([0.0, 0.0, np.radians(3.0)])))
    assert run([roll] * 8)["basic"] == [0]  # 24 degrees of roll keep four fifths of the view


@pytest.mark.parametrize("step", [0.04, 0.07, 0.1])
def test_driving_ahead_loses_the_near_ground(step):
    """Pixel by pixel, the flow of a longer step is that of several short ones."""
    expected = gap(lambda n: share_kept(drive(step * n)))
    assert expected > 1
    assert set(np.diff(run([motion(drive(step))] * (3 * expected))["basic"])) == {expected}


def test_steps_with_few_matches_are_bounded_by_basic_pairs():
    steps = [motion(shift(2.0))] * 3 + [blind()] + [motion(shift(2.0))] * 3
    meta = run(steps)
    assert meta["basic"] == [0, 3, 4]
    assert meta["why"] == ["first frame", "few matches", "few matches"]
    assert meta["overlap"][1] > 0.9
    assert meta["overlap"][2] is None
    assert run([blind()] * 3)["basic"] == [0, 1, 2]
    dark = Bundle({k: np.zeros_like(v) for k, v in blind().arrays.items()}, {"level": 2})
    assert run([dark, dark])["basic"] == [0, 1]


def test_a_stride_has_a_basic_pair_behind_a_step_with_few_matches():
    """Frame 5 shows something else: with the pairs 0, 3, 6 alone it would belong to nothing."""
    steps = [motion(shift(2.0))] * 4 + [blind()] + [motion(shift(2.0))] * 2
    meta = run(steps, rule="stride", stride=3)
    assert meta["basic"] == [0, 3, 5, 6]
    assert meta["why"] == ["first frame", "stride", "few matches", "stride"]
    assert meta["segments"] == [[0, 1, 2, 3], [3, 4, 5], [5, 6], [6, 7]]


@pytest.mark.parametrize("rule", ["overlap", "stride"])
def test_behind_a_gap_is_a_basic_pair_so_that_a_refused_bridge_begins_a_piece(rule):
    args = {"frames": 9, "behind": [3, 6], "unfit": [6]}
    steps = {"steps": tables([motion(shift(2.0))] * 8)}
    meta = keyframes.keyframes_stage.run(KeyframesParams(rule=rule, stride=16), args, steps).meta
    assert meta["basic"] == [0, 3, 7]
    assert meta["why"] == ["first frame", "behind a gap", "behind a gap"]


def test_too_little_overlap_is_named():
    meta = run([motion(shift(240.0))] * 3)
    assert meta["basic"] == [0, 1, 2]
    assert "as little as 50%" in meta["warnings"][0]
    assert run([motion(shift(100.0))] * 4, rule="stride", stride=2)["warnings"] == []
    meta = run([motion(shift(160.0))] * 4, rule="stride", stride=2)
    assert "set keyframes.stride lower" in meta["warnings"][0]


@settings(deadline=None, max_examples=15)
@given(st.lists(st.sampled_from([0.0, 20.0, 60.0, 130.0, 300.0, None]), min_size=1, max_size=8), st.floats(0.3, 0.95))
def test_any_drive_is_covered_by_segments_that_keep_the_overlap(shifts, overlap):
    steps = [blind() if u is None else motion(shift(u)) for u in shifts]
    meta = run(steps, overlap=overlap, max_gap=5)
    basic = meta["basic"]
    assert basic[0] == 0
    assert all(1 <= b - a <= 5 for a, b in itertools.pairwise(basic))
    pairs = [(a, b) for part in meta["segments"] for a, b in itertools.pairwise(part)]
    assert pairs == [(i, i + 1) for i in range(len(steps))]
    for (a, b), value in zip(itertools.pairwise(basic), meta["overlap"][1:], strict=True):
        lost = sum(u or 0.0 for u in shifts[a:b]) / CAMERA.width
        assert b == a + 1 or 1 - lost >= overlap - 0.02
        assert value is None or value == pytest.approx(max(0.0, 1 - lost), abs=0.02)


@pytest.mark.data
def test_street_at_ten_frames_a_second_gets_about_every_second_pair(data_dir):
    folder = data_dir / "kitti06_51" / "image_l"
    bundles = []
    for n in range(16):
        p = build(cv2.imread(str(folder / f"{n:06d}.png"), 0), PyramidParams())
        arrays = {f"level_{i}": a for i, a in enumerate(p.images)} | {f"valid_{i}": a for i, a in enumerate(p.valid)}
        bundles.append(Bundle(arrays, {"levels": p.levels}))
    motions = [motion_task.run(MotionParams(), {}, {"a": a, "b": b}) for a, b in itertools.pairwise(bundles)]
    meta = run(motions)
    assert set(np.diff(meta["basic"])) <= {1, 2, 3}
    assert 1.5 < np.mean(np.diff(meta["basic"])) < 3
    assert not meta["warnings"]


def test_preset_navigation_takes_pairs_farther_apart_and_yields_to_what_is_given():
    assert (KeyframesParams(preset="navigation").rule, KeyframesParams(preset="navigation").overlap) == ("overlap", 0.6)
    assert KeyframesParams(preset="navigation", stride=4).rule == "overlap"  # a sequence's own, for its terrain
    assert KeyframesParams(preset="navigation", stride=4, rule="stride").rule == "stride"
    assert KeyframesParams(preset="navigation", overlap=0.5).overlap == 0.5
    again = KeyframesParams.model_validate(KeyframesParams(preset="navigation").model_dump())
    assert again == KeyframesParams(preset="navigation")


def test_a_stride_given_alone_sets_the_rule():
    assert KeyframesParams().rule == "overlap"
    assert KeyframesParams(stride=3).rule == "stride"
    assert KeyframesParams.model_validate({"stride": 3, "rule": "overlap"}).rule == "overlap"


def test_frames_that_may_not_be_basic_are_the_cause_of_little_overlap():
    steps = {"steps": tables([motion(shift(40.0))] * 9)}
    given = {"frames": 10, "unfit": [1, 2, 3, 4, 5, 6, 7]}
    meta = keyframes.keyframes_stage.run(KeyframesParams(), given, steps).meta
    assert meta["basic"] == [0, 8]
    (line,) = meta["warnings"]
    assert "may not be basic pairs" in line
