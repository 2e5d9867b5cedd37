"""The index beside the artifacts: it spares reading manifests, and is never believed where anything differs."""

from __future__ import annotations

import gzip
import os
import shutil
import time
import tracemalloc

import pytest
from toys import chain

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store import folder, index, manifest
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.folder import Folder, Item
from rille.pipeline.engine.store.manifest import Ref

NODES = 9


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr(folder, "RACY", 0.0)


def run(cache, **options):
    """Nodes of a run, and the manifests that its client read while it looked up."""
    graph, store, read = Graph(), Store(cache), []
    chain.build(graph, **options)
    real = store._read_manifest
    store._read_manifest = lambda stage, key: read.append(key) or real(stage, key)
    result = driver.run(graph, store, driver.RunOptions(executor="inline"))
    return {h.label: (h.status, h.ref) for h in graph.nodes}, read, result


def indices(cache):
    return sorted(p for p in (cache / "index").rglob("*") if p.is_file())


def test_a_second_run_reads_no_manifest_and_finds_the_same(cache):
    run(cache)
    (path,) = indices(cache)
    assert len(gzip.decompress(path.read_bytes()).splitlines()) == NODES
    before = path.stat().st_mtime_ns
    with_index, read, result = run(cache)
    assert (read, result.total().cached) == ([], NODES)
    assert [p.stat().st_mtime_ns for p in indices(cache)] == [before], "nothing new, nothing written"
    shutil.rmtree(cache / "index")
    without, read, _ = run(cache)
    assert len(read) == NODES
    assert with_index == without


def test_facts_of_what_is_found_are_read_only_where_somebody_asks(cache, monkeypatch):
    nodes, _, _ = run(cache)
    asked, real = [], index.parsed
    for module in (index, manifest):
        monkeypatch.setattr(module, "parsed", lambda text: asked.append(text) or real(text))
    store, (label, (_, given)) = Store(cache), next(item for item in nodes.items() if item[1][1].meta)
    asked.clear()
    manifest._read.cache_clear()
    run(cache)
    assert not any(text.startswith("{") for text in asked), "the flow of these tasks asks for none"
    store.survey(indices(cache)[0].parent.name)
    asked.clear()
    found = store.lookup(given.stage, given.key)
    assert [text[0] for text in asked] == ["["]
    assert found == given, label
    assert [text[0] for text in asked] == ["[", "{", "{"], "each of the two once"
    assert dict(found.meta) == given.meta
    assert len(asked) == 3, "once"


def test_a_run_says_anew_that_it_used_the_same(cache, monkeypatch):
    run(cache)
    (path,) = indices(cache)
    before = path.stat().st_mtime_ns
    monkeypatch.setattr(index, "FRESH", -1.0)
    assert run(cache)[1] == []
    assert [p.stat().st_mtime_ns > before for p in indices(cache)] == [True]


@pytest.mark.parametrize("way", ["touched", "rewritten", "replaced", "flipped"])
def test_a_file_that_was_changed_is_read_again(cache, way):
    nodes, _, _ = run(cache)
    ref = nodes["scale/1"][1]
    path = cache / ref.path
    data, times = path.read_bytes(), (path.stat().st_atime_ns, path.stat().st_mtime_ns)
    if way == "touched":
        os.utime(path)
    elif way == "rewritten":
        path.write_bytes(data)
    elif way == "replaced":
        path.with_name("copy").write_bytes(data)
        path.with_name("copy").replace(path)
    else:
        path.write_bytes(data[:100] + bytes([data[100] ^ 1]) + data[101:])
    os.utime(path, ns=times)  # whoever sets the times back is seen all the same
    again, read, result = run(cache)
    assert len(read) >= 1
    assert again["scale/1"][1].digest == ref.digest
    assert result.total().computed == (way == "flipped")
    assert run(cache)[1] == [], "it has a line again"


def test_a_file_that_was_cut_short_is_seen_by_its_size(cache):
    nodes, _, _ = run(cache)
    ref = nodes["numbers/2"][1]
    path = cache / ref.path
    path.write_bytes(path.read_bytes()[:-1])
    again, _, result = run(cache)
    assert again["numbers/2"][0] == "computed"
    assert again["numbers/2"][1].digest == ref.digest
    assert "bytes instead of" in next((cache / "quarantine").glob("*.txt")).read_text()
    assert result.total().computed == 1


