"""Trajectories and attitudes of other programs and sensors, and interpolation of their poses.

Forms of a file, one pose T_reference_body per row:

* ``kitti``: 3 x 4 (or 4 x 4) numbers, row by row (4 x 4 perhaps column by column), perhaps after a time;
* ``tum``: time (or none, one row a frame), x y z, quaternion x y z w;
* ``euroc``: time (or none), x y z, quaternion w x y z, perhaps other columns;
* ``csv``: columns by name in any order: a time (``t``, ``time``, ``timestamp``), quaternion ``qw qx qy qz`` or angles
  ``roll pitch yaw`` with their unit (``roll_deg``, ``yaw [rad]``), and perhaps a position ``x y z`` (``px``, ``tx``);
  of a robot on a plane ``x y`` and ``yaw`` or ``theta``;
* ``colmap``: ``images.txt`` of a text model, two lines for each image: number, quaternion w x y z and translation from
  the world to the camera, the camera's number and the image's name; then its points, which are skipped.

Truth may be positions alone (:func:`positions_of`): columns x, y and perhaps time (or, as the first, names of images)
and z, by name or as the manifest states.

Angles are those of vehicles: R_reference_body = Rz(yaw) Ry(pitch) Rx(roll). Missing coordinates and angles are 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.georeference import projected
from rille.datasets.images.files import SUFFIXES
from rille.datasets.text import columns as by_name
from rille.datasets.text import units
from rille.datasets.text.columns import ANGLES, POSITION, QUATERNION, UNTIMED, meanings, stated_column
from rille.datasets.text.reading import GREATEST, read_lines
from rille.datasets.text.tables import TextTable, read_table
from rille.datasets.text.times import GPS_EPOCH, SECONDS_OF_WEEK, UNITS, of_two, of_week, seconds
from rille.datasets.text.units import unitless
from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import InputError, warning, within
from rille.stages.geometry.geometry import RigidTransform, orthonormal

ORDERED: Mapping[str, tuple[str, ...]] = {"tum": ("time", *UNTIMED), "euroc": ("time", *POSITION, *QUATERNION)}

IMAGES = ("image", *QUATERNION, *POSITION, "camera", "name")
IMAGE = re.compile(r"\s*(\d+(?:\s+\S+){7}\s+\d+)\s+(\S.*?)\s*")
"""Line of an image in a model of COLMAP."""

STAMP = re.compile(r"\d{16,}")
"""Time of EuRoC, nanoseconds; programs that write seconds have other orders of columns."""

WITHIN = 1e-6
"""s; times that differ by less are equal."""

NOT_IN_PLANE = re.compile(r"\b(lat|lon)|ecef")
"""Part of names of columns in degrees, and of coordinates from the Earth's centre."""

HEADING = re.compile(r"(?<![a-z])(head(ing)?|hdg|course|cog|bearing|azimuth|orientation|direction|angle|psi)(?![a-z])")
"""Part of names of columns that may be a yaw, of which they do not tell the sense and the beginning."""

DOWNWARDS = re.compile(r"(.*[./])?(down|depth)")
"""Names of columns of z that count downwards, as in NED frames and for vehicles under water."""

# Names of columns that are 0 if a GNSS receiver has no position, unlike a status, which is 0 if it has one.
FIX = re.compile(r"q|fix|(?:gps|fix|gnss)?[_. ]?qual(?:ity)?|fix[_. ]?type")

NANOSECONDS = re.compile(r"(.*[./_])?n(ano)?sec(s|onds)?")
"""Name of a column after that of the whole seconds, as in stamps of ROS messages."""


@dataclass(frozen=True)
class TimedPoses:
    """Poses of a file.

    Attributes
    ----------
    times : seconds, increasing; None if the file has none, and rows are frames.
    poses : T_reference_body, metres, one per row; None for a row of NaN, or of zeros.
    name : the file, for messages.
    warnings : on rows that were left out.
    images : names of the rows' images, with or without folders; empty if the file names none.
    """

    times: tuple[float, ...] | None
    poses: tuple[RigidTransform | None, ...]
    name: str = "poses"
    warnings: tuple[str, ...] = ()
    images: tuple[str, ...] = ()


def read_motion(path: Path, format: str = "auto", crs: str = "") -> TextTable:
    """The table of a file of poses or positions in any form (see module), its places :func:`projected`."""
    images = of_images(path) if format in ("auto", "colmap") else None
    return of_poses(read_table(path, "pose file"), crs) if images is None else images


