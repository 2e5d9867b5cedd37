"""What is in a cache, found out without the engine's own look-up, which would heal it."""

from __future__ import annotations

from pathlib import Path

from pipeline.artifact import array_digests, damage, output_digest
from pipeline.store import Store

HERE = Path(__file__).parent.parent
PLACES = [str(HERE), str(HERE.parent / "pipeline"), str(HERE.parent.parent)]
"""Where programs find the stages of the tests, and the project."""


def published(cache):
    """Digest by key of every artifact whose manifest and files are whole."""
    store = Store(cache)
    found = {}
    for path in Path(cache).glob("artifacts/*/*/*/manifest.json"):
        manifest = store.manifest(path.parents[2].name, path.parent.name)
        if manifest and not damage(store.root / manifest["path"], manifest["files"], lambda _: True):
            found[manifest["key"]] = manifest["digest"]
    return found


def manifests(cache):
    """Keys that have a manifest, sound or not."""
    return {path.parent.name for path in Path(cache).glob("artifacts/*/*/*/manifest.json")}


def decoded(cache):
    """Digest by key, taken over what is really read from the disk."""
    store = Store(cache)
    found = {}
    for path in Path(cache).glob("artifacts/*/*/*/manifest.json"):
        ref = store.lookup(path.parents[2].name, path.parent.name)
        if ref is not None:
            bundle = store.open(ref)
            found[ref.key] = output_digest(array_digests(bundle.arrays), bundle.meta)
    return found


def wrong(found, right):
    """Keys whose digest is not the undisturbed one (keys that it has not are strangers)."""
    return sorted(key for key, digest in found.items() if digest != right.get(key))
