"""What is in a cache, found out without the engine's own look-up, which would heal it."""

from __future__ import annotations

import io
import zipfile
from contextlib import suppress
from pathlib import Path

from rille.pipeline.engine.store.arrays import array_digests, output_digest
from rille.pipeline.engine.store.artifact import BrokenError
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.maintenance import artifacts

HERE = Path(__file__).parent.parent
PLACES = [str(HERE), str(HERE.parent / "pipeline"), str(HERE.parent.parent)]
"""Where programs find the stages of the tests, and the project."""


def published(cache):
    """Digest by key of every artifact that is whole."""
    store, found = Store(cache), {}
    for stage, key in artifacts(store):
        with suppress(BrokenError), store.opened(stage, key) as archive:
            for name in archive.namelist():
                archive.member(name, archive.size)
            found[key] = store.read_manifest(stage, key)["digest"]
    return found


def span(data, member):
    """Where in an artifact's file a member lies, or the last record of its ``directory``."""
    if member == "directory":
        return data.rindex(b"PK\x01\x02"), len(data)
    about = zipfile.ZipFile(io.BytesIO(data)).getinfo(member)
    start = about.header_offset + len(about.FileHeader())
    return start, start + about.file_size


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
