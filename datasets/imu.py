"""Inertial sensors: rotation between frames from the gyroscope, the vertical from the accelerometer.

Rates are integrated exactly for a rate that is constant between two samples (their mean): R <- R exp(w dt), Savage
(1998), doi:10.2514/2.4228, without the coning terms, which matter to inertial navigation and not to frames of a tenth
of a second. The gyroscope's bias is its reading at rest. An accelerometer measures specific force, at rest the reaction
to gravity: it points **up**. Single samples of a sensor on a running engine are useless (1 m/s^2 of vibration), so the
force is averaged over two seconds around each frame, turned by the gyroscope to the attitude at the frame, and used
only if it is steady, as large as gravity, and the sensor hardly turns.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rille.datasets import protocol
from rille.datasets.poses import coverage, refuse_apart, times_of
from rille.datasets.protocol import Rows, Vector, rows_of, vector_of
from rille.datasets.text.columns import meanings
from rille.datasets.text.tables import TextTable, read_table
from rille.datasets.text.units import FORCES, RATES, unitless
from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.errors import InputError, warning
from rille.stages.geometry.geometry import RigidTransform, orthonormal, rotation_exp

Up = Vector | None

STEADY_RATE = 0.02
"""rad/s, greatest standard deviation of means of the rate over 0.1 s at rest; idle rotors cause 0.007."""

BIN = 0.1
"""s; means over this time are free of vibration."""

HALF_WINDOW = 1.0
"""s; the force is averaged over this time before and after a frame, at an end of the record on one side. In a drone's
flight one frame in twenty passes, with errors of 0.6 degrees in the median and at most 2; half the window triples that.
"""

GRAVITY, MAX_OFF_GRAVITY = 9.81, 0.2
"""m/s^2: 9.78 to 9.83 on the ground; accelerometers of drones are biased by up to 0.1."""

GYROSCOPE = re.compile(r"(.*[./])?(gyr|g_?[xyz]\b|w_|w[xyz]|ang(?!.*cov)|omega|rate)")
ACCELEROMETER = re.compile(r"(.*[./])?(acc|alpha_|a_|a[xyz]|lin(?!.*cov)|force)")
"""Beginnings of column names, after the path of a field of a ROS message."""

ORDER = ([1, 2, 3], [4, 5, 6])
"""Columns of rates and forces without names; times come first."""


@dataclass(frozen=True)
class ImuRecord:
    """A record: times (n,), s; rates (n, 3), rad/s, and specific forces (n, 3), m/s^2, along the sensor's axes."""

    times: Floats
    rates: Floats
    forces: Floats
    name: str = "imu"
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inertial:
    """Attitude and rotation of each frame by an IMU; empty without an IMU.

    Attributes
    ----------
    attitude : R_reference_left row by row, the reference being the sensor's frame at its first sample in use; None
        outside of the record, or if a gap separates it from the longest unbroken part.
    up : unit vector of up in the left camera's frame; None where the force is not the reaction to gravity.
    axes : R_imu_left, which turned rates and forces to the camera's frame.
    warnings : on missing or suspicious data, one line each.
    notes : assumptions.
    """

    attitude: tuple[Rows | None, ...] = ()
    up: tuple[Up, ...] = ()
    axes: Rows | None = None
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


# -- reading -----------------------------------------------------------------------------------------------------------


def read_imu(path: Path) -> ImuRecord:
    """Table of time, rates about x y z and specific forces along them.

    Columns are recognised by their names (``w_RS_S_x [rad s^-1]``, ``gyro_x``, ``acc_x`` ...); without names they must
    be in this order. Values are converted by the units in the columns' names.

    Raises
    ------
    InputError
        Columns are missing, exchanged, or in multiples of gravity; a row or a time cannot be used; a value is beyond
        what such a sensor can measure.
    """
    table = read_table(path, "IMU record")
    if table.columns < 7:
        text = f"{path}, line {table.lines[0]}: {table.columns} columns are no IMU record"
        raise InputError("RIL-186", text, remedy="give time, three rates (rad/s) and three accelerations (m/s^2) a row")
    gyro, accelerometer = _columns(table)
    time = meanings(table).get("time", 0)
    table, warnings = table.measured([time, *gyro, *accelerometer])
    times = times_of(table, time)
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    # 2 s: no IMU is as slow; stamps in milliseconds are taken for seconds where nothing names their unit.
    if spacing > 2.0:
        text = f"{path}: its samples are {spacing:.4g} s apart, if its times are seconds"
        raise InputError("RIL-798", text, remedy="name the column by its unit, as time_ms or time_us")
    rates, forces = table.measures(gyro, RATES), table.measures(accelerometer, FORCES)
    # 200 rad/s: the fastest gyroscopes reach 70 (4000 degrees a second); larger numbers are damage.
    _possible(rates, 200.0, "rad/s", table)
    # 5000 m/s^2: accelerometers for shocks reach 500 times gravity.
    _possible(forces, 5000.0, "m/s^2", table)
    _plausible(rates, forces, table.name)
    return ImuRecord(np.array(times), rates, forces, table.name, warnings)