def of_poses(table: TextTable, crs: str = "") -> TextTable:
    """The table with its places :func:`projected`.

    Raises
    ------
    InputError
        It holds motions from one row's time to the next one's, which are no poses.
    """
    first, second = (table.text(k) if "time" in "".join(table.header[k : k + 1]) else [] for k in (0, 1))
    if second[1:] and (first[1:] == second[:-1] or second[1:] == first[:-1]):
        text = f"{table.name} holds motions from one time to another ({table.header[0]}, {table.header[1]}), no poses"
        raise InputError("RIL-775", text, remedy="chain them, and write time x y z qx qy qz qw a line (tum)")
    return projected(table, crs)


def poses_of(table: TextTable, format: str = "auto", unit: float | None = None) -> TimedPoses:
    """Poses of a table (forms: see module).

    Parameters
    ----------
    format : one of the forms; ``auto`` goes by the columns' names if there are any, else 12 or 16 numbers per row mean
        ``kitti``, commas ``euroc`` and blanks ``tum``.
    unit : m; length of one unit of the file; None: by the names of its columns, else 1.

    Raises
    ------
    InputError
        The form is not recognised, or a row is not a time and a pose; the message names the line.
    """
    if table.header == IMAGES:
        poses = _posed(table, meanings(table), unit)
        images = tuple(table.text(len(IMAGES) - 1))
        return TimedPoses(None, tuple(pose.inverse() for pose in poses), table.name, images=images)
    meant = meanings(table)
    first = by_name.matrix_at(table)
    shaped = first is not None or table.columns in (12, 16)
    if format == "kitti" or (format == "auto" and shaped and not by_name.have_rotation(meant)):
        return _of_matrices(table, 1.0 if unit is None else unit, timed=first == 1)
    columns = _columns(table, format, meant)
    warnings, quaternion = tuple[str, ...](), columns.keys() >= set(QUATERNION)
    if "time" in columns:
        lost = np.zeros(len(table.rows), bool)
        if quaternion:
            # Trackers that have lost their target write zeros.
            lost |= ~np.any(table.values([columns[q] for q in QUATERNION]), axis=1)
        if quaternion and columns.keys() >= set(POSITION):
            lost |= _at_origin(table.values([columns[name] for name in (*POSITION, "qx", "qy", "qz")]))
        table, left_out = table.measured(list(columns.values()), lost)
        warnings += left_out
    times = times_of(table, columns["time"]) if "time" in columns else None
    warnings += by_name.unread_times(table, columns.values()) if times is None else ()
    poses = _posed(table, columns, unit)
    warnings += _rounded(np.array([pose.translation for pose in poses]), table.name)
    return TimedPoses(times, poses, table.name, warnings)


def _at_origin(values: Floats) -> Bools:
    """Rows (n,) of x, y, z, qx, qy, qz (n, 6) at the origin, far from the row before.

    Some programs write this pose if they have none.
    """
    origin = ~values.any(axis=1)
    measured = np.asarray(~origin & (np.abs(values) < GREATEST).all(axis=1))
    places = np.where(measured[:, None], values[:, :3], 0.0)
    steps = np.linalg.norm(np.diff(places[measured], axis=0), axis=1)
    before = np.maximum.accumulate(np.where(measured, np.arange(len(values)), 0))
    # A true return to the origin has steps like the others.
    jump = 10.0 * float(np.mean(steps)) if len(steps) else np.inf
    return np.asarray(origin & (np.linalg.norm(places[before], axis=1) > jump))


def _posed(table: TextTable, columns: Mapping[str, int], unit: float | None) -> tuple[RigidTransform, ...]:
    """Poses of a table whose columns are rotations, and perhaps positions in units of ``unit`` m."""
    rotations = _quaternions(table, columns) if columns.keys() >= set(QUATERNION) else _angles(table, columns)
    nothing = np.zeros((len(table.rows), 1))
    axes = [[columns[axis]] if axis in columns else [] for axis in POSITION]
    positions = np.hstack([_lengths(table, axis, unit) if axis else nothing for axis in axes])
    return tuple(RigidTransform(R, t) for R, t in zip(rotations, positions, strict=True))


