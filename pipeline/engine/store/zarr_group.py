"""Arrays of one artifact as a zarr 3 group, which is written once.

Chunks are lz4-compressed with byte shuffle; ``dimension_names``, ``units`` and ``long_name`` are set, so
``xarray.open_zarr`` reads an artifact as it is. Members of a family (``level_*``) differ in size, so their dimensions
are told apart by the suffix (``row_0``, ``row_1`` ...).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from rille.pipeline.engine.store import cf_coordinates
from rille.stages.core.declare import AnyArray, Array, Bundle, Stage

CHUNK = 1024
"""Chunk edge, cells; an array of at most its square (4 MB of float32) is one chunk, whatever its shape."""


def encode(stage: Stage, bundle: Bundle) -> tuple[dict[str, bytes], dict[str, Any]]:
    """A bundle as a zarr group: contents by relative path, and the description of its arrays (for the manifest)."""
    lattice = cf_coordinates.lattice_of(bundle.meta)
    described, nodes = {}, {}
    files: dict[str, bytes] = {}
    for name in sorted(bundle.arrays):
        array = np.asarray(bundle.arrays[name])
        about = described[name] = _describe(name, array, next(a for a in stage.outputs if a.matches(name)))
        attributes = {k: about[k] for k in ("units", "long_name", "nodata", "frame") if about[k]}
        attributes |= cf_coordinates.attributes(name, about, bundle.arrays, lattice)
        nodes[name] = _add(files, name, array, about["dims"], attributes)
    if lattice is not None and bundle.arrays:
        frame = str(bundle.meta.get("frame", ""))
        for name, (values, dims, attributes) in cf_coordinates.coordinates(lattice, frame).items():
            nodes[name] = _add(files, name, values, dims, attributes)
    group = {
        "attributes": {"stage": stage.name, "source": cf_coordinates.source(stage), "meta": dict(bundle.meta)},
        "zarr_format": 3,
        "node_type": "group",
        # All arrays are described here too, so that opening the group reads nothing else.
        "consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": nodes},
    }
    return {"zarr.json": json.dumps(group).encode(), **files}, described


def _add(
    files: dict[str, bytes], name: str, array: AnyArray, dims: list[str], attributes: Mapping[str, str]
) -> dict[str, Any]:
    """Add the members of one array, and give its description as zarr 3 wants it.

    zarr hands each array over to threads of its own several times, which takes longer than all the rest.
    """
    little = np.asarray(array, dtype=array.dtype.newbyteorder("<"))
    edges, floating = _chunks(little.shape), little.dtype.kind == "f"
    fill = little.dtype.type(np.nan if floating else 0)
    blosc = {"typesize": little.itemsize, "cname": "lz4", "clevel": 5, "shuffle": "shuffle", "blocksize": 0}
    node = {
        "shape": little.shape,
        "data_type": little.dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": edges}},
        # No folders within the archive: its members are flat.
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": "NaN" if floating else fill.item(),
        "codecs": [
            {"name": "bytes", "configuration": {"endian": "little"}},
            {"name": "blosc", "configuration": blosc},
        ],
        "attributes": attributes,
        "dimension_names": dims,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }
    files[f"{name}/zarr.json"] = json.dumps(node).encode()
    blosc_lz4 = codec()
    # All chunks are written, those of the fill value too: a missing one is always damage.
    for at in np.ndindex(*(math.ceil(n / edge) for n, edge in zip(little.shape, edges, strict=True))):
        chunk = little[tuple(slice(i * edge, (i + 1) * edge) for i, edge in zip(at, edges, strict=True))]
        if chunk.shape != edges:  # all chunks of an array have one size: of the last ones a part is nothing
            part, chunk = chunk, np.full(edges, fill)
            chunk[tuple(map(slice, part.shape))] = part
        files[chunk_name(name, at)] = blosc_lz4.encode(np.ascontiguousarray(chunk))
    return node


def chunk_name(name: str, at: tuple[int, ...]) -> str:
    """Member that holds a chunk of an array."""
    return ".".join([f"{name}/c", *map(str, at)])


@cache
def codec() -> Any:
    """Codec of all chunks."""
    from numcodecs import blosc

    blosc.use_threads = False  # workers have a core each
    return blosc.Blosc(cname="lz4", clevel=5, shuffle=blosc.SHUFFLE)


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    if math.prod(shape) <= CHUNK**2:
        return tuple(max(n, 1) for n in shape)
    if sum(n > CHUNK for n in shape) == 1:  # a long list, cut along its length
        longest = max(shape)
        return tuple(n if n < longest else max(CHUNK**2 // (math.prod(shape) // n), 1) for n in shape)
    return tuple(min(n, CHUNK) for n in shape)


def _describe(name: str, array: AnyArray, spec: Array) -> dict[str, Any]:
    suffix = f"_{name[len(spec.name) - 1 :]}" if spec.name.endswith("*") else ""
    return {
        "dtype": array.dtype.newbyteorder("<").str,
        "shape": list(array.shape),
        "dims": [dim + suffix for dim in spec.dims],
        "units": spec.unit,
        "long_name": spec.long_name,
        "nodata": spec.nodata,
        "frame": spec.frame,
    }