def _columns(table: TextTable) -> tuple[list[int], list[int]]:
    """Columns of the rates and of the forces, x y z each."""
    found = [_named(table, GYROSCOPE), _named(table, ACCELEROMETER)]
    named = [(columns, place) for columns, place in zip(found, ORDER, strict=True) if columns]
    # With names of one sensor alone, the other has the usual columns only if this one has.
    if len(named) == 1 and named[0][0] != named[0][1]:
        text = f"{table.name}: of its columns {', '.join(table.header)} only those of one sensor are recognised"
        remedy = "order the columns time, rates, accelerations, or name them gyro_x ... acc_x ..."
        raise InputError("RIL-191", text, remedy=remedy)
    gyro, accelerometer = (columns or place for columns, place in zip(found, ORDER, strict=True))
    return gyro, accelerometer


def names_sensors(table: TextTable) -> bool:
    """Whether columns are named as the rates and the forces of an IMU."""
    return all(_named(table, sensor) for sensor in (GYROSCOPE, ACCELEROMETER))


def _named(table: TextTable, starts: re.Pattern[str]) -> list[int]:
    """The three columns whose names begin so, in the order of axes that their ends tell; empty if there are not 3."""
    found = {k: unitless(name)[-1:] for k, name in enumerate(table.header) if starts.match(name)}
    columns = sorted(found, key=found.__getitem__) if sorted(found.values()) == list("xyz") else list(found)
    return columns if len(columns) == 3 else []


def _possible(values: Floats, greatest: float, unit: str, table: TextTable) -> None:
    wrong = np.argwhere(np.abs(values) > greatest)
    if wrong.size:
        row, axis = wrong[0]
        text = f"{table.name}, line {table.lines[row]}: {values[row, axis]:.3g} {unit} is beyond any sensor"
        remedy = "correct or remove that line; give rates in rad/s and accelerations in m/s^2, or name the unit deg"
        raise InputError("RIL-854", f"{text} ({greatest:g} {unit})", remedy=remedy)


def _plausible(rates: Floats, forces: Floats, name: str) -> None:
    turn, force = (float(np.median(np.linalg.norm(v, axis=1))) for v in (rates, forces))
    # A force of gravity (9.8) among the rates, and rates of a vehicle where the force should be.
    if turn > 8 and force < 6:
        text = f"{name}: the rates are {turn:.3g} and the accelerations {force:.3g}: they look exchanged"
        remedy = "order the columns time, rates, accelerations, or name them gyro_x ... acc_x ..."
        raise InputError("RIL-187", text, remedy=remedy)
    # Else in multiples of gravity, or without it: the Moon's is more, and no vehicle has five times the Earth's.
    if not 1.2 <= force <= 50.0:
        wrong = "small" if force < 1.2 else "large"
        text = f"{name}: accelerations of {force:.3g} are too {wrong} to be gravity in m/s^2"
        remedy = "give them in m/s^2, gravity not taken off (9.81 at rest), or name their unit, as acc_x [mg]"
        raise InputError("RIL-188", text, remedy=remedy)


