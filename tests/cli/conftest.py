"""One folder for all contract tests: two sequences and a drive in one cache, each command given twice."""

from __future__ import annotations

import fcntl
import json
import os
from dataclasses import asdict

import pytest
from place import PREPARATION, SETTINGS, STARTED, Done, Place


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """The folder is prepared once for all workers of pytest; nothing is written there afterwards."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cli"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        said = folder / "said.json"
        if not said.exists():
            (folder / "settings.toml").write_text(SETTINGS)
            empty = Place(folder, {})
            call = {name: empty.rille if name in STARTED else empty.here for name in PREPARATION}
            found = {name: asdict(call[name](*words)) for name, words in PREPARATION.items()}
            said.write_text(json.dumps(found))
    return Place(folder, {name: Done(**done) for name, done in json.loads(said.read_text()).items()})
