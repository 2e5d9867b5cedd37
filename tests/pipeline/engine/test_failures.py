"""Failures of the machine end in one line with the place and the remedy, and a non-zero exit."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import tempfile

import cv2
import lazrs
import numpy as np
import pytest
from raising import raises

from rille.pipeline.cli import main
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.failures import translated
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store


def opencv_error() -> cv2.error:
    with pytest.raises(cv2.error) as caught:
        cv2.cvtColor(np.zeros((2, 2), np.uint8), cv2.COLOR_BGR2GRAY)
    return caught.value


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError("std::bad_alloc"), "RIL-736", "--memory-limit"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/there/file"), "RIL-737", "/there/file"),
        (OSError(errno.ENOSPC, "full", f"{tempfile.gettempdir()}/tmpx/dem.tif"), "RIL-737", "set TMPDIR"),
        (PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/there"), "RIL-737", "--output"),
        (opencv_error(), "RIL-738", "OpenCV"),
        (lazrs.LazrsError("IoError: Failed to call write"), "RIL-739", "cloud"),
    ],
)
def test_what_a_machine_or_a_library_refuses_is_told_in_one_line(monkeypatch, capsys, error, code, words):
    assert words in str(translated(error))
    monkeypatch.setattr("rille.pipeline.commands.sequences.init.hindrance", lambda *_: (_ for _ in ()).throw(error))
    with pytest.raises(SystemExit) as end:
        main(["init", "."])
    line = capsys.readouterr().err
    assert end.value.code == 1
    assert line.startswith(f"rille: error {code}: ")
    assert line.count("\n") == 1


@pytest.mark.parametrize("words", ["why", "compare-dem", "reconstruct", "init", "cache verify --cache", "check"])
def test_a_name_that_is_too_long_is_an_error_of_the_command_line(capsys, words):
    with pytest.raises(SystemExit) as end:
        main([*words.split(), "x" * 300, *(["a"] if words == "compare-dem" else [])])
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_link_that_leads_nowhere_and_a_folder_that_was_removed_are_named(tmp_path):
    (tmp_path / "runs").symlink_to("/scratch/gone")
    for path in (tmp_path / "runs", tmp_path / "runs" / "mockup" / "1"):
        with pytest.raises(OSError) as caught:  # noqa: PT011
            path.mkdir()
        assert "runs is a link to /scratch/gone, which is missing" in str(translated(caught.value))
    assert "current folder was removed" in str(translated(FileNotFoundError(errno.ENOENT, "No such file")))


def test_other_errors_are_left_as_they_are():
    assert translated(ZeroDivisionError()) is None


def test_a_cache_that_cannot_be_written_is_refused_before_anything_is_computed(tmp_path, monkeypatch):
    from toys.chain import build

    store, graph = Store(tmp_path / "cache"), Graph()
    build(graph)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("rille.pipeline.engine.store.base.tempfile.TemporaryFile", refuse)
    ended = []
    monkeypatch.setattr(driver, "make", lambda *_: ended.append("an executor was started"))
    with raises("RIL-575", "Read-only file system"):
        driver.run(graph, store)
    assert not ended
    (tmp_path / "file").touch()
    with raises("RIL-575", "Not a directory"):
        Store(tmp_path / "file" / "cache").writable()
    with raises("RIL-575", "Not a directory"):
        Store(tmp_path / "file").writable()


TINY = ["mockup.image_width=96", "mockup.image_height=80", "mockup.focal_length=100.0", "locus.cell_size=0.01"]
SMALL = ["--frames", "0:2", "--set", "crosscheck.enabled=false", "--set", "hfvm.preset=fast"]
SMALL += [word for assignment in TINY for word in ("--set", assignment)]


def test_a_run_whose_folder_is_removed_meanwhile_is_no_success(tmp_path, monkeypatch, capsys):
    folders = ["--cache", str(tmp_path / "cache"), "--runs", str(tmp_path / "runs"), "--executor", "inline"]
    known = driver.run

    def run(*args, **options):
        found = known(*args, **options)
        shutil.rmtree(tmp_path / "runs")
        return found

    monkeypatch.setattr(driver, "run", run)
    with pytest.raises(SystemExit) as end:
        main(["reconstruct", "mockup-short", *SMALL, *folders, "--quiet"])
    assert end.value.code == 1
    assert "RIL-740" in capsys.readouterr().err


def test_a_reader_that_has_enough_is_no_failure_to_talk_about(tmp_path):
    program = f"{sys.executable} -m pipeline.cli plan mockup-short --cache {tmp_path} | head -1"
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr == ""
