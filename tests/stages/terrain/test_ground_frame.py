from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from raising import raises
from terrain_scenes import Distance, ball, box, disparity, nearest, pitched, plane, smooth_noise, toed_in_rig

from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.geometry.epipolar import inverse_depth
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.pose_arrays import REFERENCE_PLANE
from rille.stages.terrain import ground_frame
from rille.stages.terrain import ground_frame as level_stage
from rille.stages.terrain.ground import view_ground
from rille.stages.terrain.ground_frame import SCENE, GroundFrameParams, VerticalHint, z_range
from rille.stages.terrain.locus.stage import LocusParams, local_lattice
from rille.stages.terrain.matches import Matches

RIG = toed_in_rig()
PARAMS = GroundFrameParams()

PITCH, ROLL, HEIGHT = 18.0, 2.0, 0.18
POSE = pitched(PITCH, ROLL)
FLAT = disparity(RIG, POSE, plane(0.0, 0.0, -HEIGHT))


def level(column, row, usable, *given, **more) -> dict:
    """Facts of the stage by a pair's disparities."""
    return ground_frame.level(Matches(column, row, usable), *given, **more)


def tilt_of(facts: dict) -> float:
    return math.atan(math.hypot(*facts["plane"][:2]))


def range_of(facts: dict) -> list[float]:
    return z_range(facts["plane"], facts["relief"], facts["footprint"])


def up_of(facts: dict) -> np.ndarray:
    return RigidTransform.from_matrix(facts["T_local_left"]).rotation[2]


def test_inverse_depth_against_the_projection() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, 50), rng.uniform(-0.3, 0.3, 50), rng.uniform(0.5, 4.0, 50)])
    left = RIG.left.project(points)
    right = RIG.right.project(RIG.T_right_left.apply(points))
    rho, per_pixel = inverse_depth(RIG, left, right - left)
    np.testing.assert_allclose(rho, 1.0 / points[:, 2], rtol=1e-10)
    step = 1e-6  # of inverse depth: how far does the right image move?
    nearer = RIG.right.project(RIG.T_right_left.apply(points * (rho / (rho + step))[:, None]))
    np.testing.assert_allclose(step / np.linalg.norm(nearer - right, axis=1), per_pixel, rtol=0.2)


def test_ground_plane_gives_attitude_and_height() -> None:
    noise = smooth_noise(FLAT[0].shape, PARAMS.sigma_disparity, np.random.default_rng(0))
    facts = level(FLAT[0] + noise, *FLAT[1:], RIG, PARAMS)
    assert facts["source"] == "ground plane"
    # Noise of 0.2 px over thousands of pixels, correlated over some 30: a milliradian at most.
    assert math.acos(min(1.0, float(up_of(facts) @ POSE.rotation[2]))) < 2e-3
    assert facts["plane"][2] == pytest.approx(-HEIGHT, rel=5e-3)
    assert tilt_of(facts) < 1e-9
    assert facts["ground_share"] > 0.9


def test_ground_that_contradicts_the_given_vertical_is_told() -> None:
    """The vertical is stated near the optical axis: there is no ground below it, but there is some."""
    facts = level(*FLAT, RIG, PARAMS, VerticalHint(up=[0.0, 0.3, -1.0]))
    assert "no_ground" in facts
    assert facts["seen_up"] == pytest.approx(POSE.rotation[2].tolist(), abs=0.01)
    assert "seen_up" not in level(*FLAT, RIG, PARAMS, VerticalHint(up=POSE.rotation[2]))


def test_each_source_and_their_order() -> None:
    slope = math.radians(8.0)
    maps = disparity(RIG, pitched(PITCH), plane(0.0, math.tan(slope), -HEIGHT))  # the ground rises ahead
    level_up = pitched(PITCH).rotation[2]
    given = {"up": level_up, "pitch": math.radians(PITCH)}
    for source, keys in (("attitude", ("up", "pitch")), ("pitch", ("pitch",))):
        facts = level(*maps, RIG, PARAMS, VerticalHint(**{k: given[k] for k in keys}))
        assert facts["source"] == source
        np.testing.assert_allclose(up_of(facts), level_up, atol=1e-12)
        np.testing.assert_allclose(facts["plane"], [0.0, math.tan(slope), -HEIGHT], atol=1e-3)
        assert tilt_of(facts) == pytest.approx(slope, abs=1e-3)
    without = level(*maps, RIG, PARAMS)
    assert math.acos(float(up_of(without) @ level_up)) == pytest.approx(slope, abs=1e-3)


