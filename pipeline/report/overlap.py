"""How far elevation models that see the same ground disagree: a check of poses and rig that needs no truth."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from rille.pipeline.export import ranges
from rille.pipeline.export.view import RunView
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.robust import mad_sigma

LEAST_CELLS = 100
"""Common cells below which a median says little."""


@dataclass(frozen=True)
class Difference:
    """Elevation of the model of ``pair`` minus that of ``before``, in the world, over their common cells, m.

    ``median``; ``deviation`` robust (1.4826 times the median absolute deviation); ``predicted`` median over the cells
    of what both models' own standard deviations let expect, errors of pose left out.
    """

    before: int
    pair: int
    cells: int
    median: float
    deviation: float
    predicted: float


def differences(view: RunView) -> list[Difference]:
    """Of each two successive models that overlap, in the order of the pairs."""
    found = []
    present = [pair for pair, handle in view.products.world_dem.items() if view.bundle(handle) is not None]
    for before, pair in itertools.pairwise(present):
        one = _difference(view, before, pair)
        if one is not None:
            found.append(one)
    return found


def _difference(view: RunView, before: int, pair: int) -> Difference | None:
    a, b = (view.bundle(view.products.world_dem[k]) for k in (before, pair))
    if a is None or b is None or "lattice" not in a.meta or "lattice" not in b.meta:
        return None
    lattices = [Lattice.from_dict(m.meta["lattice"]) for m in (a, b)]
    common = lattices[0].intersection(lattices[1])
    if common is None:
        return None
    windows = [lattice.window(common) for lattice in lattices]
    z, sigma = (
        [np.asarray(m[name][window], dtype=np.float64) for m, window in zip((a, b), windows, strict=True)]
        for name in ("elevation", "elevation_std")
    )
    difference, expected = z[1] - z[0], np.hypot(*sigma)
    cells = int(np.isfinite(difference).sum())
    if cells < LEAST_CELLS:
        return None
    sampled = ranges.sample(difference)
    median = float(np.median(sampled))
    deviation = mad_sigma(sampled)
    predicted = ranges.sample(np.where(np.isfinite(difference), expected, np.nan))
    return Difference(before, pair, cells, median, deviation, float(np.median(predicted)))
