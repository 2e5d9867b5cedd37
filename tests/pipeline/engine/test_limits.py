"""What may be used, what a task took, what it is foreseen to take, and that running tasks stay under the limit."""

from __future__ import annotations

import sys
from itertools import pairwise

import numpy as np
import pytest
from raising import raises
from toys.chain import build
from toys.numbers import NumbersParams

from rille.pipeline.commands import plan
from rille.pipeline.engine import events, scheduler
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.memory import cost_model, limits
from rille.pipeline.engine.memory.admission import Account, MemoryRefusedError, Waiting, account, forecast
from rille.pipeline.engine.memory.cost_model import Costs, Group
from rille.pipeline.engine.spec import Spec
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import NoParams

MB = 1_000_000
HOG = 60 * MB


def group(root, line, files):
    """A control group as the kernel shows it."""
    (root / "proc/self").mkdir(parents=True, exist_ok=True)
    (root / "proc/self/cgroup").write_text(line)
    for path, text in files.items():
        file = root / "sys/fs/cgroup" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")
    return root


def test_amounts_are_read_as_they_are_written():
    assert limits.parse("6GB") == 6 * 10**9
    assert limits.parse("1.5 GiB") == 3 * 2**29
    assert limits.parse("800m") == 800 * MB
    assert limits.parse("50%") == int(limits.total() / 2)
    for bad in ("much", "0GB", "-1GB", "120%", "6 XB", ""):
        with raises("RIL-553"):
            limits.parse(bad)
    assert [limits.words(n) for n in (6.44e9, 412e6, 2.4e6, 35e3, 0)] == ["6.4 GB", "412 MB", "2.4 MB", "35 kB", "0 kB"]


@pytest.mark.parametrize(
    ("line", "files"),
    [
        (
            "0::/user/job\n",
            {
                "user/job/memory.max": "max",
                "user/memory.max": 900 * MB,
                "user/memory.current": 500 * MB,
                "user/memory.stat": f"anon 1\ninactive_file {200 * MB}",
            },
        ),
        ("0::/\n", {"memory.max": 900 * MB, "memory.current": 300 * MB}),
        (
            "5:cpu:/x\n4:memory,hugetlb:/job\n0::/\n",
            {
                "memory/job/memory.limit_in_bytes": 900 * MB,
                "memory/job/memory.usage_in_bytes": 310 * MB,
                "memory/job/memory.stat": f"cache 5\ntotal_inactive_file {10 * MB}",
                "memory/memory.limit_in_bytes": 9223372036854771712,
                "memory/memory.usage_in_bytes": 7,
            },
        ),
        (  # the container's own group is mounted as the root
            "4:memory:/docker/0123\n",
            {"memory/memory.limit_in_bytes": 900 * MB, "memory/memory.usage_in_bytes": 300 * MB},
        ),
    ],
    ids=["v2, limit above", "v2, namespace", "v1", "v1, container"],
)
def test_the_limit_of_a_control_group_counts_and_what_others_use_of_it_does_not(tmp_path, line, files):
    root = group(tmp_path, line, files)
    assert limits.total(root) == 900 * MB
    assert limits.free(root) == 600 * MB


def test_without_a_control_group_it_is_the_machine(tmp_path):
    assert limits.total(tmp_path) == limits.total(group(tmp_path / "a", "0::/\n", {"memory.max": "max"}))
    assert 0 < limits.free(tmp_path) < limits.total(tmp_path)


def test_a_meter_sees_what_was_freed_meanwhile_and_nothing_of_tasks_side_by_side():
    kept = [np.ones(400) for _ in range(20_000)]  # 64 MB of small pieces, as a heap is left by earlier work
    del kept
    with limits.Meter() as meter:
        np.ones(10 * MB)
    assert meter.memory == pytest.approx(80 * MB, abs=8 * MB)
    assert meter.rest > 10 * MB
    with limits.Meter() as one, limits.Meter() as two:
        pass
    assert (one.memory, two.memory) == (None, None)
    with limits.Meter() as meter:
        pass
    assert meter.memory < 5 * MB
    with limits.Meter(measure=False) as meter, limits.Meter() as other:
        pass
    assert (meter.memory, other.memory) == (None, None), "one that is not measured runs, too"


