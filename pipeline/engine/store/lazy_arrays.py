"""Arrays of an artifact, each read at its first access.

The crc32c of each member is in the manifest and is compared on every read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from rille.pipeline.engine.store.manifest import checksum
from rille.pipeline.engine.store.zarr_group import CHUNK, chunk_name, codec
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import RilleError


class DamagedError(RilleError):
    """Files of an artifact are missing or do not have the recorded size or checksum."""


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
    """Arrays of an artifact, each read at its first access.

    ``damaged(reason)`` is called before the error, and says whether the artifact is out of the way.
    """

    def __init__(self, read: Read, manifest: Mapping[str, Any], damaged: Callable[[str], bool]) -> None:
        self._fetch = read
        self._manifest = manifest
        self._damaged = damaged
        self._loaded: dict[str, AnyArray] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._manifest["arrays"])

    def __len__(self) -> int:
        return len(self._manifest["arrays"])

    def __contains__(self, name: object) -> bool:
        return name in self._manifest["arrays"]

    def __getitem__(self, name: str) -> AnyArray:
        if name not in self._loaded:
            self._loaded[name] = self.part(name, (...,))
        return self._loaded[name]

    def anew(self) -> LazyArrays:
        """Return a copy that has read none of its arrays yet."""
        other = copy(self)
        other._loaded = {}
        return other

    def part(self, name: str, window: tuple[Any, ...]) -> AnyArray:
        """Part of an array, which is not kept: only the chunks that hold it are read.

        Raises
        ------
        DamagedError
            One of them is not as it was written; the artifact is set aside, if the cache can be written.
        """
        if name not in self:
            raise KeyError(f"{self._manifest['stage']} has no array {name!r}, only {', '.join(self) or 'metadata'}")
        import zarr

        try:
            whole = self._one_chunk(name)
            if whole is not None:
                return whole if window == (...,) else whole[window].copy()
            store = _reading(lambda key: self._member(f"{name}/{key}"))
            array = zarr.open_array(store=store, mode="r")
            found = self._manifest["arrays"][name]
            # Its own description is the archive's, and may claim any size; that of the manifest was looked at.
            if [list(array.shape), array.dtype.str] != [found["shape"], found["dtype"]]:
                raise _WrongError(f"{name} is described in two ways")
            return np.asarray(array[window])
        except _WrongError as error:
            wrong = str(error)
        aside = self._damaged(wrong)
        found = "was set aside" if aside else "stays, for the cache cannot be written"
        raise DamagedError(
            "RIL-504",
            f"artifact {self._manifest['label']} ({self._manifest['stage']}) is damaged, {wrong}; it {found}",
            remedy="run again: it will be recomputed" if aside else "choose another folder with --cache",
        )

    def raster(self, name: str) -> LazyRaster:
        """An array that is read by window, each time anew."""
        if name not in self:
            raise KeyError(f"{self._manifest['stage']} has no array {name!r}")
        return LazyRaster(self, name, tuple(self._manifest["arrays"][name]["shape"]))

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
        if about["chunk_grid"] != grid or [step["name"] for step in about["codecs"]] != ["bytes", "blosc"]:
            return None
        data = self._member(chunk_name(name, (0,) * len(found["shape"])))
        if data is None:
            return None
        array = np.empty(found["shape"], np.dtype(found["dtype"]))
        if int.from_bytes(data[4:8], "little") != array.nbytes:  # header of blosc
            raise _WrongError(f"{name} has another size")
        codec().decode(data, array)
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


def _reading(member: Callable[[str], bytes | None]) -> Any:
    """A store of zarr's that asks for each member when it is read: of a window, only the chunks that it touches."""
    from zarr.core.buffer import cpu
    from zarr.storage import MemoryStore

    class Reading(MemoryStore):
        async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
            data = member(key)
            return None if data is None else cpu.Buffer.from_bytes(data)

    return Reading(read_only=True)
