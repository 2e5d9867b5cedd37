"""Arrays of one artifact: their digest, and a zarr 3 group written once and read lazily.

The output digest is taken over the *decoded* arrays (type, shape, little-endian bytes, one NaN) and the metadata: a
change of codec or of chunking changes no key, and an upstream change that does not change a result stops there.

Chunks are lz4-compressed with byte shuffle and carry a crc32c that is checked on every read; ``dimension_names``,
``units`` and ``long_name`` are set, so ``xarray.open_zarr`` reads an artifact's folder as it is. Members of a family
(``level_*``) differ in size, so their dimensions are told apart by the member's suffix (``row_0``, ``row_1`` ...).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

from pipeline.engine.keys import canonical, digest
from pipeline.engine.store import cf_coordinates
from stages.core.declare import AnyArray, Array, Bundle, Stage
from stages.core.errors import RilleError

CHUNK = 1024
"""Greatest chunk edge, cells: 4 MB of float32, so that a usual image is a few files to write and to sync."""


SYNCS = 8
"""Files flushed at once."""


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
    import zarr
    from zarr.storage import MemoryStore

    chunks: dict[str, Any] = {}
    attributes = {"stage": stage.name, "source": cf_coordinates.source(stage), "meta": dict(bundle.meta)}
    # in memory first: zarr hands each small file over to a thread of its own, which takes longer than to write it
    group = zarr.create_group(store=MemoryStore(chunks), zarr_format=3, attributes=attributes)
    lattice = cf_coordinates.lattice_of(bundle.meta)
    described = {name: _add(group, name, stage, bundle, lattice) for name in sorted(bundle.arrays)}
    if lattice is not None and bundle.arrays:
        for name, (values, dims, attrs) in cf_coordinates.coordinates(
            lattice, str(bundle.meta.get("frame", ""))
        ).items():
            at = group.create_array(
                name, shape=values.shape, dtype="<f8", dimension_names=dims, attributes={**attrs},
                chunk_key_encoding={"name": "default", "separator": "."},
            )  # fmt: skip
            at[...] = values
    return {name: chunk.to_bytes() for name, chunk in chunks.items()}, described


def _add(group: Any, name: str, stage: Stage, bundle: Bundle, lattice: Any) -> dict[str, Any]:
    """Write one array into a group; its description."""
    from zarr.codecs import BloscCodec, Crc32cCodec

    array = np.asarray(bundle.arrays[name])
    about = _describe(name, array, next(a for a in stage.outputs if a.matches(name)))
    written = group.create_array(
        name,
        shape=array.shape,
        dtype=array.dtype.newbyteorder("<"),
        chunks=tuple(min(max(n, 1), CHUNK) for n in array.shape),
        compressors=(BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()),
        fill_value=np.nan if array.dtype.kind == "f" else 0,
        dimension_names=about["dims"],
        chunk_key_encoding={"name": "default", "separator": "."},  # no folders within, which would need flushing
        attributes={k: about[k] for k in ("units", "long_name", "nodata", "frame") if about[k]}
        | cf_coordinates.attributes(name, about, bundle.arrays, lattice),
        config={"write_empty_chunks": True},  # so that a missing chunk is always damage
    )
    written[...] = array
    return about


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


def spill(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files below a folder that is there, and flush them and all folders to the disk."""
    within = sorted({folder / parent for name in files for parent in Path(name).parents})
    for place in within[1:]:
        place.mkdir()
    pool = _writers(os.getpid())  # the file system takes those that wait together
    under_way = [pool.submit(_write, folder / name, data) for name, data in files.items()]
    try:
        for one in under_way:
            one.result()
        under_way = [pool.submit(fsync, place) for place in within]
        for one in under_way:
            one.result()
    finally:
        wait(under_way)  # none may come after what the caller clears away


@lru_cache(maxsize=1)
def _writers(process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(SYNCS)


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def fsync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def checksum(data: bytes) -> str:
    """CRC32C, 8 hexadecimal digits."""
    return f"{google_crc32c.value(data):08x}"


def crc32c(path: Path) -> str:
    """Checksum of a file."""
    return checksum(path.read_bytes())


def damage(folder: Path | str, files: Mapping[str, list[Any]], checksums: Callable[[str], bool]) -> str:
    """What is wrong with the files of an artifact, in words; empty if nothing.

    Sizes are always compared, contents where ``checksums(relative path)`` says so.
    """
    for name, (size, crc) in files.items():
        if wrong := resized(str(folder), {name: size}):
            return wrong
        try:
            if checksums(name) and crc32c(Path(folder, name)) != crc:
                return f"{name} has another checksum"
        except (FileNotFoundError, NotADirectoryError):
            return f"{name} is missing"
    return ""


def resized(folder: str, files: Mapping[str, int]) -> str:
    """The first file that has not the given size, in words; empty if there is none."""
    for name, size in files.items():
        try:
            found = os.stat(f"{folder}/{name}").st_size
        except (FileNotFoundError, NotADirectoryError):
            return f"{name} is missing"
        if found != size:
            return f"{name} has {found} bytes instead of {size}"
    return ""


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
    """Arrays of an artifact, each read at its first access; ``damaged(reason)`` is called before the error."""

    def __init__(self, folder: Path, manifest: Mapping[str, Any], damaged: Callable[[str], None]) -> None:
        self._folder = folder
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
            self._loaded[name] = self._read(name, (...,))
        return self._loaded[name]

    def anew(self) -> LazyArrays:
        """The same arrays, of which nothing is read yet and held."""
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
        files = {f: v for f, v in self._manifest["files"].items() if f.startswith(f"{name}/")}
        values, wrong = self._load(name, files, window)
        if not wrong:
            return values
        self._damaged(wrong)
        raise DamagedError(
            "RIL-504",
            f"artifact {self._manifest['label']} ({self._manifest['stage']}) is damaged, {wrong}; it was set aside",
            remedy="run again: it will be recomputed",
        )

    def _load(self, name: str, files: Mapping[str, list[Any]], window: tuple[Any, ...]) -> tuple[AnyArray, str]:
        """Values of a part of an array, and what is wrong with its files, in words."""
        import zarr
        from zarr.storage import LocalStore

        nothing: AnyArray = np.empty(0)
        if wrong := damage(self._folder, files, lambda file: file.endswith("zarr.json")):
            return nothing, wrong
        try:
            array = zarr.open_array(store=LocalStore(self._folder / name, read_only=True), mode="r")
            values = np.asarray(array[window])
            # zarr fills in for a chunk that has gone while it read (by clearing up, say) without a word
            return values, damage(self._folder, files, lambda _: False)
        except Exception as error:  # a chunk's own checksum, and whatever a vanishing file leads to
            wrong = damage(self._folder, files, lambda _: True)
            if not wrong:
                raise
            return nothing, f"{wrong} ({type(error).__name__} on reading)"
