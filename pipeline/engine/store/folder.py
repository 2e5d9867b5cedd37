"""Content-addressed store of artifacts on local disk: look-up, commit, quarantine, verification and clearing up.

Layout under the cache folder::

    artifacts/<stage>/<k>/<key>/manifest.json    the only commit point; <k> are the key's first two digits
    artifacts/<stage>/<k>/<key>/a-<unique>/      one attempt: an immutable zarr 3 group (xarray.open_zarr reads it)
    quarantine/<stage>-<key>-<unique>/           damaged artifacts, set aside
    hints/<sequence>/                            of its earlier runs, for explanations and estimates; never a matter
                                                 of correctness
    index/<sequence>                             what its last run found: spares reading manifests that nobody touched
    pins/<run>.json                              keys that clearing up leaves alone
    roots/<digest>.json                          folders of runs that use the cache

An attempt becomes an artifact when its manifest is linked into place, create-if-absent, after all its files are on
the disk. Killed at any instant, a run leaves either a whole artifact or an orphan that nobody reads. Of two that
commit one key the second is compared and thrown away: another digest is a :class:`NonDeterministicError`. A manifest
lists each file with size and crc32c. Sizes are checked at each look-up, checksums of chunks on each read and all of
them by :func:`pipeline.engine.store.maintenance.verify`. What is damaged is set aside, counts as absent and is
computed again.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import google_crc32c

from pipeline.engine.store.artifact import (
    LazyArrays,
    array_digests,
    checksum,
    encode,
    fsync,
    output_digest,
    resized,
    spill,
)
from pipeline.engine.store.index import Catalogue, Entry, status
from pipeline.engine.store.location import Location, locate
from stages.core.declare import Bundle, Stage
from stages.core.errors import RilleError

Manifest = dict[str, Any]

USED = 3600.0
"""Seconds after which a use is noted again: clearing up spares what was used within its grace."""

FILE = re.compile(r"(?!.*(^|/)\.\.?(/|$))[\w.-]+(/[\w.-]+)*")
"""A file of an artifact, relative to its attempt, and never above it."""

STAGE = r"\w+(?:\.\w+)*"
"""Name of a stage, as it stands in paths (``locus``, ``mockup.scene``)."""

NUMERIC = re.compile(r"[<>|][biufc]\d{1,2}")
"""NumPy's name of a type of numbers."""

_HEAD = b'{"crc32c": "%08x", "manifest": '
_HEAD_SIZE = len(_HEAD % 0)


class NonDeterministicError(RilleError):
    """A stage gave two different results for one key."""


class StoreError(RilleError):
    """The cache folder cannot be read or written."""


class GoneError(StoreError):
    """An artifact that was there has gone: cleared away, or set aside as damaged by another run."""


@dataclass(frozen=True)
class Ref:
    """A committed artifact: all that travels between tasks. ``path`` is relative to the store's root.

    ``nbytes`` are bytes of the decoded arrays, ``stored`` those of the files.
    """

    key: str
    stage: str
    digest: str
    path: str
    meta: Mapping[str, Any]
    nbytes: int = 0
    stored: int = 0


