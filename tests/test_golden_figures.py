"""Figures of short sequences: a loss of accuracy is seen before the slow tests run.

Of two real sequences, preset ``fast``, within 25 %. Of two simulated pairs, preset ``default``, within 5 %: their truth
is exact and dense, so that an error of one pixel in a thousand shows.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rille.pipeline.report import summary
from rille.pipeline.runs import run_files, session

SIMULATED = {
    "trajectory_final_error": 1.36e-5,  # metres
    "disparity_median": 0.1220,  # pixels
    "disparity_completeness": 0.805,
    "disparity_bad_2": 0.1207,
    "disparity_bad_2_matched": 0.01237,
    "disparity_within_1_sigma": 0.762,
    "dem_merged_rmse": 4.70e-4,  # metres
    "dem_merged_completeness": 0.852,
    "hazardous": 0.0824,
    "unknown": 0.4268,
    "path_length": 0.4591,  # metres
}

REAL = {
    "kitti06_51": {
        "frames_posed": 6,
        "trajectory_drift": 1.08,  # per cent of 6 m
        "trajectory_ate_rmse": 0.0049,  # metres
        "trajectory_rpe_translation_rmse": 0.0112,  # metres
        "matched": 0.787,
        "mapped_area": 317,  # square metres
        "elevation_sigma": 0.0191,  # metres
        "overlap_median": 0.0024,  # metres, between elevation models
    },
    "devon_island": {  # without truth; its rig is off, and is repaired, its yaw by the tracks
        "frames_posed": 6,
        "rig_residual_given": 0.602,  # pixels
        "rig_residual": 0.356,
        "matched": 0.876,
        "mapped_area": 76.2,
        "elevation_sigma": 0.0063,
        "overlap_median": 0.00039,
        "safe": 0.535,
        "path_length": 9.14,  # metres
    },
}


def figures(name: str, settings: tuple[str, ...], frames: str, folder: Path) -> dict[str, float]:
    """Figures of a run by name; of all its outputs only they are made."""
    options = session.Options(
        (*settings, "crosscheck.enabled=false"),
        frames=frames,
        executor="inline",
        runs=folder / "runs",
        cache=folder / "cache",
        quiet=True,
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(run_files, "MODULES", (summary,))
        assert session.perform(name, options).code == 0
    report = json.loads(next(folder.glob("runs/*/latest/report.json")).read_text())
    return {figure: report["metrics"][figure]["value"] for figure in report["metrics"]}


def test_figures_of_simulated_pairs_are_those_stated(tmp_path: Path) -> None:
    found = figures("mockup-short", (), "0:2", tmp_path)
    assert {figure: found[figure] for figure in SIMULATED} == pytest.approx(SIMULATED, rel=0.05)


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_figures_are_those_stated(name: str, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RILLE_DATA", str(data_dir))  # devon_island is known by its name, not by a folder
    sequence = name if name == "devon_island" else str(data_dir / name)
    found = figures(sequence, ("hfvm.preset=fast",), "0:6", tmp_path)
    assert {figure: found[figure] for figure in REAL[name]} == pytest.approx(REAL[name], rel=0.25)
