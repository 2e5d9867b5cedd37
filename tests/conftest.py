"""Shared fixtures."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from rille.pipeline.engine.runtime.environment import prepare_environment

prepare_environment()  # before NumPy and numba


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real sequences, named by RILLE_DATA; absence skips, or fails under RILLE_REQUIRE_DATA=1."""
    name = os.environ.get("RILLE_DATA", "")
    folder = Path(name) if name else None
    if folder is not None and folder.is_dir():
        return folder
    reason = f"RILLE_DATA={name!r} is not a folder of real sequences"
    if os.environ.get("RILLE_REQUIRE_DATA") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of chromium; absence skips, or fails under RILLE_REQUIRE_BROWSER=1."""
    found = shutil.which("chromium")
    if found is None:
        reason = "chromium is not installed"
        if os.environ.get("RILLE_REQUIRE_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return found
