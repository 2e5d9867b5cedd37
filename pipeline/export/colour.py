"""The ortho image of a run in colour, if its left images have colours.

Matching, elevation models and their merging use grey values alone, and the merged grey is free of differences of
exposure. Colour is added afterwards: for each cell, in the left image of the pair with the greatest weight there, the
difference between each colour channel and the grey is added to the merged grey. So colours have no seams of exposure.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from rille.pipeline.export.view import RUN, RunView, by_frame, used_rig
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice

LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in grey (ITU-R BT.601), as in the conversion of the images to grey."""


READS = (RUN.products.images, RUN.products.trajectory, RUN.products.rigs, RUN.sequence.rig)
"""Inputs of the colours besides the merged terrain."""


def coloured(view: RunView, source: NDArray[Any]) -> bool:
    """Whether any left image of the pairs in ``source`` has colours; a dark one may have none."""
    images = (view.bundle(view.products.images.get(int(pair))) for pair in np.unique(source))
    return any(image is not None and "colour" in image.arrays for image in images)


def ortho(view: RunView, lattice: Lattice, merged: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Red, green and blue (row, col, 3) of the merged cells, 1..255; 0 for unknown cells.

    Parameters
    ----------
    merged : arrays ``ortho``, ``elevation`` and ``source`` on ``lattice``.
    """
    grey, known = merged["ortho"], np.isfinite(merged["ortho"])
    colours = np.repeat(np.nan_to_num(grey)[..., None], 3, axis=2).astype(np.float64)
    trajectory = view.bundle(view.products.trajectory)
    poses = {} if trajectory is None else dict(zip(view.frames, by_frame(view, trajectory, "poses"), strict=True))
    xy = lattice.xy()
    for pair in np.unique(merged["source"][known]):
        image, pose = view.bundle(view.products.images.get(int(pair))), poses.get(int(pair))
        if image is None or "colour" not in image.arrays or pose is None or not np.isfinite(pose).all():
            continue
        here = known & (merged["source"] == pair) & np.isfinite(merged["elevation"])
        world = np.column_stack([xy[here], merged["elevation"][here]])
        camera = used_rig(view, int(pair)).left
        x, y = camera.project(RigidTransform.from_matrix(pose).inverse().apply(world)).T
        bands = np.moveaxis(image["colour"], 2, 0)
        colour = np.stack([scipy.ndimage.map_coordinates(b, (y, x), float, 1, mode="nearest") for b in bands], axis=1)
        colours[here] += colour - (colour @ LUMA)[:, None]
    # 0 means unknown in the file: a known black becomes 1.
    return np.where(known[..., None], np.clip(np.rint(colours), 1, 255), 0).astype(np.uint8)
