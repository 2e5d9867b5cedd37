"""Looking after a store: verification of all artifacts, and clearing away what no kept run refers to.

Folders of runs that use a cache are noted in the cache, so that clearing up keeps their artifacts.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import time
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

from rille.datasets.text.reading import read_text
from rille.pipeline.engine.failures import CLOSED
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.arrays import DamagedError, array_digests, output_digest
from rille.pipeline.engine.store.artifact import STAGE, BrokenError, reference
from rille.pipeline.engine.store.base import GoneError, Store, StoreError, clear_errors, files

GRACE = 24 * 3600.0
"""Seconds before what no run is known to use goes: no single task takes a day."""

ARTIFACT = re.compile(rf"artifacts/({STAGE})/\w\w/(\w+)\.zarr\.zip")
LEFTOVER = re.compile(r"(?:quarantine|probe)/.+|(?:.+/)?\.tmp-\w+(?:/.+)?")
"""Damaged artifacts, and files of a process that was killed."""


def artifacts(store: Store) -> Iterator[tuple[str, str]]:
    """Stage and key of everything committed; files of other names are not ours."""
    for path, _ in files(store.root, "artifacts"):
        if match := ARTIFACT.fullmatch(path):
            yield match[1], match[2]


def verify(store: Store) -> tuple[int, list[str]]:
    """Compare the checksum of every member of every artifact, and the digests of its decoded arrays and its metadata.

    Damaged artifacts are set aside, if the cache can be written.

    Returns the number of sound artifacts, and a sentence about each damaged one.
    """
    sound, damages = 0, []
    for stage, key in artifacts(store):
        label = key[:12]
        try:
            manifest = store.read_manifest(stage, key)
            label = manifest["label"] or label
            with store.opened(stage, key) as archive:
                for name in archive.namelist():
                    archive.member(name, archive.size)
            digests = array_digests(store.open(reference(manifest)).arrays)
            if output_digest(digests, manifest["meta"]) != manifest["digest"]:
                raise BrokenError("its content has another digest")
            sound += 1
        except (FileNotFoundError, GoneError):
            pass  # cleared away, or set aside by a run, just now
        except (BrokenError, DamagedError) as error:
            aside = store.set_aside(stage, key, str(error))
            outcome = "set aside" if aside else "it stays, for the cache cannot be written"
            damages.append(f"{label} ({stage}): {error}; {outcome}")
    return sound, damages


ROOTS = "roots"
"""Folder of the cache with a note of each folder of runs that uses it."""


def note_runs(store: Store, runs: Path) -> None:
    """Note a folder of runs, once, if the cache can be written."""
    folder = str(runs.resolve())
    # By machine and folder, since users of a shared cache may be on several machines.
    named = hashlib.sha256(f"{platform.node()}\0{folder}".encode()).hexdigest()[:16]
    path = store.root / ROOTS / f"{named}.json"
    with suppress(OSError):
        if not path.exists():
            atomic.write(path, json.dumps({"folder": folder, "host": platform.node()}))


def noted_runs(store: Store, runs: Path) -> list[Path]:
    """``runs`` and all noted folders, without those of this machine that are gone.

    Raises
    ------
    StoreError
        Runs of another machine cannot be read from here, so that their artifacts would count as unused; or a note
        cannot be read.
    """
    seen = {runs.resolve()}
    for path in (store.root / ROOTS).glob("*.json"):
        try:
            noted = json.loads(read_text(path, "note"))
            folder, host = Path(noted["folder"]), str(noted["host"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            remedy = "remove it, once you know that no run needs this cache"
            raise StoreError("RIL-742", f"{path} cannot be read", remedy=remedy) from error
        if folder.is_dir():
            seen.add(folder)
        elif host != platform.node():
            remedy = f"clear up there, or remove {path} if they are gone"
            raise StoreError("RIL-743", f"the runs in {folder} on {host} cannot be seen from here", remedy=remedy)
    return sorted(seen)


def gc(store: Store, keep: Collection[str], *, grace: float = GRACE, dry_run: bool = False) -> dict[str, list[int]]:
    """Remove artifacts whose key is not in ``keep``, and leftovers.

    Only files that were neither made nor used within ``grace`` seconds are removed, since a run may be under way.
    ``keep`` are the keys of the kept runs (:func:`rille.pipeline.runs.lookup.used`). In a shared folder the age of a
    file is this machine's clock minus the server's: keep ``grace`` well above the difference of the clocks.

    Returns the bytes of each file that was removed, or would be in a dry run, by stage; ``""`` holds those that are no
    artifacts.

    Raises
    ------
    StoreError
        This user may not remove some of the files; all others are gone.
    """
    limit, cleared = time.time() - grace, defaultdict[str, list[int]](list)
    refused: list[OSError] = []
    # The folder may be a link, as to a larger disk; other links are left alone.
    linked = files(store.root, "artifacts") if (store.root / "artifacts").is_symlink() else []
    for path, status in files(store.root, "") + linked:
        match = ARTIFACT.fullmatch(path)
        if status.st_mtime > limit or (match[2] in keep if match else not LEFTOVER.fullmatch(path)):
            continue
        cleared[match[1] if match else ""].append(status.st_size)
        try:
            if not dry_run:
                # A run that has found it just now finds it gone when it reads it, and computes it again.
                (store.root / path).unlink()
        except OSError as error:
            if error.errno in CLOSED:  # else somebody else cleared it away
                refused.append(error)
    if refused:
        with clear_errors(store.root):
            raise refused[0]
    return cleared
