"""Coordinates of an artifact's arrays, beside them in its zarr group, so that xarray knows where each cell is.

An array (row, col) on the lattice that the metadata state gets ``x`` (col) and ``y`` (row), metres, of the cell
centres. Arrays of image pixels need none: pixel centres are at integer (row, col), which is what xarray counts by
itself. The coordinates follow from the metadata: they are no outputs, and enter no digest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import Stage
from rille.stages.geometry.lattice import Lattice

DIMS = ["row", "col"]


def lattice_of(meta: Mapping[str, Any]) -> Lattice | None:
    """The lattice that an artifact's arrays lie on, if its metadata state one."""
    stated = meta.get("lattice")
    keys = {"x0", "y0", "cell", "rows", "cols"}
    return Lattice.from_dict(stated) if isinstance(stated, Mapping) and keys <= stated.keys() else None


def coordinates(lattice: Lattice, frame: str) -> dict[str, tuple[NDArray[np.float64], list[str], dict[str, str]]]:
    """Values, dimensions and attributes of the coordinates by name."""
    common = {"units": "m", "frame": frame}
    return {
        "x": (lattice.xs(), ["col"], {**common, "long_name": "x of the cell centre (right)"}),
        "y": (lattice.ys(), ["row"], {**common, "long_name": "y of the cell centre (ahead)"}),
    }


def attributes(
    name: str, about: Mapping[str, Any], names: Mapping[str, Any], lattice: Lattice | None
) -> dict[str, str]:
    """Return the attributes of an array that name its coordinates and its standard deviation."""
    found = {}
    if lattice is not None and about["dims"] == DIMS and about["shape"] == list(lattice.shape):
        found["coordinates"] = "x y"
    if f"{name}_std" in names:
        found["ancillary_variables"] = f"{name}_std"
    return found


def source(stage: Stage) -> str:
    """Return the attribute ``source``: a sentence about the program that made the arrays."""
    return f"Rille, stage {stage.name}, version {stage.version}: {stage.summary}"
