"""Columns of a table by the meaning of their names, or by their numbers where they have no names."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from rille.datasets.text.tables import TextTable
from rille.datasets.text.units import unitless
from rille.stages.core.errors import InputError, warning

QUATERNION, POSITION, ANGLES = ("qw", "qx", "qy", "qz"), ("x", "y", "z"), ("roll", "pitch", "yaw")
UNTIMED = (*POSITION, "qx", "qy", "qz", "qw")
"""Order of the columns without names, one row a frame."""

WORDS = (
    (
        r"((gps|utc|_)[_. ]?)?(t|(date)?time(stamp)?|stamp|secs?|(nano)?seconds)|utc|gpst|.*[./]stamp([./]secs?)?",
        "time",
    ),
    (r"(gps|gnss)?[_. ]?(i?tow|sow|(gps)?sec(ond)?s?[_. ]?of[_. ]?(the[_. ]?)?week|time[_. ]?of[_. ]?week)", "time"),
    (r"(gps|gnss|gpst)?[_. ]?(week|wn|wno)([_. ]?(no|num|number))?", "week"),
    # ROS tools write the path of a field before its name.
    (r"(.*[./])?(q|r|quat|quaternion|orientation|rot|rotation|q_rs)[_./ ]?([wxyz])", r"q\3"),
    (r"(?:p|t|pos|position|trans|translation|p_rs_r|p_rs)?[_. ]?([xyz])", r"\1"),
    (r"(?:.*[./])?(?:position|translation)[./]([xyz])", r"\1"),
    ("(roll|pitch|yaw)", r"\1"),
    ("theta", "yaw"),
    # RTKLIB has baselines from the reference station, Metashape X/Easting, PlotJuggler /fix/altitude; others have
    # Gauss-Krueger's names, and EXIF's.
    (r"(?:utm[_. ]?|.*/)?(?:e|east|easting)(?:-baseline)?|rechtswert", "x"),
    (r"(?:utm[_. ]?|.*/)?(?:n|north|northing)(?:-baseline)?|hochwert", "y"),
    ("h|hoehe|h\N{LATIN SMALL LETTER O WITH DIAERESIS}he|elev", "z"),
    (r"(?:.*[./]|(?:gps|gnss|wgs84|utm)[_ ]?)?(?:up|u-baseline|height|alt|altitude|elevation|down|depth)", "z"),
    ("(?:.*[./_ ]|gps)?lat(?:itude)?", "lat"),
    ("(?:.*[./_ ]|gps)?(?:lng|long?(?:itude)?)", "lon"),
)
"""Names of columns, and their meaning, in which ``\\1`` is the first group of the name."""

ECEF = re.compile(r"(?:.*[./_ ])?(?:ecef[-_. ]?([xyz])|([xyz])[-_. ]?ecef)")
"""Names of columns of coordinates from the Earth's centre."""

ROTATION = re.compile(
    r"(.*[./_ ])?(rot|rvec|quat|orient|roll|pitch|yaw|heading|theta|omega|phi|kappa|euler|rodrig|axis_?angle).*"
    r"|(r|q|rv)_?[wxyz]|[rm]_?\d_?\d"
)
"""Names of columns of rotations of any kind."""


def meanings(table: TextTable) -> dict[str, int]:
    """Columns by the meaning of their names; no column whose name stands twice, as x of a place and of a quaternion."""
    columns: dict[str, int] = {}
    for k, name in enumerate(table.header):
        if table.header.count(name) > 1:
            continue
        word = unitless(name).rpartition("(")[2].strip(" )")  # of a list in brackets whose commas part it
        matches = ((re.fullmatch(pattern, word), meaning) for pattern, meaning in WORDS)
        meant = next((match.expand(meaning) for match, meaning in matches if match), None)
        if meant is not None:
            columns.setdefault({"lat": "y", "lon": "x"}.get(meant, meant) if table.crs else meant, k)
    if table.header[:1] == ("date",):
        columns.setdefault("time", 0)
    # Trackers of positions alone write zeros.
    if columns.keys() >= set(QUATERNION) and not table.values([columns[q] for q in QUATERNION]).any():
        columns = {name: k for name, k in columns.items() if name not in QUATERNION}
    bare = [unitless(name) for name in table.header]
    heights = [k for k, name in enumerate(bare) if name in ("u", "d")]
    if {"e", "n"} <= set(bare) and heights:  # beside others they may mean anything
        columns.setdefault("z", heights[0])
    if table.crs and "x" not in columns:
        columns |= geocentric(table)
    return columns


