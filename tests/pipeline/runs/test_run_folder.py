"""Folders of runs."""

from __future__ import annotations

import errno
import os
import shlex
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pytest
from raising import raises

from rille.pipeline.engine.runtime import environment
from rille.pipeline.runs import session
from rille.stages.core.errors import ConfigError

NOW = datetime(2026, 1, 2, tzinfo=UTC)


@pytest.mark.parametrize("file", [False, True])
def test_what_is_no_link_to_a_run_is_told_before_anything_is_computed(tmp_path, file):
    (tmp_path / "latest").touch() if file else (tmp_path / "latest").mkdir()
    with raises("RIL-765", str(tmp_path / "latest")):
        session._make_folder(tmp_path, NOW)
    assert [p.name for p in tmp_path.iterdir()] == ["latest"]


def test_a_folder_that_is_a_broken_link_is_named(tmp_path):
    (tmp_path / "runs").symlink_to("gone/runs")
    with raises("RIL-061", "--runs") as error:
        session._make_folder(tmp_path / "runs" / "toy", NOW)
    assert isinstance(error.value, ConfigError)  # which ends a watch at once


def test_results_are_whole_where_no_link_can_be_made(tmp_path, monkeypatch, capsys):
    def refuse(path, *_, **__):
        raise PermissionError(errno.EPERM, "Operation not permitted", str(path))

    monkeypatch.setattr(Path, "symlink_to", refuse)
    folder = session._make_folder(tmp_path, NOW)
    session._point_latest(folder)
    assert "RIL-741" in (said := capsys.readouterr().err)
    assert folder.name in said


def test_a_link_to_a_run_that_has_gone_is_moved(tmp_path):
    (tmp_path / "latest").symlink_to("gone")
    folder = session._make_folder(tmp_path, NOW)
    session._point_latest(folder)
    assert (tmp_path / "latest").resolve() == folder


def test_a_link_that_a_killed_run_of_this_number_left_is_replaced(tmp_path):
    (tmp_path / f".latest-{os.getpid()}").symlink_to("killed")
    folder = session._make_folder(tmp_path, NOW)
    session._point_latest(folder)
    assert (tmp_path / "latest").resolve() == folder


def test_the_command_of_a_run_is_one_line_that_a_shell_takes(tmp_path):
    assignments = ("drive.goal=[0.1,\n2.0]", "hfvm.preset=fast", "a.b=\x1b")
    command = session.Options(assignments, config=tmp_path / "my file.toml").command("reconstruct", "my data")
    assert tomllib.loads(f"# {command}\n") == {}
    words = shlex.split(command)
    assert words[:5] == ["rille", "reconstruct", "my data", "--config", str(tmp_path / "my file.toml")]
    assert words[5:9] == ["--set", "drive.goal=[0.1, 2.0]", "--set", "hfvm.preset=fast"]


def test_too_few_open_files_are_named_before_anything_is_read(monkeypatch):
    asked = []
    monkeypatch.setattr(environment.resource, "getrlimit", lambda _: (24, 24))
    monkeypatch.setattr(environment.resource, "setrlimit", lambda _, limits: asked.append(limits))
    with raises("RIL-584", "24 open files", "ulimit -n"):
        session.perform("no-such-sequence", session.Options())
    monkeypatch.setattr(environment.resource, "getrlimit", lambda _: (256, 100_000))
    with raises("RIL-276"):
        session.perform("no-such-sequence", session.Options())
    assert asked == [(8192, 100_000)]


def test_what_is_said_before_a_run_or_at_its_end_is_no_warning_too() -> None:
    missing = [{"kind": "contradiction", "what": "models contradict", "why": ""}]
    lines = ["no IMU", "models contradict", "a blurred frame", "a blurred frame"]
    assert session.unsaid(lines, missing, ["no IMU"]) == ["a blurred frame"]
