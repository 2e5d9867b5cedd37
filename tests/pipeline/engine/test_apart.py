"""No process imports, loads or obeys what lies in the current folder: the client, workers, their tracker, numba."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import ModuleType

import pytest

from rille.pipeline.engine.runtime import environment
from rille.pipeline.engine.runtime.environment import leave_out, take_back

RILLE = str(Path(sysconfig.get_path("scripts")) / "rille")

MODULES = ("pickle", "socket", "numba", "yaml", "json", "csv", "zipfile", "typing", "pathlib", "matplotlib", "tornado")
BEFORE_ANY_PROGRAM = ("sitecustomize", "usercustomize")
"""Python itself imports them: where the user's own search path names the current folder, before Rille begins."""

TRIPWIRE = """from pathlib import Path as _Path
(_Path(__file__).parent / "EXECUTED").touch()
raise ImportError("a module of the current folder")
"""
SETTINGS = {
    ".numba_config.yaml": "opt: tripwire\n",
    "matplotlibrc": "figure.figsize: tripwire\n",
    "dask.yaml": "distributed: tripwire\n",
    ".config/dask/dask.yaml": "distributed: tripwire\n",
    ".env": "RILLE_CACHE=tripwire://\n",
    "libz.so.1": "no library",
    "libexpat.so.1": "no library",
}

WORKERS = """
import sys, os
from pathlib import Path
from rille.pipeline.engine.runtime.environment import prepare_environment
prepare_environment()
from rille.pipeline.engine import workers

def now():
    return sys.path[0], os.environ.get("PYTHONSAFEPATH")

def look():
    import importlib.util, os, sys
    from rille.pipeline.engine import workers
    workers._prepare(ours=True)  # as the first task of a worker does
    importlib.util.find_spec("matplotlib")  # asks for it alone, as xarray does
    import matplotlib, numba
    assert numba.njit(lambda x: x + 1)(1) == 2
    return [entry for entry in sys.path if os.path.abspath(entry) == os.getcwd()]

if __name__ == "__main__":
    import cv2, numba, matplotlib  # this process is the user's: tripwires come when it has its modules
    for name, text in eval(sys.argv[1]).items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text)
    before = now()
    dask = workers.make("dask", 1, Path(sys.argv[2]), 2e9)
    print(dask._client.submit(look).result(60))
    dask.close()
    print(now() == before)
"""

COMPILES_AND_WRITES = """
import sys
from pathlib import Path
from rille.pipeline.cli import prepare
prepare()
import numba, matplotlib
import numpy as np
from rille.pipeline.export.paths import write_path
from rille.stages.core.declare import Bundle
write_path(Path(sys.argv[1]), Bundle({"path": np.zeros((2, 3))}, {}))
print(numba.njit(lambda x: x + 1)(1))
"""


def traps(*, python: bool = True) -> dict[str, str]:
    """Files by name."""
    modules = (*MODULES, *(BEFORE_ANY_PROGRAM if python else ()))
    return SETTINGS | {f"{name}.py": TRIPWIRE for name in modules}


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "downloaded"
    place.mkdir()
    return place


def lay(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def start(folder: Path, *command: str, **more: str) -> str:
    """What a process says that runs in the folder; nothing there was executed or complained of."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("RILLE_", "PYTHON"))}
    done = subprocess.run(
        command, cwd=folder, env=kept | more, capture_output=True, text=True, timeout=120, check=False
    )
    assert not (folder / "EXECUTED").exists(), done.stderr
    assert done.returncode == 0, done.stderr
    assert "matplotlibrc" not in done.stderr
    return done.stdout


PLAN = ("plan", "mockup-short", "--frames", "0:1")


@pytest.mark.parametrize(
    ("command", "path"),
    [([RILLE], ""), ([sys.executable, "-m", "rille"], ""), ([sys.executable, "-P", "-m", "rille"], ":/tmp:.")],
    ids=["rille", "python -m rille", "a search path with empty and relative entries"],
)
def test_the_client_leaves_the_current_folder_out(folder, command, path):
    lay(folder, traps(python=not path))
    assert "never computed" in start(folder, *command, *PLAN, PYTHONPATH=path)


def test_the_last_of_two_runs_in_one_interactive_python_takes_the_path_back(monkeypatch):
    monkeypatch.setattr(environment, "_was_on_path", [])  # without other runs of this process
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    leave_out()
    leave_out()
    take_back()
    assert "" not in sys.path
    assert "PYTHONSAFEPATH" in os.environ
    take_back()
    assert sys.path[0] == ""
    assert "PYTHONSAFEPATH" not in os.environ


def test_a_program_from_standard_input_has_no_file_that_workers_would_read(monkeypatch):
    program = ModuleType("__main__")
    program.__file__ = "<stdin>"
    monkeypatch.setitem(sys.modules, "__main__", program)
    leave_out()
    take_back()
    assert not hasattr(program, "__file__")


def test_workers_and_their_tracker_leave_it_out_of_the_path_of_an_interactive_python(folder, tmp_path):
    said = start(folder, sys.executable, "-c", WORKERS, repr(traps()), str(tmp_path / "cache"))
    assert said.split("\n")[:2] == ["[]", "True"]


def test_libraries_read_no_settings_and_no_data_there(folder, tmp_path):
    lay(folder, traps())
    for name in ("proj.db", "proj.ini"):  # who opens a pipe waits for ever
        os.mkfifo(folder / name)
    assert start(folder, sys.executable, "-P", "-c", COMPILES_AND_WRITES, str(tmp_path / "path.gpkg")) == "2\n"


def test_a_user_without_a_home_has_a_folder_for_matplotlib(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setenv("MPLCONFIGDIR", "")  # so that what is set below is taken back
    for home, own in ((tmp_path, False), (tmp_path / "nonexistent", True)):
        monkeypatch.delenv("MPLCONFIGDIR", raising=False)
        monkeypatch.setenv("HOME", str(home))
        environment.ignore_settings()
        assert ("MPLCONFIGDIR" in os.environ) is own
    assert Path(os.environ["MPLCONFIGDIR"]).parent.is_dir()