# -- frames ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stretch:
    """Samples without a gap, without bias; ``turned`` (n, 3, 3) is R_reference_imu, identity at the first sample."""

    times: Floats
    rates: Floats
    forces: Floats
    turned: Floats
    slack: float

    def holds(self, moment: float) -> bool:
        """Whether a moment lies within, or beyond an end by at most the usual spacing."""
        return bool(self.times[0] - self.slack <= moment <= self.times[-1] + self.slack)

    def attitude(self, moment: float) -> Floats:
        """R_reference_imu at a moment, by the mean rate of the samples around it."""
        k = int(np.clip(np.searchsorted(self.times, moment, side="right") - 1, 0, len(self.times) - 2))
        rate = 0.5 * (self.rates[k] + self.rates[k + 1])
        return np.asarray(self.turned[k] @ rotation_exp(rate * (moment - self.times[k])), dtype=np.float64)

    def up(self, moment: float) -> Floats | None:
        """Up in the sensor's frame at a moment, not normalised; None where the force is not gravity's reaction."""
        first, last = np.searchsorted(self.times, (moment - HALF_WINDOW, moment + HALF_WINDOW))
        chosen = slice(int(first), int(last))
        # At an end of the record one side of the window is enough, as long as it is whole.
        if last - first < 2 or self.times[last - 1] - self.times[first] < HALF_WINDOW - self.slack:
            return None
        turns = self.attitude(moment).T @ self.turned[chosen]
        force = np.einsum("nij,nj->ni", turns, self.forces[chosen])
        mean = force.mean(axis=0)
        spread = bins(force, self.times[chosen]).std(axis=0)
        return mean if bool(unaccelerated(mean, spread, self.rates[chosen].mean(axis=0))) else None


def unaccelerated(force: Floats, spread: Floats, rate: Floats) -> Bools:
    """Whether mean ``force`` (..., 3), m/s^2, is the reaction to gravity alone.

    ``spread`` (..., 3): standard deviation of its means over 0.1 s; ``rate`` (..., 3): mean rate, rad/s.
    """
    level = np.abs(np.linalg.norm(force, axis=-1) - GRAVITY) <= MAX_OFF_GRAVITY
    # The force of an accelerated body varies; that of a turning sensor has a centrifugal part; at rest cheap sensors
    # have a rate of 0.08.
    return np.asarray(level & (spread.max(axis=-1) <= 0.2) & (np.linalg.norm(rate, axis=-1) <= 0.15))


def at_frames(imu: ImuRecord, at: Sequence[float], T_imu_left: RigidTransform) -> Inertial:
    """Attitude and vertical of the left camera at the moments of the frames.

    Parameters
    ----------
    at : seconds, increasing, of the sensor's clock.
    T_imu_left : pose of the left camera in the sensor's frame; its rotation alone matters.

    Raises
    ------
    InputError
        The record and the frames have no time in common, or the record has less than two samples.
    """
    if len(imu.times) < 2:
        raise InputError("RIL-189", f"{imu.name} has one sample", remedy="give the whole record")
    refuse_apart(imu.times, at, imu.name)
    bias, notes = resting_bias(imu, at[0], at[-1])
    parts = stretches(imu, bias, at[0] - HALF_WINDOW, at[-1] + HALF_WINDOW)
    part = [next((p for p, s in enumerate(parts) if s.holds(moment)), None) for moment in at]
    # Rotations across a gap are unknown: the reference is that of the part with most frames.
    longest = max(range(len(parts)), key=lambda p: (part.count(p), -p), default=None)
    R_imu_left = T_imu_left.rotation
    attitude: list[Rows | None] = []
    up: list[Up] = []
    for p, moment in zip(part, at, strict=True):
        R_reference_imu = parts[p].attitude(moment) if p is not None and p == longest else None
        force = parts[p].up(moment) if p is not None else None
        attitude.append(None if R_reference_imu is None else rows_of(orthonormal(R_reference_imu @ R_imu_left)))
        seen = None if force is None else R_imu_left.T @ force
        up.append(None if seen is None else vector_of(seen / np.linalg.norm(seen)))
    warnings = (*imu.warnings, *coverage(attitude, at, f"attitude from {imu.name}"))
    usual = float(np.median(np.linalg.norm(imu.forces, axis=1)))
    if not any(up) and abs(usual - GRAVITY) > MAX_OFF_GRAVITY:
        text = f"{imu.name} gives no vertical: its accelerations are {usual:.2f} m/s^2 (median), gravity's {GRAVITY}"
        warnings += (warning("RIL-850", f"{text}: calibrate their scale and bias, or state world.up"),)
    return Inertial(tuple(attitude), tuple(up), rows_of(R_imu_left), warnings, notes)


