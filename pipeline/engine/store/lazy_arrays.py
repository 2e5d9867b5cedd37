"""Arrays of an artifact, each read at its first access; the CRC-32 of each member is compared at every reading."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rille.pipeline.engine.store.archive import Archive, BrokenError
from rille.pipeline.engine.store.manifest import Manifest
from rille.pipeline.engine.store.zarr_group import chunk_name, codec
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import RilleError

if TYPE_CHECKING:
    from rille.pipeline.engine.store.base import Store


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
