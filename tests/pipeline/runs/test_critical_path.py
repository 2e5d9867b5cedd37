"""How the time of a run is accounted for, on ledgers whose figures can be summed by hand."""

from __future__ import annotations

import json

import pytest
from toys.chain import run

from rille.pipeline.runs import critical_path


def ledger(path, rows, **facts):
    """Rows of (label, kernel seconds, inputs)."""
    lines = [{"run": {"jobs": 2, **facts}}]
    for label, kernel, inputs in rows:
        if label == "expansion":
            lines.append({"expansion": {"after": kernel, "nodes": inputs}})
            continue
        row = {"label": label, "stage": label[0], "inputs": {"x": inputs}, "status": "computed", "kernel": kernel}
        lines.append(row | {"seconds": kernel + 0.1, "started": 100.0, "ended": 100.0 + kernel})
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def test_the_least_time_is_the_longest_chain_or_the_work_over_the_workers(tmp_path):
    rows = [("a", 3.0, []), ("b", 1.0, []), ("c", 2.0, ["a", "b"]), ("d", 0.5, ["b"])]
    found = critical_path.timing(ledger(tmp_path / "l", rows, seconds=9.0))
    assert found.chain == (("a", 3.0), ("c", 2.0))
    assert (found.kernel, found.longest, found.least) == (6.5, 5.0, 5.0)
    assert found.good == pytest.approx(1.15 * 5 + 5)
    wide = [(f"n{k}", 2.0, []) for k in range(6)]
    assert critical_path.timing(ledger(tmp_path / "w", wide, seconds=9.0)).least == 6.0


def test_what_was_laid_out_later_waited_for_what_laid_it_out(tmp_path):
    rows = [("a", 3.0, []), ("b", 4.0, []), ("expansion", ["a", "b"], ["c", "d"]), ("c", 1.0, []), ("d", 2.0, ["c"])]
    assert critical_path.timing(ledger(tmp_path / "l", rows)).chain == (("b", 4.0), ("c", 1.0), ("d", 2.0))


def test_a_run_that_was_killed_is_timed_by_its_tasks_and_the_whole_command_where_it_is_known(tmp_path):
    rows = [("a", 3.0, []), ("b", 1.0, ["a"])]
    assert critical_path.timing(ledger(tmp_path / "l", rows)).wall == 3.0
    assert critical_path.timing(ledger(tmp_path / "l", rows, seconds=4.5, total=6.0)).wall == 6.0


def test_seconds_of_compiling_are_told_by_stage(tmp_path):
    row = {"inputs": {}, "status": "computed", "kernel": 9.0, "seconds": 9.0, "started": 1.0, "ended": 10.0}
    compiled = [("track/1", "track", 2.5), ("hfvm/1", "hfvm", 4.0), ("track/2", "track", 2.0), ("rig", "rig", 0.0)]
    rows = [row | {"label": label, "stage": stage, "compiling": s} for label, stage, s in compiled]
    path = tmp_path / "l"
    path.write_text("".join(json.dumps(line) + "\n" for line in rows))
    assert critical_path.timing(path).compiling == (("track", 4.5), ("hfvm", 4.0))


def test_a_real_ledger_is_told_in_words(tmp_path):
    first, second = run(tmp_path, "1"), run(tmp_path, "2")
    told = list(critical_path.describe(first))
    assert told[0].startswith("run toy/1: ")
    assert "9 tasks computed with 1 worker" in told[0]
    assert told[2].startswith("longest chain ")
    assert "1.15 times the least possible and 5 s" in told[5]
    assert list(critical_path.describe(second))[1] == "nothing was computed"
