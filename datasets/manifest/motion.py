"""Times and motion of a manifest: time stamps, true poses, odometry, attitude and vertical of each pair."""

from __future__ import annotations

import math
import ntpath
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rille.datasets import protocol
from rille.datasets.images.disparities import last_number
from rille.datasets.images.files import SUFFIXES
from rille.datasets.images.pairing import ImagePair
from rille.datasets.imu import at_frames, read_imu, sensed
from rille.datasets.manifest import model
from rille.datasets.manifest.rig import direction
from rille.datasets.poses import (
    TimedPoses,
    TimedPositions,
    coverage,
    interpolate,
    poses_of,
    positions_of,
    read_motion,
    refuse_apart,
    week_of,
)
from rille.datasets.text.columns import columns_of_places, meanings, unread_rotations
from rille.datasets.text.names import ends
from rille.datasets.text.order import stamps_of
from rille.datasets.text.reading import read_lines
from rille.datasets.text.tables import NUMBER, TextTable, split
from rille.datasets.text.times import UNITS, of_two, seconds, undated
from rille.datasets.text.units import unit_of, unitless
from rille.stages.core.errors import IncompleteError, InputError, warning
from rille.stages.geometry.geometry import RigidTransform

Poses = tuple[RigidTransform | None, ...]
Row = TypeVar("Row")

TWO_CELLS = re.compile(r"\d{10} \d{1,9}")
"""Seconds since 1970 and nanoseconds; if the second is the number of a frame, it hardly changes the time."""

TIME = re.compile("time|stamp", re.IGNORECASE)
"""Part of the title of a column of times."""

GPS_TIME = re.compile(r"gps[_ ]?t(ime)?")
"""Names of columns of times that know no leap seconds; there were none since 2017."""

FEWEST_POSITIONS = 3
"""Positions that place a trajectory."""

NEEDS_TIMES = "give [times] with file, names = true or rate_hz"


