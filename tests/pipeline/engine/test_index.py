"""The index beside the artifacts: it spares reading manifests, and is never believed where anything differs."""

from __future__ import annotations

import os
import shutil

import pytest
from toys import chain

from pipeline.engine import scheduler
from pipeline.engine.graph import Graph
from pipeline.engine.store import folder as store_module
from pipeline.engine.store import index as catalogue
from pipeline.engine.store.folder import Store
from pipeline.engine.store.index import Catalogue, Entry, status


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr(catalogue, "RACY", 0)


def run(cache, **options):
    """Nodes of a run, and the manifests that its client read while it looked up."""
    graph, store, read = Graph(), Store(cache), []
    chain.build(graph, **options)
    real = store._read_manifest
    store._read_manifest = lambda home: read.append(str(home)) or real(home)
    result = scheduler.run(graph, store, executor="inline")
    return {h.label: (h.status, h.ref) for h in graph.nodes}, read, result


def index(cache):
    (path,) = (cache / "index").iterdir()
    return path


def test_a_second_run_reads_no_manifest_and_finds_the_same(cache):
    run(cache)
    assert len(index(cache).read_text().splitlines()) == 1 + 9
    before = index(cache).stat().st_mtime_ns
    with_index, read, result = run(cache)
    assert (read, result.total().cached) == ([], 9)
    assert index(cache).stat().st_mtime_ns == before, "nothing new, nothing written"
    shutil.rmtree(cache / "index")
    without, read, _ = run(cache)
    assert len(read) == 9
    assert with_index == without


def test_a_run_that_marks_its_artifacts_as_used_reads_no_manifest_either(cache, monkeypatch):
    """After an hour each look-up touches the manifest: then, and in the run after it, the index still holds."""
    run(cache)
    monkeypatch.setattr(store_module, "USED", -1.0)
    for _ in range(3):
        before = {path: path.stat().st_mtime_ns for path in cache.glob("artifacts/*/*/*/manifest.json")}
        _, read, result = run(cache)
        assert (read, result.total().cached) == ([], 9)
        assert all(path.stat().st_mtime_ns > then for path, then in before.items())


@pytest.mark.parametrize("way", ["touched", "rewritten", "replaced", "flipped"])
def test_a_manifest_that_was_changed_is_read_again(cache, way):
    nodes, _, _ = run(cache)
    ref = nodes["scale/1"][1]
    path = Store(cache).home("scale", ref.key) / "manifest.json"
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


def test_sizes_of_files_are_compared_with_the_index_too(cache):
    nodes, _, _ = run(cache)
    ref = nodes["numbers/2"][1]
    chunk = cache / ref.path / "values" / "c.0.0"
    chunk.write_bytes(chunk.read_bytes()[:-1])
    again, _, result = run(cache)
    assert again["numbers/2"][0] == "computed"
    assert again["numbers/2"][1].digest == ref.digest
    assert "has" in next((cache / "quarantine").glob("*/reason.txt")).read_text()
    assert result.total().computed == 1


@pytest.mark.parametrize(
    "damage", [lambda d: b"", lambda d: d[:-3], lambda d: d[:70] + b"9" + d[71:], lambda d: b"\xff" * 99]
)
def test_a_damaged_index_counts_as_none(cache, damage):
    nodes, _, _ = run(cache)
    index(cache).write_bytes(damage(index(cache).read_bytes()))
    again, read, _ = run(cache)
    assert len(read) == 9
    assert {label: ref for label, (_, ref) in again.items()} == {label: ref for label, (_, ref) in nodes.items()}
    assert run(cache)[1] == [], "it was written anew"


def test_what_was_changed_a_moment_ago_is_not_entered(cache, monkeypatch):
    monkeypatch.setattr(catalogue, "RACY", 3600 * 10**9)
    run(cache)
    assert not (cache / "index").exists()


def test_sequences_have_an_index_each_and_parameters_share_one(cache):
    run(cache)
    run(cache, offset=1.0)
    assert len(list((cache / "index").iterdir())) == 1
    assert run(cache)[1] == [], "going back and forth costs nothing"
    run(cache, seed=5)
    assert len(list((cache / "index").iterdir())) == 2


def test_lines_that_no_run_uses_any_more_go(tmp_path):
    made = os.stat(tmp_path)
    entry = Entry(status(made), "d", "p", 1, 2, {"a": [1.5, None]}, {"zarr.json": 3})
    assert Entry.read(entry.line()) == entry
    book = Catalogue(tmp_path / "index" / "x")
    for k in range(20):
        book.enter(f"{k:064d}", entry)
    book.save([f"{k:064d}" for k in range(2)])
    assert len(Catalogue.load(book.path).lines) == 2 * (1 + catalogue.SPARE)
