"""What the cache holds, for which runs; pins; and what clearing leaves."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from itertools import pairwise

import pytest
from raising import raises
from toys.chain import run

from rille.pipeline.commands import cache as commands
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.manifest import artifact_path, frame, length
from rille.pipeline.runs import inventory, lookup, pins, roots


def grow_old(folder):
    for path in (folder / "cache").rglob("*"):
        os.utime(path, (1.0, 1.0))


@pytest.fixture
def two(tmp_path):
    return tmp_path, run(tmp_path, "1"), run(tmp_path, "2", seed=1)


def test_the_cache_is_listed_by_the_run_that_used_it_last(two, capsys):
    folder, first, _ = two
    store = Store(folder / "cache")
    rows = {(r.sequence, r.stage): r for r in inventory.holdings(store, folder / "runs")}
    assert rows["toy", "numbers"].artifacts == 8
    assert rows["toy", "numbers"].bytes == 8 * 40 * 40 * 5
    assert rows["toy", "numbers"].last_run == "toy/2"
    numbers = [store.manifest(stage, key) for stage, key in maintenance.artifacts(store) if stage == "numbers"]
    made = [manifest["provenance"]["started"] for manifest in numbers]
    assert (rows["toy", "numbers"].oldest, rows["toy", "numbers"].newest) == (min(made), max(made))
    on_disk = sum(p.stat().st_size for p in (folder / "cache/artifacts").rglob("*") if p.is_file())
    assert sum(r.stored for r in rows.values()) == on_disk
    shutil.rmtree(first)
    rows = {(r.sequence, r.stage): r for r in inventory.holdings(store, folder / "runs")}
    assert rows["-", "numbers"].artifacts == rows["toy", "numbers"].artifacts == 4
    assert inventory.ls(folder / "cache", folder / "runs", as_json=False) == 0
    assert "no kept run" in capsys.readouterr().out
    inventory.ls(folder / "cache", folder / "runs", as_json=True)
    assert {r["stage"] for r in json.loads(capsys.readouterr().out)} == {"numbers", "scale", "total"}


def test_the_largest_comes_first(tmp_path):
    run(tmp_path, "1", "a", frames=1)
    run(tmp_path, "1", "z", seed=1, size=200)
    rows = inventory.holdings(Store(tmp_path / "cache"), tmp_path / "runs")
    assert [r.sequence for r in rows] == 3 * ["z"] + 3 * ["a"]
    assert all(a.stored >= b.stored for a, b in pairwise(rows) if a.sequence == b.sequence)


@pytest.mark.parametrize(
    ("newest", "oldest", "words"),
    [(30, 30, " 30 s "), (300, 310, " 5 min "), (7 * 3600, 7 * 3600, " 7 h "), (7200, 3 * 86400, " 2 h..3 d ")],
)
def test_ages_are_told_in_the_largest_unit(newest, oldest, words):
    now = time.time()
    row = inventory.Holding("s", "locus", 2, 10, 10, oldest=now - oldest, newest=now - newest)
    assert words in list(inventory.describe([row], []))[1]


def test_the_last_run_is_the_last_one_of_all_folders(tmp_path):
    store = Store(tmp_path / "cache")
    first = run(tmp_path, "20260101T000000Z")
    # Of a folder whose name comes first, a run that came last.
    shutil.copytree(first, tmp_path / "a" / "toy" / "20260201T000000Z")
    roots.note(store, tmp_path / "a")
    assert {row.last_run for row in inventory.holdings(store, tmp_path / "runs")} == {"toy/20260201T000000Z"}


def test_a_pin_outlives_the_folder_of_its_run(two, capsys):
    folder, first, _ = two
    store = Store(folder / "cache")
    before = set(maintenance.artifacts(store))
    assert pins.pin(store, first) == 9
    shutil.rmtree(folder / "runs")
    grow_old(folder)
    rows = [r for r in inventory.holdings(store, folder / "runs") if r.stage == "numbers"]
    assert {(r.last_run, r.artifacts, r.pinned) for r in rows} == {("toy/1", 4, 4), ("-", 4, 0)}
    assert commands.gc(cache=folder / "cache", runs=folder / "runs", dry_run=True) == 0
    printed = capsys.readouterr().out
    assert "would remove 9 artifacts" in printed
    assert {line.split()[0]: line.split()[1] for line in printed.splitlines()[:3]} == {
        "numbers": "4",
        "scale": "4",
        "total": "1",
    }
    assert set(maintenance.artifacts(store)) == before, "it was only said"
    sizes = {stage: [0, 0] for stage in ("numbers", "scale", "total")}
    for stage, key in before:
        if key not in pins.keys(store):
            sizes[stage][0] += 1
            sizes[stage][1] += (folder / "cache" / artifact_path(stage, key)).stat().st_size
    assert maintenance.gc(store, pins.keys(store), dry_run=True).stages == sizes
    commands.gc(cache=folder / "cache", runs=folder / "runs", dry_run=False)
    assert {key for _, key in maintenance.artifacts(store)} == pins.keys(store)
    assert maintenance.verify(store, deep=True) == (9, [])
    with raises("RIL-563", "'2'", "toy/1"):
        pins.unpin(store, "2")
    assert pins.unpin(store, str(first)) == "toy/1"
    with raises("RIL-744", "no run is known"):
        commands.gc(cache=folder / "cache", runs=folder / "runs", dry_run=False)
    assert len(set(maintenance.artifacts(store))) == 9


def test_pins_add_up_and_the_latest_of_a_sequence_goes_first(two):
    folder, first, second = two
    store = Store(folder / "cache")
    assert pins.pin(store, first) == pins.pin(store, second) == 9
    assert pins.keys(store) == lookup.used(first) | lookup.used(second)
    assert [pins.unpin(store, name) for name in ("toy", "1")] == ["toy/2", "toy/1"]
    assert pins.pins(store) == []


def test_nothing_is_cleared_away_while_a_pin_cannot_be_read(two):
    folder, first, _ = two
    store = Store(folder / "cache")
    pins.pin(store, first)
    next((folder / "cache/pins").iterdir()).write_text("{")
    with raises("RIL-564"):
        commands.gc(cache=folder / "cache", runs=folder / "runs", dry_run=False)


def test_deep_verification_decodes_what_was_computed(two, capsys):
    """A wrong digest in a manifest that is whole by itself: no checksum of files sees it."""
    folder, _, _ = two
    store = Store(folder / "cache")
    stage, key = next(iter(maintenance.artifacts(store)))
    path = folder / "cache" / artifact_path(stage, key)
    data = path.read_bytes()
    manifest = json.loads(data[: length(data)])["manifest"]
    manifest["arrays"]["mask"]["sha256"] = "0" * 64
    path.write_bytes(frame(manifest) + data[length(data) :])
    assert maintenance.verify(store) == (18, [])
    assert commands.verify(cache=folder / "cache", deep=True) == 1
    assert f"{manifest['label']} (numbers): mask decoded to another digest; set aside" in capsys.readouterr().err
    assert lookup.keys([folder / "runs"])[key].startswith("toy/")


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
    assert "not readable; it stays, for the cache cannot be written" in capsys.readouterr().err
    assert commands.verify(cache=folder / "cache") == 1
    assert "not readable; set aside" in capsys.readouterr().err