def sensed(sequence: protocol.Sequence, inertial: Inertial) -> protocol.Sequence:
    """The sequence with the attitude and the vertical of an IMU, as far as they are known."""
    return replace(
        sequence,
        attitude=inertial.attitude if any(inertial.attitude) else sequence.attitude,
        up=inertial.up if any(inertial.up) else sequence.up,
        imu_axes=inertial.axes,
        notes=(*sequence.notes, *inertial.notes),
        warnings=(*sequence.warnings, *inertial.warnings),
    )


def stretches(imu: ImuRecord, bias: Floats | None, start: float, end: float) -> list[Stretch]:
    """The parts of a record from ``start`` to ``end`` (s) without gaps, each of at least two samples."""
    # 2.5 median spacings: one missing sample (2) is common, more is not.
    slack = 2.5 * float(np.median(np.diff(imu.times)))
    # 0.1 s: longest gap in the samples over which the rate is interpolated, unless the usual spacing is longer.
    bridge = max(0.1, slack)
    near = np.flatnonzero((imu.times >= start - bridge) & (imu.times <= end + bridge))
    out = []
    for part in np.split(near, np.flatnonzero(np.diff(imu.times[near]) > bridge) + 1):
        if part.size >= 2:
            times, rates = imu.times[part], imu.rates[part] - (0.0 if bias is None else bias)
            out.append(Stretch(times, rates, imu.forces[part], integrate(times, rates), slack))
    return out


def integrate(times: Floats, rates: Floats) -> Floats:
    """R_first_now (n, 3, 3) of the sensor at each sample, from rates (n, 3), rad/s, in its own axes."""
    from scipy.spatial.transform import Rotation

    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]
    out = np.empty((len(times), 3, 3))
    out[0] = np.eye(3)
    for k, step in enumerate(Rotation.from_rotvec(steps).as_matrix()):
        out[k + 1] = out[k] @ step
    return out


def resting_bias(imu: ImuRecord, start: float, end: float) -> tuple[Floats | None, tuple[str, ...]]:
    """Gyroscope bias (3,), rad/s, by its readings at rest, and a note on these; None without rest.

    Rest is a second in which means over 0.1 s of rate and force are steady, the force is as large as gravity and the
    rate no larger than a bias can be. A steady slow turn about the vertical looks the same; if resting seconds
    disagree, those that agree with the quietest one count. A bias drifts (0.1 degrees a second in two minutes), so the
    five seconds at rest nearest to the frames (from ``start`` to ``end``) count.
    """
    rate, force = bins(imu.rates, imu.times), bins(imu.forces, imu.times)
    # 1 s: shortest rest.
    count = round(1.0 / BIN)
    if len(rate) < count:
        return None, (NO_BIAS,)
    rates, forces = (np.lib.stride_tricks.sliding_window_view(v, count, axis=0) for v in (rate, force))
    shaken = rates.std(axis=-1).max(axis=-1)
    mean = rates.mean(axis=-1)
    rest = (shaken <= STEADY_RATE) & unaccelerated(forces.mean(axis=-1), forces.std(axis=-1), mean)
    if not rest.any():
        return None, (NO_BIAS,)
    quietest = int(np.flatnonzero(rest)[np.argmin(shaken[rest])])
    rest &= np.linalg.norm(mean - mean[quietest], axis=-1) <= STEADY_RATE
    covered = np.convolve(rest, np.ones(count)) > 0  # bins of a second of rest
    times = bins(imu.times[:, None], imu.times)[covered, 0]
    away = np.maximum(start - times, 0) + np.maximum(times - end, 0)
    # 5 s: more makes the bias older, not better.
    nearest = np.argsort(away, kind="stable")[: round(5.0 / BIN)]
    bias = np.median(rate[covered][nearest], axis=0)  # the ends of a rest may have some motion
    words = ", ".join(f"{v:.4f}" for v in bias)
    return bias, (f"gyroscope bias ({words}) rad/s from {len(nearest) * BIN:.1f} s of rest",)


NO_BIAS = "the gyroscope's bias is not known (no second of rest in its record): rotations drift with it"


def bins(values: Floats, times: Floats) -> Floats:
    """Means (m, 3) of successive samples over 0.1 s; without the remainder, unless there is nothing else."""
    size = max(1, round(BIN / float(np.median(np.diff(times)))))
    count = max(1, len(values) // size)
    return np.asarray(values[: count * size].reshape(count, -1, values.shape[1]).mean(axis=1), dtype=np.float64)
