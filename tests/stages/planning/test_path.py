"""Local path: what is never entered, the margin, unknown ground, both planners, and ends that are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises
from vehicles import SHORT

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BITS
from rille.stages.hazard.risk import CAUTION, DOUBT_BIT, HAZARDOUS, UNKNOWN, RiskParams, risk_stage
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path import PathParams, Route, describe, find_path, nearest_middle, path_stage

CELL = 0.01


def maps(risk: np.ndarray, z: np.ndarray, bit: str = "step") -> dict[str, np.ndarray]:
    """A risk map whose hazards are all of one measure."""
    reason = np.where(risk == HAZARDOUS, BITS[bit], 0).astype(np.uint16)
    return {"risk": risk.astype(np.uint8), "reason": reason, "elevation": z.astype(np.float32)}


def level(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(lattice.shape, dtype=np.uint8), np.zeros(lattice.shape, dtype=np.float32)


def terrain(seed: int, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Random islands of caution, hazard and unknown on gently rolling ground."""
    rng = np.random.default_rng(seed)
    risk, _ = level(lattice)
    for kind in (CAUTION, HAZARDOUS, UNKNOWN):
        for _ in range(4):
            r, c = rng.integers(0, lattice.rows), rng.integers(0, lattice.cols)
            risk[r : r + 4, c : c + 4] = kind
    y, x = np.mgrid[: lattice.rows, : lattice.cols]
    z = (0.003 * np.sin(x / 5 + seed) * np.cos(y / 7)).astype(np.float32)
    return risk, np.where(risk == UNKNOWN, np.float32(np.nan), z)


def wheels_of(route: Route, vehicle: Vehicle) -> np.ndarray:
    """Wheel middles (n, 2) x, y at the vertices, heading along the edge that led there."""
    out = []
    for a, b in zip(route.xyz[:-1, :2], route.xyz[1:, :2], strict=True):
        ahead = (b - a) / np.hypot(*(b - a))
        aside = np.array([ahead[1], -ahead[0]])
        for f, g in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            out.append(b + 0.5 * f * vehicle.wheel_base * ahead + 0.5 * g * vehicle.track * aside)
    return np.array(out)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), planner=st.sampled_from(["rows", "grid8"]))
def test_unknown_and_hazard_are_never_entered(seed: int, planner: str) -> None:
    lattice = Lattice.at(-20, 30, CELL, 40, 36)
    risk, z = terrain(seed, lattice)
    route = find_path(maps(risk, z), lattice, SHORT, params=PathParams(planner=planner))
    xyz = route.xyz
    if len(xyz):
        at = np.rint(lattice.index(xyz[:, :2])).astype(int)
        assert (risk[at[:, 0], at[:, 1]] < HAZARDOUS).all()
        assert np.isfinite(xyz).all()
        if planner == "rows":
            np.testing.assert_allclose(np.diff(xyz[:, 1]), CELL, atol=1e-9)
    else:
        assert route.reason


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 999),
    margin=st.sampled_from([0.0, 0.01, 0.025]),
    planner=st.sampled_from(["rows", "grid8"]),
    bit=st.sampled_from(["step", "tilt"]),
)
def test_wheels_and_middle_keep_the_margin_from_hazards_to_them(
    seed: int, margin: float, planner: str, bit: str
) -> None:
    lattice = Lattice.at(-20, 30, CELL, 60, 56)
    risk, z = terrain(seed, lattice)
    vehicle = SHORT.model_copy(update={"margin": margin})
    route = find_path(maps(risk, z, bit), lattice, vehicle, params=PathParams(planner=planner))
    hazards = lattice.xy()[risk == HAZARDOUS]
    if len(route.xyz) < 2:
        return
    places = wheels_of(route, vehicle) if bit == "step" else route.xyz[:, :2]
    nearest = np.hypot(*(places[:, None] - hazards[None]).transpose(2, 0, 1)).min()
    # a wheel is put on the nearest cell: half a diagonal
    assert nearest >= margin - 0.71 * CELL
    assert margin == 0.0 or nearest > 0.3 * CELL


