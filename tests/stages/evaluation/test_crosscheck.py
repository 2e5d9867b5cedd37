"""Crosscheck: an analytic scene is recovered in metres, masks hold, and two runs give the same bytes."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.evaluation import crosscheck
from rille.stages.evaluation.crosscheck import (
    OVERLAP,
    CrosscheckParams,
    colmap_rig,
    crosscheck_stage,
    image_pairs,
    match,
    windows,
)
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.rigid import angles_between, posed
from rille.stages.imaging.features import extract

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
BASELINE = 0.2
RIG = Rig(CAMERA, CAMERA, RigidTransform(rotation_exp([0.0, 0.01, 0.005]), [-BASELINE, 0.002, 0.0]))
PARAMS = CrosscheckParams()


def board() -> list[tuple[np.ndarray, np.ndarray]]:
    """Textured squares that face the camera at rest: (corner and edges (3, 3), texture), far ones first."""
    rng = np.random.default_rng(0)
    squares = []
    for depth in np.sort(rng.uniform(2.0, 6.0, 130))[::-1]:
        texture = cv2.GaussianBlur(rng.normal(size=(48, 48)), (0, 0), 2.5)
        texture = np.clip(128 + 45 * texture / texture.std(), 0, 255).astype(np.float32)
        side = 0.16 * depth
        corner = np.array([rng.uniform(-0.65, 0.65) * depth, rng.uniform(-0.5, 0.5) * depth, depth])
        # texel (u, v) lies at corner + side / 47 * (u, v)
        squares.append((np.column_stack([[side / 47, 0, 0], [0, side / 47, 0], corner]), texture))
    return squares


SQUARES = board()


def render(T_camera_scene: RigidTransform) -> np.ndarray:
    """Image (240, 320) uint8: each plane by its exact homography."""
    out = np.full((240, 320), 90.0, np.float32)
    for plane, texture in SQUARES:
        H = CAMERA.matrix @ (T_camera_scene.rotation @ plane + np.outer(T_camera_scene.translation, [0, 0, 1]))
        drawn = cv2.warpPerspective(texture, H, (320, 240), flags=cv2.INTER_LINEAR, borderValue=-1e4)
        out = np.where(drawn >= 0, drawn, out)
    return np.rint(out).astype(np.uint8)


def drive(n: int) -> list[RigidTransform]:
    """T_scene_left: 0.1 m forward and 0.03 m aside a frame, turning."""
    return [RigidTransform(rotation_exp([0.0, 0.01 * k, 0.004 * k]), [0.03 * k, 0.0, 0.1 * k]) for k in range(n)]


def bundle(image: np.ndarray, valid: np.ndarray | None = None) -> Bundle:
    """Features of an image."""
    return extract(image, np.ones(image.shape, np.uint8) if valid is None else valid)


@pytest.fixture(scope="module")
def scene() -> tuple[list[RigidTransform], dict[str, list[Bundle]]]:
    poses = drive(4)
    left = [bundle(render(T.inverse())) for T in poses]
    right = [bundle(render(RIG.T_right_left @ T.inverse())) for T in poses]
    return poses, {"left": left, "right": right}


def run(inputs: Any, frames: list[int], params: CrosscheckParams = PARAMS) -> Bundle:
    out = crosscheck_stage.run(params, {"frames": frames, "rig": RIG.to_dict()}, inputs)
    check_outputs(crosscheck_stage, out)
    return out


def test_poses_are_metric_and_repeat_bit_by_bit(scene: Any) -> None:
    poses, inputs = scene
    out, again = run(inputs, [3, 4, 5, 6]), run(inputs, [3, 4, 5, 6])
    for name, array in out.arrays.items():
        np.testing.assert_array_equal(array, again[name])
    assert out.meta == again.meta
    assert posed(out["poses"]).all()
    assert out["line_distance"].max() < 0.5
    np.testing.assert_allclose(out["poses"][0], np.eye(3, 4), atol=1e-12)
    true = np.array([(poses[0].inverse() @ T).matrix34 for T in poses])
    # the rig sees depth at 4 m to 4^2 / (300 * 0.2) m a pixel: 27 mm for features of 0.1 px, 1.5 mm over 300 of them
    assert np.linalg.norm(out["poses"][:, :, 3] - true[:, :, 3], axis=1).max() < 2 * 1.5e-3
    # 0.1 px are 0.02 degrees of one feature
    assert np.degrees(angles_between(out["poses"], true)).max() < 2 * 0.02


@pytest.mark.parametrize(
    "camera",
    [
        Camera(300.0, 300.0, -20.5, 119.5, 140, 240),  # its images were cut out of larger ones
        Camera(300.0, 300.0, 159.5, 250.5, 140, 240),
        Camera(4000.0, 4000.0, 159.5, 119.5, 320, 240),
    ],
)
def test_cameras_that_colmap_registers_no_images_of(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), [-max(0.3, camera.fx / 4000), 0.0, 0.0]))
    seen_at = rng.uniform([0, 0], [camera.width, camera.height], (400, 2))
    points = camera.rays(seen_at) * rng.uniform(3.0, 9.0, 400)[:, None] * max(1.0, camera.fx / 800)
    descriptors = rng.uniform(0, 1, (400, 128)).astype(np.float32) ** 3
    descriptors *= 512 / np.linalg.norm(descriptors, axis=1, keepdims=True)
    images: dict[str, list[Bundle]] = {"left": [], "right": []}
    poses = [RigidTransform(np.eye(3), [0.05 * k, 0.0, 0.1 * k]) for k in range(3)]
    for pose in poses:
        for side, T in (("left", RigidTransform.identity()), ("right", rig.T_right_left)):
            at = camera.project((T @ pose.inverse()).apply(points))
            inside = ((at > 0) & (at < [camera.width, camera.height])).all(axis=1)
            found = {"points": (at[inside] + 0.5).astype(np.float32), "descriptors": descriptors[inside]}
            images[side].append(Bundle(found, {}))
    out = crosscheck_stage.run(PARAMS, {"frames": [0, 1, 2], "rig": rig.to_dict()}, images)
    true = np.array([T.matrix34 for T in poses])
    assert np.linalg.norm(out["poses"][:, :, 3] - true[:, :, 3], axis=1).max() < 1e-3


def test_a_wrong_rig_is_held_not_repaired(scene: Any) -> None:
    """Half a degree of roll puts rows of the right camera off by 1.3 px at the rim: it must stay in the residuals."""
    inputs = {side: bundles[:3] for side, bundles in scene[1].items()}
    wrong = Rig(CAMERA, CAMERA, RigidTransform(rotation_exp([0.0, 0.0, 0.009]), np.zeros(3)) @ RIG.T_right_left)
    good, bad = (
        crosscheck_stage.run(PARAMS, {"frames": [0, 1, 2], "rig": rig.to_dict()}, inputs).meta["reprojection_px"]
        for rig in (RIG, wrong)
    )
    assert good < 0.5
    assert bad > 1.5 * good


def test_without_a_stereo_pair_nothing_has_a_scale(scene: Any) -> None:
    """The left images alone would give a model of any size."""
    _, images = scene
    covered = [bundle(np.zeros((240, 320), np.uint8))] * len(images["right"])
    found = run({"left": images["left"], "right": covered}, [0, 1, 2, 3])
    assert not posed(found["poses"]).any()
    assert "left and right start no model" in found.meta["reason"]


def test_a_frame_that_fits_nowhere_is_listed_and_the_rest_stays(scene: Any) -> None:
    _, inputs = scene
    noise = np.random.default_rng(1).integers(0, 255, (2, 240, 320), dtype=np.uint8)
    left, right = list(inputs["left"]), list(inputs["right"])
    left[2], right[2] = bundle(noise[0]), bundle(noise[1])
    out = run({"left": left, "right": right}, [0, 1, 2, 3])
    assert posed(out["poses"]).tolist() == [True, True, False, True]
    assert np.isnan(out["line_distance"][2])


def test_an_image_that_has_slipped_in_its_row_is_far_from_the_epipolar_lines(scene: Any) -> None:
    """By 6 pixels; the frame's pose is right all the same, by the other images."""
    poses, inputs = scene
    right = list(inputs["right"])
    right[2] = bundle(np.roll(render(RIG.T_right_left @ poses[2].inverse()), 6, axis=0))
    out = run({"left": inputs["left"], "right": right}, [0, 1, 2, 3])
    assert out["line_distance"][2] == pytest.approx(6.0, abs=0.3)
    assert np.delete(out["line_distance"], 2).max() < 0.5


