"""A vehicle placed on the ground at every position and heading: tilt, slope of the footprint, rise under the belly.

Positions lie on a coarse grid, at every seventh of a wheel; heights are first reduced to the highest and the lowest of
each of its blocks, so that none is left out. A wheel *stands* on the highest ground in its contact patch, half a wheel
wide; *ground* is the lowest there. At each position the vehicle takes ``HEADINGS`` headings. Three of four wheels touch
the ground: two of them span the wheel base and two the track, so the plane through them has the gradient (difference
along a side / wheel base, difference along an axle / track). The greatest over triples of wheels and headings is

* tilt, from where the wheels stand (stones count), and
* slope of the footprint's plane, from the ground beneath (stones narrower than a wheel do not).

Rise under the belly is the height of the ground there over the plane of the wheels: for a point p between the axles
with bilinear weights w of the four wheels, ``sum_i w_i max(0, z(p) - stand_i)``. It is the height of p over that plane
if no wheel stands higher than p, else more: a wheel that stands high lifts the belly, but that is not relied on, as in
the bounds of Otsu et al. (2020), doi:10.1002/rob.21917 (ACE). On a plane of gradient g it is at most g wheel_base / 4
along, and g track / 4 across.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.kernel import kernel
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import running_max

Ints = NDArray[np.int64]

HEADINGS = 8
"""Headings over half a turn, since the footprint is symmetric; 22.5 degrees move a wheel by less than its diameter."""


class Places(NamedTuple):
    """Results (row, col) on the coarse grid, float32: gradients ``tilt`` and ``slope`` (1), ``rise`` (m).

    ``unstood``: share of wheels and parts of the belly, over headings, with unknown ground below, which is not in the
    others.
    """

    tilt: Floats32
    slope: Floats32
    rise: Floats32
    unstood: Floats32


class Stance(NamedTuple):
    """Offsets (row, col) in coarse cells: wheels (heading, 4, 2), belly (heading, point, 2), and sizes in coarse cells.

    Wheels: front left, front right, rear left, rear right. ``spans`` (heading, 4) metres: left side, right side, front
    axle, rear axle. ``weights`` (point, 4) of the wheels at the belly's points.
    """

    wheels: Ints
    belly: Ints
    spans: Floats32
    weights: Floats32
    wheel_reach: int
    belly_reach: int

    @staticmethod
    def of(vehicle: Vehicle, cell: float) -> Stance:
        """Offsets for a vehicle on a grid with cells of ``cell`` metres."""
        # Order of the wheels in all arrays: front left, front right, rear left, rear right.
        half = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [-1.0, 1.0]]) / 2.0  # ahead, right
        wheels = half * [vehicle.wheel_base, vehicle.track]
        width = max(vehicle.track - vehicle.wheel_width, vehicle.wheel_width)
        parts = _parts(vehicle.wheel_base, width), _parts(width, vehicle.wheel_base)
        ahead, right = ((np.arange(n) + 0.5) / n - 0.5 for n in parts)
        share = np.stack(np.meshgrid(ahead, right, indexing="ij"), axis=-1).reshape(-1, 2)
        points = share * [vehicle.wheel_base, width]
        along, across = share[:, :1], points[:, 1:] / vehicle.track
        weights = (0.5 + 2.0 * along * half[:, 0]) * (0.5 + 2.0 * across * half[:, 1])
        turns = [_rotation(k * math.pi / HEADINGS) for k in range(HEADINGS)]
        at = np.stack([np.rint(wheels @ turn / cell) for turn in turns])
        under = np.stack([np.rint(points @ turn / cell) for turn in turns])
        pairs = ((0, 2), (1, 3), (0, 1), (2, 3))
        # By the wheels' rounded positions, not the vehicle's sides, so that a plane of gradient g has g at any heading.
        spans = np.stack([np.hypot(*(at[:, a] - at[:, b]).T) for a, b in pairs], axis=1) * cell
        part = max(vehicle.wheel_base / parts[0], width / parts[1])
        return Stance(
            at.astype(np.int64),
            under.astype(np.int64),
            # Wheels on one coarse cell would have a span of 0.
            np.maximum(spans, cell).astype(np.float32),
            weights.astype(np.float32),
            max(1, round(0.25 * vehicle.wheel_diameter / cell)),
            max(1, round(0.5 * part / cell)),
        )


def _parts(length: float, other: float) -> int:
    """Number of parts of a side, for about square parts; the shorter side has two."""
    return max(2, round(2.0 * length / min(length, other)))


def _rotation(angle: float) -> Floats:
    """(ahead, right) to (row, col) of a raster whose rows fall ahead, turned clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[-c, s], [s, c]])


def stride(vehicle: Vehicle, cell: float) -> int:
    """Cells from position to position."""
    # At least seven positions along a wheel's diameter.
    return max(1, int(vehicle.wheel_diameter / (7 * cell) + 1e-6))


