"""What moves by itself, in a scene of known shape: ground and a wall behind, before which a board is pushed aside."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.odometry.resection.moving import MovingParams, departures, moving, moving_stage

ROWS, COLS, LEVEL = 96, 160, 2
CAMERA = Camera(150.0, 150.0, 79.5, 47.5, COLS, ROWS)
RIG = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.4, 0.0, 0.0])))
T_B_A = RigidTransform(rotation_exp([0.0, 0.01, 0.002]), np.array([0.02, 0.0, -0.5]))
"""Half a metre ahead, and a turn."""
UNLIKE = tuple(np.random.default_rng(9).normal(128, 20, (2, ROWS // 2**LEVEL, COLS // 2**LEVEL)).astype(np.float32))
"""Two images that show nothing in common."""
BOARD = slice(40, 72), slice(60, 108)
"""Rows and columns of the board, 4 m ahead."""


def depths() -> np.ndarray:
    """Depth (row, col), m: a ground 1.2 m below, a wall at 9 m, and the board."""
    row = np.arange(ROWS, dtype=np.float64)[:, None] - CAMERA.cy
    ground = np.where(row > 0, 1.2 * CAMERA.fy / np.maximum(row, 1e-6), np.inf)
    out = np.minimum(np.broadcast_to(ground, (ROWS, COLS)), 9.0).copy()
    out[BOARD] = 4.0
    return out


def given(
    board_moves: float, *, back: bool = False, noise: float = 0.0, rig: Rig = RIG
) -> tuple[Bundle, Bundle, Bundle]:
    """Disparity of the pair, displacements from image a to b, and the segment's poses.

    The board moves by so many metres to the right; ``back``: the pair is that of image b.
    """
    rng, depth, step = np.random.default_rng(2), depths(), 2**LEVEL
    pixels = np.stack(np.meshgrid(np.arange(COLS), np.arange(ROWS)), -1).reshape(-1, 2).astype(np.float64)
    points = CAMERA.rays(pixels) * depth.reshape(-1, 1)
    right = rig.right.project(rig.T_right_left.apply(points)) - pixels
    right += rng.normal(0, 0.1 * rig.right.fx / CAMERA.fx, pixels.shape)
    names = ("column_disparity", "row_disparity")
    maps = {name: right[:, k].reshape(ROWS, COLS).astype(np.float32) for k, name in enumerate(names)}
    all_matched = np.full((ROWS, COLS), Validity.MATCHED, np.uint8)
    disparity = Bundle({**maps, "validity": all_matched, "backmatch_error": np.zeros((ROWS, COLS), np.float32)}, {})
    aside = np.zeros((ROWS, COLS, 3))
    aside[(*BOARD, 0)] = board_moves
    if back:
        # Image a is that of before: displacements on its grid, of a scene that looks the same from there but for T.
        there = CAMERA.project(T_B_A.inverse().apply(points - aside.reshape(-1, 3)))
        flow = np.full((ROWS // step, COLS // step, 2), np.nan)
        cell = np.rint((there - 1.5) / step).astype(int)
        order = np.argsort(-depth.ravel(), kind="stable")  # nearest last
        for k in order:
            x, y = cell[k]
            if 0 <= y < flow.shape[0] and 0 <= x < flow.shape[1]:
                flow[y, x] = pixels[k] - there[k]
    else:
        shift = CAMERA.project(T_B_A.apply(points + aside.reshape(-1, 3))) - pixels
        flow = shift.reshape(ROWS // step, step, COLS // step, step, 2)[:, step // 2, :, step // 2]
    flow = flow + rng.normal(0, noise, flow.shape)
    valid = np.where(np.isfinite(flow).all(-1), np.uint8(Validity.MATCHED), np.uint8(0))
    motion = Bundle(
        {n: flow[..., k].astype(np.float32) for k, n in enumerate(names)} | {"validity": valid}, {"level": LEVEL}
    )
    poses = np.stack([RigidTransform.identity().matrix34, T_B_A.inverse().matrix34])
    return disparity, motion, Bundle({"poses": poses}, {})


def grey(points: np.ndarray) -> np.ndarray:
    """Texture (...) of the scene at points (..., 3), waves of 1 m and more."""
    rng, out = np.random.default_rng(5), np.full(points.shape[:-1], 128.0)
    for length in np.geomspace(1.0, 4.0, 12):
        out += 12 * np.sin(points @ (rng.normal(0, 2 * np.pi / length, 3)) + rng.uniform(0, 6))
    return out


def views(board_moves: float, *, back: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Left images a and b (row, col) of the coarse grid; of the camera that has no pair what the other one sees."""
    depth, step = depths(), 2**LEVEL
    pixels = np.stack(np.meshgrid(np.arange(COLS), np.arange(ROWS)), -1).reshape(-1, 2).astype(np.float64)
    points = CAMERA.rays(pixels) * depth.reshape(-1, 1)
    aside = np.zeros((ROWS, COLS, 3))
    aside[(*BOARD, 0)] = -board_moves if back else board_moves
    there = (T_B_A.inverse() if back else T_B_A).apply(points + aside.reshape(-1, 3))
    cell, value = np.rint((CAMERA.project(there) - 1.5) / step).astype(int), grey(points)
    own = value.reshape(ROWS // step, step, COLS // step, step).mean((1, 3))
    other, count = np.zeros(own.shape), np.zeros(own.shape)
    for k in np.argsort(-there[:, 2], kind="stable"):
        x, y = cell[k]
        if 0 <= y < other.shape[0] and 0 <= x < other.shape[1]:
            other[y, x], count[y, x] = value[k], 1
    other[count == 0] = 128.0
    return (other, own) if back else (own, other)


def pyramid(image: np.ndarray) -> Bundle:
    """Artifact of a pyramid whose level of the coarse grid is the image."""
    arrays = {f"level_{n}": image.astype(np.float32) for n in range(LEVEL + 1)}
    return Bundle(arrays | {f"valid_{n}": np.ones(image.shape, np.uint8) for n in range(LEVEL + 1)}, {"levels": 3})


def found(
    board_moves: float, *, back: bool = False, noise: float = 0.0, cut: int = 0, seen_to_move: bool = True
) -> np.ndarray:
    """What moves; of images that lack the last ``cut`` rows and columns, which the coarse pixels still cover.

    Unless ``seen_to_move``, the displacements alone say that the board moves.
    """
    pyramids = [pyramid(image) for image in views(board_moves if seen_to_move else 0.0, back=back)]
    disparity, motion, segment = given(board_moves, back=back, noise=noise)
    arrays = {name: np.asarray(array)[: ROWS - cut, : COLS - cut] for name, array in disparity.arrays.items()}
    disparity = Bundle(arrays, {})
    out = moving_stage.run(
        MovingParams(),
        {"back": back},
        {
            "disparity": disparity,
            "rig": Bundle({}, {"rig": RIG.to_dict()}),
            "motion": motion,
            "segment": segment,
            "pyramids": pyramids,
        },
    )
    check_outputs(moving_stage, out)
    assert out.meta["share"] == pytest.approx(out["moving"].mean())
    return np.asarray(out["moving"]) != 0


@pytest.mark.parametrize("back", [False, True])
def test_a_still_scene_has_nothing_that_moves_whatever_the_camera_does(back: bool) -> None:
    assert not found(0.0, back=back, noise=0.8).any()


@pytest.mark.parametrize("cut", [1, 3])
def test_sides_of_the_image_need_be_no_multiples_of_a_coarse_pixel(cut: int) -> None:
    mask, whole = found(0.5, cut=cut), found(0.5)[:-cut, :-cut]
    assert mask.shape == whole.shape
    assert mask.any()
    assert (mask == whole).mean() > 0.99


@pytest.mark.parametrize("back", [False, True])
def test_a_board_that_is_pushed_aside_is_found_and_little_beside_it(back: bool) -> None:
    mask = found(0.5, back=back, noise=0.8)
    board = np.zeros_like(mask)
    board[BOARD] = True
    # What the board hides in the image before or after is not known.
    assert mask[board].mean() > 0.8
    near = np.zeros_like(mask)
    near[BOARD[0].start - 12 : BOARD[0].stop + 12, BOARD[1].start - 36 : BOARD[1].stop + 36] = True
    assert not (mask & ~near).any()


@pytest.mark.parametrize("back", [False, True])
def test_where_the_next_image_shows_the_still_scene_a_displacement_is_wrong(back: bool) -> None:
    """As on tiles and wallpaper, which look the same elsewhere."""
    assert found(0.5, back=back).mean() > 0.05
    assert not found(0.5, back=back, seen_to_move=False).any()


def test_a_departure_is_what_the_distance_leaves_unexplained() -> None:
    """Pixels of the right camera that are finer than the left one's make nothing more certain."""
    finer = Rig(CAMERA, Camera(450.0, 450.0, 238.5, 142.5, 3 * COLS, 3 * ROWS), RIG.T_right_left)
    alike, other = (departures(*given(0.0, rig=rig)[:2], rig, T_B_A, UNLIKE, back=False) for rig in (RIG, finer))
    assert np.nanmedian(alike) < 0
    assert np.nanmedian(other) == pytest.approx(np.nanmedian(alike), abs=0.02)


def test_where_nothing_is_known_nothing_moves() -> None:
    disparity, motion, segment = given(0.5)
    unknown = Bundle({**motion.arrays, "validity": np.zeros_like(motion["validity"])}, motion.meta)
    assert not moving(departures(disparity, unknown, RIG, T_B_A, UNLIKE, back=False)).any()
    dark = Bundle({**disparity.arrays, "validity": np.zeros_like(disparity["validity"])}, {})
    assert not moving(departures(dark, motion, RIG, T_B_A, UNLIKE, back=False)).any()
    lost = Bundle({"poses": np.full((2, 3, 4), np.nan)}, {})
    inputs = {"disparity": disparity, "rig": Bundle({}, {"rig": RIG.to_dict()}), "motion": motion, "segment": lost}
    inputs["pyramids"] = [pyramid(image) for image in UNLIKE]
    assert not np.asarray(moving_stage.run(MovingParams(), {}, inputs)["moving"]).any()
    assert segment["poses"].shape == (2, 3, 4)


def test_a_small_part_is_an_error_of_the_displacements() -> None:
    off = np.zeros((60, 100))
    off[10:13, 10:13] = 9.0
    assert not moving(off).any()
    off[30:40, 50:70] = 9.0
    mask = moving(off)
    assert mask[28:42, 48:72].all()
    assert mask.sum() == 14 * 24