def _lengths(table: TextTable, columns: Sequence[int], unit: float | None) -> Floats:
    """Coordinates (n, columns), m; the sign of those that count downwards is changed."""
    bare = [unitless(name) for name in table.header]
    down = {k for k, name in enumerate(bare) if DOWNWARDS.fullmatch(name) or (name == "d" and {"e", "n"} <= set(bare))}
    signs = [-1.0 if k in down else 1.0 for k in columns]
    return table.measures(columns, units.LENGTHS, unit) * signs


def of_images(path: Path) -> TextTable | None:
    """Table of :data:`IMAGES`, poses from the world to cameras, of COLMAP's ``images.txt``; None of any other file."""
    lines = enumerate(read_lines(path, "pose file"), start=1)
    matches = ((k, IMAGE.fullmatch(line)) for k, line in lines if not line.lstrip().startswith("#"))
    rows = {k: (*m[1].split(), m[2]) for k, m in matches if m and m[2].lower().endswith(SUFFIXES)}
    return TextTable(str(path), IMAGES, tuple(rows.values()), tuple(rows), commas=False) if rows else None


@dataclass(frozen=True)
class TimedPositions:
    """Positions of a file, x, y or x, y, z, m, one a row, their times, s, or their images; see :class:`TimedPoses`."""

    times: tuple[float, ...] | None
    positions: tuple[tuple[float, ...], ...]
    name: str
    warnings: tuple[str, ...]
    images: tuple[str, ...] = ()


def positions_of(
    table: TextTable, format: str, columns: Mapping[Any, str | int], unit: float | None = None, *, held: bool = False
) -> TimedPositions | None:
    """Positions of a table without rotations; None if the file holds poses.

    Parameters
    ----------
    table : degrees of latitude and longitude are :func:`projected` before.
    columns : name or number (from 1) of ``time``, ``x``, ``y``, ``z``, unless the table's names are clear; with any of
        them the table is one of positions.
    unit : as for :func:`poses_of`.
    held : rows that repeat the last measurement are left out, where a log is faster than its sensor.

    Raises
    ------
    InputError
        A column in ``columns`` does not exist, x or y is missing, or a cell is no number.
    """
    if format not in ("auto", "csv") or table.header == IMAGES:
        return None
    stated = {meaning: stated_column(table, column) for meaning, column in columns.items()}
    # A column that the user assigns to one axis is not another axis by its name: { x = "x", y = "z" } leaves no height.
    meant = {meaning: k for meaning, k in meanings(table).items() if k not in stated.values()} | stated
    known = {"x", "y"} & set(meant)
    many = len(known) < 2 and table.columns >= len(ORDERED["tum"])
    posed = by_name.have_rotation(meant) or many or by_name.matrix_at(table) is not None or by_name.untimed(table)
    # Beside degrees, and names of images, nothing says in which frame angles are.
    if not columns and posed and not (table.crs or by_name.of_photographs(table)):
        return None
    degrees = [axis for axis in known if table.header and NOT_IN_PLANE.search(table.header[meant[axis]])]
    if len(known) < 2 or (degrees and not table.crs):
        names = ", ".join(table.header) or f"{table.columns} without names"
        text = f"{table.name}: its columns ({names}) do not say which are x and y in metres"
        remedy = 'name them in the manifest: columns = { time = "NAME", x = "NAME", y = "NAME" }, or numbers'
        if any(map(NOT_IN_PLANE.search, table.header)):
            remedy = (
                "give decimal degrees, negative in the south and west (neither minutes nor degrees times 10^7), in "
            )
            remedy += "columns latitude and longitude"
            remedy += ", or metres in a plane, as UTM has them (easting, northing), in columns x and y"
        raise InputError("RIL-805", text, remedy=remedy)
    placed = [meant["x"], meant["y"]]
    placed += [meant["z"]] if "z" in meant and not np.isnan(table.values([meant["z"]])).all() else []
    timed = [meant["time"]] if "time" in meant else []
    named, warnings = not timed and bool(np.isinf(table.values([0])).all()), tuple[str, ...]()
    if timed or named:  # else rows are pairs
        lost = _without_fix(table, *placed[:2])
        table, left_out = table.measured([*timed, *placed], lost | _held(table.values(placed)) if held else lost)
        warnings += left_out
    rows = _lengths(table, placed, unit)
    warnings += _rounded(rows, table.name)
    times, images = times_of(table, *timed) if timed else None, tuple(table.text(0)) if named else ()
    warnings += () if timed or named else by_name.unread_times(table, placed)
    return TimedPositions(times, tuple(tuple(float(v) for v in row) for row in rows), table.name, warnings, images)


