"""Compiled kernels on disk: what is damaged, or another's, is compiled anew and never run."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from numba.core import caching
from toys.numbers import NumbersParams

from rille.pipeline.engine import progress
from rille.pipeline.engine.graph import Graph, Took
from rille.pipeline.engine.runtime import numba_cache
from rille.pipeline.engine.runtime.numba_cache import COMPILING, guard

ROOT = Path(__file__).resolve().parents[3]
KERNEL = """
from rille.pipeline.engine.runtime.numba_cache import guard
guard()
import numba
@numba.njit(cache=True)
def twice(x):
    return x * 2
print(twice(21), twice(2.5), sum(twice.stats.cache_hits.values()))
"""


@pytest.fixture
def entry(tmp_path):
    guard()
    made = caching.IndexDataCacheFile(str(tmp_path), "kernel", (1.0, 2))
    made.save(("int64", "x86"), ("code", 1))
    (file,) = tmp_path.iterdir()
    return made, file


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: b"",
        lambda d: d[:-3],
        lambda d: bytes(len(d)),
        lambda d: d[:20],
        lambda d: d[:40] + bytes([d[40] ^ 4]) + d[41:],
        lambda d: bytes([d[0] ^ 1]) + d[1:],
    ],
)
def test_a_damaged_entry_is_none_and_is_written_anew(entry, damage):
    cache, file = entry
    assert cache.load(("int64", "x86")) == ("code", 1)
    file.write_bytes(damage(file.read_bytes()))
    assert cache.load(("int64", "x86")) is None
    cache.save(("int64", "x86"), ("code", 2))
    assert cache.load(("int64", "x86")) == ("code", 2)


def test_entries_do_not_meet(entry, tmp_path):
    cache, file = entry
    cache.save(("float64", "x86"), ("other", 1))
    assert cache.load(("int64", "x86")) == ("code", 1)
    assert caching.IndexDataCacheFile(str(tmp_path), "kernel", (9.0, 2)).load(("int64", "x86")) is None
    (strange,) = set(tmp_path.iterdir()) - {file}
    strange.replace(file)
    assert cache.load(("int64", "x86")) is None, "a file that holds another key"


def test_numba_itself_finds_its_kernels_and_survives_damage(tmp_path):
    script = tmp_path / "kernel.py"
    script.write_text(KERNEL)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "numba"), "PYTHONPATH": str(ROOT)}

    def said():
        done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert said() == ["42", "5.0", "0"]
    assert said() == ["42", "5.0", "2"]
    first, *_ = (tmp_path / "numba").rglob("*.nbc")
    first.write_bytes(b"")
    assert said() == ["42", "5.0", "1"]
    assert said() == ["42", "5.0", "2"]


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
from rille.stages.caller import f
print(f(21), sum(f.stats.cache_hits.values()))
"""