def test_local_frame() -> None:
    T = RigidTransform.from_matrix(level(*FLAT, RIG, PARAMS, VerticalHint(up=POSE.rotation[2]))["T_local_left"])
    np.testing.assert_allclose(T.translation, 0.0)
    axis = T.rotation @ [0.0, 0.0, 1.0]
    assert abs(axis[0]) < 1e-12
    assert axis[1] > 0
    np.testing.assert_allclose(T.rotation, POSE.rotation, atol=1e-12)


def test_street_with_more_walls_than_road() -> None:
    """Camera 1.65 m high, level axis: walls on both sides, one of them near, and a car."""
    cam = Camera(700.0, 700.0, 400.0, 120.0, 800, 260)
    rig = Rig(cam, cam, RigidTransform(np.eye(3), [-0.54, 0.0, 0.0]))
    walls = [box((-9.0, 0.0, -1.65), (-5.0, 200.0, 9.0)), box((4.0, 0.0, -1.65), (9.0, 200.0, 9.0))]
    scene = nearest(plane(0.0, 0.0, -1.65), *walls, box((1.5, 12.0, -1.65), (3.5, 16.0, -0.2)))
    column, row, usable = disparity(rig, pitched(1.0), scene)
    column = column + smooth_noise(column.shape, 0.3, np.random.default_rng(0))
    facts = level(column, row, usable, rig, PARAMS)
    assert facts["ground_share"] < 0.5
    assert facts["plane"][2] == pytest.approx(-1.65, abs=0.02)
    assert math.acos(float(up_of(facts) @ pitched(1.0).rotation[2])) < math.radians(0.3)
    low, high = range_of(facts)
    assert low < -1.65 - 0.05
    assert high > -0.2
    assert high <= 1.652 + abs(facts["footprint"][3]) * math.tan(tilt_of(facts))
    x_min, x_max, y_min, y_max = facts["footprint"]
    assert x_min < -4.0
    assert x_max > 4.0
    nearest_row = math.atan(139 / 700) + math.radians(1.0)  # below the horizon
    assert y_min == pytest.approx(1.65 / math.tan(nearest_row), rel=0.05)
    assert y_max > 15.0


def test_the_far_background_is_not_ground() -> None:
    ground, wall = plane(0.0, 0.0, -0.6), box((-900.0, 100.0, -900.0), (900.0, 200.0, 900.0))
    T = pitched(3.0)
    column, row, usable = disparity(RIG, T, nearest(ground, wall))
    column = column + smooth_noise(column.shape, 0.2, np.random.default_rng(0))
    facts = level(column, row, usable, RIG, PARAMS)
    cols, rows = np.meshgrid(np.arange(RIG.left.width), np.arange(RIG.left.height))
    v = RIG.left.rays(np.stack([cols, rows], -1)[usable]) @ T.rotation.T
    # Ground beyond 5 sigma of inverse depth, 5 * 0.2 px / (f B), cannot be told from the background.
    on_ground = ground(np.zeros(3), v) < RIG.left.fx * RIG.baseline
    assert facts["ground_share"] == pytest.approx(on_ground.mean(), abs=0.05)
    assert facts["plane"][2] == pytest.approx(-0.6, rel=0.02)


def test_relief_holds_the_rocks() -> None:
    rocks = nearest(plane(0.0, 0.0, -HEIGHT), ball((0.0, 0.35, -HEIGHT), 0.05), ball((-0.1, 0.5, -HEIGHT), 0.06))
    facts = level(*disparity(RIG, POSE, rocks), RIG, PARAMS, VerticalHint(up=POSE.rotation[2]))
    assert facts["plane"][2] == pytest.approx(-HEIGHT, rel=0.02)
    assert range_of(facts)[0] < -HEIGHT
    assert range_of(facts)[1] > -HEIGHT + 0.055
    assert facts["relief"][0] < 0.0 < facts["relief"][1]


