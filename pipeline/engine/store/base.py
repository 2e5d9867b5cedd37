"""Content-addressed store of artifacts: look-up, commit, quarantine.

Files in the cache folder::

    artifacts/<stage>/<k>/<key>.zarr.zip    an artifact, one file; <k> are the key's first two digits
    quarantine/<stage>-<key>-<unique>*      a damaged artifact, and the reason, set aside
    hints/<sequence>/                       of its earlier runs, for explanations and plans; never a matter
                                            of correctness
    roots/<digest>.json                     folders of runs that use the cache

The file of an artifact (:mod:`rille.pipeline.engine.store.artifact`) is its own commit: it is on the disk as a whole
before it gets its name, and gets it only if nobody has it (a link). Killed at any instant, a run leaves a whole
artifact or none. If two runs commit one key, the second result is compared and dropped: another digest is a
:class:`NonDeterministicError`. Checksums of what is read are compared at each reading, and all of them by
:func:`rille.pipeline.engine.store.maintenance.verify`. What is damaged is set aside, counts as absent and is computed
again.
"""

from __future__ import annotations

import errno
import json
import os
import re
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rille.pipeline.engine.failures import CLOSED, FULL, remedy_of
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store import artifact
from rille.pipeline.engine.store.arrays import LazyArrays, array_digests, encode, output_digest
from rille.pipeline.engine.store.artifact import Archive, BrokenError, Manifest, Ref, artifact_path
from rille.stages.core.declare import Bundle, Stage
from rille.stages.core.errors import ConfigError, RilleError


class StoreError(RilleError):
    """The cache cannot be read or written."""


def locate(cache: Path | str) -> Path:
    """Folder of a cache.

    Raises
    ------
    ConfigError
        It is a URL; the message does not repeat what may be a password.
    """
    if re.match(r"\w+:/", str(cache)):  # a Path has lost the second slash
        text = f"a cache at {str(cache).partition(':')[0]}:// is not supported"
        raise ConfigError("RIL-546", text, remedy="give --cache a folder; machines share one by NFS, say")
    return Path(cache)


@contextmanager
def clear_errors(root: Path) -> Iterator[None]:
    """Raise as a :class:`StoreError` where the disk below ``root`` is full, or refuses; other errors may be passing."""
    try:
        yield
    except OSError as error:
        if error.errno not in (*FULL, *CLOSED, errno.ENOTDIR):
            raise
        text = f"the cache {root} cannot be used ({os.strerror(error.errno)})"
        raise StoreError("RIL-575", text, remedy=remedy_of(error.errno)) from error


def files(root: Path, area: str) -> list[tuple[str, os.stat_result]]:
    """All files below a folder in ``root``: their paths relative to ``root``, in order, and their status."""
    listed = []
    for folder, _, names in os.walk(root / area):
        for path in (Path(folder, name) for name in names):
            with suppress(OSError):  # gone meanwhile
                listed.append((path.relative_to(root).as_posix(), path.lstat()))
    return sorted(listed)


def quarantine(path: Path, root: Path, name: str) -> Path:
    """Move a file aside; its new path, whose name begins with ``name``."""
    aside = root / "quarantine" / f"{name}-{uuid.uuid4().hex[:8]}"
    aside.parent.mkdir(parents=True, exist_ok=True)
    os.rename(path, aside)
    return aside


class NonDeterministicError(RilleError):
    """A stage gave two different results for one key."""


def not_deterministic(stage: str, label: str, what: str = "digest") -> NonDeterministicError:
    """The error of a task whose results differ by ``what``."""
    text = f"stage {stage} is not deterministic: {label} gave another {what} than before"
    return NonDeterministicError("RIL-577", text)


class GoneError(StoreError):
    """An artifact that was there has gone: cleared away, or set aside as damaged by another run."""


