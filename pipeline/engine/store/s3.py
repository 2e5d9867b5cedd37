"""Artifacts in a bucket of an S3-compatible server: the same commit as on disk, with few requests.

Objects below the prefix::

    manifests/<stage>/<key>.json        the only commit point: written with If-None-Match: *
    data/<stage>/<key>/a-<unique>/      one attempt: an immutable zarr 3 group
    index/<digest>.json.gz              manifests that a run used: what it read, and that it used them
    quarantine/...                      manifests of damaged artifacts, with the reason
    rille.json                          the server was tried (pipeline.engine.store.s3_client)

All objects of an attempt are there before its manifest is written, and a manifest names each with size and crc32c,
which are compared with every object read. Killed at any instant, a run leaves a whole artifact or an orphan that nobody
reads. A writer that does not know whether its manifest arrived leaves its attempt to clearing up. A look-up trusts the
manifest and does not ask for each object: an object store writes whole objects only, and what was deleted from outside
is found when it is read, set aside and computed again, or by :func:`pipeline.engine.store.s3_maintenance.verify`.

A survey lists the manifests (a request a thousand) and takes what they say from the indices of the last runs, where the
ETag is the same: a run that finds everything asks four times, however many artifacts there are.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import time
import uuid
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.engine.store.artifact import LazyArrays, checksum
from pipeline.engine.store.folder import (
    USED,
    Manifest,
    Ref,
    Store,
    StoreError,
    frame,
    parsed,
    reference,
    sound,
    unframe,
)
from pipeline.engine.store.location import hints_folder
from pipeline.engine.store.s3_client import Bucket, BucketError, Entry, OddNameError, connect
from stages.core.declare import AnyArray

MOST_UNPACKED = 256_000_000
"""Bytes of an index; one of a hundred thousand artifacts has less, and a small object may unpack to any size."""

INDICES = 8
"""Indices read by a survey, the newest."""


class ObjectStore(Store):
    """Artifacts at ``s3://bucket/prefix``; see :class:`~pipeline.engine.store.folder.Store`."""

    def __init__(self, url: str) -> None:
        super().__init__(hints_folder(url))
        self.location = url
        self.bucket = connect(url)
        self._listed: dict[str, str] | None = None
        """ETags of the manifests that were there at the survey."""
        self._known: dict[str, tuple[str, Manifest]] = {}
        """Manifests with their ETags, by path."""
        self._indices: dict[str, Entry] = {}

    # -- looking up ---------------------------------------------------------------------------------------------

    def survey(self, sequence: str) -> None:
        """List the manifests, and read the newest indices (a copy of each is kept on this machine)."""
        try:
            self._listed = {e.path: e.etag for e in self.bucket.list("manifests")}
            self._indices = {e.path: e for e in self.bucket.list("index")}
        except OddNameError:
            return  # then each manifest is asked for
        for entry in sorted(self._indices.values(), key=lambda e: -e.modified)[:INDICES]:
            for path, (etag, manifest) in self._index(entry.path).items():
                if self._listed.get(path) == etag:
                    self._known.setdefault(path, (etag, manifest))

    def writable(self) -> None:
        """The server says so at the first commit."""

    def _index(self, path: str) -> dict[str, tuple[str, Manifest]]:
        """A damaged index counts as empty, as does a damaged copy."""
        copy = self.root / path
        with suppress(OSError, ValueError):
            return _unpack(path, copy.read_bytes())
        found = self.bucket.get(path)
        with suppress(OSError, ValueError):
            if found is not None:
                index = _unpack(path, found[0])
                _keep(copy, found[0])
                return index
        return {}

    def _fetch(self, path: str) -> Manifest | None:
        """Read a manifest. Raises ValueError where its content is not what was written."""
        found = self.bucket.get(path)
        if found is None:
            self._known.pop(path, None)
            return None
        manifest = unframe(found[0])
        self._known[path] = (found[1], manifest)
        return manifest

    def _find(self, path: str, fresh: bool = False) -> Manifest | None:
        if not fresh and path in self._known:
            return self._known[path][1]
        if not fresh and self._listed is not None and path not in self._listed:
            return None
        return self._fetch(path)

    def lookup(self, stage: str, key: str, *, fresh: bool = False) -> Ref | None:
        """The artifact of a key, as of the survey if there was one and not ``fresh``."""
        try:
            manifest = self._find(manifest_path(stage, key), fresh)
        except ValueError:
            self.set_aside(stage, key, None, "the manifest is not readable")
            return None
        return None if manifest is None else reference(manifest)

    def manifest(self, stage: str, key: str) -> Manifest | None:
        """Manifest of a key; None if absent or not readable."""
        try:
            return self._find(manifest_path(stage, key))
        except ValueError:
            return None

    def note(self, refs: Iterable[Ref]) -> None:
        """Write an index of what a run used, unless the same was written within the hour. Best effort."""
        paths = sorted({manifest_path(ref.stage, ref.key) for ref in refs})
        with suppress(BucketError, ValueError):  # the credentials may permit reading alone
            for path, found in self.bucket.get_all(p for p in paths if p not in self._known).items():
                if found is not None:
                    self._known[path] = (found[1], unframe(found[0]))
            name, data = _pack({p: self._known[p] for p in paths if p in self._known})
            before = self._indices.get(name)
            if before is None or before.modified < time.time() - USED:
                self.bucket.put(name, data)
                with suppress(OSError):
                    _keep(self.root / name, data)

    # -- reading ------------------------------------------------------------------------------------------------

    def path(self, ref: Ref) -> Path:
        """Artifacts here are not files."""
        raise StoreError(
            "RIL-557", f"{ref.path} is in {self.location}, not in a folder", remedy="open it with zarr and obstore"
        )

    def _current(self, ref: Ref) -> Manifest | None:
        path = manifest_path(ref.stage, ref.key)
        with suppress(ValueError):
            return self._known[path][1] if path in self._known else self._fetch(path)
        return None

    def _arrays(self, manifest: Manifest, damaged: Callable[[str], None]) -> LazyArrays:
        return RemoteArrays(self.bucket, manifest, damaged)

    # -- writing ------------------------------------------------------------------------------------------------

    def _write(self, manifest: Manifest, files: Mapping[str, bytes]) -> Manifest | None:
        manifest["path"] = f"data/{manifest['stage']}/{manifest['key']}/a-{uuid.uuid4().hex[:16]}"
        objects = {f"{manifest['path']}/{name}": data for name, data in files.items()}
        try:
            self.bucket.put_all(objects)
        except BaseException:
            self._discard(objects)
            raise
        there = self._create(manifest, frame(manifest))
        if there is not None:
            self._discard(objects)
        return there

    def _create(self, manifest: Manifest, framed: bytes) -> Manifest | None:
        """Write the manifest unless there is one; returns the one that was there before, if any."""
        stage, key = manifest["stage"], manifest["key"]
        path = manifest_path(stage, key)
        for _ in range(3):
            if self.bucket.create(path, framed):
                return None
            try:
                there = self._fetch(path)
            except ValueError:
                self.set_aside(stage, key, None, "the manifest is not readable")
                continue
            if there is not None:  # it may be this one, whose first answer was lost
                return None if there["path"] == manifest["path"] else there
        raise StoreError(
            "RIL-558", f"cannot publish {path} in {self.location}", remedy="remove that object and run again"
        )

    def _discard(self, objects: Iterable[str]) -> None:
        with suppress(BucketError):
            self.bucket.delete(objects)

    def set_aside(self, stage: str, key: str, manifest: Manifest | None, reason: str) -> None:
        """Take the manifest of a damaged artifact away; its objects stay as an orphan. Best effort.

        Another run may have done so before, and have published a sound one meanwhile: that one stays.
        """
        path = manifest_path(stage, key)
        self._known.pop(path, None)
        if self._listed is not None:
            self._listed.pop(path, None)
        with suppress(BucketError):
            found = self.bucket.get(path)
            if found is None:
                return
            with suppress(ValueError):
                if manifest is None or unframe(found[0])["path"] != manifest["path"]:
                    return
            name = f"quarantine/{stage}-{key[:16]}-{uuid.uuid4().hex[:8]}"
            self.bucket.put_all({f"{name}/manifest.json": found[0], f"{name}/reason.txt": f"{reason}\n".encode()})
            self.bucket.delete([path])


