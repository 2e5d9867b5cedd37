from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
from raising import raises
from toys import chain

from rille.pipeline.commands.results import runs
from rille.pipeline.engine import events
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import lookup


def test_a_run_is_complete_once_its_files_are_written(tmp_path):
    run, graph = tmp_path / "runs" / "toy" / "1", Graph()
    run.mkdir(parents=True)
    chain.build(graph)
    options = driver.RunOptions(executor="inline", ledger=run / lookup.LEDGER)
    driver.run(graph, Store(tmp_path / "cache"), options)
    assert [line.split()[1] for line in runs.describe([run])] == ["state", "unfinished"]
    events.add_facts(run / lookup.LEDGER, total=1.0)
    assert [line.split()[1] for line in runs.describe([run])] == ["state", "complete"]
    events.add_facts(run / lookup.LEDGER, holes=3)  # as the report counts, although no task has failed
    assert [line.split()[1:3] for line in runs.describe([run])][1] == ["3", "missing"]
    events.add_facts(run / lookup.LEDGER, holes=0, part=True)
    assert [line.split()[1:3] for line in runs.describe([run])][1] == ["a", "part"]
    events.add_facts(run / lookup.LEDGER, part=False)
    report = {"frames": [{"posed": True}, {"posed": False}], "metrics": {"trajectory_drift": {"value": 0.1234}}}
    (run / "report.json").write_text(json.dumps(report))
    assert [*runs.describe([run])][1].split()[-4:] == ["1.0", "1/2", "0.123", "%"]
    for other in ("[]", "[" * 100_000, '{"frames": 3}', '{"frames": [], "metrics": {"trajectory_drift": 1}}'):
        (run / "report.json").write_text(other)
        assert [*runs.describe([run])][1].split()[-1] == "1.0"


@pytest.mark.parametrize("linked", [False, True])
def test_runs_are_found_by_the_names_that_users_type(tmp_path, linked):
    """The latest of all is not the last by name; a link stands for a run that is there already."""
    names = ("a/20260103", "b/20260101", "b/20260102")
    every = [tmp_path / "runs" / name for name in names]
    for run in every:
        run.mkdir(parents=True)
        (run / lookup.LEDGER).touch()
    if linked:
        (tmp_path / "runs/b/latest").symlink_to("20260102")
    assert lookup.all_runs(tmp_path / "runs") == every
    known = {str(tmp_path / "runs/b"): 2} if linked else {}
    known |= {"latest": 0, "a": 0, "b": 2, "20260101": 1, "b/20260101": 1, str(every[1]): 1}
    assert {text: lookup.find(text, tmp_path / "runs") for text in known} == {t: every[k] for t, k in known.items()}
    with raises("RIL-067", "20260103"):
        lookup.find("20260104", tmp_path / "runs")


def test_a_run_has_one_path_however_it_is_named(tmp_path, monkeypatch):
    run = tmp_path / "runs/a/20260103"
    run.mkdir(parents=True)
    (run / lookup.LEDGER).touch()
    (tmp_path / "runs/a/latest").symlink_to("20260103")
    monkeypatch.chdir(tmp_path)
    assert {lookup.find(text, Path("runs")) for text in ("latest", "a", "20260103", "a/20260103")} == {run}


def test_a_closed_folder_of_runs_is_not_said_to_hold_none(tmp_path, monkeypatch):
    def closed(place):
        raise PermissionError(errno.EACCES, "Permission denied", str(place))

    monkeypatch.setattr(os, "scandir", closed)
    with pytest.raises(PermissionError) as caught:
        lookup.find("latest", tmp_path)
    assert caught.value.filename == str(tmp_path)
