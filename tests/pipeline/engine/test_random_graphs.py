"""Random graphs, laid out by flows that wait, with holes and lost artifacts, against a naive evaluator."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from distributed import Client, LocalCluster
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph, Maybe
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import NoParams


@st.composite
def graphs(draw):
    """Nodes ``(own, degenerate, inputs, late)``: inputs are earlier nodes; a late one is added by a flow that waits."""
    nodes = []
    for k in range(draw(st.integers(1, 8))):
        inputs = draw(st.lists(st.integers(0, k - 1), max_size=3)) if k else []
        # Few numbers, so that several nodes often have one key.
        nodes.append((draw(st.integers(0, 2)), draw(st.integers(0, 5)) == 0, inputs, draw(st.booleans())))
    return nodes


def lay_out(nodes):
    graph, handles = Graph(), {}

    def add(k):
        own, degenerate, inputs, _ = nodes[k]
        read = [handles[i] for i in inputs]
        handles[k] = graph.node(
            "toys.node", f"node/{k}", NoParams(), {"own": own, "degenerate": degenerate}, {}, {"read": read}
        )

    def flow():
        for k, (_, _, inputs, late) in enumerate(nodes):
            if late:
                yield Maybe([handles[i] for i in inputs])
            add(k)

    graph.flow(flow())
    return graph, handles


def naive(nodes):
    """The value of each node; None where it, or what it reads, has no answer."""
    values = []
    for own, degenerate, inputs, _ in nodes:
        read = [values[i] for i in inputs]
        values.append(None if degenerate or None in read else own + sum(read))
    return values


def evaluate(nodes, store, executor="inline"):
    graph, handles = lay_out(nodes)
    result = driver.run(graph, store, driver.RunOptions(executor=executor, jobs=2))
    values = [int(store.open(h.ref)["value"][0]) if (h := handles[k]).done else None for k in range(len(nodes))]
    return values, result, handles


@settings(max_examples=40, deadline=None)
@given(graphs(), st.sets(st.integers(0, 7)))
def test_a_run_computes_what_a_naive_evaluator_does_also_after_a_loss(nodes, gone):
    expected = naive(nodes)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "cache")
        values, result, handles = evaluate(nodes, store)
        assert values == expected
        own = {
            k
            for k, (_, degenerate, inputs, _) in enumerate(nodes)
            if degenerate and None not in [expected[i] for i in inputs]
        }
        assert {f.label for f in result.failures} == {f"node/{k}" for k in own}
        assert {k for k, h in handles.items() if h.status == "skipped"} == {
            k for k, value in enumerate(expected) if value is None
        } - own
        lost = {handles[k].key for k in gone if k in handles and handles[k].done}
        for key in lost:
            (Path(folder) / "cache").joinpath(*_place(store, handles, key)).unlink()
        values, result, handles = evaluate(nodes, store)
        assert values == expected
        assert {h.key for h in handles.values() if h.status == "computed"} == lost


@pytest.fixture(scope="module")
def client():
    with (
        LocalCluster(2, processes=False, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@settings(max_examples=15, deadline=None)
@given(graphs())
def test_a_cluster_computes_the_same(client, nodes):
    with tempfile.TemporaryDirectory() as folder:
        assert evaluate(nodes, Store(Path(folder) / "cache"), client)[0] == naive(nodes)


def _place(store, handles, key):
    ref = next(h.ref for h in handles.values() if h.done and h.key == key)
    return Path(ref.path).parts
