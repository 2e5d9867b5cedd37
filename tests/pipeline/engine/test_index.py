"""The index beside the artifacts: it spares reading manifests, and is never believed where anything differs."""

from __future__ import annotations

import os
import sqlite3
import zlib
from concurrent.futures import ThreadPoolExecutor

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


def rows(cache, query="SELECT * FROM artifacts", *values):
    with sqlite3.connect(cache / index.NAME) as database:
        return database.execute(query, values).fetchall()


def test_a_second_run_reads_no_manifest_and_finds_the_same(cache):
    run(cache)
    before = rows(cache)
    assert len(before) == NODES
    with_index, read, result = run(cache)
    assert (read, result.counts["cached"]) == ([], NODES)
    assert rows(cache) == before
    (cache / index.NAME).unlink()
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
    assert result.counts["computed"] == (way == "flipped")
    assert run(cache)[1] == [], "it has a row again"


def test_what_was_changed_a_moment_ago_is_neither_entered_nor_believed(cache, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(folder, "RACY_S", 3600.0)
        run(cache)
        assert not (cache / index.NAME).exists()
    run(cache)
    monkeypatch.setattr(folder, "RACY_S", 3600.0)
    assert len(run(cache)[1]) == NODES


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def of_gigabytes(path):
    os.truncate(path, 3_000_000_000)


def of_another_program(path):
    path.unlink()
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE places (url)")


def a_program(path):
    """A view that never ends."""
    path.unlink()
    with sqlite3.connect(path) as database:
        database.execute(
            "CREATE VIEW artifacts AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
            "SELECT i AS sequence, i AS key, i AS stated, i AS checksum FROM n"
        )


def with_a_trigger(path):
    with sqlite3.connect(path) as database:
        database.execute("CREATE TRIGGER t AFTER INSERT ON artifacts BEGIN DELETE FROM artifacts; END")


@pytest.mark.parametrize(
    "way",
    [
        *(pipe, of_gigabytes, of_another_program, a_program, with_a_trigger),
        lambda path: path.write_bytes(b"\xff" * 99),
        lambda path: path.write_bytes(path.read_bytes()[:3000]),
        lambda path: (path.unlink(), path.mkdir()),
    ],
)
def test_an_index_that_is_none_of_ours_is_set_aside(cache, way):
    nodes, _, _ = run(cache)
    way(cache / index.NAME)
    again, read, _ = run(cache)
    assert len(read) == NODES
    assert len(list((cache / "quarantine").iterdir())) == 1
    assert refs(again) == refs(nodes)
    assert run(cache)[1] == [], "it was written anew"


def test_an_index_may_be_a_link_to_nothing_or_to_a_file_of_somebody_else(cache, tmp_path):
    theirs = tmp_path / "theirs.sqlite"
    run(cache)
    (cache / index.NAME).rename(theirs)
    before = theirs.read_bytes()
    for target in (theirs, tmp_path / "nothing"):
        (cache / index.NAME).unlink(missing_ok=True)
        (cache / index.NAME).symlink_to(target)
        assert len(run(cache)[1]) == NODES
    assert theirs.read_bytes() == before
    assert not (tmp_path / "nothing").exists()


@pytest.mark.parametrize(
    ("stated", "right"),
    [
        ('["m", {}]', True),
        ('["m", {"key": 1, "stage": [], "digest": "", "meta": []}]', True),
        ("[" * 100_000, True),
        (7, True),
        (b"\xff", True),
        (None, True),
        ("flipped", False),
    ],
)
def test_a_row_that_is_none_of_ours_is_not_believed(cache, stated, right):
    nodes, _, _ = run(cache)
    if stated == "flipped":
        stated = rows(cache)[0][2].replace('"meta":{', '"meta":{"more":1,', 1)
    checksum = zlib.crc32(str(stated).encode()) if right else 5
    rows(cache, "UPDATE artifacts SET stated = ?, checksum = ?", stated, checksum)
    again, read, _ = run(cache)
    assert len(read) == NODES
    assert refs(again) == refs(nodes)


def test_a_locked_index_costs_a_bounded_wait(cache, monkeypatch):
    nodes, _, _ = run(cache)
    monkeypatch.setattr(index, "TIMEOUT_S", 0.05)
    with sqlite3.connect(cache / index.NAME) as other:
        other.execute("BEGIN EXCLUSIVE")
        again, read, _ = run(cache)
    assert len(read) == NODES
    assert refs(again) == refs(nodes)
    assert run(cache)[1] == [], "it is as it was"


def test_several_runs_enter_what_they_used_at_once(cache):
    nodes, _, _ = run(cache)
    (cache / index.NAME).unlink()
    stores = [Store(cache) for _ in nodes]
    for k, store in enumerate(stores):
        store.survey(f"s{k % 2}")
    with ThreadPoolExecutor(NODES) as pool:
        list(pool.map(lambda store, ref: store.note([ref]), stores, refs(nodes).values()))
    assert sorted(row[1] for row in rows(cache)) == sorted(ref.key for ref in refs(nodes).values())
