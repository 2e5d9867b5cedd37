"""Arrays of one artifact: their digest, and a zarr 3 group written once and read lazily.

The output digest is taken over the *decoded* arrays (type, shape, little-endian bytes, one NaN) and the metadata: a
change of codec or of chunking changes no key, and an upstream change that does not change a result stops there.

Chunks are lz4-compressed with byte shuffle, and their crc32c in the manifest is compared on every read;
``dimension_names``, ``units`` and ``long_name`` are set, so ``xarray.open_zarr`` reads an artifact as it is. Members of
a family (``level_*``) differ in size, so their dimensions are told apart by the suffix (``row_0``, ``row_1`` ...).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rille.pipeline.engine.keys import canonical, digest
from rille.pipeline.engine.store import cf_coordinates
from rille.pipeline.engine.store.manifest import checksum
from rille.stages.core.declare import AnyArray, Array, Bundle, Stage
from rille.stages.core.errors import RilleError

CHUNK = 1024
"""Chunk edge, cells; an array of at most its square (4 MB of float32) is one chunk, whatever its shape."""


class DamagedError(RilleError):
    """Files of an artifact are missing or do not have the recorded size or checksum."""


def array_digests(arrays: Mapping[str, AnyArray]) -> dict[str, str]:
    """SHA-256 of each array: type, shape and little-endian bytes in C order, every NaN made the same."""
    return {name: _array_digest(name, np.asarray(arrays[name])) for name in sorted(arrays)}


def _array_digest(name: str, array: AnyArray) -> str:
    if array.dtype.kind not in "biuf":
        raise TypeError(f"array {name} is {array.dtype}: store integers, floats or booleans")
    little = array.dtype.newbyteorder("<")
    plain = np.ascontiguousarray(array, dtype=little)
    if array.dtype.kind == "f" and np.isnan(plain).any():
        # NaN has millions of bit patterns, and processors choose differently among them.
        plain = np.where(np.isnan(plain), little.type(np.nan), plain)
    total = hashlib.sha256(f"{little.str} {array.shape}\0".encode())
    total.update(plain.data)
    return total.hexdigest()


def output_digest(digests: Mapping[str, str], meta: Mapping[str, Any]) -> str:
    """Digest of a result: the digests of its arrays, and its metadata.

    Raises
    ------
    TypeError
        ``meta`` is not plain JSON (NaN and infinities are not either: use None).
    """
    _refuse_non_finite(meta, "meta")
    return digest({"arrays": dict(digests), "meta": dict(meta)})


def _refuse_non_finite(value: Any, where: str) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            _refuse_non_finite(item, f"{where}.{key}")
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            _refuse_non_finite(item, f"{where}[{i}]")
    elif isinstance(value, set | frozenset):
        raise TypeError(f"{where} is a set: give a sorted list")
    elif isinstance(value, float) and not np.isfinite(value):
        raise TypeError(f"{where} is {value}: metadata is JSON, use None for what is undefined")
    else:
        canonical(value, where)


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
    codec = _codec()
    # All chunks are written, those of the fill value too: a missing one is always damage.
    for at in np.ndindex(*(math.ceil(n / edge) for n, edge in zip(little.shape, edges, strict=True))):
        chunk = little[tuple(slice(i * edge, (i + 1) * edge) for i, edge in zip(at, edges, strict=True))]
        if chunk.shape != edges:  # all chunks of an array have one size: of the last ones a part is nothing
            part, chunk = chunk, np.full(edges, fill)
            chunk[tuple(map(slice, part.shape))] = part
        files[_chunk_name(name, at)] = codec.encode(np.ascontiguousarray(chunk))
    return node


def _chunk_name(name: str, at: tuple[int, ...]) -> str:
    return ".".join([f"{name}/c", *map(str, at)])


@cache
def _codec() -> Any:
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


@dataclass(frozen=True)
class LazyRaster:
    """An array of an artifact of which only the chunks are read that a window touches."""

    arrays: LazyArrays
    name: str
    shape: tuple[int, ...]

    def __getitem__(self, at: tuple[slice, ...]) -> AnyArray:
        """Values of slices."""
        return self.arrays.part(self.name, at)


Read = Callable[[int, int], bytes | None]
"""Bytes of an artifact's file from one offset to another; None if the file has gone."""


