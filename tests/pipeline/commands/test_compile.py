"""Kernels compiled beforehand: what a run then need not compile, and what is left behind."""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from rille.pipeline.commands.computing import compile as compilation
from rille.pipeline.engine.runtime import kernels as compiled
from rille.pipeline.runs.session import RunResult
from rille.stages.core.errors import RilleError


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of kernels of this test alone."""
    made = tmp_path / "kernels"
    made.mkdir()
    (made / "old.nbc").touch()
    monkeypatch.setattr(compiled, "folder", lambda: made)
    return made


def test_only_the_number_of_new_kernels_is_said(
    kernels: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = []

    def perform(sequence: str, options: Any, *, verb: str = "reconstruct", warn: Any) -> RunResult:
        warn("a warning of the run")
        (kernels / "function").mkdir(exist_ok=True)
        (kernels / "function" / f"{verb}.nbc").touch()
        options.runs.mkdir(exist_ok=True)
        folders.append(options.runs.parent)
        return RunResult(3, options.runs, ["a run's own words"], [])  # a drive that does not reach its goal

    monkeypatch.setattr(compilation, "perform", perform)
    compilation.compile_kernels()
    assert re.fullmatch(rf"{kernels}  kernels compiled: 2, in \d+ s\n", capsys.readouterr().out)
    assert len(folders) == 2
    assert not folders[0].exists()


def test_a_run_that_fails_is_an_error_and_leaves_nothing(kernels: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = []

    def perform(sequence: str, options: Any, *, verb: str = "reconstruct", warn: Any) -> RunResult:
        options.runs.mkdir()
        folders.append(options.runs.parent)
        raise RilleError("RIL-061", "cannot make a folder", remedy="make room")

    monkeypatch.setattr(compilation, "perform", perform)
    with pytest.raises(RilleError) as failed:
        compilation.compile_kernels()
    assert failed.value.code == "RIL-061"
    assert folders
    assert not folders[0].exists()


@pytest.mark.slow
def test_a_run_finds_its_kernels_compiled(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "own")}

    def rille(*words: str) -> str:
        program = Path(sysconfig.get_path("scripts")) / "rille"
        done = subprocess.run(
            [program, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    compiled = [int(n) for n in re.findall(r"compiled: (\d+)", rille("compile") + rille("compile"))]
    assert compiled[0] > 50
    assert compiled[1] == 0
    assert [p.name for p in tmp_path.iterdir()] == ["own"]
    folder = tmp_path / "own" / "rille" / "kernels"
    before = len(list(folder.glob("*/*.nbc")))
    rille("reconstruct", "mockup-short", "--quiet")
    assert len(list(folder.glob("*/*.nbc"))) - before <= 2
