"""Stage ``mockup.truth``: the exact disparity of a pair, by ray casting from both cameras."""

from __future__ import annotations

import numpy as np

from rille.datasets.mockup.facts import ExactFacts, SceneFacts
from rille.datasets.mockup.raycast import HeightField
from rille.datasets.mockup.render import camera_rays, transform
from rille.datasets.mockup.scene import height_field
from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform

SEEN, HIDDEN, OUTSIDE, NO_BED = 0, 1, 2, 3


def visible(
    field: HeightField, camera: Camera, T_bed_camera: RigidTransform, points: Floats
) -> tuple[Floats, Bools, Bools]:
    """Pixels of surface points in a camera, and whether it sees them.

    Parameters
    ----------
    points : (n, 3) of the bed frame, metres; NaN rows are outside and hidden.

    Returns
    -------
    pixels : (n, 2) column, row.
    inside : (n,) the projection lies within the outermost pixel centres.
    free : (n,) and nothing stands in between.
    """
    camera_points = transform(T_bed_camera.inverse(), points)
    pixels = camera.project(camera_points)
    inside = camera.holds(pixels)
    free = np.zeros(len(points), dtype=bool)
    directions = points[inside] - T_bed_camera.translation
    t = field.contact(T_bed_camera.translation[None, :], directions)
    length = np.sqrt((directions**2).sum(axis=1))
    # A ray that just misses its point has grazed it: seen; one that comes in through the bed's side: hidden.
    # 1e-5 m: a point is hidden if its line of sight ends farther in front of it; far below the accuracy of any use.
    free[inside] = ~((1.0 - t) * length > 1e-5)
    return pixels, inside, free


def true_disparity(field: HeightField, rig: Rig, T_bed_left: RigidTransform) -> dict[str, AnyArray]:
    """Disparity of each left pixel's central ray.

    Returns
    -------
    column_disparity, row_disparity : float32 (row, col), pixels, right minus left; NaN where the left camera sees no
        bed. Also for points that the right camera does not see.
    occluded : uint8; 0 both cameras see the point, 1 hidden from the right one, 2 outside its image, 3 no bed.
    depth : float32, metres along the left optical axis, NaN without bed.
    """
    rays = camera_rays(rig.left, T_bed_left)
    depth = field.cast(T_bed_left.translation[None, :], rays)
    points = T_bed_left.translation + depth[:, None] * rays
    pixels, inside, free = visible(field, rig.right, T_bed_left @ rig.T_right_left.inverse(), points)
    shape = (rig.left.height, rig.left.width)
    rows, columns = np.indices(shape)
    occluded = np.full(len(rays), SEEN, np.uint8)
    # Later lines override: points outside of the right image have not been tested for being hidden.
    occluded[~free] = HIDDEN
    occluded[~inside] = OUTSIDE
    occluded[np.isnan(depth)] = NO_BED
    return {
        "column_disparity": (pixels[:, 0].reshape(shape) - columns).astype(np.float32),
        "row_disparity": (pixels[:, 1].reshape(shape) - rows).astype(np.float32),
        "occluded": occluded.reshape(shape),
        "depth": depth.reshape(shape).astype(np.float32),
    }


@stage(
    "mockup.truth",
    outputs=[
        Array("column_disparity", ("row", "col"), "float32", "px", "exact column disparity", nodata="nan"),
        Array("row_disparity", ("row", "col"), "float32", "px", "exact row disparity", nodata="nan"),
        Array("occluded", ("row", "col"), "uint8", "1", "0 seen, 1 hidden, 2 outside the right image, 3 no bed"),
        Array("depth", ("row", "col"), "float32", "m", "depth along the left optical axis", nodata="nan"),
    ],
)
def truth_stage(
    params: NoParams, scene: Bundle[SceneFacts], *, T_bed_left: RigidTransform, rig: Rig, frame: int
) -> Bundle[ExactFacts]:
    """Exact disparity of a simulated pair."""
    arrays = true_disparity(height_field(scene), rig, T_bed_left)
    return Bundle(arrays, {"frame": frame, "seen": int((arrays["occluded"] == SEEN).sum())})
