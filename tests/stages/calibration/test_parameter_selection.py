"""Which parameters of a rig the images may change: repaired where it is right, untouched where it is not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rig_scenes import bed_depth, bed_rig, knocked, matches, street_depth, street_rig

from rille.stages.calibration import parameter_selection
from rille.stages.calibration.parameter_selection import RelativeParams, decide
from rille.stages.geometry.epipolar import NAMES, distances
from rille.stages.geometry.geometry import Rig, RigidTransform

PARAMS = RelativeParams()
SCENES = {"street": (street_rig(), street_depth), "bed": (bed_rig(), bed_depth)}


def found(decision):
    return dict(zip(NAMES, np.degrees(decision.correction), strict=True))


def freed(decision):
    return {p.name for p in decision.parameters if p.freed}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", range(3))
def test_a_sound_calibration_stays(name, seed):
    rig, depth = SCENES[name]
    decision = decide(rig, [matches(rig, depth, seed=seed, pair=k) for k in range(3)], PARAMS)
    assert not decision.changed
    assert all(p.value == 0.0 and not p.freed and p.why for p in decision.parameters)


def test_row_offset_and_roll_of_a_street_are_repaired_and_yaw_is_held():
    rig = street_rig()
    true = knocked(rig, pitch_deg=-0.24, roll_deg=0.3)
    decision = decide(rig, [matches(true, street_depth, pair=k) for k in range(3)], PARAMS)
    assert freed(decision) == {"pitch", "roll"}
    # 0.01 degrees are 0.12 px of rows
    assert found(decision)["pitch"] == pytest.approx(-0.24, abs=0.01)
    assert found(decision)["roll"] == pytest.approx(0.3, abs=0.01)
    yaw = decision.parameters[1]
    assert not yaw.observed
    assert "not observed" in yaw.why


def test_toe_in_of_a_street_is_held_even_where_it_is_wrong():
    """The images see rows that look like toe-in, but not whether depth is wrong."""
    rig = street_rig()
    decision = decide(rig, [matches(knocked(rig, yaw_deg=0.5), street_depth)], PARAMS)
    assert not decision.changed
    assert math.degrees(decision.parameters[1].asked) == pytest.approx(0.5, abs=0.1)


def test_an_angle_that_departs_alone_is_likelier_a_principal_point_and_with_others_a_knock(monkeypatch):
    rig = street_rig()
    monkeypatch.setattr(parameter_selection, "MAX_DEPTH_ERROR", 1.0)
    alone, both = (
        decide(rig, [matches(knocked(rig, yaw_deg=0.3, roll_deg=roll), street_depth, pair=k) for k in range(3)], PARAMS)
        for roll in (0.0, 0.3)
    )
    assert not alone.changed
    assert "likelier a principal point" in alone.parameters[1].why
    assert freed(both) == {"yaw", "roll"}


@pytest.mark.parametrize("name", SCENES)
def test_a_yaw_that_no_principal_point_explains_is_repaired(name):
    """By three degrees outwards: nothing lies beyond infinity, but all of it is nearer."""
    rig, depth = SCENES[name]
    decision = decide(rig, [matches(knocked(rig, yaw_deg=-3.0), depth, pair=k) for k in range(3)], PARAMS)
    assert "yaw" in freed(decision)
    assert found(decision)["yaw"] == pytest.approx(-3.0, abs=0.2)


def far(rays, rng):
    """A plain to the horizon, half the image beyond 100 m."""
    return np.where(rays[:, 1] > 0.05, 1.65 / np.maximum(rays[:, 1], 0.05), rng.uniform(100, 1000, len(rays)))


def test_matches_beyond_infinity_show_a_wrong_toe_in():
    """Depth is surely wrong, and the keystone of the rows says by how much."""
    rig = street_rig()
    pairs = [matches(knocked(rig, yaw_deg=0.8), far, pair=k) for k in range(3)]
    decision = decide(rig, pairs, PARAMS)
    assert freed(decision) == {"yaw"}
    assert found(decision)["yaw"] == pytest.approx(0.8, abs=0.06)
    # turned the other way nothing is impossible, only nearer
    assert not decide(rig, [matches(knocked(rig, yaw_deg=-0.8), far)], PARAMS).changed


def test_rows_that_ask_for_four_times_as_much_as_infinity_change_no_toe_in():
    """As found on KITTI: half of what they ask for brings all matches before infinity, so it is not what was turned."""
    rig = street_rig()
    pairs = [matches(knocked(rig, yaw_deg=0.8), far, pair=k) for k in range(3)]
    for m in pairs:
        keystone, _ = distances(knocked(rig, yaw_deg=2.4), np.zeros(5), m.left, m.right)
        m.right[:, 1] -= keystone
    decision = decide(rig, pairs, PARAMS)
    assert not decision.changed
    assert math.degrees(decision.parameters[1].asked) > 2.0


def test_noise_that_matches_in_a_sky_makes_no_change_worth_it():
    """It lies beyond infinity, and no rig explains it."""
    rig = street_rig()
    pairs = [matches(rig, street_depth, pair=k) for k in range(3)]
    for m in pairs:
        m.right[::8, 0] = m.left[::8, 0] + np.linspace(2.0, 90.0, len(m.right[::8]))
    chooser = parameter_selection._Chooser(rig, pairs, PARAMS)
    assert chooser.impossible
    assert not chooser._enough([0], chooser.all, np.array([5e-5, 0.0, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize("near", [False, True])
def test_principal_point_that_the_rotation_made_up_for_is_not_mistaken_for_toe_in(near):
    """As found on KITTI: depth is right, rows show a keystone of half a pixel RMS."""
    rig = bed_rig() if near else street_rig()
    if near:
        rig = Rig(rig.left, rig.right, RigidTransform(np.eye(3), np.array([-0.097, 0.0, 0.0])))
    shift = 5.0
    turned = knocked(rig, yaw_deg=math.degrees(shift / rig.right.fx))
    true = Rig(rig.left, replace(rig.right, cx=rig.right.cx - shift), turned.T_right_left)
    pairs = [matches(true, bed_depth if near else street_depth, noise=0.1, pair=k) for k in range(3)]
    rest, _ = distances(rig, np.zeros(5), pairs[0].left, pairs[0].right)
    assert np.std(rest) > 0.2  # a plain fit would "improve" on that
    decision = decide(rig, pairs, PARAMS)
    assert not decision.changed
    assert math.degrees(decision.parameters[1].asked) > 0.3
    assert "principal point" in decision.parameters[1].why


@pytest.mark.parametrize("knock", [(0.5, 0.5, 0.5), (0.0, -0.5, 0.0), (-0.5, 0.3, 0.0)])
def test_a_convergent_rig_tells_its_toe_in(knock):
    rig = bed_rig()
    decision = decide(rig, [matches(knocked(rig, *knock), bed_depth, noise=0.1, pair=k) for k in range(4)], PARAMS)
    assert freed(decision) == {n for n, k in zip(NAMES, knock, strict=False) if k}
    # 0.035 degrees of toe-in are a quarter of a percent of depth
    np.testing.assert_allclose(list(found(decision).values())[:3], knock, atol=0.035)


def test_direction_of_the_baseline_is_found():
    rig = bed_rig()
    true = knocked(rig, across_deg=1.0, forward_deg=-1.0)
    decision = decide(rig, [matches(true, bed_depth, noise=0.1, pair=k) for k in range(3)], PARAMS)
    assert freed(decision) == {"baseline_across", "baseline_forward"}
    np.testing.assert_allclose(list(found(decision).values())[3:], [1.0, -1.0], atol=0.25)


@pytest.mark.parametrize(("sigmas", "kept"), [(2.0, {"baseline_forward"}), (3.5, set())])
def test_what_is_held_may_explain_a_correction(sigmas, kept, monkeypatch):
    """Beside a yaw that is held, and may be off, it is 1.55 +- 0.49 degrees."""
    monkeypatch.setattr(parameter_selection, "LEAST_SIGMAS", sigmas)
    rig = street_rig()
    true = knocked(rig, yaw_deg=0.8, forward_deg=1.2)
    decision = decide(rig, [matches(true, street_depth, samples=300, pair=k) for k in range(2)], PARAMS)
    assert freed(decision) == kept
    assert kept or "what is held" in decision.parameters[4].why


def test_a_third_of_wrong_matches_does_no_harm():
    rig = street_rig()
    true = knocked(rig, pitch_deg=0.4, roll_deg=-0.6)
    decision = decide(rig, [matches(true, street_depth, outliers=0.33)], PARAMS)
    assert freed(decision) == {"pitch", "roll"}
    np.testing.assert_allclose([found(decision)[n] for n in ("pitch", "roll")], [0.4, -0.6], atol=0.01)


def test_a_vertical_rig_holds_pitch_instead():
    """What is toe-in on a horizontal rig is pitch where one camera stands above the other."""
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rig = street_rig()
    camera = replace(rig.left, cx=rig.left.cy, cy=rig.left.cx, width=rig.left.height, height=rig.left.width)
    standing = Rig(camera, camera, replace(rig.T_right_left, translation=turn @ rig.T_right_left.translation))
    true = knocked(standing, pitch_deg=0.4, yaw_deg=0.3)
    decision = decide(
        standing, [matches(true, lambda r, g: g.uniform(4.0, 60.0, len(r)), pair=k) for k in range(3)], PARAMS
    )
    assert freed(decision) == {"yaw"}
    assert found(decision)["yaw"] == pytest.approx(0.3, abs=0.02)
    assert not decision.parameters[0].observed


def test_sigmas_are_honest_about_smooth_errors():
    """Smooth row errors of the believed size: estimates miss by their sigmas, not by more."""
    rig = bed_rig()
    true = knocked(rig, pitch_deg=0.5, roll_deg=0.5)
    rng = np.random.default_rng(5)
    missed = []
    for k in range(12):
        a = 0.1 / math.sqrt(10) * rng.standard_normal((4, 4))

        def field(u, v, a=a):
            terms = [(i, j) for i in range(4) for j in range(4 - i)]
            legendre = [np.polynomial.legendre.legval(x, np.eye(4)[d]) for x in (u, v) for d in range(4)]
            return sum(a[i, j] * math.sqrt((2 * i + 1) * (2 * j + 1)) * legendre[i] * legendre[4 + j] for i, j in terms)

        decision = decide(rig, [matches(true, bed_depth, noise=0.1, pair=k, field=field)], PARAMS)
        missed += [
            (math.degrees(p.value) - 0.5) / math.degrees(p.sigma)
            for p in decision.parameters
            if p.name in ("pitch", "roll")
        ]
    assert 0.4 < math.sqrt(np.mean(np.square(missed))) < 1.6


def test_many_matches_do_not_make_sigmas_small():
    rig = street_rig()
    true = knocked(rig, pitch_deg=0.5)
    few = decide(rig, [matches(true, street_depth)], PARAMS).parameters[0].sigma
    many = (
        decide(rig, [matches(true, street_depth, samples=5000, pair=k) for k in range(2)], PARAMS).parameters[0].sigma
    )
    assert many > 0.5 * few
    assert math.degrees(many) > 0.001  # 10 000 matches of 0.2 px alone would claim 0.0002


def test_what_is_small_is_left():
    rig = street_rig()
    decision = decide(rig, [matches(knocked(rig, pitch_deg=0.015), street_depth, pair=k) for k in range(2)], PARAMS)
    assert not decision.changed
    assert "not worth it" in decision.parameters[0].why
    eager = RelativeParams(least_rows=0.0)
    assert "pitch" in freed(
        decide(rig, [matches(knocked(rig, pitch_deg=0.015), street_depth, pair=k) for k in range(3)], eager)
    )


def test_what_comes_to_nothing_together_is_left(monkeypatch):
    """Two parameters that each ask for much, one against the other: a sound calibration stays."""
    rig, depth = SCENES["bed"]
    pairs = [matches(rig, depth, pair=k) for k in range(2)]

    def greedy(self, i, chosen):
        return None if i >= parameter_selection.ANGLES else "held"

    monkeypatch.setattr(parameter_selection._Chooser, "_refusal", greedy)
    decision = decide(rig, pairs, PARAMS)
    assert not decision.changed
    assert "with the others" in decision.parameters[3].why


def test_what_moves_rows_singly_and_hardly_together_is_left():
    """Over flat ground a pitch and the baseline's direction stand in for each other: rows then say nothing of them."""
    rig, depth = SCENES["bed"]
    sound = [matches(rig, depth, noise=0.02, pair=k) for k in range(2)]
    moved, some = parameter_selection.row_sensitivity(rig, sound), [0, 3, 4]
    against = np.zeros(5)
    against[some] = np.linalg.eigh(moved[np.ix_(some, some)])[1][:, 0]
    against *= 0.2 / math.sqrt(against @ moved @ against)
    assert (np.abs(against) * np.sqrt(np.diag(moved))).max() > 2 * PARAMS.least_rows
    true = knocked(rig, math.degrees(against[0]), 0.0, 0.0, *np.degrees(against[3:]))
    decision = decide(rig, [matches(true, depth, noise=0.02, pair=k) for k in range(2)], PARAMS)
    assert not decision.changed


def test_the_principal_point_is_as_certain_in_rays_along_either_axis():
    rig = street_rig()
    flat = replace(rig, right=replace(rig.right, fy=0.5 * rig.right.fy))
    assert RelativeParams().priors(flat).principal == (0.005 * rig.right.fx, 0.0025 * rig.right.fy)
