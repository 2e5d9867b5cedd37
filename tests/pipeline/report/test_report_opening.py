"""The opening screen in words: tiles, missing local paths, standard deviations that the truth contradicts."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toys.finished import Page, bundles, view, written

from rille.datasets.protocol import Sequence
from rille.pipeline.export.view import UNSTATED, TaskRow
from rille.pipeline.report import delivery, page, summary, terrain_map
from rille.pipeline.report.gather import WorldTerrain
from rille.stages.core import quantities
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import REASONS, RiskParams
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path import PathParams


def metric(value, unit, label="", truth=None, completeness=None):
    return {
        "value": value,
        "unit": unit,
        "label": label,
        "truth": truth,
        "completeness": completeness,
        "how": "counted",
    }


def page_of(**changes):
    """Text of the page of the toy's run, with other facts."""
    run = view()
    facts = summary.summarise(run, summary.collect(run), ()) | changes
    facts["metrics"] = {name: {"group": "", **entry} for name, entry in facts["metrics"].items()}
    return Page(page.render(run, facts, (), ())).text


def test_tiles_say_what_stands_beside_their_figure():
    metrics = {
        "frames_posed": metric(9, "frames", "Frames with a pose", completeness="9 of 10 frames"),
        "trajectory_drift": metric(0.84, "%", "Drift at the end", truth="GPS", completeness="9 of 10 frames"),
        "trajectory_final_error": metric(0.5, "m"),
        "trajectory_path_length": metric(59.9, "m"),
        "path_length": metric(66.6, "m", "Path length"),
        "path_inclination": metric(6.2, "deg"),
        "path_tilt": metric(None, "deg"),
        "mapped_area": metric(None, "m²", "Mapped area"),
    }
    text = page_of(metrics=metrics)
    opening = text[text.index("Frames with a pose") : text.index("Nothing is missing")]
    limit = quantities.number(Vehicle().max_slope_deg)
    figures = ("9 of 10 frames", "0.840 %", "0.500 m", "59.9 m", "against truth", "66.6 m", f"6.20° of {limit}°")
    assert [figure for figure in figures if figure not in opening] == []
    assert "Mapped area" not in opening


def test_a_drive_names_the_limits_that_were_broken_and_how_near_the_others_came():
    metrics = {
        "drive_path_length": metric(1.08, "m", "Length driven", truth="simulator"),
        "drive_placements": metric(273, "placements"),
        "drive_clearance_violations": metric(0, "placements"),
        "drive_tilt_violations": metric(2, "placements"),
        "drive_least_clearance": metric(0.0164, "m"),
        "drive_greatest_tilt": metric(21.0, "deg"),
    }
    text = page_of(metrics=metrics)
    opening = text[text.index("Length driven") :]
    figures = ("1.08 m", "273 placements", "2 placements", "16.4 mm", "21° of 20°", "against truth")
    assert [figure for figure in figures if figure not in opening] == []


def test_every_reason_on_the_map_has_words():
    text = page_of()
    listed = text[text.index("Reasons") :]
    assert [name for name in REASONS if f"{name} :" not in listed] == []


def test_columns_of_pairs_without_anything_are_left_out():
    (first, *_) = summary.collect(view())["pairs"]
    nothing = dict.fromkeys(first)
    pairs = [nothing | {"frame": 0, "matched": 0.5}, nothing | {"frame": 4, "path": "found"}]
    assert "local path Frame Matched Path 0 50 % – 4 – found Overlap:" in page_of(pairs=pairs)


def rows(*paths):
    return [{"frame": 2 * k, "path": path} for k, path in enumerate(paths)]


def test_stops_without_a_local_path_are_told_with_the_reason_of_each():
    (few,) = delivery._local_paths(rows("found", "closed", "found", None, "narrow", "closed"))
    assert "3 of 5" in few["what"]
    assert [fact for fact in ("closed (frames 2, 10)", "narrow (frame 8)") if fact not in few["why"]] == []
    assert delivery._local_paths(rows("found", None)) == []


def failed(label, reason, behind=()):
    return [
        TaskRow(label, "any", "failed", None, reason),
        *(TaskRow(b, "any", "skipped", None, "", cause) for b, cause in behind),
    ]


