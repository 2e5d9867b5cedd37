"""The table of a run's time, on a ledger whose figures can be summed by hand."""

from __future__ import annotations

import json
from pathlib import Path

from rille.pipeline.commands.results import runs


def test_seconds_are_summed_by_stage(tmp_path: Path) -> None:
    run = tmp_path / "toy" / "1"
    run.mkdir(parents=True)
    rows = [("track/1", "track", "computed", 2.5, 2.0), ("hfvm/1", "hfvm", "computed", 4.0, 0.0)]
    rows += [("track/2", "track", "computed", 2.0, 0.25), ("rig", "rig", "cached", 0.0, 0.0)]
    lines: list[object] = [
        {"label": label, "stage": stage, "status": status, "kernel": seconds, "compiling": compiling}
        for label, stage, status, seconds, compiling in rows
    ]
    lines += [{"run": {"jobs": 2}}, {"run": {"seconds": 6.0}}, {"run": {"total": 7.5}}]
    (run / "ledger.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    head, _, *stages = runs.by_stage(run)
    assert head == "run toy/1: 7.5 s with 2 workers"
    assert [line.split() for line in stages] == [
        ["track", "4.5", "2.2", "2", "0"],
        ["hfvm", "4.0", "0.0", "1", "0"],
        ["rig", "0.0", "0.0", "0", "1"],
        ["all", "8.5", "2.2", "3", "1"],
    ]
