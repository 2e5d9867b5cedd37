"""What a section of the report consists of."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.report.canvas import Panel


@dataclass(frozen=True)
class Table:
    """Rows of words under ``head``; columns whose index is in ``numbers`` are set flush right."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Block:
    """One figure: panels side by side under a title, what one sees, a legend of ``(colour, words)`` and a table.

    ``strip``: the panels are narrow columns.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: tuple[tuple[str, str], ...] = ()
    table: Table | None = None
    strip: bool = False

    @property
    def anchor(self) -> str:
        """Where links lead."""
        return self.name.lower().replace(" ", "-")


@dataclass(frozen=True)
class Gallery:
    """The figures that could be drawn, and why others could not: ``(title, reason)``."""

    blocks: tuple[Block, ...]
    absent: tuple[tuple[str, str], ...]
