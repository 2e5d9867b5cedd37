"""The store in a bucket, against an S3 server on loopback and one that misbehaves."""

from __future__ import annotations

import gzip
import json
import os
import random
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import servers
from toys import chain

from pipeline.engine import scheduler
from pipeline.engine.graph import Graph
from pipeline.engine.store import folder as store_module
from pipeline.engine.store import maintenance, s3, s3_client
from pipeline.engine.store.folder import Store, at, frame
from pipeline.engine.store.location import hints_folder, locate
from pipeline.engine.store.s3 import ObjectStore, manifest_path
from stages.core.declare import Bundle

from toys import numbers  # isort: skip
from raising import raises

FRAMES = 4
NODES = 2 * FRAMES + 1


@pytest.fixture(scope="module")
def port():
    with servers.s3() as port:
        yield port


@pytest.fixture
def url(port, tmp_path, monkeypatch, request):
    """A prefix of its own, and the environment to reach it."""
    for name, value in servers.environment(port, tmp_path / "local").items():
        monkeypatch.setenv(name, value)
    return f"s3://bucket/{tmp_path.name}"


@pytest.fixture
def proxied(port, monkeypatch):
    """``proxied(trouble)`` puts a proxy in between."""
    made = []

    def start(trouble):
        made.append(servers.Proxy(port, trouble))
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{made[-1].port}")
        return made[-1]

    yield start
    for proxy in made:
        proxy.close()


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """Digests of the same run on a folder."""
    return digests(run(tmp_path_factory.mktemp("disk") / "cache")[0])


def run(cache, **options):
    graph = Graph()
    chain.build(graph, frames=FRAMES)
    result = scheduler.run(graph, at(cache), executor="inline", **options)
    result.check()
    return graph, result


def digests(graph):
    return {h.key: h.ref.digest for h in graph.nodes}


def bundle(value=1.0):
    return Bundle({"values": np.full((3, 4), value), "mask": np.zeros((3, 4), dtype=np.uint8)}, {"frame": 0})


def commit(store, key="k" * 64, value=1.0):
    return store.commit(numbers.STAGE, key, bundle(value), label="numbers/0")


def test_cold_and_warm_give_what_a_folder_gives(url, right, proxied):
    proxy = proxied(lambda *_: "")
    cold, _ = run(url)
    assert digests(cold) == right
    del proxy.requests[:]
    s3_client._connect.cache_clear()  # as in a process of its own
    warm, result = run(url)
    assert digests(warm) == right
    assert result.total().cached == NODES
    assert not result.executor_started
    assert len(proxy.requests) <= 4, "the mark, two listings: not one request an artifact"
    values = at(url).open(warm.nodes[0].ref)["values"]
    assert values.shape == (40, 40)


def test_another_machine_reads_the_index_once(url, right, proxied, tmp_path, monkeypatch):
    run(url)
    monkeypatch.setenv("RILLE_LOCAL", str(tmp_path / "elsewhere"))
    proxy = proxied(lambda *_: "")
    warm, _ = run(url)
    assert digests(warm) == right
    assert sum("/index/" in path for _, path in proxy.requests) == 1


def test_a_damaged_index_is_no_matter(url, right):
    run(url)
    store = at(url)
    (entry,) = store.bucket.list("index")
    for data in (b"", b"no gzip", gzip.compress(b"x" * 50), store.bucket.get(entry.path)[0][:-9]):
        store.bucket.put(entry.path, data)
        (hints_folder(url) / entry.path).unlink(missing_ok=True)
        warm, result = run(url)
        assert digests(warm) == right
        assert result.total().cached == NODES


@pytest.mark.parametrize("how", ["refuse", "deafen", pytest.param("cut", marks=pytest.mark.slow)])
def test_servers_in_trouble_change_nothing(url, right, proxied, how, monkeypatch):
    monkeypatch.setattr(
        s3_client, "BACK_OFF", {**s3_client.BACK_OFF, "init_backoff": s3_client.timedelta(milliseconds=5)}
    )
    rng = random.Random(how)
    methods = {"refuse": ("GET", "PUT", "POST"), "deafen": ("PUT",), "cut": ("GET",)}[how]
    share = 0.08 if how == "cut" else 0.2
    proxy = proxied(lambda method, path, count: how if method in methods and rng.random() < share else "")
    for _ in range(2):
        graph, _ = run(url)
        assert digests(graph) == right
    assert proxy.troubled >= 3
    store = at(url)
    attempts = {e.path.split("/")[3] for e in store.bucket.list("data")}
    assert len(attempts) == NODES, "a commit whose answer was lost is one's own"
    assert maintenance.verify(store) == (NODES, [])


