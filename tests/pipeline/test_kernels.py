"""Compiled kernels on disk: what is damaged, or another's, is compiled anew and never run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import caching

from pipeline.kernels import guard

ROOT = Path(__file__).resolve().parent.parent.parent
KERNEL = """
from pipeline.kernels import guard
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