class Store:
    """Artifacts in a folder, ``root``, by which another process opens the same store; the first commit makes it.

    Raises
    ------
    ConfigError
        The cache is no folder but a URL.
    """

    def __init__(self, cache: Path | str) -> None:
        self.root = locate(cache).absolute()

    def hints(self, sequence: str) -> Path:
        """Folder of what earlier runs of a sequence leave for explanations and plans."""
        # No name leads out of the folder.
        return self.root / "hints" / (quote(sequence, safe="").replace(".", "%2E") or "-")

    def writable(self) -> None:
        """Raise if nothing can be written here.

        Raises
        ------
        StoreError
            The folder cannot be made, is full or may not be written.
        """
        with clear_errors(self.root):
            (self.root / "artifacts").mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.root) as file:
                file.write(b"\0" * 4096)  # an empty file fits on a full disk
                file.flush()

    def lookup(self, stage: str, key: str, *, use: bool = True) -> Ref | None:
        """The artifact of a key; one whose manifest is damaged, or whose file has no end, is set aside and counts as
        absent.

        With ``use`` clearing up leaves it alone from now on.
        """
        path = f"{self.root}/{artifact_path(stage, key)}"  # no Path: a plan asks tens of thousands of times
        # Without the rights for it nobody clears it up; if it has just gone, that is seen below.
        with suppress(OSError):
            # Age of a file that a look-up touches, seconds: well below the grace of clearing up, which spares what was
            # touched
            if use and os.stat(path).st_mtime < time.time() - 3600.0:
                os.utime(path)
        try:
            return artifact.reference(self.read_manifest(stage, key))
        except FileNotFoundError:
            return None
        except BrokenError as error:
            self.set_aside(stage, key, str(error))
            return None

    def manifest(self, stage: str, key: str) -> Manifest | None:
        """Manifest of a key as it was committed, no check of the arrays; None if absent or not readable."""
        try:
            return self.read_manifest(stage, key)
        except (OSError, BrokenError, StoreError):
            return None

    def read_manifest(self, stage: str, key: str) -> Manifest:
        """Manifest of a key.

        Raises
        ------
        BrokenError, FileNotFoundError
            It is not readable; there is none.
        """
        with clear_errors(self.root):
            return artifact.read_manifest(f"{self.root}/{artifact_path(stage, key)}", stage, key)

    @contextmanager
    def opened(self, stage: str, key: str) -> Iterator[Archive]:
        """The file of an artifact, open for reading; errors as those of :meth:`read_manifest`."""
        with clear_errors(self.root), artifact.opened(f"{self.root}/{artifact_path(stage, key)}") as file:
            yield file

    def open(self, ref: Ref) -> Bundle:
        """The bundle behind a reference; each array is read, and its chunks' checksums compared, at first access.

        Raises
        ------
        GoneError
            The artifact has gone since it was looked up.
        """
        made = self.manifest(ref.stage, ref.key)
        if made is None or made["digest"] != ref.digest:
            text = f"artifact {ref.stage} {ref.key[:12]} has gone from {self.root}"
            raise GoneError("RIL-572", text, remedy="run again")
        return Bundle(LazyArrays(self, made), made["meta"])

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
        members, arrays = encode(stage, bundle)
        made: Manifest = {
            "stage": stage.name,
            "label": label,
            "key": key,
            "digest": digest,
            "arrays": {name: {**about, "sha256": digests[name]} for name, about in arrays.items()},
            "meta": json.loads(json.dumps(bundle.meta)),
            "provenance": dict(provenance or {}),
        }
        content = artifact.pack({artifact.MANIFEST: json.dumps(made, allow_nan=False).encode(), **members})
        path = artifact_path(stage.name, key)
        # Another process may publish, damage or remove the same artifact between any two of these steps.
        for _ in range(3):
            with clear_errors(self.root):
                if atomic.create(self.root / path, content):
                    return artifact.reference(made)
            there = self.lookup(stage.name, key)  # a damaged one is set aside
            if there is not None and there.digest == digest:
                return there
            old = self.manifest(stage.name, key)
            if there is not None and old is not None:
                raise not_deterministic(stage.name, label or key[:12], artifact.difference(made, old))
        raise StoreError("RIL-573", f"cannot publish {path} in {self.root}", remedy="remove that file and run again")

    def set_aside(self, stage: str, key: str, reason: str) -> bool:
        """Move a damaged artifact out of the way; False: it stays, for the cache may be read-only."""
        try:
            aside = quarantine(self.root / artifact_path(stage, key), self.root, f"{stage}-{key[:16]}")
        except OSError as error:
            return isinstance(error, FileNotFoundError)  # another run has set it aside
        with suppress(OSError):
            atomic.write(aside.with_suffix(".txt"), f"{reason}\n")
        return True
