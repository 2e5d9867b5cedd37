"""The simulated experiment: geometry exact, light plausible, bits reproducible."""

from __future__ import annotations

import math

import numpy as np
import pytest
from raising import raises
from scipy.ndimage import binary_erosion, map_coordinates

from rille.datasets.mockup import sequence as seq
from rille.datasets.mockup import terrain
from rille.datasets.mockup.params import MockupParams, SceneParams
from rille.datasets.mockup.scene import build_scene, height_field
from rille.datasets.mockup.truth import HIDDEN, NO_BED, OUTSIDE, SEEN, true_disparity
from rille.datasets.mockup.truth_dem import seen_by, true_dem
from rille.stages.geometry.geometry import RigidTransform, level_rotation, rotation_exp


@pytest.fixture(scope="module")
def field(tiny):
    return height_field(build_scene(tiny.part(SceneParams)))


def flat(p: MockupParams) -> MockupParams:
    return p.model_copy(update={"relief": 0.0, "rocks": 0.0, "craters": 0.0})


# -- rig and poses ---------------------------------------------------------------------------------------------------


def test_rig_is_the_papers():
    p = MockupParams()
    rig = seq.true_rig(p)
    assert rig.baseline == pytest.approx(0.097, abs=1e-12)
    left, right = seq.mount(p, "left"), seq.mount(p, "right")
    for pose, inward in ((left, 1.0), (right, -1.0)):
        axis, across = pose.rotation[:, 2], pose.rotation[:, 0]
        assert math.asin(-axis[2]) == pytest.approx(math.radians(18.0), abs=1e-12)  # the stated pitch, exactly
        assert across[2] == pytest.approx(0.0, abs=1e-15)  # no roll
        assert math.atan2(axis[0], axis[1]) == pytest.approx(inward * math.radians(5.0), abs=1e-12)
    # the axes cross in plan at half the baseline over the tangent of the toe-in
    x = np.array([0.0, 0.0485 / math.tan(math.radians(5.0))])
    np.testing.assert_allclose(
        (x - left.translation[:2]) @ [math.cos(0.0872664626), -math.sin(0.0872664626)], 0, atol=1e-9
    )


