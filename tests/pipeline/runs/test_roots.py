"""A cache knows the folders of the runs that use it, so that clearing up from anywhere keeps what they need."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import pytest
from raising import raises
from toys import chain

from rille.pipeline.commands import cache
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.maintenance import artifacts, note_runs, noted_runs


@pytest.fixture
def used(tmp_path: Path) -> Store:
    """A cache whose artifacts are all older than the grace; a run under ``work/runs`` refers to them."""
    store, folder, graph = Store(tmp_path / "cache"), tmp_path / "work" / "runs", Graph()
    (folder / "toy" / "1").mkdir(parents=True)
    chain.build(graph)
    driver.run(graph, store, driver.RunOptions(executor="inline", ledger=folder / "toy" / "1" / "ledger.jsonl"))
    note_runs(store, folder)
    for path in store.root.glob("artifacts/*/*/*.zip"):
        os.utime(path, (0, 0))
    return store


def collect(store: Store, runs: Path) -> int:
    cache.gc(cache=store.root, runs=runs)
    return len(list(artifacts(store)))


def test_clearing_up_from_elsewhere_keeps_what_known_runs_need(used, tmp_path, monkeypatch):
    assert collect(used, tmp_path / "elsewhere" / "runs") == 9
    note_runs(used, tmp_path / "work" / "runs")
    assert len(list((used.root / "roots").iterdir())) == 1, "noted once"
    monkeypatch.setattr(maintenance.platform, "node", lambda: "another")
    note_runs(used, tmp_path / "work" / "runs")
    assert len(list((used.root / "roots").iterdir())) == 2, "by each machine: there, the folder may be another one"


def test_where_no_run_is_known_nothing_is_cleared(used, tmp_path):
    shutil.rmtree(tmp_path / "work")
    with raises("RIL-744", "no run is known"):
        collect(used, tmp_path / "elsewhere")
    assert len(list(artifacts(used))) == 9


def test_runs_of_another_machine_that_cannot_be_seen_stop_it(used, tmp_path):
    (used.root / "roots" / "other.json").write_text(json.dumps({"folder": "/nowhere/runs", "host": "other"}))
    with raises("RIL-743", "/nowhere/runs on other"):
        collect(used, tmp_path / "work" / "runs")
    (used.root / "roots" / "other.json").write_text("{")
    with raises("RIL-742", "other.json"):
        collect(used, tmp_path / "work" / "runs")


def test_a_cache_that_may_only_be_read_is_used_without_a_note(used, tmp_path, monkeypatch):
    def refuse(*_) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(atomic, "write", refuse)
    note_runs(used, tmp_path / "mine")
    assert noted_runs(used, tmp_path) == sorted([tmp_path, tmp_path / "work" / "runs"])


def test_what_may_not_be_removed_is_no_success(used, tmp_path, monkeypatch):
    owned, remove = next(used.root.glob("artifacts/*/*/*.zip")), Path.unlink

    def refuse(path: Path, missing_ok: bool = False) -> None:
        if path == owned:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        remove(path, missing_ok=missing_ok)

    graph, run = Graph(), tmp_path / "work" / "runs" / "toy" / "2"
    chain.build(graph, seed=1)
    run.mkdir()
    driver.run(graph, used, driver.RunOptions(executor="inline", ledger=run / "ledger.jsonl"))
    shutil.rmtree(run.parent / "1")
    monkeypatch.setattr(Path, "unlink", refuse)
    with raises("RIL-575", "Permission denied"):
        collect(used, run.parents[1])
    assert owned.exists()
    assert len(list(artifacts(used))) == 10, "the others are gone"
