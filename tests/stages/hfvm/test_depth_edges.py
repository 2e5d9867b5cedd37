"""Placement of depth edges: the kernel against its equation, and an outline that features had put too far out."""

import numpy as np
import pytest

from rille.stages.hfvm.image import compact
from rille.stages.hfvm.native.problem import LevelPair, pack_map, unpacked
from rille.stages.hfvm.native.reference import (
    EDGE_GREY,
    EDGE_REACH_PX,
    MAX_EDGE_DISTANCE,
    MIN_APART_PX,
    OTHER_FACTOR,
    OWN_FACTOR,
)
from rille.stages.hfvm.native.reference import EDGE_RADIUS_PX as RADIUS
from rille.stages.hfvm.native.solver import solver

ROWS, COLS = 40, 60

BETTER = OWN_FACTOR, OTHER_FACTOR
SIDES = (1, 0), (-1, 0), (0, 1), (0, -1)
AROUND = tuple((j * k, i * k) for k in (EDGE_REACH_PX // 2, EDGE_REACH_PX) for j, i in SIDES)


def place(left, right, maps, wanted, near_sign):
    """Displacements with depth edges placed anew."""
    words = LevelPair(compact(left), compact(right), np.zeros((3, 3)), 0.0)
    grey = np.rint(left).astype(np.int16)
    return unpacked(solver.edges(words, grey, pack_map(*maps), wanted.view(np.uint8), int(near_sign)))


def by_the_equation(left, right, u, v, wanted, near_sign):
    """C(d) of every candidate, pixel by pixel."""
    out = u.copy(), v.copy()
    rows, cols = u.shape
    a, b = (compact(side).view(np.uint8).reshape(*side.shape, 8).astype(int) for side in (left, right))
    grey = np.rint(left).astype(int)
    offsets = np.arange(-RADIUS, RADIUS + 1)
    for y in range(EDGE_REACH_PX, rows - EDGE_REACH_PX):
        for x in range(EDGE_REACH_PX, cols - EDGE_REACH_PX):
            tried = [(int(u[y, x]), int(v[y, x]))]
            for j, i in AROUND:
                one = int(u[y + j, x + i]), int(v[y + j, x + i])
                if all(max(abs(one[0] - p), abs(one[1] - q)) >= MIN_APART_PX for p, q in tried):
                    tried.append(one)
            if len(tried) == 1 or not wanted[y, x]:
                continue
            costs = []
            for du, dv in tried:
                q, p = y + dv + offsets[:, None], x + du + offsets
                if q.min() < 0 or p.min() < 0 or q.max() >= b.shape[0] or p.max() >= b.shape[1]:
                    costs.append(None)
                    continue
                window = np.ix_(y + offsets, x + offsets)
                weight = np.maximum(EDGE_GREY - abs(grey[window] - grey[y, x]), 0)
                costs.append(int((weight * np.minimum(abs(a[window] - b[q, p]).sum(axis=-1), MAX_EDGE_DISTANCE)).sum()))
            if costs[0] is None:
                continue
            chosen, best = 0, BETTER[0] * costs[0]
            for k, cost in enumerate(costs[1:], 1):
                farther = near_sign * (tried[k][0] - tried[0][0]) < 0
                if cost is not None and BETTER[not farther] * cost < best:
                    chosen, best = k, BETTER[not farther] * cost
            out[0][y, x], out[1][y, x] = tried[chosen]
    return out


@pytest.mark.parametrize("near_sign", [-1.0, 1.0, 0.0])
def test_kernel_and_equation_agree(near_sign):
    rng = np.random.default_rng(1)
    scene = rng.uniform(0, 60, (ROWS + 20, COLS + 20)).astype(np.float32)
    left, right = (
        scene[4 : 4 + ROWS, 8 : 8 + COLS],
        scene[: ROWS + 9, : COLS + 4] + rng.normal(0, 1, (ROWS + 9, COLS + 4)),
    )
    left, right = np.ascontiguousarray(left), right.astype(np.float32)
    u = np.repeat(rng.choice([2, 5, 8], (ROWS // 4, COLS // 4)), 4, axis=0).repeat(4, axis=1).astype(np.int16)
    v = rng.integers(4, 7, (ROWS, COLS)).astype(np.int16)
    wanted = rng.random((ROWS, COLS)) < 0.9
    found = place(left, right, (u, v), wanted, near_sign)
    expected = by_the_equation(left, right, u, v, wanted, near_sign)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])
    assert (found[0] != u).any(), "something was decided anew"


def pair(near=-9, far=-2):
    """A textured square before a textured wall: left and right image, and the true columns of displacement."""
    rng = np.random.default_rng(2)
    wall = (60 + 30 * rng.random((ROWS, COLS + 20))).astype(np.float32)
    square = (150 + 60 * rng.random((16, 20))).astype(np.float32)
    left, right = wall[:, :COLS].copy(), wall[:, -far : COLS - far].copy()
    truth = np.full((ROWS, COLS), far, np.int16)
    left[12:28, 24:44], right[12:28, 24 + near : 44 + near] = square, square
    truth[12:28, 24:44] = near
    return left, right, truth


def test_an_outline_that_was_too_wide_is_put_in_its_place():
    left, right, truth = pair()
    wide = truth.copy()
    wide[9:31, 21:47] = truth[15, 30]
    nothing = np.zeros_like(truth)
    found, rows = place(left, right, (wide, nothing), np.ones(truth.shape, bool), -1.0)
    # Beside the square's left side the right image hides the wall, so that there is no evidence for it.
    seen = np.ones(truth.shape, bool)
    seen[12:28, 24 - 7 : 24] = False
    assert np.mean((wide != truth)[seen]) > 0.08
    assert np.mean((found != truth)[seen]) < 0.005
    assert not rows.any()


def test_without_evidence_nothing_changes():
    _, _, truth = pair()
    flat = np.full(truth.shape, 90, np.float32)
    found = place(flat, flat, (truth, np.zeros_like(truth)), np.ones(truth.shape, bool), -1.0)
    np.testing.assert_array_equal(found[0], truth)