class Store:
    """Artifacts under ``root`` (made at the first commit).

    ``location`` is what another process opens the store by (:func:`at`). Of a store in a bucket ``root`` is the local
    folder of its hints.
    """

    location: Location

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root).absolute()
        self.location = self.root
        self._catalogue: Catalogue | None = None

    def __fspath__(self) -> str:
        return str(self.root)

    def hints(self, sequence: str) -> Path:
        """Folder of what earlier runs of a sequence leave for explanations and estimates."""
        name = quote(sequence, safe="").replace(".", "%2E")  # no name leads out of it
        return self.root / "hints" / (name or "-")

    def survey(self, sequence: str) -> None:
        """Before many look-ups: find out at once what is there, with few requests or readings.

        ``sequence`` names what runs over the same images, whatever their parameters.
        """
        self._catalogue = Catalogue.load(self.root / "index" / sequence)

    def note(self, refs: Iterable[Ref]) -> None:
        """At the end of a run: what it used, for later surveys."""
        if self._catalogue is None:
            return
        used = {ref.key: ref for ref in refs}
        for key, ref in used.items():
            if key not in self._catalogue.lines and key not in self._catalogue.found:
                with suppress(OSError, ValueError):
                    home = self._home(ref.stage, key)
                    self._enter(os.stat(f"{home}/manifest.json"), self._read_manifest(home))
        self._catalogue.save(used)

    def _enter(self, stat: os.stat_result, manifest: Manifest) -> Entry:
        """Of a manifest that was read after its status was taken."""
        nbytes, stored = sizes(manifest)
        files = {name: size for name, (size, _) in manifest["files"].items()}
        m = manifest
        entry = Entry(status(stat), m["digest"], m["path"], nbytes, stored, m["meta"], files)
        if self._catalogue is not None:
            self._catalogue.enter(m["key"], entry)
        return entry

    def lookup(self, stage: str, key: str, *, fresh: bool = False) -> Ref | None:
        """The artifact of a key, its file sizes checked; a damaged one is set aside and counts as absent.

        ``fresh`` does not rely on a survey.
        """
        entry = self._sound(stage, key)
        if entry is None:
            return None
        return Ref(key, stage, entry.digest, entry.path, entry.meta, entry.nbytes, entry.stored)

    def _sound(self, stage: str, key: str) -> Entry | None:
        home = self._home(stage, key)  # no Path: a plan looks tens of thousands up
        published, manifest = f"{home}/manifest.json", None
        try:
            with self._clear_errors():
                stat = os.stat(published)
                entry = None if self._catalogue is None else self._catalogue.get(key, status(stat))
                if entry is None:
                    manifest = self._read_manifest(home)
                    entry = self._enter(stat, manifest)
                if stat.st_mtime < time.time() - USED:  # only now: a touched manifest has another status
                    self._touch(key, published, entry)
        except FileNotFoundError:
            return None
        except ValueError:
            self.set_aside(stage, key, None, "manifest.json is not readable")
            return None
        wrong = resized(f"{self.root}/{entry.path}", entry.files)
        if wrong:
            self.set_aside(stage, key, manifest or self.manifest(stage, key), wrong)
            return None
        return entry

    def _touch(self, key: str, published: str, entry: Entry) -> None:
        """Note that an artifact is in use."""
        with suppress(OSError):  # a cache may be read-only
            os.utime(published)
            if self._catalogue is not None:
                self._catalogue.enter(key, replace(entry, status=status(os.stat(published))))

    def writable(self) -> None:
        """Raise if nothing can be written here.

        Raises
        ------
        StoreError
            The folder cannot be made, is full or may not be written.
        """
        with self._clear_errors():
            self.root.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.root, suffix=".tmp") as file:
                file.write(b"\0" * 4096)
                file.flush()

    def manifest(self, stage: str, key: str) -> Manifest | None:
        """Manifest of a key as it was committed, no check of the files; None if absent or not readable."""
        try:
            return self._read_manifest(self.home(stage, key))
        except (OSError, ValueError):
            return None

    def path(self, ref: Ref) -> Path:
        """Folder of the zarr group, for ``xarray.open_zarr(path)``."""
        return self.root / ref.path

    def open(self, ref: Ref) -> Bundle:
        """The bundle behind a reference; each array is read, and its chunks' checksums compared, at first access.

        Raises
        ------
        GoneError
            The artifact has gone since it was looked up.
        """
        manifest = self._current(ref)
        if manifest is None or manifest["digest"] != ref.digest:
            raise GoneError(
                "RIL-572", f"artifact {ref.stage} {ref.key[:12]} has gone from {self.location}", remedy="run again"
            )

        def damaged(reason: str) -> None:
            self.set_aside(ref.stage, ref.key, manifest, reason)

        return Bundle(self._arrays(manifest, damaged), manifest["meta"])

    def _current(self, ref: Ref) -> Manifest | None:
        return self.manifest(ref.stage, ref.key)

    def _arrays(self, manifest: Manifest, damaged: Callable[[str], None]) -> LazyArrays:
        return LazyArrays(self.root / manifest["path"], manifest, damaged)

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
        BucketError
            The server does not answer, or refuses.
        """
        files, manifest = prepare(stage, key, bundle, label, provenance)
        return settle(manifest, self._write(manifest, files))

    def _write(self, manifest: Manifest, files: Mapping[str, bytes]) -> Manifest | None:
        """Write an attempt, whose path is noted in the manifest, and publish it; what was there before, if anything."""
        home = self.home(manifest["stage"], manifest["key"])
        attempt = home / f"a-{uuid.uuid4().hex[:16]}"
        manifest["path"] = attempt.relative_to(self.root).as_posix()
        with self._clear_errors():
            try:
                _make(attempt)
                spill(attempt, files)
                there = self._publish(home, manifest)
            except BaseException:
                published = self.manifest(
                    manifest["stage"], manifest["key"]
                )  # an interruption may come just after the link
                if published is None or published["path"] != manifest["path"]:
                    shutil.rmtree(attempt, ignore_errors=True)
                raise
        if there is not None:
            shutil.rmtree(attempt, ignore_errors=True)
        return there

    def _publish(self, home: Path, manifest: Manifest) -> Manifest | None:
        """Link the manifest into place; returns the sound one that was there before, if any."""
        data = frame(manifest)
        temporary = home / f"m-{uuid.uuid4().hex[:16]}.tmp"
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            for _ in range(3):
                try:
                    os.link(temporary, home / "manifest.json")
                except FileExistsError:
                    sound = self._sound(manifest["stage"], manifest["key"])
                    there = self.manifest(manifest["stage"], manifest["key"]) if sound else None
                    if there is not None:
                        return there
                else:
                    with suppress(OSError):  # it is published: at worst a power failure takes it back as a whole
                        for folder in (home, *list(home.parents)[:3]):
                            fsync(folder)
                    return None
            raise StoreError(
                "RIL-573", f"cannot publish {home / 'manifest.json'}", remedy="remove that file and run again"
            )
        finally:
            temporary.unlink(missing_ok=True)

    def home(self, stage: str, key: str) -> Path:
        """Folder of a key: its manifest and its attempts."""
        return Path(self._home(stage, key))

    def _home(self, stage: str, key: str) -> str:
        return f"{self.root}/artifacts/{stage}/{key[:2]}/{key}"

    def _read_manifest(self, home: Path | str) -> Manifest:
        """Raises ValueError where the content is not what was written."""
        with open(f"{home}/manifest.json", "rb") as file:
            return unframe(file.read())

    def set_aside(self, stage: str, key: str, manifest: Manifest | None, reason: str) -> None:
        """Move a damaged artifact out of the way, manifest first. Best effort: a cache may be read-only.

        Another run may have done so before, and have published a sound one meanwhile: that one is put back.
        """
        aside = self.root / "quarantine" / f"{stage}-{key[:16]}-{uuid.uuid4().hex[:8]}"
        home = self.home(stage, key)
        with suppress(OSError):
            aside.mkdir(parents=True)
            try:
                (home / "manifest.json").rename(aside / "manifest.json")
            except FileNotFoundError:
                aside.rmdir()
                return
            with suppress(ValueError):
                moved = self._read_manifest(aside)
                if manifest is None or moved["path"] != manifest["path"]:
                    with suppress(FileExistsError):
                        os.link(aside / "manifest.json", home / "manifest.json")
                    shutil.rmtree(aside)
                    return
            if manifest is not None:
                (self.root / manifest["path"]).rename(aside / Path(manifest["path"]).name)
            (aside / "reason.txt").write_text(f"{reason}\n", encoding="utf-8")

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise StoreError(
                    "RIL-574",
                    f"no space left for the cache {self.root}",
                    remedy="free space, clear the cache, or choose another folder with --cache",
                ) from error
            if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
                raise StoreError(
                    "RIL-575",
                    f"the cache {self.root} may not be used ({os.strerror(error.errno)})",
                    remedy="choose another folder with --cache",
                ) from error
            if isinstance(error, NotADirectoryError):
                raise StoreError(
                    "RIL-576", f"the cache {self.root} is not a folder", remedy="choose one with --cache"
                ) from error
            raise


def at(cache: Path | str) -> Store:
    """The store at a location, a folder or ``s3://bucket/prefix``.

    Raises
    ------
    RilleError
        There is no such place, or it may not be used.
    """
    where = locate(cache)
    if isinstance(where, Path):
        return Store(where)
    from pipeline.engine.store.s3 import ObjectStore

    return ObjectStore(where)


def prepare(
    stage: Stage, key: str, bundle: Bundle, label: str, provenance: Mapping[str, Any] | None
) -> tuple[dict[str, bytes], Manifest]:
    """A result as contents by relative path, and its manifest, which lacks only the ``path`` of the attempt."""
    digests = array_digests(bundle.arrays)
    digest = output_digest(digests, bundle.meta)
    files, arrays = encode(stage, bundle)
    return files, {
        "stage": stage.name,
        "label": label,
        "key": key,
        "digest": digest,
        "arrays": {name: {**about, "sha256": digests[name]} for name, about in arrays.items()},
        "meta": dict(bundle.meta),
        "files": {name: [len(data), checksum(data)] for name, data in files.items()},
        "provenance": dict(provenance or {}),
    }


def settle(manifest: Manifest, there: Manifest | None) -> Ref:
    """Reference of a commit: to what was published, or to what was ``there`` before if that is the same.

    Raises
    ------
    NonDeterministicError
        It is not the same.
    """
    if there is None:
        return reference(json.loads(json.dumps(manifest)))
    if there["digest"] != manifest["digest"]:
        raise NonDeterministicError("RIL-577", difference(manifest["label"] or manifest["key"][:12], manifest, there))
    return reference(there)


def frame(manifest: Manifest) -> bytes:
    """A manifest as it is stored, with its checksum."""
    body = json.dumps(manifest, allow_nan=False).encode()
    head: bytes = _HEAD % google_crc32c.value(body)
    return head + body + b"}\n"


def unframe(data: bytes) -> Manifest:
    """Raises ValueError where it is not what was written."""
    body = data[_HEAD_SIZE:-2]
    if data != _HEAD % google_crc32c.value(body) + body + b"}\n":
        raise ValueError("the manifest is damaged")
    return sound(parsed(body))


def parsed(data: bytes) -> Any:
    """JSON. Raises ValueError where it is none, or nested beyond what any writer makes."""
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def sound(found: Any) -> Manifest:
    """A manifest whose checksum may be right by intent: it has every entry, and no path in it leaves its attempt.

    Raises ValueError where it is none.
    """
    try:
        manifest: Manifest = dict(found)
        stage, key = manifest["stage"], manifest["key"]
        place = re.fullmatch(rf"(artifacts|data)/({STAGE})/(?:(\w\w)/)?(\w+)/a-\w+", manifest["path"])
        if place is None or (place[2], place[4]) != (stage, key) or (place[3] or key[:2]) != key[:2]:
            raise ValueError("path")
        for name, (size, crc) in manifest["files"].items():
            if not FILE.fullmatch(name) or type(size) is not int or size < 0 or not isinstance(crc, str):
                raise ValueError(name)
        for name, about in manifest["arrays"].items():
            if not FILE.fullmatch(name) or not NUMERIC.fullmatch(about["dtype"]):
                raise ValueError(name)
            if not all(type(n) is int and n >= 0 for n in about["shape"]):
                raise ValueError(name)
        words = manifest["label"], manifest["digest"], *manifest["meta"]
        if not all(isinstance(word, str) for word in words):
            raise ValueError("text")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the manifest is damaged: {error}") from None
    return manifest


def _make(attempt: Path) -> None:
    """New folder of an attempt; clearing up may take an empty home away just as it is made."""
    for _ in range(100):
        with suppress(FileNotFoundError):
            attempt.mkdir(parents=True)
            return
    attempt.mkdir(parents=True)


def reference(manifest: Manifest) -> Ref:
    """What a manifest is referred to by."""
    m = manifest
    return Ref(m["key"], m["stage"], m["digest"], m["path"], m["meta"], *sizes(m))


def sizes(manifest: Manifest) -> tuple[int, int]:
    """Bytes of an artifact: its arrays decoded, and its files."""
    nbytes = sum(int(a["dtype"][2:]) * math.prod(a["shape"]) for a in manifest["arrays"].values())
    return nbytes, sum(size for size, _ in manifest["files"].values())


def difference(label: str, new: Manifest, old: Manifest) -> str:
    """What two results of one key differ in, in words."""
    names = sorted({*new["arrays"], *old["arrays"]})
    other = [n for n in names if new["arrays"].get(n, {}).get("sha256") != old["arrays"].get(n, {}).get("sha256")]
    what = ", ".join(other + (["meta"] if new["meta"] != old["meta"] else []))
    return f"stage {new['stage']} is not deterministic: {label} gave another {what or 'digest'} than before"
