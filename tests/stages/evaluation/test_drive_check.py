"""A drive against the truth: every placement counts, whatever became of the drive."""

from __future__ import annotations

import numpy as np

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.evaluation.drive_check import drive_check_stage, localisation
from rille.stages.hazard.vehicle import Vehicle

VEHICLE = Vehicle(wheel_diameter=0.03, track=0.08, wheel_base=0.1, clearance=0.025, max_step=0.012, max_slope_deg=20.0)


def leg(steps: list[float], frame_at: list[int]) -> Bundle:
    """Placements 5 mm apart along y."""
    n = len(steps)
    trail = np.tile(np.eye(3, 4), (n, 1, 1))
    trail[:, 1, 3] = 0.005 * np.arange(n)
    still = {"tilt": np.zeros(n), "clearance": np.full(n, 0.02)}
    return Bundle({"trail": trail, "step": np.array(steps), "frame_at": np.array(frame_at), **still}, {})


def test_a_drive_that_failed_is_judged_by_all_that_it_drove() -> None:
    start, last = leg([0.001], [0]), leg([0.001, 0.013, 0.002], [0, 2])
    args = {"rows": [0, -1], "vehicle": VEHICLE.model_dump(mode="json")}
    found = drive_check_stage.run(NoParams(), args, {"drives": [start, last]})
    metrics = found.meta["metrics"]
    assert metrics["placements"]["value"] == 4
    assert metrics["step_violations"]["value"] == 1
    assert metrics["path_length"]["value"] == 0.01
    assert found.meta["path_exists"] is None
    assert "localisation_error" not in metrics


def test_a_leg_that_was_cut_short_counts_up_to_there() -> None:
    cut = {"rows": [0], "vehicle": VEHICLE.model_dump(mode="json")}
    found = drive_check_stage.run(NoParams(), cut, {"drives": [leg([0.001, 0.013, 0.002], [0, 2])]})
    assert found.meta["metrics"]["placements"]["value"] == 1


def test_where_tracking_is_lost_the_last_known_position_counts() -> None:
    true = np.tile(np.eye(3, 4), (5, 1, 1))
    true[:, 1, 3] = np.arange(5.0)
    estimate = true.copy()
    estimate[2:4, 0, 3] = 0.5, 0.1
    assert localisation(estimate, true, 4.0)[1]["localisation_error"]["value"] == 0.0
    estimate[4] = np.nan
    error, metrics = localisation(estimate, true, 4.0)
    assert np.isnan(error[4])
    assert metrics["localisation_error"]["value"] == 0.1
    assert metrics["localisation_share"]["value"] == 0.025
    assert metrics["greatest_error"]["value"] == 0.5
    assert "last position that is known" in metrics["localisation_error"]["how"]
