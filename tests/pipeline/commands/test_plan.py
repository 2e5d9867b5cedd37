"""What a plan says, on toy graphs: reasons, what rests on earlier results, and what is not known."""

from __future__ import annotations

from dataclasses import replace

import pytest
from toys.chain import build

from rille.datasets.registry import open_sequence
from rille.pipeline.commands.computing import plan
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow.closed_loop import dataflow


def lines(cache, *, verbose=False, sequence="", choice="", **changed):
    graph = Graph(sequence, choice)
    build(graph, **changed)
    result = driver.run(graph, Store(cache), driver.RunOptions(dry=True))
    result.check()
    return list(plan.describe(graph, result, 2, verbose=verbose))


def compute(cache, *, sequence="", choice="", **kw):
    graph = Graph(sequence, choice)
    build(graph, **kw)
    driver.run(graph, Store(cache), driver.RunOptions(executor="inline")).check()


def test_of_an_empty_cache_says_what_it_cannot_know(cache):
    told = lines(cache)
    assert told[1].split() == ["numbers", "0", "4", "never", "computed", "(4)"]
    assert told[-2] == "4 tasks known: 0 cached, 4 to do"
    assert told[-1].startswith("more tasks follow, known only after numbers/0, numbers/1, numbers/2")


def test_the_time_is_that_of_earlier_results_over_the_workers_that_there_will_be(cache):
    compute(cache)
    graph = Graph()
    build(graph, seed=1)
    result = driver.run(graph, Store(cache), driver.RunOptions(dry=True))
    for handle in graph.nodes:
        handle.earlier = None if handle.stage == "total" else replace(handle.earlier, seconds=3.0)
    told = list(plan.describe(graph, result, 2))
    assert told[-2].endswith("9 to do, about 12 s with 2 workers by earlier runs (never timed: total)")


def test_when_all_is_cached_nothing_is_to_do(cache):
    compute(cache)
    assert lines(cache)[-1] == "9 tasks known: 9 cached, 0 to do"


def test_a_changed_parameter_is_named_and_what_follows_is_laid_out_by_the_last_run(cache):
    compute(cache)
    told = lines(cache, seed=1)
    assert told[1].split() == ["numbers", "0", "4", "params.seed", "0", "->", "1", "(4)"]
    assert told[2].endswith("an input is to be computed (4)")
    assert "9 tasks known: 0 cached, 9 to do" in told[-2]
    assert told[-1].startswith("laid out by the last run's numbers/0")


def test_verbose_gives_each_task_its_reason(cache):
    compute(cache)
    told = lines(cache, verbose=True, offset=0.5)
    assert "    scale/0: params.offset 0.0 -> 0.5" in told
    assert "    total: input scale/0 is to be computed" in told


def test_hints_belong_to_their_sequence(cache):
    compute(cache, sequence="long", frames=6)
    assert lines(cache, sequence="short", frames=3, seed=1)[1].endswith("never computed (3)")
    assert lines(cache, sequence="long", frames=6, seed=1)[1].endswith("params.seed 0 -> 1 (6)")


def test_what_follows_is_laid_out_by_the_same_choice_of_frames_only(cache):
    compute(cache, sequence="long", choice="all", frames=6)
    told = lines(cache, sequence="long", choice="few", frames=3, seed=1)
    assert told[1].endswith("params.seed 0 -> 1 (3)"), "a reason may come from another choice"
    assert told[-1].startswith("more tasks follow, known only after numbers/0, numbers/1, numbers/2")
    assert told[-2].startswith("3 tasks known")


def test_a_dataflow_says_whose_hints_are_meant():
    given = configuration.build({})

    def whose(name, frames):
        graph = Graph()
        dataflow(graph, open_sequence(name), given, frames)
        return graph.sequence, graph.choice

    assert whose("mockup", (0, 1)) == whose("mockup", (0, 1))
    assert len({whose("mockup", (0, 1)), whose("mockup", (0, 2)), whose("mockup-short", (0, 1))}) == 3


@pytest.mark.parametrize("name", ["..", "../../x", "/etc", "a b%/c", ""])
def test_no_name_of_a_sequence_leads_out_of_the_hints(cache, name):
    folder = Store(cache).hints(name)
    assert folder.resolve().parent == (cache / "hints").resolve()


def test_an_earlier_result_that_does_not_fit_hides_what_follows(cache):
    def lay_out(seed, wanted):
        graph = Graph()
        build(graph, frames=1, seed=seed)

        def fitting():
            yield graph.nodes[0]
            return {0: "known"}[wanted]

        graph.flow(fitting())
        return graph

    driver.run(lay_out(0, 0), Store(cache), driver.RunOptions(executor="inline")).check()
    result = driver.run(lay_out(1, 1), Store(cache), driver.RunOptions(dry=True))
    assert result.ok
    assert result.unknown == ["numbers/0"]
    result = driver.run(lay_out(0, 1), Store(cache), driver.RunOptions(dry=True))
    assert [f.label for f in result.failures] == ["plan after numbers/0"], "by what is there it is a failure"