def _rounded(places: Floats, name: str) -> tuple[str, ...]:
    """Warning about coordinates (n, 2 or 3), m, in single precision, rounded to centimetres or more."""
    single = places.astype(np.float32)
    # Decimals may be such numbers too, but not in each of their steps: whole metres, or halves.
    stepwise = (places % (2.0 * np.spacing(np.abs(single).max(axis=0)))).any(axis=0)
    rounded = (places == single).all(axis=0) & stepwise & (np.ptp(places, axis=0) > 0)
    step = float(np.spacing(np.abs(single).max(axis=0))[rounded].max(initial=0.0))
    # Few rows may be such numbers by chance.
    if step < 0.01 or len(places) < 4:
        return ()
    line = f"{name}: its coordinates have steps of {step:g} m, as numbers of single precision have so far from 0"
    return (warning("RIL-709", f"{line}: write them in double precision, or less a constant"),)


def _without_fix(table: TextTable, x: int, y: int) -> AnyArray:
    """Rows without a position of the receiver: its quality is 0, or x and y are, a kilometre from all others."""
    away = np.hypot(*table.values([x, y]).T)
    quality = table.values([k for k, name in enumerate(table.header) if FIX.fullmatch(name)])
    none = ((quality == 0) & (quality > 0).any(axis=0)).any(axis=1)
    # 1000 m: no vehicle jumps so far.
    return np.asarray(none | ((away == 0) & bool(away[away > 0].min(initial=np.inf) > 1000.0)))


def _held(values: Floats) -> Bools:
    """Rows (n,) of values (n, k) that are those of the row before; none unless most values stand in several rows."""
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    lengths = np.diff(np.flatnonzero(np.append(~same, True)))
    return np.asarray(same & (len(lengths) > 2 and np.median(lengths) >= 2))


def times_of(table: TextTable, column: int) -> tuple[float, ...]:
    """Times of a column (:func:`rille.datasets.text.times.seconds`), in the unit of its name."""
    stamps, stated = table.text(column), table.unit(column)
    unit = stated if stated in UNITS else "auto"
    if NANOSECONDS.fullmatch("".join(table.header[column + 1 : column + 2])):
        stamps, unit = list(map(of_two, stamps, table.text(column + 1))), "s"
    if (week := week_of(table, column)) is not None:
        # u-blox' iTOW is in milliseconds, which its name does not say.
        unit = unit if unit != "auto" else "s" if table.values([column]).max() <= SECONDS_OF_WEEK else "ms"
        stamps, unit = [of_week(*cells, UNITS[unit]) for cells in zip(table.text(week), stamps, strict=True)], "s"
    return seconds(stamps, table.name, unit=unit, lines=table.lines)


def week_of(table: TextTable, column: int) -> int | None:
    """Column of GPS weeks beside a ``column`` of times within them; None: there is none."""
    week = meanings(table).get("week", column)
    return week if week != column and table.values([column]).max() <= 1000 * SECONDS_OF_WEEK else None


def _columns(table: TextTable, format: str, meant: dict[str, int]) -> dict[str, int]:
    """Columns of poses, by their names or in the order of the format."""
    if format in ("auto", "csv"):
        if by_name.have_rotation(meant) or {"x", "y", "yaw"} <= set(meant):  # of a robot on a plane
            return meant
        if {"x", "y"} <= set(meant):
            lacking = ", ".join(q for q in QUATERNION if q not in meant)
            text = f"{table.name}: its columns {', '.join(table.header)} are positions without a rotation ({lacking})"
            remedy = "add qw, qx, qy, qz or yaw_deg (roll_deg, pitch_deg); positions alone are [positions] or [truth]"
            raise InputError("RIL-801", text, remedy=_perhaps_yaw(table) + remedy)
    form = format if format != "auto" else "euroc" if table.commas else "tum"
    frames = by_name.untimed(table)
    bare = table.commas and (frames or table.columns == len(ORDERED["tum"])) and not STAMP.fullmatch(table.rows[0][0])
    if format == "auto" and bare:
        text = f"{table.name}: nothing says whether its quaternions are x, y, z, w or w, x, y, z"
        remedy = 'name its columns, or state format = "tum" (w last) or "euroc" (w first)'
        raise InputError("RIL-745", text, remedy=remedy)
    order = ORDERED.get(form, ())[frames:]
    more = table.columns > len(order) and (form == "tum" or (format == "auto" and table.header))  # of other meaning
    if not order or table.columns < len(order) or more:
        seen = f"columns {', '.join(table.header)}" if table.header else f"{table.columns} numbers"
        stated = "" if format == "auto" else f" of format {format}"
        text = f"{table.name}, line {table.lines[0]}: {seen} are no pose{stated}"
        named = "columns with names (csv), as time,qw,qx,qy,qz or time,roll_deg,pitch_deg,yaw_deg"
        remedy = f"3 x 4 numbers (kitti), time and 7 numbers (tum, euroc), or {named}; or state the format"
        raise InputError("RIL-264", text, remedy=_perhaps_yaw(table) + remedy)
    return {name: k for k, name in enumerate(order)}