@dataclass
class MotionReader:
    """Reads the times and motion of one manifest.

    Attributes
    ----------
    root : folder that files are relative to.
    pairs : of images; some may lack a file.
    sequence : with the records read so far; times come first, by which the others are interpolated.
    growing : whether images are still arriving, so that a table may have rows for later ones.
    crs : to which degrees of latitude and longitude are projected; empty: UTM.
    """

    root: Path
    pairs: Sequence[ImagePair]
    sequence: protocol.Sequence
    growing: bool = False
    crs: str = ""

    def read(self, manifest: model.Manifest) -> protocol.Sequence:
        """The sequence with what the tables ``times``, ``truth``, ``odometry``, ``positions``, ``attitude``, ``imu``
        state.

        Raises
        ------
        InputError
            A file cannot be used, does not belong to these pairs, or needs times where the pairs have none.
        """
        if manifest.times is not None:
            self.state(times=self.times(manifest.times))
        if manifest.truth is not None:
            self.truth(manifest.truth)
        if manifest.odometry is not None:
            self.odometry(manifest.odometry)
        if manifest.positions is not None:
            self.measured(manifest.positions)
        if manifest.attitude is not None:
            self.attitude(manifest.attitude)
        if manifest.imu is not None:
            self.imu(manifest.imu)
        sensor = manifest.attitude or manifest.imu
        if sensor is not None and sensor.sigma_deg is not None:
            sigma = {"sigma": math.radians(sensor.sigma_deg)}
            self.state(priors={**self.sequence.priors, "attitude": sigma, "up": sigma})
        return self.sequence

    def state(self, **found: Any) -> None:
        """Set attributes of the sequence."""
        self.sequence = replace(self.sequence, **found)

    def warn(self, lines: tuple[str, ...]) -> None:
        """Add warnings to the sequence."""
        self.state(warnings=(*self.sequence.warnings, *lines))

    def times(self, section: model.Times) -> tuple[float, ...]:
        """Time of each pair, s; for one without a row interpolated between its neighbours.

        Raises
        ------
        InputError
            The times do not parse, are not one for each pair or of other images, do not increase, mix units, or are
            frame numbers in names.
        """
        if section.rate_hz is not None:
            return tuple(k / section.rate_hz for k in range(len(self.pairs)))
        path = self.root / (section.file or "")
        named, stamps = self.stamps_of_names(section.unit) if section.names else self.stamps_of_file(path)
        unit = named if section.unit == "auto" else section.unit
        what = "the image names" if section.names else str(path)
        known = [k for k, stamp in enumerate(stamps) if stamp is not None]
        rows = [stamp for stamp in stamps if stamp is not None]
        times = seconds([t for t, _ in rows], what, unit=unit, lines=[line for _, line in rows])
        usual = float(np.median(np.diff(times))) if times[1:] else 0.0
        # 10 s: no vehicle takes frames so far apart, and whole numbers in milliseconds would be.
        if unit == "auto" and times[0] < 1e8 and usual >= 10.0 and all(map(float.is_integer, times)):
            text = f"times of {what} are {usual:g} s apart, if they are seconds: are they milliseconds or less?"
            self.warn((warning("RIL-718", f"{text} State times.unit"),))
        return tuple(float(t) for t in np.interp(range(len(stamps)), known, times))

    def stamps_of_names(self, unit: str) -> tuple[str, list[tuple[str, int]]]:
        """The ``unit``, and the time stamp in each left image's name (a date, one since 1970, or its last number) with
        the pair's number."""
        stems = [pair.left.stem for pair in self.pairs]
        last = (["", *re.findall(r"\d+(?:\.\d+)?", undated(stem))][-1] for stem in stems)
        stamps = [stamp or number for stamp, number in zip(stamps_of(stems), last, strict=True)]
        wrong = stamps.index("") if "" in stamps else 0
        small = unit == "auto" and len(stamps) > 2 and "" not in stamps and float(stamps[0]) < 1e8
        if "" in stamps or (small and set(np.diff(np.array(stamps, float))) == {1}):
            text = f"times.names: {self.pairs[wrong].left} has no number in its name, or one that counts"
            remedy = 'give times.file or times.rate_hz; or, where the names are seconds, times.unit = "s"'
            raise InputError("RIL-227", text, remedy=remedy)
        return unit, [(stamp, k) for k, stamp in enumerate(stamps, start=1)]

    def stamps_of_file(self, path: Path) -> tuple[str, list[tuple[str, int] | None]]:
        """Unit in the column's name, or ``auto``; time stamp of each pair as text, and its line number."""
        lines = read_lines(path, "times")
        if self.growing and not path.read_bytes().endswith(b"\n"):  # the last line is still being written
            del lines[-1:]
        header, found = tuple[str, ...](), list[tuple[list[str], int]]()
        images, by_name, widest = False, dict[str, int](), tuple[str, ...]()
        for k, line in enumerate(lines, start=1):
            text = undated(line.strip())
            cells = split(text.removeprefix("#"), next((s for s in ",;\t" if s in text), None))
            names = [cell for cell in cells if cell.lower().endswith(SUFFIXES)]
            others = [cell for cell in cells if cell not in names]
            if text.startswith("#") or not others or not re.match(r"[-+.\d]|(nan|inf)$", others[0], re.I):
                header = cells or header
                continue
            titles = dict(zip(header, cells, strict=True)) if len(header) == len(cells) else {}
            stated = [cell for title, cell in titles.items() if TIME.search(title)]
            images, widest = images or bool(names), max(widest, cells, key=len)
            by_name |= {ntpath.splitext(ntpath.basename(cell))[0]: len(found) for cell in names or cells[1:2]}
            times = [cell for cell in stated if NUMBER.match(cell)][:1] or [*others[0].split(), *others[1:]]
            found.append((times, k))
        if all(TWO_CELLS.fullmatch(" ".join(cells)) for cells, _ in found):
            found = [([of_two(*cells)], k) for cells, k in found]
        # Over a single column blanks part no titles: time [ms].
        titles_of = header if len(widest) > 1 else (" ".join(header),)
        units = [unit_of(title) for title in titles_of if TIME.search(title)]
        unit = next((stated for stated in units if stated in UNITS), "auto")
        column = int(_counts([cells for cells, _ in found]))
        rows = [(cells[column], k) for cells, k in found]
        # Tables may list more images than there are pairs, in any order: if all pairs are found, names decide.
        absent = next((p.left.stem for p in self.pairs if not p.absent and p.left.stem not in by_name), "")
        if by_name and not absent:
            return unit, [rows[by_name[p.left.stem]] if p.left.stem in by_name else None for p in self.pairs]
        taken = None if images else self.one_a_pair(rows)
        if taken is None:
            more = f", none of {absent}" if by_name else ""
            which = ends([pair.left for pair in self.pairs])
            problem = f"{path} has {len(rows)} times for {len(self.pairs)} pairs ({which}){more}"
            raise IncompleteError("RIL-229", problem, remedy="give one line a pair, or lines of time and file name")
        return unit, taken

    def one_a_pair(self, rows: Sequence[Row]) -> list[Row | None] | None:
        """One row for each pair; None for pairs that lack a file, if there are rows for whole pairs alone. None: the
        rows are those of other pairs.

        Rows for images that are still to come are left out.
        """
        rows = rows[: len(self.pairs)] if self.growing else rows
        if len(rows) == len(self.pairs):
            return list(rows)
        remaining, whole = iter(rows), sum(not pair.absent for pair in self.pairs)
        return [None if pair.absent else next(remaining) for pair in self.pairs] if len(rows) == whole else None

    def table(self, file: str, format: str = "auto") -> TextTable:
        """The table of a file of poses or positions, with a warning where nobody has stated its projection."""
        read = read_motion(self.root / file, format, self.crs)
        if read.crs and not self.crs:
            self.warn((warning("RIL-774", f"{read.name}: places on Earth are projected to {read.crs}"),))
        return read

    def poses(self, section: model.PoseFile | model.Attitude, table: str, read: TextTable | None = None) -> Poses:
        """T_reference_left of each pair from a file of a body's poses, which may have been ``read`` before."""
        path = self.root / section.file
        rows = read or self.table(section.file, section.format)
        timed = poses_of(rows, section.format, section.unit if isinstance(section, model.PoseFile) else 1.0)
        self.warn(timed.warnings)
        poses: Poses = timed.poses
        if timed.times is not None:
            poses = self.of_numbers(timed, section) or self.of_times(timed, section, table)
        elif timed.images:
            poses = self.of_images(timed)
        elif (one_a_pair := self.one_a_pair(poses)) is not None:
            poses = tuple(one_a_pair)
        else:
            text = f"{table}.file: {path} has {len(poses)} poses for {len(self.pairs)} pairs"
            named = f"; of its columns ({', '.join(rows.header)}) none is called time" if rows.header else ""
            raise IncompleteError("RIL-230", text + named, remedy="give one a pair, or poses with times")
        mount = section.T_body_left
        return poses if mount is None else tuple(pose and pose @ mount for pose in poses)

    def of_times(self, timed: TimedPoses, section: model.PoseFile | model.Attitude, table: str) -> Poses:
        """The pose at the time of each pair; None where the file has none about that time."""
        path, at = self.root / section.file, self.sequence.times
        if at is None:
            raise InputError("RIL-231", f"the poses of {path} have times, but the pairs have none", remedy=NEEDS_TIMES)
        moved = replace(timed, times=tuple(t + section.time_offset for t in timed.times or ()))
        poses = interpolate(moved, at, section.max_gap)
        self.warn(coverage(poses, at, f"{table} ({path.name})"))
        if 2 * sum(pose is not None for pose in poses) < len(poses):
            self.refuse_sparse(section, moved.times or (), table)
        if table == "truth":
            left = np.zeros(3) if section.T_body_left is None else section.T_body_left.translation
            track = tuple(tuple(pose.apply(left).tolist()) for pose in moved.poses if pose)
            self.state(truth_record=protocol.Positions(track, moved.times, section.max_gap))
        return poses

    def of_numbers(self, timed: TimedPoses, section: model.PoseFile | model.Attitude) -> Poses | None:
        """The pose of each pair whose number, in the name of its left image, stands in place of a time in the file.

        None: what stands there are times, or numbers of other images.
        """
        times, at = timed.times or (0.5,), np.array(self.sequence.times or (), dtype=np.float64)
        # Seconds, if half of the pairs are at a row; pairs ten a second are within 0.15 s of one in three of ten cases.
        there = (at >= times[0] - 0.15) & (at <= times[-1] + 0.15) & (np.abs(at - at.round()) <= 0.15)
        if any(t != int(t) for t in times) or section.max_gap >= 1 or 2 * np.count_nonzero(there) >= len(self.pairs):
            return None
        known = dict(zip(map(int, times), timed.poses, strict=True))
        numbers = [last_number(pair.left) for pair in self.pairs]
        poses = tuple(map(known.get, numbers))
        if 2 * sum(pose is not None for pose in poses) < len(poses) or len(set(numbers)) < len(numbers):
            return None
        self.state(notes=(*self.sequence.notes, f"{section.file} has poses by the numbers in the names of the images"))
        return poses

    def of_images(self, timed: TimedPoses) -> Poses:
        """The pose of each left image, by its name in the file; None for images that the file does not name.

        Raises
        ------
        InputError
            The file names none of them, or one twice.
        """
        rows = _rows_of_images(timed.images, self.pairs)
        poses = tuple(None if row is None else timed.poses[row] for row in rows)
        if not any(poses):
            text = f"{timed.name} has poses of {ends([Path(image) for image in timed.images])}, none of a left image"
            left = ends([pair.left for pair in self.pairs])
            raise InputError("RIL-975", f"{text} ({left})", remedy="give the model of these images")
        return poses

    def truth(self, section: model.Truth) -> None:
        """Read true poses of each pair, or true positions with their own times."""
        rows = self.table(section.file, section.format)
        self.doubt_clock(section, rows)
        alone = positions_of(rows, section.format, section.columns, section.unit)
        kind = "positions" if alone else "poses"
        self.state(truth_source=section.source or f"{kind} of {section.file}, as recorded")
        if alone is not None:
            self.state(truth_positions=self.true_positions(section, alone))
            self.warn(() if section.columns else unread_rotations(rows))
            return
        if section.lever_arm is not None:
            text = f"truth.lever_arm: {section.file} holds poses, not positions alone"
            raise InputError("RIL-782", text, remedy="state where the camera is in their body as T_body_left")
        self.state(truth=self.poses(section, "truth", rows), truth_mount=section.T_body_left)
        self.state(truth_sigma_m=section.sigma_m or 0.0, truth_sigma_rad=math.radians(section.sigma_deg or 0.0))

    def odometry(self, section: model.Odometry) -> None:
        """Read dead reckoning, which is a measurement if its accuracy is stated."""
        poses = self.poses(section, "odometry")
        self.state(odometry=poses)
        if section.drift is not None and section.turn_deg is not None:
            stated: dict[str, Any] = {"drift": section.drift, "turn": math.radians(section.turn_deg)}
            stated |= _plane(poses, section.T_body_left or RigidTransform.identity())
            self.state(priors={**self.sequence.priors, "odometry": stated})

    def true_positions(self, section: model.Truth, found: TimedPositions) -> protocol.Positions:
        """True positions, without rotations."""
        if (section.sigma_m or section.sigma_deg) is not None:
            text = f"truth.sigma_m, sigma_deg: {section.file} holds positions, to which no covariance is held"
            raise InputError("RIL-807", text, remedy="remove sigma_m and sigma_deg, or give poses")
        rows, times = self.positions(section, found, "truth")
        self.refuse_sparse(section, times or (), "truth")
        lever = section.lever_arm
        if section.T_body_left is not None and lever is None:  # the body's origin is the antenna
            lever = protocol.vector_of(section.T_body_left.inverse().translation)
        return protocol.Positions(rows, times, section.max_gap, lever)

    def refuse_sparse(self, section: model.PoseFile | model.Attitude, times: Sequence[float], table: str) -> None:
        """Refuse rows that are more than ``max_gap``, s, apart about all pairs, so that nothing can be interpolated."""
        rows = np.array(times)
        after = np.searchsorted(rows, self.sequence.times or ())
        after = after[(after > 0) & (after < len(rows))]
        spacing = float(np.min(rows[after] - rows[after - 1], initial=np.inf)) if len(after) else 0.0
        if spacing > section.max_gap:
            text = f"{table}.max_gap: {section.file} has rows {spacing:.4g} s apart, more than "
            text += f"{section.max_gap:g} s: nothing would be compared"
            remedy = f"raise {table}.max_gap, if straight lines between them are exact enough; name a unit: time_ms"
            raise InputError("RIL-804", text, remedy=remedy)

    def positions(
        self, section: model.Truth | model.PositionFile, found: TimedPositions, table: str
    ) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...] | None]:
        """Positions in metres, and their times (s) by the images' clock, or numbers of pairs; None: one for each pair.

        Rows that begin with names of images are those of the left images of these names.

        Raises
        ------
        InputError
            Both have times, but none in common; or not both have, and there is not one position for each pair.
        """
        self.warn(found.warnings)
        clock, pairs = self.sequence.times, len(self.pairs)
        if found.times is not None and clock is not None:
            times = tuple(t + section.time_offset for t in found.times)
            refuse_apart(times, clock, found.name)
            return found.positions, times
        at = {k: row for k, row in enumerate(_rows_of_images(found.images, self.pairs)) if row is not None}
        named = tuple(found.positions[row] for row in at.values())
        if len(named) == pairs:
            return named, None
        # Measurements may be of numbers of pairs.
        clock = clock or (tuple(map(float, range(pairs))) if table == "positions" else None)
        if named and clock:
            return named, tuple(clock[k] for k in at)
        rows = found.positions[:pairs] if self.growing else found.positions
        of_images = bool(named) or any(name.lower().endswith(SUFFIXES) for name in found.images)
        if len(rows) == pairs and not of_images:
            return rows, None
        there = f"{len(named)} positions by names of left images" if of_images else f"{len(rows)} positions"
        text = f"{table}.file: {section.file} has {there} for {pairs} pairs, and not both have times"
        remedy = "give one a pair, times of both ([times] of the pairs), or names of left images in the first column"
        raise IncompleteError("RIL-803", text, remedy=remedy)

    def doubt_clock(self, section: model.Recorded, table: TextTable) -> None:
        """Warn of times since 1970 that are called GPS time, and of GPS weeks, unless an offset is stated."""
        column = meanings(table).get("time")
        if section.time_offset != 0.0 or column is None:
            return
        named = GPS_TIME.fullmatch(unitless(table.header[column])) and (table.values([column]) > 1e9).all()
        what, other, offset = "its times are called GPS time, which is 18 s ahead of UTC", "UTC", -18
        if weeks := week_of(table, column) is not None:
            what, other, offset = "its GPS weeks are read as UTC, 18 s less", "GPS time", 18
        if weeks or named:
            text = f"{section.file}: {what}: if those of the images are {other}, state time_offset = {offset}"
            self.warn((warning("RIL-785", text),))

    def measured(self, section: model.PositionFile) -> None:
        """Read measured positions, in metres, at times (s) of the images' clock; at numbers of pairs without a clock.

        Raises
        ------
        InputError
            The file holds no positions, or has neither times nor one row for each pair, or no time in common with the
            pairs.
        """
        table = self.table(section.file)
        found = positions_of(table, "auto", section.columns or columns_of_places(table), section.unit, held=True)
        if found is None:
            text = f"positions.file: {section.file} holds poses, or columns without names"
            raise InputError("RIL-453", text, remedy="say which are meant: columns = { time = 1, x = 2, y = 3, z = 4 }")
        self.doubt_clock(section, table)
        places, times = self.positions(section, found, "positions")
        at = self.sequence.times or ()
        there = sum(at[0] <= t <= at[-1] for t in times) if times and at else FEWEST_POSITIONS
        if there < FEWEST_POSITIONS <= min(len(places), len(at)):
            text = f"{section.file}: {there} of its {len(places)} positions are of the time of the frames"
            self.warn((warning("RIL-797", f"{text}: check its clock, and the unit of its times (time_ms)"),))
        sigma = [section.sigma] * 3 if isinstance(section.sigma, float) else list(section.sigma)
        measured = {
            "positions": [list(place) for place in places],
            "times": list(times or self.sequence.times or range(len(places))),
            "sigma": sigma,
            "lever": list(section.lever_arm),
        }
        self.state(priors={**self.sequence.priors, "positions": measured})

    def attitude(self, section: model.Attitude) -> None:
        """Read rotations of a sensor, and the vertical if that is known in the file's reference frame."""
        poses = self.poses(section, "attitude")
        self.state(attitude=tuple(None if pose is None else protocol.rows_of(pose.rotation) for pose in poses))
        if section.up is not None:
            self.state(up=tuple(None if p is None else direction(section.up, p.inverse()) for p in poses))

    def imu(self, section: model.Imu) -> None:
        """Read rotations and vertical by an IMU."""
        at = self.sequence.times
        if at is None:
            text = "[imu] needs times, but the pairs have none"
            raise InputError("RIL-232", text, remedy=NEEDS_TIMES)
        imu = read_imu(self.root / section.file)
        shifted = replace(imu, times=imu.times + section.time_offset)
        self.sequence = sensed(self.sequence, at_frames(shifted, at, section.T_imu_left))