def test_three_tasks_of_a_kind_are_measured_and_then_only_greater_ones():
    sizes = [50.0, 100.0, 70.0, 60.0, 200.0, 200.0, 100.0, 200.0, 200.0]
    expected = [True, True, True, False, True, True, False, True, False]
    assert [cost_model.tells_more("a", size) for size in sizes] == expected
    assert cost_model.tells_more("b", 1.0)


SPEC = Spec("toys.numbers", "n", NumbersParams())


def known(samples, params=None, tasks=None):
    name = cost_model._name(Spec("toys.numbers", "x", params or NumbersParams()))
    return Costs({"numbers": {name: Group(3, tasks or len(samples), samples)}})


def test_nothing_measured_is_a_guess_and_says_so():
    found = Costs().foresee(SPEC, 10 * MB)
    assert found.source == "no earlier run: a guess of the stage's declaration"
    assert found.memory == 50 * MB + 6 * 10 * MB
    assert (found.measured, found.spread) == (False, 0.5)


@pytest.mark.parametrize(
    "damaged",
    [
        '{"stages": {"toy": {"x": {"runs": Infinity, "tasks": 1, "samples": []}}}, "rests": []}',
        '{"stages": {"toy": {"x": {"runs": 1, "tasks": 1, "samples": [["a", "b", "c", "d"]]}}}, "rests": []}',
        pytest.param("[" * 100_000, id="deep"),
    ],
)
def test_damaged_costs_count_as_none(tmp_path, damaged):
    (tmp_path / cost_model.FILE).write_text(damaged)
    assert cost_model.recall(tmp_path).groups == {}


def test_tasks_of_like_size_are_foreseen_by_their_median_and_its_spread():
    found = known([(10.0, 80 * MB, 5.0, 2.0), (11.0, 100 * MB, 5.0, 2.0), (12.0, 130 * MB, 7.0, 3.0)]).foresee(
        SPEC, 11.0
    )
    assert (found.memory, found.spread) == (100 * MB, pytest.approx(0.3))
    alone = known([(10.0, 80 * MB, 5.0, 2.0)]).foresee(SPEC, 10.0)
    assert (alone.memory, alone.spread) == (80 * MB, 0.5), "one task tells little"
    assert (found.result, found.stored) == (5.0, 2.0)
    assert found.source == "from 3 tasks of 3 runs"
    assert found.most == pytest.approx(130 * MB + cost_model.SLACK)


def test_other_sizes_follow_a_line_and_are_less_certain():
    samples = [(x * MB, 20 * MB + 3 * x * MB, x, x) for x in (1.0, 2.0, 4.0)]  # 20 MB and 3 bytes a byte
    found = known(samples).foresee(SPEC, 16 * MB)
    assert found.memory == pytest.approx(68 * MB)
    assert found.spread > 0.5
    near = known(samples).foresee(SPEC, 5.2 * MB)
    assert 0.1 < near.spread < found.spread
    one_size = known([(2 * MB, 10 * MB, 1.0, 1.0), (2.2 * MB, 9 * MB, 1.0, 1.0)]).foresee(SPEC, 8 * MB)
    assert one_size.memory == pytest.approx(9.5 * MB * 8 / 2.1), "no slope is to be told from these"


def test_a_tiny_task_beside_the_line_does_not_make_the_great_ones_gigabytes():
    samples = [(1 * MB, 0.02 * MB, 1.0, 1.0), (10 * MB, 12 * MB, 1.0, 1.0), (20 * MB, 26 * MB, 1.0, 1.0)]
    found = known(samples).foresee(SPEC, 45 * MB)
    assert found.memory == pytest.approx(58 * MB, rel=0.02)
    assert found.most < 3 * found.memory


