"""What clearing the cache leaves, and what verification finds."""

from __future__ import annotations

import errno
import json
import os
import shutil

import pytest
from raising import raises
from toys.chain import run

from rille.pipeline.commands import cache as commands
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.manifest import artifact_path, frame, length
from rille.pipeline.runs import lookup


def grow_old(folder):
    for path in (folder / "cache").rglob("*"):
        os.utime(path, (1.0, 1.0))


@pytest.fixture
def two(tmp_path):
    return tmp_path, run(tmp_path, "1"), run(tmp_path, "2", seed=1)


def test_what_no_kept_run_needs_goes_and_is_listed_first(two, capsys):
    folder, first, second = two
    store = Store(folder / "cache")
    before, kept = set(maintenance.artifacts(store)), lookup.used(first)
    shutil.rmtree(second)
    grow_old(folder)
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
        if key not in kept:
            sizes[stage][0] += 1
            sizes[stage][1] += (folder / "cache" / artifact_path(stage, key)).stat().st_size
    assert maintenance.gc(store, kept, dry_run=True).stages == sizes
    commands.gc(cache=folder / "cache", runs=folder / "runs", dry_run=False)
    assert {key for _, key in maintenance.artifacts(store)} == kept
    assert maintenance.verify(store, deep=True) == (9, [])
    shutil.rmtree(first)
    with raises("RIL-744", "no run is known"):
        commands.gc(cache=folder / "cache", runs=folder / "runs", dry_run=False)
    assert len(set(maintenance.artifacts(store))) == 9


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
