"""Doubts about a trajectory by its motion alone: a camera that stands still, or that goes to and fro."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.quantities import metres
from rille.stages.geometry import rigid


def doubtful_motion(poses: Floats, covariance: Floats) -> list[str]:
    """At most one line on poses (frame, 3, 4), m, of one piece, in order, with their covariances (frame, 6, 6)."""
    return _resting(poses, covariance) or _to_and_fro(poses[:, :, 3])


def _resting(poses: Floats, covariance: Floats) -> list[str]:
    """By the images the camera stands still, which who recorded them knows better."""
    if len(poses) < 3:
        return []
    moved = rigid.relative_error(poses[:1], poses[1:])
    for value, part in ((np.linalg.norm(moved[:, :, 3], axis=1), slice(3)), (rigid.angle(moved), slice(3, 6))):
        # 5.0: standard deviations that a camera at rest stays within; the slowest of those that moved went 60.
        if not (value**2 <= 5.0**2 * np.trace(covariance[1:, part, part], axis1=1, axis2=2)).all():
            return []
    far = metres(float(np.linalg.norm(moved[:, :, 3], axis=1).max()))
    return [
        f"by the images the camera stands still, within {far} in all {len(poses)} frames; if it moved, what they show "
        "moves with it or repeats along its way: switch off a projector of dots, mask the vehicle's body or the pattern"
    ]


def _to_and_fro(places: Floats) -> list[str]:
    """The camera goes back at most of its frames, as where images are not in the order in which they were taken."""
    steps = np.diff(places, axis=0)
    if len(steps) < 6:
        return []
    back = np.einsum("ni,ni->n", steps[1:], steps[:-1]) < 0
    axis = np.linalg.svd(places - places.mean(axis=0))[2][0]
    long, least = (
        np.linalg.norm(of, axis=1).sum() for of in (steps, np.diff(places[np.argsort(places @ axis)], axis=0))
    )
    # 0.7: noise of a camera that rests for a while adds less to its way.
    if back.mean() <= 0.5 or least > 0.7 * long:
        return []
    return [
        f"the camera goes back at {int(back.sum())} of {len(back)} frames: {metres(long)}, where its places lie on a "
        f"way of {metres(least)}; are the images in the order in which they were taken?"
    ]