def test_other_parameters_serve_where_there_is_nothing_better():
    found = known([(10.0, 80 * MB, 5.0, 2.0)], params=NumbersParams(seed=7)).foresee(SPEC, 10.0)
    assert found.memory == 80 * MB
    assert found.source == "from 1 task of 3 runs with other parameters"
    assert found.spread >= 0.5


def hogs(count=3, size=HOG, seconds=0.25):
    graph = Graph()
    for i in range(count):
        graph.node("toys.hog", f"hog/{i}", NoParams(), {"bytes": size, "seconds": seconds, "i": i})
    return graph


def overlaps(path):
    rows = [r for r in events.read(path) if r["stage"] == "hog"]
    spans = sorted((r["started"], r["ended"]) for r in rows)
    assert all(start < end for start, end in spans)
    return sum(second[0] < first[1] for first, second in pairwise(spans))


@pytest.fixture
def learned(cache, tmp_path):
    """Folders of caches that know what a hog takes, and hold none; and the digests that it gives."""
    graph = hogs(seconds=0.0)
    scheduler.run(graph, Store(cache), scheduler.RunOptions(executor="inline")).check()
    assert [h.took.memory for h in graph.nodes] == [pytest.approx(HOG, rel=0.15)] * 3

    def make(name):
        (tmp_path / name).mkdir()
        there, here = (Store(folder).hints("") / cost_model.FILE for folder in (tmp_path / name, cache))
        there.parent.mkdir(parents=True)
        there.write_bytes(here.read_bytes())
        return Store(tmp_path / name)

    return make, {h.label: h.ref.digest for h in graph.nodes}


def run(graph, store, executor, limit):
    path = store.root / "ledger.jsonl"
    result = scheduler.run(
        graph, store, scheduler.RunOptions(executor=executor, jobs=2, memory_limit=limit, ledger=path)
    )
    return result, path


def test_a_limit_keeps_tasks_apart_that_do_not_fit_together(learned):
    make, digests = learned
    store = make("tight")
    rest = cost_model.recall(store.hints("")).rest
    limit = limits.resident() + 2 * rest + 1.5 * HOG + 2 * cost_model.SLACK
    graph = hogs()
    result, path = run(graph, store, "dask", limit)
    assert result.ok
    assert {h.label: h.ref.digest for h in graph.nodes} == digests
    assert overlaps(path) == 0
    assert events.facts(path)["jobs"] == 2
    result, path = run(hogs(seconds=2.0), make("wide"), "dask", None)
    assert result.ok
    assert overlaps(path) > 0, "the limit it was, and nothing else"


def lay_out():
    graph = Graph()
    first = graph.node("toys.hog", "small", NoParams(), {"bytes": 1000, "i": 0})
    graph.node("toys.hog", "huge", NoParams(), {"bytes": 10 * limits.total(), "i": 1}, inputs={"after": first})
    return graph


def test_what_does_not_fit_alone_is_refused_before_anything_runs(cache):
    graph = lay_out()
    with raises("RIL-500") as caught:
        scheduler.run(graph, Store(cache), scheduler.RunOptions(executor="inline", survey=lay_out))
    assert caught.value.remedy == "change hog.bytes, or give more with --memory-limit"
    assert [h.status for h in graph.nodes] == ["pending", "pending"]
    assert not cache.exists()


def test_what_could_not_be_foreseen_is_refused_when_its_turn_comes(cache):
    graph = lay_out()
    result = scheduler.run(graph, Store(cache), scheduler.RunOptions(executor="inline", keep_going=True))
    assert [h.status for h in graph.nodes] == ["computed", "failed"]
    assert isinstance(result.failures[0].error, MemoryRefusedError)


def test_fewer_workers_start_where_their_own_memory_would_take_the_tasks_place():
    kept = Costs(rests=[100 * MB])
    own = limits.resident()
    assert account(kept, own + 400 * MB, "dask", 4).workers == 4
    assert account(kept, own + 400 * MB, "dask", 4, largest=150 * MB).workers == 2
    assert account(kept, own + 150 * MB, "dask", 4, largest=150 * MB).workers == 1
    assert account(kept, own + 400 * MB, "tcp://host:1", 4, largest=150 * MB).workers == 4
    shares = account(kept, own + 400 * MB, "dask", 4, largest=150 * MB)
    assert shares.budget == pytest.approx(200 * MB, abs=5 * MB)
    assert shares.alone == pytest.approx(300 * MB, abs=5 * MB)
    assert account(kept, None, "tcp://host:1", 4).budget == float("inf")