def place(high: Floats32, low: Floats32, vehicle: Vehicle, cell: float, whole: Bools) -> Places:
    """Place the vehicle everywhere.

    Parameters
    ----------
    high, low : (row, col) float32, metres, highest and lowest ground in each coarse cell, NaN unknown.
    cell : side of a coarse cell, metres.
    whole : (row, col) coarse cells that are wholly known.
    """
    stance = Stance.of(vehicle, cell)
    reach = int(max(np.abs(stance.wheels).max(), np.abs(stance.belly).max()))
    out = Places(*(np.zeros(high.shape, dtype=np.float32) for _ in Places._fields))
    # Outside of the map all is unknown; wheels at its border may still touch ground of the map.
    high, low = (np.pad(a, reach, constant_values=np.nan) for a in (high, low))
    unknown = np.pad((~whole).astype(np.float32), reach, constant_values=1.0)
    stand, belly = (running_max(high, n) for n in (stance.wheel_reach, stance.belly_reach))
    maps = [
        np.where(np.isfinite(a), a, np.float32(np.nan)) for a in (stand, -running_max(-low, stance.wheel_reach), belly)
    ]
    maps += [(running_max(unknown, n) > 0).astype(np.uint16) for n in (stance.wheel_reach, stance.belly_reach)]
    _place(_Ground(*maps), stance._replace(wheels=stance.wheels + reach, belly=stance.belly + reach), out)
    return Places(np.sqrt(out.tilt), np.sqrt(out.slope), out.rise, out.unstood)


class _Ground(NamedTuple):
    """Padded maps (row, col): highest and lowest ground below a wheel, highest below a part of the belly (m), and
    whether any ground below a wheel, or below a part of the belly, is unknown."""

    stand: Floats32
    lowest: Floats32
    belly: Floats32
    gaps: NDArray[np.uint16]
    gaps_below: NDArray[np.uint16]


@kernel
def _place(ground, stance, out):  # type: ignore[no-untyped-def]
    """Fill ``out``, tilt and slope squared, row by row: a row of a padded map, moved by an offset of ``stance``, is the
    ground below one part of the vehicle at all positions of the row."""
    rows, cols = out.tilt.shape
    headings = stance.wheels.shape[0]
    parts = headings * (stance.wheels.shape[1] + stance.belly.shape[1])
    missing = np.empty(cols, dtype=np.uint16)
    for r in range(rows):
        missing[:] = 0
        for k in range(headings):
            stand = _below_wheels(ground.stand, stance.wheels[k], r, cols)
            _steepest(stand, stance.spans[k], out.tilt[r])
            _steepest(_below_wheels(ground.lowest, stance.wheels[k], r, cols), stance.spans[k], out.slope[r])
            for y, x in stance.wheels[k]:
                missing += ground.gaps[r + y, x : x + cols]
            for j in range(stance.belly.shape[1]):
                y, x = stance.belly[k, j]
                missing += ground.gaps_below[r + y, x : x + cols]
                _rise(stand, ground.belly[r + y, x : x + cols], stance.weights[j], out.rise[r])
        out.unstood[r] = missing / np.float32(parts)


@kernel
def _below_wheels(a, wheels, r, cols):  # type: ignore[no-untyped-def]
    """Rows of a map below the four wheels at the positions of row ``r``."""
    return (
        a[r + wheels[0, 0], wheels[0, 1] : wheels[0, 1] + cols],
        a[r + wheels[1, 0], wheels[1, 1] : wheels[1, 1] + cols],
        a[r + wheels[2, 0], wheels[2, 1] : wheels[2, 1] + cols],
        a[r + wheels[3, 0], wheels[3, 1] : wheels[3, 1] + cols],
    )


@kernel
def _steepest(wheels, spans, out):  # type: ignore[no-untyped-def]
    """Raise ``out`` to the greatest squared gradient of the planes through three wheels on known ground."""
    one, zero = np.float32(1.0), np.float32(0.0)
    left, right, front, rear = one / spans[0], one / spans[1], one / spans[2], one / spans[3]
    for c in range(out.shape[0]):
        fl, fr, rl, rr = wheels[0][c], wheels[1][c], wheels[2][c], wheels[3][c]
        # NaN compares false and is no maximum: a plane with a wheel over unknown ground is left out.
        along = max(zero, abs(fl - rl) * left, abs(fr - rr) * right)
        across = max(zero, abs(fl - fr) * front, abs(rl - rr) * rear)
        out[c] = max(out[c], along * along + across * across)


@kernel
def _rise(wheels, belly, weights, out):  # type: ignore[no-untyped-def]
    """Raise ``out`` to the rise of a point of the belly, with these weights of the wheels, over the wheels' plane."""
    (fl, fr, rl, rr), zero = wheels, np.float32(0.0)
    for c in range(out.shape[0]):
        # Each difference is cut off at 0 before it is weighted, so that none compensates another.
        front = weights[0] * max(zero, belly[c] - fl[c]) + weights[1] * max(zero, belly[c] - fr[c])
        rear = weights[2] * max(zero, belly[c] - rl[c]) + weights[3] * max(zero, belly[c] - rr[c])
        out[c] = max(out[c], front + rear)