def _rows_of_images(names: Sequence[str], pairs: Sequence[ImagePair]) -> list[int | None]:
    """The row of each pair's left image by its name in a file, with or without folders and ending; None: there is none.

    By the last parts of the path, as many as in the file: COLMAP's names begin at its folder of images.
    """

    def parts(name: str) -> tuple[str, ...]:
        stem = name.rpartition(".")[0] if name.lower().endswith(SUFFIXES) else name
        return tuple(re.split(r"[/\\]", stem.removeprefix("./")))

    known = {parts(name): row for row, name in enumerate(names)}
    paths = [parts(str(pair.left)) for pair in pairs]
    return [next((known[path[k:]] for k in range(len(path)) if path[k:] in known), None) for path in paths]


def _counts(rows: Sequence[Sequence[str]]) -> bool:
    """Whether the first cells number the rows, and the second ones are times."""
    cells = [row[:2] for row in rows if len(row) > 1 and NUMBER.match(row[0]) and NUMBER.match(row[1])]
    if len(cells) < max(2, len(rows)):
        return False
    steps = np.diff(np.array(cells, dtype=float), axis=0)
    counted = float(cells[0][0]) in (0, 1) and (steps[:, 0] == 1).all() and (steps[:, 1] > 0).all()
    return bool(counted and (float(cells[0][1]) > 1e8 or (steps[:, 1] != 1).any()))


def _plane(poses: Poses, T_body_left: RigidTransform) -> dict[str, list[float]]:
    """Of poses of a body that never rolls or pitches, as by wheels: ``up`` of its plane, and the body's ``origin`` [m],
    in the left camera's frame; else empty. Heights beside it, as by a barometer, are along no axis of the body."""
    known = [pose for pose in poses if pose is not None]
    turns = np.array([pose.rotation for pose in known])
    origin = T_body_left.inverse().translation
    heights = [pose.apply(origin)[2] for pose in known]
    if len(known) < 2 or np.ptp(turns[:, 2], axis=0).max() > 1e-6:
        return {}
    # Rotations that never change and heights that do are those of a program that states no rotations.
    if np.ptp(heights) > 1e-6 and np.ptp(turns, axis=0).max() < 1e-6:
        return {}
    return {"up": turns[0, 2].tolist(), "origin": origin.tolist()}
