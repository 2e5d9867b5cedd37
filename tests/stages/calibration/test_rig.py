"""The rig of a sequence: pooled over its pairs, repaired or kept, with words for both."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from fnmatch import fnmatch

import numpy as np
import pytest
from raising import raises
from rig_scenes import bed_depth, bed_rig, knocked, matches, street_depth, street_rig
from terrain_scenes import toed_in_rig

from rille.stages.calibration import rig as rig_stage
from rille.stages.calibration.parameter_selection import Parameter
from rille.stages.calibration.relative_orientation import RIG, PointPairs, linearised
from rille.stages.calibration.rig import RigParams, _drift, orient_rig
from rille.stages.core.declare import Bundle
from rille.stages.geometry.epipolar import NAMES
from rille.stages.geometry.geometry import Rig, RigidTransform, rotation_exp


def facts(rig: Rig, pairs, **params):
    found = orient_rig(rig, pairs, RigParams(**params))
    json.dumps(found, allow_nan=False)
    return found


def moves(found):
    return [line for line in found["warnings"] if "the rig moves" in line]


def street(count=4, noise=0.2, **knock):
    true = knocked(street_rig(), **knock)
    return [matches(true, street_depth, pair=10 * k, noise=noise, samples=800) for k in range(count)]


@pytest.mark.parametrize("inputs", [{}, {"orientations": []}])
def test_without_pairs_the_given_rig_passes_through(inputs):
    rig = toed_in_rig()
    meta = rig_stage.rig_stage.run(RigParams(), {"rig": rig.to_dict()}, inputs).meta
    assert meta["rig"] == rig.to_dict()
    assert (meta["changed"], meta["warnings"]) == (False, [])


def test_no_baseline_is_refused():
    rig = toed_in_rig()
    with raises("RIL-377"):
        facts(Rig(rig.left, rig.right, RigidTransform.identity()), [])


def test_stage_reads_what_orientation_writes():
    rig = street_rig()
    bundles = [
        Bundle(
            {"left": m.left.astype(np.float32), "right": m.right.astype(np.float32)}, {"pair": m.pair, "repeated": 0.1}
        )
        for m in street(pitch_deg=0.3)
    ]
    meta = rig_stage.rig_stage.run(RigParams(), {"rig": rig.to_dict()}, {"orientations": bundles}).meta
    assert meta["changed"]
    assert [p["pair"] for p in meta["per_pair"]] == [0, 10, 20, 30]


def stage_facts(rig, pairs):
    bundles = [Bundle({"left": m.left, "right": m.right}, {"pair": m.pair, "repeated": 0.1}) for m in pairs]
    return rig_stage.rig_stage.run(RigParams(), {"rig": rig.to_dict()}, {"orientations": bundles}).meta


def test_a_focal_length_of_one_camera_is_the_contradiction_and_no_turn():
    true = street_rig()
    longer = replace(true.right, fx=1.05 * true.right.fx, fy=1.05 * true.right.fy)
    meta = stage_facts(Rig(true.left, longer, true.T_right_left), street())
    assert meta["contradiction"] == meta["misread"] == meta["warnings"][0]
    assert "the right camera's is 0.95" in meta["misread"]
    assert not any("no mount moves" in line for line in meta["warnings"])
    assert "knocked" not in meta
    assert "misread" not in stage_facts(true, street(pitch_deg=0.3))


def test_matches_beyond_infinity_of_a_transposed_rotation_are_named_as_such():
    given = street_rig()
    turned = Rig(
        given.left, given.right, RigidTransform(rotation_exp([0.01, 0.06, 0.01]), given.T_right_left.translation)
    )
    seen = [matches(turned, street_depth, pair=k) for k in range(3)]
    transposed = RigidTransform(turned.T_right_left.rotation.T, turned.T_right_left.translation)
    with raises("RIL-752", "if it is transposed"):
        stage_facts(Rig(given.left, given.right, transposed), seen)


def test_a_pair_without_matches_says_nothing_of_the_lenses():
    nothing = Bundle({side: np.zeros((0, 2), np.float32) for side in ("left", "right")}, {"pair": 0, "repeated": 0.0})
    meta = rig_stage.rig_stage.run(RigParams(), {"rig": street_rig().to_dict()}, {"orientations": [nothing]}).meta
    assert "misread" not in meta
    assert len(meta["warnings"]) == 1


def test_a_sound_rig_stays_to_the_bit_and_nothing_is_warned_of():
    rig = street_rig()
    found = facts(rig, street())
    assert found["rig"] == found["given"] == rig.to_dict()
    assert (found["changed"], found["source"], found["warnings"]) == (False, "given calibration", [])
    assert found["residual_before_px"] == found["residual_after_px"] == pytest.approx(0.2, rel=0.1)
    assert not any(p["freed"] for p in found["parameters"])


def test_a_knock_is_repaired_and_told():
    found = facts(street_rig(), street(pitch_deg=-0.24, roll_deg=0.3))
    assert "pitch and roll repaired" in found["source"]
    used = Rig.from_dict(found["rig"])
    true = knocked(street_rig(), pitch_deg=-0.24, roll_deg=0.3)
    np.testing.assert_allclose(used.T_right_left.rotation, true.T_right_left.rotation, atol=2e-4)  # 0.01 degrees
    assert used.baseline == pytest.approx(0.54, rel=1e-12)
    assert found["residual_after_px"] < 0.25 < 2.0 < found["residual_before_px"]
    first, second = found["warnings"]
    assert "contradicts the images" in first
    assert "0.30 degrees clockwise" in first
    assert "held: yaw" in second
    assert found["parameters"][1]["why"].startswith("not observed")


def test_a_yaw_that_the_tracks_have_corrected_is_not_said_to_be_held():
    first = knocked(street_rig(), yaw_deg=0.3)
    found = orient_rig(street_rig(), street(pitch_deg=-0.24, roll_deg=0.3), RigParams(), first)
    assert found["given"] == first.to_dict()
    assert found["source"].endswith("corrected by the tracks")
    assert "contradicts the images" in found["warnings"][0]
    assert not any("yaw" in line for line in found["warnings"])


@pytest.mark.parametrize(
    ("centre", "roll", "angle", "words"),
    [
        ((0.0, 0.5, 0.0), 0.0, "yaw", "columns of the right image lie 3.* px too far right, it is"),
        ((0.5, 0.0, 0.0), 90.0, "yaw", "columns of the right image lie 3.* px too far right, it is"),
        (
            (0.35, 0.35, 0.0),
            0.0,
            "pitch",
            "the right image lies 3.* px off the epipolar lines, pitch is off by *, it is",
        ),
    ],
)
def test_words_of_a_knock_where_epipolar_lines_are_no_rows(centre, roll, angle, words):
    camera, rotation = street_rig().left, rotation_exp([0.0, 0.0, np.radians(roll)])
    rig = Rig(camera, camera, RigidTransform(rotation, -rotation @ np.array(centre)))
    true = knocked(rig, roll_deg=0.3, **{f"{angle}_deg": 0.24})
    line = facts(rig, [matches(true, street_depth, pair=k) for k in range(2)])["warnings"][0]
    assert fnmatch(line, f"*: {words} turned by 0.30 degrees clockwise*")


def test_mode_fixed_only_tells():
    rig = street_rig()
    found = facts(rig, street(pitch_deg=-0.24), mode="fixed")
    assert found["rig"] == rig.to_dict()
    assert not found["changed"]
    assert found["warnings"][0].endswith("kept because rig.mode = fixed")
    assert found["parameters"][0]["value"] == pytest.approx(-0.24, abs=0.01)


def test_convergent_rig_with_a_wrong_toe_in():
    rig = bed_rig()
    pairs = [matches(knocked(rig, 0.5, 0.5, 0.5), bed_depth, noise=0.1, pair=k) for k in range(4)]
    found = facts(rig, pairs)
    values = {p["name"]: p["value"] for p in found["parameters"]}
    np.testing.assert_allclose([values[n] for n in ("pitch", "yaw", "roll")], 0.5, atol=0.035)
    for p in found["per_pair"]:
        for name, value in p["values"].items():
            expected = 0.5 if name in ("pitch", "yaw", "roll") else 0.0
            assert abs(value - expected) < 4 * p["sigma"][name]


def test_one_bad_pair_among_good_ones_does_not_pull():
    pairs = street(5, pitch_deg=-0.24)
    rng = np.random.default_rng(0)
    pairs[2] = PointPairs(20, pairs[2].left, pairs[2].right + rng.uniform(-20, 20, pairs[2].right.shape))
    found = facts(street_rig(), pairs)
    assert found["parameters"][0]["value"] == pytest.approx(-0.24, abs=0.01)


def test_a_rig_that_moves_is_told():
    rig = street_rig()
    pairs = street(4)
    pairs.append(matches(knocked(rig, roll_deg=0.4), street_depth, pair=99, samples=800))
    lines = [line for line in facts(rig, pairs)["warnings"] if "the rig moves" in line]
    assert len(lines) == 1
    assert "roll" in lines[0]
    assert "pair 99" in lines[0]


def with_patch(pairs, at, patch=(400, 180), seed=0):
    """The same with gross mismatches in a corner of one pair: 30 % of its matches 1 to 3 px off in the row."""
    rng = np.random.default_rng([seed, at])
    m = pairs[at]
    corner = (m.left < patch).all(1) if seed % 2 == 0 else (m.left > [m.left[:, 0].max() - patch[0], 0]).all(1)
    wrong = corner & (rng.random(len(m.left)) < 0.3)
    right = m.right.copy()
    right[wrong, 1] += rng.uniform(1.0, 3.0, int(wrong.sum()))
    return [*pairs[:at], PointPairs(m.pair, m.left, right), *pairs[at + 1 :]]


SCENES = {"street": (street_rig, street_depth), "bed": (bed_rig, bed_depth)}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("seed", range(2))
def test_a_patch_of_gross_mismatches_moves_no_rig(scene, seed):
    rig, depth = SCENES[scene][0](), SCENES[scene][1]
    pairs = [matches(rig, depth, pair=k, seed=seed, samples=1500) for k in range(10)]
    assert moves(facts(rig, with_patch(pairs, 4, seed=seed))) == []


def test_a_near_thing_that_mismatches_wholly_moves_no_rig():
    """A reflecting object in a corner, all its rows off alike: the baseline across would explain them."""
    rig = street_rig()

    def depth(rays, rng):
        z = street_depth(rays, rng)
        return np.where((rays[:, 0] < -0.45) & (rays[:, 1] > 0.0), np.minimum(z, 2.0), z)

    pairs = [matches(rig, depth, pair=k, samples=1500) for k in range(10)]
    m = pairs[3]
    thing = (m.left[:, 0] - m.right[:, 0]) > 120
    assert thing.sum() > 40
    pairs[3] = PointPairs(m.pair, m.left, m.right + np.outer(thing, [0.0, 2.0]))
    assert moves(facts(rig, pairs)) == []


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("angle", ["pitch", "roll"])
@pytest.mark.parametrize("first", [2, 5, 9])
def test_a_knock_from_some_pair_on_is_found_beside_a_patch(scene, angle, first):
    rig, depth = SCENES[scene][0](), SCENES[scene][1]
    after = knocked(rig, **{f"{angle}_deg": 0.3})
    pairs = [matches(after if k >= first else rig, depth, pair=k, samples=1500) for k in range(10)]
    assert any(f"the rig moves: {angle}" in line for line in moves(facts(rig, with_patch(pairs, 4))))


def test_parameters_that_stand_in_for_each_other_do_not_move_the_rig():
    start = linearised(street_rig(), street(5))
    design = start[-1].design[:, :RIG]
    away = np.linalg.svd(design)[2][-1]  # of all directions the one in which rows move least
    away *= 0.6 / np.sqrt(np.mean((design * away) ** 2, axis=0)).max()  # pixels by one parameter alone
    strong = int(np.argmax(np.mean((design * away) ** 2, axis=0)))
    assert np.sqrt(np.mean((design @ away) ** 2)) < RigParams().least_rows < 0.6

    def told(by, shown):
        degrees = np.degrees([0.0 * by] * 4 + [by])
        rows = [
            {"pair": k, "values": dict(zip(NAMES, row, strict=True)), "sigma": dict.fromkeys(NAMES, 1e-3)}
            for k, row in enumerate(degrees)
        ]
        last = replace(start[-1], constant=start[-1].constant - design @ by) if shown else start[-1]
        return [move.warning for move in _drift([*start[:-1], last], rows, RigParams())]

    def scattered(shares):
        by = np.outer(shares, away)
        rows = [
            {"pair": k, "values": dict(zip(NAMES, row, strict=True)), "sigma": dict.fromkeys(NAMES, 1e-3)}
            for k, row in enumerate(np.degrees(by))
        ]
        shown = [
            replace(one, constant=one.constant - one.design[:, :RIG] @ row) for one, row in zip(start, by, strict=False)
        ]
        return [move.warning for move in _drift(shown, rows, RigParams())]

    # No pair has the usual value of each parameter.
    assert scattered([1.0, 0.7, -0.9, -0.6]) == []
    alone = 2.0 * np.where(np.arange(RIG) == strong, away, 0.0)
    assert told(away, shown=True) == []
    assert told(alone, shown=False) == []  # what the pair's own values claim and its rows do not show
    assert told(alone, shown=True)[0].startswith(f"the rig moves: {NAMES[strong].replace('_', ' ')} of 1 of 5 pairs")


@pytest.mark.parametrize("roll", [-0.06, 0.03])  # taken for a rig that moved it asks for twice as much
def test_images_of_both_cameras_that_are_mirrored_are_named_where_the_rig_is_not_symmetric(roll):
    bed = bed_rig()
    tilted = RigidTransform(rotation_exp([0.0, 0.0, roll]) @ bed.T_right_left.rotation, bed.T_right_left.translation)
    for rig, told in ((Rig(bed.left, bed.right, tilted), True), (bed, False)):
        seen, size = [matches(rig, bed_depth, pair=k) for k in range(2)], [0.0, rig.left.height - 1.0]
        pairs = [PointPairs(m.pair, m.left * [1, -1] + size, m.right * [1, -1] + size) for m in seen]
        with raises("RIL-684") if told else nullcontext():
            assert not orient_rig(rig, pairs, RigParams())["changed"]


@pytest.mark.parametrize("roll", [0.0, 90.0, -60.0])
@pytest.mark.parametrize("centre", [(0.54, 0.0, 0.0), (0.0, 0.54, 0.0)])
def test_swapped_images_are_named(centre, roll):
    camera, rotation = street_rig().left, rotation_exp([0.0, 0.0, np.radians(roll)])
    camera = replace(camera, width=600, height=600, cx=310.0, cy=290.0)
    rig = Rig(camera, camera, RigidTransform(rotation, -rotation @ np.array(centre)))
    pairs = [matches(rig, street_depth, pair=k) for k in range(2)]
    assert facts(rig, pairs)["warnings"] == []
    with raises("RIL-781"):
        facts(rig, [PointPairs(m.pair, m.right, m.left) for m in pairs])


@pytest.mark.parametrize("centre", [(0.54, 0.0, 0.0), (-0.54, 0.0, 0.0), (0.0, 0.54, 0.0), (0.4, 0.0, 0.4)])
def test_an_inverted_transformation_is_named_and_cameras_in_any_order_are_not(centre):
    """Whose principal points are not alike, so that exchanged sides do not explain the matches."""
    camera = street_rig().left
    right = replace(camera, cx=camera.cx - 12.0, cy=camera.cy + 12.0)
    rig = Rig(camera, right, RigidTransform(np.eye(3), np.negative(centre)))
    pairs = [matches(rig, street_depth, pair=k, samples=800) for k in range(2)]
    assert facts(rig, pairs)["warnings"] == []
    with raises("RIL-781", "its transformation inverted"):
        facts(replace(rig, T_right_left=rig.T_right_left.inverse()), pairs)


@pytest.mark.parametrize("off", [-2.5, -9.0])
def test_a_sky_through_a_camera_that_is_turned_is_not_called_swapped(off):
    rng = np.random.default_rng(2)
    left = rng.uniform(0, (1225, 369), (600, 2))
    pairs = [PointPairs(0, left, left + np.stack([rng.normal(-off, 0.3, 600), rng.normal(0, 0.1, 600)], 1))]
    with raises("RIL-772", "sky"):
        orient_rig(street_rig(), pairs, RigParams(significance=1e9))


def test_images_of_unlike_scenes_are_not_called_swapped():
    rng = np.random.default_rng(2)
    left = rng.uniform(0, (1225, 369), (600, 2))
    pairs = [PointPairs(0, left, left + np.stack([rng.uniform(5, 60, 600), rng.normal(0, 3, 600)], 1))]
    with raises("RIL-375", "one scene"):
        facts(street_rig(), pairs)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_rows_count_in_pixels_of_the_coarser_image(scale):
    rig = street_rig()
    right = replace(rig.right, fx=scale * rig.right.fx, fy=scale * rig.right.fy, width=2452, height=740)
    finer = Rig(rig.left, replace(right, cx=scale * rig.right.cx, cy=scale * rig.right.cy), rig.T_right_left)
    found = facts(finer, [matches(finer, street_depth, noise=0.8 * scale, pair=k) for k in range(2)])
    assert "suspects" not in found
    assert found["warnings"] == []


def test_distortion_that_was_left_is_told():
    rig = street_rig()

    def barrel(u, v):
        return 12.0 * v * (u**2 + 0.1 * v**2)

    pairs = [matches(rig, street_depth, pair=k, field=barrel) for k in range(2)]
    assert any("lens distortion" in line for line in facts(rig, pairs)["warnings"])


def test_pairs_with_few_matches_are_passed_over_and_told():
    pairs = street(2)
    few = PointPairs(5, pairs[0].left[:20], pairs[0].right[:20])
    found = facts(street_rig(), [*pairs, few])
    assert found["warnings"] == ["1 of 3 pairs have too few matches for the rig"]
    alone = facts(street_rig(), [few])
    assert "used as given" in alone["warnings"][0]
    assert "parameters" not in alone


@pytest.mark.data
def test_street_of_kitti_is_left_alone_and_repaired_when_knocked(data_dir):
    from rille.datasets.images.misalign import MisalignParams, warp
    from rille.datasets.registry import open_sequence
    from rille.stages.calibration.orientation import thin
    from rille.stages.core.validity import matched
    from rille.stages.geometry.lens import Lens
    from rille.stages.hfvm.stage import match

    sequence = open_sequence(str(data_dir / "kitti06_51"))
    left, right = (_image(sequence.image(20, camera)) for camera in ("left", "right"))
    knock = MisalignParams(rows=3.0, roll_deg=0.3)
    bent, valid = warp(right, np.ones_like(right), Lens(sequence.rig.right), knock)
    for image, mask, repaired in ((right, None, []), (bent, valid, ["pitch", "roll"])):
        d = match(left, image, valid=(None, mask))
        points = thin(d.column_disparity, d.row_disparity, matched(d.validity), d.backmatch_error, 1500)
        found = facts(sequence.rig, [PointPairs(20, *points)])
        assert [p["name"] for p in found["parameters"] if p["freed"]] == repaired
        assert found["residual_after_px"] < 0.7


def _image(source):
    import cv2

    return cv2.imread(source.hints["path"], cv2.IMREAD_GRAYSCALE)


def test_a_correction_that_no_mount_makes_is_a_contradiction_and_no_repair():
    """Right images one frame late on a straight drive: the baseline would point 60 degrees forward."""
    given = street_rig()
    centre = np.array([0.54, 0.0, -1.0])
    late = Rig(given.left, given.right, RigidTransform(np.eye(3), -centre))
    found = facts(given, [matches(late, street_depth, pair=k, samples=800) for k in range(4)])
    assert not found["changed"]
    assert found["rig"] == given.to_dict()
    assert "baseline forward is off by" in found["contradiction"]
    assert (
        "not repaired, for no mount moves that far: are left and right exposed at one moment?" in found["contradiction"]
    )
    assert found["suspects"] == [0, 1, 2, 3]
    assert "contradiction" not in facts(given, street(roll_deg=2.0))


@pytest.mark.parametrize(("degrees", "words"), [(180, "180 degrees"), (90, "90 degrees clockwise"), (-90, "anticlock")])
def test_turned_images_are_named_and_no_knock(degrees, words):
    rig, cosine, sine = street_rig(), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[cosine, sine], [-sine, cosine]])  # rows point down: x to y is clockwise
    middle = 0.5 * np.array([rig.right.width - 1, rig.right.height - 1])
    pairs = [PointPairs(m.pair, m.left, (m.right - middle) @ turn + middle) for m in street()]
    found = facts(rig, pairs)
    assert not found["changed"]
    assert words in found["contradiction"]
    assert found["warnings"] == [found["contradiction"]]
    assert "contradiction" not in facts(rig, street(roll_deg=4.0))


@pytest.mark.parametrize(
    ("name", "degrees", "words"),
    [
        ("baseline_across", -3.0, "baseline across is off by -3.00 +- 0.57 degrees"),
        ("baseline_across", 837.0, "more than 45 degrees (are the images of both cameras turned?)"),
        ("baseline_forward", -60.0, "baseline forward is off by more than 45 degrees"),
    ],
)
def test_no_angle_of_a_linear_estimate_is_larger_than_it_can_be(name, degrees, words):
    angle = np.radians(degrees)
    assert rig_stage._off(Parameter(name, angle, angle, 0.01, True, True, "")).endswith(words)


def test_a_pair_whose_rows_no_rig_explains_is_a_suspect():
    pairs = street(5)
    rng = np.random.default_rng(1)
    m = pairs[2]
    pairs[2] = PointPairs(m.pair, m.left, m.right + np.outer(rng.normal(0, 2.0, len(m.left)), [0.0, 1.0]))
    assert facts(street_rig(), pairs)["suspects"] == [m.pair]
    assert "suspects" not in facts(street_rig(), street(5, roll_deg=0.5))


@pytest.mark.parametrize("first", [2, 5, 8])
def test_where_a_rig_was_knocked_too_far_for_one_calibration_is_told(first):
    rig = street_rig()
    after = knocked(rig, roll_deg=1.0)
    pairs = [matches(after if k >= first else rig, street_depth, pair=10 + k, samples=800) for k in range(10)]
    found = facts(rig, pairs)
    assert found["knocked"].startswith(f"the rig moved at pair {10 + first}: roll by 1.0")
    assert any(f"first at pair {10 + first}" in line for line in moves(found))
    assert "knocked" not in facts(rig, street(5, roll_deg=1.0))
