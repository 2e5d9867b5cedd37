"""What is in a cache, found out without the engine's own look-up, which would heal it."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.maintenance import artifacts
from rille.pipeline.engine.store.manifest import artifact_path, damage, length, unframe
from rille.pipeline.engine.store.output_digest import array_digests, output_digest

HERE = Path(__file__).parent.parent
PLACES = [str(HERE), str(HERE.parent / "pipeline"), str(HERE.parent.parent)]
"""Where programs find the stages of the tests, and the project."""


def published(cache):
    """Digest by key of every artifact that is whole."""
    store, found = Store(cache), {}
    for stage, key in artifacts(store):
        data = store.folder.read(artifact_path(stage, key))
        with suppress(ValueError):
            manifest = unframe(data[: length(data)])
            if not damage(manifest, data):
                found[manifest["key"]] = manifest["digest"]
    return found


def span(data, kind, member):
    """Where in an artifact's file a part lies: its manifest, a member, or the directory of the archive."""
    size = length(data)
    if kind in ("manifest", "directory"):
        return (0, size) if kind == "manifest" else (data.rindex(b"PK\x01\x02"), len(data))
    start, length_, _ = unframe(data[:size])["files"][member]
    return start, start + length_


def manifests(cache):
    """Keys that have an artifact, sound or not."""
    return {key for _, key in artifacts(Store(cache))}


def decoded(cache):
    """Digest by key, taken over what is really read."""
    store, found = Store(cache), {}
    for stage, key in artifacts(store):
        ref = store.lookup(stage, key)
        if ref is not None:
            bundle = store.open(ref)
            found[ref.key] = output_digest(array_digests(bundle.arrays), bundle.meta)
    return found


def wrong(found, right):
    """Keys whose digest is not the undisturbed one (keys that it has not are strangers)."""
    return sorted(key for key, digest in found.items() if digest != right.get(key))