def _perhaps_yaw(table: TextTable) -> str:
    """Beginning of a remedy for a table with a heading, of which nothing says how it counts; empty without one."""
    heading = next((name for name in table.header if HEADING.search(name)), "")
    hint = f"write a column yaw_deg: 90 less {heading} if that is degrees clockwise from y (north), {heading}"
    return f"{hint} if it is counter-clockwise from x; else " if heading else ""


def _angles(table: TextTable, columns: Mapping[str, int]) -> Floats:
    """Rotation matrices (n, 3, 3) of roll, pitch and yaw, in the unit of the names, else of the magnitudes."""
    from scipy.spatial.transform import Rotation

    known = [k for k, a in enumerate(ANGLES) if a in columns]
    values = np.zeros((len(table.rows), 3))
    places = [columns[ANGLES[k]] for k in known]
    values[:, known] = table.measures(places, units.ANGLES)
    stated = {table.unit(place) for place in places}
    if stated == {""} and np.abs(values).max() > 2 * np.pi:
        values, stated = np.deg2rad(values), {"deg"}
    if len(stated) != 1 or stated == {""}:
        names = " and ".join(table.header[place] for place in places) or "roll, pitch and yaw"
        text = f"{table.name}: the angles {names} have {'two units' if stated - {''} else 'no unit'}"
        remedy = "write it after their names, as yaw_deg or yaw_rad"
        raise InputError("RIL-265", text, remedy=remedy)
    # Capitals: intrinsic rotations, yaw first, then pitch, then roll.
    turns = Rotation.from_euler("ZYX", values[:, ::-1])
    return np.asarray(turns.as_matrix(), dtype=np.float64)


def _quaternions(table: TextTable, columns: Mapping[str, int]) -> Floats:
    """Rotation matrices (n, 3, 3) of unit quaternions."""
    from scipy.spatial.transform import Rotation

    q = table.numbers([columns[name] for name in ("qx", "qy", "qz", "qw")])
    norms = np.linalg.norm(q, axis=1)
    # 0.01: difference of the norm from 1; text has at least three digits, so more means another column.
    bad = np.flatnonzero(np.abs(norms - 1) > 0.01)
    if bad.size:
        k = int(bad[0])
        text = f"{table.name}, line {table.lines[k]}: a quaternion of length {norms[k]:.4g}"
        remedy = "give unit quaternions, and the format whose order of columns the file has"
        raise InputError("RIL-266", text, remedy=remedy)
    return np.asarray(Rotation.from_quat(q).as_matrix(), dtype=np.float64)


def _of_matrices(table: TextTable, unit: float, timed: bool) -> TimedPoses:
    """Poses of rows of [R | t], perhaps after a time; t is in units of ``unit`` m."""
    if table.columns - timed not in (12, 16):
        text = f"{table.name}, line {table.lines[0]}: {table.columns} numbers are no 3 x 4 pose"
        raise InputError("RIL-267", text, remedy="give 12 numbers a line, perhaps behind a time, or state the format")
    columns, warnings = range(timed, table.columns), tuple[str, ...]()
    if timed:  # else rows are frames
        table, warnings = table.measured(range(table.columns), (table.values(columns[:12]) == 0).all(axis=1))
    values = table.numbers(columns, gaps=True).reshape(len(table.rows), -1, 4)
    largest = np.nan_to_num(np.abs(values)).max(axis=0)
    if len(largest) == 4 and largest[3, :3].any() and not largest[:3, 3].any():
        values = values.transpose(0, 2, 1)  # column by column
    values = values[:, :3].copy()
    values[:, :, 3] *= unit
    poses = tuple(
        None if np.isnan(m).any() or not m.any() else rounded_pose(m, f"{table.name}, line {line}")
        for m, line in zip(values, table.lines, strict=True)
    )
    return TimedPoses(times_of(table, 0) if timed else None, poses, table.name, warnings)


