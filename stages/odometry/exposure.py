"""Changes of exposure between the frames of a segment, undone before points are searched.

Feature vectors know the brightness, so that a point is not found in a frame that is a quarter brighter; the coarse
displacements are found all the same. The grey values of the pixels that they connect tell by what factor a frame is
brighter than the one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from rille.stages.hfvm.coarse import MAX_FIT_PIXELS, MAX_GREY, MIN_FIT_PIXELS, MIN_GREY, MIN_LOG_RATIO
from rille.stages.hfvm.image import thinned
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.odometry.displacements import LevelDisplacements


def levelled(frames: Sequence[Pyramid], motions: Sequence[LevelDisplacements]) -> list[Pyramid]:
    """Return the frames, each as bright as the first one; those that differ less than notably as they are.

    Parameters
    ----------
    motions : displacements from each frame to the next, one fewer than frames.
    """
    steps = [log_ratio(a, b, motion) for (a, b), motion in zip(pairwise(frames), motions, strict=True)]
    total = np.cumsum([0.0, *steps])
    return [
        _brighter(frame, -log) if abs(log) > MIN_LOG_RATIO else frame for frame, log in zip(frames, total, strict=True)
    ]


def log_ratio(a: Pyramid, b: Pyramid, motion: LevelDisplacements) -> float:
    """Logarithm of the factor by which frame b is brighter than a: median over the displacements; 0 of too few."""
    y, x = thinned(np.isfinite(motion.column), MAX_FIT_PIXELS)
    # Centres of the level's pixels, to the nearest pixel of the images; of odd sizes the last one lies outside.
    here = (np.stack([x, y]) + 0.5) * 2.0**motion.level - 0.5
    there = here + np.stack([motion.column[y, x], motion.row[y, x]])
    p, q = (np.rint(place).astype(np.intp) for place in (here, there))
    rows, cols = a.shape
    inside = (np.minimum(p, q) >= 0).all(axis=0) & (np.maximum(p, q) < [[cols], [rows]]).all(axis=0)
    (px, py), (qx, qy) = p[:, inside], q[:, inside]
    before, after = a.images[0][py, px], b.images[0][qy, qx]
    # Clipped grey values tell no factor, and in the dark a grey level is a quarter of the value.
    good = (np.minimum(before, after) > MIN_GREY) & (np.maximum(before, after) < MAX_GREY)
    good &= (a.valid[0][py, px] != 0) & (b.valid[0][qy, qx] != 0)
    if np.count_nonzero(good) < MIN_FIT_PIXELS:
        return 0.0
    return float(np.median(np.log(after[good] / before[good])))


def _brighter(frame: Pyramid, log: float) -> Pyramid:
    factor = np.float32(np.exp(log))
    return Pyramid([image * factor for image in frame.images], frame.valid, frame.noise * float(factor))
