"""Rotations by the paper's pointing angles (Eq. 5), which state a pose in three numbers that a test can read."""

from __future__ import annotations

import math

import numpy as np


def rotation_from_angles(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Rotation matrix of the paper's pointing angles, radians (Eq. 5)."""
    so, co = math.sin(omega), math.cos(omega)
    sp, cp = math.sin(phi), math.cos(phi)
    sk, ck = math.sin(kappa), math.cos(kappa)
    return np.array(
        [
            [cp * ck, cp * sk, -sp],
            [so * sp * ck - co * sk, so * sp * sk + co * ck, so * cp],
            [co * sp * ck + so * sk, co * sp * sk - so * ck, co * cp],
        ]
    )


def angles_from_rotation(rotation: np.ndarray) -> tuple[float, float, float]:
    """Angles omega, phi, kappa, radians, of a rotation matrix (inverse of Eq. 5, ``|phi| < pi / 2``)."""
    r = np.asarray(rotation, dtype=np.float64)
    phi = math.asin(float(np.clip(-r[0, 2], -1.0, 1.0)))
    return math.atan2(r[1, 2], r[2, 2]), phi, math.atan2(r[0, 1], r[0, 0])
