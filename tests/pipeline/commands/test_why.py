"""What is said of one task of a run; how runs and tasks are found by what a user types."""

from __future__ import annotations

import re
import shutil

import pytest
from raising import raises
from toys.chain import run

from rille.pipeline.commands.results import why
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import lookup


def told(folder, at, label):
    return list(why.describe(at, label, Store(folder / "cache")))


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    folder = tmp_path_factory.mktemp("three")
    return folder, run(folder, "1"), run(folder, "2"), run(folder, "3", offset=0.5)


def test_a_computed_task_tells_all_that_it_was_made_from(three):
    folder, _, second, third = three
    lines = told(folder, third, "scale/2")
    assert lines[0] == "scale/2: stage scale, computed in run toy/3"
    assert lines[1] == "why           params.offset 0.0 -> 0.5"
    text = "\n".join(lines)
    numbers = next(r for r in lookup.events.read(third / "ledger.jsonl") if r["label"] == "numbers/2")
    assert f"input         values       numbers/2                digest {numbers['digest'][:12]}, cached" in lines
    assert "parameter     scale.offset = 0.5" in text
    assert "rille.stages.core.declare" in text
    assert "packages      numpy " in text
    assert lines[-1] == "since         toy/2: params.offset 0.0 -> 0.5"
    assert told(folder, second, "scale/2")[-1] == "since         toy/1: nothing changed, the key is the same"


def test_a_cached_task_names_the_run_that_computed_it(three):
    folder, first, _, third = three
    assert (
        told(folder, third, "numbers/0")[1]
        == "why           an artifact of the same key was there; run toy/1 computed it"
    )
    assert told(folder, first, "numbers/0")[1] == "why           never computed"
    assert told(folder, first, "numbers/0")[-1] == "since         no earlier run of this sequence had this task"


def test_a_run_alone_lists_its_tasks_by_stage_and_reason(three):
    _, first, second, third = three
    lines = [" ".join(line.split()) for line in why.summary(third)]
    assert lines[0].endswith("tasks in run toy/3")
    assert any(line.startswith("numbers 4 cached numbers/0, numbers/1") for line in lines)
    which = "scale 4 computed scale/0, scale/1, scale/2 and 1 more"
    assert f"{which}: params.offset 0.0 -> 0.5" in lines
    assert f"{which}: never computed" in [" ".join(line.split()) for line in why.summary(first)]
    assert all(" cached " in f"{line} " for line in list(why.summary(second))[1:])


def test_a_stage_lists_its_tasks_with_reasons(three, tmp_path):
    folder, _, _, third = three
    lines = [" ".join(line.split()) for line in told(folder, third, "scale")]
    assert lines[0] == "4 tasks of stage scale in run toy/3"
    assert lines[1:] == [f"scale/{k} computed params.offset 0.0 -> 0.5" for k in range(4)]
    (tmp_path / "runs" / "toy").mkdir(parents=True)
    other = shutil.copytree(third, tmp_path / "runs" / "toy" / "3") / "ledger.jsonl"
    other.write_text(other.read_text() + '{"label": "total/1", "stage": "total", "status": "cached"}\n')
    lines = told(folder, other.parent, "total")
    assert lines[0].startswith("total: stage total"), "a task of that name comes first"
    assert lines[1].split() == ["stage", "total", "has", "also", "total/1"]
    with raises("RIL-068", "numbers"):
        told(folder, third, "number")


def test_it_may_be_a_run_of_another_sequence(tmp_path):
    run(tmp_path, "1"), run(tmp_path, "2", sequence="other", offset=0.5)
    at = run(tmp_path, "3", sequence="other")
    lines = told(tmp_path, at, "scale/1")
    assert lines[1] == "why           an artifact of the same key was there; run toy/1 computed it"
    assert lines[-1] == "since         other/2: params.offset 0.5 -> 0.0", "compared with runs of its own"


def test_many_inputs_are_counted_and_an_artifact_that_has_gone_is_said(tmp_path):
    at = run(tmp_path, "1", frames=11)
    lines = told(tmp_path, at, "total")
    assert sum(line.startswith("input ") for line in lines) == why.MAX_INPUTS + 1
    assert "input         parts        and 3 more, computed" in lines
    shutil.rmtree(tmp_path / "cache" / "artifacts" / "total")
    assert re.search(r"has gone from .*, or the run used another cache \(--cache\)", told(tmp_path, at, "total")[-1])


def test_differences_from_the_programs_defaults_are_marked():
    from rille.pipeline.flow.config import build, stages

    made = {
        "stage": "locus",
        "provenance": {
            "params": stages()["locus"].params(max_range_cells=7.0).model_dump(mode="json"),
            "args": {"pair": 3},
            "code": {"rille.stages.terrain.locus.stage": "0"},
            "env": {},
            "started": 0.0,
            "python": "3.11.7",
            "host": {"name": "n", "machine": "m", "cpus": 2},
        },
    }
    lines = list(why._recipe(made))
    assert [line for line in lines if "default:" in line] == [
        "parameter     locus.max_range_cells = 7.0   (default: 6.0)"
    ]
    assert "argument      pair = 3" in lines
    params = build().hfvm.model_dump(mode="json")
    shared = {"stage": "hfvm_given", "provenance": made["provenance"] | {"params": params}}
    assert next(iter(why._recipe(shared))).startswith("parameter     hfvm.preset = ")


def test_names_that_are_not_there_are_answered_by_the_nearest(three):
    folder, _, _, third = three
    with raises("RIL-068", "'scal/2'", "scale/2"):
        told(folder, third, "scal/2")
    with raises("RIL-068", "numbers/0"):
        told(folder, third, "zzzzzz")
    here = folder / "runs"
    assert lookup.find("toy", here) == third, "no run is marked as the latest: the last one"
    assert lookup.find("toy/2", here) == lookup.find("2", here) == here / "toy" / "2"
    assert lookup.find(str(third), here) == third
    assert lookup.find("latest", here) == third
    with raises("RIL-067", "'tpy'"):
        lookup.find("tpy", here)
    with raises("RIL-067"):
        lookup.find("toy", folder / "nowhere")