@pytest.mark.parametrize(("gap", "ground"), [(9, "outline"), (7, "wheels"), (2, "middle")])
def test_what_stays_on_known_ground_is_told(gap: int, ground: str) -> None:
    lattice = Lattice.at(-15, 60, CELL, 40, 31)
    risk, z = level(lattice)
    risk[15:25] = UNKNOWN
    risk[15:25, 15 - gap // 2 : 15 - gap // 2 + gap] = 0
    vehicle = SHORT.model_copy(update={"track": 0.05})  # 6.5 cells over the wheels
    route = find_path(maps(risk, z), lattice, vehicle)
    assert route.ground == ground
    assert len(route.xyz) > 30


def test_a_path_over_level_ground_does_not_follow_the_noise_of_its_elevations() -> None:
    lattice = Lattice.at(-20, 60, CELL, 60, 41)
    risk, z = level(lattice)
    z = z + np.random.default_rng(3).normal(0.0, 0.005, z.shape).astype(np.float32)
    winding, straight = (
        find_path(maps(risk, z), lattice, SHORT, params=PathParams(detour_cost=cost)) for cost in (0.0, 0.2)
    )
    aside = [int(np.abs(np.diff(route.cells[:, 1])).sum()) for route in (winding, straight)]
    assert aside[1] < 0.5 * aside[0]


@pytest.mark.parametrize("fine", [1, 4, 10])
def test_prices_of_a_metre_hold_on_cells_of_any_size(fine: int) -> None:
    """A cell of 1 mm is four steps of 0.24 mm, of which 0.2 times what a diagonal is longer would round to nothing."""
    cell, rover = CELL / fine, SHORT.model_copy(update={"max_step": 0.012})
    lattice = Lattice.at(-20 * fine, 60 * fine, cell, 60 * fine, 41 * fine)
    risk, z = level(lattice)
    z += np.random.default_rng(3).normal(0.0, 0.002, (60, 41)).astype(np.float32).repeat(fine, 0).repeat(fine, 1)
    winding, straight = (
        describe(
            find_path(maps(risk, z), lattice, rover, params=PathParams(planner="rows", detour_cost=cost)),
            maps(risk, z),
            lattice,
            rover,
        )
        for cost in (0.0, 0.2)
    )
    assert straight["length_m"] < 0.99 * winding["length_m"]
    higher = rover.model_copy(update={"max_step": 0.12})
    by_grid = find_path(
        maps(risk, 0.0 * z), lattice, higher, ends=((0.0, 0.1), (0.1, 0.5)), params=PathParams(planner="grid8")
    )
    length = np.hypot(*np.diff(by_grid.xyz[:, :2], axis=0).T).sum()
    assert length == pytest.approx(0.3 + 0.1 * math.sqrt(2.0), rel=0.01)


def test_caution_ground_is_avoided_where_the_detour_is_short() -> None:
    lattice = Lattice.at(-20, 60, CELL, 60, 41)
    risk, z = level(lattice)
    risk[25:35, 12:24] = CAUTION
    for toll, crosses in ((0.0, True), (0.2, False)):
        route = find_path(maps(risk, z), lattice, SHORT, params=PathParams(caution_cost=toll))
        assert (risk[tuple(route.cells.T)] == CAUTION).any() == crosses


@pytest.mark.parametrize(("chance", "crossed"), [(0.0, True), (0.09, False), (0.5, False)])
def test_ground_that_may_be_a_hazard_is_gone_round(chance: float, crossed: bool) -> None:
    lattice = Lattice.at(-30, 60, CELL, 61, 61)
    given = maps(*level(lattice)) | {"p_hazard": np.zeros(lattice.shape, dtype=np.float32)}
    given["p_hazard"][25:36, 24:37] = chance
    ends = ((0.0, 0.1), (0.0, 0.5))
    route = find_path(given, lattice, SHORT, ends=ends, params=PathParams(uncertainty_cost=20.0))
    assert bool((given["p_hazard"][route.cells[:, 0], route.cells[:, 1]] == np.float32(chance)).all()) == crossed
    assert len(route.cells) > 30


def test_the_dearest_ground_is_gone_round() -> None:
    """A cell costs 45 000 steps of 0.2 mm, which 16 bits do not hold."""
    lattice = Lattice.at(-30, 60, CELL, 61, 61)
    given = maps(*level(lattice)) | {"p_hazard": np.zeros(lattice.shape, dtype=np.float32)}
    given["p_hazard"][25:36, 24:37] = 0.9
    prices = PathParams(uncertainty_cost=1000.0, p_certain_hazard=1.0)
    route = find_path(given, lattice, SHORT, ends=((0.0, 0.1), (0.0, 0.5)), params=prices)
    assert len(route.cells) > 30
    assert given["p_hazard"][route.cells[:, 0], route.cells[:, 1]].max() == 0.0


def test_ground_that_is_probably_a_hazard_closes_the_way() -> None:
    lattice = Lattice.at(-30, 60, CELL, 61, 61)
    given = maps(*level(lattice)) | {"p_hazard": np.zeros(lattice.shape, dtype=np.float32)}
    given["p_hazard"][30] = 0.2
    ends = ((0.0, 0.1), (0.0, 0.5))
    closed = find_path(given, lattice, SHORT, ends=ends)
    assert not len(closed.cells)
    assert (
        "above path.p_certain_hazard 0.1 closes every path; without it one leads over ground of up to 0.2:"
        in closed.reason
    )
    assert len(find_path(given, lattice, SHORT, ends=ends, params=PathParams(p_certain_hazard=0.2)).cells) > 30
    given["risk"][30] = HAZARDOUS  # then it is not for what may be hazardous
    assert "p_certain_hazard" not in find_path(given, lattice, SHORT, ends=ends).reason


def test_ground_that_is_probably_a_hazard_everywhere_is_said_with_the_figure() -> None:
    lattice = Lattice.at(0, 40, CELL, 40, 30)
    arrays = maps(*level(lattice)) | {"p_hazard": np.full(lattice.shape, 0.15, dtype=np.float32)}
    source = Bundle(arrays, {"lattice": lattice.to_dict(), "vehicle": SHORT.model_dump()})
    reason = path_stage.run(PathParams(), {}, {"risk": source}).meta["reason"]
    assert reason.startswith("ground with a p_hazard above path.p_certain_hazard 0.1 closes every path")
    assert "up to 0.15" in reason


def test_from_start_to_target_in_metres() -> None:
    lattice = Lattice.at(-50, 50, CELL, 101, 101)
    given = maps(*level(lattice))
    xyz = find_path(given, lattice, SHORT, ends=((-0.3, -0.2), (0.3, 0.25))).xyz
    # ends are moved to the centres of their cells: half a diagonal
    assert np.hypot(*(xyz[0, :2] - [-0.3, -0.2])) < 0.71 * CELL
    assert np.hypot(*(xyz[-1, :2] - [0.3, 0.25])) < 0.71 * CELL
    assert (np.hypot(*np.diff(xyz[:, :2], axis=0).T)).sum() == pytest.approx(0.15 + 0.45 * math.sqrt(2.0))
    with raises("RIL-406", "path.target", "-0.505"):
        find_path(given, lattice, SHORT, ends=((-0.3, -0.2), (2.0, 0.0)))


def test_behind_a_wall_rows_fail_and_grid8_goes_round() -> None:
    lattice = Lattice.at(-30, 60, CELL, 61, 61)
    risk, z = level(lattice)
    risk[20, 8:53] = risk[20:45, 8] = risk[20:45, 52] = HAZARDOUS  # a cup that opens to the near side
    ends = ((0.0, 0.25), (0.0, 0.55))
    by_rows = find_path(maps(risk, z), lattice, SHORT, ends=ends, params=PathParams(planner="rows"))
    assert len(by_rows.xyz) == 0
    route = find_path(maps(risk, z), lattice, SHORT, ends=ends)
    assert route.planner == "grid8"
    np.testing.assert_allclose(route.xyz[[0, -1], :2], [[0.0, 0.25], [0.0, 0.55]], atol=1e-9)
    assert np.diff(route.xyz[:, 1]).min() < 0  # it goes back


@pytest.mark.parametrize("datum", [0.0, 3e5])
def test_heights_far_from_the_datum_cost_what_they_differ(datum: float) -> None:
    """300 km are 1.5e9 steps of 0.2 mm, which are kept in 64 bits; float32 there tells 0.03 m apart."""
    lattice = Lattice.at(-15, 60, CELL, 40, 31)
    risk, z = level(lattice)
    z[:20] = 0.5
    given = maps(risk, z + np.float32(datum))
    route = find_path(given, lattice, SHORT)
    assert len(route.xyz) > 30
    assert describe(route, given, lattice, SHORT)["climb_m"] == pytest.approx(0.5, abs=0.03)


def test_a_map_that_is_cut_is_crossed_on_its_longer_side() -> None:
    lattice = Lattice.at(-30, 60, CELL, 100, 61)
    risk, z = level(lattice)
    risk[70:74] = HAZARDOUS  # from edge to edge: 70 rows ahead of it, 26 before
    given = maps(risk, z)
    facts = describe(find_path(given, lattice, SHORT, stretch=True), given, lattice, SHORT)
    assert facts["planner"] == "grid8"
    before, beyond = facts["left_out_m"]
    assert 0.30 <= before <= 0.30 + 2 * SHORT.half_length
    assert beyond <= 2 * SHORT.half_length
    from_start = find_path(given, lattice, SHORT, ends=((0.0, -0.3), None), stretch=True)
    np.testing.assert_allclose(from_start.xyz[0, :2], [0.0, -0.3], atol=1e-9)
    assert describe(from_start, given, lattice, SHORT)["left_out_m"][1] > 0.70, "the other side is left out"


@pytest.mark.parametrize(
    ("y", "closed", "begins"),
    [(-0.6, False, -0.3), (0.0, False, 0.0), (0.0, True, 0.0), (-0.26, False, -0.3), (0.58, False, -0.3)],
)
def test_a_mission_begins_where_the_rig_began(y: float, closed: bool, begins: float) -> None:
    """The map's first row lies ahead of it after a straight drive, far behind it after an orbit."""
    lattice = Lattice.at(-30, 60, CELL, 91, 61)
    risk, z = level(lattice)
    if closed:  # a ring around it
        risk[52:69, 32:49] = HAZARDOUS
        risk[55:66, 35:46] = 0
    route = find_path(maps(risk, z), lattice, SHORT, stretch=True, begin=(0.1, y))
    assert route.xyz[0, :2] == pytest.approx([0.1 if begins == 0.0 else 0.0, begins], abs=0.12 if closed else 0.05)
    assert route.xyz[-1, 1] > 0.5


def test_from_a_start_alone_a_mission_goes_round_as_well() -> None:
    lattice = Lattice.at(-30, 60, CELL, 61, 61)
    risk, z = level(lattice)
    risk[20, 8:53] = risk[20:45, 8] = risk[20:45, 52] = HAZARDOUS  # a cup that opens to the near side
    ends = ((0.0, 0.25), None)
    assert not len(find_path(maps(risk, z), lattice, SHORT, ends=ends, params=PathParams(planner="rows")).xyz)
    route = find_path(maps(risk, z), lattice, SHORT, ends=ends, stretch=True)
    assert route.planner == "grid8"
    np.testing.assert_allclose(route.xyz[0, :2], [0.0, 0.25], atol=1e-9)
    assert describe(route, maps(risk, z), lattice, SHORT)["left_out_m"][1] < 2 * SHORT.half_length


@pytest.mark.parametrize("given", [0, 1])
def test_an_end_alone_is_not_left_on_a_stub_of_the_strictest_ground(given: int) -> None:
    lattice = Lattice.at(-15, 120, CELL, 110, 31)
    risk, z = level(lattice)
    risk[30:70] = UNKNOWN
    risk[30:70, 12:19] = 0  # as wide as the wheels, not as the outline
    vehicle = SHORT.model_copy(update={"track": 0.05})
    risk[100:104] = HAZARDOUS  # cuts the map, so that rows lead nowhere
    end = tuple(lattice.xy()[(95, 15) if given == 0 else (8, 15)])
    ends = (end, None) if given == 0 else (None, end)
    route = find_path(maps(risk, z), lattice, vehicle, ends=ends, stretch=True, params=PathParams(planner="grid8"))
    assert route.ground == "wheels"
    assert route.cells[0, 0] - route.cells[-1, 0] > 80


@pytest.mark.parametrize(("at", "ground"), [(5, "outline"), (40, "wheels")])
def test_unknown_ground_under_the_belly_is_passed_where_the_path_gains_a_third(at: int, ground: str) -> None:
    lattice = Lattice.at(-15, 120, CELL, 110, 31)
    risk, z = level(lattice)
    risk[at : at + 10] = UNKNOWN
    risk[at : at + 10, 12:19] = 0  # as wide as the wheels, not as the outline
    risk[100:104] = HAZARDOUS  # cuts the map, so that rows lead nowhere
    vehicle = SHORT.model_copy(update={"track": 0.05})
    route = find_path(maps(risk, z), lattice, vehicle, stretch=True)
    assert (route.planner, route.ground) == ("grid8", ground)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (HAZARDOUS, ("RIL-408", "path.start", "0.02", "vehicle.max_step", "0.01")),
        (UNKNOWN, ("RIL-407", "path.start", "0.05")),
    ],
)
def test_a_start_that_cannot_be_stood_on_is_refused_with_the_figure(kind: int, expected: tuple[str, ...]) -> None:
    lattice = Lattice.at(-20, 40, CELL, 41, 41)
    risk, z = level(lattice)
    risk[30:39, 15:26] = kind
    given = maps(risk, z) | {"step": np.full(lattice.shape, 0.02, dtype=np.float32)}
    with raises(*expected):
        find_path(given, lattice, SHORT, ends=((0.0, 0.06), None))


