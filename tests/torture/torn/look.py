"""What is in a cache, found out without the engine's own look-up, which would heal it."""

from __future__ import annotations

import time
from pathlib import Path

from pipeline.engine.store.artifact import array_digests, damage, output_digest
from pipeline.engine.store.folder import Store, at, unframe
from pipeline.engine.store.s3_maintenance import _damage

HERE = Path(__file__).parent.parent
PLACES = [str(HERE), str(HERE.parent / "pipeline"), str(HERE.parent.parent)]
"""Where programs find the stages of the tests, and the project."""


def published(cache):
    """Digest by key of every artifact whose manifest and files are whole."""
    if str(cache).startswith("s3://"):
        bucket = at(cache).bucket
        made = [unframe(bucket.get(entry.path)[0]) for entry in bucket.list("manifests")]
        return {manifest["key"]: manifest["digest"] for manifest in made if not _damage(at(cache), manifest)}
    store = Store(cache)
    found = {}
    for path in Path(cache).glob("artifacts/*/*/*/manifest.json"):
        manifest = store.manifest(path.parents[2].name, path.parent.name)
        if manifest and not damage(store.root / manifest["path"], manifest["files"], lambda _: True):
            found[manifest["key"]] = manifest["digest"]
    return found


def settled(cache):
    """Wait until a server has carried out what a killed program still asked of it."""
    if str(cache).startswith("s3://"):
        bucket, before = at(cache).bucket, None
        while (now := sorted((e.path, e.etag) for e in bucket.list(""))) != before:
            before = now
            time.sleep(0.1)


def manifests(cache):
    """Keys that have a manifest, sound or not."""
    if str(cache).startswith("s3://"):
        return {Path(entry.path).stem for entry in at(cache).bucket.list("manifests")}
    return {path.parent.name for path in Path(cache).glob("artifacts/*/*/*/manifest.json")}


def decoded(cache):
    """Digest by key, taken over what is really read."""
    store, found = at(cache), {}
    if str(cache).startswith("s3://"):
        there = [(Path(e.path).parent.name, Path(e.path).stem) for e in store.bucket.list("manifests")]
    else:
        there = [(p.parents[2].name, p.parent.name) for p in Path(cache).glob("artifacts/*/*/*/manifest.json")]
    for stage, key in there:
        ref = store.lookup(stage, key)
        if ref is not None:
            bundle = store.open(ref)
            found[ref.key] = output_digest(array_digests(bundle.arrays), bundle.meta)
    return found


def wrong(found, right):
    """Keys whose digest is not the undisturbed one (keys that it has not are strangers)."""
    return sorted(key for key, digest in found.items() if digest != right.get(key))