def test_failures_are_told_by_cause_with_the_tasks_that_depend_on_them():
    tasks = [TaskRow(f"locus/local/{k}", "locus", "computed") for k in range(36)]
    for k in (36, 40):
        behind = [(f"risk/local/{k}", f"locus/local/{k}"), (f"path/local/{k}", f"risk/local/{k}")]
        tasks += failed(f"locus/local/{k}", f"no ground within {k}.5 m: look down", behind)
    tasks += failed("locus/local/44", "too dark: give light")
    tasks += [TaskRow("merge", "merge", "skipped", None, "stopped after locus/local/44 failed")]
    told = delivery._failures(SimpleNamespace(tasks=tasks))
    assert [m["kind"] for m in told] == ["failed", "failed", "skipped"]
    assert [m["why"] for m in told[:2]] == ["no ground within 36.5 m: look down", "too dark: give light"]
    facts = ("2 of 39", "locus/local", "(36, 40)", "4 tasks")
    assert [fact for fact in facts if fact not in told[0]["what"]] == []


def test_the_plane_of_the_first_pair_that_has_one_is_told():
    plane = {"source": "reference plane", "T_local_left": RigidTransform.identity().to_list(), "ground_share": 0.4}
    view = SimpleNamespace(bundle=lambda handle: handle, products=SimpleNamespace(level={0: None, 3: None}))
    assert delivery._reference(view) == []
    view.products.level[3] = Bundle({}, plane)
    (item,) = delivery._reference(view)
    assert "the plane that 40% of the scene lies on (normal [0.00, 0.00, 1.00]" in item["why"]


def test_what_the_images_contradict_is_told_before_what_failed():
    view = SimpleNamespace(tasks=failed("locus/local/1", "no ground at -0.1"), vehicle_source="", part="")
    view.tasks += failed("locus/local/2", "no ground at 0.25")
    found = {"missing": [{"kind": "contradiction", "what": "two motions", "why": ""}], "absent": [], "delivered": []}
    told = delivery.complete(found, view, [])["missing"]
    assert [m["kind"] for m in told] == ["contradiction", "failed"]


@pytest.mark.parametrize(("priors", "told"), [({}, True), ({"odometry": {"drift": 0.02}}, False)])
def test_odometry_that_says_not_how_good_it_is_could_join_pieces(priors, told):
    known = SimpleNamespace(odometry=(), priors=priors)
    view = SimpleNamespace(sequence=SimpleNamespace(loose_odometry=Sequence.loose_odometry.__get__(known)))
    (item,) = delivery._poses(view, [{"frame": k, "posed": True, "in_world": k < 2} for k in range(3)])
    assert ("state drift and turn_deg of [odometry]" in item["why"]) == told


@pytest.mark.parametrize("made", [True, False])
def test_a_part_that_poses_frames_misses_those_that_have_no_pose(made):
    tasks = [TaskRow("trajectory" if made else "track/0", "trajectory" if made else "track", "computed")]
    given = {"tasks": tasks, "part": "--until trajectory", "left_out": {}, "until": (), "only": ()}
    rows = [{"frame": k, "posed": k != 1, "in_world": k < 2} for k in range(3)]
    view = SimpleNamespace(**given, sequence=SimpleNamespace(loose_odometry=False))
    found = {"missing": delivery._poses(view, rows), "absent": [], "delivered": []}
    told = delivery.complete(found, view, [])["missing"]
    assert [m["why"] for m in told] == (["frame 1", "frame 2"] if made else [])


@pytest.mark.parametrize(
    ("figures", "told"),
    [
        ({"trajectory_drift": metric(0.84, "%"), "trajectory_ate_rmse": metric(0.1, "m")}, "drift 0.840 %"),
        ({"trajectory_drift": metric(None, "%"), "trajectory_ate_rmse": metric(0.05, "m")}, "RMSE 50 mm"),
        ({"trajectory_position_drift": metric(2.0, "%")}, "drift 2 %"),
    ],
)
def test_the_verdict_gives_one_figure_against_truth(figures, told):
    verdict = summary._verdict(view(), [], [], figures)
    assert verdict.count("against truth") == 1
    assert f"{told} against truth" in verdict


@pytest.mark.parametrize(
    ("positions", "rotations", "told"),
    [
        (None, None, ""),
        (8.9, 8.9, ""),
        (1.2, 850.0, "off the truth, rotations by about 29 times their"),
        (100.0, 1.0, "off the truth, positions by about 10 times their"),
        (100.0, 400.0, "positions by about 10 times and rotations by about 20 times their"),
    ],
)
def test_standard_deviations_that_truth_contradicts_are_warned_of(positions, rotations, told):
    nees = {"trajectory_nees_position": positions, "trajectory_nees_rotation": rotations}
    found = summary._small_sigma({name: {"value": value} for name, value in nees.items()})
    assert len(found) == bool(told)
    assert told in "".join(found)
    # A map whose poses hold stands where it says.
    assert ("not for its place" in "".join(found)) == ("positions" in told)