def test_a_server_that_ignores_conditions_is_refused(url, proxied):
    proxied(lambda *_: "blind")
    with raises("RIL-516"):
        at(url)
    with raises("RIL-516"):
        at(url)  # nothing was noted


def test_a_bucket_moved_to_another_server_is_tried_again(url, proxied):
    commit(at(url))
    proxied(lambda *_: "blind")
    with raises("RIL-516"):
        at(url)


def test_of_a_race_one_is_published(url):
    store, refs = at(url), []
    threads = [threading.Thread(target=lambda: refs.append(commit(at(url)))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refs) == 4
    assert len({r.path for r in refs}) == 1
    attempts = {"/".join(e.path.split("/")[:4]) for e in store.bucket.list("data")}
    assert attempts == {refs[0].path}, "the losers have cleared up"
    with raises("RIL-577"):
        commit(store, value=2.0)


def test_nothing_is_read_before_the_manifest_is_there(url, proxied):
    store = at(url)
    proxy = proxied(lambda method, path, count: "")
    commit(at(url))
    puts = [path for method, path in proxy.requests if method == "PUT" and ("/data/" in path or "/manifests/" in path)]
    assert "/manifests/" in puts[-1]
    assert sum("/manifests/" in p for p in puts) == 1
    store.bucket.delete([manifest_path("numbers", "k" * 64)])
    assert store.lookup("numbers", "k" * 64) is None


@pytest.mark.parametrize("way", ["delete", "truncate", "flip"])
def test_damage_is_seen_when_read_and_healed(url, right, way):
    run(url)
    store = at(url)
    entry = next(e for e in store.bucket.list("data/numbers") if "/values/c" in e.path)
    data = bytearray(store.bucket.get(entry.path)[0])
    data[len(data) // 2] ^= 4
    if way == "delete":
        store.bucket.delete([entry.path])
    else:
        store.bucket.put(entry.path, bytes(data) if way == "flip" else bytes(data[:-3]))
    store.survey("")
    ref = store.lookup("numbers", entry.path.split("/")[2])
    with raises("RIL-504", "values/c"):
        store.open(ref)["values"]
    assert store.lookup("numbers", ref.key) is None
    assert any("reason.txt" in e.path for e in store.bucket.list("quarantine"))
    graph, result = run(url)
    assert digests(graph) == right
    assert result.total().computed == 1


def test_a_task_heals_its_damaged_input(url, right):
    graph, _ = run(url)
    store = at(url)
    total = next(h for h in graph.nodes if h.stage == "total")
    scaled = next(h for h in graph.nodes if h.stage == "scale")
    store.bucket.delete([manifest_path("total", total.key), f"{scaled.ref.path}/level_0/c.0.0"])
    store.bucket.delete(e.path for e in store.bucket.list("index"))
    healed, result = run(url)
    assert digests(healed) == right
    assert result.total().computed == 2


def test_verify_and_gc(url):
    graph, _ = run(url)
    store = at(url)
    kept = {h.key for h in graph.nodes if h.stage != "total"}
    total = next(h for h in graph.nodes if h.stage == "total")
    assert maintenance.gc(store, kept).artifacts == 0, "it was made within the grace"
    assert maintenance.gc(store, kept, grace=-60, dry_run=True).artifacts == 1
    store.bucket.put("data/numbers/abc/a-orphan/zarr.json", b"{}")
    cleared = maintenance.gc(store, kept, grace=-60)
    assert (cleared.artifacts, cleared.orphans) == (1, 1)
    assert not list(store.bucket.list(total.ref.path))
    assert maintenance.verify(store) == (NODES - 1, [])
    chunk = next(e for e in store.bucket.list("data/scale") if "/c.0" in e.path)
    store.bucket.put(chunk.path, b"0" * chunk.size)
    sound, damaged = maintenance.verify(store)
    assert sound == NODES - 2
    assert damaged[0].stage == "scale"
    assert "another checksum" in damaged[0].reason


def test_what_a_run_used_lately_is_spared(url):
    run(url)
    assert maintenance.gc(at(url), set(), grace=0.0, dry_run=True).artifacts in (
        0,
        NODES,
    )  # the clock of a whole second
    assert maintenance.gc(at(url), set(), grace=3600).artifacts == 0


def test_no_secret_is_written_anywhere(url, tmp_path, capfd, proxied):
    run(url, ledger=tmp_path / "ledger.jsonl")
    with raises("RIL-508") as wrong:
        at("s3://no-such-bucket/x")
    said = str(wrong.value) + repr(wrong.value) + "".join(capfd.readouterr())
    stored = at(url).bucket
    contents = [stored.get(e.path)[0] for e in stored.list("")]
    contents += [gzip.decompress(c) for c in contents if c[:2] == b"\x1f\x8b"]
    contents += [p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()] + [said.encode()]
    assert len(contents) > 20
    for secret in (servers.SECRET, servers.KEY):
        assert not [c for c in contents if secret.encode() in c]


def rille(url, environment, *words):
    command = [sys.executable, "-m", "pipeline.cli", "cache", "verify", "--cache", url, *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stderr.strip()


def test_each_mistake_is_one_line(port, tmp_path, monkeypatch, proxied, url):
    monkeypatch.setattr(s3_client, "HASTY", {**s3_client.HASTY, "max_retries": 1})
    with raises("RIL-508"):
        at("s3://missing/x")
    proxied(lambda *_: "refuse")
    with raises("RIL-511", "503", "s3://bucket"):
        at(url)
    proxied(lambda *_: "forbid")
    with raises("RIL-510"):
        at(url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with raises("RIL-512", "127.0.0.1:9"):
        at(url)
    assert rille("s3://Bad_Bucket/x", dict(os.environ)) == (
        2,
        "rille: error RIL-548: 'Bad_Bucket' is no name of a bucket: give --cache s3://bucket/prefix, and credentials"
        " in the environment (AWS_ACCESS_KEY_ID ...)",
    )


@pytest.mark.parametrize(
    ("given", "code"),
    [
        ("gs://bucket/x", "RIL-546"),
        ("s3://key:hunter2@bucket/x", "RIL-547"),
        ("s3://bucket/x?secret=hunter2", "RIL-547"),
        ("s3:///x", "RIL-548"),
        ("s3://bucket/a b", "RIL-549"),
        ("s3://bucket/a/../b", "RIL-549"),
    ],
)
def test_bad_urls(given, code):
    with raises(code) as wrong:
        locate(given)
    assert "hunter2" not in str(wrong.value)


def test_locations():
    assert locate("s3://bucket//a/b/") == "s3://bucket/a/b"
    assert locate(Path("s3://bucket/a")) == "s3://bucket/a", "a path has lost a slash"
    assert locate("folder/x") == Path("folder/x")
    assert hints_folder(Path("c")) == Path("c")
    assert hints_folder("s3://bucket/a/b").name == "bucket+a+b"
    assert isinstance(at("some/folder"), Store)
    assert not isinstance(at("some/folder"), ObjectStore)


def test_of_a_window_only_the_chunks_are_fetched_that_it_touches(url, proxied):
    rng = np.random.default_rng(0)
    whole = Bundle({"values": rng.random((2500, 1100)), "mask": np.zeros((3, 4), dtype=np.uint8)}, {"frame": 0})
    ref = at(url).commit(numbers.STAGE, "k" * 64, whole, label="numbers/0")
    proxy = proxied(lambda *_: "")
    opened = at(url).open(ref)
    del proxy.requests[:]
    part = opened.part("values", (slice(1000, 1040), slice(5, 9)))
    assert (part == whole["values"][1000:1040, 5:9]).all()
    asked = sorted(path.rpartition("/")[2] for _, path in proxy.requests)
    assert asked == ["c.0.0", "c.1.0", "zarr.json"]
    assert (opened.raster("values")[2499:, 1024:] == whole["values"][2499:, 1024:]).all()
    assert (opened["values"] == whole["values"]).all()
    at(url).bucket.delete([f"{ref.path}/values/c.2.1"])
    assert (opened.part("values", (slice(0, 5), slice(0, 5))) == whole["values"][:5, :5]).all()
    with raises("RIL-504", "values/c.2.1"):
        opened.part("values", (slice(2400, 2500), slice(1030, 1040)))


def test_arrays_are_read_by_zarr_as_they_are(url):
    zarr = pytest.importorskip("zarr")
    from zarr.storage import ObjectStore as Remote

    store = at(url)
    ref = commit(store)
    group = zarr.open_group(Remote(store.bucket._store, read_only=True), path=ref.path, mode="r")
    assert (group["values"][...] == 1.0).all()
    assert json.dumps(group.attrs["meta"]) == '{"frame": 0}'


# -- what others put there ---------------------------------------------------------------------------------------------


def put(port, name, data=b"x"):
    """An object of any name; the client that Rille uses would refuse to write some of them."""
    import boto3

    boto3.client("s3", endpoint_url=f"http://127.0.0.1:{port}").put_object(Bucket="bucket", Key=name, Body=data)


@pytest.mark.parametrize("name", ["manifests//x.json", "manifests/../x", "manifests/a\x1b[2J/b", "index//x"])
def test_an_object_of_an_odd_name_leaves_the_bucket_usable(url, port, right, name):
    run(url)
    put(port, f"{url.removeprefix('s3://bucket/')}/{name}")
    s3_client._connect.cache_clear()
    warm, result = run(url)
    assert digests(warm) == right
    assert result.total().cached == NODES
    with raises("RIL-766"):
        maintenance.gc(at(url), set(), grace=0.0)


@pytest.mark.parametrize("name", ["manifests/x", "manifests/a/b/c/d", "data/x", "data/a/b/c/d", "index/x", "notes.txt"])
def test_objects_of_others_are_passed_over_and_stay(url, port, name):
    commit(at(url))
    whole = f"{url.removeprefix('s3://bucket/')}/{name}"
    put(port, whole)
    assert maintenance.verify(at(url)) == (1, [])
    assert maintenance.gc(at(url), set(), grace=-60.0).artifacts == 1
    assert s3_client.Bucket(url).get(name) is not None or name.startswith("index")


def test_an_index_is_never_unpacked_beyond_its_bound(url, monkeypatch):
    store = at(url)
    bomb = gzip.compress(bytes(100_000_000))
    assert len(bomb) < 100_000
    monkeypatch.setattr(s3, "MOST_UNPACKED", 1_000_000)
    store.bucket.put("index/bomb.json.gz", bomb)
    tracemalloc.start()
    store.survey("")
    assert tracemalloc.get_traced_memory()[1] < 30_000_000
    tracemalloc.stop()
    assert store._known == {}


@pytest.mark.parametrize(
    "change",
    [
        {"path": "data/../../../etc/a-1"},
        {"path": f"data/numbers/{'j' * 64}/a-1"},
        {"files": {"../../x": [1, "00000000"]}},
        {"files": {"values/c.0.0": ["1", "00000000"]}},
        {"arrays": {"values": {"dtype": "<f8", "shape": ["9" * 5000], "sha256": ""}}},
        {"arrays": {"values": {"dtype": "|O8", "shape": [1], "sha256": ""}}},
        {"meta": None},
        {"label": ["a"]},
    ],
)
def test_a_manifest_that_is_wrong_by_intent_counts_as_damaged(url, change):
    store = at(url)
    ref = commit(store)
    path = manifest_path(ref.stage, ref.key)
    store.bucket.put(path, frame(store.manifest(ref.stage, ref.key) | change))
    assert at(url).lookup(ref.stage, ref.key) is None
    assert at(url).lookup(ref.stage, ref.key) is None, "it was set aside"
    for text in (b"[" * 100_000, b'{"path": ' * 50_000, b"[]", b"1" * 5000):
        with pytest.raises(ValueError):  # noqa: PT011
            store_module.unframe(store_module._HEAD % google_crc32c.value(text) + text + b"}\n")