class RemoteArrays(LazyArrays):
    """Arrays of an artifact in a bucket."""

    def __init__(self, bucket: Bucket, manifest: Mapping[str, Any], damaged: Callable[[str], None]) -> None:
        super().__init__(Path(manifest["path"]), manifest, damaged)
        self._bucket = bucket

    def _load(self, name: str, files: Mapping[str, list[Any]], window: tuple[Any, ...]) -> tuple[AnyArray, str]:
        import zarr

        def fetch(key: str) -> bytes | None:
            file = f"{name}/{key}"
            if file not in files:
                return None
            found = self._bucket.get(f"{self._manifest['path']}/{file}")
            data = None if found is None else found[0]
            if wrong := damaged_objects({file: files[file]}, {file: data}):
                raise _WrongError(wrong)
            return data

        try:
            array = zarr.open_array(store=_reading(fetch), mode="r")
            return np.asarray(array[window]), ""
        except _WrongError as error:
            return np.empty(0), str(error)


class _WrongError(Exception):
    """What is wrong with an object."""


def _reading(fetch: Callable[[str], bytes | None]) -> Any:
    """A store of zarr's that asks for each object when it is read: of a window, only the chunks that it touches."""
    import asyncio

    from zarr.core.buffer import cpu
    from zarr.storage import MemoryStore

    class Reading(MemoryStore):
        async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
            data = await asyncio.to_thread(fetch, key)  # several at once
            return None if data is None else cpu.Buffer.from_bytes(data)

    return Reading(read_only=True)


