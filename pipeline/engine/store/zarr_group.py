"""Arrays of one artifact as a zarr 3 group, which is written once.

Chunks are lz4-compressed with byte shuffle; ``dimension_names``, ``units`` and ``long_name`` are set, so
``xarray.open_zarr`` reads an artifact as it is. Members of a family (``level_*``) differ in size, so their dimensions
are told apart by the suffix (``row_0``, ``row_1`` ...).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np

from rille.pipeline.engine.store import cf_coordinates
from rille.pipeline.engine.store.cf_coordinates import Variable
from rille.stages.core.declare import AnyArray, Bundle, Stage

CHUNK = 1024
"""Chunk edge, cells; an array of at most its square (4 MB of float32) is one chunk, whatever its shape."""


def encode(stage: Stage, bundle: Bundle) -> tuple[dict[str, bytes], dict[str, Any]]:
    """A bundle as a zarr group: contents by relative path, and the type, shape and chunks of its arrays by name."""
    variables = {name: _variable(stage, name, bundle.arrays[name]) for name in sorted(bundle.arrays)}
    stored = {
        name: {"dtype": values.dtype.str, "shape": list(values.shape), "chunks": list(_edges(values.shape))}
        for name, (values, _, _) in variables.items()
    }
    variables |= cf_coordinates.located(variables, bundle.meta)
    nodes = {name: _node(*variable) for name, variable in variables.items()}
    source = f"Rille, stage {stage.name}: {stage.summary}"
    group = {
        "attributes": {"stage": stage.name, "source": source, "meta": dict(bundle.meta)},
        "zarr_format": 3,
        "node_type": "group",
        # All arrays are described here too, so that opening the group reads nothing else.
        "consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": nodes},
    }
    members = {"zarr.json": json.dumps(group).encode()}
    for name, (values, _, _) in variables.items():
        members[f"{name}/zarr.json"] = json.dumps(nodes[name]).encode()
        members |= {chunk_name(name, at): content for at, content in _chunks(values)}
    return members, stored


def _variable(stage: Stage, name: str, array: AnyArray) -> Variable:
    spec = next(a for a in stage.outputs if a.matches(name))
    suffix = f"_{name[len(spec.name) - 1 :]}" if spec.name.endswith("*") else ""
    texts = {"units": spec.unit, "long_name": spec.long_name, "nodata": spec.nodata, "frame": spec.frame}
    little = np.asarray(array, dtype=np.asarray(array).dtype.newbyteorder("<"))
    return little, [dim + suffix for dim in spec.dims], {name: text for name, text in texts.items() if text}


def _node(values: AnyArray, dims: list[str], attributes: Mapping[str, str]) -> dict[str, Any]:
    """Description of an array as zarr 3 wants it.

    zarr hands each array over to threads of its own several times, which takes longer than all the rest.
    """
    blosc = {"typesize": values.itemsize, "cname": "lz4", "clevel": 5, "shuffle": "shuffle", "blocksize": 0}
    return {
        "shape": values.shape,
        "data_type": values.dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": _edges(values.shape)}},
        # No folders within the archive: its members are flat.
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": "NaN" if values.dtype.kind == "f" else values.dtype.type(0).item(),
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "blosc", "configuration": blosc}],
        "attributes": attributes,
        "dimension_names": dims,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def _chunks(values: AnyArray) -> Iterator[tuple[tuple[int, ...], bytes]]:
    """Index and content of all chunks, those of the fill value too: a missing one is always damage."""
    edges = _edges(values.shape)
    for at in np.ndindex(*(math.ceil(n / edge) for n, edge in zip(values.shape, edges, strict=True))):
        chunk = values[tuple(slice(i * edge, (i + 1) * edge) for i, edge in zip(at, edges, strict=True))]
        if chunk.shape != edges:  # all chunks of an array have one size: of the last ones a part is nothing
            part, chunk = chunk, np.full(edges, np.nan if values.dtype.kind == "f" else 0, values.dtype)
            chunk[tuple(map(slice, part.shape))] = part
        yield at, codec().encode(np.ascontiguousarray(chunk))


def chunk_name(name: str, at: tuple[int, ...]) -> str:
    """Member that holds a chunk of an array."""
    return ".".join([f"{name}/c", *map(str, at)])


@cache
def codec() -> Any:
    """Codec of all chunks."""
    from numcodecs import blosc

    blosc.use_threads = False  # workers have a core each
    return blosc.Blosc(cname="lz4", clevel=5, shuffle=blosc.SHUFFLE)


def _edges(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape of the chunks of an array."""
    if math.prod(shape) <= CHUNK**2:
        return tuple(max(n, 1) for n in shape)
    if sum(n > CHUNK for n in shape) == 1:  # a long list, cut along its length
        longest = max(shape)
        return tuple(n if n < longest else max(CHUNK**2 // (math.prod(shape) // n), 1) for n in shape)
    return tuple(min(n, CHUNK) for n in shape)