def geocentric(table: TextTable) -> dict[str, int]:
    """Columns that are named as coordinates from the Earth's centre, by axis."""
    found = ((ECEF.fullmatch(unitless(name)), k) for k, name in enumerate(table.header))
    return {match[1] or match[2]: k for match, k in found if match}


def have_rotation(columns: Mapping[str, int]) -> bool:
    """Whether there is a rotation among columns by their meaning."""
    return set(QUATERNION) <= set(columns) or set(ANGLES) <= set(columns)


def of_photographs(table: TextTable) -> bool:
    """Whether rows are places of images by name, with angles, as Metashape and Pix4D write them."""
    meant = meanings(table)
    by_name = {"x", "y", *ANGLES} <= meant.keys() and not {"time", *QUATERNION} & meant.keys()
    return by_name and bool(np.isinf(table.values([0])).all())


def columns_of_places(table: TextTable) -> dict[Any, str | int]:
    """Numbers (from 1) of the columns that their names make those of positions, of poses too; none without x and y."""
    meant = meanings(table)
    named = {name: k + 1 for name, k in meant.items() if name in ("time", *POSITION)}
    return dict(named) if {"x", "y"} <= meant.keys() else {}


def stated_column(table: TextTable, stated: str | int) -> int:
    """Index of a column that the manifest names or numbers.

    Raises
    ------
    InputError
        There is none.
    """
    for names in (table.header, list(map(unitless, table.header))):
        if isinstance(stated, str) and stated.strip().lower() in names:
            return names.index(stated.strip().lower())
    if isinstance(stated, int) and 1 <= stated <= table.columns:
        return stated - 1
    text = f"{table.name}: columns: there is no column {stated!r} of {', '.join(table.header) or table.columns}"
    raise InputError("RIL-806", text, remedy="give a name of its first line, or a number from 1")


def unread_times(table: TextTable, read: Collection[int]) -> tuple[str, ...]:
    """Warning about columns beside those that are ``read``, none of them the time, that grow as times do."""
    others = [k for k in range(len(table.header)) if k not in read]
    values = table.values(others)
    # Whole numbers below 10^6 count rows or images; of fewer than four rows any column may grow by chance.
    stamps = (np.diff(values, axis=0) > 0).all(axis=0) & ((values % 1 > 0) | (values >= 1e6)).any(axis=0)
    grows = np.flatnonzero(stamps)
    if len(values) < 4 or not grows.size:
        return ()
    names = " and ".join(table.header[others[k]] for k in grows)
    text = f"{table.name}: no column is called time, its rows count as one a pair, and {names} is not read"
    return (warning("RIL-717", f"{text}: if it is the time, call it time (time_ms, time_ns by its unit)"),)


def unread_rotations(table: TextTable) -> tuple[str, ...]:
    """Warning about columns beside those of positions that seem to hold rotations."""
    meant = meanings(table)
    taken = {meant.get(name) for name in ("time", *POSITION)}
    named = [name for k, name in enumerate(table.header) if k not in taken and ROTATION.fullmatch(unitless(name))]
    if not named:
        return ()
    columns = f"its columns {', '.join(named)} are no rotations about known axes"
    write = "for poses write places in metres, and qw, qx, qy, qz or roll, pitch, yaw, or rows of 3 x 4 numbers"
    return (warning("RIL-749", f"{table.name}: its positions alone are read; {columns}: {write}"),)


# -- columns without names ---------------------------------------------------------------------------------------------


def untimed(table: TextTable) -> bool:
    """Whether rows are x y z and a quaternion of length 1, one a frame."""
    if table.header or table.columns != len(UNTIMED):
        return False
    return bool(np.allclose(np.linalg.norm(table.values(range(3, 7)), axis=1), 1.0, atol=1e-3))


def matrix_at(table: TextTable) -> int | None:
    """First column of [R | t]: 0, or 1 after a time; None if the first whole row holds no rotation."""
    first = int(table.columns in (13, 17))
    if table.columns - first not in (12, 16):
        return None
    values = table.values(range(first, table.columns))
    whole = values[np.isfinite(values).all(1) & values.any(1)][:1].reshape(-1, 4)[:3, :3]
    # What is no rotation may be too large for a product.
    rotation = len(whole) and np.abs(whole).max() < 2 and np.allclose(whole @ whole.T, np.eye(3), atol=0.05)
    return first if rotation else None
