"""Files appear whole or not at all, and by one module."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rille.pipeline.engine.runtime import atomic

PIPELINE = Path(__file__).parents[3] / "pipeline"


def names(folder):
    return sorted(p.name for p in folder.rglob("*"))


def test_a_file_is_replaced_or_left(tmp_path, monkeypatch):
    path = tmp_path / "deep" / "a.json"
    atomic.write(path, "one")
    atomic.write(path, b"two")
    assert path.read_bytes() == b"two"

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic.os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        atomic.write(path, "three")
    assert (path.read_bytes(), names(path.parent)) == (b"two", ["a.json"])


def test_a_full_disk_is_told_with_the_name_of_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")  # as a write gives it: without a name

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space") as by_write:
        atomic.write(tmp_path / "a", "one")
    with pytest.raises(OSError, match="No space") as by_block, atomic.replacing(tmp_path / "b") as path:
        path.write_bytes(b"two")
    assert (by_write.value.filename, by_block.value.filename) == (str(tmp_path / "a"), str(tmp_path / "b"))
    assert names(tmp_path) == []

    def closed(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "mkdir", lambda path, **more: more or closed(path))
    monkeypatch.setattr(Path, "write_bytes", closed)
    with pytest.raises(PermissionError) as by_write:
        atomic.write(tmp_path / "a", "one")
    with pytest.raises(PermissionError) as by_block, atomic.replacing(tmp_path / "b"):
        pass
    assert (by_write.value.filename, by_block.value.filename) == (str(tmp_path / "a"), str(tmp_path / "b"))


def test_a_write_protected_disk_is_told_with_the_name_of_the_file(tmp_path, monkeypatch):
    """Which refuses to remove a file before it looks whether there is one."""

    def refused(path, *_, **__):
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "write_bytes", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    with pytest.raises(OSError, match="Read-only") as error:
        atomic.write(tmp_path / "mask.png", b"")
    assert error.value.filename == str(tmp_path / "mask.png")


def test_what_stands_in_the_place_of_a_file_is_named(tmp_path):
    with pytest.raises(IsADirectoryError) as error:
        atomic.write(tmp_path, b"")
    assert error.value.filename == str(tmp_path)


def test_of_two_that_create_a_file_one_does(tmp_path):
    path = tmp_path / "a" / "b"
    assert atomic.create(path, b"one")
    assert not atomic.create(path, b"two")
    assert (path.read_bytes(), names(path.parent)) == (b"one", ["b"])


def test_a_block_that_fails_leaves_what_was_there(tmp_path):
    for name in ("file.tif", "folder.zarr"):
        path = tmp_path / name
        for turn in range(2):
            with atomic.replacing(path) as temporary:
                assert temporary.name == name
                place = temporary if name == "file.tif" else temporary / "x"
                place.parent.mkdir(exist_ok=True)
                place.write_text(f"{turn}")
        with pytest.raises(ValueError, match="half"), atomic.replacing(path) as temporary:
            raise ValueError("half")
        assert (path if path.is_file() else path / "x").read_text() == "1"
    assert names(tmp_path) == ["file.tif", "folder.zarr", "x"]


@pytest.mark.parametrize("full", [False, True])
def test_a_file_never_takes_the_place_of_a_folder(tmp_path, full):
    folder = tmp_path / "results"
    folder.mkdir()
    if full:
        (folder / "thesis.txt").write_text("years")
    with pytest.raises(IsADirectoryError, match="results"), atomic.replacing(folder) as temporary:
        temporary.write_text("a file")
    with pytest.raises(IsADirectoryError, match="results"):
        atomic.write(folder, "a file")
    assert names(tmp_path) == ["results"] + full * ["thesis.txt"]
    (tmp_path / "notes").write_text("years")
    with pytest.raises(NotADirectoryError, match="notes"), atomic.replacing(tmp_path / "notes") as temporary:
        temporary.mkdir()


def test_no_other_module_moves_files_into_place():
    pattern = re.compile(r"os\.(replace|link|fsync)\(|\.tmp\b|temporary\.(replace|rename)\(")
    found = [p for p in PIPELINE.rglob("*.py") if p.name != "atomic.py" and pattern.search(p.read_text("utf-8"))]
    assert [p.name for p in found] == ["maintenance.py"], "which clears away what is left over"


def test_names_that_are_no_utf8_are_spelt_out(tmp_path):
    atomic.write(tmp_path / "a.json", json.dumps("caf\udce9 ü", ensure_ascii=False))
    assert (tmp_path / "a.json").read_bytes() == b'"caf\\udce9 \xc3\xbc"'
    assert json.loads((tmp_path / "a.json").read_bytes()) == "caf\udce9 ü"
