"""Coordinates of an artifact's arrays, beside them in its zarr group, so that xarray knows where each cell is.

An array (row, col) on the lattice that the metadata state gets ``x`` (col) and ``y`` (row), metres, of the cell
centres. Arrays of image pixels need none: pixel centres are at integer (row, col), which is what xarray counts by
itself. The coordinates follow from the metadata: they are no outputs, and enter no digest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rille.stages.core.declare import AnyArray
from rille.stages.geometry.lattice import Lattice

DIMS = ["row", "col"]

Variable = tuple[AnyArray, list[str], dict[str, str]]
"""Values, names of the dimensions, and attributes."""


def lattice_of(meta: Mapping[str, Any]) -> Lattice | None:
    """The lattice that an artifact's arrays lie on, if its metadata state one."""
    stated = meta.get("lattice")
    keys = {"x0", "y0", "cell", "rows", "cols"}
    return Lattice.from_dict(stated) if isinstance(stated, Mapping) and keys <= stated.keys() else None


def coordinates(lattice: Lattice, frame: str) -> dict[str, Variable]:
    """Values, dimensions and attributes of the coordinates by name."""
    common = {"units": "m", "frame": frame}
    return {
        "x": (lattice.xs(), ["col"], {**common, "long_name": "x of the cell centre (right)"}),
        "y": (lattice.ys(), ["row"], {**common, "long_name": "y of the cell centre (ahead)"}),
    }


def located(variables: Mapping[str, Variable], meta: Mapping[str, Any]) -> dict[str, Variable]:
    """The arrays of an artifact, which name their coordinates and standard deviations, and these coordinates."""
    lattice, named = lattice_of(meta), dict[str, Variable]()
    for name, (values, dims, attributes) in variables.items():
        on_lattice = lattice is not None and dims == DIMS and values.shape == lattice.shape
        names = {"coordinates": "x y"} if on_lattice else {}
        names |= {"ancillary_variables": f"{name}_std"} if f"{name}_std" in variables else {}
        named[name] = values, dims, {**attributes, **names}
    return named | (coordinates(lattice, str(meta.get("frame", ""))) if lattice is not None and variables else {})