@pytest.mark.parametrize(
    ("bit", "band", "value", "words"),
    [
        ("tilt", "tilt", math.radians(25.0), "tilt 25 deg, vehicle.max_slope_deg 20"),
        ("rise", "clearance", -0.01, f"rise under the belly {SHORT.clearance + 0.01:.3g} m, vehicle.clearance"),
    ],
)
def test_a_measure_is_told_in_the_unit_of_its_limit(bit: str, band: str, value: float, words: str) -> None:
    """Its raster holds radians, or what is left under the belly."""
    lattice = Lattice.at(-20, 40, CELL, 41, 41)
    risk, z = level(lattice)
    risk[30:39, 15:26] = HAZARDOUS
    given = maps(risk, z, bit) | {band: np.full(lattice.shape, value, dtype=np.float32)}
    with raises("RIL-408", words):
        find_path(given, lattice, SHORT, ends=((0.0, 0.06), None))


def test_a_hazard_of_doubt_alone_is_said_to_be_one() -> None:
    """``step 0.008 m, vehicle.max_step 0.01`` reads as permitted ground."""
    lattice = Lattice.at(-20, 40, CELL, 41, 41)
    risk, z = level(lattice)
    risk[30:39, 15:26] = HAZARDOUS
    given = maps(risk, z) | {"step": np.full(lattice.shape, 0.008, dtype=np.float32)}
    with raises("RIL-408", "0.008 m plus risk.sigmas", "vehicle.max_step", "0.01"):
        find_path(given, lattice, SHORT, ends=((0.0, 0.06), None))


