"""Places seen again: a rendered loop whose motion is known, alike pairs that are no loop, candidates block by block."""

import cv2
import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp, rotation_log
from rille.stages.imaging.features import extract
from rille.stages.odometry.loops import CANDIDATES, LoopsParams, loops_stage, similarities, words
from rille.stages.odometry.resection.loop import loop_stage

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
RIG = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), [-0.12, 0.0, 0.0]))
PX_PER_M = 250.0
WALL = RigidTransform(rotation_exp([0.25, 0.1, 0.0]), [-1.6, -1.2, 1.8])
"""Pose of a wall, whose x and y are columns and rows of its picture, in the world."""
AGAIN = RigidTransform(rotation_exp([0.02, -0.06, 0.05]), [0.18, -0.05, 0.12])


def picture(seed: int) -> np.ndarray:
    """Noise of several scales (800, 800), 0..255."""
    rng = np.random.default_rng(seed)
    field = sum(s * cv2.GaussianBlur(rng.standard_normal((800, 800)), (0, 0), s) for s in (1.5, 3.0, 6.0, 12.0))
    return np.clip(128 + 45 * field / field.std(), 0, 255).astype(np.uint8)


def pair(image: np.ndarray, T_world_left: RigidTransform, size: float = 1.0) -> tuple[Bundle, Bundle]:
    """Features and exact disparity of a pair before the wall; ``size``: wall and way are so many times as large."""
    T = T_world_left.inverse() @ WALL
    onto = CAMERA.matrix @ np.column_stack([T.rotation[:, :2] / PX_PER_M, T.translation])
    seen = cv2.warpPerspective(image, onto, (CAMERA.width, CAMERA.height), flags=cv2.INTER_AREA)
    noise = np.random.default_rng(int(1e6 * abs(T.translation[0]))).standard_normal(seen.shape)
    features = extract(np.clip(seen + noise, 0, 255).astype(np.uint8), np.ones(seen.shape, np.uint8))
    rays = CAMERA.rays(np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), -1))
    normal = T.rotation[:, 2]
    depth = size * (normal @ T.translation) / (rays @ normal)
    disparity = {
        "column_disparity": (-CAMERA.fx * RIG.baseline / depth).astype(np.float32),
        "row_disparity": np.zeros(depth.shape, np.float32),
        "validity": np.full(depth.shape, Validity.MATCHED, np.uint8),
    }
    return features, Bundle(disparity, {})


def compared(*pairs: tuple[Bundle, Bundle]) -> Bundle:
    """Result of the stage: the first pair against the others."""
    rigs = [Bundle({}, {"rig": RIG.to_dict()})] * len(pairs)
    inputs = {"features": [f for f, _ in pairs], "disparities": [d for _, d in pairs], "rigs": rigs}
    return loop_stage.run(NoParams(), {"pairs": list(range(len(pairs) - 1, -1, -1))}, inputs)


FIRST = pair(picture(1), RigidTransform(np.eye(3), np.zeros(3)))


def test_a_loop_has_the_motion_that_it_was_rendered_with() -> None:
    out, again = (compared(pair(picture(1), AGAIN), FIRST, pair(picture(2), AGAIN)) for _ in range(2))
    check_outputs(loop_stage, out)
    assert out.meta == again.meta
    (factor,) = out.meta["factors"]
    assert (factor["from"], factor["to"]) == (1, 2)
    pose, covariance = RigidTransform.from_matrix(factor["pose"]), np.reshape(factor["covariance"], (6, 6))
    off = np.concatenate([pose.translation - AGAIN.translation, rotation_log(pose.rotation @ AGAIN.rotation.T)])
    assert np.linalg.norm(off[:3]) < 2e-3
    assert np.linalg.norm(off[3:]) < 2e-3
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert off @ np.linalg.solve(covariance, off) < 22.5  # 99.9 % of six degrees of freedom