@pytest.mark.parametrize("bed", [{}, {"slope_deg": 8.0, "jitter_deg": 1.0}, {"roll_deg": 3.0}])
def test_the_vertical_is_an_inclinometers(bed):
    frames = 12
    sequence = seq.mockup(MockupParams(frames=frames, forward=0.01, **bed))
    assert sequence.pitch is None
    off = [np.degrees(np.arccos(np.dot(up, T.rotation[2]))) for up, T in zip(sequence.up, sequence.truth, strict=True)]
    # 0.2 degrees about each of two axes across the vertical: RMS 0.28, of 24 squares to 14 % (one standard deviation)
    assert 0.16 < np.sqrt(np.mean(np.square(off))) < 0.40
    assert len({round(v, 9) for v in off}) == frames, "every frame has an error of its own"
    # By seed and frame: the same for a shorter sequence, another for another seed.
    again = seq.mockup(MockupParams(frames=5, forward=0.01, **bed))
    if "jitter_deg" not in bed:
        np.testing.assert_allclose(again.up, sequence.up[:5], atol=1e-15)
    assert seq.mockup(MockupParams(frames=5, forward=0.01, seed=2, **bed)).up[0] != again.up[0]
    exact = seq.mockup(MockupParams(frames=2, up_noise_deg=0.0, **bed))
    for up, pose in zip(exact.up, exact.truth, strict=True):
        np.testing.assert_allclose(pose.rotation @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert seq.mockup(MockupParams(frames=2, inclinometer=False, **bed)).up is None


def test_steps_are_30_mm_ahead_and_15_mm_to_the_right():
    poses = seq.body_poses(MockupParams())
    steps = np.diff([b.translation for b in poses], axis=0)
    np.testing.assert_allclose(steps, np.tile([0.015, 0.03, 0.0], (39, 1)), atol=1e-12)


def test_turns_of_a_whole_circle_close_the_way():
    p = MockupParams(frames=81, turn_deg=4.5, sideways=0.01, forward=0.03)
    poses = seq.body_poses(p)
    np.testing.assert_allclose(poses[-1].matrix34, poses[0].matrix34, atol=1e-12)
    steps = np.diff([T.translation for T in poses], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.hypot(0.01, 0.03))
    middle = np.mean([T.translation[:2] for T in poses[:-1]], axis=0)
    np.testing.assert_allclose(middle, [0.0, 0.5 * p.bed_length], atol=0.01)


def test_drive_beyond_the_bed_is_refused():
    with raises("RIL-253"):
        seq.mockup(MockupParams(frames=200))


def test_given_rig_errs_only_as_stated():
    p = MockupParams(rig_error_deg=(0.0, 0.1, 0.0))
    given, true = seq.given_rig(p), seq.true_rig(p)
    relative = given.T_right_left.rotation @ true.T_right_left.rotation.T
    np.testing.assert_allclose(relative, rotation_exp([0.0, math.radians(0.1), 0.0]), atol=1e-12)
    assert given.baseline == pytest.approx(true.baseline)
    assert given.left == true.left


def test_an_attitude_sensor_gives_up_in_the_inclinometers_place():
    shaken = seq.mockup(MockupParams(frames=3, jitter_deg=1.0, attitude_noise_deg=0.0))
    for up, pose in zip(shaken.up, shaken.truth, strict=True):
        np.testing.assert_allclose(pose.rotation @ up, [0.0, 0.0, 1.0], atol=1e-12)


# -- truth -------------------------------------------------------------------------------------------------------------


def test_disparity_of_a_flat_bed_is_the_planes_homography(tiny):
    p = flat(tiny)
    rig, left = seq.true_rig(p), seq.body_poses(p)[0] @ seq.mount(p, "left")
    column, row, occluded, depth = true_disparity(height_field(build_scene(p.part(SceneParams))), rig, left).values()
    # plane z = 0 of the bed in the left camera: n . X = h
    n, h = -left.rotation[2], left.translation[2]
    T = rig.T_right_left
    H = rig.right.matrix @ (T.rotation + np.outer(T.translation, n) / h) @ np.linalg.inv(rig.left.matrix)
    rows, cols = np.mgrid[: p.image_height, : p.image_width]
    q = np.stack([cols, rows, np.ones_like(cols)], axis=-1) @ H.T
    seen = occluded != NO_BED
    assert 0.3 < seen.mean() < 0.95
    # 1e-4 px: float32 of a few hundred pixels
    np.testing.assert_allclose(column[seen], (q[..., 0] / q[..., 2] - cols)[seen], atol=1e-4)
    np.testing.assert_allclose(row[seen], (q[..., 1] / q[..., 2] - rows)[seen], atol=1e-4)
    assert not (occluded == HIDDEN).any()
    assert np.isnan(column[~seen]).all()
    assert np.isnan(depth[~seen]).all()
    inside = (cols + column >= 0) & (cols + column <= p.image_width - 1)
    inside &= (rows + row >= 0) & (rows + row <= p.image_height - 1)
    np.testing.assert_array_equal((occluded == SEEN)[seen], inside[seen])
    assert (occluded == OUTSIDE).any()


def test_disparity_obeys_the_epipolar_constraint(tiny, field):
    rig, left = seq.true_rig(tiny), seq.body_poses(tiny)[1] @ seq.mount(tiny, "left")
    column, row, _, _ = true_disparity(field, rig, left).values()
    rows, cols = np.nonzero(np.isfinite(column))
    T = rig.T_right_left
    tx, ty, tz = T.translation
    E = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ T.rotation
    F = np.linalg.inv(rig.right.matrix).T @ E @ np.linalg.inv(rig.left.matrix)
    a = np.stack([cols, rows, np.ones_like(cols)], axis=1).astype(float)
    b = a.copy()
    b[:, 0] += column[rows, cols]
    b[:, 1] += row[rows, cols]
    line = a @ F.T
    distance = (b * line).sum(axis=1) / np.hypot(line[:, 0], line[:, 1])
    assert np.abs(distance).max() < 1e-4


def test_hidden_points_are_those_with_terrain_in_the_way(tiny, field):
    rig, left = seq.true_rig(tiny), seq.body_poses(tiny)[0] @ seq.mount(tiny, "left")
    right = left @ rig.T_right_left.inverse()
    _, _, occluded, depth = true_disparity(field, rig, left).values()
    assert (occluded == HIDDEN).sum() > 10
    checked = 0
    for code in (SEEN, HIDDEN):
        rows, cols = np.nonzero(occluded == code)
        for r, c in list(zip(rows, cols, strict=True))[:: max(1, len(rows) // 150)]:
            point = left.apply(depth[r, c] * rig.left.rays([c, r]).astype(float))
            s = np.linspace(0.0, 1.0, 2000)[:-1, None]
            p = right.translation + s * (point - right.translation)
            on = (np.abs(p[:, 0]) < 0.45) & (p[:, 1] > 0) & (p[:, 1] < 0.8)
            j = np.clip((p[:, 0] - field.x0) / field.cell, 0, field.height.shape[1] - 1.001)
            i = np.clip((field.y0 - p[:, 1]) / field.cell, 0, field.height.shape[0] - 1.001)

            gap = np.where(on, p[:, 2] - map_coordinates(field.height.astype(float), [i, j], order=1), np.inf)
            if code == SEEN:
                assert gap.min() > -2e-5  # depth is stored as float32, and a point on the surface has gap 0
            else:
                # by more than the tolerance somewhere, unless between two steps of the march
                checked += gap.min() < 1e-5
    assert checked > 0.95 * min(150, (occluded == HIDDEN).sum())


@pytest.mark.parametrize("tilt", [0.0, 0.03])
def test_dem_agrees_with_what_the_renderer_hits(tiny, field, tilt):
    rig, left = seq.true_rig(tiny), seq.body_poses(tiny)[0] @ seq.mount(tiny, "left")
    level = rotation_exp([tilt, -tilt, 0.0]) @ level_rotation(left.rotation[2])
    T_bed_world = left @ RigidTransform(level, np.zeros(3)).inverse()
    depth = true_disparity(field, rig, left)["depth"]
    compared = 0
    for r, c in [(60, 20), (70, 48), (50, 60), (75, 80), (45, 30)]:
        point = T_bed_world.inverse().apply(left.apply(float(depth[r, c]) * rig.left.rays([c, r])))
        lattice = {"x0": point[0], "y0": point[1], "cell": 0.001, "rows": 1, "cols": 1}
        elevation, surface = true_dem(field, lattice, T_bed_world)
        np.testing.assert_allclose(T_bed_world.inverse().apply(surface)[0, :2], point[:2], atol=1e-9)
        # depth is float32; a rock's wall (slope up to 5) turns its error sideways into height
        compared += abs(elevation[0, 0] - point[2]) < 1e-6
        assert elevation[0, 0] > point[2] - 1e-6  # the first surface from above is never below a visible one
    assert compared >= 4


def test_dem_at_the_nodes_of_the_bed_is_the_height_itself(field):
    lattice = {"x0": field.x0, "y0": field.y0, "cell": field.cell, "rows": 401, "cols": 451}
    elevation, _ = true_dem(field, lattice, RigidTransform.identity())
    np.testing.assert_allclose(elevation, field.height, atol=1e-7)
    beyond, _ = true_dem(field, lattice | {"x0": 2.0}, RigidTransform.identity())
    assert np.isnan(beyond).all()


def test_seen_is_both_cameras_of_any_listed_pair(tiny, field):
    rig = seq.true_rig(tiny)
    lefts = [b @ seq.mount(tiny, "left") for b in seq.body_poses(tiny)]
    lattice = {"x0": -0.3, "y0": 0.6, "cell": 0.01, "rows": 60, "cols": 60}
    _, points = true_dem(field, lattice, RigidTransform.identity())
    each = [seen_by(field, rig, [pose], points) for pose in lefts]
    assert not seen_by(field, rig, [], points).any()
    np.testing.assert_array_equal(seen_by(field, rig, lefts, points), np.any(each, axis=0))
    assert 0.1 < each[0].mean() < 0.95
    # what is seen projects into both images
    for camera, pose in ((rig.left, lefts[0]), (rig.right, lefts[0] @ rig.T_right_left.inverse())):
        pixels = camera.project(pose.inverse().apply(points[each[0]]))
        assert (pixels >= 0).all()
        assert (pixels <= [camera.width - 1, camera.height - 1]).all()


# -- pictures ----------------------------------------------------------------------------------------------------------


def test_right_picture_is_the_left_one_displaced_by_the_disparity(materialise):

    # near enough, and sharp enough, for the pixel to be finer than the bed's cell
    p = MockupParams(frames=1, bed_width=0.6, bed_length=0.6, image_width=160, image_height=140, focal_length=170.0)
    s = seq.mockup(p)
    left = materialise(s.image(0, "left"))["image"].astype(float)
    right = materialise(s.image(0, "right"))["image"].astype(float)
    truth = materialise(s.truth_disparity(0))
    rows, cols = np.nonzero(truth["occluded"] == SEEN)
    at = [rows + truth["row_disparity"][rows, cols], cols + truth["column_disparity"][rows, cols]]
    there = map_coordinates(right, at, order=1)
    assert np.corrcoef(left[rows, cols], there)[0, 1] > 0.9
    off = map_coordinates(right, [at[0], at[1] + 3.0], order=1)
    assert np.corrcoef(left[rows, cols], off)[0, 1] < 0.7


def test_mask_is_the_bed(tiny, materialise):
    s = seq.mockup(tiny)
    bundle = materialise(s.image(0, "left"))
    bed = materialise(s.truth_disparity(0))["occluded"] != NO_BED
    valid = bundle["valid"] == 1
    assert not (valid & ~bed).any()
    # the mask keeps one pixel away from the edge

    assert (binary_erosion(bed, np.ones((5, 5)), border_value=1) <= valid).all()
    image = bundle["image"]
    background = ~binary_erosion(bed, np.ones((3, 3)), border_value=1) & ~bed
    assert np.median(image[background]) < 20
    assert 70 < image[valid].mean() < 130


def test_bits_depend_on_seed_frame_and_camera_alone(tiny):
    from tests.datasets.conftest import Materialiser

    first, second = Materialiser(), Materialiser()
    s = seq.mockup(tiny)
    images = {k: first(s.image(*k))["image"] for k in [(0, "left"), (0, "right"), (1, "left")]}
    for k in [(1, "left"), (0, "right"), (0, "left")]:  # another order, another process's cache
        np.testing.assert_array_equal(second(s.image(*k))["image"], images[k])
    other = seq.mockup(tiny.model_copy(update={"seed": 2}))
    assert (second(other.image(0, "left"))["image"] != images[(0, "left")]).mean() > 0.5
    still = seq.mockup(tiny.model_copy(update={"forward": 0.0, "sideways": 0.0}))
    noise = second(still.image(0, "left"))["image"].astype(float) - second(still.image(1, "left"))["image"]
    assert 0.8 * math.sqrt(2) * 1.5 < noise.std() < 1.2 * math.sqrt(2) * 1.5


def test_noise_does_not_make_another_bed(tiny):
    quiet, loud = seq.mockup(tiny), seq.mockup(tiny.model_copy(update={"noise": 5.0, "exposure": 0.5}))
    assert quiet.image(0, "left").inputs["scene"] == loud.image(0, "left").inputs["scene"]
    assert quiet.image(0, "left").params != loud.image(0, "left").params


# -- light and terrain -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("azimuth", [-90.0, 0.0, 90.0, 180.0, -60.0])
def test_shadow_is_as_long_as_the_sun_is_low_and_falls_away_from_it(azimuth):
    p = SceneParams(sun_elevation_deg=20.0, sun_azimuth_deg=azimuth)
    height = np.zeros((301, 301), np.float32)
    height[145:156, 145:156] = 0.03
    lit = terrain.sunlit(height, p)
    a = math.radians(azimuth)
    away = np.array([math.cos(a), -math.sin(a)])  # rows, cols: rows grow towards the viewer
    length = 30.0 / math.tan(math.radians(20.0))  # cells, from the top's edge
    # half of the block's width along the ray, as a ray through its middle leaves it
    half = 5.5 / max(abs(away))
    samples = np.arange(0.0, 140.0)
    r, c = np.rint(150 + samples * away[0]).astype(int), np.rint(150 + samples * away[1]).astype(int)
    dark = lit[r, c] < 128
    end = samples[np.flatnonzero(dark).max()]
    assert abs(end - (half + length)) < 3.0
    assert (lit[np.rint(150 - samples * away[0]).astype(int), np.rint(150 - samples * away[1]).astype(int)] > 250).all()


def test_soft_edges_widen_with_the_distance():
    p = SceneParams(sun_azimuth_deg=-90.0)
    widths = []
    for top in (0.01, 0.04):
        height = np.zeros((5, 301), np.float32)
        height[:, :20] = top
        row = terrain.sunlit(height, p)[2].astype(int)
        widths.append(int(((row > 20) & (row < 235)).sum()))
    assert widths[1] > 2 * widths[0] > 0


def test_rocks_and_craters_change_only_their_own_part():
    bare = SceneParams(bed_width=0.3, bed_length=0.3, rocks=0.0, craters=0.0)
    stony = bare.model_copy(update={"rocks": 30.0})
    a, b = build_scene(bare), build_scene(stony)
    rise = b["height"] - a["height"]
    assert rise.min() > -1e-6
    assert 0.0 < (rise > 1e-4).mean() < 0.5
    assert rise.max() < 0.04 * 1.2
    np.testing.assert_array_equal(a["albedo_0"], b["albedo_0"])


@pytest.mark.parametrize("cover", [0.05, 0.2])
def test_rocks_cover_the_stated_share_in_the_stated_sizes(cover: float) -> None:
    p = SceneParams(bed_width=1.2, bed_length=1.2, rock_cover=cover, seed=4)
    stones = np.zeros((1201, 1201), np.float32)
    terrain.add_rocks(stones, p)
    # a hundredth of the bed is a tenth to a half of the widest rock: what one rock more or less at the border changes
    assert (stones > 1e-6).mean() == pytest.approx(cover, rel=0.05, abs=0.004)
    sizes = terrain.cover_sizes(np.random.default_rng(0), cover, 200.0)
    area = 0.25 * np.pi * sizes**2
    q = 10.0 * (1.79 + 0.152 / cover)
    for least in (0.01, 0.02, 0.05):
        share = (np.exp(-q * least) - np.exp(-q * 0.15)) / (np.exp(-q * 0.004) - np.exp(-q * 0.15))
        assert area[sizes > least].sum() / area.sum() == pytest.approx(share, rel=0.02)


def test_a_sloped_bed_is_seen_as_a_level_one_is() -> None:
    p = MockupParams(frames=2, bed_width=0.9, bed_length=1.0, relief=0.0, rocks=0.0, craters=0.0, slope_deg=10.0)
    height = build_scene(p.part(SceneParams))["height"]
    assert height[0, 0] - height[-1, 0] == pytest.approx(math.tan(math.radians(10.0)), rel=1e-5)
    for pose in seq.body_poses(p):
        normal = pose.rotation[:, 2]
        assert math.degrees(math.acos(normal[2])) == pytest.approx(10.0)
        # distance of the body from the plane z = tan(10 degrees) y
        assert normal @ pose.translation == pytest.approx(p.camera_height)


def test_bed_challenges_the_rover():
    from rille.stages.hazard.risk import risk_map

    for kind in ({}, {"seed": 7}):
        p = SceneParams(bed_width=1.0, bed_length=1.0, **kind)
        height = build_scene(p)["height"]
        risk = risk_map(height, np.zeros_like(height), p.cell, seq.mockup(MockupParams(frames=1)).vehicle)["risk"]
        assert 0.05 < (risk == 2).mean() < 0.40


@pytest.mark.parametrize(
    ("given", "cell"),
    [
        ({}, 0.001),
        ({"pitch_deg": 0.0}, 0.001),
        ({"camera_height": 0.45, "baseline": 0.04, "focal_length": 800.0, "pitch_deg": 35.0}, 0.005),
        ({"camera_height": 0.45, "baseline": 0.15, "focal_length": 350.0, "image_height": 300}, 0.002),
    ],
)
def test_cells_are_no_finer_than_the_nearest_depths(given: dict[str, float], cell: float) -> None:
    """Cells of 1 mm of a high camera with a short baseline would leave no ground that is seen well enough."""
    assert seq.mockup(MockupParams.model_validate(given)).defaults["locus.cell_size"] == cell
