"""Compiled kernels on disk: what is damaged, or made of other code, is compiled anew and never run."""

from __future__ import annotations

import fcntl
import io
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numba
import numba.core.caching
import pytest
from toys.numbers import NumbersParams

from rille.pipeline.engine import events
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.runtime import kernels
from rille.pipeline.engine.runtime.kernels import Compiling, Locator
from rille.pipeline.engine.task import Took

ROOT = Path(__file__).resolve().parents[3]
CALLEE = "import numba\n@numba.njit(cache=True)\ndef twice(x):\n    return x * 2\n"
CALLER = """
import numba
from rille.stages.callee import twice
@numba.njit(cache=True)
def f(x):
    return twice(x) + 1
"""
RUN = """
from rille.pipeline.engine.runtime.environment import prepare_environment
prepare_environment()
from rille.pipeline.engine.runtime import kernels
kernels.PATIENCE_SECONDS = {patience}
from rille.stages.caller import f
print("asks", flush=True)
print(f(21), sum(f.stats.cache_hits.values()))
"""


@pytest.fixture
def checkout(tmp_path):
    """``checkout(name)``: own modules in which one kernel calls another file's; ``start`` runs it as a new process."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "user")}

    def make(name):
        stages = tmp_path / name / "stages"
        stages.mkdir(parents=True)
        for file, text in {"__init__": "", "callee": CALLEE, "caller": CALLER}.items():
            (stages / f"{file}.py").write_text(text)
        shutil.copytree(ROOT / "stages" / "core", stages / "core")
        for same in ("rille", "pipeline"):
            shutil.copytree(ROOT / same, tmp_path / name / same, symlinks=True)

        def start(patience=100.0):
            command = [sys.executable, "-c", RUN.format(patience=patience)]
            own = {**environment, "PYTHONPATH": str(tmp_path / name)}
            return subprocess.Popen(command, env=own, cwd=tmp_path, stdout=subprocess.PIPE, text=True)

        return stages, start

    return make


def said(process):
    """Result of the kernel, and the number of kernels that were loaded."""
    words, _ = process.communicate()
    assert process.returncode == 0
    return words.removeprefix("asks\n").split()


def test_a_kernel_is_compiled_anew_when_another_file_changes_that_it_calls(checkout):
    stages, start = checkout("one")
    assert said(start()) == ["43", "0"]
    assert said(start()) == ["43", "1"]
    (stages / "callee.py").write_text(CALLEE.replace("x * 2", "x * 3"))
    assert said(start()) == ["64", "0"]


def test_an_edit_beside_it_compiles_nothing_and_checkouts_share(checkout, tmp_path):
    _, start = checkout("one")
    said(start())
    stages, start = checkout("two")
    (stages / "other.py").write_text("X = 1\n")
    (stages / "caller.py").write_text(f'"""Words."""\n\n# and a comment\n{CALLER}')
    assert said(start()) == ["43", "1"]
    assert {path.parent.parent for path in tmp_path.rglob("*.nbc")} == {tmp_path / "user" / "rille" / "kernels"}


DAMAGES = (
    ("nbc", lambda d: b""),
    ("nbc", lambda d: d[:40] + bytes([d[40] ^ 4]) + d[41:]),
    ("nbi", lambda d: d[:-3]),
    ("json", lambda d: bytes(len(d))),
)


def test_a_damaged_kernel_is_compiled_anew(checkout, tmp_path):
    _, start = checkout("one")
    said(start())
    for kind, damage in DAMAGES:
        kept = [*(tmp_path / "user/rille/kernels").glob(f"*/*.{kind}")]
        assert kept
        for path in kept:
            path.write_bytes(damage(path.read_bytes()))
        assert said(start()) == ["43", "0"], kind
    assert said(start()) == ["43", "1"]


def test_numba_asks_us_first_also_where_it_is_imported_already(monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_LOCATOR_CLASSES", "")
    monkeypatch.delenv(kernels.LOCATORS, raising=False)
    kernels.use_own_folder()
    first, *others = numba.config.CACHE_LOCATOR_CLASSES.split(",")
    assert first == f"{Locator.__module__}.Locator"
    assert {getattr(numba.core.caching, name) for name in others} == set(numba.core.caching.CacheImpl._locator_classes)


def test_functions_of_others_stay_where_numba_keeps_them():
    assert Locator.from_function(shutil.copytree, shutil.__file__) is None


def test_kernels_that_nothing_loads_are_cleared(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "folder", lambda: tmp_path)
    old, new = tmp_path / "old", tmp_path / "new"
    for path in (old, new):
        path.mkdir()
    os.utime(old, (0, 0))
    (old.parent / "cleared-meanwhile").symlink_to("nowhere")
    assert kernels.unused() == [old]


def test_seconds_of_compiling_end_with_the_outermost_kernel(monkeypatch):
    clock = iter([10.0, 41.0, 50.0, 60.0])
    monkeypatch.setattr(kernels.time, "perf_counter", lambda: next(clock))
    compiling = Compiling()
    compiling.begin()
    compiling.begin()
    compiling.saved.append(SimpleNamespace(note_checksums=lambda: None))
    compiling.end()
    assert compiling.seconds == 0
    compiling.end()
    assert compiling.take() == 31.0
    compiling.begin()  # a kernel is loaded
    compiling.end()
    assert compiling.take() == 0.0


@pytest.mark.parametrize("patience", [100.0, 0.1])
def test_a_process_waits_for_another_that_compiles_but_not_for_ever(checkout, tmp_path, patience):
    _, start = checkout("one")
    private = tmp_path / "user" / "rille"
    private.mkdir(parents=True, mode=0o700)
    with (private / "compiling").open("w") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)
        process = start(patience)
        assert process.stdout.readline() == "asks\n"
        if patience > 1:
            time.sleep(0.5)
            assert process.poll() is None
            fcntl.lockf(lock, fcntl.LOCK_UN)
        assert said(process) == ["43", "0"]


def test_of_several_processes_one_compiles(checkout):
    _, start = checkout("one")
    assert sorted(said(process) for process in [start(), start(), start()]) == [["43", "0"], ["43", "1"], ["43", "1"]]


def test_a_run_says_what_it_compiled():
    stream = io.StringIO()
    shown = events.Lines(stream)
    handle = Graph().node("toys.numbers", "n", NumbersParams(), {"frame": 0})
    shown.open()
    shown.resolved(handle, 2, Took())
    assert stream.getvalue() == ""
    shown.resolved(handle, 2, Took(compiling=31.2))
    assert "31 s" in stream.getvalue()
