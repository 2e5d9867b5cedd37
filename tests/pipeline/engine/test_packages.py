"""Which packages a stage depends on, and on which kind of processor."""

from __future__ import annotations

import ctypes
import importlib
import importlib.metadata
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy
import pytest
from raising import raises

from rille import datasets, stages
from rille.pipeline.engine import keys
from rille.stages.core.declare import declared

ROOT = Path(__file__).resolve().parents[3]


def stage_modules() -> list[str]:
    """Every module that declares a stage."""
    found = []
    for package in (stages, datasets):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if declared(importlib.import_module(info.name)) is not None:
                found.append(info.name)
    return found


@pytest.mark.parametrize("module", stage_modules())
def test_no_package_is_forgotten_or_missing(module):
    found = keys.versions(module)
    assert "numpy" in found
    for name, version in found.items():
        assert version.partition(" ")[0] == importlib.metadata.version(name)


def test_the_algebra_of_these_tests_takes_one_thread():
    """Where a plugin of pytest imports NumPy before the tests set the environment, some are ten times slower."""
    for path in Path(numpy.__file__).parents[1].glob("numpy.libs/*openblas*"):
        library = ctypes.CDLL(str(path))
        assert library.scipy_openblas_get_num_threads64_() == 1


def test_packages_come_from_the_imports_of_all_that_is_reached(tmp_path, monkeypatch):
    folder = tmp_path / "own_kit"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "main.py").write_text("import json\nfrom own_kit import far\n")
    (folder / "far.py").write_text("from typing import TYPE_CHECKING\ndef f():\n    import cv2.aruco, yaml\n")
    monkeypatch.syspath_prepend(tmp_path)
    for cached in (keys._roots, keys._file, keys.module_digests):
        cached.cache_clear()
    assert keys.external_imports("own_kit.main") == {"cv2", "yaml"}
    assert {name.lower() for name in keys.versions("own_kit.main")} == {"opencv-python-headless", "pyyaml"}
    (folder / "far.py").write_text("import no_such_package\n")
    for cached in (keys._read, keys.module_digests):
        cached.cache_clear()
    with raises("RIL-530", "no_such_package"):
        keys.versions("own_kit.main")


KINDS = """
from rille.pipeline.engine.keys import version
print([version(name) for name in ("numpy", "scipy", "opencv-python-headless")])
"""


def kinds(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", KINDS],
        env={**os.environ, **environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="the names are those of x86-64")
@pytest.mark.parametrize(
    "environment",
    [{"OPENBLAS_CORETYPE": "Nehalem"}, {"NPY_DISABLE_CPU_FEATURES": "X86_V3"}, {"OPENCV_CPU_DISABLE": "AVX2"}],
)
def test_another_kind_of_processor_is_another_environment(environment):
    assert kinds(**environment) != kinds()
