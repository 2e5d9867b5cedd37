"""Ground behind stones lies below the lines of sight over it: by hand, and against all lines of sight of relief."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.occlusion_bounds import OcclusionBoundsParams, ceiling, occlusion_bounds_stage

LATTICE = Lattice.snap((-0.2, 0.2, 0.0, 0.8), 0.004)
X, Y = LATTICE.xy()[..., 0], LATTICE.xy()[..., 1]
HEIGHT = 0.165
CENTRE = np.array([0.0, 0.0, HEIGHT])
WALL, TOP = (0.30, 0.32), 0.018
SHADOW = WALL[1] * HEIGHT / (HEIGHT - TOP)


def wall() -> tuple[np.ndarray, np.ndarray]:
    """A wall across level ground: what there is, and what the camera sees of it."""
    there = np.where((WALL[0] <= Y) & (WALL[1] >= Y), TOP, 0.0).astype(np.float32)
    far = np.hypot(X, Y)
    hidden = (WALL[1] < Y) & (far < SHADOW * far / np.maximum(Y, 1e-9))
    return there, np.where(hidden, np.float32(np.nan), there)


def test_the_shadow_of_a_wall_lies_below_the_line_over_its_edge() -> None:
    there, seen = wall()
    top = ceiling(seen, LATTICE, CENTRE)
    shadow = np.isnan(seen) & (np.abs(X) < 0.5 * Y)  # whose ends are on the map
    assert shadow.sum() > 500
    assert np.isfinite(top[shadow]).all()
    line = HEIGHT * (1.0 - Y / SHADOW)
    assert (top[shadow] >= there[shadow]).all()
    assert top[shadow] == pytest.approx(line[shadow], abs=HEIGHT * 2 * LATTICE.cell / SHADOW)
    assert np.isnan(top[np.isfinite(seen)]).all(), "what was seen needs no bound"


def test_where_nothing_was_seen_beyond_there_is_no_bound() -> None:
    _, seen = wall()
    seen[WALL[1] < Y] = np.nan
    assert np.isnan(ceiling(seen, LATTICE, CENTRE)[WALL[1] < Y]).all()


def relief(rng: np.random.Generator) -> np.ndarray:
    """Smooth stones on level ground."""
    z = np.zeros(LATTICE.shape)
    for x, y in rng.uniform((-0.15, 0.1), (0.15, 0.6), (12, 2)):
        z += rng.uniform(0.005, 0.04) * np.exp(-((X - x) ** 2 + (Y - y) ** 2) / rng.uniform(0.012, 0.03) ** 2)
    return z


def seen_from(z: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Cells whose line to the camera passes above all others, at every tenth of a cell."""
    part = np.linspace(0.0, 1.0, 2000)[:-1]
    row, col = LATTICE.index(centre[:2])
    rows, cols = np.indices(z.shape)
    out = np.ones(z.shape, bool)
    for t in part:
        i, j = np.rint(row + t * (rows - row)).astype(int), np.rint(col + t * (cols - col)).astype(int)
        inside = (i >= 0) & (j >= 0) & (i < z.shape[0]) & (j < z.shape[1]) & ((i != rows) | (j != cols))
        i, j = np.where(inside, i, 0), np.where(inside, j, 0)
        out &= ~inside | (z[i, j] <= centre[2] + t * (z - centre[2]) + 1e-9)
    return out


@pytest.mark.parametrize("seed", range(4))
def test_nothing_that_is_hidden_stands_above_its_bound(seed: int) -> None:
    z = relief(np.random.default_rng(seed))
    seen = np.where(seen_from(z, CENTRE), z, np.nan).astype(np.float32)
    top = ceiling(seen, LATTICE, CENTRE)
    bounded = np.isfinite(top)
    assert bounded.sum() > 300
    # a line of sight to the middle of a cell passes up to half a cell beside that of another one
    slack = LATTICE.cell * np.hypot(*np.gradient(z, LATTICE.cell)).max()
    assert (top[bounded] >= z[bounded] - slack).all()
    assert np.median((top - z)[bounded]) < 0.02


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31))
def test_raising_what_was_seen_never_lowers_a_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, seen = wall()
    before = ceiling(seen, LATTICE, CENTRE)
    raised = seen + rng.uniform(0.0, 0.01, seen.shape).astype(np.float32)
    after = ceiling(raised, LATTICE, CENTRE)
    bounded = np.isfinite(before)
    assert (after[bounded] >= before[bounded]).all()


def run(params: OcclusionBoundsParams, *dems: Bundle) -> Bundle:
    merged = np.asarray(dems[0]["elevation"])
    arrays = {"elevation": merged, "relief_std": np.where(np.isnan(merged), np.nan, 0.001).astype(np.float32)}
    return occlusion_bounds_stage.run(
        params, {}, {"merged": Bundle(arrays, {"lattice": LATTICE.to_dict()}), "dems": list(dems)}
    )


def model(seen: np.ndarray, height: float = HEIGHT) -> Bundle:
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, height]))
    meta = {"lattice": LATTICE.to_dict(), "T_frame_left": pose.to_list(), "pixel_rad": 0.0055, "pair": 0}
    std = np.where(np.isnan(seen), np.nan, 0.002).astype(np.float32)
    return Bundle({"elevation": seen.astype(np.float32), "elevation_std": std}, meta)


def test_the_stage_adds_standard_deviations_and_takes_the_least_of_several_models() -> None:
    _, seen = wall()
    low, hidden = model(seen, 0.12), np.isnan(seen) & (np.abs(X) < 0.4 * Y)
    found = run(OcclusionBoundsParams(), model(seen))
    upper, lower = np.asarray(found["upper"]), np.asarray(found["lower"])
    known = ~np.isnan(seen)
    assert upper[known] == pytest.approx(seen[known] + 1.25 * 0.001, abs=1e-6)
    assert lower[known] == pytest.approx(seen[known] - 1.25 * 0.001, abs=1e-6)
    assert np.isnan(lower[~known]).all()
    exact = ceiling(seen, LATTICE, CENTRE)[hidden]
    assert (upper[hidden] > exact).all()
    assert upper[hidden] == pytest.approx(exact + 1.25 * 0.002, abs=0.001)
    alone = np.asarray(run(OcclusionBoundsParams(), low)["upper"])
    assert (alone[hidden] < upper[hidden]).any()
    for models in ((model(seen), low), (low, model(seen))):
        both = np.asarray(run(OcclusionBoundsParams(), *models)["upper"])
        assert both[hidden] == pytest.approx(np.fmin(upper, alone)[hidden])


def test_no_line_is_drawn_to_what_was_seen_too_coarsely() -> None:
    _, seen = wall()
    coarse = run(OcclusionBoundsParams(max_footprint=0.003), model(seen))
    assert np.isnan(np.asarray(coarse["upper"])[np.isnan(seen)]).all()
    fine = run(OcclusionBoundsParams(max_footprint=0.1), model(seen))
    assert np.isfinite(np.asarray(fine["upper"])[np.isnan(seen)]).mean() > 0.01
