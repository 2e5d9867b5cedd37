"""Hints: JSON files that speed up or explain later runs; where one is missing or damaged, nothing else suffers."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from rille.pipeline.engine.runtime import atomic

T = TypeVar("T")


def read_hint(path: Path, kind: TypeAdapter[T]) -> T | None:
    """What was left in a file; None if there is none, or something else."""
    # A pipe would block for ever, a device never ends.
    with suppress(OSError, ValueError):
        return None if not path.is_file() else kind.validate_json(path.read_bytes())
    return None


def write_hint(path: Path, value: Any) -> None:
    """Leave a value for later runs; best effort."""
    with suppress(OSError):
        atomic.write(path, json.dumps(value))
