"""Kind of a table of numbers beside images: times, truth, IMU, attitude ..., by its header and first row."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rille.datasets.images.files import SUFFIXES
from rille.datasets.imu import names_sensors
from rille.datasets.poses import of_images, of_poses, poses_of, positions_of
from rille.datasets.text.columns import QUATERNION, matrix_at, meanings, of_photographs, untimed
from rille.datasets.text.tables import ROWS, read_table
from rille.stages.core.errors import InputError

TABLES = (".txt", ".csv", ".tum", ".dat", ".pos")
ODOMETRY, TRUTH = re.compile("odom|wheel|encoder", re.I), re.compile("truth|(?<![a-z])gt(?![a-z])", re.I)
"""In the names of tables of dead reckoning, and of the truth."""


CAMERA_WORDS = re.compile(
    r"calib|intrinsic|focal|baseline|distortion|fov|camera_?matrix|lensmodel|\bf[xyl]([lr]|_[xy])?\b", re.I
)
"""In the name or the text of a file that seems to describe cameras."""


def table_kind(path: Path, pairs: int) -> str:
    """Kind of a table of numbers, by its header and first row: truth, imu, attitude, times ...; empty: no table.

    Raises
    ------
    InputError
        It is no text, has decimal commas, holds motions, no poses, or is one of true poses or positions, but cannot be
        read.
    """
    # Refuses files that are no text; most others are no tables, which is no error.
    if of_images(path):
        text = f"{path} holds poses by COLMAP, at a scale that it need not know"
        remedy = 'if they are in metres, state them as [truth] with file = "images.txt"'
        raise InputError("RIL-976", text, remedy=remedy)
    named = "times" if "time" in path.stem.lower() else ""
    try:
        table = read_table(path, "table")
    except InputError as error:
        if error.remedy == ROWS:  # records of another form, such as NMEA
            raise
        return named
    table = of_poses(table)
    row = table.values(range(table.columns))[0]
    header = " ".join(table.header)
    if row.size >= 7 and (re.search("gyro|w_rs|ang_vel|angular|accel", header) or names_sensors(table)):
        return "imu"
    if "yaw" in header and "roll" in header and not (table.crs or of_photographs(table)):
        return "attitude"
    meant, poses = meanings(table), "truth"
    # Of a robot on a plane, or by their name: dead reckoning is no truth.
    if (ODOMETRY.search(path.stem) and not TRUTH.search(path.stem)) or "yaw" in meant:
        # It begins near 0, in a frame of its own.
        places = [row[meant[axis]] for axis in ("x", "y") if axis in meant]
        geodetic = table.crs or of_photographs(table) or np.abs(places).max(initial=0.0) > 1e4
        poses = "positions" if geodetic else "odometry"
        if len(places) == 2:
            return poses
    if untimed(table) and len(table.rows) == pairs:
        return poses
    if matrix_at(table) is not None or (meant.keys() >= {"x", "y", *QUATERNION} and not table.crs):
        # Of cameras or sensors, as "image_00: ...", or a single one, it says where they are mounted.
        mounts = table.rows[0][0].endswith(":") or (len(table.rows) == 1 < pairs and "time" not in meant)
        return poses if not mounts and poses_of(table).poses else ""  # which may refuse it
    # Of degrees that are no decimal ones the error says how to write them.
    placed = meant.keys() >= {"x", "y"} or meant.keys() >= {"lat", "lon"}
    positions = positions_of(table, "csv", {}) if placed else None
    # Without times or names of images there must be one for each pair.
    if positions is not None and (positions.times or positions.images or len(positions.positions) == pairs):
        return "positions"
    images = any(cell.lower().endswith(SUFFIXES) for cell in table.rows[0])
    if images and "time" in meant and len(table.rows) == pairs:
        return "times"
    if (
        row.size >= 8
        and row.size not in (12, 16)
        and abs(np.linalg.norm(row[4:8]) - 1) < 1e-3
        and poses_of(table).poses
    ):
        return poses
    # Beside times of exposure or numbers of frames, as in times.txt of DSO.
    rising = row.size == 1 and len(table.rows) == pairs and bool((np.diff(table.values([0]), axis=0) > 0).all())
    if (rising and not CAMERA_WORDS.search(path.stem)) or (row.size <= 3 and named):
        return "times"
    # Names of images, dates and the like are no numbers.
    return named if np.isinf(row).any() else ""
