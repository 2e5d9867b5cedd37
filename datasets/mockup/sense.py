"""Stage ``mockup.sense``: readings of the rover's sensors on a leg: wheels, inclinometer, accelerometer.

Estimates of a drive use these readings and the images alone.
"""

from __future__ import annotations

import math

import numpy as np

from rille.datasets.mockup.facts import DrivenFacts, SensedFacts
from rille.datasets.mockup.rover import RoverParams
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.geometry.geometry import rotation_exp


def _peaks(z: Floats, wheels: Floats) -> Floats:
    """Vertical acceleration (position,), m/s2, of the body at its driving speed; 0 for turns on the spot."""
    out = np.zeros(len(z))
    # The vehicle drives at 0.05 m/s.
    seconds = np.hypot(*np.diff(wheels[:, :2], axis=0).T) / 0.05
    rolls = (seconds[:-1] > 0) & (seconds[1:] > 0)
    a, b, rise = seconds[:-1][rolls], seconds[1:][rolls], np.diff(z)
    out[1:-1][rolls] = np.abs((rise[1:][rolls] / b - rise[:-1][rolls] / a) / (0.5 * (a + b)))
    return out


@stage(
    "mockup.sense",
    outputs=[
        Array("odometry", ("frame", "xyh"), "float64", "1", "x, y (m), heading (rad) since the leg began, by wheels"),
        Array("up", ("frame", "xyz"), "float64", "1", "direction of up in the left camera, by inclinometer"),
        Array("acceleration", ("frame",), "float64", "1", "peak of vertical acceleration since the last image, m/s2"),
    ],
)
def sense_stage(params: RoverParams, drive: Bundle[DrivenFacts], *, leg: int) -> Bundle[SensedFacts]:
    """What the simulated rover's sensors report of a leg."""
    rng = np.random.default_rng([params.seed, 71, 1 + leg])
    at = np.asarray(drive["frame_at"])
    wheels, poses = np.asarray(drive["wheels"])[at], np.asarray(drive["poses"])
    # One factor for the whole leg, as by an error of the wheels' radius, which does not average out.
    odometry = wheels * (1.0 + 0.01 * float(rng.standard_normal()))
    # 0.2 degrees: of the inclinometer, about each axis.
    sigma = math.radians(0.2)
    # The third row of R_bed_left is the bed's z axis, in axes of the camera.
    up = np.stack([rotation_exp(sigma * rng.standard_normal(3)) @ pose[2, :3] for pose in poses])
    peak = _peaks(np.asarray(drive["trail"])[:, 2, 3], np.asarray(drive["wheels"]))
    acceleration = [float(peak[a + 1 : b + 1].max(initial=0.0)) for a, b in zip([0, *at[:-1]], at, strict=True)]
    # 0.05 m/s2: of the accelerometer.
    noise = 0.05 * rng.standard_normal(len(at))
    arrays = {"odometry": odometry, "up": up, "acceleration": np.abs(np.array(acceleration) + noise)}
    return Bundle(arrays, {"up": up.tolist(), "odometry": odometry.tolist()})
