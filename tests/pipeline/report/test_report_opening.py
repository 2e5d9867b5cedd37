"""The opening screen in words: tiles, missing local paths, standard deviations that the truth contradicts."""

from types import SimpleNamespace

import numpy as np
import pytest
from toys.finished import view, written

from rille.pipeline.export.view import UNSTATED
from rille.pipeline.report import checks, delivery, page, summary, tables, terrain_map
from rille.pipeline.report.canvas import Table
from rille.pipeline.report.gather import Terrain
from rille.stages.calibration.rig import RigParams
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import REASONS, RiskParams
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path import PathParams


def metric(value, unit, label="", truth=None, completeness=None):
    return {"value": value, "unit": unit, "label": label, "truth": truth, "completeness": completeness}


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
    assert page._tiles(metrics, 20.0) == [
        ("Frames with a pose", "9 of 10 frames", ""),
        ("Drift at the end", "0.840 %", "0.500 m at the end; of 59.9 m driven; against truth; 9 of 10 frames"),
        ("Path length", "66.6 m", "inclination up to 6.20° of 20°"),
    ]


def test_a_drive_names_the_limits_that_were_broken_and_how_near_the_others_came():
    metrics = {
        "drive_path_length": metric(1.08, "m", "Length driven", truth="simulator"),
        "drive_placements": metric(273, "placements"),
        "drive_clearance_violations": metric(0, "placements"),
        "drive_tilt_violations": metric(2, "placements"),
        "drive_least_clearance": metric(0.0164, "m"),
        "drive_greatest_tilt": metric(21.0, "deg"),
    }
    words = (
        "judged at 273 placements; tilted beyond the limit at 2 placements; at least 16.4 mm of room under the belly"
    )
    assert page._tiles(metrics, 20.0) == [("Length driven", "1.08 m", f"{words}; tilt up to 21° of 20°; against truth")]


def test_every_reason_on_the_map_has_words():
    assert dict(page.reasons()).keys() == REASONS.keys()


def test_columns_of_pairs_without_anything_are_left_out():
    given = {name: None for _, name, _ in tables._PAIR_COLUMNS}
    two = [given | {"frame": 0, "matched": 0.5}, given | {"frame": 4, "path": "found"}]
    assert tables.pair_table(two) == Table(
        ("Frame", "Matched", "Path"), (("0", "50 %", "–"), ("4", "–", "found")), (0, 1)
    )


def test_where_stops_are_closed():
    two = [{"frame": k, "path": "closed", "blocked_m": m} for k, m in ((0, 4.0), (2, 12.345))]
    (item,) = delivery._local_paths(two, merged=False)
    assert item["why"] == "closed (frames 0, 2; closed 4 to 12.3 m ahead)"


def rows(*paths):
    return [{"frame": 2 * k, "path": path} for k, path in enumerate(paths)]


def test_a_missing_local_path_names_the_shorter_list_of_stops_and_whether_there_is_a_merged_path():
    (few,) = delivery._local_paths(rows("found", "closed", "found", None, "found"), merged=False)
    assert few["what"] == "1 of 4 stops have no local path"
    assert few["why"] == "closed (frame 2)"
    (most,) = delivery._local_paths(rows("closed", "closed", "found", "closed"), merged=True)
    assert most["why"].startswith(
        "closed (all stops but frame 4); a path over the merged terrain was found all the same"
    )
    (one,) = delivery._local_paths(rows("closed"), merged=True)
    assert "one stop sees" in most["why"]
    assert one["why"].endswith("found all the same")
    (all_of_them,) = delivery._local_paths(rows("closed", "closed"), merged=False)
    assert all_of_them["why"] == "closed (frames 0, 2)"
    assert delivery._local_paths(rows("found", None), merged=True) == []


@pytest.mark.parametrize(("nees", "words"), [(None, []), (8.9, []), (850.0, ["about 29 times too small"])])
def test_standard_deviations_that_truth_contradicts_are_warned_of(nees, words):
    accuracy = SimpleNamespace(meta={"metrics": {"nees": {"value": nees}}})
    view = SimpleNamespace(products=SimpleNamespace(accuracy=accuracy), bundle=lambda handle: handle)
    found = summary._sigma_warning(view)
    assert len(found) == len(words)
    assert all(word in line for word, line in zip(words, found, strict=True))