def given(positions, rotation, footprint):
    """A run with these positions (frame, 3), f = 350 px, 600 x 200 pixels, a baseline of .5 m."""
    poses = np.concatenate([np.broadcast_to(rotation, (len(positions), 3, 3)), positions[:, :, None]], axis=2)
    trajectory = Bundle({"poses": poses, "piece": np.zeros(len(poses), np.int16)}, {"main": 0})
    level = SimpleNamespace(meta={"footprint": footprint, "plane": footprint and [0.0, 0.75, -2.0]})
    camera = SimpleNamespace(fx=350.0, fy=350.0, width=600, height=200)
    levels = {0: level, 4: None}
    return SimpleNamespace(
        products=SimpleNamespace(trajectory=trajectory, level=levels, ground=levels),
        sequence=SimpleNamespace(rig=SimpleNamespace(left=camera, baseline=0.5)),
        bundle=lambda handle: handle,
    )


AHEAD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""R_world_left of a level camera that looks along y."""


@pytest.mark.parametrize(
    ("way", "by_focal_length"),
    [([0.0, 1.0, 0.0], "0.120 m"), ([0.6, 0.8, 0.0], "76.8 mm"), ([1.0, 0.0, 0.0], "0 m")],
)
def test_what_rests_on_the_given_numbers_is_said_in_figures_of_the_run(way, by_focal_length):
    """12 m ahead, aslant and aside: a focal length scales the part along the optical axis alone."""
    positions = np.outer(np.arange(13.0), way)
    positions[3] = np.nan
    (line,) = summary.given_numbers(given(positions, AHEAD, [-3.0, 3.0, 4.0, 16.0]))
    assert "baseline (0.500 m) is 0.120 m of the path of 12 m;" in line
    assert f"focal length (350 px) is {by_focal_length};" in line
    assert "(6 px) leads its end 0.206 m aside" in line
    assert "ground 10 m ahead by 57.1 mm" in line
    assert line.endswith("the left camera stands 1.60 m above the ground.")


def test_nothing_rests_on_the_given_numbers_of_a_camera_without_a_path():
    assert summary.given_numbers(given(np.zeros((5, 3)), AHEAD, None)) == []
    assert "ground" not in summary.given_numbers(given(np.eye(3), AHEAD, None))[0]


def test_an_imu_that_contradicts_the_images_is_warned_of():
    """A camera at rest by its images; rates in degrees a second, and gravity off the ground that is seen."""
    run = given(np.zeros((9, 3)), AHEAD, None)
    run.products.trajectory.meta["frames"] = list(range(9))
    level = RigidTransform(AHEAD, np.zeros(3)).to_list()
    ground = {"source": "attitude", "T_local_left": level, "plane": None, "ground_share": 0.0}
    run.products.ground[0].meta.update(ground)
    spun = [Rotation.from_rotvec([0.0, 0.2 * k, 0.0]).as_matrix() for k in range(9)]
    known = {"imu_axes": np.eye(3), "times": 0.05 * np.arange(9), "pitch": None, "attitude": spun}
    run.sequence.__dict__.update(known)
    (rates,) = summary._sensed_turns(run)
    assert summary._verticals(run) == []
    assert "degrees a second" in rates
    run.products.ground[0].meta["seen_up"] = [0.0, 0.0, -1.0]
    run.sequence.attitude = [np.eye(3)] * 9
    (gravity,) = summary._verticals(run)
    assert summary._sensed_turns(run) == []
    assert "up is 90 degrees off" in gravity
    run.sequence.imu_axes = None
    run.products.ground[0].meta.update(source="pitch")
    run.sequence.pitch = 0.0
    (pitch,) = summary._verticals(run)
    assert "looks down by 90 degrees" in pitch
    run.products.ground[0].meta.update(source="none")
    assert summary._sensed_turns(run) == summary._verticals(run) == []


@pytest.mark.parametrize(("warnings", "told"), [([], 1), (["the truth fits better by another convention"], 0)])
def test_standard_deviations_are_not_judged_by_truth_that_was_misread(warnings, told):
    made = bundles()
    metrics = made["accuracy"].meta["metrics"] | {"nees_rotation": {"value": 850.0, "unit": "", "how": ""}}
    made["accuracy"] = Bundle(made["accuracy"].arrays, {"metrics": metrics, "warnings": warnings})
    lines = summary.collect(view(made))["warnings"]
    assert sum("times their standard deviations" in line for line in lines) == told


@pytest.mark.parametrize(("source", "told"), [(UNSTATED, True), ("user", False)])
def test_limits_that_nobody_stated_are_told(tmp_path, source, told):
    config = SimpleNamespace(vehicle=Vehicle(), risk=RiskParams(), path=PathParams())
    facts, read, _, _ = written(tmp_path, view(config=config, vehicle_source=source))
    assert [m["kind"] for m in facts["absent"]] == ["vehicle"] * told
    assert ("0.700 m between its axles, 0.600 m between its wheels, up to 20°" in read.text) == told


@pytest.mark.parametrize(
    ("change", "told"), [({}, 1), ({"asked": 0.1}, 0), ({"observed": True}, 0), ({"freed": True}, 0)]
)
def test_a_turn_that_the_images_ask_for_but_cannot_tell_is_undecided(change, told):
    yaw = {"name": "yaw", "freed": False, "observed": False, "asked": 0.4, "sigma": 0.05} | change
    assert summary.undecided([yaw], 4.0) == [yaw] * told
    assert summary.undecided([yaw], 10.0) == []


@pytest.mark.parametrize(
    ("scale", "told"), [(None, "compare a known length"), (-0.31, "that of depth, is off by 0.31 %")]
)
def test_what_is_undecided_is_judged_by_the_truth(scale, told):
    yaw = {"name": "yaw", "asked": 0.4, "sigma": 0.05}
    rig = {"rigs": 1, "source": "given", "changed": False, "residual_before_px": 0.1, "residual_after_px": 0.1}
    text = page_of(
        rig=rig | {"parameters": [yaw], "undecided": [yaw]}, metrics={"trajectory_scale_error": metric(scale, "%")}
    )
    assert told in text
    assert "yaw +0.4000°" in text


def test_the_profile_shows_the_inclination_that_was_judged():
    lattice = Lattice.snap((0.0, 4.0, 0.0, 3.0), 1.0)
    inclination = np.arange(lattice.rows * lattice.cols, dtype=np.float64).reshape(lattice.shape) / 100
    inclination[1, 1] = np.nan
    centres = lattice.xy()
    path = np.array([[*centres[2, 3], 0.5], [*centres[1, 1], 0.6], [centres[0, 0][0] - 5.0, 0.0, 0.7]])
    risk = WorldTerrain(lattice, {"inclination": inclination})
    found = terrain_map._path(SimpleNamespace(path=path, risk=risk))
    assert found[0] == [*path[0], round(float(np.degrees(inclination[2, 3])), 2)]
    assert [row[3] for row in found[1:]] == [None, None]
    assert terrain_map._path(SimpleNamespace(path=None, risk=None)) == []


@pytest.mark.parametrize(("outside", "unsure", "told"), [(0.06, 0.05, True), (0.05, 0.04, False), (0.3, 0.0, True)])
def test_of_the_pair_whose_map_lacks_most_it_is_told_what_brings_that_in(outside, unsure, told):
    def lacking(*shares):
        facts = dict(zip(("outside", "unsure"), shares, strict=True)) | {"settings": {"locus.max_sigma": 0.02}}
        return SimpleNamespace(meta={"coverage": facts | {"size": [3.0, 40.0]}})

    maps = {0: lacking(0.01, 0.0), 4: lacking(outside, unsure), 8: SimpleNamespace(meta={})}
    run = SimpleNamespace(products=SimpleNamespace(local_dem=maps), bundle=lambda handle: handle)
    lines = delivery.coverage(run)
    assert len(lines) == told
    assert all("pair 4" in line and "--set locus.max_sigma=0.02" in line for line in lines)


@pytest.mark.parametrize(
    ("source", "risk", "told"), [("ground plane", {}, 1), ("pitch", {}, 0), ("ground plane", None, 0)]
)
def test_that_a_slope_of_all_ground_counts_as_level_is_told_where_nothing_gives_the_vertical(source, risk, told):
    levels = {pair: SimpleNamespace(meta={"source": source}) for pair in (0, 4)}
    run = SimpleNamespace(products=SimpleNamespace(level=levels, world_risk=risk), bundle=lambda handle: handle)
    assert len(delivery.unmeasured_vertical(run)) == told
