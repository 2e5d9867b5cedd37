"""Tables of numbers in text files of sensors and other programs: cells as text, with line numbers.

Columns are separated by commas, semicolons, tabs or blanks. The last line of words before the first row has the names
of the columns, with or without a leading ``#`` or ``%``, and a line of units below it their units; later comments are
skipped. Below a CRS, as in OpenDroneMap's ``geo.txt``, the columns are image, x, y and z. A date and time of day at the
beginning of a row is a number of seconds. Cells may be empty.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from rille.datasets.text.reading import GREATEST, SAMPLE, read_lines
from rille.datasets.text.times import undated
from rille.datasets.text.units import OPERATOR, UNITS, unit_of
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import InputError, warning
from rille.stages.core.quantities import count

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|[-+]?(nan|inf)$", re.IGNORECASE)
STRUCTURED = re.compile(
    r"\s*(?:(?P<JSON>\{|\[\s*[\[{])|(?P<XML><[?!a-zA-Z])|(?P<NMEA>(?:[\d.:TZ-]+[\s,;]+)?\$[A-Z]{5},))"
)
"""Beginnings of files with records of another form: GPX and KML are XML; a logger writes its time before NMEA's."""

ROWS = (
    "write rows of numbers below a line of names, as time,x,y,z or time,x,y,z,qw,qx,qy,qz, in metres, or "
    "time,latitude,longitude,altitude in degrees and metres"
)
"""Remedy for these."""

CRS = re.compile(
    r"(EPSG:4\d{3}|\+proj=(?:latlong|longlat)\b.*)|EPSG:\d+|\+proj=.*|WGS ?84 UTM \d\d?[NS]", re.IGNORECASE
)
"""A coordinate reference system, of degrees or in a plane, as the first line of OpenDroneMap's ``geo.txt``."""

DATE = re.compile(r"\s*[\"']?\d{4}[-/.]\d\d?[-/.]\d")


@dataclass(frozen=True)
class TextTable:
    """Rows of equal length; ``header`` is empty if the file has no names, ``lines`` are the rows' line numbers.

    ``crs``: of columns of latitude and longitude that hold northing and easting, m, instead; empty: there are none.
    """

    name: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    commas: bool
    crs: str = ""

    @property
    def columns(self) -> int:
        """Number of columns."""
        return len(self.rows[0])

    def unit(self, column: int) -> str:
        """Unit in the name of a column (:func:`unit_of`); empty: none."""
        return unit_of(self.header[column]) if self.header else ""

    def text(self, column: int) -> list[str]:
        """One column as written: exact, while a float would lose the last digits of a time stamp."""
        return [row[column] for row in self.rows]

    def values(self, columns: Sequence[int]) -> Floats:
        """Columns as numbers (rows, columns); NaN for missing values, infinity for other texts."""
        return np.array([[number(row[column]) for column in columns] for row in self.rows])

    def measured(self, columns: Sequence[int], lost: AnyArray | bool = False) -> tuple[TextTable, tuple[str, ...]]:
        """The table without rows that lack a value in a column, repeat the row before, or are ``lost``, and a warning.

        If no row would be left, all are kept, and their reader reports the error.
        """
        repeated = np.array([False, *(row == before for before, row in pairwise(self.rows))])
        missing = np.asarray(np.isnan(self.values(columns)).any(axis=1) | repeated | lost)
        if missing.all() or not missing.any():
            return self, ()
        kept = [(row, line) for row, line, gone in zip(self.rows, self.lines, missing, strict=True) if not gone]
        rows, lines = zip(*kept, strict=True)
        rows_left_out = count(int(missing.sum()), "row")
        text = f"{self.name}: {rows_left_out} of {len(missing)} without a measurement of their own left out"
        text += f", the first in line {self.lines[int(missing.argmax())]}"
        return replace(self, rows=rows, lines=lines), (warning("RIL-706", text),)

    def measures(self, columns: Sequence[int], units: Mapping[str, float], unit: float | None = None) -> Floats:
        """Columns as :meth:`numbers`, times ``unit``, or by default times the unit in a column's name.

        Raises
        ------
        InputError
            A cell is no number, or the unit in a name is none of the ``units``.
        """
        factors = []
        for column in columns:
            stated = self.unit(column)
            if unit is None and stated and stated not in units:
                text = f"{self.name}: the unit of column {self.header[column]!r} is none of it, or is not known"
                raise InputError("RIL-995", text, remedy="convert it to m, rad, rad/s or m/s^2, and name it so")
            factors.append(units.get(stated, 1.0) if unit is None else unit)
        return self.numbers(columns) * factors

    def numbers(self, columns: Sequence[int], gaps: bool = False) -> Floats:
        """Columns as numbers below ``GREATEST``, (rows, columns); with ``gaps`` whole rows may be NaN.

        Raises
        ------
        InputError
            A cell is no such number; the message names the line.
        """
        values = self.values(columns)
        wrong = ~(np.abs(values) < GREATEST) & ~(gaps & np.isnan(values).all(axis=1, keepdims=True))
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            cell = self.rows[row][columns[column]][:40]
            text = f"{self.name}, line {self.lines[row]}: {cell!r} is not a finite number below {GREATEST:g}"
            raise InputError("RIL-284", text, remedy="correct or remove that line")
        return values


