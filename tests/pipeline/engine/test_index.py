"""The index beside the artifacts: it spares reading manifests, and is never believed where anything differs."""

from __future__ import annotations

import os
import zlib

import pytest
from toys import chain

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store import folder, index
from rille.pipeline.engine.store.base import Store

NODES = 9


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr(folder, "RACY_S", 0.0)


def run(cache, **options):
    """Nodes of a run, and the manifests that its client read while it looked up."""
    graph, store, read = Graph(), Store(cache), []
    chain.build(graph, **options)
    real = store.read_manifest
    store.read_manifest = lambda stage, key: read.append(key) or real(stage, key)
    result = driver.run(graph, store, driver.RunOptions(executor="inline"))
    return {h.label: (h.status, h.ref) for h in graph.nodes}, read, result


def refs(nodes):
    return {label: ref for label, (_, ref) in nodes.items()}


def at(cache):
    """File of the index of a sequence without a name."""
    return Store(cache).hints("") / index.NAME


def lines(cache):
    return at(cache).read_text().split("\n")


def test_a_second_run_reads_no_manifest_and_finds_the_same(cache):
    run(cache)
    before = lines(cache)
    assert len(before) == NODES
    with_index, read, result = run(cache)
    assert (read, result.total().cached) == ([], NODES)
    assert lines(cache) == before
    at(cache).unlink()
    without, read, _ = run(cache)
    assert len(read) == NODES
    assert with_index == without


def test_a_run_over_old_artifacts_touches_them_and_notes_it(cache):
    nodes, _, _ = run(cache)
    for ref in refs(nodes).values():
        os.utime(cache / ref.path, (1.0, 1.0))
    assert len(run(cache)[1]) == NODES
    assert min((cache / ref.path).stat().st_mtime for ref in refs(nodes).values()) > 1e6
    assert run(cache)[1] == []


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
        path.write_bytes(data[:-200] + bytes([data[-200] ^ 1]) + data[-199:])
    os.utime(path, ns=times)  # whoever sets the times back is seen all the same
    again, read, result = run(cache)
    assert len(read) >= 1
    assert again["scale/1"][1].digest == ref.digest
    assert result.total().computed == (way == "flipped")
    assert run(cache)[1] == [], "it has a row again"


def test_what_was_changed_a_moment_ago_is_neither_entered_nor_believed(cache, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(folder, "RACY_S", 3600.0)
        run(cache)
        assert not at(cache).exists()
    run(cache)
    monkeypatch.setattr(folder, "RACY_S", 3600.0)
    assert len(run(cache)[1]) == NODES


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def of_gigabytes(path):
    os.truncate(path, 3_000_000_000)


@pytest.mark.parametrize(
    "way",
    [
        *(pipe, of_gigabytes),
        lambda path: path.write_bytes(b"\xff" * 99),
        lambda path: path.write_text("\n".join(path.read_text().replace('"meta":{', '"meta":{"more":1,').split("\n"))),
    ],
)
def test_an_index_that_is_none_of_ours_is_not_believed(cache, way):
    nodes, _, _ = run(cache)
    way(at(cache))
    again, read, _ = run(cache)
    assert len(read) == NODES
    assert refs(again) == refs(nodes)
    assert run(cache)[1] == [], "it was written anew"


def test_an_index_may_be_a_link_to_nothing_or_to_a_file_of_somebody_else(cache, tmp_path):
    run(cache)
    (tmp_path / "theirs.txt").write_text("theirs")
    for target in (tmp_path / "theirs.txt", tmp_path / "nothing"):
        at(cache).unlink()
        at(cache).symlink_to(target)
        assert len(run(cache)[1]) == NODES
    assert (tmp_path / "theirs.txt").read_text() == "theirs"
    assert not (tmp_path / "nothing").exists()


@pytest.mark.parametrize(
    "stated", ["{}", '{"key": 1, "stage": [], "digest": "", "meta": []}', "[" * 100_000, "", "\x85"]
)
def test_a_line_that_is_none_of_ours_is_not_believed(cache, stated):
    nodes, _, _ = run(cache)
    rests = [" ".join([*line.split(" ", 3)[1:3], stated]) for line in lines(cache)]
    at(cache).write_text("\n".join(f"{zlib.crc32(rest.encode()):08x} {rest}" for rest in rests))
    again, read, _ = run(cache)
    assert len(read) == NODES
    assert refs(again) == refs(nodes)


def test_half_an_index_spares_half_of_the_manifests(cache):
    run(cache)
    data = at(cache).read_bytes()
    at(cache).write_bytes(data[: len(data) // 2])
    assert 0 < len(run(cache)[1]) < NODES
    assert run(cache)[1] == []