def test_tasks_leave_in_their_order_but_pass_one_that_must_wait_and_not_for_ever():
    graph = Graph()
    big = graph.node("toys.hog", "big", NoParams(), {"bytes": 1, "i": 0})
    small = [graph.node("toys.numbers", f"n/{k}", NumbersParams(), {"frame": k}) for k in range(12)]
    waiting = Waiting()
    for handle in (*reversed(small), big):
        waiting.push(handle)
    assert len(waiting) == 13
    passed = []
    while (taken := waiting.take((), lambda h: h is not big)) is not None:
        passed.append(taken)
    assert passed == small[:8], "then the workers are left to become free"
    assert waiting.take((), lambda h: True) is big
    assert waiting.take({"numbers"}, lambda h: True, last=False) is None, "not of a cold stage"
    assert waiting.take({"numbers"}, lambda h: True) is small[8], "unless a worker has nothing else"
    waiting.push(big)
    assert waiting.take({"hog"}, lambda h: True) is small[9], "else another"
    waiting.clear()
    assert (len(waiting), waiting.take((), lambda h: True)) == (0, None)


def test_a_plan_foresees_memory_and_bytes_and_says_from_what(cache):
    def lines(**kw):
        graph = Graph()
        build(graph, **kw)
        scheduler.run(graph, Store(cache), scheduler.RunOptions(dry=True))
        kept = cost_model.recall(Store(cache).hints(""))
        return list(plan.needs(graph, kept, Account(8e9, 1e8, 2e8, 2))), forecast(graph, kept), graph

    told, _, _ = lines(size=400)
    assert told[1].endswith("  no earlier run: a guess of the stage's declaration")
    graph = Graph()
    build(graph, size=400)
    scheduler.run(graph, Store(cache), scheduler.RunOptions(executor="inline")).check()
    told, _, _ = lines(size=400)
    assert told == [], "nothing is to do"
    told, found, graph = lines(size=400, seed=1)
    assert [line.split()[0] for line in told[1:4]] == ["numbers", "scale", "total"]
    assert told[2].endswith("from 4 tasks of 1 run")
    assert told[1].endswith("from 4 tasks of 1 run with other parameters")
    numbers, scale = found[0], found[graph.nodes[4].index]
    assert numbers.result == 400 * 400 * 5, "float32 and uint8"
    assert scale.result == 400 * 400 * 4 + 200 * 200 * 4
    assert scale.memory > 0
    assert "of 8.0 GB" in told[-1]


def test_guesses_upon_guesses_do_not_grow_without_end():
    """Each task of a long ladder takes both before it: counted as their sums, results would double again and again."""
    graph = Graph()
    rungs = [graph.node("toys.numbers", f"n/{k}", NumbersParams(), {"frame": k}, expect=1e6) for k in range(2)]
    for k in range(60):
        rungs.append(graph.node("toys.total", f"t/{k}", NoParams(), inputs={"parts": rungs[-2:]}))
    for handle in graph.nodes:
        handle.status = "planned"
    found = forecast(graph, Costs())
    assert max(f.memory for f in found.values()) < 200 * MB
    assert found[rungs[-1].index].result == pytest.approx(2e6)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc and trims the heap of glibc")
def test_freed_memory_is_given_back_now_and_then_though_nothing_is_measured() -> None:
    with limits.Meter():
        before = limits.resident()
    pieces = [np.ones(400) for _ in range(80_000)]  # 256 MB of small pieces, with one that stays above them
    pins = pieces[-100:]
    pieces.clear()
    grown = limits.resident()
    for _ in range(limits.SELDOM):
        with limits.Meter(measure=False):
            pass
    assert pins
    assert grown > before + 200e6
    assert limits.resident() < before + 50e6
