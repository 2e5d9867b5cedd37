"""Memory that a run may take, estimates of its tasks, and the workers and refusals that follow from both."""

from __future__ import annotations

import math

import pytest
from raising import raises
from toys.chain import build
from toys.numbers import NumbersParams

from rille.pipeline.commands.computing import plan
from rille.pipeline.engine import events, memory
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import NoParams

MB = 1_000_000


def test_amounts_are_read_as_they_are_written():
    assert memory.parse("6GB") == 6 * 10**9
    assert memory.parse("1.5 GiB") == 3 * 2**29
    assert memory.parse("800m") == 800 * MB
    assert memory.parse("50%") == int(memory.total() / 2)
    for bad in ("much", "0GB", "-1GB", "120%", "6 XB", ""):
        with raises("RIL-553"):
            memory.parse(bad)
    assert [memory.words(n) for n in (6.44e9, 412e6, 2.4e6, 35e3, 0)] == ["6.4 GB", "412 MB", "2.4 MB", "35 kB", "0 kB"]


def test_what_is_free_lies_within_the_limit_of_the_machine_or_its_group():
    assert 0 < memory.free() < memory.total()


def lay_out():
    graph = Graph()
    first = graph.node("toys.hog", "small", NoParams(), {"bytes": 1000, "i": 0})
    graph.node("toys.hog", "huge", NoParams(), {"bytes": 10 * memory.total(), "i": 1}, inputs={"after": first})
    return graph


def test_what_does_not_fit_alone_is_refused_before_anything_runs(cache):
    graph = lay_out()
    with raises("RIL-500") as caught:
        driver.run(graph, Store(cache), driver.RunOptions(executor="inline"))
    assert caught.value.remedy == "change hog.bytes, or give more with --memory-limit"
    assert [h.status for h in graph.nodes] == ["pending", "pending"]
    assert not cache.exists()


def test_what_could_not_be_known_beforehand_is_refused_when_its_turn_comes(cache):
    graph = Graph()
    first = graph.node("toys.hog", "small", NoParams(), {"bytes": 1000, "i": 0})

    def grow():
        yield first
        graph.node("toys.hog", "huge", NoParams(), {"bytes": 10 * memory.total(), "i": 1}, inputs={"after": first})

    graph.flow(grow())
    result = driver.run(graph, Store(cache), driver.RunOptions(executor="inline", keep_going=True))
    assert [h.status for h in graph.nodes] == ["computed", "failed"]
    assert result.failures[0].error.code == "RIL-500"


@pytest.mark.parametrize(("largest", "workers"), [(0.0, 4), (250 * MB, 2), (10_000 * MB, 1)])
def test_there_are_as_many_workers_as_the_limit_holds_of_the_largest_task(largest, workers):
    budget = memory.Budget(1_100 * MB, 100 * MB, 4)
    assert budget.workers(largest) == workers
    assert budget.alone == 750 * MB


def test_on_a_cluster_of_others_only_a_given_limit_counts():
    assert memory.budget("tcp://host:1", None, 4).limit == math.inf
    assert memory.budget("tcp://host:1", None, 4).workers(1e15) == 4
    assert memory.budget("tcp://host:1", 5e9, 4).limit == 5e9


def test_workers_give_way_to_a_larger_task_that_is_laid_out_later(cache):
    """The first tasks leave room for two workers; a later one for one: all end, on what is left."""
    graph = Graph()
    small = [graph.node("toys.numbers", f"n/{k}", NumbersParams(), {"frame": k}) for k in range(4)]
    seen = []

    def grow():
        yield small
        handle = graph.node("toys.hog", "large", NoParams(), {"bytes": 1000, "i": 0}, expect=120 * MB)
        seen.append(memory.Estimates().task(handle))
        yield handle
        graph.node("toys.numbers", "last", NumbersParams(), {"frame": 9})

    graph.flow(grow())
    limit = memory.resident() + 2 * (memory.WORKER_BYTES + 60 * MB) + 50 * MB
    options = driver.RunOptions(executor="dask", jobs=2, memory_limit=limit, ledger=cache / "ledger.jsonl")
    assert driver.run(graph, Store(cache), options).ok
    assert events.facts(cache / "ledger.jsonl")["jobs"] == 2
    assert memory.Budget(limit, memory.resident(), 2).workers(seen[0]) == 1


def test_a_plan_names_the_largest_task_and_the_workers_that_it_leaves_room_for(cache):
    def lines(budget):
        graph = Graph()
        build(graph, size=400)
        driver.run(graph, Store(cache), driver.RunOptions(dry=True))
        return list(plan.needs(memory.Estimates().planned(graph), budget))

    (line,) = lines(memory.Budget(8e9, 1e8, 2))
    assert line == ("memory: the largest task, numbers/0, is estimated to need 50 MB; room for 2 workers in 8.0 GB")
    with raises("RIL-500", "numbers/0"):
        lines(memory.Budget(3.5e8, 1e8))
    graph = Graph()
    build(graph, size=400)
    driver.run(graph, Store(cache), driver.RunOptions(executor="inline")).check()
    assert lines(memory.Budget(8e9, 1e8, 2)) == [], "nothing is to do"


def test_estimates_upon_estimates_do_not_grow_without_end():
    """Each task of a long ladder takes both before it: counted as their sums, results would double again and again."""
    graph = Graph()
    rungs = [graph.node("toys.numbers", f"n/{k}", NumbersParams(), {"frame": k}, expect=1e6) for k in range(2)]
    for k in range(60):
        rungs.append(graph.node("toys.total", f"t/{k}", NoParams(), inputs={"parts": rungs[-2:]}))
    for handle in graph.nodes:
        handle.status = "planned"
    assert max(needs for _, needs in memory.Estimates().planned(graph)) < 200 * MB