@pytest.mark.parametrize(
    ("larger", "facts"), [({"track": 0.08}, ("0.095 m wide", "0.05 m")), ({"wheel_base": 1.0}, ("m long", "0.403 m"))]
)
def test_a_vehicle_larger_than_the_map_is_refused(larger: dict[str, float], facts: tuple[str, str]) -> None:
    lattice = Lattice.at(0, 40, CELL, 40, 5)
    with raises("RIL-431", *facts):
        find_path(maps(*level(lattice)), lattice, SHORT.model_copy(update=larger))


SIZES = ("track", "wheel_base", "wheel_diameter")


@pytest.mark.parametrize(
    ("sizes", "times", "side"), [(SIZES, 2.0, "0.08 m"), (SIZES, 1e5, "0.08 m"), (["wheel_base"], 50.0, "0.408 m")]
)
def test_the_map_of_one_pair_may_be_smaller_than_the_vehicle(sizes: list[str], times: float, side: str) -> None:
    """Its cells are unknown and it has no path; of a whole world that is an error: units may be others."""
    lattice = Lattice.at(0, 40, CELL, 40, 8)
    vehicle = SHORT.model_copy(update={name: times * getattr(SHORT, name) for name in sizes})
    dem = Bundle({"elevation": level(lattice)[1]}, {"lattice": lattice.to_dict(), "frame": "local"})
    given = {"vehicle": vehicle.model_dump()}
    risk = risk_stage.run(RiskParams(), given | {"use": "local"}, {"dem": [dem]})
    check_outputs(risk_stage, risk)
    assert risk.meta["shares"]["unknown"] == 1.0
    path = path_stage.run(PathParams(), {"use": "local"}, {"risk": risk})
    check_outputs(path_stage, path)
    assert not path.meta["found"]
    assert f"the map only {side}" in path.meta["reason"]
    with raises("RIL-431", side):
        risk_stage.run(RiskParams(), given, {"dem": [dem]})