@pytest.fixture
def checkout(tmp_path):
    """``checkout(name)``: own modules in which one kernel calls another file's; ``said`` runs it as a new process."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "user")}

    def make(name):
        stages = tmp_path / name / "stages"
        stages.mkdir(parents=True)
        for file, text in {"__init__": "", "callee": CALLEE, "caller": CALLER}.items():
            (stages / f"{file}.py").write_text(text)
        shutil.copytree(ROOT / "stages" / "core", stages / "core")
        for same in ("rille", "pipeline"):
            shutil.copytree(ROOT / same, tmp_path / name / same, symlinks=True)

        def said():
            done = subprocess.run(
                [sys.executable, "-c", RUN],
                env={**environment, "PYTHONPATH": str(tmp_path / name)},
                cwd=tmp_path,
                capture_output=True,
                text=True,
                check=True,
            )
            return done.stdout.split()

        return stages, said

    return make


def test_a_kernel_is_compiled_anew_when_another_file_changes_that_it_calls(checkout):
    stages, said = checkout("one")
    assert said() == ["43", "0"]
    assert said() == ["43", "1"]
    (stages / "callee.py").write_text(CALLEE.replace("x * 2", "x * 3"))
    assert said() == ["64", "0"]


def test_an_edit_beside_it_compiles_nothing_and_checkouts_share(checkout, tmp_path):
    _, said = checkout("one")
    said()
    stages, said = checkout("two")
    (stages / "other.py").write_text("X = 1\n")
    (stages / "caller.py").write_text(f'"""Words."""\n\n# and a comment\n{CALLER}')
    assert said() == ["43", "1"]
    assert {path.parent for path in tmp_path.rglob("*.nbc")} == {tmp_path / "user" / "rille" / "kernels"}


def test_kernels_that_nothing_loads_are_cleared(tmp_path, monkeypatch):
    monkeypatch.setattr(numba_cache, "folder", lambda: tmp_path)
    old, new = tmp_path / "old.nbc", tmp_path / "new.nbc"
    for path in (old, new):
        path.write_bytes(b"")
    os.utime(old, (0, 0))
    (old.parent / "renamed-meanwhile").symlink_to("nowhere")
    assert numba_cache.unused() == [old]


def test_seconds_of_compiling_end_with_the_outermost_kernel(entry, monkeypatch):
    cache, _ = entry
    clock = iter([10.0, 41.0, 50.0])
    monkeypatch.setattr(numba_cache.time, "perf_counter", lambda: next(clock))
    COMPILING.take()
    assert cache.load("outer") is None
    assert cache.load("callee") is None
    cache.save("callee", 1)
    assert COMPILING.seconds == 0
    cache.save("outer", 1)
    assert cache.load("outer") == 1
    assert COMPILING.take() == 31.0


WRAPPERS = """
from rille.pipeline.engine.runtime.environment import prepare_environment
prepare_environment()
from rille.stages.caller import f
f(21)
print("cfunc" in " ".join(f.inspect_llvm().values()), "cpython" in " ".join(f.inspect_llvm().values()))
"""


def test_own_kernels_are_compiled_without_the_wrapper_for_c(checkout, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "RUN", WRAPPERS)
    assert checkout("one")[1]() == ["False", "True"]


LATER = """
import sys
from rille.pipeline.engine.runtime.numba_cache import guard
guard()
from numba.core import caching
print("asks", flush=True)
print(caching.IndexDataCacheFile(sys.argv[1], "kernel", (1.0, 2)).load("late"))
"""


def test_of_two_processes_that_need_a_kernel_the_second_loads_what_the_first_compiled(entry, tmp_path):
    cache, _ = entry
    assert cache.load("late") is None, "this process compiles it from here on"
    command = [sys.executable, "-c", LATER, str(tmp_path)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"asks\n"
        time.sleep(0.5)
        assert other.poll() is None
        cache.save("late", "compiled once")
        assert other.stdout.read() == b"compiled once\n"


@pytest.mark.parametrize("end", ["take", "patience"])
def test_a_process_that_failed_to_compile_holds_nobody_up(entry, tmp_path, end):
    cache, _ = entry
    assert cache.load("late") is None
    script = LATER
    if end == "take":
        COMPILING.take()
    else:
        script = script.replace(
            "guard()\n", "guard()\nfrom rille.pipeline.engine.runtime import numba_cache as n\nn.PATIENCE = 0.1\n"
        )
    command = [sys.executable, "-c", script, str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, timeout=100)
    COMPILING.take()
    assert done.stdout == b"asks\nNone\n"


def test_a_run_says_what_it_compiled():
    stream = io.StringIO()
    shown = progress.Lines(stream)
    handle = Graph().node("toys.numbers", "n", NumbersParams(), {"frame": 0})
    shown.open(Graph(), {}, 1)
    shown.resolved(handle)
    assert stream.getvalue() == ""
    handle.took = Took(compiling=31.2)
    shown.resolved(handle)
    assert "31 s" in stream.getvalue()
