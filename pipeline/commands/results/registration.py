"""Where the terrain of one run lies in that of another of the same place, whose world frame is another.

The ortho images tell it by their keypoints. Under another sun, or over ground that was raked, they show no place that
both share; the relief does, and has to be unlike every other place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.evaluation.place import Ortho, place
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.map_localization import GlobalMap, MapLocalizationParams, SearchArea, fix

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Registration:
    """``motion`` (2, 3) from x, y of A to those of B, a turn and a shift; ``by`` what it was found, in words; ``sigma``
    (3,): standard deviations of the shift, m, and of the turn, rad."""

    motion: Floats
    by: str
    sigma: Floats


def register(a: Ortho, b: Ortho, heights: tuple[Floats, Floats]) -> Registration:
    """Find where A lies in B, without a start.

    Parameters
    ----------
    a, b : ortho images in metres, of level models.
    heights : elevations (row, col), m, NaN unknown, of the cells of both.

    Raises
    ------
    DegenerateError
        Neither the images nor the relief tell one place.
    """
    try:
        placed = place(a, b)
    except DegenerateError:
        found = _by_relief(a, b, heights)
        if found is None:
            raise
        return found
    return Registration(placed.motion, f"ortho images, {placed.agreeing} keypoints", placed.sigma)


def _by_relief(a: Ortho, b: Ortho, heights: tuple[Floats, Floats]) -> Registration | None:
    """The only place whose relief fits; None where there is none, or another fits nearly as well."""
    try:
        model, ground = _lattice(a), _lattice(b)
        if model is None or ground is None or (a.grey.shape, b.grey.shape) != (heights[0].shape, heights[1].shape):
            return None
        x0, x1, y0, y1 = ground.bounds
        reach = max(math.hypot(x, y) for x in model.bounds[:2] for y in model.bounds[2:])
        area = SearchArea(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0, 0.5 * math.hypot(x1 - x0, y1 - y0) + reach, math.pi)
        elevations = GlobalMap(heights[1], ground.x0, ground.y0, ground.cell)
        found = fix(heights[0], model, elevations, area, MapLocalizationParams.model_validate({}))
    except (DegenerateError, InputError):
        return None
    if found.doubt:
        return None
    motion = np.column_stack([found.pose.rotation[:2, :2], found.pose.translation[:2]])
    # A tilt, which the elevations tell later, shortens the level part of the rotation.
    motion[:, :2] /= math.sqrt(np.linalg.det(motion[:, :2]))
    return Registration(motion, f"relief, {found.cells} cells", np.sqrt(np.diag(found.covariance))[[0, 1, 5]])


def _lattice(image: Ortho) -> Lattice | None:
    """The image's lattice; None where it is turned against the axes, or its cells are no squares."""
    (a, b, x0), (c, d, y0) = image.matrix
    square = a > 0 and abs(d + a) < 1e-6 * a and max(abs(b), abs(c)) < 1e-9 * a
    return Lattice(float(x0), float(y0), float(a), *image.grey.shape) if square else None
