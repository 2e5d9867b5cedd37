"""Figures of two short real sequences, within 25 %: a loss of accuracy is seen before the slow tests run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rille.pipeline.runs import session

TOLERANCE = 0.25

FIGURES = {
    "kitti06_51": {
        "frames_posed": 6,
        "trajectory_drift": 1.10,  # per cent of 6 m
        "trajectory_ate_rmse": 0.00502,  # metres
        "trajectory_rpe_translation_rmse": 0.0105,  # metres
        "matched": 0.787,
        "mapped_area": 274,  # square metres
        "elevation_sigma": 0.0240,  # metres
        "overlap_median": 0.0036,  # metres, between elevation models
    },
    "devon_island": {  # without truth; its rig is off, and is repaired, its yaw by the tracks
        "frames_posed": 6,
        "rig_residual_given": 0.656,  # pixels
        "rig_residual": 0.410,
        "matched": 0.876,
        "mapped_area": 77.2,
        "elevation_sigma": 0.00448,
        "overlap_median": 0.00034,
        "safe": 0.518,
        "path_length": 9.31,  # metres
    },
}


@pytest.mark.data
@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_those_stated(name: str, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RILLE_DATA", str(data_dir))  # devon_island is known by its name, not by a folder
    fast = ("hfvm.preset=fast", "crosscheck.enabled=false")
    options = session.Options(
        fast,
        frames="0:6",
        executor="inline",
        runs=tmp_path / "runs",
        cache=tmp_path / "cache",
        progress="quiet",
    )
    assert session.perform(name if name == "devon_island" else str(data_dir / name), options).code == 0
    report = json.loads(next(tmp_path.glob("runs/*/latest/report.json")).read_text())
    figures = {figure: report["metrics"][figure]["value"] for figure in FIGURES[name]}
    assert figures == pytest.approx(FIGURES[name], rel=TOLERANCE)
