"""Elevation models against truth, by hand: the error never without the completeness."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation.dem_accuracy import dem_accuracy, dem_accuracy_stage, in_window
from rille.stages.geometry.lattice import Lattice

CELL = 0.5


def test_figures_by_hand() -> None:
    """Errors 1, 1, 1, 5 mm of five cells seen; one cell is not given, one given but not seen."""
    truth = np.zeros((2, 3), dtype=np.float32)
    dem = np.array([[1e-3, 1e-3, 1e-3], [5e-3, np.nan, 9.0]], dtype=np.float32)
    seen = np.array([[1, 1, 1], [1, 1, 0]], dtype=bool)
    std = np.full_like(dem, 3e-3)
    value = {k: m["value"] for k, m in dem_accuracy(dem, std, truth, seen).items()}
    assert value["rmse"] == pytest.approx(np.sqrt(7) * 1e-3, rel=1e-6)
    assert value["nmad"] == pytest.approx(0.0, abs=1e-9)
    assert value["bias"] == pytest.approx(2e-3, rel=1e-6)
    assert value["p95"] == pytest.approx(4.4e-3, rel=1e-6)  # linear between the 3rd and the 4th of four
    assert value["completeness"] == pytest.approx(0.8)
    assert (value["within_1_sigma"], value["within_2_sigma"]) == (0.75, 1.0)


def test_nmad_is_the_standard_deviation_of_normal_errors() -> None:
    error = np.random.default_rng(0).normal(scale=2e-3, size=(200, 200)).astype(np.float32)
    error[:5] = 1.0  # 2.5 % of outliers move it by less than 5 %
    found = dem_accuracy(error, np.full_like(error, 2e-3), np.zeros_like(error), np.ones(error.shape, dtype=bool))
    assert found["nmad"]["value"] == pytest.approx(2e-3, rel=0.06)
    assert found["rmse"]["value"] > 0.1
    assert found["within_1_sigma"]["value"] == pytest.approx(0.975 * 0.683, abs=0.01)
    assert found["within_2_sigma"]["value"] == pytest.approx(0.975 * 0.954, abs=0.01)


def test_leaving_out_hard_cells_shows() -> None:
    truth = np.zeros((10, 10), dtype=np.float32)
    dem = truth.copy()
    dem[:5] = np.nan
    found = dem_accuracy(dem, dem, truth, np.ones((10, 10), dtype=bool))
    assert (found["rmse"]["value"], found["completeness"]["value"]) == (0.0, 0.5)
    nothing = dem_accuracy(dem, dem, truth, np.zeros((10, 10), dtype=bool))
    assert nothing["rmse"]["value"] is None
    assert nothing["completeness"]["value"] is None
    assert nothing["within_1_sigma"]["value"] is None


def test_the_window_is_in_metres() -> None:
    lattice = Lattice.at(-2, 4, CELL, 5, 5)  # x -1 .. 1, y 2 .. 0
    inside = in_window(lattice, (-0.5, 1.0, 0.5, 2.0))
    expected = np.zeros((5, 5), dtype=bool)
    expected[:3, 1:4] = True
    np.testing.assert_array_equal(inside, expected)
    assert in_window(lattice, None).all()


def test_the_stage_lays_tiles_on_the_lattice_of_truth() -> None:
    whole = Lattice.at(0, 10, CELL, 6, 8)
    z = np.arange(48, dtype=np.float32).reshape(6, 8)
    truth = Bundle({"elevation": z, "seen": np.ones((6, 8), dtype=np.uint8)}, {"lattice": whole.to_dict()})
    part = Lattice.at(0, 10, CELL, 6, 4)
    std = np.full((6, 4), 0.2, dtype=np.float32)
    tile = Bundle({"elevation": z[:, :4] + np.float32(0.25), "elevation_std": std}, {"lattice": part.to_dict()})
    out = dem_accuracy_stage.run(NoParams(), {}, {"dem": [tile], "truth": truth})
    check_outputs(dem_accuracy_stage, out)
    assert (out["error"][:, :4] == 0.25).all()
    assert np.isnan(out["error"][:, 4:]).all()
    assert out.meta["metrics"]["completeness"]["value"] == 0.5
    assert out.meta["metrics"]["unseen"]["value"] == 0
    assert out.meta["metrics"]["within_1_sigma"]["value"] == 0.0
    assert out.meta["metrics"]["within_2_sigma"]["value"] == 1.0
    window = dem_accuracy_stage.run(NoParams(), {"window": [0.0, 4.5, 1.5, 5.0]}, {"dem": [tile], "truth": truth})
    assert window.meta["metrics"]["completeness"]["value"] == 1.0