def test_limits_that_leave_nothing_to_drive_on_are_named() -> None:
    lattice = Lattice.at(0, 40, CELL, 40, 30)
    risk, z = level(lattice)
    given = maps(np.full_like(risk, HAZARDOUS), z, "tilt")
    facts = describe(find_path(given, lattice, SHORT), given, lattice, SHORT)
    assert facts["found"] is False
    assert [
        fact for fact in ("1200", "tilt", "vehicle.max_slope_deg 20", "world.up") if fact not in facts["reason"]
    ] == []


WALLS = {
    "unknown ground": {"risk": UNKNOWN},
    "a hazard": {"risk": HAZARDOUS, "reason": BITS["step"]},
    "ground too uncertain to be called safe": {"risk": HAZARDOUS, "reason": BITS["step"] | DOUBT_BIT},
}


@pytest.mark.parametrize("margin", [0.0, 0.1])
@pytest.mark.parametrize("planner", ["auto", "grid8"])
@pytest.mark.parametrize("words", [*WALLS, "p_hazard"])
def test_a_local_path_leads_as_far_as_the_ground_is_known_and_safe_and_says_what_ends_it(
    words: str, planner: str, margin: float
) -> None:
    """A wall lies 60 rows ahead of the nearest one; beyond it is more ground than before it."""
    lattice = Lattice.at(-20, 160, CELL, 160, 41)
    risk, z = level(lattice)
    # All ground has the greatest probability that is permitted.
    given = maps(risk, z) | {"p_hazard": np.full(lattice.shape, 0.1, np.float32)}
    rover = SHORT.model_copy(update={"margin": margin})
    for name, value in WALLS.get(words, {"p_hazard": 0.3}).items():
        given[name][80:100] = value
    facts = describe(find_path(given, lattice, rover, params=PathParams(planner=planner)), given, lattice, rover)
    assert facts["found"]
    assert facts["start"][1] <= lattice.ys()[-1] + 4 * SHORT.half_length, "where the vehicle stands"
    assert lattice.ys()[99] - 4 * SHORT.half_length - margin < facts["target"][1] < lattice.ys()[99]
    assert facts["ended_by"] == (words if words in WALLS else "ground too uncertain to be called safe")


