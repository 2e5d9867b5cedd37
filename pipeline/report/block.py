"""What a section of the report consists of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rille.pipeline.report.canvas import Panel


@dataclass(frozen=True)
class Table:
    """Rows of words under ``head``; columns whose index is in ``numbers`` are set flush right."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Block:
    """One figure: panels side by side under a title, what one sees, a legend of ``(colour, words)`` and a table.

    ``strip``: the panels are narrow columns. ``data``: what the page's script draws in their place, as plain JSON.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: tuple[tuple[str, str], ...] = ()
    table: Table | None = None
    strip: bool = False
    data: Mapping[str, Any] | None = None

    @property
    def anchor(self) -> str:
        """Where links lead."""
        return self.name.lower().replace(" ", "-")


@dataclass(frozen=True)
class Figure:
    """What became of a figure: its block, or why there is none; neither where nobody expects it.

    ``failed``: drawing it raised an error, so that the run lacks what it could have shown.
    """

    title: str
    block: Block | None = None
    why: str = ""
    failed: bool = False

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> Figure:
        """What ``dataclasses.asdict`` has taken apart."""
        given = d["block"]
        if given is None:
            return Figure(d["title"], None, d["why"], d["failed"])
        table = given["table"]
        if table is not None:
            table = Table(tuple(table["head"]), tuple(map(tuple, table["rows"])), frozenset(table["numbers"]))
        parts = {"panels": tuple(Panel(**panel) for panel in given["panels"]), "table": table}
        return Figure(d["title"], Block(**{**given, **parts, "legend": tuple(map(tuple, given["legend"]))}), d["why"])