def test_a_part_that_is_repeated_elsewhere_is_no_loop() -> None:
    # A poster that hangs at two places: all that matches agrees, in one part of the image.
    other = picture(2)
    other[330:480, 330:480] = picture(1)[330:480, 330:480]
    out = compared(pair(other, AGAIN), FIRST)
    assert not out.meta["factors"]
    assert [r["from"] for r in out.meta["refused"]] == [0]
    assert "parts of the image" in out.meta["refused"][0]["reason"]


@pytest.mark.parametrize(("size", "why"), [(1.3, "times as far"), (1.08, "both directions depart")])
def test_the_same_picture_at_another_size_is_no_loop(size: float, why: str) -> None:
    out = compared(pair(picture(1), AGAIN, size=size), FIRST)
    assert not out.meta["factors"]
    assert why in out.meta["refused"][0]["reason"]


def test_both_directions_are_joined_and_as_uncertain_as_they_disagree() -> None:
    spread = []
    for size in (1.0, 1.05):
        again = pair(picture(1), AGAIN, size=size)
        there, back = (compared(*pairs).meta["factors"][0] for pairs in ((again, FIRST), (FIRST, again)))
        around = RigidTransform.from_matrix(there["pose"]) @ RigidTransform.from_matrix(back["pose"])
        assert np.linalg.norm(around.translation) < 1e-4
        spread.append(np.sqrt(there["covariance"][0]))
    assert spread[1] > 2 * spread[0]


def test_a_pattern_without_end_is_no_loop() -> None:
    tile = picture(3)[:50, :50]
    tiled = np.tile(tile, (16, 16))
    there = RigidTransform(np.eye(3), [0.4, 0.0, 0.0])  # two tiles aside: the same image
    assert not compared(pair(tiled, there), pair(tiled, RigidTransform(np.eye(3), np.zeros(3)))).meta["factors"]


def blocks(images: list[Bundle], sizes: list[int], apart: int) -> list[list[int]]:
    """Candidates of all pairs, indexed in blocks of these sizes."""
    made: list[Bundle] = []
    for start, size in zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True):
        inputs = {"features": images[start : start + size], "earlier": list(made)}
        numbers = list(range(int(start), int(start) + size))
        made.append(loops_stage.run(LoopsParams(apart=apart), {"pairs": numbers}, inputs))
        check_outputs(loops_stage, made[-1])
    return [row for block in made for row in block.meta["candidates"]]


def test_candidates_are_earlier_pairs_of_the_same_place_however_they_are_cut_into_blocks() -> None:
    walls = [picture(k) for k in range(8)]
    there = [(w, RigidTransform(np.eye(3), [0.02 * w, 0.0, 0.0])) for w in range(8)]
    back = [(w, AGAIN) for w in (2, 5)]
    images = [pair(walls[w], T)[0] for w, T in [*there, *back]]
    whole = blocks(images, [10], apart=3)
    assert whole == blocks(images, [4, 5, 1], apart=3)
    assert whole[:8] == blocks(images[:8], [8], apart=3)
    assert all(k - i >= 3 for k, row in enumerate(whole) for i in row)
    assert all(len(row) <= CANDIDATES for row in whole)
    of = [words(np.asarray(image["descriptors"])) for image in images]
    alike = similarities(of, of)
    np.testing.assert_allclose(np.diag(alike), 1.0)
    assert alike[8, :8].argmax() == 2
    assert alike[9, :8].argmax() == 5
    assert 2 in whole[8]
    assert 5 in whole[9]


def test_an_image_without_features_has_no_candidates() -> None:
    blank = extract(np.full((240, 320), 80, np.uint8), np.ones((240, 320), np.uint8))
    assert blocks([blank] * 5, [5], apart=2) == [[]] * 5


@pytest.mark.parametrize("count", [1, 2])
def test_pairs_that_match_little_are_not_worth_a_word(count: int) -> None:
    out = compared(pair(picture(1), AGAIN), *[pair(picture(7), AGAIN)] * count)
    assert out.meta == {"factors": [], "refused": []}
