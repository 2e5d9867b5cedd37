"""Corners of a chessboard in images: size of the board, positions, and equal order in both images of a pair.

Detection is OpenCV's: by squares, then by sectors (Duda, Frese 2018) for boards that the first misses. Both are refined
alike: on rendered boards the second alone errs by 0.13 - 0.28 px RMS, refined by 0.02 - 0.05, and on real ones
calibrated parameters are then the same for both. A board may look the same after half a turn, so the order of the
corners is only made equal in the two images of a pair, which is enough for a calibration.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import cv2
import numpy as np

from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import ConfigError, InputError

LEAST_SIDE = 3
"""Fewest inner corners along a side that distinguish a board from clutter."""

QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
THOROUGH = (
    cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE,
    cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE,
)
"""Flags of two attempts by the sectors about each corner, in tenths of a second; squares take hundredths of one."""


def parse_corners(text: str) -> tuple[int, int]:
    """Columns and rows of inner corners from ``9x6``.

    Raises
    ------
    ConfigError
        It is not two numbers of at least ``LEAST_SIDE``.
    """
    columns, _, rows = text.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and min(int(columns), int(rows)) >= LEAST_SIDE):
        remedy = f"give inner corners, e.g. 9x6 for a board of 10 x 7 squares; at least {LEAST_SIDE} each"
        raise ConfigError("RIL-151", f"--corners {text!r} is not COLUMNSxROWS", remedy=remedy)
    return int(columns), int(rows)


def board_points(corners: tuple[int, int], square: float) -> Floats:
    """Corners (n, 3) in the board's frame, metres, z = 0, row by row.

    Raises
    ------
    ConfigError
        ``square`` is not a plausible length in metres.
    """
    # 1 m: larger squares are lengths in millimetres or centimetres.
    if not 0 < square <= 1.0:
        guess = next((square / unit for unit in (100.0, 1000.0) if 0.005 <= square / unit <= 0.2), square / 1000.0)
        hint = f"; did you mean {guess:g}?" if square > 0 else ""
        raise ConfigError("RIL-152", f"--square {square:g} m is no side of a square", remedy=f"give it in metres{hint}")
    rows, columns = np.indices((corners[1], corners[0]))
    return np.stack([square * columns, square * rows, np.zeros(rows.shape)], axis=-1).reshape(-1, 3)


def eight_bit(image: AnyArray) -> Bytes:
    """Grey image as uint8, for the detection; 16-bit ones are stretched to their range."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    low, high = np.percentile(image, [0.1, 99.9])
    scaled = (image.astype(np.float32) - low) * (255.0 / max(float(high - low), 1.0))
    return np.asarray(np.clip(scaled, 0, 255), dtype=np.uint8)


def find_size(images: Iterable[Bytes]) -> tuple[int, int]:
    """Inner corners (more, fewer) of the board in most of the images.

    In a single image a part of the board, or a pattern of the surroundings, may be detected; the same size in most of
    them is no accident.

    Raises
    ------
    InputError
        No board is found, or no two images agree.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    votes: Counter[tuple[int, int]] = Counter()
    for image in images:
        found, points, pattern = cv2.findChessboardCornersSBWithMeta(image, (LEAST_SIDE, LEAST_SIDE), flags)
        if found and min(pattern.shape) >= LEAST_SIDE and is_board(image, points, pattern.shape[::-1]):
            votes[max(pattern.shape), min(pattern.shape)] += 1
    agreed = {size: count for size, count in votes.items() if count > 1}
    if not agreed:
        text = "no chessboard of one size is found in the images"
        remedy = "give its inner corners, e.g. --corners 9x6, and check that all of it is in view and in focus"
        raise InputError("RIL-153", text, remedy=remedy)
    return max(agreed, key=lambda size: (agreed[size], size[0] * size[1]))


def find_corners(image: Bytes, corners: tuple[int, int]) -> Floats | None:
    """All inner corners (n, 2) column, row of a board, row by row; None if they are not all found."""
    attempts = [(cv2.findChessboardCorners, QUICK), *((cv2.findChessboardCornersSB, flags) for flags in THOROUGH)]
    for find, flags in attempts:
        found, points = find(image, corners, flags=flags)
        if found and is_board(image, points, corners):
            return refine(image, points, corners)
    return None


def is_board(image: Bytes, points: AnyArray, corners: tuple[int, int]) -> bool:
    """Whether corners (n, 2) are those of a chessboard: steady steps, and alternating squares."""
    return steady(points, corners) and alternates(image, points, corners)


def steady(points: AnyArray, corners: tuple[int, int]) -> bool:
    """Whether the steps between corners (n, 2) along rows and columns change slowly, as on a plane."""
    grid = np.asarray(points, dtype=np.float64).reshape(corners[1], corners[0], 2)
    for along in (grid, grid.transpose(1, 0, 2)):
        steps = np.diff(along, axis=0)
        length = np.linalg.norm(steps, axis=-1)
        bend = np.linalg.norm(np.diff(steps, axis=0), axis=-1)
        # 0.35: change from one step between corners to the next over their mean length. A board tilted by 45 degrees at
        # three times its width, or seen through a wide lens, has less than 0.2, clutter more than 0.5.
        if (bend > 0.35 * (length[1:] + length[:-1]) / 2).any():
            return False
    return True


def alternates(image: Bytes, points: AnyArray, corners: tuple[int, int]) -> bool:
    """Whether the squares between corners (n, 2) are dark and bright by turns, unlike clutter."""
    grid = np.asarray(points, dtype=np.float32).reshape(corners[1], corners[0], 2)
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    grey = cv2.remap(image, middles[..., 0], middles[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    rows, columns = np.indices(grey.shape)
    even = (rows + columns) % 2 == 0
    bright = even if grey[even].mean() > grey[~even].mean() else ~even
    signed = np.where(bright, grey, -grey)  # the sum of two that touch is bright less dark
    steps = np.concatenate([(signed[1:] + signed[:-1]).ravel(), (signed[:, 1:] + signed[:, :-1]).ravel()])
    # 0.1: difference of adjacent squares over the range of all squares; print under a shadow has more.
    return bool(steps.min() > 0.1 * np.ptp(grey))


def refine(image: Bytes, points: AnyArray, corners: tuple[int, int]) -> Floats:
    """Corners (n, 2) refined by the grey value gradients around them (OpenCV's cornerSubPix)."""
    grid = np.asarray(points).reshape(corners[1], corners[0], 2)
    spacing = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
    # 0.25: half side of the window around a corner over the least spacing of corners, as large as possible without
    # edges of the next corner. Half of it doubles the noise, twice of it reaches the neighbours.
    reach = int(np.clip(0.25 * spacing, 2, 11))
    start = np.array(grid, dtype=np.float32).reshape(-1, 1, 2)
    settled = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4
    refined = cv2.cornerSubPix(image, start, (reach, reach), (-1, -1), settled)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def same_order(left: Floats, right: Floats, corners: tuple[int, int]) -> Floats:
    """The right image's corners (n, 2) in the order of the left one's.

    Of all orders of a grid it is the one by which both patterns are most alike: right if the roll between the cameras
    is less than a quarter of a turn (an eighth for a board with as many rows as columns).
    """
    columns, rows = corners
    grid = right.reshape(rows, columns, 2)
    orders = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if rows == columns:
        orders += [g.transpose(1, 0, 2) for g in orders]
    middle = left - left.mean(0)

    def apart(order: Floats) -> float:
        return float(((order.reshape(-1, 2) - right.mean(0) - middle) ** 2).sum())

    return min(orders, key=apart).reshape(-1, 2).copy()
