"""Verdicts on hand-made figures: each threshold from both sides."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rille.datasets.protocol import Positions, Sequence
from rille.pipeline.runs.checks import looks, matches, records
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.imaging.image_quality import ALONG
from rille.stages.odometry.frame_screening import FrameScreeningParams

LIMITS = FrameScreeningParams.model_validate({})
CAMERA = Camera(500.0, 500.0, 160.0, 120.0, 320, 240)


def levels(found):
    return [v.level for v in found]


def rig(x: float, right: Camera = CAMERA) -> Rig:
    return Rig(CAMERA, right, RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])))


@pytest.mark.parametrize(("x", "level"), [(-0.12, "OK"), (-97.0, "WARN"), (-0.001, "WARN"), (0.12, "OK"), (-4.9, "OK")])
def test_a_baseline_in_another_unit_and_cameras_in_any_order(x, level):
    assert records.judge_rig(rig(x)).level == level


def test_a_right_camera_upside_down_stands_where_it_stands():
    upside_down = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.array([0.12, 0.0, 0.0]))
    assert records.judge_rig(Rig(CAMERA, CAMERA, upside_down)).level == "OK"


def test_another_camera_is_stated_and_no_mistake():
    half = records.judge_rig(rig(-0.1, Camera(250.0, 250.0, 80.0, 60.0, 160, 120)))
    assert half.level == "OK"
    assert half.text.endswith("500 px, 320 x 240, right 250 px, 160 x 120")
    wide = Camera(500.0, 500.0, 320.0, 120.0, 640, 240)
    assert records.judge_rig(rig(-0.1, wide)).level == "OK"
    tele = records.judge_rig(rig(-0.1, Camera(1000.0, 1000.0, 160.0, 120.0, 320, 240)))
    assert (tele.level, tele.text[-24:]) == ("OK", "right 1000 px, 320 x 240")


def recorded(frames: int, **known) -> tuple[Sequence, range]:
    """A sequence of which something is known, and its frames."""
    names = tuple(map(str, range(frames)))
    return Sequence("one", rig(-0.1), frames, lambda frame, camera: None, names, **known), range(frames)


def test_times():
    def judged(*times: float):
        return records.judge_times(*recorded(len(times), times=times))

    assert records.judge_times(*recorded(2)).level == judged(3.0).level == "OK"
    assert "10 frames a second over 0.3 s" in judged(0.0, 0.1, 0.2, 0.3).text
    gap = judged(0.0, 0.1, 0.2, 0.6, 0.7)
    assert gap.level == "WARN"
    assert "0.4 s from frame 2 to 3" in gap.text
    some = recorded(8, times=tuple(0.1 * k for k in range(8)))[0]
    assert "0.4 s from frame 2 to 6" in records.judge_times(some, [0, 1, 2, 6, 7]).text
    back = judged(0.0, 0.1, 0.1, 0.2)
    assert back.level == "FAIL"
    assert "frame 1 to 2" in back.text


def poses(count: int) -> list[RigidTransform]:
    return [RigidTransform(rotation_exp([0.0, 0.1 * k, 0.0]), np.array([0.0, 0.0, 2.0 * k])) for k in range(count)]


def test_truth_coverage_and_length():
    assert "none" in records.judge_truth(*recorded(1)).text
    places = Positions(((0.0, 0.0), (3.0, 4.0)), (0.0, 1.0))
    alone = records.judge_truth(*recorded(4, truth_positions=places))
    assert (alone.level, "positions only" in alone.text, "5 m" in alone.text) == ("OK", True, True)
    full = records.judge_truth(*recorded(4, truth=poses(4)))
    assert (full.level, full.text) == ("OK", "4 of 4 frames, 6 m")
    part = records.judge_truth(*recorded(4, truth=[*poses(3), None]))
    assert part.level == "WARN"
    assert "3 of 4" in part.text


def test_attitude_against_truth():
    truth = poses(4)
    right = [tuple(map(tuple, T.rotation)) for T in truth]
    reference = rotation_exp([0.3, -0.2, 1.0])  # any inertial frame
    turned = [tuple(map(tuple, reference @ T.rotation)) for T in truth]
    inverse = [tuple(map(tuple, T.rotation.T)) for T in truth]

    def judged(attitude):
        return records.judge_attitude(*recorded(4, truth=truth, attitude=attitude))

    assert judged(None) is None
    assert judged(right).level == "OK"
    assert judged(turned).level == "OK"
    wrong = judged(inverse)
    assert wrong.level == "FAIL"
    assert f"{2 * math.degrees(0.1):.1f} degrees" in wrong.text
    assert judged([*right[:3], None]).level == "WARN"


def ahead(*z: float | None) -> list[RigidTransform | None]:
    return [None if v is None else RigidTransform(np.eye(3), np.array([0.0, 0.0, v])) for v in z]


@pytest.mark.parametrize(
    ("z", "times", "level", "words"),
    [
        ((0.0, 1.0, 2.0), None, "OK", "3 of 3 frames, 2 m, 1 of the truth's length"),
        ((0.0, 1.0, 2.0), (0.0, 0.5, 1.0), "OK", "2 m/s"),
        ((0.0, None, 2.0), None, "WARN", "2 of 3 frames"),
        ((0.0, 1.5, 3.0), None, "WARN", "1.5 of the truth's length"),
        ((0.0, 1000.0, 2000.0), (0.0, 1.0, 2.0), "FAIL", "1e+03 m/s"),
        ((0.0, 1.0, 2.0), (0.0, 0.0, 0.0), "OK", "2 m, "),
    ],
)
def test_odometry_has_a_length_and_a_speed(z, times, level, words):
    known = {"odometry": ahead(*z), "truth": ahead(0.0, 1.0, 2.0), "times": times}
    found = records.judge_odometry(*recorded(3, **known))
    assert found.level == level
    assert words in found.text
    assert records.judge_odometry(*recorded(3, times=times)) is None


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        ({}, "OK", "6 rows, 5 of them while the images were taken, 4 m, 2 m/s; standard deviation 0.1 m"),
        ({"times": [100.0 + k for k in range(6)]}, "WARN", "0 of them"),
        ({"sigma": [9.0, 9.0, 1.0]}, "WARN", "9 x 1 m"),
        ({"positions": [[1000.0 * k, 0.0] for k in range(6)]}, "FAIL", "2e+03 m/s"),
    ],
)
def test_positions_are_counted_within_the_time_of_the_images(change, level, words):
    measured = {"times": [0.5 * k for k in range(6)], "positions": [[k, 0.0] for k in range(6)], "sigma": [0.1] * 3}
    known = {"priors": {"positions": {**measured, **change}}, "times": (0.0, 1.0, 2.0)}
    found = records.judge_positions(*recorded(3, **known))
    assert found.level == level
    assert words in found.text
    assert records.judge_positions(*recorded(3)) is None


def test_up_is_stated():
    assert records.judge_up(*recorded(1)) is None
    assert records.judge_up(*recorded(1, up=[(0.0, -1.0, 0.0)])).level == "OK"
    turned = records.judge_up(*recorded(1, up=[(0.0, 1.0, 0.0)]))  # of a camera that is mounted upside down
    assert (turned.level, turned.text.split("; ")[1]) == ("OK", "it points down in the images")
    assert records.judge_up(*recorded(1, up=[None])).level == "WARN"


def cameras(left: list[dict[str, float]], right: list[dict[str, float]]):
    return {"left": dict(enumerate(left)), "right": dict(enumerate(right))}


GOOD = {"mean": 100.0, "deviation": 40.0, "dark": 0.0, "bright": 0.0, **dict.fromkeys(ALONG, 1.0), "detail": 0.1}
NAMES = [f"f{k}" for k in range(5)]


def changed(**values: float) -> dict[str, float]:
    return GOOD | values


def test_good_images_give_two_lines():
    assert levels(looks.judge_looks(cameras([GOOD] * 5, [GOOD] * 5), NAMES, LIMITS)) == ["OK", "OK"]


@pytest.mark.parametrize(
    ("left", "right", "level", "words"),
    [
        ([GOOD] * 4 + [changed(sharpness=0.4)], [GOOD] * 5, "WARN", "frame f4 (40% of the usual sharpness)"),
        ([GOOD] * 5, [changed(sharpness=0.5)] * 5, "WARN", "right is 0.50 as sharp"),
        ([GOOD] * 5, [changed(mean=40.0)] * 5, "WARN", "right is 0.40 as bright"),
        ([GOOD] * 3 + [changed(mean=180.0)] * 2, [GOOD] * 5, "WARN", "changes by a factor of 1.8 from frame f2 to f3"),
        ([changed(bright=0.5)] * 5, [GOOD] * 5, "WARN", "50 % of the left images is white"),
        ([GOOD] * 5, [changed(deviation=0.1)] + [GOOD] * 4, "WARN", "1 right images show nothing, first frame f0"),
        (
            [changed(deviation=2.0)] * 5,
            [GOOD] * 5,
            "WARN",
            "the left images are faint: their grey values deviate by 2.0",
        ),
    ],
)
def test_bad_images_are_told(left, right, level, words):
    found = looks.judge_looks(cameras(left, right), NAMES, LIMITS)
    assert any(v.level == level and words in v.text for v in found)


def test_an_image_that_shows_nothing_tells_of_no_exposure():
    black = changed(mean=0.0, deviation=0.0)
    found = looks.judge_looks(cameras([GOOD, GOOD, black, GOOD, GOOD], [GOOD] * 5), NAMES, LIMITS)
    assert [bad.code for bad in found if bad.level != "OK"] == ["RIL-650"]


@pytest.mark.parametrize(("share", "level"), [(0.0, "OK"), (0.2, "WARN"), (0.97, "FAIL")])
def test_sides(share, level):
    assert matches.judge_sides(share).level == level


@pytest.mark.parametrize(
    ("unlike", "swapped", "level", "code"),
    [(0, 0, "OK", ""), (1, 1, "WARN", "773"), (4, 0, "WARN", "773"), (4, 4, "FAIL", "659")],
)
def test_pairs_unlike_the_others(unlike, swapped, level, code):
    found = matches.judge_pairs(dict.fromkeys(range(unlike), "why"), 6, swapped, NAMES)
    assert found.level == level
    assert code in found.code


def facts(before: float, after: float, offset: float = 0.0, turn: float = 0.1):
    residuals = {"residual_before_px": before, "residual_after_px": after, "row_offset": offset}
    return residuals | {"roll_deg": 0.1, "turn_deg": turn}


@pytest.mark.parametrize(
    ("given", "level", "words"),
    [
        (facts(0.3, 0.3), "OK", "roll +0.100"),
        (facts(3.2, 0.4, 3.1), "WARN", "RIL-664"),
        (facts(0.7, 0.4, -0.6), "WARN", "RIL-664"),
        (facts(2.5, 2.0), "WARN", "RIL-663"),
        (facts(40.0, 20.0), "FAIL", "RIL-662"),
        (facts(200.0, 0.4, turn=-179.0), "FAIL", "turned by 179 degrees"),
        ({"words": "not checked: 3 matches"}, "WARN", "3 matches"),
    ],
)
def test_epipolar(given, level, words):
    found = matches.judge_epipolar(given)
    assert found.level == level
    assert words in str(found)


def test_matching():
    depths = np.linspace(2.0, 4.0, 101)
    good = matches.judge_matching(0.7, depths, 0.1)
    assert good.level == "OK"
    assert "depth 2.1 to 3.9 m, median 3 m" in good.text
    assert matches.judge_matching(0.1, depths, 0.1).level == "WARN"
    assert matches.judge_matching(0.001, depths, 0.1).level == "FAIL"
    none = matches.judge_matching(None, depths[:0], 0.1)
    assert none.level == "FAIL"
    assert "nan" not in str(none)
    assert matches.judge_matching(0.7, 100 * depths, 0.1).level == "WARN"


def test_maps_that_the_images_do_not_bear_out_are_named():
    found = matches.judge_matching(0.0, np.zeros(0), 0.1, given=True)
    assert (found.level, found.code) == ("FAIL", "RIL-907")
    assert matches.judge_matching(0.7, np.ones(9), 0.1, given=True).level == "OK"


@pytest.mark.parametrize(("overlap", "level"), [(0.8, "OK"), (0.3, "WARN"), (0.05, "FAIL"), (None, "FAIL")])
def test_motion(overlap, level):
    motions = {(0, 1): {"overlap": 0.8, "median_length": 12.0}, (1, 2): {"overlap": overlap, "median_length": None}}
    found = matches.judge_motion(motions, NAMES)
    assert found.level == level
    assert "12.0 px" in found.text


@pytest.mark.parametrize(("largest", "code"), [(0.3, "RIL-715"), (0.6, "")])
def test_images_that_stand_still_are_named(largest, code):
    """As those are on which the dots of a projector move along with the camera."""
    motions = {(k, k + 1): {"overlap": 0.98, "median_length": v} for k, v in enumerate((0.1, largest))}
    assert matches.judge_motion(motions, NAMES).code == code


def test_one_frame_has_no_motion():
    assert matches.judge_motion({}, NAMES).level == "OK"