def test_a_local_path_ends_at_the_edge_or_at_the_goal() -> None:
    lattice = Lattice.at(-20, 60, CELL, 60, 41)
    given = maps(*level(lattice))
    for ends, words in (((None, None), "the edge of the map"), (((0.0, 0.1), (0.0, 0.4)), "the goal")):
        assert describe(find_path(given, lattice, SHORT, ends=ends), given, lattice, SHORT)["ended_by"] == words


@pytest.mark.parametrize("stretch", [False, True])
@pytest.mark.parametrize("lengths", [0.5, 2.0])
def test_no_path_is_what_does_not_lead_the_length_of_the_vehicle(lengths: float, stretch: bool) -> None:
    lattice = Lattice.at(-20, 200, CELL, 200, 41)
    risk, z = level(lattice)
    risk[: 200 - round(lengths * 2 * SHORT.half_length / CELL)] = HAZARDOUS
    risk[20:22] = 0  # too little ground elsewhere
    on_middle = maps(risk, z, "tilt")  # keeps the middle off, not the wheels
    facts = describe(find_path(on_middle, lattice, SHORT, stretch=stretch), on_middle, lattice, SHORT)
    assert facts["found"] is (lengths > 1)
    if lengths < 1:
        assert "ahead" in facts["reason"]


LONG = SHORT.model_copy(update={"wheel_base": 0.2 - SHORT.wheel_diameter})
"""20 cells long."""


RIM = 12
"""Cells of known ground around a map, on which the outline of that vehicle stays."""