def rounded_pose(m: Floats, where: str) -> RigidTransform:
    """Pose of [R | t] (3, 4); its rotation, written with few digits, is made orthonormal.

    Raises
    ------
    InputError
        It is not even roughly a rotation; the message begins with ``where``.
    """
    with within(where):
        RigidTransform(m[:, :3], m[:, 3])
    return RigidTransform(orthonormal(m[:, :3]), m[:, 3])


def interpolate(timed: TimedPoses, at: Sequence[float], max_gap: float) -> tuple[RigidTransform | None, ...]:
    """Poses at other times: positions on the straight line, rotations on the shortest arc between two rows.

    Parameters
    ----------
    at : seconds, of the same clock.
    max_gap : seconds; between rows farther apart nothing is interpolated.

    Returns
    -------
    tuple
        One entry per time; None in longer gaps and beyond the first and last row (:func:`coverage` counts them).

    Raises
    ------
    InputError
        The poses have no times, or none of ``at`` lies between the first and the last.
    """
    from scipy.spatial.transform import Rotation, Slerp

    if timed.times is None:
        raise InputError("RIL-268", f"{timed.name} has no times", remedy="give one pose a frame, or a file with times")
    t, wanted = np.array(timed.times), np.asarray(at, dtype=np.float64)
    inside = (wanted >= t[0] - WITHIN) & (wanted <= t[-1] + WITHIN)
    refuse_apart(t, wanted, timed.name)
    before = np.clip(np.searchsorted(t, wanted, side="right") - 1, 0, max(len(t) - 2, 0))
    after = np.minimum(before + 1, len(t) - 1)
    distance = np.minimum(np.abs(wanted - t[before]), np.abs(wanted - t[after]))
    # At a row itself a gap beside it does not matter.
    known = inside & ((t[after] - t[before] <= max_gap) | (distance <= WITHIN))
    # Changes by WITHIN at most; Slerp refuses any time beyond its ends.
    moment = np.clip(wanted, t[0], t[-1])
    rows = [pose for pose in timed.poses if pose is not None]  # rows of NaN have no times
    positions = np.array([p.translation for p in rows])
    rotations = Rotation.from_matrix([p.rotation for p in rows])
    turned = Slerp(t, rotations)(moment).as_matrix() if len(t) > 1 else [rows[0].rotation] * len(wanted)
    moved = np.stack([np.interp(moment, t, axis) for axis in positions.T], axis=1)
    return tuple(RigidTransform(turned[k], moved[k]) if known[k] else None for k in range(len(wanted)))


def refuse_apart(times: Sequence[float] | Floats, at: Sequence[float] | Floats, name: str) -> None:
    """Refuse a record called ``name`` whose increasing times, s, have none in common with those of the frames."""
    if at[-1] < times[0] - WITHIN or at[0] > times[-1] + WITHIN:
        text = f"{name} reaches from {times[0]:.3f} to {times[-1]:.3f} s, the frames from {at[0]:.3f} to {at[-1]:.3f} s"
        later = float(at[0] - times[0])
        zone = round(later / 1800) * 1800
        offset, of = (zone, "of another time zone") if abs(zone) <= 14 * 3600 else (GPS_EPOCH, "since 1980 (GPS time)")
        # 300 s: records begin that long before the images.
        likely = f"are they {of}? Then time_offset = {offset}; else " if offset and abs(later - offset) < 300 else ""
        remedy = "check that both have the same clock and unit; a manifest states a constant offset as time_offset"
        raise InputError("RIL-269", f"{text}: no common time", remedy=likely + remedy)


def coverage(found: Sequence[object | None], at: Sequence[float], what: str) -> tuple[str, ...]:
    """A warning on the number and times of frames without an entry; empty if all have one.

    Parameters
    ----------
    at : seconds, one per frame.
    what : name of the missing record, e.g. ``truth``.
    """
    without = [k for k, entry in enumerate(found) if entry is None]
    if not without:
        return ()
    runs = 1 + sum(b - a > 1 for a, b in pairwise(without))
    start = at[0]
    spans = f"first at {at[without[0]] - start:.2f} s, last at {at[without[-1]] - start:.2f} s of the sequence"
    stretches = "1 stretch" if runs == 1 else f"{runs} stretches"
    return (warning("RIL-688", f"no {what} for {len(without)} of {len(found)} frames, in {stretches}: {spans}"),)
