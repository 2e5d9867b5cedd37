"""What a manifest knows of time and movement: time stamps, true poses, odometry, attitude and vertical of each pair."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rille.datasets.images.pairing import ImagePair, ends, stamp_of
from rille.datasets.imu import at_frames, read_imu
from rille.datasets.manifest.model import Attitude, Imu, Manifest, PoseFile, Times, Truth
from rille.datasets.manifest.rig import direction
from rille.datasets.poses import coverage, interpolate, read_poses, read_positions
from rille.datasets.protocol import Positions, Rows, rows_of
from rille.datasets.text.reading import read_lines
from rille.datasets.text.times import seconds
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import RigidTransform

Poses = tuple[RigidTransform | None, ...]
Ups = tuple[tuple[float, float, float] | None, ...]
Seconds = tuple[float, ...]

NEEDS_TIMES = "give [times] with file, names = true or rate_hz"


@dataclass
class KnownMotion:
    """One entry a pair, as in :class:`rille.datasets.protocol.Sequence`; ``warnings`` collects what is suspicious."""

    times: Seconds | None
    truth: Poses | None = None
    truth_positions: Positions | None = None
    truth_source: str = ""
    truth_mount: RigidTransform | None = None
    odometry: Poses | None = None
    attitude: tuple[Rows | None, ...] | None = None
    imu_axes: Rows | None = None
    up: Ups | None = None
    warnings: tuple[str, ...] = ()


def read_motion(
    manifest: Manifest, root: Path, name: str, pairs: Sequence[ImagePair], times: Seconds | None
) -> KnownMotion:
    """Everything that the manifest's tables ``times``, ``truth``, ``odometry``, ``attitude`` and ``imu`` state.

    Parameters
    ----------
    times : of the pairs, s, where the manifest states none.

    Raises
    ------
    InputError
        A file cannot be used, does not belong to these pairs, or needs times where the pairs have none.
    """
    motion = KnownMotion(times)
    if manifest.times is not None:
        motion.times, motion.warnings = pair_times(manifest.times, root, name, pairs)
    if manifest.truth is not None:
        _truth(manifest.truth, root, name, motion, len(pairs))
    if manifest.odometry is not None:
        motion.odometry = _poses(manifest.odometry, "odometry", root, name, motion, len(pairs))
    if manifest.attitude is not None and manifest.imu is not None:
        raise InputError(
            "RIL-226", f"{name}: [attitude] and [imu] both state the rotation", remedy="remove one of them"
        )
    if manifest.attitude is not None:
        _attitude(manifest.attitude, root, name, motion, len(pairs))
    if manifest.imu is not None:
        _imu(manifest.imu, root, name, motion)
    return motion


# -- times -------------------------------------------------------------------------------------------------------------


def pair_times(section: Times, root: Path, name: str, pairs: Sequence[ImagePair]) -> tuple[Seconds, tuple[str, ...]]:
    """Time of each pair, s, and warning lines.

    Raises
    ------
    InputError
        The times do not parse, are not one a pair, do not increase, or mix units.
    """
    if section.rate_hz is not None:
        return tuple(k / section.rate_hz for k in range(len(pairs))), ()
    if section.names:
        return seconds([_stamp(pair, name) for pair in pairs], "the image names", unit=section.unit)
    assert section.file is not None
    path = root / section.file
    stamps, lines = _times_of_file(path, [pair.left.name for pair in pairs])
    return seconds(stamps, str(path), unit=section.unit, lines=lines)


def _stamp(pair: ImagePair, name: str) -> str:
    """The time stamp in an image's name: one since 1970, or its last number, with its decimals."""
    found = [stamp_of(pair.left.stem)] if stamp_of(pair.left.stem) else re.findall(r"\d+(?:\.\d+)?", pair.left.stem)
    if not found:
        raise InputError("RIL-227", f"{name}: times.names: {pair.left} has no number in its name", remedy=NEEDS_TIMES)
    return str(found[-1])


def _times_of_file(path: Path, names: Sequence[str]) -> tuple[list[str], list[int]]:
    """Time stamps as text, in the order of the pairs, and the lines that they stand in."""
    text = read_lines(path, "times")
    rows = [(k, re.split(r"[,;\s]+", line.strip().strip(","))) for k, line in enumerate(text, start=1)]
    rows = [(k, words) for k, words in rows if words[0] and words[0][0] in "0123456789.+-"]
    # Tables may list more images than there are pairs, in any order: names decide where all are found.
    by_name = {Path(words[1]).stem: (words[0], k) for k, words in rows if len(words) > 1}
    stems = [Path(n).stem for n in names]
    if by_name and all(stem in by_name for stem in stems):
        return [by_name[stem][0] for stem in stems], [by_name[stem][1] for stem in stems]
    if len(rows) != len(names):
        absent = next((n for n, stem in zip(names, stems, strict=True) if stem not in by_name), "")
        raise InputError(
            "RIL-229",
            f"{path} has {len(rows)} times for {len(names)} pairs ({ends(names)})"
            + (f", none of {absent}" if by_name else ""),
            remedy="give one line a pair, or lines of time and file name",
        )
    return [words[0] for _, words in rows], [k for k, _ in rows]


