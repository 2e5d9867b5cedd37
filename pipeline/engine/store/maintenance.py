"""Looking after a store: verification of every checksum, and clearing away what no kept run refers to."""

from __future__ import annotations

import shutil
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.engine.runtime import numba_cache
from pipeline.engine.store import s3_maintenance
from pipeline.engine.store.artifact import DamagedError, LazyArrays, array_digests, damage, output_digest
from pipeline.engine.store.folder import Manifest, Store
from pipeline.engine.store.s3 import ObjectStore

GRACE = 24 * 3600.0
"""Seconds before an attempt without a manifest counts as an orphan: no single task takes a day."""


@dataclass(frozen=True)
class Damage:
    """A damaged artifact, set aside."""

    stage: str
    key: str
    label: str
    reason: str


@dataclass
class Cleared:
    """What was removed, or would be."""

    artifacts: int = 0
    orphans: int = 0
    bytes: int = 0
    stages: dict[str, list[int]] = field(default_factory=dict)
    """Number and bytes of the artifacts, by stage."""


def verify(store: Store, *, deep: bool = False) -> tuple[int, list[Damage]]:
    """Compare every file of every artifact with its recorded checksum; damaged ones are set aside.

    ``deep`` decodes every chunk as well and compares the digests (SHA-256) of what was computed.

    Returns the number of sound artifacts, and the damaged ones.
    """
    if isinstance(store, ObjectStore):
        judged = list(s3_maintenance.verify(store))
        return sum(not reason for *_, reason in judged), [Damage(*found) for found in judged if found[-1]]
    sound, found = 0, []
    for stage, key in artifacts(store):
        manifest = store.manifest(stage, key)
        if manifest is None and not (store.home(stage, key) / "manifest.json").exists():
            continue  # cleared away, or set aside by a run, just now
        if manifest is None:
            reason, label = "manifest.json is not readable", ""
        else:
            reason = damage(store.root / manifest["path"], manifest["files"], lambda _: True)
            reason = reason or (_decoded(store, manifest) if deep else "")
            label = manifest["label"]
        if reason:
            store.set_aside(stage, key, manifest, reason)
            found.append(Damage(stage, key, label, reason))
        else:
            sound += 1
    return sound, found


def _decoded(store: Store, manifest: Manifest) -> str:
    """What is wrong with the decoded arrays or the metadata of an artifact; empty if nothing."""
    try:
        digests = array_digests(LazyArrays(store.root / manifest["path"], manifest, lambda _: None))
    except DamagedError as error:
        return error.message
    wrong = [name for name, found in digests.items() if found != manifest["arrays"][name]["sha256"]]
    if wrong:
        return f"{', '.join(wrong)} decoded to another digest"
    return "" if output_digest(digests, manifest["meta"]) == manifest["digest"] else "the metadata have another digest"


def gc(store: Store, keep: Collection[str], *, grace: float = GRACE, dry_run: bool = False) -> Cleared:
    """Remove artifacts whose key is not in ``keep``, orphans, quarantine, and this user's kernels that nothing uses.

    Only what was neither made nor used within ``grace`` seconds goes (a run may be under way). The manifest goes first,
    so that an interruption leaves an orphan and never half an artifact. ``keep`` are the keys of the kept runs
    (:func:`pipeline.engine.events.keys`).
    """
    if isinstance(store, ObjectStore):
        return Cleared(*s3_maintenance.gc(store, keep, grace=grace, dry_run=dry_run))
    cleared = Cleared()
    limit = time.time() - grace
    kept = set(keep)
    for home in sorted(store.root.glob("artifacts/*/*/*")):
        _clear_home(store, home, home.name in kept, limit, cleared, dry_run)
    for path in (*store.root.glob("*.tmp"), *store.root.glob("hints/*/*.tmp")):
        if _written(path) <= limit:
            cleared.orphans += 1
            _remove(path, cleared, dry_run)
    for path in (*store.root.glob("quarantine/*"), *store.root.glob("index/*")):
        if _written(path) <= limit:
            _remove(path, cleared, dry_run)
    for path in numba_cache.unused():
        _remove(path, cleared, dry_run)
    return cleared


def _clear_home(store: Store, home: Path, kept: bool, limit: float, cleared: Cleared, dry_run: bool) -> None:
    published = home / "manifest.json"
    manifest = store.manifest(home.parents[1].name, home.name)
    mine = home / Path(manifest["path"]).name if manifest else None
    if mine is not None and not kept and _written(published) <= limit:
        cleared.artifacts += 1
        before = cleared.bytes
        _remove(published, cleared, dry_run)
        _remove(mine, cleared, dry_run)
        stage = cleared.stages.setdefault(home.parents[1].name, [0, 0])
        stage[0], stage[1] = stage[0] + 1, stage[1] + cleared.bytes - before
    for path in (*home.glob("a-*"), *home.glob("m-*.tmp")):
        if path != mine and _written(path) <= limit:
            cleared.orphans += 1
            _remove(path, cleared, dry_run)
    if not dry_run:
        with suppress(OSError):
            home.rmdir()  # only where nothing is left


def artifacts(store: Store) -> Iterator[tuple[str, str]]:
    """Stage and key of everything committed."""
    if isinstance(store, ObjectStore):
        yield from s3_maintenance.artifacts(store)
        return
    for path in sorted(store.root.glob("artifacts/*/*/*/manifest.json")):
        yield path.parents[2].name, path.parent.name


def _written(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return float("inf")


def _remove(path: Path, cleared: Cleared, dry_run: bool) -> None:
    with suppress(OSError):  # somebody else clears away too
        for file in [path] if path.is_file() else path.rglob("*"):
            with suppress(OSError):
                cleared.bytes += file.stat().st_size if file.is_file() else 0
    if dry_run:
        return
    if path.is_file():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)