class LazyArrays(Mapping[str, AnyArray]):
    """Arrays of an artifact, each read at its first access; ``damaged(reason)`` is called before the error."""

    def __init__(
        self, read: Read, manifest: Mapping[str, Any], damaged: Callable[[str], None], *, slow: bool = False
    ) -> None:
        self._fetch = read
        self._manifest = manifest
        self._damaged = damaged
        self._slow = slow
        self._loaded: dict[str, AnyArray] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._manifest["arrays"])

    def __len__(self) -> int:
        return len(self._manifest["arrays"])

    def __contains__(self, name: object) -> bool:
        return name in self._manifest["arrays"]

    def __getitem__(self, name: str) -> AnyArray:
        if name not in self._loaded:
            self._loaded[name] = self._read(name, (...,))
        return self._loaded[name]

    def anew(self) -> LazyArrays:
        """Return a copy that has read none of its arrays yet."""
        other = copy(self)
        other._loaded = {}
        return other

    def part(self, name: str, window: tuple[Any, ...]) -> AnyArray:
        """Part of an array, which is not kept: only the chunks that hold it are read."""
        return self._read(name, window)

    def raster(self, name: str) -> LazyRaster:
        """An array that is read by window, each time anew."""
        if name not in self:
            raise KeyError(f"{self._manifest['stage']} has no array {name!r}")
        return LazyRaster(self, name, tuple(self._manifest["arrays"][name]["shape"]))

    def _read(self, name: str, window: tuple[Any, ...]) -> AnyArray:
        if name not in self:
            raise KeyError(f"{self._manifest['stage']} has no array {name!r}, only {', '.join(self) or 'metadata'}")
        import zarr

        try:
            whole = self._one_chunk(name)
            if whole is not None:
                return whole if window == (...,) else whole[window].copy()
            store = _reading(lambda key: self._member(f"{name}/{key}"), self._slow)
            return np.asarray(zarr.open_array(store=store, mode="r")[window])
        except _WrongError as error:
            wrong = str(error)
        self._damaged(wrong)
        raise DamagedError(
            "RIL-504",
            f"artifact {self._manifest['label']} ({self._manifest['stage']}) is damaged, {wrong}; it was set aside",
            remedy="run again: it will be recomputed",
        )

    def _one_chunk(self, name: str) -> AnyArray | None:
        """An array that is one chunk, as most are; None: it is not, or has other codecs than we write.

        zarr hands every reading over to a thread of its own, twice, which takes ten times as long.
        """
        found = self._manifest["arrays"][name]
        if math.prod(found["shape"]) > CHUNK**2:
            return None
        described = self._member(f"{name}/zarr.json")
        about = json.loads(described) if described is not None else {"chunk_grid": None, "codecs": []}
        grid = {"name": "regular", "configuration": {"chunk_shape": found["shape"]}}
        if about["chunk_grid"] != grid or [codec["name"] for codec in about["codecs"]] != ["bytes", "blosc"]:
            return None
        data = self._member(_chunk_name(name, (0,) * len(found["shape"])))
        if data is None:
            return None
        array = np.empty(found["shape"], np.dtype(found["dtype"]))
        if int.from_bytes(data[4:8], "little") != array.nbytes:  # header of blosc
            raise _WrongError(f"{name} has another size")
        _codec().decode(data, array)
        return array

    def _member(self, name: str) -> bytes | None:
        """Content of a member, compared with the manifest; None where zarr asks for one that there never was."""
        if name not in self._manifest["files"]:
            return None
        start, size, crc = self._manifest["files"][name]
        data = self._fetch(start, start + size)
        if data is None:
            raise _WrongError("its file is missing")
        if len(data) != size:
            raise _WrongError(f"{name} has {len(data)} bytes instead of {size}")
        if checksum(data) != crc:
            raise _WrongError(f"{name} has another checksum")
        return data


class _WrongError(Exception):
    """What is wrong with a member, in words."""


def _reading(member: Callable[[str], bytes | None], slow: bool) -> Any:
    """A store of zarr's that asks for each member when it is read: of a window, only the chunks that it touches."""
    import asyncio

    from zarr.core.buffer import cpu
    from zarr.storage import MemoryStore

    class Reading(MemoryStore):
        async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
            data = await asyncio.to_thread(member, key) if slow else member(key)
            return None if data is None else cpu.Buffer.from_bytes(data)

    return Reading(read_only=True)
