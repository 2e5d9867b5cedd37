"""Looking after a store: verification of every checksum, and clearing away what no kept run refers to."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from rille.pipeline.engine.runtime import numba_cache
from rille.pipeline.engine.store import index
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.lazy_arrays import DamagedError, LazyArrays
from rille.pipeline.engine.store.manifest import STAGE, Manifest, artifact_path, damage, length, unframe
from rille.pipeline.engine.store.output_digest import array_digests, output_digest

GRACE = 24 * 3600.0
"""Seconds before what no run is known to use goes: no single task takes a day."""

ARTIFACT = re.compile(rf"artifacts/({STAGE})/(\w\w)/(\w+)\.zarr\.zip")
PASSING = re.compile(rf"(?:{index.AREA}|quarantine|probe)/.+")
LEFTOVER = re.compile(
    r"(?:.+/)?\.tmp-\w+(?:/.+)?"  # of a writer that was killed
    rf"|artifacts/{STAGE}/\w\w/\w{{64}}/.+|manifests/{STAGE}/\w+\.json|data/{STAGE}/\w+/a-\w+/.+"  # of earlier formats
)


@dataclass(frozen=True)
class Damage:
    """A damaged artifact; ``aside``: it is out of the way, as it is unless the cache cannot be written."""

    stage: str
    key: str
    label: str
    reason: str
    aside: bool


@dataclass
class Cleared:
    """Artifacts and bytes that were removed, or would be in a dry run."""

    artifacts: int = 0
    orphans: int = 0
    bytes: int = 0
    stages: dict[str, list[int]] = field(default_factory=dict)
    """Number and bytes of the artifacts, by stage."""


def artifacts(store: Store) -> Iterator[tuple[str, str]]:
    """Stage and key of everything committed; files of other names are not ours."""
    for item in store.folder.list("artifacts"):
        if found := ARTIFACT.fullmatch(item.path):
            yield found[1], found[3]


def verify(store: Store, *, deep: bool = False) -> tuple[int, list[Damage]]:
    """Compare every byte of every artifact with the recorded checksums; damaged ones are set
    aside, if the cache can be written.

    ``deep`` decodes every chunk as well and compares the digests (SHA-256) of what was computed.

    Returns the number of sound artifacts, and the damaged ones.
    """
    sound, found = 0, []
    for stage, key in artifacts(store):
        data = store.folder.read(artifact_path(stage, key))
        if data is None:
            continue  # cleared away, or set aside by a run, just now
        manifest = None
        with suppress(ValueError):
            manifest = unframe(data[: length(data)])
        if manifest is None or (manifest["stage"], manifest["key"]) != (stage, key):
            reason = "the manifest is not readable"
        else:
            reason = damage(manifest, data) or (_decoded(manifest, data) if deep else "")
        if reason:
            aside = store.set_aside(stage, key, manifest, reason)
            found.append(Damage(stage, key, manifest["label"] if manifest else "", reason, aside))
        sound += not reason
    return sound, found


def _decoded(manifest: Manifest, data: bytes) -> str:
    """What is wrong with the decoded arrays or the metadata of an artifact; empty if nothing."""
    try:
        digests = array_digests(LazyArrays(lambda start, stop: data[start:stop], manifest, lambda _: True))
    except DamagedError as error:
        return error.message
    wrong = [name for name, found in digests.items() if found != manifest["arrays"][name]["sha256"]]
    if wrong:
        return f"{', '.join(wrong)} decoded to another digest"
    return "" if output_digest(digests, manifest["meta"]) == manifest["digest"] else "the metadata have another digest"


def gc(store: Store, keep: Collection[str], *, grace: float = GRACE, dry_run: bool = False) -> Cleared:
    """Remove artifacts whose key is not in ``keep``, leftovers, quarantine, and this user's kernels that nothing uses.

    Only files that were neither made nor used within ``grace`` seconds are removed, since a run may be under way; the
    index of a run states what it used. ``keep`` are the keys of the kept runs
    (:func:`rille.pipeline.engine.events.keys`). In a shared folder the age of a file is this machine's clock minus the
    server's: keep ``grace`` well above the difference of the clocks.
    """
    limit, cleared, doomed = time.time() - grace, Cleared(), []
    # Of a run whose folder is gone, or of another machine, the index alone tells what it used.
    kept = set(keep) | index.used_since(store.folder, limit)
    for item in store.folder.list(""):
        if item.modified > limit:
            continue
        if found := ARTIFACT.fullmatch(item.path):
            if found[3] in kept:
                continue
            cleared.artifacts += 1
            stage = cleared.stages.setdefault(found[1], [0, 0])
            stage[0], stage[1] = stage[0] + 1, stage[1] + item.size
        elif LEFTOVER.fullmatch(item.path):
            cleared.orphans += 1
        elif not PASSING.fullmatch(item.path):
            continue
        cleared.bytes += item.size
        doomed.append(item)
    for path in numba_cache.unused():
        cleared.bytes += sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")))
        if not dry_run:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
    if not dry_run:
        store.folder.clear(doomed)
    return cleared