def closed_to_the_middle(free: np.ndarray) -> tuple[dict[str, np.ndarray], Lattice]:
    """Ground on which the vehicle's middle, but not a wheel, is kept off all that is not ``free``, with a rim of it."""
    free = np.pad(free, RIM)
    lattice = Lattice.at(-free.shape[1] // 2, 100, CELL, *free.shape)
    return maps(np.where(free, 0, HAZARDOUS), level(lattice)[1], "tilt"), lattice


@pytest.mark.parametrize("end", ["start", "target"])
@pytest.mark.parametrize(("stub", "found"), [(20, True), (21, False)])
def test_a_path_by_rows_starts_and_ends_within_a_length_of_the_ragged_ends(stub: int, end: str, found: bool) -> None:
    """The last rows hold a few free cells that lead nowhere."""
    free = np.ones((100, 41), bool)
    free[:stub] = False
    free[: stub - 1, 20] = True
    given, lattice = closed_to_the_middle(free if end == "target" else free[::-1])
    route = find_path(given, lattice, LONG, params=PathParams(planner="rows"))
    assert (len(route.cells) > 0) == found
    if end == "start":
        anywhere = find_path(given, lattice, LONG, params=PathParams(planner="grid8"))
        assert (len(anywhere.cells) > 0) == found
    if found:
        rows = (99, stub) if end == "target" else (99 - stub, 0)
        assert (route.cells[[0, -1], 0] - RIM).tolist() == list(rows)
    else:
        assert route.blocking_row == RIM + (stub - 1 if end == "target" else 99 - stub + 1)


@pytest.mark.parametrize("stretch", [False, True])
@pytest.mark.parametrize("planner", ["auto", "rows", "grid8"])
@pytest.mark.parametrize(("rows", "found"), [(21, True), (20, False)])
def test_a_path_across_a_map_no_longer_than_the_vehicle_is_none(
    rows: int, found: bool, planner: str, stretch: bool
) -> None:
    lattice = Lattice.at(-20, 100, CELL, rows, 41)
    given = maps(*level(lattice))
    route = find_path(given, lattice, LONG, stretch=stretch, params=PathParams(planner=planner))
    assert (len(route.cells) == 21) == found
    if not found:
        assert not len(route.cells)
        assert "vehicle's length ahead" in route.reason
        assert route.blocking_row is None, "rows cross the map, or were not sought"


@pytest.mark.parametrize("planner", ["auto", "rows", "grid8"])
def test_only_to_a_target_that_is_asked_for_a_path_may_be_shorter_than_the_vehicle(planner: str) -> None:
    lattice = Lattice.at(-20, 100, CELL, 100, 41)
    given, params = maps(*level(lattice)), PathParams(planner=planner)
    start, target = (tuple(lattice.xy()[row, 20]) for row in (12, 0))
    assert len(find_path(given, lattice, LONG, ends=(start, target), params=params).cells) == 13
    assert not len(find_path(given, lattice, LONG, ends=(start, None), stretch=True, params=params).cells)


@pytest.mark.parametrize(("stretch", "end"), [(False, (5, 2)), (True, (20, 20))])
def test_a_stop_goes_as_far_as_ground_leads_and_a_mission_not_into_its_last_corner(
    stretch: bool, end: tuple[int, int]
) -> None:
    free = np.zeros((100, 41), bool)
    free[20:] = free[5:20, 2] = True
    route = find_path(*closed_to_the_middle(free), LONG, stretch=stretch, params=PathParams(planner="grid8"))
    assert tuple(route.cells[-1] - RIM) == end


def test_on_a_short_map_a_path_by_rows_goes_into_the_last_corner() -> None:
    free = np.zeros((40, 41), bool)
    free[10:] = free[:10, 2] = True
    route = find_path(*closed_to_the_middle(free), LONG, params=PathParams(planner="rows"))
    assert (route.cells[-1] - RIM).tolist() == [0, 2]


def test_a_path_by_rows_begins_in_its_place_however_dear_that_ground_is() -> None:
    free = np.ones((60, 41), bool)
    given, lattice = closed_to_the_middle(free)
    given["risk"][RIM + 45 : RIM + 60, RIM:-RIM] = CAUTION
    route = find_path(given, lattice, LONG, params=PathParams(planner="rows", caution_cost=10.0))
    assert (route.cells[0] - RIM).tolist() == [59, 20]


def test_of_rows_that_all_but_the_last_can_be_entered_the_last_one_blocks() -> None:
    free = np.ones((60, 41), bool)
    free[0, 1:] = free[1, :10] = False
    given, lattice = closed_to_the_middle(free)
    ends = (None, tuple(lattice.xy()[RIM, RIM]))
    route = find_path(given, lattice, LONG, ends=ends, params=PathParams(planner="rows"))
    assert (route.blocking_row, route.reason) == (RIM, "hazardous or unknown ground closes the whole width")
    assert find_path(given, lattice, LONG, ends=ends, params=PathParams(planner="grid8")).blocking_row is None


def test_a_mission_goes_into_the_last_corner_where_it_else_led_no_length_ahead() -> None:
    free = np.zeros((100, 41), bool)
    free[10:30] = free[:10, 2] = free[90:] = True
    route = find_path(*closed_to_the_middle(free), LONG, stretch=True)
    assert (route.cells[[0, -1]] - RIM).tolist() == [[29, 20], [0, 2]]


def test_a_local_path_goes_round_what_closes_the_rows() -> None:
    lattice = Lattice.at(-30, 120, CELL, 120, 61)
    risk, z = level(lattice)
    risk[:10] = HAZARDOUS
    risk[60, :50] = risk[60:90, 50] = HAZARDOUS  # a pocket ahead of the middle, open at the right of it
    risk[100:, 50:] = HAZARDOUS
    given = maps(risk, z)
    facts = describe(find_path(given, lattice, SHORT), given, lattice, SHORT)
    assert facts["found"]
    assert facts["target"][1] > lattice.ys()[60]


def test_going_down_is_no_climb() -> None:
    lattice = Lattice.at(-10, 60, CELL, 50, 21)
    risk, z = level(lattice)
    rows = np.arange(50.0)[:, None]  # the target is in row 0
    for height, top in ((0.002 * rows, 0.0), (0.002 * np.minimum(rows, 49.0 - rows), 0.002 * 24.0)):
        given = maps(risk, z + height)
        route = find_path(given, lattice, SHORT)
        facts = describe(route, given, lattice, SHORT)
        assert len(route.cells) > 30
        assert facts["climb_m"] == pytest.approx(max(0.0, top - facts["start"][2]), abs=0.002)


@pytest.mark.parametrize("blocked", [False, True])
def test_the_stage(blocked: bool) -> None:
    lattice = Lattice.at(-10, 60, CELL, 50, 21)
    risk = np.zeros(lattice.shape, dtype=np.uint8)
    if blocked:
        risk[20] = HAZARDOUS
    y = lattice.ys()[:, None] + np.zeros(lattice.cols)
    arrays = maps(risk, 0.1 * y) | {
        "inclination": np.full(lattice.shape, math.atan(0.1), dtype=np.float32),
        "tilt": np.full(lattice.shape, 0.2, dtype=np.float32),
        "clearance": np.full(lattice.shape, 0.02, dtype=np.float32),
        "p_hazard": np.full(lattice.shape, 0.01, dtype=np.float32),
    }
    arrays["clearance"][30, 10] = 0.015
    source = Bundle(arrays, {"lattice": lattice.to_dict(), "vehicle": SHORT.model_dump(), "frame": "local"})
    out = path_stage.run(PathParams(start=(9.0, 9.0)), {"use": "local"}, {"risk": source})
    check_outputs(path_stage, out)
    assert out.meta["found"]
    if blocked:
        # the front wheels stand half a wheel base before the row
        assert lattice.ys()[24] < out.meta["target"][1] < lattice.ys()[20]
        assert out.meta["ended_by"] == "a hazard"
        return
    outside = 2 * math.ceil(SHORT.half_length / CELL)  # rows at which the outline leaves the map
    assert 50 - outside <= len(out["path"]) <= 50
    assert out.meta["max_inclination"] == pytest.approx(math.atan(0.1))
    assert out.meta["least_clearance"] == pytest.approx(0.015)
    assert out.meta["max_tilt"] == pytest.approx(0.2)
    assert out.meta["max_p_hazard"] == pytest.approx(0.01)
    steps = len(out["path"]) - 1
    # a wheel's mean at the first and last row leans on what lies inside: half a cell of its three
    assert out.meta["climb_m"] == pytest.approx(0.1 * steps * CELL, abs=0.1 * CELL + 1e-6)
    assert out.meta["length_m"] == pytest.approx(steps * CELL * math.hypot(1, 0.1), rel=1e-3)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 9999), rows=st.integers(1, 9), cols=st.integers(1, 9))