@pytest.mark.parametrize("kind", ["blank", "noise"])
def test_a_window_without_a_model_is_a_fact(kind: str) -> None:
    rng = np.random.default_rng(2)
    images = [
        bundle(
            np.full((240, 320), 80, np.uint8) if kind == "blank" else rng.integers(0, 255, (240, 320), dtype=np.uint8)
        )
        for _ in range(4)
    ]
    out = run({"left": images[:2], "right": images[2:]}, [0, 1])
    assert np.isnan(out["poses"]).all()
    assert "no two images" in out.meta["reason"]
    assert out.meta["reprojection_px"] is None


def test_matching_equals_colmap_s_own_matcher(scene: Any) -> None:
    a, b = (np.asarray(image["descriptors"]) for image in scene[1]["left"][:2])
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, 1
    matcher = pycolmap.FeatureMatcher.create(options, pycolmap.Device.cpu)
    kind = pycolmap.FeatureExtractorType.SIFT
    keypoints = [pycolmap.FeatureKeypoints([pycolmap.FeatureKeypoint()] * len(x)) for x in (a, b)]
    native = [pycolmap.FeatureDescriptors(type=kind, data=x) for x in (a, b)]
    expected = matcher.match(keypoints[0], native[0], keypoints[1], native[1])
    assert len(expected) > 50
    ours = match(a.astype(np.float32), b.astype(np.float32))
    assert {tuple(row) for row in ours.tolist()} == {tuple(row) for row in expected.tolist()}


