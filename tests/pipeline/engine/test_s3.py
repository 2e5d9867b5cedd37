"""The store in a bucket, against an S3 server on loopback and one that misbehaves."""

from __future__ import annotations

import gzip
import json
import os
import random
import subprocess
import sys
import threading
from datetime import datetime
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import servers
from toys import chain

from rille.pipeline.engine import scheduler
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store import maintenance, manifest, s3
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.folder import Folder
from rille.pipeline.engine.store.location import hints_folder, locate
from rille.pipeline.engine.store.manifest import artifact_path
from rille.stages.core.declare import Bundle

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
    result = scheduler.run(graph, Store(cache), scheduler.RunOptions(executor="inline", **options))
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
    s3._connect.cache_clear()  # as in a process of its own
    warm, result = run(url)
    assert digests(warm) == right
    assert result.total().cached == NODES
    assert not result.executor_started
    assert len(proxy.requests) <= 4, "the mark, two listings, an index: not one request an artifact"
    values = Store(url).open(warm.nodes[0].ref)["values"]
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
    store = Store(url)
    (entry,) = store.place.list("index")
    for data in (b"", b"no gzip", gzip.compress(b"x" * 50), store.place.read(entry.path)[:-9]):
        store.place.write(entry.path, data)
        warm, result = run(url)
        assert digests(warm) == right
        assert result.total().cached == NODES


@pytest.mark.parametrize("how", ["refuse", "deafen", pytest.param("cut", marks=pytest.mark.slow)])
def test_servers_in_trouble_change_nothing(url, right, proxied, how, monkeypatch):
    monkeypatch.setattr(s3, "BACK_OFF", {**s3.BACK_OFF, "init_backoff": s3.timedelta(milliseconds=5)})
    rng = random.Random(how)
    methods = {"refuse": ("GET", "PUT", "POST"), "deafen": ("PUT",), "cut": ("GET",)}[how]
    share = 0.08 if how == "cut" else 0.2
    proxy = proxied(lambda method, path, count: how if method in methods and rng.random() < share else "")
    for _ in range(2):
        graph, _ = run(url)
        assert digests(graph) == right
    assert proxy.troubled >= 2
    store = Store(url)
    assert len(list(store.place.list("artifacts"))) == NODES, "a commit whose answer was lost is one's own"
    assert maintenance.verify(store) == (NODES, [])


@pytest.mark.parametrize("read", [lambda b: b.read("a"), lambda b: b.list(""), lambda b: b.status("a")])
def test_a_server_in_trouble_is_asked_as_often_as_was_said(url, proxied, read, monkeypatch):
    monkeypatch.setattr(s3, "BACK_OFF", {**s3.BACK_OFF, "init_backoff": s3.timedelta(milliseconds=5)})
    proxy = proxied(lambda *_: "refuse")
    with raises("RIL-511"):
        read(s3.Bucket(url, {**s3.HASTY, "max_retries": 2}))
    assert proxy.troubled == 3


@pytest.mark.parametrize("method", ["read", "list"])
def test_answers_that_break_off_are_asked_for_again(url, proxied, method):
    s3.Bucket(url).write("area/a", b"0123456789" * 100)
    proxy = proxied(lambda _method, _path, count: "cut" if count <= 2 else "")
    bucket = s3.Bucket(url)
    if method == "read":
        assert bucket.read("area/a") == b"0123456789" * 100
    else:
        assert [item.path for item in bucket.list("area")] == ["area/a"]
    assert proxy.troubled >= 2


def test_a_server_that_ignores_conditions_is_refused(url, proxied):
    proxied(lambda *_: "blind")
    with raises("RIL-516"):
        Store(url)
    with raises("RIL-516"):
        Store(url)  # nothing was noted


def test_a_bucket_moved_to_another_server_is_tried_again(url, proxied):
    commit(Store(url))
    proxied(lambda *_: "blind")
    with raises("RIL-516"):
        Store(url)


