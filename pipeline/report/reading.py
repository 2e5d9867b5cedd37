"""What an output reads of a run, written as attribute access that type checkers follow, as names of its record."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from rille.pipeline.export.view import RunView
from rille.pipeline.flow.products import Products


class _Path:
    """Records the attributes that are read of it, as a dotted name."""

    def __init__(self, name: str = "") -> None:
        self._name = name

    def __getattr__(self, name: str) -> _Path:
        return _Path(f"{self._name}.{name}".lstrip("."))

    def __str__(self) -> str:
        return self._name


Used = tuple[object, ...]


def artifacts(uses: Callable[[Products], Used]) -> tuple[str, ...]:
    """Names of the products that ``uses`` reads, for the record of an output."""
    return tuple(map(str, uses(cast(Products, _Path()))))


def known(uses: Callable[[RunView], Used]) -> tuple[str, ...]:
    """Dotted names of the facts of a run that ``uses`` reads, for the record of an output."""
    return ("frames", *map(str, uses(cast(RunView, _Path()))))
