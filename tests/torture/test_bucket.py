"""Servers in trouble, and one that cannot be trusted, in front of the cache in a bucket."""

from __future__ import annotations

import random

import pytest
import servers
from raising import raises
from torn import chain, look

from rille.pipeline.engine import scheduler
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store import s3 as requests
from rille.pipeline.engine.store.base import Store

METHODS = {"refuse": ("GET", "PUT", "POST"), "deafen": ("PUT",), "cut": ("GET",)}
WORDS = {
    "refuse": "503 to each fifth request",
    "deafen": "each fifth writing carried out and answered by 503",
    "cut": "each twelfth answer broken off",
}


@pytest.fixture
def through(server, monkeypatch):
    """``through(trouble)``: the server behind a proxy that misbehaves."""
    made = []

    def start(trouble):
        made.append(servers.Proxy(server, trouble))
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{made[-1].port}")
        return made[-1]

    yield start
    for proxy in made:
        proxy.close()


@pytest.mark.slow
@pytest.mark.parametrize("how", METHODS)
def test_a_server_in_trouble(calm, bucket, through, row, monkeypatch, how):
    monkeypatch.setattr(requests, "BACK_OFF", {**requests.BACK_OFF, "init_backoff": requests.timedelta(milliseconds=5)})
    prefix, rng, tries = bucket[0], random.Random(how), 3
    share = 0.08 if how == "cut" else 0.2

    def trouble(method, path, count):
        first = "/probe/" in path or path.endswith("rille.json")  # which is given up soon, on purpose
        return how if method in METHODS[how] and not first and rng.random() < share else ""

    proxy = through(trouble)
    lost, wrong, computed = [], [], 0
    for trial in range(tries):
        for _ in range(2):  # cold, then warm
            graph = Graph()
            chain.build(graph)
            result = scheduler.run(graph, Store(f"{prefix}/{trial}"), scheduler.RunOptions(executor="inline", jobs=3))
            computed += result.total().computed
            wrong += [h.label for h in graph.nodes if h.ref is None or h.ref.digest != calm["labels"][h.label]]
        found = look.published(f"{prefix}/{trial}")
        lost += sorted(set(calm["digests"]) - set(found))
        wrong += look.wrong(look.decoded(f"{prefix}/{trial}"), calm["digests"])
    remark = f"{WORDS[how]}, {proxy.troubled} in all"
    row(f"bucket, server in trouble: {how}", tries, lost, wrong, computed, tries * len(calm["digests"]), remark)


def test_a_store_that_ignores_conditional_puts_is_refused(calm, bucket, through, row):
    """Before anything is computed; and what an honest server let in before stays as it is."""
    prefix = bucket[0]
    graph = Graph()
    chain.build(graph, frames=2, size=20)
    scheduler.run(graph, Store(prefix), scheduler.RunOptions(executor="inline")).check()
    before = {e.path: e.mark for e in Store(prefix).place.list("")}
    proxy = through(lambda *_: "blind")
    for place in (prefix, f"{prefix}/new"):
        with raises("RIL-516"):
            Store(place)
    wrote = [path for method, path in proxy.requests if method == "PUT" and "/probe/" not in path]
    proxy.trouble = lambda *_: ""
    after = {e.path: e.mark for e in Store(prefix).place.list("") if e.path.startswith("artifacts")}
    lost = [path for path, etag in before.items() if path.startswith("artifacts") and after.get(path) != etag]
    row("bucket that ignores conditional puts", 2, lost, wrote, 0, 0, "refused before anything is computed")
