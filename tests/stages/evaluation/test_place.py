"""One place in two frames: turn and shift by the ortho images; other places are refused."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import cv2
import numpy as np
import pytest
from raising import raises

from rille.stages.evaluation.place import place
from rille.stages.terrain.relief.grid import Grid


def ground(seed):
    """Grey texture (row, col) of several scales."""
    rng = np.random.default_rng(seed)
    octaves = [cv2.resize(rng.normal(size=(n, n)).astype(np.float32), (480, 480)) for n in (30, 60, 120, 240)]
    return np.clip(128 + 25 * sum(octaves), 0, 255)


def seen(image, matrix, cells=300):
    """What cells (row, col) with this map to x, y show of a ground whose pixels are centimetres."""
    to_pixels = 100.0 * matrix
    grey = cv2.warpAffine(image, to_pixels, (cells, cells), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    known = cv2.warpAffine(np.ones_like(image), to_pixels, (cells, cells), flags=cv2.WARP_INVERSE_MAP) > 0.99
    return Grid(np.where(known, grey, np.nan), matrix)


def in_plane(found):
    """Turn and shift (2, 3) of x and y."""
    return found.pose.matrix34[:2, [0, 1, 3]]


def lattice(cell, turn_deg=0.0, x=0.0, y=0.0):
    c, s = cell * math.cos(math.radians(turn_deg)), cell * math.sin(math.radians(turn_deg))
    return np.array([[c, -s, x], [s, c, y]])


@pytest.mark.parametrize("turn", [0.0, 25.0, 170.0])
@pytest.mark.parametrize("cell", [0.01, 0.013])
def test_turn_and_shift_are_found(turn, cell):
    b = seen(ground(1), lattice(0.01, x=0.9, y=0.8))
    # A's frame: turned and shifted against B's
    motion = lattice(1.0, turn, 2.4, 2.2)
    own = np.array([[cell, 0.0, -140 * cell], [0.0, cell, -150 * cell]])
    there = motion[:, :2] @ own + np.column_stack([np.zeros((2, 2)), motion[:, 2]])
    a = Grid(seen(ground(1), there).values, own)
    placed = place(a, b)
    found, sigma = in_plane(placed), np.sqrt(np.diag(placed.covariance))
    middle = np.array([0.1, -0.05])
    error = (found - motion)[:, :2] @ middle + (found - motion)[:, 2]
    assert np.abs(error).max() < 0.5 * 0.01
    assert np.linalg.det(found[:, :2]) == pytest.approx(1.0)
    assert placed.figures["keypoints"] > 30
    assert np.isinf(sigma[[2, 3, 4]]).all()
    assert np.abs((found - motion)[:, 2]).max() < 5.0 * sigma[:2].max() + 1e-4  # keypoints next to each other err alike


def test_eastings_and_northings_lose_no_digits():
    a, b = seen(ground(1), lattice(0.01)), seen(ground(1), lattice(0.01, x=0.4, y=0.3))
    far = np.array([[0.0, 0.0, 500000.0], [0.0, 0.0, 5200000.0]])
    found = in_plane(place(a, replace(b, matrix=b.matrix + far)))
    assert np.abs(found - far - lattice(1.0)).max() < 0.005


def test_errors_are_least_in_the_middle_of_the_matches_and_grow_with_the_distance_from_them():
    a, b = seen(ground(1), lattice(0.01)), seen(ground(1), lattice(0.01, x=0.4, y=0.3))
    placed = place(replace(a, matrix=a.matrix + np.array([[0, 0, 3000], [0, 0, -8000]])), b)
    kept = np.ix_([0, 1, 5], [0, 1, 5])
    turn = placed.pose.rotation[:2, :2]
    sigmas = []
    for x, y in (turn @ at for at in ((3001.5, -7998.5), (3001.5, -7898.5), (0.0, 0.0))):
        by_pose = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
        sigmas.append(np.sqrt(np.diag(by_pose @ placed.covariance[kept] @ by_pose.T)).max())
    assert 0.0 < sigmas[0] < sigmas[1] / 20 < sigmas[2] / 1000


def test_a_much_coarser_image_in_other_units_is_compared_at_its_own_cells():
    a = seen(ground(1), lattice(0.01))
    fine = seen(ground(1), lattice(0.01), cells=480).values
    coarse = fine.reshape(160, 3, 160, 3).mean(axis=(1, 3))
    b = Grid(40.0 * coarse + 7000.0, lattice(0.03, x=0.01, y=0.01))
    assert np.abs(in_plane(place(a, b)) - lattice(1.0)).max() < 0.01


def test_an_image_that_fits_two_places_is_refused():
    a = seen(ground(1), lattice(0.01), cells=150)
    b = seen(ground(1), lattice(0.01), cells=150)
    twice = np.concatenate([b.values, b.values], axis=1)
    # Of twins a keypoint's second best match is as good as its best: noise tells half of them apart.
    twice[:, :150] += np.random.default_rng(4).normal(0, 12, (150, 150)) * (np.indices((150, 150))[0] % 50 < 25)
    twice[:, 150:] += np.random.default_rng(5).normal(0, 12, (150, 150)) * (np.indices((150, 150))[0] % 50 >= 25)
    with raises("RIL-841", "two places", "--near"):
        place(a, Grid(twice, b.matrix))


def test_an_image_that_is_distorted_by_some_cells_fits_no_second_place():
    a = seen(ground(1), lattice(0.01))
    y, x = np.indices(a.values.shape, np.float32)
    for amplitude, apart in ((2.0, False), (5.0, True)):
        waves = x + np.float32(amplitude) * np.sin(y * np.float32(2 * math.pi / 60))
        b = Grid(cv2.remap(a.values, waves, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), a.matrix)
        with raises("RIL-841", "two places") if apart else nullcontext():
            place(a, b)


def test_another_place_is_refused():
    a, b = (seen(ground(seed), lattice(0.01)) for seed in (1, 2))
    with raises("RIL-327", "one place"):
        place(a, b)
    place(a, Grid(a.values, lattice(0.0102)))
    with raises("RIL-327", "scale of 1.050"):
        place(a, Grid(a.values, lattice(0.0105)))
    blank = Grid(np.full((50, 50), 90.0), lattice(0.01))
    with raises("RIL-327", "0 keypoints"):
        place(blank, b)
