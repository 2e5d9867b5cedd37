"""What whole runs must reach: the figures that the README states, with the room that noise needs (slow)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline import run

pytestmark = pytest.mark.slow


def metrics(sequence: str, folder: Path) -> dict[str, Any]:
    options = run.Options(sequence, runs=folder / "runs", cache=folder / "cache", progress="quiet")
    assert run.reconstruct(options) == 0
    report = json.loads(next(folder.glob("runs/*/latest/report.json")).read_text())
    assert report["complete"]
    return {name: m["value"] for name, m in report["metrics"].items()}


def test_mockup(tmp_path: Path) -> None:
    m = metrics("mockup", tmp_path)
    assert m["frames_posed"] == 40
    assert m["trajectory_drift"] <= 0.20  # percent of the path
    assert m["dem_pairs_rmse_max"] <= 1.0e-3
    assert m["dem_pairs_completeness_min"] >= 0.65
    assert 0.05 <= m["path_check_hazardous_share"] <= 0.40
    assert m["path_check_hazard_cells"] == 0
    assert m["path_check_path_length"] >= 0.6


@pytest.mark.data
def test_street(data_dir: Path, tmp_path: Path) -> None:
    m = metrics(str(data_dir / "kitti06_51"), tmp_path)
    assert m["frames_posed"] == 51
    assert m["trajectory_drift"] <= 1.2