def manifest_path(stage: str, key: str) -> str:
    """Object whose being there makes an artifact."""
    return f"manifests/{stage}/{key}.json"


def damaged_objects(files: Mapping[str, list[Any]], contents: Mapping[str, bytes | None]) -> str:
    """What is wrong with the objects of an artifact, in words; empty if nothing."""
    for name, (size, crc) in files.items():
        data = contents[name]
        if data is None:
            return f"{name} is missing"
        if len(data) != size:
            return f"{name} has {len(data)} bytes instead of {size}"
        if checksum(data) != crc:
            return f"{name} has another checksum"
    return ""


def _pack(index: dict[str, tuple[str, Manifest]]) -> tuple[str, bytes]:
    """Name and content of an index; equal ones have one name."""
    name = hashlib.sha256(json.dumps([[path, etag] for path, (etag, _) in index.items()]).encode()).hexdigest()[:32]
    data = json.dumps(index).encode()
    return f"index/{name}.json.gz", gzip.compress(hashlib.sha256(data).digest() + data, 5, mtime=0)


def _unpack(path: str, packed: bytes) -> dict[str, tuple[str, Manifest]]:
    """Raises ValueError or OSError where it is damaged."""
    unpacker = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    try:
        data = unpacker.decompress(packed, MOST_UNPACKED)
    except zlib.error as error:
        raise ValueError(f"{path} is damaged: {error}") from None
    if not unpacker.eof:
        raise ValueError(f"{path} is cut short, or unpacks to more than {MOST_UNPACKED} bytes")
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        raise ValueError(f"{path} is damaged")
    index = parsed(data[32:])
    try:
        return {name: (str(etag), sound(manifest)) for name, (etag, manifest) in index.items()}
    except (TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from None


def _keep(copy: Path, data: bytes) -> None:
    copy.parent.mkdir(parents=True, exist_ok=True)
    temporary = copy.with_name(f"{copy.name}.{os.getpid()}.tmp")
    temporary.write_bytes(data)
    temporary.replace(copy)