# -- poses -------------------------------------------------------------------------------------------------------------


def _poses(
    section: PoseFile | Attitude, table: str, root: Path, name: str, motion: KnownMotion, count: int
) -> tuple[RigidTransform | None, ...]:
    """T_reference_left of each pair from a file of poses of a body; warnings go to ``motion``."""
    path = root / section.file
    timed = read_poses(path, section.format)
    motion.warnings += timed.warnings
    if isinstance(section, PoseFile):
        in_metres = (RigidTransform(pose.rotation, section.unit * pose.translation) for pose in timed.poses)
        timed = replace(timed, poses=tuple(in_metres))
    poses: Poses = timed.poses
    if timed.times is None:
        if len(timed.poses) != count:
            raise InputError(
                "RIL-230",
                f"{name}: {table}.file: {path} has {len(timed.poses)} poses for {count} pairs",
                remedy="give one a pair, or poses with times",
            )
    else:
        if motion.times is None:
            raise InputError(
                "RIL-231", f"{name}: the poses of {path} have times, but the pairs have none", remedy=NEEDS_TIMES
            )
        moved = replace(timed, times=tuple(t + section.time_offset for t in timed.times))
        poses = interpolate(moved, motion.times, section.max_gap)
        motion.warnings += coverage(poses, motion.times, f"{table} ({path.name})")
    if section.T_body_left is None:
        return poses
    T_body_left = RigidTransform.from_matrix(section.T_body_left)
    return tuple(None if pose is None else pose @ T_body_left for pose in poses)


def _truth(section: Truth, root: Path, name: str, motion: KnownMotion, count: int) -> None:
    """Poses of each pair, or positions alone with their own times."""
    alone = read_positions(root / section.file, section.format, {str(k): v for k, v in section.columns.items()})
    motion.truth_source = section.source or f"{'positions' if alone else 'poses'} of {section.file}, as recorded"
    if alone is None:
        if section.lever_arm is not None:
            raise InputError(
                "RIL-782",
                f"{name}: truth.lever_arm: {section.file} holds poses, not positions alone",
                remedy="state where the camera is in their body as T_body_left",
            )
        motion.truth = _poses(section, "truth", root, name, motion, count)
        motion.truth_mount = None if section.T_body_left is None else RigidTransform.from_matrix(section.T_body_left)
        return
    if section.T_body_left is not None:
        raise InputError(
            "RIL-802",
            f"{name}: truth.T_body_left: the positions of {alone.name} have no rotations by which to move them",
            remedy="remove T_body_left, or give poses",
        )
    times = None if alone.times is None else tuple(t + section.time_offset for t in alone.times)
    if motion.times is None or times is None:
        if len(alone.positions) != count:
            raise InputError(
                "RIL-803",
                f"{name}: truth.file: {alone.name} has {len(alone.positions)} positions for {count} pairs, and "
                f"{'the pairs have' if motion.times is None else 'it has'} no times to match them by",
                remedy="give one a pair, or times of both ([times] of the pairs)",
            )
        times = None
    elif len(times) > 1 and float(np.median(np.diff(times))) > section.max_gap:
        raise InputError(
            "RIL-804",
            f"{name}: truth.max_gap = {section.max_gap:g} s, but the positions of {alone.name} are "
            f"{float(np.median(np.diff(times))):.4g} s apart: nothing would be compared",
            remedy="raise truth.max_gap, if straight lines between them are exact enough",
        )
    positions = tuple(tuple(section.unit * v for v in row) for row in alone.positions)
    motion.truth_positions = Positions(positions, times, section.max_gap, section.lever_arm)
    motion.warnings += alone.warnings


def _attitude(section: Attitude, root: Path, name: str, motion: KnownMotion, count: int) -> None:
    poses = _poses(section, "attitude", root, name, motion, count)
    motion.attitude = tuple(None if pose is None else rows_of(pose.rotation) for pose in poses)
    if section.up is not None:
        what = f"{name}: attitude.up"
        motion.up = tuple(None if p is None else direction(section.up, p.inverse(), what) for p in poses)


def _imu(section: Imu, root: Path, name: str, motion: KnownMotion) -> None:
    if motion.times is None:
        raise InputError("RIL-232", f"{name}: [imu] needs times, but the pairs have none", remedy=NEEDS_TIMES)
    imu = read_imu(root / section.file)
    shifted = replace(imu, times=imu.times + section.time_offset)
    inertial = at_frames(shifted, motion.times, RigidTransform.from_matrix(section.T_imu_left))
    motion.attitude, motion.imu_axes = inertial.attitude, inertial.axes
    motion.up = inertial.up if any(up is not None for up in inertial.up) else None
    motion.warnings += (*imu.warnings, *inertial.warnings)