def test_without_ground_the_pair_is_levelled_all_the_same() -> None:
    wall = disparity(RIG, pitched(0.0), box((-9.0, 1.0, -9.0), (9.0, 2.0, 9.0)))
    facts = level(*wall, RIG, PARAMS)
    assert facts["source"] == "none"
    assert "no ground plane" in facts["no_ground"]
    assert facts["plane"] is facts["footprint"] is None
    T = RigidTransform.from_matrix(facts["T_local_left"])
    np.testing.assert_allclose(T.rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    # A pixel covers 2 mm at twice the distance of the nearer of two walls.
    near = 0.001 * RIG.left.fx
    walls = box((-9.0, near, -9.0), (0.0, 9.0, 9.0)), box((-9.0, 4 * near, -9.0), (9.0, 9.0, 9.0))
    seen = level(*disparity(RIG, pitched(0.0), nearest(*walls)), RIG, PARAMS)
    assert seen["cell_size"] == pytest.approx(0.002)
    assert level(*wall, RIG, PARAMS, VerticalHint(up=[0.0, -1.0, 0.1]))["source"] == "attitude"

    stated = level(*wall, RIG, PARAMS.model_copy(update={"reference_height": 0.3}))
    np.testing.assert_allclose(stated["plane"], [0.0, 0.0, -0.3], atol=1e-12)
    assert stated["source"] == "none"
    away = level(*wall, RIG, PARAMS.model_copy(update={"reference_height": 0.3}), VerticalHint(up=[0.0, -0.17, 0.98]))
    assert away["plane"] is None  # it looks up: that surface is not in view
    assert away["source"] == "attitude"

    far = disparity(RIG, pitched(0.0), box((-900.0, 100.0, -900.0), (900.0, 200.0, 900.0)))
    patch = np.zeros_like(far[2])
    patch[150:190, 150:190] = True
    for seed in range(5):  # so far away every plane fits, chance sets its tilt
        noisy = far[0] + smooth_noise(far[0].shape, 0.2, np.random.default_rng(seed))
        assert level(noisy, far[1], patch, RIG, PARAMS)["plane"] is None
    assert "texture in common" in level(FLAT[0], FLAT[1], np.zeros_like(FLAT[2]), RIG, PARAMS)["no_ground"]


@pytest.mark.parametrize("pitch", [83.0, 90.0])
def test_a_camera_that_looks_down_is_told_to_state_the_vertical_and_sees_ground_with_it(pitch: float) -> None:
    """The remedy is taken at its word."""
    column, row, usable = disparity(RIG, pitched(pitch), plane(0.0, 0.0, -HEIGHT))
    facts = level(column, row, usable, RIG, PARAMS)
    assert facts["no_ground"].endswith("if that is the ground, state it as world.up in a manifest")
    up = json.loads(facts["no_ground"].split("normal at ")[1].split(" in the")[0])
    assert "no_ground" not in level(column, row, usable, RIG, PARAMS, VerticalHint(up=up))


@pytest.mark.parametrize("up", [None, [0.0, -1.0, 0.0]])
def test_where_no_plane_dominates_a_surface_may_be_stated(up: list[float] | None) -> None:
    column, row, usable = disparity(RIG, pitched(0.0), box((-9.0, 1.0, -9.0), (9.0, 2.0, 9.0)))
    column = column + np.random.default_rng(0).normal(0.0, 0.3 * abs(column[usable]).max(), column.shape)
    facts = level(column, row, usable, RIG, PARAMS, VerticalHint(up=up))
    assert facts["no_ground"].endswith("state its depth by ground_frame.reference_height")
    assert "world.up" not in facts["no_ground"]
    assert "lowest quarter" not in facts["no_ground"]


@pytest.mark.parametrize("down", [1, -1])
def test_ground_that_is_hidden_asks_for_a_look_at_the_images(down: int) -> None:
    """Dirt on a lens, or an image that is torn below: walls and trees are all that is matched."""
    column, row, usable = disparity(RIG, pitched(0.0), box((-9.0, 1.0, -9.0), (9.0, 2.0, 9.0)))
    column = column + np.random.default_rng(0).normal(0.0, 0.8 * abs(column[usable]).max(), column.shape)
    usable[::down][len(usable) // 2 :] = False
    facts = level(column, row, usable, RIG, PARAMS, VerticalHint(up=[0.0, -float(down), 0.0]))
    assert "; 0% of the lowest quarter of the left image is matched: look there at both images" in facts["no_ground"]


def test_a_wall_before_a_floor_that_nothing_matches_says_so() -> None:
    """A floor without texture: the wall is not offered as ground alone."""
    column, row, usable = disparity(RIG, pitched(0.0), box((-9.0, 1.0, -9.0), (9.0, 4.0, 9.0)))
    usable[len(usable) // 2 :] = False
    facts = level(column, row, usable, RIG, PARAMS)
    assert "normal at [" in facts["no_ground"]
    assert "; 0% of the lowest quarter of the left image is matched: look there at both images" in facts["no_ground"]
    assert facts["matched_below"] == 0.0


def test_ground_that_is_seen_too_coarsely_says_which_cells_show_it() -> None:
    """From 200 m with a baseline of 9 cm, as a drone; the remedy is taken at its word."""
    column, row, usable = disparity(RIG, POSE, plane(0.0, 0.0, -200.0))
    facts = level(column, row, usable, RIG, PARAMS.model_copy(update={"sigma_disparity": 0.01}))
    assert facts["no_ground"]
    cell = float(facts["no_ground"].split("locus.cell_size to ")[1].split()[0])
    params = LocusParams(cell_size=cell, max_sigma=cell, sigma_disparity=0.01)
    view = view_ground(RIG, RigidTransform.from_matrix(facts["T_local_left"]).rotation, facts["plane"])
    assert local_lattice(view, cell, params).rows > 0
    with raises("RIL-344"):
        local_lattice(view, 0.5 * cell, params.model_copy(update={"max_sigma": 0.5 * cell}))
    with raises("RIL-344", "locus.max_sigma") as stated:
        local_lattice(view, cell, params.model_copy(update={"max_sigma": 0.01 * cell}))
    assert "cell_size" not in stated.value.remedy
    sigma = float(stated.value.remedy.split("locus.max_sigma to ")[1].split()[0])
    assert local_lattice(view, cell, params.model_copy(update={"max_sigma": sigma})).rows > 0


@pytest.mark.parametrize("pitch", [40.0, 90.0])
def test_ground_that_is_known_to_be_level_has_cells_that_a_short_baseline_allows(pitch: float) -> None:
    """A pixel covers 5 mm of it, and a depth errs by 10 times as much."""
    pose = pitched(pitch)
    column, row, usable = disparity(RIG, pose, plane(0.0, 0.0, -3.0))
    known = level(column, row, usable, RIG, PARAMS, VerticalHint(up=pose.rotation[2]))
    assert "no_ground" not in known
    assert known["plane"][2] == pytest.approx(-3.0, abs=1e-3)
    view = view_ground(RIG, RigidTransform.from_matrix(known["T_local_left"]).rotation, known["plane"])
    assert known["cell_size"] > view.cell_size()
    near = view.slant <= 2.0 * view.slant.min()
    error = np.median(PARAMS.sigma_disparity / view.slope[near])
    assert error <= known["cell_size"] <= 2.5 * error
    assert "no_ground" in level(column, row, usable, RIG, PARAMS)


WALL = pitched(90.0)
"""Of a camera that looks at a wall z = -1.5 + 0.2 x, which a ball of half its points hides in part."""


def wall(*more: Distance, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    column, row, usable = disparity(RIG, WALL, nearest(plane(0.2, 0.0, -1.5), *more))
    return column + smooth_noise(column.shape, noise, np.random.default_rng(3)), row, usable


@pytest.mark.parametrize("reference", [SCENE, [*(WALL.rotation.T @ [0.2, 0.0, -1.0]), 0.0, 0.0, 1.5]])
def test_without_ground_elevations_are_distances_from_another_plane(reference: str | list[float]) -> None:
    maps = wall(ball((0.1, 0.1, -1.45), 0.15))
    assert "no_ground" in level(*maps, RIG, PARAMS)
    facts = level(*maps, RIG, PARAMS, reference=reference)
    assert (facts["source"], "no_ground" in facts) == (REFERENCE_PLANE, False)
    T = RigidTransform.from_matrix(facts["T_local_left"])
    # The wall's normal towards the camera, in the camera's frame; z = 0 on the wall.
    normal = WALL.rotation.T @ np.array([-0.2, 0.0, 1.0]) / math.hypot(0.2, 1.0)
    assert T.rotation[2] @ normal > math.cos(math.radians(0.2))
    assert T.translation == pytest.approx([0.0, 0.0, 1.5 / math.hypot(0.2, 1.0)], rel=3e-3, abs=1e-9)
    # Right in the image is right on the wall, and the ball, which stands out by 0.1 m, within the range of the search.
    assert T.rotation[0, 0] > 0.9
    assert range_of(facts)[1] > 0.09
    assert facts["footprint"][1] - facts["footprint"][0] > 0.8


@pytest.mark.parametrize("reference", [SCENE, [0.0, 0.0, -1.0, 0.0, 0.0, 1.5]])
def test_a_pair_without_a_match_has_a_frame_though_no_surface(reference: str | list[float]) -> None:
    # Trajectory and the models of other pairs depend on it.
    column, row, usable = wall()
    facts = level(column, row, np.zeros_like(usable), RIG, PARAMS, reference=reference)
    assert (facts["source"], facts["plane"], facts["cell_size"] > 0) == (REFERENCE_PLANE, None, True)
    assert "no pixel is matched" in facts["no_ground"]


def test_a_scene_without_a_plane_is_measured_across_the_view() -> None:
    heap = [
        ball((x, y, -1.2 - 0.3 * ((5 * k) % 7)), 0.25)
        for k, (x, y) in enumerate(np.mgrid[-2:3, -2:3].reshape(2, -1).T * 0.35)
    ]
    column, row, usable = disparity(RIG, WALL, nearest(*heap))
    T = RigidTransform.from_matrix(level(column, row, usable, RIG, PARAMS, reference=SCENE)["T_local_left"])
    assert T.rotation[2].tolist() == [0.0, 0.0, -1.0]


def test_a_plane_through_the_camera_is_refused() -> None:
    for plane_given in ([0.0, 0.0, 1.0, 0.3, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]):
        with raises("RIL-379"):
            level(*FLAT, RIG, PARAMS, reference=plane_given)


def test_what_no_frame_can_be_posed_from_is_said_with_a_remedy() -> None:
    swapped = Rig(RIG.right, RIG.left, RIG.T_right_left)
    # Their rows fit the rig neither as given nor with its sides exchanged.
    with raises("RIL-375", "one scene"):
        level(-FLAT[0], FLAT[1], FLAT[2], swapped, PARAMS)
    # Turned inward, the cameras see far ground ahead with their sides exchanged, too, but off the epipolar lines.
    inside_out = disparity(Rig(RIG.right, RIG.left, RIG.T_right_left.inverse()), POSE, plane(0.0, 0.0, -8.0 * HEIGHT))
    with raises("RIL-781"):
        level(*inside_out, RIG, PARAMS)
    with raises("RIL-377"):
        level(*FLAT, Rig(RIG.left, RIG.right, RigidTransform.identity()), PARAMS)
    with raises("RIL-378"):
        level(*FLAT, RIG, PARAMS, VerticalHint(up=[0.0, 0.0, 0.0]))
    with raises("RIL-376"):
        level(FLAT[0][:-1], FLAT[1], FLAT[2], RIG, PARAMS)


def test_stage_uses_only_measured_pixels_and_is_repeatable() -> None:
    column, row, usable = (np.array(m) for m in FLAT)
    filled = np.zeros_like(usable)
    filled[:, :60] = True
    column[filled] -= 20.0  # filled disparities may be anything
    validity = np.where(filled, Validity.INTERPOLATED, np.where(usable, Validity.MATCHED, 0)).astype(np.uint8)
    error = np.zeros_like(validity, dtype="f4")
    column[:, 60:80] -= 20.0
    error[:, 60:80] = np.nan  # nothing was matched back
    maps = {"column_disparity": column.astype("f4"), "row_disparity": row.astype("f4"), "validity": validity}
    maps |= {"backmatch_error": error}
    inputs = {"disparity": Bundle(maps, {}), "rig": Bundle({}, {"rig": RIG.to_dict()})}
    facts = level_stage.ground_frame_stage.run(PARAMS, {"pitch": math.radians(PITCH)}, inputs).meta
    assert facts["plane"][2] == pytest.approx(-HEIGHT, rel=1e-3)
    assert facts == level_stage.ground_frame_stage.run(PARAMS, {"pitch": math.radians(PITCH)}, inputs).meta
    json.dumps(facts, allow_nan=False)


@pytest.mark.parametrize("pitch", [0.0, 12.0])
def test_images_that_are_mirrored_top_to_bottom_show_ground_above_the_cameras(pitch: float) -> None:
    """Of parallel cameras matches, epipolar lines and motions are faultless then, and the world is mirrored."""
    cam = Camera(350.0, 350.0, 199.5, 64.5, 400, 130)
    rig = Rig(cam, cam, RigidTransform(np.eye(3), [-0.54, 0.0, 0.0]))
    scene = nearest(plane(0.0, 0.0, -1.65), box((-9.0, 0.0, -1.65), (-5.0, 200.0, 9.0)))
    column, row, usable = disparity(rig, pitched(pitch), scene)
    for way, warned in ((1, False), (-1, True)):
        maps = {"column_disparity": column[::way].astype("f4"), "row_disparity": way * row[::way].astype("f4")}
        maps |= {"validity": np.where(usable[::way], Validity.MATCHED, 0).astype(np.uint8)}
        maps |= {"backmatch_error": np.zeros(usable.shape, "f4")}
        inputs = {"disparity": Bundle(maps, {}), "rig": Bundle({}, {"rig": rig.to_dict()})}
        facts = level_stage.ground_frame_stage.run(PARAMS, {}, inputs).meta
        assert facts.get("warnings") == ([level_stage.HANGING] if warned else None)
        assert "contradiction" not in facts
        # A vertical with the wrong sign contradicts the images.
        reversed_up = {"up": [0.0, 1.0, 0.0]}
        facts = level_stage.ground_frame_stage.run(PARAMS, reversed_up, inputs).meta
        assert facts.get("contradiction") == (None if warned else level_stage.HANGING)


@pytest.mark.parametrize(("rows", "warned"), [(50, True), (9, False)])
def test_a_few_eaves_above_the_cameras_are_no_ground_of_mirrored_images(rows: int, warned: bool) -> None:
    cam = Camera(350.0, 350.0, 199.5, 64.5, 400, 130)
    rig = Rig(cam, cam, RigidTransform(np.eye(3), [-0.54, 0.0, 0.0]))
    column, row, usable = (a[::-1].copy() for a in disparity(rig, pitched(0.0), plane(0.0, 0.0, -1.65)))
    random = np.random.default_rng(0)
    column[: 60 - rows] = -random.uniform(5.0, 60.0, (60 - rows, 400))
    column[60:], row[60:], usable[60:] = -random.uniform(5.0, 60.0, (70, 400)), 0.0, True
    maps = {"column_disparity": column.astype("f4"), "row_disparity": -row.astype("f4")}
    maps |= {"validity": np.where(usable, Validity.MATCHED, 0).astype(np.uint8)}
    maps |= {"backmatch_error": np.zeros(usable.shape, "f4")}
    inputs = {"disparity": Bundle(maps, {}), "rig": Bundle({}, {"rig": rig.to_dict()})}
    facts = level_stage.ground_frame_stage.run(PARAMS, {}, inputs).meta
    assert ("warnings" in facts) == warned


def test_a_drone_that_tilts_backwards_sees_no_ground_above() -> None:
    T = pitched(110.0)  # 20 degrees beyond straight down
    column, row, usable = disparity(RIG, T, plane(0.0, 0.0, -HEIGHT))
    maps = {"column_disparity": column.astype("f4"), "row_disparity": row.astype("f4")}
    maps |= {"validity": np.where(usable, Validity.MATCHED, 0).astype(np.uint8)}
    maps |= {"backmatch_error": np.zeros(usable.shape, "f4")}
    inputs = {"disparity": Bundle(maps, {}), "rig": Bundle({}, {"rig": RIG.to_dict()})}
    facts = level_stage.ground_frame_stage.run(PARAMS, {}, inputs).meta
    assert "no_ground" in facts
    assert "warnings" not in facts


@pytest.mark.data
def test_kitti_street(data_dir: Path) -> None:
    """The cameras of the KITTI car are mounted 1.65 m above the road, level to a degree or two."""
    import cv2

    folder = data_dir / "kitti06_51"
    P = np.array((folder / "calib.txt").read_text().split(), float).reshape(2, 3, 4)
    left, right = (cv2.imread(str(sorted((folder / f"image_{c}").iterdir())[25]), 0) for c in "lr")
    matcher = cv2.StereoSGBM_create(0, 128, 5, 200, 800, 1, 63, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    d = matcher.compute(left, right).astype(np.float32) / 16
    cam = Camera(P[0, 0, 0], P[0, 1, 1], P[0, 0, 2], P[0, 1, 2], left.shape[1], left.shape[0])
    rig = Rig(cam, cam, RigidTransform(np.eye(3), [P[1, 0, 3] / P[1, 0, 0], 0.0, 0.0]))
    facts = level(-d, np.zeros_like(d), d > 0, rig, PARAMS)
    assert facts["plane"][2] == pytest.approx(-1.65, abs=0.12)
    assert math.degrees(math.acos(-float(up_of(facts)[1]))) < 3.0


@pytest.mark.parametrize("plane_given", [[0.0, 0.0, -HEIGHT], [0.1, -0.15, -HEIGHT]])
def test_the_view_of_a_plane_is_that_of_lifted_points_and_neighbouring_pixels(plane_given: list[float]) -> None:
    """Pixels of disparity for a point lifted by a tenth of a millimetre; ground between the rays of four pixels."""
    a, b, c = plane_given
    view = view_ground(RIG, POSE.rotation, plane_given)
    point = view.xyz[len(view.xyz) // 2]
    assert point[2] == pytest.approx(c + a * point[0] + b * point[1])

    def meet(pixel: np.ndarray) -> np.ndarray:
        ray = RIG.left.rays(pixel) @ POSE.rotation.T
        return (c / (ray @ [-a, -b, 1.0]))[..., None] * ray

    def seen(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return RIG.left.project(p @ POSE.rotation), RIG.right.project(RIG.T_right_left.apply(p @ POSE.rotation))

    left, right = seen(point + 1e-4 * np.eye(3)[2])
    behind = seen(meet(left))[1]
    k = len(view.xyz) // 2
    assert view.slope[k] == pytest.approx(np.linalg.norm(right - behind) / 1e-4, rel=1e-3)
    pixel = seen(point)[0]
    across, down = (meet(pixel + step) - meet(pixel - step) for step in ([0.5, 0.0], [0.0, 0.5]))
    area = abs(across[0] * down[1] - across[1] * down[0])
    assert view.along[k] * view.across[k] == pytest.approx(area, rel=0.02)


@pytest.mark.parametrize(("scale", "coarser"), [(4.0, 1.0), (0.9, 1.0), (0.25, 4.0)])
def test_the_coarser_camera_tells_how_much_ground_a_pixel_covers(scale: float, coarser: float) -> None:
    c = RIG.right
    centre = ((v + 0.5) * scale - 0.5 for v in (c.cx, c.cy))
    right = Camera(c.fx * scale, c.fy * scale, *centre, round(c.width * scale), round(c.height * scale))
    other = Rig(RIG.left, right, RIG.T_right_left)
    given, found = (view_ground(rig, POSE.rotation, [0.0, 0.0, -HEIGHT]) for rig in (RIG, other))
    for name in ("along", "across"):
        before, after = (float(np.median(getattr(view, name))) for view in (given, found))
        assert after / before == pytest.approx(coarser, rel=0.05)
    assert coarser / 2 <= found.cell_size() / given.cell_size() <= coarser * 2  # to 1, 2 or 5
