"""Arrays of one artifact: their digests, their form in the file, a zarr 3 group, and how they are read from it.

The digest of a result is over the *decoded* arrays (type, shape, little-endian bytes, one NaN) and the metadata. A
change of codec or of chunking changes no key, and an upstream change that does not change a result stops there.

The group is written once. Chunks are lz4-compressed with byte shuffle; ``dimension_names``, ``units`` and ``long_name``
are set, so ``xarray.open_zarr`` reads an artifact as it is. Members of a family (``level_*``) differ in size, so their
dimensions are told apart by the suffix (``row_0``, ``row_1`` ...).

An array (row, col) on the lattice that the metadata state has coordinates beside it, ``x`` (col) and ``y`` (row),
metres, of the cell centres, so that xarray knows where each cell is. Arrays of image pixels need none: pixel centres
are at integer (row, col), which is what xarray counts by itself. Coordinates follow from the metadata: they are no
outputs, and enter no digest.

Each array is read at its first access; the CRC-32 of each member is compared at every reading.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.store.artifact import Archive, BrokenError, Manifest
from rille.stages.core.declare import AnyArray, Bundle, Stage
from rille.stages.core.errors import RilleError
from rille.stages.geometry.lattice import Lattice

if TYPE_CHECKING:
    from rille.pipeline.engine.store.base import Store

DIMS = ["row", "col"]

Variable = tuple[AnyArray, list[str], dict[str, str]]
"""Values, names of the dimensions, and attributes."""

CHUNK = 1024
"""Chunk edge, cells; an array of at most its square (4 MB of float32) is one chunk, whatever its shape."""


def array_digests(arrays: Mapping[str, AnyArray]) -> dict[str, str]:
    """SHA-256 of each array: type, shape and little-endian bytes in C order, every NaN made the same."""
    return {name: _array_digest(name, np.asarray(arrays[name])) for name in sorted(arrays)}


def _array_digest(name: str, array: AnyArray) -> str:
    if array.dtype.kind not in "biuf":
        raise TypeError(f"array {name} is {array.dtype}: store integers, floats or booleans")
    little = array.dtype.newbyteorder("<")
    plain = np.ascontiguousarray(array, dtype=little)
    if array.dtype.kind == "f":
        # NaN has millions of bit patterns, and processors choose differently among them.
        bits, usual = (a.view(f"<u{little.itemsize}") for a in (plain, little.type(np.nan)))
        if (np.isnan(plain) & (bits != usual)).any():
            plain = np.where(np.isnan(plain), little.type(np.nan), plain)
    total = hashlib.sha256(f"{little.str} {array.shape}\0".encode())
    total.update(plain.data)
    return total.hexdigest()


def output_digest(digests: Mapping[str, str], meta: Mapping[str, Any]) -> str:
    """Digest of a result: the digests of its arrays, and its metadata.

    Raises
    ------
    TypeError
        ``meta`` is not plain JSON; a bundle's has None for NaN and infinities.
    """
    return digest({"arrays": dict(digests), "meta": dict(meta)}, "result")


def encode(stage: Stage, bundle: Bundle) -> tuple[dict[str, bytes], dict[str, Any]]:
    """A bundle as a zarr group: contents by relative path, and the type, shape and chunks of its arrays by name."""
    variables = {name: _variable(stage, name, bundle.arrays[name]) for name in sorted(bundle.arrays)}
    stored = {
        name: {"dtype": values.dtype.str, "shape": list(values.shape), "chunks": list(_edges(values.shape))}
        for name, (values, _, _) in variables.items()
    }
    variables |= located(variables, bundle.meta)
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


class DamagedError(RilleError):
    """The file of an artifact is missing, or is not as it was written."""


@dataclass(frozen=True)
class LazyRaster:
    """An array of an artifact of which only the chunks are read that a window touches."""

    arrays: LazyArrays
    name: str
    shape: tuple[int, ...]

    def __getitem__(self, at: tuple[slice, ...]) -> AnyArray:
        """Values of slices."""
        return self.arrays.part(self.name, at)


class LazyArrays(Mapping[str, AnyArray]):
    """Arrays of an artifact, each read at its first access."""

    def __init__(self, store: Store, manifest: Manifest) -> None:
        self._store = store
        self._manifest = manifest
        self._loaded: dict[str, AnyArray] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._manifest["arrays"])

    def __len__(self) -> int:
        return len(self._manifest["arrays"])

    def __contains__(self, name: object) -> bool:
        return name in self._manifest["arrays"]

    def __getitem__(self, name: str) -> AnyArray:
        if name not in self._loaded:
            self._loaded[name] = self.part(name, ())
        return self._loaded[name]

    def raster(self, name: str) -> LazyRaster:
        """An array that is read by window, each time anew."""
        return LazyRaster(self, name, tuple(self._manifest["arrays"][name]["shape"]))

    def part(self, name: str, window: tuple[slice, ...]) -> AnyArray:
        """Part of an array (slices without a step), which is not kept: only the chunks that hold it are read.

        Raises
        ------
        DamagedError
            One of them is not as it was written; the artifact is set aside, if the cache can be written.
        """
        stage, key, about = self._manifest["stage"], self._manifest["key"], self._manifest["arrays"][name]
        try:
            with self._store.opened(stage, key) as archive:
                return _read(archive, name, about, window)
        except FileNotFoundError:
            wrong = "its file is missing"
        except BrokenError as error:
            wrong = str(error)
        aside = self._store.set_aside(stage, key, wrong)
        outcome = "was set aside" if aside else "stays, for the cache cannot be written"
        text = f"artifact {self._manifest['label']} ({stage}) is damaged, {wrong}; it {outcome}"
        remedy = "run again: it will be recomputed" if aside else "choose another folder with --cache"
        raise DamagedError("RIL-504", text, remedy=remedy)


def _read(archive: Archive, name: str, about: Mapping[str, Any], window: tuple[slice, ...]) -> AnyArray:
    """Window of an array (all of each axis that it does not name), from the chunks that it touches.

    zarr would hand every reading over to a thread of its own, twice, which takes ten times as long.
    """
    edges, dtype = tuple(about["chunks"]), np.dtype(about["dtype"])
    slices = [*window, *[slice(None)] * (len(edges) - len(window))]
    spans = [range(n)[part] for n, part in zip(about["shape"], slices, strict=True)]
    values = np.empty([len(span) for span in spans], dtype)
    touched = [range(s.start // e, -(-s.stop // e) if s else 0) for s, e in zip(spans, edges, strict=True)]
    for at in itertools.product(*touched):
        # Blosc adds a header of 16 bytes.
        data = archive.member(chunk_name(name, at), math.prod(edges) * dtype.itemsize + 16)
        # First value of the window, counted from the first one of the chunk.
        shifts = [s.start - i * e for s, i, e in zip(spans, at, edges, strict=True)]
        exact = values.shape == edges and not any(shifts)
        chunk = values if exact else np.empty(edges, dtype)
        if int.from_bytes(data[4:8], "little") != chunk.nbytes:  # header of blosc
            raise BrokenError(f"{name} has another size")
        codec().decode(data, chunk)
        if not exact:
            target = tuple(slice(max(-d, 0), e - d) for d, e in zip(shifts, edges, strict=True))
            source = tuple(slice(max(d, 0), d + n) for d, n in zip(shifts, values.shape, strict=True))
            values[target] = chunk[source]
    return values