def number(cell: str) -> float:
    """Number of a cell; NaN for a missing value, infinity for any other text."""
    try:
        return math.nan if cell.lower() in ("", "-", "na", "n/a", "null", "none") else float(cell)
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
        It cannot be read, is JSON, XML or NMEA, has no rows, or rows differ in length.
    """
    lines = read_lines(path, what)
    if form := STRUCTURED.match("\n".join(lines[:SAMPLE])):
        raise InputError("RIL-979", f"{what} {path} is {form.lastgroup}, no table", remedy=ROWS)
    names, units, separator, columns = "", tuple[str, ...](), None, 0
    rows: list[tuple[str, ...]] = []
    at: list[int] = []
    for k, line in enumerate(lines, start=1):
        # Tabs at the end may separate empty cells.
        text = (undated(line) if DATE.match(line) else line).lstrip().rstrip(" ")
        if not text or (rows and text.startswith(("#", "%", "//"))):
            continue
        if not rows:
            # Set by every line up to the first row, which decides, since comments may hold commas.
            separator = next((s for s in ",;" if s in text), None)
            columns = 0 if CRS.fullmatch(names) else len(split(names, separator or ("\t" if "\t" in names else None)))
        row = split(text, separator, columns)
        if not rows and not NUMBER.match(row[0]) and not _named(row, columns or len(row)):
            text = text.lstrip("#%").strip()
            cells = split(text, separator, columns)
            below = names and len(cells) == len(split(names, separator, columns))
            of_units = below and all(UNITS.issuperset(OPERATOR.split(cell.lower())) for cell in cells)
            names, units = (names, cells) if of_units else (text, ())
            continue
        if rows and len(row) != columns:
            if k == len(lines) and len(row) < columns and not path.read_bytes().endswith(b"\n"):
                break  # torn, as of a recorder that was switched off
            text = f"{path}, line {k}: {len(row)} columns where the first row has {columns}"
            raise InputError("RIL-285", text, remedy="correct or remove that line")
        columns = len(row)
        rows.append(row)
        at.append(k)
    if not rows:
        last = next((f"; its last line is {line[:60]!r}" for line in reversed(lines) if line.strip()), "")
        text = f"{what} {path} has no rows that begin with a number{last}"
        raise InputError("RIL-286", text, remedy="check that it is the right file; dates are as 2026-05-31 12:00:00")
    header = split(names, separator, columns)
    if "".join(header[:1]).lower() in ("gpst", "utc") and len(header) == columns - 1:  # RTKLIB's week, and its seconds
        header = ("week", *header)
    header = header if len(header) == columns else _of_places(names, columns)
    if len(units) == columns:
        header = tuple(f"{n} [{u.strip('[]()')}]" if u else n for n, u in zip(header, units, strict=False))
    return TextTable(str(path), tuple(name.lower() for name in header), tuple(rows), tuple(at), separator is not None)


def _of_places(names: str, columns: int) -> tuple[str, ...]:
    """Names of the columns below a CRS: an image, its place, and others that are not read; none if there is no CRS."""
    if (crs := CRS.fullmatch(names)) is None:
        return ()
    place = ("longitude", "latitude", "altitude") if crs[1] else ("x", "y", "z")
    return ("image", *place, *(f"column {k}" for k in range(5, columns + 1)))[:columns]


def _named(row: tuple[str, ...], columns: int) -> bool:
    """Whether numbers follow a name, as that of a vehicle or of an image, in as many cells as there are names."""
    return (
        len(row) == columns
        and re.match(r"[\w./]", row[0]) is not None
        and 2 * sum(map(bool, map(NUMBER.match, row))) > columns
    )


def split(text: str, separator: str | None, columns: int = 0) -> tuple[str, ...]:
    """Cells of a line without quotes; a separator at the end adds a cell only if that makes ``columns`` cells.

    Without a separator, cells are separated by blanks, or by tabs alone if that makes ``columns`` cells.
    """
    if separator is None and "\t" in text and len(text.split()) != columns == text.count("\t") + 1:
        separator = "\t"
    cells = [cell.strip().strip("\"'").strip() for cell in text.split(separator)]
    return tuple(cells[:-1] if separator and len(cells) not in (1, columns) and not cells[-1] else cells)
