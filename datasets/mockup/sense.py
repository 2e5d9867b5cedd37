"""Stage ``mockup.sense``: what the rover's sensors report of a leg: wheels, inclinometer, accelerometer.

This, and the images, is all that the estimates ever learn of a drive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.datasets.mockup.rover import RoverParams
from rille.stages.core.declare import Array, Bundle, Inputs, Stage
from rille.stages.geometry.geometry import rotation_exp


def _run(params: RoverParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    drive = inputs["drive"]
    rng = np.random.default_rng([params.seed, 71, 1 + int(args["leg"])])
    at = np.asarray(drive["frame_at"])
    wheels, poses = np.asarray(drive["wheels"])[at], np.asarray(drive["poses"])
    # One error for the whole leg: it does not average out over the leg's images.
    odometry = wheels * (1.0 + params.odometry_sigma * float(rng.standard_normal()))
    sigma = math.radians(params.attitude_sigma_deg)
    # The third row of R_bed_left is the bed's z axis, in axes of the camera.
    up = np.stack([rotation_exp(sigma * rng.standard_normal(3)) @ pose[2, :3] for pose in poses])
    peak = _peaks(np.asarray(drive["trail"])[:, 2, 3], np.asarray(drive["wheels"]), params.speed)
    acceleration = [float(peak[a + 1 : b + 1].max(initial=0.0)) for a, b in zip([0, *at[:-1]], at, strict=True)]
    noise = params.acceleration_sigma * rng.standard_normal(len(at))
    arrays = {"odometry": odometry, "up": up, "acceleration": np.abs(np.array(acceleration) + noise)}
    facts = {"up": up.tolist(), "odometry": odometry.tolist()}
    return Bundle(arrays, {"leg": args["leg"], **facts})


def _peaks(z: np.ndarray, wheels: np.ndarray, speed: float) -> np.ndarray:
    """Vertical acceleration (position,), m/s2, of the body at its driving speed; none where it turns on the spot."""
    out = np.zeros(len(z))
    way = np.hypot(*np.diff(wheels[:, :2], axis=0).T)
    for k in range(1, len(z) - 1):
        a, b = way[k - 1] / speed, way[k] / speed
        if a > 0 and b > 0:
            out[k] = abs(((z[k + 1] - z[k]) / b - (z[k] - z[k - 1]) / a) / (0.5 * (a + b)))
    return out


STAGE = Stage(
    name="mockup.sense",
    version=1,
    summary="what the simulated rover's sensors report of a leg",
    params=RoverParams,
    inputs=("drive",),
    outputs=(
        Array("odometry", ("frame", "xyh"), "float64", "1", "x, y (m), heading (rad) since the leg began, by wheels"),
        Array("up", ("frame", "xyz"), "float64", "1", "direction of up in the left camera, by inclinometer"),
        Array("acceleration", ("frame",), "float64", "1", "peak of vertical acceleration since the last image, m/s2"),
    ),
    run=_run,
)
