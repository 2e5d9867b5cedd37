"""Where a vehicle may stand: by hand, against a look at every cell, and never more with a wider margin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vehicles import SHORT

from rille.stages.planning.configuration_space import (
    ACROSS,
    DIRECTED_STEPS,
    STRAIGHT,
    FreePlaces,
    distance,
    widened,
)

CELL = 0.01


@pytest.mark.parametrize("step", [(-1, 0), (0, 1), (-1, 1), (-1, -1)])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), length=st.floats(0, 6), width=st.floats(0, 4))
def test_a_rectangle_covers_what_lies_under_it(step: tuple[int, int], seed: int, length: float, width: float) -> None:
    mask = np.random.default_rng(seed).random((25, 27)) < 0.01
    found = widened(mask, length, width, step)
    unit = math.hypot(*step)
    ahead, aside = np.array(step) / unit, np.array([step[1], -step[0]]) / unit
    for r, c in np.argwhere(mask):
        d = np.stack(np.mgrid[:25, :27], axis=-1) - [r, c]
        under = (np.abs(d @ ahead) <= length) & (np.abs(d @ aside) <= width)
        assert found[under].all()
    far = (np.abs(np.stack(np.mgrid[:25, :27], axis=-1)[:, :, None] - np.argwhere(mask)[None, None]).max(axis=-1,
    initial=0)
           if mask.any() else np.zeros((25, 27, 1)))  # fmt: skip
    inner = np.zeros_like(mask)
    margin = math.ceil(length) + math.ceil(width) + 2
    inner[margin : 25 - margin, margin : 27 - margin] = True
    assert not (found & inner & (far.min(axis=-1) > margin)).any() or not mask.any()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), share=st.sampled_from([0.0, 0.005, 0.05]))
def test_distances_equal_a_look_at_every_cell(seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((30, 31)) < share
    at = np.stack(np.mgrid[:30, :31], axis=-1)
    nearest = [np.hypot(*np.moveaxis(at - cell, -1, 0)) for cell in np.argwhere(mask)]
    expected = CELL * np.minimum.reduce(nearest) if nearest else np.full(mask.shape, np.inf)
    np.testing.assert_allclose(distance(mask, CELL), expected, rtol=1e-6)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 999),
    margins=st.tuples(st.floats(0, 0.05), st.floats(0, 0.05)),
    below=st.sampled_from(["outline", "wheels", "middle"]),
)
def test_a_wider_margin_frees_no_cell(seed: int, margins: tuple[float, float], below: str) -> None:
    rng = np.random.default_rng(seed)
    wheel, body, unknown = (rng.random((30, 34)) < 0.02 for _ in range(3))
    narrow, wide = (
        FreePlaces(wheel, body, SHORT.model_copy(update={"margin": m}), CELL, unknown).ways(below)
        for m in sorted(margins)
    )
    assert ((wide & ~narrow) == 0).all()


def test_where_a_vehicle_may_stand_by_hand() -> None:
    """One hazard to a wheel, wheels 2 cells ahead and behind, 3 to the left and right: four places each way."""
    wheel = np.zeros((21, 21), dtype=bool)
    wheel[10, 10] = True
    vehicle = SHORT.model_copy(update={"wheel_base": 0.04, "track": 0.06})
    none = np.zeros_like(wheel)
    ways = FreePlaces(wheel, none, vehicle, CELL).ways()
    expected = {STRAIGHT: {(8, 7), (8, 13), (12, 7), (12, 13)}, ACROSS: {(7, 8), (13, 8), (7, 12), (13, 12)}}
    for way, cells in expected.items():
        assert {(int(r), int(c)) for r, c in np.argwhere((ways & way) == 0)} == cells
    # a hazard to the whole vehicle closes its own cell alone; the outline is 7 cells long and 8 wide, rounded outwards
    np.testing.assert_array_equal(np.argwhere(FreePlaces(none, wheel, vehicle, CELL).ways() == 0), [[10, 10]])
    wide = np.zeros((41, 41), dtype=bool)
    ways = FreePlaces(wide, wide, vehicle, CELL, np.pad(wheel, 10)).ways("outline")
    inner = (ways & STRAIGHT)[10:31, 10:31]
    assert np.abs(np.argwhere(inner == 0) - 10).max(axis=0).tolist() == [4, 4]
    assert not ways[:4].any()  # off the map


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999), margin=st.sampled_from([0.0, 0.02, 0.045]), cols=st.integers(1, 140))
def test_where_a_vehicle_may_stand_equals_a_look_at_every_wheel(seed: int, margin: float, cols: int) -> None:
    """All three grounds, on narrow and wide maps."""
    rng = np.random.default_rng(seed)
    wheel, body, unknown = (rng.random((23, cols)) < 0.03 for _ in range(3))
    vehicle = SHORT.model_copy(update={"wheel_base": 0.07, "track": 0.05, "margin": margin})
    stand = FreePlaces(wheel, body, vehicle, CELL, unknown)
    near, middle = (distance(hazard, CELL) <= np.float32(margin) for hazard in (wheel, body))
    found = {below: stand.ways(below) for below in ("outline", "wheels", "middle")}
    for bit, dr, dc in DIRECTED_STEPS:
        unit = math.hypot(dr, dc)
        outline = widened(unknown, vehicle.half_length / CELL, vehicle.half_width / CELL, (dr, dc))
        for r in range(23):
            for c in range(cols):
                at = [
                    (r + round((a * dr + b * dc) / unit), c + round((a * dc - b * dr) / unit))
                    for a in (3.5, -3.5)
                    for b in (2.5, -2.5)
                ]
                inside = [(i, j) for i, j in at if 0 <= i < 23 and 0 <= j < cols]
                free = not middle[r, c] and not any(near[w] for w in inside)
                known = len(inside) == 4 and not any(unknown[w] for w in inside)
                assert bool(found["middle"][r, c] & bit) == free
                assert bool(found["wheels"][r, c] & bit) == (free and known)
                assert bool(found["outline"][r, c] & bit) == (free and len(inside) == 4 and not outline[r, c])
