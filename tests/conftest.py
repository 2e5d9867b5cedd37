"""Shared fixtures."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn

import hypothesis
import pytest

from rille.pipeline.engine.runtime.environment import prepare_environment

prepare_environment()  # before NumPy and numba

# A busy machine is no failure of the example.
hypothesis.settings.register_profile("rille", deadline=None)
hypothesis.settings.load_profile("rille")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real sequences, named by RILLE_DATA; absence skips, or fails under RILLE_REQUIRE_DATA=1."""
    name = os.environ.get("RILLE_DATA", "")
    folder = Path(name) if name else None
    if folder is not None and folder.is_dir():
        return folder
    return missing(f"RILLE_DATA={name!r} is not a folder of real sequences", "RILLE_REQUIRE_DATA")


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of chromium; absence skips, or fails under RILLE_REQUIRE_BROWSER=1."""
    return shutil.which("chromium") or missing("chromium is not installed", "RILLE_REQUIRE_BROWSER")


def missing(what: str, required: str) -> NoReturn:
    """Skip a test for what this machine lacks, or fail it where the variable ``required`` is 1, as in CI."""
    if os.environ.get(required) == "1":
        pytest.fail(what)
    pytest.skip(what)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the seconds of the tests of each folder, setups too, where ``--durations`` is given."""
    if terminalreporter.config.getoption("durations") is None:
        return
    seconds = Counter[str]()
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        if hasattr(report, "duration") and hasattr(report, "nodeid"):
            seconds[report.nodeid.partition("::")[0].rpartition("/")[0]] += report.duration
    terminalreporter.section("seconds by folder")
    for folder, total in seconds.most_common():
        terminalreporter.write_line(f"{total:8.1f} {folder}")
