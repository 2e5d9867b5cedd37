"""Declarations of stored poses and covariances. Each stage states the frame of reference of its poses."""

from __future__ import annotations

from dataclasses import replace

from rille.stages.core.declare import Array

NO_VERTICAL = "none"
"""Source of the vertical if nothing gives it: z is then the camera's own up."""
GROUND_PLANE = "ground plane"
"""Source of the vertical if it is the normal of the seen ground."""
REFERENCE_PLANE = "reference plane"
"""Source of the vertical if elevations are distances from a plane other than the ground: z is its normal."""

POSES = Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", "nan")

COVARIANCE = Array(
    "covariance",
    ("frame", "parameter", "parameter_b"),
    "float64",
    "m^2, m rad, rad^2",
    "covariance of position and rotation vector",
    "nan",
)

SHARED = Array(
    "shared",
    ("frame", "parameter", "source"),
    "float64",
    "m, rad",
    "errors of position and rotation vector per standard deviation of what all segments share",
    "nan",
)

BY_INTRINSICS = Array(
    "by_intrinsics",
    ("frame", "parameter", "number"),
    "float64",
    "m, rad",
    "change of position and rotation vector with each error of the calibration that is estimated",
    "nan",
)

OWN_COVARIANCE = replace(COVARIANCE, name="own_covariance", long_name="covariance if the calibration had no errors")