def test_matching_of_nothing_and_of_one() -> None:
    nothing, one = np.zeros((0, 128), np.float32), np.full((1, 128), 512 / np.sqrt(128), np.float32)
    assert match(nothing, one).shape == (0, 2)
    assert match(one, one).tolist() == [[0, 0]]


def test_the_principal_point_is_counted_as_positions_are() -> None:
    (camera, _), _ = colmap_rig(RIG)
    assert (camera.principal_point_x, camera.principal_point_y) == (CAMERA.cx + 0.5, CAMERA.cy + 0.5)
    np.testing.assert_allclose(camera.img_from_cam(np.array([0.0, 0.0, 1.0])), [CAMERA.cx + 0.5, CAMERA.cy + 0.5])


def test_pairs_by_hand() -> None:
    assert image_pairs(3) == [(1, 2), (1, 3), (2, 4), (1, 5), (2, 6), (3, 4), (3, 5), (4, 6), (5, 6)]
    assert (1, 5) in image_pairs(4)
    assert (1, 7) not in image_pairs(4)


@given(st.integers(1, 200), st.integers(OVERLAP + 1, 40))
def test_windows_cover_all_frames_and_share_enough(n: int, window: int) -> None:
    frames = list(range(5, 5 + n))
    parts = windows(frames, CrosscheckParams(window=window))
    assert sorted({f for part in parts for f in part}) == frames
    assert max(len(part) for part in parts) <= window
    for a, b in itertools.pairwise(parts):
        assert a[-OVERLAP:] == b[:OVERLAP]
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.data
@pytest.mark.slow
def test_devon_island_is_registered_throughout(data_dir: Any) -> None:
    camera = Camera(969.0, 969.0, 635.139, 463.537, 1280, 960)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), [-0.234, 0.0, 0.0]))
    inputs = {}
    for side in ("left", "right"):
        files = sorted((data_dir / "devon_island" / side).iterdir())
        inputs[side] = [bundle(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in files]
    n = len(inputs["left"])
    out = crosscheck_stage.run(PARAMS, {"frames": list(range(n)), "rig": rig.to_dict()}, inputs)
    assert posed(out["poses"]).sum() == n == 10


@pytest.mark.parametrize(("posed_from", "tried"), [(5, [1, 3, 5]), (1, [1]), (7, [1, 3, 5])])
def test_starts_that_pose_no_other_frame_end_no_search(monkeypatch, posed_from, tried):
    """Left images 1, 3, 5 of three frames, of fewer and fewer near points; from one of them all frames are posed."""
    asked = list[int]()

    def mapped(database: Any, start: tuple[int, int]) -> list[Any]:
        asked.append(start[0])
        frames = [1, 2, 3] if start[0] == posed_from else [(start[0] + 1) // 2]
        return [SimpleNamespace(reg_frame_ids=lambda: frames, num_reg_frames=lambda: len(frames))]

    monkeypatch.setattr(crosscheck, "_map", mapped)
    assert len(crosscheck._models(None, {1: 90, 3: 80, 5: 70})) == len(tried)
    assert asked == tried
