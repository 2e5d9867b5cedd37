"""Risk map: hand-computed ground, slopes and steps against their limits, and what no change may make safer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises
from vehicles import MODEL

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BITS, MEASURES, HazardInput
from rille.stages.hazard.risk import (
    CAUTION,
    FILLED_BIT,
    HAZARDOUS,
    SAFE,
    UNKNOWN,
    UNKNOWN_BIT,
    UNSEEN_BIT,
    RiskParams,
    risk_map,
    risk_stage,
    window_cells,
)
from rille.stages.hazard.vehicle import DEFAULT_VEHICLE, Vehicle

FINE = 0.001
COARSE = 0.005


def judge(z: np.ndarray, cell: float = FINE, std: float | np.ndarray = 0.0, vehicle: Vehicle = MODEL, **params) -> dict:
    z = z.astype(np.float32)
    return risk_map(z, np.broadcast_to(np.float32(std), z.shape).copy(), cell, vehicle, RiskParams(**params))


def ramp(slope: float, direction: float = 0.0, shape: tuple[int, int] = (200, 200)) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]] * FINE
    return math.tan(slope) * (x * math.cos(direction) + y * math.sin(direction))


def test_a_post_on_coarse_ground_by_hand() -> None:
    """Wheel windows are 3 x 3 cells of 10 mm; the post of 20 mm is in nine of them, 45 degrees over two cells."""
    z = np.zeros((31, 31))
    z[15, 15] = 0.02
    out = judge(z, cell=0.01)
    near = np.zeros((31, 31), dtype=bool)
    near[14:17, 14:17] = True
    np.testing.assert_array_equal((out["reason"] & BITS["step"]) > 0, near)
    np.testing.assert_array_equal((out["reason"] & BITS["inclination"]) > 0, near)
    np.testing.assert_allclose(out["step"][near], 0.02, rtol=1e-6)
    np.testing.assert_allclose(out["height_range"][near], 0.02, rtol=1e-6)
    np.testing.assert_allclose(out["inclination"][near], math.pi / 4, rtol=1e-6)
    assert (out["reason"] & BITS["range"]).max() == 0
    # at the post: of the pairs of neighbours that begin or end in nine cells, four differ by 20 mm, each counted twice
    assert out["roughness"][15, 15] == pytest.approx(math.sqrt(0.5 * 8 * 0.02**2 / 36), rel=1e-5)
    assert out["clearance"][15, 15] == pytest.approx(0.01, rel=1e-5)
    # under one wheel: both spans, rounded to cells of 10 mm, are 0.1 and 0.08 m
    assert out["tilt"][20, 19] == pytest.approx(math.atan(math.hypot(0.2, 0.25)), rel=1e-5)
    assert out["slope"][20, 19] == 0.0
    np.testing.assert_array_equal(out["p_hazard"][10:21, 10:21] == 1.0, (out["risk"] == HAZARDOUS)[10:21, 10:21])


def test_windows_are_the_wheel_in_cells() -> None:
    assert [window_cells(d, 0.001) for d in (0.03, 0.025, 0.001)] == [31, 25, 3]
    assert window_cells(0.3, 0.1) == 3
    assert [window_cells(d, 0.004) for d in (0.015, 0.03)] == [5, 9], "the nearest number, not the next lower one"


@pytest.mark.parametrize("direction", [0.0, 0.4, math.pi / 4, 2.0])
@pytest.mark.parametrize(("slope_deg", "hazardous"), [(17.8, False), (20.5, True)])
def test_a_slope_is_judged_alike_in_all_directions(direction: float, slope_deg: float, hazardous: bool) -> None:
    out = judge(ramp(math.radians(slope_deg), direction))
    inner = np.s_[85:-85, 85:-85]
    tangent = np.tan(out["inclination"][inner]) / math.tan(math.radians(slope_deg))
    assert 1.0 - 1e-3 <= tangent.min() <= tangent.max() <= 1.11  # an octagon's corners
    for name in ("tilt", "slope"):
        found = np.tan(out[name][inner]) / math.tan(math.radians(slope_deg))
        assert 1.0 - 1e-3 <= found.min() <= found.max() <= 1.04
    assert (out["risk"][inner] == HAZARDOUS).all() == hazardous
    # over a wheel's radius this slope rises 0.37 * 14 mm * 1.09 = 5.8 mm, no step; under the belly 12 of 30 mm
    assert (out["reason"] & (BITS["step"] | BITS["range"] | BITS["rise"])).max() == 0


@pytest.mark.parametrize(("height", "hazardous"), [(0.014, False), (0.016, True)])
def test_a_step_is_found_within_a_wheels_radius(height: float, hazardous: bool) -> None:
    z = np.zeros((100, 150))
    z[:, 70:] = height
    out = judge(z, vehicle=MODEL.model_copy(update={"max_slope_deg": 60.0}))
    step = (out["reason"] & BITS["step"]) > 0
    columns = np.flatnonzero(step.any(axis=0))
    if hazardous:
        half = window_cells(0.5 * MODEL.wheel_diameter, FINE) // 2
        assert (columns[0], columns[-1]) == (70 - half, 69 + half)
    else:
        assert len(columns) == 0


@pytest.mark.parametrize(("cell", "vehicle"), [(0.001, MODEL), (0.1, DEFAULT_VEHICLE)], ids=["median", "coarse"])
def test_noise_does_not_make_flat_ground_hazardous(cell: float, vehicle: Vehicle) -> None:
    sigma = 0.03 * vehicle.max_step
    z = np.random.default_rng(1).normal(scale=sigma, size=(250, 250))
    out = judge(z, cell, std=sigma, vehicle=vehicle)
    assert (out["risk"] == HAZARDOUS).sum() == 0
    assert out["p_hazard"][90:-90, 90:-90].max() < 0.001


def test_noise_does_not_hide_a_step() -> None:
    sigma = 0.1 * MODEL.max_step
    z = np.random.default_rng(2).normal(scale=sigma, size=(100, 100))
    z[50:] += 1.1 * MODEL.max_step
    out = judge(z, std=sigma)
    assert ((out["reason"][48:52, 1:-1] & BITS["step"]) > 0).all()


def test_a_single_wrong_cell_on_fine_ground_is_no_rock_but_a_coarse_post_is() -> None:
    z = np.zeros((100, 120))
    z[50, 60] = 0.05
    for cell in (FINE, 0.003):  # five of which are a wheel's radius
        assert (judge(z, cell)["risk"] == HAZARDOUS).sum() == 0
    z[50, 60] = 0.5
    # Five cells of 0.07 m are 0.35 m but for their rounding.
    large = DEFAULT_VEHICLE.model_copy(update={"wheel_diameter": 0.7})
    assert (judge(z, cell=0.07, vehicle=large)["risk"] == HAZARDOUS).sum() == 0
    assert (judge(z, cell=0.1, vehicle=DEFAULT_VEHICLE)["risk"] == HAZARDOUS).sum() >= 9


def test_hidden_ground_makes_no_hazard_less_certain() -> None:
    """Behind a step of 20 mm, where 15 mm are permitted, the ground is hidden or seen."""
    z = np.zeros((120, 200))
    z[:, 100:] = 0.02
    hidden = z.copy()
    hidden[:, 105:] = np.nan
    seen, half = (judge(ground, std=0.002) for ground in (z, hidden))
    near = np.s_[55:65, 100:105]
    assert (seen["risk"][near] == HAZARDOUS).all()
    assert (half["risk"][near] == HAZARDOUS).all()
    assert (half["p_hazard"][near] >= seen["p_hazard"][near]).all()


def test_a_cell_that_the_vehicle_can_only_reach_over_hidden_ground_says_so() -> None:
    z = np.zeros((200, 300))
    z[:, :100] = np.nan
    unseen = (judge(z)["reason"][100] & UNSEEN_BIT) > 0
    # The middle within half a wheel base of it; the wheel's window alone ends at 15 cells.
    assert unseen[100:140].all()
    assert not unseen[190:220].any()


def test_unknown_does_not_grow_and_what_is_near_it_is_not_called_safe() -> None:
    z = np.zeros((250, 300))
    z[:, :60] = np.nan
    z[120:123, 150:153] = np.nan
    out = judge(z)
    assert (out["risk"][100:150, :60] == UNKNOWN).all()
    assert (out["risk"][100:150, 60:75] == CAUTION).all()
    assert ((out["reason"][100:150, 60:75] & UNSEEN_BIT) > 0).all()
    assert (out["risk"][100:150, 150:200] == SAFE).all()
    np.testing.assert_array_equal(np.argwhere(out["filled"]), np.argwhere(np.isnan(z) & (np.arange(300) > 100)))
    assert ((out["reason"] & FILLED_BIT) > 0).sum() == 9


def test_beside_its_border_a_map_is_judged_as_beside_unknown_ground() -> None:
    """Wheels that stand a little beyond the border still touch the ground within it."""
    rng = np.random.default_rng(4)
    z = np.cumsum(rng.normal(scale=0.1 * MODEL.max_step, size=(120, 112)), axis=0)
    alone, among = judge(z), judge(np.pad(z, 40, constant_values=np.nan))
    for name in ("risk", "reason", "slope", "tilt", "clearance", "p_hazard"):
        np.testing.assert_array_equal(alone[name], among[name][40:-40, 40:-40], err_msg=name)


def test_a_closed_hole_is_as_uncertain_as_its_rim_is_uneven() -> None:
    """A gap of 5 cells between level ground and a 14 mm shelf, where 15 mm are permitted.

    Its cells have 14 mm / sqrt(12), about a sixth of the window: 1.6 mm there, 1.25 x 0.9 of which are added.
    """
    z = np.zeros((150, 200))
    z[:, 100:] = 0.014
    vehicle = MODEL.model_copy(update={"max_slope_deg": 40.0})
    assert (judge(z, vehicle=vehicle)["risk"][70:80, 97:102] < HAZARDOUS).all()
    z[60:90, 97:102] = np.nan
    out = judge(z, vehicle=vehicle)
    assert (out["filled"][60:90, 97:102] == 1).all()
    assert (out["risk"][70:80, 97:102] == HAZARDOUS).all()


@pytest.mark.parametrize(("wide", "closed"), [(6, True), (7, False)])
def test_a_hole_is_closed_up_to_its_share_of_a_wheel(wide: int, closed: bool) -> None:
    z = np.zeros((120, 200))
    z[40:80, 90 : 90 + wide] = np.nan
    assert bool(judge(z, max_hole=0.2)["filled"][60, 90 : 90 + wide].all()) == closed


def test_a_step_proven_by_few_cells_is_hazardous() -> None:
    z = np.full((100, 120), np.nan)
    z[40:43, 60:63] = 0.0
    z[40:43, 63:66] = 0.03
    out = judge(z, max_hole=0.0)
    assert (out["risk"][40:43, 60:66] == HAZARDOUS).all()


def test_ground_that_is_infinitely_uncertain_is_unknown() -> None:
    z, std = np.zeros((120, 120)), np.zeros((120, 120))
    missing = z.copy()
    missing[20:60, 20:60] = np.nan
    endless, unsure = z.copy(), std.copy()
    endless[20:60, 20:60] = unsure[20:60, 20:60] = np.inf
    for found in (judge(endless), judge(z, std=unsure)):
        np.testing.assert_equal(found, judge(missing))


def test_nothing_known_and_a_map_too_small() -> None:
    out = judge(np.full((100, 100), np.nan))
    assert (out["risk"] == UNKNOWN).all()
    assert ((out["reason"] & UNKNOWN_BIT) > 0).all()
    with raises("RIL-431", "0.095", "0.06"):
        judge(np.zeros((60, 200)))


# -- what never makes a cell safer ------------------------------------------------------------------------------------


def danger(out: dict) -> np.ndarray:
    """Rank of a class: what may not be entered is the greatest."""
    return np.minimum(out["risk"], HAZARDOUS)


def rough(seed: int, shape: tuple[int, int] = (40, 44)) -> np.ndarray:
    """Ground with slopes and stones about the limits, at cells of 5 mm, in parts of 1/8192 m that float32 keeps."""
    rng = np.random.default_rng(seed)
    z = np.rint(8192 * np.cumsum(rng.normal(scale=0.002, size=shape), axis=int(rng.integers(2)))) / 8192
    z[rng.random(shape) < rng.uniform(0, 0.3)] = np.nan
    return z


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 9999), lift=st.integers(1, 250), level=st.floats(0.0, 1.0), holes=st.booleans())
def test_raising_what_stands_highest_never_makes_a_cell_safer(seed: int, lift: int, level: float, holes: bool) -> None:
    """Relief is made greater: all that is higher than some level is raised by one amount."""
    z = rough(seed)
    z = z if holes else np.nan_to_num(z)
    threshold = np.nanquantile(z, level)
    std = np.random.default_rng(seed + 1).uniform(0, 0.002, z.shape)
    raised = np.where(z > threshold, z + lift / 8192, z)
    params = {"cell": COARSE, "std": std, "max_hole": 0.5 if holes else 0.0}
    before, after = judge(z, **params), judge(raised, **params)
    assert (danger(after) >= danger(before)).all()
    both = before["risk"] != UNKNOWN
    if not holes:
        assert (after["p_hazard"][both] >= before["p_hazard"][both]).all()
    for name in ("inclination", "height_range", "step", "roughness", "tilt", "slope"):
        assert (after[name][both] >= before[name][both] - 1e-6).all(), name
    assert (after["clearance"][both] <= before["clearance"][both] + 1e-6).all()


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 9999),
    heights=st.tuples(st.floats(0.001, 0.05), st.floats(0.001, 0.05)),
    width=st.floats(0.01, 0.15),
)
def test_a_rock_that_grows_on_level_ground_never_makes_a_cell_safer(
    seed: int, heights: tuple[float, float], width: float
) -> None:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:40, :44] * COARSE
    q = np.hypot(x - rng.uniform(0.05, 0.17), (y - rng.uniform(0.05, 0.15)) / rng.uniform(0.6, 1.0)) / (0.5 * width)
    rock = np.maximum(1.0 - q**4, 0.0)
    low, high = (judge(h * rock, cell=COARSE, std=0.0003) for h in sorted(heights))
    assert (danger(high) >= danger(low)).all()
    assert (high["p_hazard"] >= low["p_hazard"])[low["risk"] != UNKNOWN].all()


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 9999),
    factor=st.floats(1.0, 4.0),
    where=st.floats(0.0, 1.0),
    sigmas=st.floats(0.0, 5.0),
    cell=st.sampled_from([COARSE, 0.002]),
)
def test_more_noise_never_makes_a_cell_safer(
    seed: int, factor: float, where: float, sigmas: float, cell: float
) -> None:
    z = rough(seed, (60, 64))
    rng = np.random.default_rng(seed + 1)
    std = rng.uniform(0, 0.002, z.shape)
    more = np.where(rng.random(z.shape) < where, factor * std, std)
    before, after = (judge(z, cell=cell, std=s, sigmas=sigmas) for s in (std, more))
    assert (danger(after) >= danger(before)).all()
    assert (danger(judge(z, cell=cell, std=std, sigmas=sigmas + 0.5)) >= danger(before)).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), share=st.floats(0.0, 0.9))
def test_unknown_is_never_safe_and_every_hazard_has_a_reason(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    z = np.cumsum(rng.normal(scale=0.002, size=(40, 50)), axis=1)
    z[rng.random(z.shape) < share] = np.nan
    out = judge(z, cell=COARSE)
    blank = np.isnan(z) & (out["filled"] == 0)
    assert (out["risk"][blank] == UNKNOWN).all()
    np.testing.assert_array_equal(out["risk"] == HAZARDOUS, (out["reason"] & 127) > 0)
    np.testing.assert_array_equal((out["reason"] & UNKNOWN_BIT) > 0, out["risk"] == UNKNOWN)
    np.testing.assert_array_equal(np.isnan(out["p_hazard"]), out["risk"] == UNKNOWN)
    mirrored = judge(z[:, ::-1], cell=COARSE)
    np.testing.assert_array_equal(mirrored["filled"], out["filled"][:, ::-1])
    np.testing.assert_array_equal(mirrored["step"], out["step"][:, ::-1])


def test_the_stage_assembles_tiles() -> None:
    whole = Lattice.at(-10, 30, FINE, 110, 120)
    z = ramp(0.2, 1.0, whole.shape).astype(np.float32)
    parts = [Lattice.at(-10, 30, FINE, 110, 40), Lattice.at(30, 30, FINE, 110, 80)]
    dems = [
        Bundle(
            {"elevation": z[whole.window(p)], "elevation_std": np.full(p.shape, 1e-4, dtype=np.float32)},
            {"lattice": p.to_dict(), "frame": "world"},
        )
        for p in parts
    ]
    out = risk_stage.run(RiskParams(), {"vehicle": MODEL.model_dump()}, {"dem": dems})
    check_outputs(risk_stage, out)
    one = judge(z, std=1e-4)
    np.testing.assert_array_equal(out["risk"], one["risk"])
    assert out.meta["lattice"] == whole.to_dict()
    for dem in dems:  # a merged model: what its poses share neither makes a slope nor a step
        dem.arrays["relief_std"], dem.arrays["elevation_std"] = dem.arrays["elevation_std"], dem["elevation_std"] + 9
    np.testing.assert_array_equal(
        risk_stage.run(RiskParams(), {"vehicle": MODEL.model_dump()}, {"dem": dems})["p_hazard"], one["p_hazard"]
    )
    assert sum(out.meta["shares"][k] for k in ("safe", "caution", "hazardous", "unknown")) == pytest.approx(1.0)
    small = DEFAULT_VEHICLE.model_copy(update={"track": 0.05, "wheel_base": 0.1, "wheel_diameter": 0.04})
    exact = risk_stage.run(
        RiskParams(), {"vehicle": small.model_dump()}, {"dem": [Bundle({"elevation": z}, {"lattice": whole.to_dict()})]}
    )
    assert exact.meta["vehicle"]["name"] == "default rover"


@pytest.mark.filterwarnings("error")
def test_flat_ground_beside_rough_ground_has_every_measure() -> None:
    z = np.zeros((120, 120), dtype=np.float32)
    z[:40, :40] = np.random.default_rng(0).normal(0.0, 1e-3, (40, 40))  # running sums round; behind it nothing is left
    terrain = HazardInput(z, z, np.zeros_like(z), 0.002, MODEL, 0.06)
    assert all(np.isfinite(m.kernel(terrain)).all() for m in MEASURES)
    assert np.isfinite(terrain.window_noise()).all()
