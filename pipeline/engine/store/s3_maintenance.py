"""Verification and clearing up of a store in a bucket; :mod:`pipeline.engine.store.maintenance` says what the words
mean.

What a run used within the grace is told by its index (:meth:`pipeline.engine.store.s3.ObjectStore.note`): a bucket has
no time of last use. Ages are by the server's clock against this machine's: keep the grace well above their difference.
"""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Collection, Iterator

from pipeline.engine.store.folder import STAGE, Manifest, unframe
from pipeline.engine.store.s3 import ObjectStore, damaged_objects, manifest_path
from pipeline.engine.store.s3_client import Entry

MANIFEST = re.compile(rf"manifests/({STAGE})/(\w+)\.json")
ATTEMPT = re.compile(rf"data/({STAGE})/(\w+)/a-\w+(?=/)")

AT_ONCE = 200
"""Objects deleted in one go."""


def verify(store: ObjectStore) -> Iterator[tuple[str, str, str, str]]:
    """Stage, key, label and reason of each artifact; the reason is empty if it is sound, else it was set aside."""
    for entry, stage, key in _committed(store):
        found = store.bucket.get(entry.path)
        if found is None:
            continue  # cleared away, or set aside by a run, just now
        try:
            manifest = unframe(found[0])
        except ValueError:
            reason = "the manifest is not readable"
            store.set_aside(stage, key, None, reason)
            yield stage, key, "", reason
            continue
        reason = _damage(store, manifest)
        if reason:
            store.set_aside(stage, key, manifest, reason)
        yield stage, key, manifest["label"], reason


def artifacts(store: ObjectStore) -> Iterator[tuple[str, str]]:
    """Stage and key of everything committed."""
    for _, stage, key in _committed(store):
        yield stage, key


def _damage(store: ObjectStore, manifest: Manifest) -> str:
    place, files = manifest["path"], manifest["files"]
    found = store.bucket.get_all(f"{place}/{name}" for name in files)
    return damaged_objects(files, {n: None if (c := found[f"{place}/{n}"]) is None else c[0] for n in files})


def gc(store: ObjectStore, keep: Collection[str], *, grace: float, dry_run: bool) -> tuple[int, int, int]:
    """Numbers of artifacts and of orphans removed, and their bytes; a manifest goes before its objects."""
    limit, kept = time.time() - grace, set(keep)
    store.survey("")
    doomed: list[Entry] = []
    for entry in store.bucket.list("index"):
        if entry.modified > limit:
            kept |= {found[2] for path in store._index(entry.path) if (found := MANIFEST.fullmatch(path))}
        else:
            doomed.append(entry)
    manifests: list[Entry] = []
    live, gone = {}, set()
    for entry, stage, key in _committed(store):
        manifest = store.manifest(stage, key)
        if key in kept or entry.modified > limit:
            live[entry.path] = None if manifest is None else manifest["path"]
        else:
            manifests.append(entry)
            gone.add(None if manifest is None else manifest["path"])
    objects = defaultdict(list)
    for entry in store.bucket.list("data"):
        if (place := ATTEMPT.match(entry.path)) is not None:
            objects[place[0]].append(entry)
    orphans = 0
    for attempt, entries in objects.items():
        _, stage, key, _ = attempt.split("/")
        path = manifest_path(stage, key)
        if path in live and live[path] in (None, attempt):
            continue
        if attempt in gone or max(e.modified for e in entries) <= limit:
            orphans += attempt not in gone
            doomed += entries
    doomed += [e for area in ("quarantine", "probe") for e in store.bucket.list(area) if e.modified <= limit]
    if not dry_run:
        for chosen in (manifests, doomed):
            for start in range(0, len(chosen), AT_ONCE):
                store.bucket.delete(e.path for e in chosen[start : start + AT_ONCE])
    return len(manifests), orphans, sum(e.size for e in (*manifests, *doomed))


def _committed(store: ObjectStore) -> Iterator[tuple[Entry, str, str]]:
    """Each manifest with its stage and key; objects of other names are not ours, and stay."""
    for entry in store.bucket.list("manifests"):
        found = MANIFEST.fullmatch(entry.path)
        if found is not None:
            yield entry, found[1], found[2]