def test_the_cell_nearest_to_the_middle_of_a_row_is_the_first_of_the_nearest(seed: int, rows: int, cols: int) -> None:
    rng = np.random.default_rng(seed)
    cells, row = rng.random((rows, cols)) < 0.3, int(rng.integers(rows))
    cells[rng.integers(rows), rng.integers(cols)] = True
    listed = [(int(r), int(c)) for r, c in np.argwhere(cells)]
    assert nearest_middle(cells, row) == min(listed, key=lambda at: abs(at[0] - row) + abs(at[1] - 0.5 * (cols - 1)))


@pytest.mark.parametrize("planner", ["rows", "auto"])
def test_a_target_in_a_closed_ring_is_said_not_to_be_connected(planner: str) -> None:
    lattice = Lattice.at(-60, 120, CELL, 121, 121)
    risk, z = level(lattice)
    risk[45:80, 45:80] = HAZARDOUS
    risk[50:75, 50:75] = risk[0, 0]
    ends = ((0.0, 0.1), (0.02, 0.58))
    route = find_path(maps(risk, z), lattice, SHORT, ends=ends, params=PathParams(planner=planner))
    assert not len(route.cells)
    assert route.reason == "start and target are not connected by ground that the vehicle may cross"
    assert route.blocking_row is None
