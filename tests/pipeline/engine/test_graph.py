"""Flows: generators that add tasks and go on when what they wait for is there."""

from __future__ import annotations

import pytest
from toys import mischief, numbers, scale, total
from toys.numbers import NumbersParams
from toys.scale import ScaleParams

from rille.pipeline.engine import events
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph, Maybe, MissingError
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.runs.run_files import task_rows
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import DegenerateError

NO = NoParams()


def number(graph, frame):
    return graph.node(numbers.STAGE, f"numbers/{frame}", NumbersParams(size=8), {"frame": frame})


def broken(graph, what="degenerate"):
    return graph.node(mischief.STAGE, f"broken/{what}", NO, {"what": what})


def run(graph, tmp_path, **options):
    return driver.run(graph, Store(tmp_path / "cache"), driver.RunOptions(executor="inline", **options))


def test_a_flow_gets_what_it_yielded_and_several_run_side_by_side(tmp_path):
    graph, told = Graph(), []

    def scaled(frame):
        values = number(graph, frame)
        ref = yield values
        told.append(ref.meta["frame"])
        again = yield [graph.node(scale.STAGE, f"scale/{frame}", ScaleParams(), inputs={"values": values})]
        return again[0].meta["levels"] + frame

    def whole():
        alone = yield from scaled(2)
        parts = [handle for handle in graph.nodes if handle.stage == "scale"]
        found = yield graph.node(total.STAGE, "total", NO, inputs={"parts": parts})
        told.append((alone, found.meta["count"], (yield [])))

    for flow in (scaled(0), scaled(1), whole()):
        graph.flow(flow)
    assert [handle.label for handle in graph.nodes] == ["numbers/0", "numbers/1", "numbers/2"], "all have begun"
    assert run(graph, tmp_path).ok
    assert not graph.waiting
    assert told == [0, 1, 2, (4, 3, [])]


def test_what_is_missing_is_none_or_raises_where_it_is_waited_for(tmp_path):
    graph, told = Graph(), []

    def careful():
        told.append([ref is None for ref in (yield Maybe([fine, bad]))])

    def catching():
        try:
            yield [fine, bad]
        except MissingError as error:
            told.append(str(error))
        again = yield number(graph, 1)
        told.append(again.meta["frame"])

    def careless():
        yield after
        pytest.fail("went on")

    fine, bad = number(graph, 0), broken(graph)
    after = graph.node(mischief.STAGE, "after", NO, {"what": "fine"}, inputs={"after": bad})
    graph.flow(careful())
    graph.flow(catching())
    graph.flow(careless())
    result = run(graph, tmp_path, ledger=tmp_path / "ledger.jsonl")
    assert [failure.label for failure in result.failures] == ["broken/degenerate"]
    assert sorted(map(str, told)) == sorted(["1", "[False, True]", "broken/degenerate"])
    assert [one.handles for one in graph.waiting] == [[after]]
    assert "plan after after" in (tmp_path / "ledger.jsonl").read_text(), "the run says what never followed"


def test_an_error_of_a_flow_is_a_failure_of_the_run(tmp_path):
    graph = Graph()

    def wrong():
        yield number(graph, 0)
        raise ValueError("no such pair")

    graph.flow(wrong())
    assert [f"{f.label}: {f.error}" for f in run(graph, tmp_path).failures] == ["plan after numbers/0: no such pair"]


def test_a_flow_whose_reader_has_gone_ends_the_run(tmp_path):
    graph = Graph()

    def printing():
        yield number(graph, 0)
        raise BrokenPipeError

    graph.flow(printing())
    with pytest.raises(BrokenPipeError):
        run(graph, tmp_path)


def test_a_stage_may_be_named_by_its_module(tmp_path):
    graph = Graph()
    a, b = number(graph, 0), graph.node("toys.numbers", "b", NumbersParams(size=8), {"frame": 0})
    assert a.spec.module == b.spec.module
    assert run(graph, tmp_path).ok
    assert a.key == b.key


def outdated(graph):
    """Two tasks of a calibration that is then corrected: one of them cannot be computed, one is the same task again."""
    number(graph, 0), number(graph, 1), broken(graph)
    graph.outdated |= {0, 1, 2}
    number(graph, 0)
    graph.node(numbers.STAGE, "numbers/1", NumbersParams(size=9), {"frame": 1})
    graph.node(mischief.STAGE, "broken/degenerate", NO, {"what": "fine"})


def test_what_failed_with_an_outdated_calibration_is_of_no_account(tmp_path):
    graph = Graph()
    outdated(graph)
    result = run(graph, tmp_path, ledger=tmp_path / "ledger.jsonl")
    assert result.ok
    assert result.counts == {"computed": 4}
    assert events.facts(tmp_path / "ledger.jsonl")["outdated"] == ["numbers/1"]


def test_an_exporter_opens_what_was_laid_out_last(tmp_path):
    graph, store = Graph(), Store(tmp_path / "cache")
    outdated(graph)
    run(graph, tmp_path, ledger=tmp_path / "ledger.jsonl")
    found = RunArtifacts(tmp_path, store)
    assert [len(found.one(f"numbers/{k}")["values"]) for k in (0, 1)] == [8, 9]
    assert sorted(found.all("numbers")) == ["0", "1"]


def test_a_flow_that_raises_has_a_line_in_the_ledger(tmp_path):
    graph = Graph()

    def flow():
        yield number(graph, 0)
        raise DegenerateError("RIL-051", "no elevation model has a cell in the world")

    graph.flow(flow())
    result = run(graph, tmp_path, ledger=tmp_path / "ledger.jsonl")
    assert not result.ok
    (line,) = (row for row in events.read(tmp_path / "ledger.jsonl") if row["status"] == "failed")
    assert line["label"] == "plan after numbers/0"
    assert "no elevation model has a cell" in line["reason"]
    (row,) = (row for row in task_rows(graph, result.failures) if row.status == "failed")
    assert row.reason == "no elevation model has a cell in the world"
