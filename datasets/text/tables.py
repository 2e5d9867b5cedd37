"""Tables of numbers in text files, as sensors and other programs write them: cells as text, lines remembered.

Columns are parted by commas, semicolons or blanks. The last line of words before the first row names the columns,
with or without a leading ``#``; later comments are passed over.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rille.datasets.text.reading import GREATEST, SAMPLE, read_lines
from rille.stages.core.errors import InputError

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|[-+]?(nan|inf)$", re.IGNORECASE)
DATE = re.compile(r"\s*[\"']?\d{4}[-/.]\d\d?[-/.]\d")


@dataclass(frozen=True)
class TextTable:
    """Rows of equal length; ``header`` is empty where the file has no names, ``lines`` are the rows' line numbers."""

    name: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    commas: bool

    @property
    def columns(self) -> int:
        """How many columns each row has."""
        return len(self.rows[0])

    def text(self, column: int) -> list[str]:
        """One column as it is written: exact, where a float would lose the last digits of a time stamp."""
        return [row[column] for row in self.rows]

    def numbers(self, columns: Sequence[int], gaps: bool = False) -> NDArray[np.float64]:
        """Columns as numbers below ``GREATEST``, (rows, columns); with ``gaps`` rows may be NaN as a whole.

        Raises
        ------
        InputError
            A cell is no such number; the message names the line.
        """
        values = np.array([[_number(row[column]) for column in columns] for row in self.rows])
        wrong = ~(np.abs(values) < GREATEST) & ~(gaps & np.isnan(values).all(axis=1, keepdims=True))
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            cell = self.rows[row][columns[column]][:40]
            text = f"{self.name}, line {self.lines[row]}: {cell!r} is not a finite number below {GREATEST:g}"
            raise InputError("RIL-284", text, remedy="correct or remove that line")
        return values


def _number(cell: str) -> float:
    """Number of a cell; infinity where it is none."""
    try:
        return float(cell)
    except ValueError:
        return math.inf


def read_table(path: Path, what: str) -> TextTable:
    """Table in a text file.

    Parameters
    ----------
    what : what the file should hold, for errors.

    Raises
    ------
    InputError
        It cannot be read, has no rows, or rows differ in length.
    """
    lines = read_lines(path, what)
    names, separator = "", None
    rows: list[tuple[str, ...]] = []
    at: list[int] = []
    for k, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or (rows and text.startswith("#")):
            continue
        if not rows:
            # Set anew by every line up to the first row, which decides: a comment above it may hold a comma.
            separator = next((s for s in (",", ";") if s in text), None)
        row = split(text, separator)
        if not rows and not NUMBER.match(row[0]):
            names = text.lstrip("#").strip()
            continue
        if rows and len(row) != len(rows[0]):
            text = f"{path}, line {k}: {len(row)} columns where the first row has {len(rows[0])}"
            raise InputError("RIL-285", text, remedy="correct or remove that line")
        rows.append(row)
        at.append(k)
    if not rows:
        dated = any(DATE.match(line) for line in lines[:SAMPLE])
        remedy = "write times as seconds, not as dates" if dated else "check that it is the right file"
        raise InputError("RIL-286", f"{what} {path} has no rows of numbers", remedy=remedy)
    header = split(names, separator) if names else ()
    header = header if len(header) == len(rows[0]) else ()
    return TextTable(str(path), tuple(name.lower() for name in header), tuple(rows), tuple(at), separator is not None)


def split(text: str, separator: str | None) -> tuple[str, ...]:
    """Cells of a line without their quotes; a separator at its end makes no cell."""
    cells = [cell.strip().strip("\"'").strip() for cell in text.split(separator)]
    return tuple(cells[:-1] if separator and len(cells) > 1 and not cells[-1] else cells)