@pytest.mark.parametrize(
    "damage", [lambda d: b"", lambda d: d[:-3], lambda d: d[:70] + bytes([d[70] ^ 1]) + d[71:], lambda d: b"\xff" * 99]
)
def test_a_damaged_index_counts_as_none(cache, damage, capsys):
    nodes, _, _ = run(cache)
    (path,) = indices(cache)
    path.write_bytes(damage(path.read_bytes()))
    again, read, _ = run(cache)
    assert len(read) == NODES
    assert capsys.readouterr().err.count("is passed over") == 1
    assert {label: ref for label, (_, ref) in again.items()} == {label: ref for label, (_, ref) in nodes.items()}
    assert run(cache)[1] == [], "it was written anew"


def test_what_was_changed_a_moment_ago_is_not_entered(cache, monkeypatch):
    monkeypatch.setattr(folder, "RACY", 3600.0)
    run(cache)
    assert not indices(cache)


def test_what_was_changed_a_moment_ago_is_read_again(cache, monkeypatch):
    run(cache)
    monkeypatch.setattr(folder, "RACY", 3600.0)
    assert len(run(cache)[1]) == NODES


def test_a_file_that_was_cut_short_during_the_run_is_not_entered(cache):
    ref = run(cache)[0]["scale/1"][1]
    shutil.rmtree(cache / "index")
    store, again = Store(cache), Store(cache)
    store.survey("s")
    os.truncate(cache / ref.path, ref.stored - 1)
    store.note([ref])
    again.survey("s")
    assert again.lookup(ref.stage, ref.key) is None


def test_sequences_have_an_index_each_and_parameters_share_one(cache):
    run(cache)
    run(cache, offset=1.0)
    assert len(list((cache / "index").iterdir())) == 1
    assert run(cache)[1] == [], "going back and forth costs nothing"
    run(cache, seed=5)
    assert len(list((cache / "index").iterdir())) == 2


def test_an_index_is_never_unpacked_beyond_its_bound(cache, monkeypatch, capsys):
    """A hundred megabytes of nothing in a hundred kilobytes: one line, and no memory."""
    bomb = gzip.compress(bytes(100_000_000))
    assert len(bomb) < 100_000
    (cache / "index/s").mkdir(parents=True)
    (cache / "index/s/bomb").write_bytes(bomb)
    monkeypatch.setattr(index, "MOST", 1_000_000)
    store = Store(cache)
    tracemalloc.start()
    store.survey("s")
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()
    assert store._index.lines == {}
    told = "index/s/bomb in the cache is passed over: it unpacks to more than 1 MB"
    assert capsys.readouterr().err == f"rille: warning RIL-984: {told}\n"


@pytest.mark.parametrize("line", [b"", b"\n", b"0" * 63 + b"\n"], ids=["one line", "empty lines", "short lines"])
def test_an_index_of_what_no_run_writes_costs_little(cache, monkeypatch, capsys, line):
    """An endless line is not joined again for each of its pieces, and lines of nothing are not counted out."""
    (cache / "index/s").mkdir(parents=True)
    (cache / "index/s/bomb").write_bytes(gzip.compress((line or b"0") * (300_000_000 // len(line or b"0")), 1))
    began = time.process_time()
    store = Store(cache)
    store.survey("s")
    assert time.process_time() - began < 3.0
    assert store._index.lines == {}
    assert capsys.readouterr().err.count("is passed over") == 1


def test_an_index_is_compact(tmp_path):
    """Of an artifact: key, digest and mark, which cannot be compressed further, and what its facts need."""

    class Marked(Folder):
        def status(self, path):
            return Item(path, 20_000, f"{hash(path) & (1 << 64) - 1:x}.4e20", 0.0)

    folder, refs = Marked(tmp_path), {}
    for k in range(5000):
        key, digest = (f"{hash((k, what)) & (1 << 256) - 1:064x}".replace("0000", f"{k:04x}") for what in "kd")
        refs[key] = Ref(key, "hfvm", digest, {"frame": k, "valid": k / 3}, 30_000 + k, 20_000)
    made = index.Index(folder, "s")
    made.note(refs)
    (path,) = indices(tmp_path)
    assert path.stat().st_size < 140 * len(refs)
    again = index.Index(folder, "s")
    key = next(iter(refs))
    assert again.get("hfvm", folder.status(refs[key].path), key) == refs[key]
