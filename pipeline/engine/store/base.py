"""Content-addressed store of artifacts: look-up, commit, quarantine.

Files in the cache folder::

    artifacts/<stage>/<k>/<key>.zarr.zip    an artifact, one file; <k> are the key's first two digits
    quarantine/<stage>-<key>-<unique>.*     a damaged artifact, and the reason, set aside
    index/<sequence>/<digest>               what a run used (rille.pipeline.engine.store.index)
    rille.json                              the format
    hints/<sequence>/                       of its earlier runs, for explanations and estimates; never a matter
                                            of correctness
    roots/<digest>.json                     folders of runs that use the cache

The file of an artifact (:mod:`rille.pipeline.engine.store.manifest`) is its own commit: it is on the disk as a whole
before it gets its name, and gets it only if nobody has it (a link). Killed at any instant, a run leaves a whole
artifact or none. Of two that commit one key the second is compared and thrown away: another digest is a
:class:`NonDeterministicError`. The size of the file is compared at each look-up, checksums of what is read on each
reading, and all of them by :func:`rille.pipeline.engine.store.maintenance.verify`. What is damaged is set aside, counts
as absent and is computed again.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rille.datasets.text.warning import warning
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.store.folder import Folder, StoreError, locate
from rille.pipeline.engine.store.index import Index, folder_of
from rille.pipeline.engine.store.lazy_arrays import LazyArrays
from rille.pipeline.engine.store.manifest import (
    FIRST,
    Manifest,
    Ref,
    artifact_path,
    difference,
    length,
    pack,
    reference,
    unframe,
)
from rille.pipeline.engine.store.output_digest import array_digests, output_digest
from rille.pipeline.engine.store.zarr_group import encode
from rille.stages.core.declare import Bundle, Stage
from rille.stages.core.errors import RilleError


class NonDeterministicError(RilleError):
    """A stage gave two different results for one key."""


class GoneError(StoreError):
    """An artifact that was there has gone: cleared away, or set aside as damaged by another run."""


class Store:
    """Artifacts in a folder, ``root``, by which another process opens the same store.

    Raises
    ------
    ConfigError
        The cache is no folder but a URL.
    """

    def __init__(self, cache: Path | str) -> None:
        self.root = locate(cache).absolute()
        self.folder = Folder(self.root)
        self._index: Index | None = None

    def hints(self, sequence: str) -> Path:
        """Folder of what earlier runs of a sequence leave for explanations and estimates."""
        return self.root / "hints" / folder_of(sequence)

    def survey(self, sequence: str) -> None:
        """Before many look-ups: read the index of earlier runs, which spares the manifests of what it names.

        ``sequence`` names what runs over the same images, whatever their parameters.
        """
        if self.folder.earlier():
            text = f"artifacts of an earlier format in {self.root} are not read: 'rille cache gc' removes them"
            warn(warning("RIL-985", text))
        self._index = Index(self.folder, sequence)

    def note(self, refs: Iterable[Ref]) -> None:
        """Record, at the end of a run, which artifacts it used: for later look-ups and for ``gc``. Best effort."""
        if self._index is not None:
            with suppress(OSError, RilleError):  # it may permit reading alone
                self._index.note({ref.key: ref for ref in refs})

    def writable(self) -> None:
        """Raise if nothing can be written here.

        Raises
        ------
        StoreError
            The folder cannot be made, is full or may not be written.
        """
        self.folder.begin()

    def lookup(self, stage: str, key: str, *, fresh: bool = False, use: bool = True) -> Ref | None:
        """The artifact of a key, the size of its file checked; a damaged one is set aside and counts as absent.

        ``fresh`` does not rely on the index. With ``use`` clearing up leaves it alone from now on.
        """
        item = self.folder.status(artifact_path(stage, key))
        if item is None:
            return None
        known = None if fresh or self._index is None else self._index.get(stage, item, key)
        touched = self.folder.use(item) if use else item
        if touched is None:
            return None
        if known is not None:
            if touched.mark != item.mark and self._index is not None:
                self._index.forget(key)
            return known
        try:
            manifest = self._read_manifest(stage, key)
        except ValueError:
            self.set_aside(stage, key, None, "the manifest is not readable")
            return None
        if manifest is None:
            return None
        if item.size != manifest["size"]:
            self.set_aside(stage, key, manifest, f"it has {item.size} bytes instead of {manifest['size']}")
            return None
        return reference(manifest)

    def manifest(self, stage: str, key: str) -> Manifest | None:
        """Manifest of a key as it was committed, no check of the arrays; None if absent or not readable."""
        try:
            return self._read_manifest(stage, key)
        except (OSError, ValueError, StoreError):
            return None

    def _read_manifest(self, stage: str, key: str) -> Manifest | None:
        """Raises ValueError where the content is not what was written."""
        path = artifact_path(stage, key)
        line = self.folder.read(path, 0, FIRST)
        if line is None:
            return None
        size = length(line)
        if size > len(line):
            line += self.folder.read(path, len(line), size) or b""
        manifest = unframe(line[:size])
        if (manifest["stage"], manifest["key"]) != (stage, key):
            raise ValueError("the manifest is that of another artifact")
        return manifest

    def path(self, ref: Ref) -> str:
        """Return the address by which ``xarray.open_zarr`` opens an artifact."""
        return f"zip::{self.root / ref.path}"

    def open(self, ref: Ref) -> Bundle:
        """The bundle behind a reference; each array is read, and its chunks' checksums compared, at first access.

        Raises
        ------
        GoneError
            The artifact has gone since it was looked up.
        """
        manifest = self.manifest(ref.stage, ref.key)
        if manifest is None or manifest["digest"] != ref.digest:
            raise GoneError(
                "RIL-572", f"artifact {ref.stage} {ref.key[:12]} has gone from {self.root}", remedy="run again"
            )

        def damaged(reason: str) -> bool:
            return self.set_aside(ref.stage, ref.key, manifest, reason)

        def read(start: int, stop: int) -> bytes | None:
            return self.folder.read(ref.path, start, stop)

        return Bundle(LazyArrays(read, manifest, damaged), manifest["meta"])

    def commit(
        self, stage: Stage, key: str, bundle: Bundle, *, label: str = "", provenance: Mapping[str, Any] | None = None
    ) -> Ref:
        """Write a result and publish it under its key; what another one has published before stays.

        Raises
        ------
        NonDeterministicError
            The key is there already, with another digest.
        StoreError
            The disk is full or may not be written.
        """
        digests = array_digests(bundle.arrays)
        digest = output_digest(digests, bundle.meta)
        files, arrays = encode(stage, bundle)
        manifest: Manifest = {
            "stage": stage.name,
            "label": label,
            "key": key,
            "digest": digest,
            "attempt": uuid.uuid4().hex,
            "arrays": {name: {**about, "sha256": digests[name]} for name, about in arrays.items()},
            "meta": json.loads(json.dumps(bundle.meta)),
            "provenance": dict(provenance or {}),
        }
        pieces = pack(manifest, files)
        path = artifact_path(stage.name, key)
        # Another process may publish, damage or remove the same artifact between any two of these steps.
        for _ in range(3):
            if self.folder.create(path, pieces):
                return reference(manifest)
            # fresh: the index vouches for a file that nobody wrote since, which the disk may have damaged.
            there = self.lookup(stage.name, key, fresh=True)  # a damaged one is set aside
            if there is not None and there.digest == digest:
                return there
            old = self.manifest(stage.name, key)
            if there is not None and old is not None:
                raise NonDeterministicError("RIL-577", difference(label or key[:12], manifest, old))
        raise StoreError("RIL-573", f"cannot publish {path} in {self.root}", remedy="remove that file and run again")

    def set_aside(self, stage: str, key: str, manifest: Manifest | None, reason: str) -> bool:
        """Move a damaged artifact out of the way; False: it stays, for the cache may be read-only.

        Another run may have done so before, and have published a sound one meanwhile: that one stays.
        """
        path, aside = artifact_path(stage, key), f"quarantine/{stage}-{key[:16]}-{uuid.uuid4().hex[:8]}"
        with suppress(OSError, RilleError):
            with suppress(ValueError):
                found = self._read_manifest(stage, key)
                # Compare attempts, not keys: a sound artifact of the same key may have replaced the damaged one.
                if found is None or manifest is None or found["attempt"] != manifest["attempt"]:
                    return True
            self.folder.move(path, f"{aside}.zarr.zip")
            with suppress(OSError, RilleError):
                self.folder.write(f"{aside}.txt", f"{reason}\n".encode())
            return True
        return False