def given(positions, rotation, footprint):
    """A run with these positions (frame, 3), f = 350 px, 600 x 200 pixels, a baseline of .5 m."""
    poses = np.concatenate([np.broadcast_to(rotation, (len(positions), 3, 3)), positions[:, :, None]], axis=2)
    level = SimpleNamespace(meta={"footprint": footprint})
    camera = SimpleNamespace(fx=350.0, fy=350.0, width=600, height=200)
    return SimpleNamespace(
        products=SimpleNamespace(trajectory=Bundle({"poses": poses}, {}), level={0: level, 4: None}),
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


def test_nothing_rests_on_the_given_numbers_of_a_camera_without_a_path():
    assert summary.given_numbers(given(np.zeros((5, 3)), AHEAD, None)) == []
    assert "ground" not in summary.given_numbers(given(np.eye(3), AHEAD, None))[0]


def test_standard_deviations_are_not_judged_by_truth_that_was_misread():
    metrics = {"nees": {"value": 850.0}}
    accuracy = SimpleNamespace(meta={"metrics": metrics, "warnings": ["the truth fits better by another convention"]})
    view = SimpleNamespace(products=SimpleNamespace(accuracy=accuracy), bundle=lambda handle: handle)
    assert summary._sigma_warning(view) == []


@pytest.mark.parametrize(("source", "told"), [(UNSTATED, True), ("user", False)])
def test_limits_that_nobody_stated_are_told(tmp_path, source, told):
    config = SimpleNamespace(vehicle=Vehicle(), risk=RiskParams(), path=PathParams())
    facts, read, _, _ = written(tmp_path, view(config=config, vehicle_source=source))
    assert [m["kind"] for m in facts["absent"]] == ["vehicle"] * told
    assert ("0.700 m between its axles, 0.600 m between its wheels, up to 20°" in read.text) == told


@pytest.mark.parametrize(
    ("change", "scale", "words"),
    [
        ({"significance": 10.0}, None, None),
        ({}, None, "compare a known length"),
        ({}, -0.31, "with it that of depth, is off by 0.31 %"),
        ({"asked": 0.1}, None, None),
        ({"observed": True}, None, None),
        ({"freed": True}, None, None),
    ],
)
def test_a_turn_that_the_images_ask_for_but_cannot_tell_is_judged_by_the_truth(change, scale, words):
    yaw = {"name": "yaw", "freed": False, "observed": False, "asked": 0.4, "sigma": 0.05} | change
    accuracy = None if scale is None else SimpleNamespace(meta={"metrics": {"scale_error": {"value": scale}}})
    params = RigParams(significance=yaw.pop("significance", 4.0))
    config, products = SimpleNamespace(rig=params), SimpleNamespace(accuracy=accuracy)
    scene = SimpleNamespace(view=SimpleNamespace(config=config, products=products, bundle=lambda h: h))
    found = " ".join(checks._untold(scene, SimpleNamespace(collected=lambda name: [yaw])))
    assert words in found if words else found == ""
    assert "yaw +0.4000°" in found or not words


def test_the_profile_shows_the_inclination_that_was_judged():
    lattice = Lattice.snap((0.0, 4.0, 0.0, 3.0), 1.0)
    inclination = np.arange(lattice.rows * lattice.cols, dtype=np.float64).reshape(lattice.shape) / 100
    inclination[1, 1] = np.nan
    centres = lattice.xy()
    path = np.array([[*centres[2, 3], 0.5], [*centres[1, 1], 0.6], [centres[0, 0][0] - 5.0, 0.0, 0.7]])
    risk = Terrain(lattice, {"inclination": inclination})
    found = terrain_map._path(SimpleNamespace(path=path, risk=risk))
    assert found[0] == [*path[0], round(float(np.degrees(inclination[2, 3])), 2)]
    assert [row[3] for row in found[1:]] == [None, None]
    assert terrain_map._path(SimpleNamespace(path=None, risk=None)) == []
