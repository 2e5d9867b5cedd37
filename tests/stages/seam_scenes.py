"""Elevation models of one rough ground along a track, each with noise of its own that is alike over several cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice

CELL = 0.005
SIGMA = 0.0005


def ground(lattice: Lattice) -> np.ndarray:
    xy = lattice.xy()
    return 0.05 * np.sin(7 * xy[..., 0]) * np.cos(5 * xy[..., 1]) + 0.01 * np.sin(60 * xy[..., 1])


def dem(
    pair: int, lattice: Lattice, *, bias: float = 0.0, tilt: Any = (0.0, 0.0), grey: float = 100.0, seed: int = 0
) -> Bundle:
    """Model with noise of SIGMA alike over five cells; ``tilt`` (rad) about the middle of the lattice."""
    rng = np.random.default_rng([seed, pair])
    noise = gaussian_filter(rng.normal(size=lattice.shape), 2.0)
    xy = lattice.xy() - lattice.xy().mean(axis=(0, 1))
    z = ground(lattice) + SIGMA * noise / noise.std() + bias + xy @ np.asarray(tilt)
    z[rng.random(lattice.shape) < 0.2] = np.nan
    shape = lattice.shape
    maps = {
        "elevation": z,
        "elevation_std": np.full(shape, SIGMA),
        "ortho": grey * rng.uniform(0.9, 1.1, shape),
    }
    meta = {"pair": pair, "lattice": lattice.to_dict(), "frame": "world"}
    return Bundle({k: v.astype(np.float32) for k, v in maps.items()}, meta)


def along(count: int, *, rows: int = 160, cols: int = 120, step: int = 50, **off: dict[int, Any]) -> dict[int, Bundle]:
    """Models of pairs 0, 4, 8 ..., each ``step`` cells ahead of the one before; ``off``: by pair, of :func:`dem`."""
    return {
        4 * k: dem(
            4 * k,
            Lattice.at(-cols // 2 + k % 3, 300 + k * step, CELL, rows, cols),
            **{name: values[4 * k] for name, values in off.items() if 4 * k in values},
        )
        for k in range(count)
    }
