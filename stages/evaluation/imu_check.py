"""Whether sensors contradict the images: rates against the camera's rotations, verticals against the seen ground.

The sensor's rotation from frame to frame should be that of the images. If it is not, a signed exchange S of its axes,
or the factor from degrees, is searched for by which they agree. At rest only gravity can be compared, and only if the
images show the ground: several S then fit, because gravity along one axis does not determine the other two.
"""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import level_rotation
from rille.stages.geometry.rigid import posed

# Radians between frames above which the two disagree; and the largest share of them that another reading may leave.
MIN_DISAGREEMENT, MAX_SHARE = 0.035, 0.3
# Between a vertical and the normal of the ground: the mean slope that the pairs of a run see is less.
MAX_SLOPE_DEG = 15.0
MIN_COSINE = np.cos(np.deg2rad(MAX_SLOPE_DEG))
UNLESS = "unless all of that ground is such a slope,"


@cache
def signed_axes() -> list[Floats]:
    """The signed exchanges (3, 3) of three axes; the given axes come first."""
    turns = scipy.spatial.transform.Rotation.create_group("O").as_matrix()
    return [np.eye(3), *(sign * turn for sign in (1.0, -1.0) for turn in turns)]


def of_rotations(images: Floats, sensor: Floats, times: Floats, axes: Floats) -> list[str]:
    """Warnings if the sensor's rotations differ from those of the images, with a reading that would fit.

    Parameters
    ----------
    images, sensor : (frame, 3, 3) R_reference_left by the images and by the sensor; NaN where one has none.
    times : (frame,) s.
    axes : (3, 3) R_imu_left.
    """
    both = posed(images) & posed(sensor)
    # After a gap a sensor's attitude, and a trajectory, may begin anew.
    step = both[:-1] & both[1:]
    if step.sum() < 5:
        return []
    steps = (np.swapaxes(R[:-1][step], 1, 2) @ R[1:][step] for R in (images, sensor))
    seen, sensed = (scipy.spatial.transform.Rotation.from_matrix(step).as_rotvec() @ axes.T for step in steps)

    # A bias, at most 0.15 rad/s, also looks like a rotation; read as degrees it would be small.
    fast = np.median(np.linalg.norm(sensed, axis=1)) > MIN_DISAGREEMENT + 0.15 * np.median(np.diff(times)[step])
    readings = list(product((1.0, float(np.deg2rad(1.0))) if fast else (1.0,), signed_axes()))
    off = [float(np.median(np.linalg.norm(factor * sensed @ S.T - seen, axis=1))) for factor, S in readings]
    if off[0] < MIN_DISAGREEMENT or min(off) > MAX_SHARE * off[0]:
        return []
    # If the camera hardly turns, all axes fit alike, and the stated ones are preferred.
    given = [0.1 * off[0] * (S is signed_axes()[0]) for _, S in readings]
    best = int(np.argmin(np.subtract(off, given)))
    factor, S = readings[best]
    turned = f"between frames it turns {np.degrees(off[0]):.2g} degrees otherwise (median)"
    words = [f"the IMU contradicts the images: {turned}"]
    if factor != 1.0:
        words.append("its rates are in degrees a second: name its columns so, [deg/s]")
    if not np.allclose(S, np.eye(3)):
        words.append(f"its x, y and z would have to be its {names(S)}: exchange its columns")
    return ["; ".join([*words, f"that leaves {np.degrees(off[best]):.2g} degrees"])]