def test_of_a_race_one_is_published(url):
    place, refs = Store(url).place, []
    threads = [threading.Thread(target=lambda: refs.append(commit(Store(url)))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refs) == 4
    assert len({r.path for r in refs}) == 1
    assert [e.path for e in place.list("artifacts")] == [refs[0].path], "the losers leave nothing"
    with raises("RIL-577"):
        commit(Store(url), value=2.0)


def test_a_commit_is_one_object(url, proxied):
    Store(url)
    proxy = proxied(lambda method, path, count: "")
    bucket = Store(url)
    del proxy.requests[:]
    ref = commit(bucket)
    assert [path.rpartition("/")[2] for method, path in proxy.requests if method == "PUT"] == [f"{ref.key}.zarr.zip"]
    bucket.place.delete([ref.path])
    assert bucket.lookup("numbers", "k" * 64) is None


def test_many_objects_are_removed_in_several_goes(url, monkeypatch):
    monkeypatch.setattr(s3, "AT_ONCE", 2)
    bucket, names = s3.Bucket(url), [f"area/{k}" for k in range(5)]
    for name in names:
        bucket.write(name, b"x")
    bucket.delete(["area/absent", *names])
    assert bucket.list("") == []


def test_artifacts_of_an_earlier_format_are_said_once(url, capsys):
    mark = json.loads(Store(url).place.read("rille.json"))
    Store(url).place.write("rille.json", json.dumps(mark | {"format": 1}).encode())
    for words in ("earlier format", ""):
        s3._connect.cache_clear()  # as in a process of its own
        Store(url).survey("s")
        said = capsys.readouterr().err
        assert words in said
        assert bool(words) == bool(said)


@pytest.mark.parametrize("way", ["delete", "truncate", "flip"])
def test_damage_is_healed(url, right, way):
    """A missing object and another size are seen at the look-up, another content when it is read."""
    run(url)
    store = Store(url)
    entry = next(e for e in store.place.list("artifacts/numbers"))
    data = bytearray(store.place.read(entry.path))
    key = entry.path.split("/")[-1].partition(".")[0]
    if way == "delete":
        store.place.delete([entry.path])
    else:
        start, size, _ = store.manifest("numbers", key)["files"]["values/c.0.0"]
        data[start + size // 2] ^= 4
        store.place.write(entry.path, bytes(data) if way == "flip" else bytes(data[:-3]))
    store.survey("")
    ref = store.lookup("numbers", key)
    assert (ref is None) == (way != "flip")
    if ref is not None:
        with raises("RIL-504", "values/c"):
            store.open(ref)["values"]
    assert store.lookup("numbers", key) is None
    assert any(e.path.endswith(".txt") for e in store.place.list("quarantine")) == (way != "delete")
    graph, result = run(url)
    assert digests(graph) == right
    assert result.total().computed == 1


def test_a_task_heals_its_damaged_input(url, right):
    graph, _ = run(url)
    store = Store(url)
    total = next(h for h in graph.nodes if h.stage == "total")
    scaled = next(h for h in graph.nodes if h.stage == "scale")
    data = bytearray(store.place.read(scaled.ref.path))
    data[store.manifest("scale", scaled.key)["files"]["level_0/c.0.0"][0]] ^= 1
    store.place.write(scaled.ref.path, bytes(data))
    store.place.delete([artifact_path("total", total.key)])
    healed, result = run(url)
    assert digests(healed) == right
    assert result.total().computed == 2


def test_verify_and_gc(url):
    graph, _ = run(url)
    store = Store(url)
    kept = {h.key for h in graph.nodes if h.stage != "total"}
    total = next(h for h in graph.nodes if h.stage == "total")
    assert maintenance.gc(store, kept).artifacts == 0, "it was made within the grace"
    assert maintenance.gc(store, kept, grace=-60, dry_run=True).artifacts == 1
    store.place.write("data/numbers/abc/a-orphan/zarr.json", b"{}")
    cleared = maintenance.gc(store, kept, grace=-60)
    assert (cleared.artifacts, cleared.orphans) == (1, 1)
    assert store.place.read(total.ref.path) is None
    assert maintenance.verify(store) == (NODES - 1, [])
    entry = next(iter(store.place.list("artifacts/scale")))
    data = store.place.read(entry.path)
    store.place.write(entry.path, data[:-9] + b"0" * 9)
    sound, damaged = maintenance.verify(store)
    assert sound == NODES - 2
    assert damaged[0].stage == "scale"
    assert "another checksum" in damaged[0].reason


def test_what_a_run_used_lately_is_spared(url, monkeypatch):
    run(url)
    store = Store(url)
    listed = store.place.list

    def as_if_old(area):
        return [e._replace(modified=0.0) if e.path.startswith("artifacts") else e for e in listed(area)]

    monkeypatch.setattr(store.place, "list", as_if_old)
    assert maintenance.gc(store, set(), grace=3600).artifacts == 0
    store.place.delete(entry.path for entry in listed("index"))
    assert maintenance.gc(store, set(), grace=3600).artifacts == NODES


def test_no_secret_is_written_anywhere(url, tmp_path, capfd, proxied):
    run(url, ledger=tmp_path / "ledger.jsonl")
    with raises("RIL-508") as wrong:
        Store("s3://no-such-bucket/x")
    said = str(wrong.value) + repr(wrong.value) + "".join(capfd.readouterr())
    stored = Store(url).place
    contents = [stored.read(e.path) for e in stored.list("")]
    contents += [gzip.decompress(c) for c in contents if c[:2] == b"\x1f\x8b"]
    contents += [p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()] + [said.encode()]
    assert len(contents) > NODES + 2
    for secret in (servers.SECRET, servers.KEY):
        assert not [c for c in contents if secret.encode() in c]


def rille(url, environment, *words):
    command = [sys.executable, "-m", "rille.pipeline.cli", "cache", "verify", "--cache", url, *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stderr.strip()


def test_an_object_without_a_tag_has_no_mark():
    known = {"path": "a", "size": 1, "last_modified": datetime.now()}
    assert [s3._item({**known, "e_tag": tag}).mark for tag in (None, '"ab"')] == ["", "ab"]


def test_each_mistake_is_one_line(port, tmp_path, monkeypatch, proxied, url):
    monkeypatch.setattr(s3, "HASTY", {**s3.HASTY, "max_retries": 1})
    with raises("RIL-508"):
        Store("s3://missing/x")
    proxied(lambda *_: "refuse")
    with raises("RIL-511", "503", "s3://bucket"):
        Store(url)
    proxied(lambda *_: "forbid")
    with raises("RIL-510"):
        Store(url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with raises("RIL-512", "127.0.0.1:9"):
        Store(url)
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
    assert isinstance(Store("some/folder").place, Folder)


def test_of_a_window_only_the_chunks_are_fetched_that_it_touches(url, proxied):
    rng = np.random.default_rng(0)
    whole = Bundle({"values": rng.random((2500, 1100)), "mask": np.zeros((3, 4), dtype=np.uint8)}, {"frame": 0})
    ref = Store(url).commit(numbers.STAGE, "k" * 64, whole, label="numbers/0")
    proxy = proxied(lambda *_: "")
    opened = Store(url).open(ref)
    del proxy.ranges[:]
    part = opened.part("values", (slice(1000, 1040), slice(5, 9)))
    assert (part == whole["values"][1000:1040, 5:9]).all()
    asked = sorted(proxy.ranges)
    members = Store(url).manifest(ref.stage, ref.key)["files"]
    wanted = [members[f"values/{name}"] for name in ("c.0.0", "c.1.0", "zarr.json")]
    assert asked == sorted(f"bytes={start}-{start + size - 1}" for start, size, _ in wanted)
    assert (opened.raster("values")[2499:, 1024:] == whole["values"][2499:, 1024:]).all()
    assert (opened["values"] == whole["values"]).all()
    Store(url).place.delete([ref.path])
    with raises("RIL-504", "missing"):
        opened.part("values", (slice(2400, 2500), slice(1030, 1040)))


# -- what others put there ---------------------------------------------------------------------------------------------


def put(port, name, data=b"x"):
    """An object of any name; the client that Rille uses would refuse to write some of them."""
    import boto3

    boto3.client("s3", endpoint_url=f"http://127.0.0.1:{port}").put_object(Bucket="bucket", Key=name, Body=data)


@pytest.mark.parametrize("name", ["artifacts//x.zip", "artifacts/../x", "artifacts/a\x1b[2J/b", "index//x"])
def test_an_object_of_an_odd_name_leaves_the_bucket_usable(url, port, right, name):
    run(url)
    put(port, f"{url.removeprefix('s3://bucket/')}/{name}")
    s3._connect.cache_clear()
    warm, result = run(url)
    assert digests(warm) == right
    assert result.total().cached == NODES
    with raises("RIL-766"):
        maintenance.gc(Store(url), set(), grace=0.0)


@pytest.mark.parametrize("name", ["artifacts/x", "artifacts/a/b/c/d", "data/x", "data/a/b/c/d", "index/x", "notes.txt"])
def test_objects_of_others_are_passed_over_and_stay(url, port, name):
    commit(Store(url))
    whole = f"{url.removeprefix('s3://bucket/')}/{name}"
    put(port, whole)
    assert maintenance.verify(Store(url)) == (1, [])
    assert maintenance.gc(Store(url), set(), grace=-60.0).artifacts == 1
    assert s3.Bucket(url).read(name) is not None or name.startswith("index")


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "scale"},
        {"key": "j" * 64},
        {"files": {"../../x": [0, 1, "00000000"]}},
        {"files": {"values/c.0.0": [0, "1", "00000000"]}},
        {"files": {"values/c.0.0": [0, 10**9, "00000000"]}},
        {"files": {"values/c.0.0": [-5, 5, "00000000"]}},
        {"archive": None},
        {"arrays": {"values": {"dtype": "<f8", "shape": ["9" * 5000], "sha256": ""}}},
        {"arrays": {"values": {"dtype": "|O8", "shape": [1], "sha256": ""}}},
        {"meta": None},
        {"label": ["a"]},
    ],
)
def test_a_manifest_that_is_wrong_by_intent_counts_as_damaged(url, change):
    store = Store(url)
    ref = commit(store)
    data = store.place.read(ref.path)
    start = manifest.length(data)
    # All but the change is right: offsets, size and checksum.
    store.place.write(ref.path, manifest.frame(json.loads(data[:start])["manifest"] | change) + data[start:])
    assert Store(url).lookup(ref.stage, ref.key) is None
    assert Store(url).lookup(ref.stage, ref.key) is None, "it was set aside"
    for text in (b"[" * 100_000, b'{"path": ' * 50_000, b"[]", b"1" * 5000):
        with pytest.raises(ValueError):  # noqa: PT011
            manifest.unframe(manifest._HEAD % (google_crc32c.value(text), len(text)) + text + b"}\n")
