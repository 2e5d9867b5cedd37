"""What clearing the cache leaves, and what verification finds, as commands."""

from __future__ import annotations

import errno
import os
import shutil

import pytest
from raising import raises
from toys.chain import run

from rille.pipeline.commands import cache as commands
from rille.pipeline.engine.runtime import kernels
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.artifact import artifact_path
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import lookup


@pytest.fixture
def two(tmp_path):
    return tmp_path, run(tmp_path, "1"), run(tmp_path, "2", seed=1)


def test_what_no_kept_run_needs_goes_and_is_listed_first(two, tmp_path, capsys, monkeypatch):
    folder, first, second = two
    store, kernel, older = Store(folder / "cache"), tmp_path / "a.nbc", tmp_path / "older"
    before, kept = set(maintenance.artifacts(store)), lookup.used(first)
    older.mkdir()
    for path in (kernel, older / "b.nbc", store.root / "artifacts/.tmp-00ff", store.root / "notes.txt"):
        path.write_bytes(b"1234")
    (store.root / "quarantine").mkdir()
    (store.root / "quarantine/toy.zarr.zip").write_bytes(b"1234")
    monkeypatch.setattr(kernels, "unused", lambda: [kernel, older])
    shutil.rmtree(second)
    assert maintenance.gc(store, kept) == {}, "all is young"
    for path in store.root.rglob("*"):
        os.utime(path, (1.0, 1.0))
    commands.gc(cache=store.root, runs=folder / "runs", dry_run=True)
    printed = capsys.readouterr().out
    assert "would remove 9 artifacts and 2 leftovers" in printed
    lines = [line.split()[:2] for line in printed.splitlines()]
    assert sorted(lines[:3]) == [["numbers", "4"], ["scale", "4"], ["total", "1"]]
    assert set(maintenance.artifacts(store)) == before, "it was only said"
    assert kernel.exists()
    assert older.exists()
    commands.gc(cache=store.root, runs=folder / "runs")
    assert {key for _, key in maintenance.artifacts(store)} == kept
    assert not kernel.exists()
    assert not older.exists()
    assert {path.name for path in store.root.iterdir()} == {"artifacts", "hints", "notes.txt", "quarantine"}
    assert [path for area in ("quarantine", "hints") for path in (store.root / area).rglob(".tmp*")] == []
    assert maintenance.verify(store) == (9, [])
    shutil.rmtree(first)
    with raises("RIL-744", "no run is known"):
        commands.gc(cache=store.root, runs=folder / "runs")
    assert len(set(maintenance.artifacts(store))) == 9


def test_artifacts_behind_a_link_are_cleared_away_and_nothing_else_behind_links(two, capsys):
    folder, first, second = two
    store, (elsewhere, mine) = Store(folder / "cache"), (folder / name for name in ("disk", "mine"))
    (store.root / "artifacts").rename(elsewhere)
    (store.root / "artifacts").symlink_to(elsewhere)
    mine.mkdir()
    (mine / "notes.txt").touch()
    (store.root / "quarantine").symlink_to(mine)
    for path in (*elsewhere.rglob("*.zip"), mine / "notes.txt"):
        os.utime(path, (1.0, 1.0))
    shutil.rmtree(second)
    commands.gc(cache=store.root, runs=folder / "runs")
    assert "removed 9 artifacts and 0 leftovers" in capsys.readouterr().out
    assert {key for _, key in maintenance.artifacts(store)} == lookup.used(first)
    assert (mine / "notes.txt").exists()


def test_a_damaged_line_of_a_ledger_costs_its_task_alone(two):
    _, first, _ = two
    whole, ledger = lookup.used(first), first / lookup.LEDGER
    lines = ledger.read_bytes().splitlines(keepends=True)
    ledger.write_bytes(b"".join([lines[0], b"\xff" + lines[1], *lines[2:]]))
    assert len(lookup.used(first)) == len(whole) - 1


def test_what_cannot_be_set_aside_is_not_said_to_be(two, capsys, monkeypatch):
    folder, _, _ = two
    store = Store(folder / "cache")
    stage, key = next(iter(maintenance.artifacts(store)))
    path = folder / "cache" / artifact_path(stage, key)
    path.write_bytes(bytes(path.stat().st_size))

    def refuse(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as patched:
        patched.setattr(os, "rename", refuse)
        assert commands.verify(cache=folder / "cache") == 1
    assert "it stays, for the cache cannot be written" in capsys.readouterr().err
    assert commands.verify(cache=folder / "cache") == 1
    assert "set aside" in capsys.readouterr().err
    assert commands.verify(cache=folder / "cache") == 0
