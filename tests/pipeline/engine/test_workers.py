"""A dask scheduler and two worker processes started by hand, on loopback."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from contextlib import ExitStack

import pytest
from hands import by_hand
from raising import raises
from toys import chain

from rille.pipeline.engine import caller, events, foreign, workers
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import NoParams


@pytest.fixture(scope="module")
def hands(tmp_path_factory):
    """A scheduler with two workers."""
    with by_hand(tmp_path_factory.mktemp("cluster")) as hands:
        hands.worker("first")
        hands.worker("second")
        yield hands


def run(cache, where="inline", jobs=2):
    graph = Graph()
    chain.build(graph)
    driver.run(graph, Store(cache), driver.RunOptions(executor=where, jobs=jobs)).check()
    return {h.key: h.ref.digest for h in graph.nodes}


def test_a_cluster_gives_what_one_process_gives(hands, tmp_path):
    assert run(tmp_path / "cluster", hands.address) == run(tmp_path / "inline")
    assert not list((tmp_path / "cluster").glob("*.tmp")), "probes are cleared away"


def test_several_runs_at_once_on_one_client_all_end(hands, tmp_path):
    """Each hears of its own tasks, also after the run that began first has failed and left."""
    from distributed import Client

    def run_one(number):
        graph = Graph()
        chain.build(graph, seed=number)
        if number == 0:
            graph.node("toys.mischief", "fails", NoParams(), {"what": "value"})
        ended[number] = driver.run(graph, Store(tmp_path / "cache"), driver.RunOptions(executor=client)).ok

    ended = {}
    with Client(hands.address, set_as_default=False) as client:
        threads = [threading.Thread(target=run_one, args=(number,), daemon=True) for number in range(4)]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + 60
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
    assert ended == {0: False, 1: True, 2: True, 3: True}


@pytest.mark.parametrize("inside", [False, pytest.param(True, id="in-process")])
def test_a_client_handed_in_runs_the_tasks_on_its_workers_and_stays_open(hands, tmp_path, inside):
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        where = hands.address
        if inside:
            where = stack.enter_context(LocalCluster(2, processes=False, threads_per_worker=1, dashboard_address=":0"))
        client = stack.enter_context(Client(where, set_as_default=False))
        client.get_task_stream()  # from here on
        made = run(tmp_path / "cluster", client)
        ran = client.get_task_stream()
        assert client.status == "running"
        assert {row["worker"] for row in ran} <= set(client.nthreads())
    assert Counter(row["key"].partition("-")[0] for row in ran) == {"numbers": 4, "scale": 4, "total": 1}
    assert made == run(tmp_path / "inline")


def test_the_ledger_of_a_default_run_names_the_dask_worker_of_each_task(tmp_path):
    graph, ledger = Graph(), tmp_path / "ledger.jsonl"
    chain.build(graph)
    driver.run(graph, Store(tmp_path / "cache"), driver.RunOptions(jobs=2, ledger=ledger)).check()
    rows = events.read(ledger)
    assert len(rows) == len(graph.nodes)
    assert {row["worker"] for row in rows} <= {"0", "1"}


def test_a_cache_that_is_not_shared_is_refused(hands, tmp_path, monkeypatch):
    write = foreign.atomic.write
    monkeypatch.setattr(foreign.atomic, "write", lambda path, text: write(tmp_path / "elsewhere" / path.name, text))
    with raises("RIL-523"):
        run(tmp_path / "cache", hands.address)


def test_other_versions_are_refused_by_name(hands, tmp_path, monkeypatch):
    ours = foreign.identity()
    monkeypatch.setattr(foreign, "identity", lambda: {**ours, "numpy": "9.9", "source code": "feed"})
    with raises("RIL-521") as wrong:
        run(tmp_path / "cache", hands.address)
    assert "worker first" in str(wrong.value) or "worker second" in str(wrong.value)
    assert f"differs: source code {ours['source code']} instead of feed, numpy {ours['numpy']} instead of 9.9" in str(
        wrong.value
    )


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "tcp://no-such-host.invalid:8786"])
def test_no_scheduler(tmp_path, address, monkeypatch):
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 1.0)
    with raises("RIL-541", "tcp://"):
        run(tmp_path / "cache", address)


@pytest.mark.parametrize("kind", ["proceses", "tcp://", "tcp://host", "http://host:80", "tcp:host:80"])
def test_unknown_executors(kind):
    with raises("RIL-539"):
        caller.check(kind)


def test_threads_of_libraries_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    with raises("RIL-522", "OMP_NUM_THREADS"):
        foreign.compare(foreign.identity(), tmp_path / "probe" / "token")


def test_an_adaptive_cluster_without_workers_starts_one(tmp_path):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(processes=False, n_workers=0, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        cluster.adapt(minimum=0, maximum=1, interval="50ms")
        made = workers.make(client, 1, tmp_path, 1e9)
        assert made.threads() == 1
        made.close()


@pytest.mark.slow
def test_no_workers_and_a_scheduler_that_leaves(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "NO_WORKERS_SECONDS", 2.0)
    with by_hand(tmp_path) as hands:
        with raises("RIL-525"):
            run(tmp_path / "cache", hands.address)
        hands.worker("only")
        graph = Graph()
        chain.build(graph)
        from rille.stages.core.declare import NoParams

        graph.node("toys.mischief", "sleep/0", NoParams(), {"what": "sleep", "seconds": 60, "i": 0})
        monkeypatch.setattr(workers, "NO_WORKERS_SECONDS", 30.0)
        begun = driver.make

        def make(*given):
            made = begun(*given)
            os.killpg(hands.processes[0].pid, signal.SIGKILL)
            return made

        monkeypatch.setattr(driver, "make", make)
        with raises("RIL-526"):
            driver.run(graph, Store(tmp_path / "cache"), driver.RunOptions(executor=hands.address))
