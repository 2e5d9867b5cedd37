"""The toy stages of the engine's tests are importable, in worker processes and programs too."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rille.datasets.mockup import scene

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))


@pytest.fixture(scope="session", autouse=True)
def _each_bed_is_made_once() -> Iterator[None]:
    """A bed takes a second, and most simulated sequences of these tests have the same one."""
    made, build = dict[str, Any](), scene.build_scene

    def build_once(*given: object) -> Any:
        return made.get(str(given)) or made.setdefault(str(given), build(*given))  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(scene, "build_scene", build_once)
        yield


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def program_environment() -> dict[str, str]:
    """Environment of a program that can import the toy stages."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent.parent)])}