def of_vertical(given: Floats, seen: Floats, axes: Floats | None, pitch: float | None = None) -> list[str]:
    """Warnings if a stated or measured vertical contradicts the seen ground, with a reading that would fit.

    Parameters
    ----------
    given, seen : (pair, 3) up in the left camera's frame as stated or by a sensor, and by the ground.
    axes : (3, 3) R_imu_left; None: up is not an IMU's.
    pitch : radians; the stated downward pitch over the ground that ``given`` follows from; None: from another source.
    """
    # Slopes in all directions cancel in the mean of the ground's normals, each in the frame levelled by its vertical.
    tilt = np.mean([level_rotation(up) @ ground for up, ground in zip(given, seen, strict=True)], axis=0)
    off = float(np.degrees(np.arctan2(np.hypot(tilt[0], tilt[1]), tilt[2])))
    given, seen = given.mean(axis=0), seen.mean(axis=0)
    if pitch is not None:
        stated, found = np.degrees([pitch, np.arctan2(-seen[2], -seen[1])])
        rest = abs(found + stated)
        # A pitch over the ground excludes a slope: 5 degrees off it may already have the other sign.
        reversed_fits = off > 5.0 and rest < MAX_SHARE * off
        if off <= MAX_SLOPE_DEG and not reversed_fits:
            return []
        line = (
            f"world.pitch_deg = {stated:.3g} contradicts the images: by the ground that they show the camera looks "
            f"down by {found:.3g} degrees"
        )
        remedy = f"with the other sign it is {rest:.2g} off" if reversed_fits else f"{UNLESS} correct or remove it"
        return [f"{line}; {remedy}"]
    if off <= MAX_SLOPE_DEG:
        return []
    if axes is None:
        vertical = f"the stated vertical is {off:.0f} degrees off that of the ground which is seen"
        return [f"{vertical}: {UNLESS} correct up (its sign, too), the angles' unit or T_body_left"]
    a, b = axes @ given, axes @ seen
    fits = sorted((float(-b @ S @ a), k) for k, S in enumerate(signed_axes()) if b @ S @ a > MIN_COSINE)
    told = "; or ".join(dict.fromkeys(names(signed_axes()[k]) for _, k in fits[:3]))
    return [
        f"the IMU contradicts the images: its up is {off:.0f} degrees off that of the ground which is seen; {UNLESS} "
        f"its x, y and z would have to be its {told or 'own, turned'} (gravity alone does not tell which): exchange "
        "its columns, or correct T_imu_left"
    ]


def of_mount(given: Floats, seen: Floats, images: Floats) -> list[str]:
    """Warnings if a measured vertical is off by an angle that turns with the vehicle, as by its mount or its zero.

    The normal of the ground, in the frame levelled by the vertical and aligned to the heading, is the sum of a slope of
    the world, turned by the heading, and of that angle. A drive without turns does not tell one from the other.

    Parameters
    ----------
    given, seen : (pair, 3) up in the left camera's frame by the sensor, and by the ground.
    images : (pair, 3, 3) R_world_left by the images.
    """
    if not len(given):
        return []
    levels = np.array([level_rotation(up) for up in given])
    lean = np.degrees(np.einsum("nij,nj->ni", levels, seen)[:, :2])
    local = images @ np.swapaxes(levels, 1, 2)
    heading = np.exp(1j * np.arctan2(local[:, 1, 0] - local[:, 0, 1], local[:, 0, 0] + local[:, 1, 1]))
    # Per pair two equations of the angle (2,) and of the world's slope (2,), turned back by the heading.
    design = np.array([[[1, 0, h.real, h.imag], [0, 1, -h.imag, h.real]] for h in heading]).reshape(-1, 4)
    # Both may be of any size up to what else is named; ground is as uneven as it proves to be, or 1 degree.
    prior, sigma = np.eye(4) / MAX_SLOPE_DEG**2, 1.0
    for _ in range(2):
        information = design.T @ design / sigma**2 + prior
        answer = np.linalg.solve(information, design.T @ lean.ravel() / sigma**2)
        sigma = max(1.0, float(np.sqrt(np.mean((lean.ravel() - design @ answer) ** 2))))
    size, error = np.hypot(*answer[:2]), np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[:2, :2])[-1])
    # 3 degrees: less is within what suspensions give; and five of its standard deviations.
    if size < max(3.0, 5.0 * error):
        return []
    return [
        f"the measured vertical is off by {size:.1f} +- {error:.1f} degrees: ground that is seen leans so to the same "
        "side of the vehicle, whichever way it heads, as no slope does: correct T_body_left (T_imu_left), or the "
        "sensor's zero"
    ]


def names(S: Floats) -> str:
    """Signed axes (3, 3) in words: z, -y, x."""
    return ", ".join(("-" if row.min() < -0.5 else "") + "xyz"[int(np.abs(row).argmax())] for row in S)
