"""What a plan says, on toy graphs: reasons, what rests on earlier results, and what is not known."""

from __future__ import annotations

from toys.chain import build

from pipeline import driver, plan
from pipeline.dag import Graph
from pipeline.store import Store


def lines(cache, *, verbose=False, **changed):
    graph = Graph()
    build(graph, **changed)
    result = driver.run(graph, Store(cache), dry=True)
    return list(plan.describe(graph, result, {"numbers": 2.0, "scale": 3.0, "total": 1.0}, 2, verbose=verbose))


def compute(cache, **kw):
    graph = Graph()
    build(graph, **kw)
    driver.run(graph, Store(cache), executor="inline").check()


def test_of_an_empty_cache_says_what_it_cannot_know(cache):
    told = lines(cache)
    assert told[1] == "numbers                0       4  never computed (4)"
    assert told[-2] == "4 tasks known: 0 cached, 4 to do, about 4 s with 2 workers by earlier runs"
    assert told[-1].startswith("more tasks follow, known only after numbers/0, numbers/1, numbers/2")


def test_when_all_is_cached_nothing_is_to_do(cache):
    compute(cache)
    assert lines(cache)[-1] == "9 tasks known: 9 cached, 0 to do"


def test_a_changed_parameter_is_named_and_what_follows_is_laid_out_by_the_last_run(cache):
    compute(cache)
    told = lines(cache, seed=1)
    assert told[1].startswith("numbers                0       4  params.seed 0 -> 1 (4)")
    assert told[2].endswith("an input is to be computed (4)")
    assert "9 tasks known: 0 cached, 9 to do" in told[-2]
    assert told[-1].startswith("laid out by the last run's numbers/0")


def test_verbose_gives_each_task_its_reason(cache):
    compute(cache)
    told = lines(cache, verbose=True, offset=0.5)
    assert "    scale/0: params.offset 0.0 -> 0.5" in told
    assert "    total: input scale/0 is to be computed" in told
