"""``rille compare``: what one of the runs lacks is told, and is no equal result."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rille.pipeline.commands.results.compare import _figures, _positions, _tasks
from rille.stages.geometry.geometry import RigidTransform, rotation_exp


def ledger(run: Path, **digests: str | None) -> Path:
    """Folder of a run whose tasks have these results; None: failed."""
    run.mkdir()
    rows = [{"label": n, "stage": n} | ({"digest": d} if d else {"state": "failed"}) for n, d in digests.items()]
    (run / "ledger.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def test_a_failed_task_has_no_result(tmp_path: Path) -> None:
    a = ledger(tmp_path / "a", same="1", other="2", fails="3", broken=None)
    b = ledger(tmp_path / "b", same="1", other="4", fails=None, broken=None, more="5")
    head, *stages = _tasks(a, b)
    assert head.split(maxsplit=1)[1] == "1 with the same result, 1 with another"
    assert {line.strip() for line in stages} == {
        "other: 1 another result, the first to differ",
        f"by the manifest, parameters, files or code: rille why {tmp_path.name}/b other",
        "fails: 1 in A alone",
        "more: 1 in B alone",
        "broken: 1 without a result in both",
    }


def test_where_a_difference_begins_is_said(tmp_path: Path) -> None:
    runs = []
    for name, rows in {
        "a": {"image": ("1", {}), "mask": ("2", {"image": "image"}), "match": ("3", {"read": ["mask", "image"]})},
        "b": {"image": ("1", {}), "mask": ("4", {"image": "image"}), "match": ("5", {"read": ["mask", "image"]})},
    }.items():
        lines = [{"label": n, "stage": n, "digest": digest, "inputs": of} for n, (digest, of) in rows.items()]
        runs.append(tmp_path / name)
        runs[-1].mkdir()
        (runs[-1] / "ledger.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    _, *stages = _tasks(*runs)
    assert [line.strip() for line in stages] == [
        "mask: 1 another result, the first to differ",
        "match: 1 another result",
        f"by the manifest, parameters, files or code: rille why {tmp_path.name}/b mask",
    ]


@pytest.mark.parametrize("first", [0, 2])
def test_positions_of_runs_that_begin_at_other_frames_are_compared_in_one_world(tmp_path: Path, first: int) -> None:
    poses = [RigidTransform(rotation_exp([0.0, 0.0, 0.1 * k]), np.array([0.3 * k, 1.0 * k, 0.0])) for k in range(6)]
    about = {"units": {"time": "s"}, "frames_of_reference": {"world": {"definition": ""}}}
    for name, start in (("a", 0), ("b", first)):
        (tmp_path / name).mkdir()
        frames = [{"frame": k, "name": str(k), "time": float(k)} for k in range(start, 6)]
        own = [(poses[start].inverse() @ poses[k]).to_list() for k in range(start, 6)]
        (tmp_path / name / "frames.json").write_text(json.dumps(about | {"frames": frames}))
        np.savetxt(tmp_path / name / "trajectory.kitti", own)
    line = _positions(tmp_path / "a", tmp_path / "b")
    assert ("laid on each other" in line) == (first > 0)
    assert f"of {6 - first} frames" in line
    assert "RMS 0 m" in line


def test_figures_of_one_run_are_told() -> None:
    both = {"drift": {"label": "Drift", "value": 1.0, "unit": "m"}}
    alone = {"climb": {"label": "Climb", "value": 0.5, "unit": "m"}}
    clock = {"wall_clock": {"label": "Time", "value": 3.0, "unit": "s"}}
    lines = list(_figures({"metrics": both | alone | clock}, {"metrics": both}))
    assert "1 equal" in lines[0]
    assert [line.strip() for line in lines[1:]] == ["Climb: 0.500 m -> none"]
