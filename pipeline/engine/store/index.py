"""What the runs of a sequence found in a store: manifests that nobody touched since need not be read again.

A hint beside the artifacts, ``index/<sequence>/<name>``, written at the end of a run: a gzip of lines, one for each
artifact that it used, with the mark of its file (:class:`~rille.pipeline.engine.store.folder.Item`) and what the
manifest says of digest, sizes and facts. If the mark differs, or the index is damaged, the manifest is read as if
there were no index. Clearing up spares what an index names that is younger than its grace.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import time
import zlib
from collections.abc import Iterable, Mapping
from urllib.parse import quote

from rille.datasets.text.warning import warning
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.store.folder import Folder, Item
from rille.pipeline.engine.store.manifest import Facts, Ref, parsed
from rille.stages.core.errors import RilleError

AREA = "index"

NEWEST = 4
"""Indices read of a sequence."""

MOST = 256_000_000
"""Bytes that all of them may unpack to: a small file may unpack to any size."""

LONGEST = 64_000_000
"""Bytes of a line: facts of one artifact."""

KEY = 64
"""Digits of a key."""

FRESH = 3600.0
"""Seconds after which a run writes again that it used the same artifacts."""


def folder_of(sequence: str) -> str:
    """Name of the folder of what is kept by sequence; no name leads out of where it lies."""
    return quote(sequence, safe="").replace(".", "%2E") or "-"


class Index:
    """Lines by key, of the newest indices of a sequence."""

    def __init__(self, folder: Folder, sequence: str) -> None:
        self._folder = folder
        self._area = f"{AREA}/{folder_of(sequence)}"
        self._written: dict[str, float] = {}
        self.lines: dict[str, str] = {}
        room = MOST
        for item in sorted(folder.list(self._area), key=lambda i: -i.modified)[:NEWEST]:
            try:
                room -= _read(folder, item, self.lines, room)
                self._written[item.path] = item.modified
            except ValueError as error:
                warn(warning("RIL-984", f"{item.path} in the cache is passed over: {error}"))

    def get(self, stage: str, item: Item, key: str) -> Ref | None:
        """Return the reference to an artifact if its file is unchanged since it was entered, else None."""
        line = self.lines.get(key, "")
        if not line.startswith(f'["{item.mark}",'):
            self.lines.pop(key, None)
            return None
        end = line.find(",{")
        try:
            _, digest, nbytes, stored = parsed(f"{line[:end]}]")
        except (ValueError, TypeError):
            return None
        return Ref(key, stage, digest, Facts(line, end + 1, -1), nbytes, stored)

    def forget(self, key: str) -> None:
        """Drop a line whose mark has changed though the file has not: it is written anew at the end."""
        self.lines.pop(key, None)

    def note(self, used: Mapping[str, Ref]) -> None:
        """Write what a run used, unless an index says so that is young."""
        # Lines that were read are still right: whatever was looked up through them had its mark compared.
        known = {key: self.lines[key] for key in used if key in self.lines}
        for key in used.keys() - known.keys():
            ref = used[key]
            item = self._folder.status(ref.path)
            if item is not None and item.mark and item.size == ref.stored:
                known[key] = _line(item.mark, ref)
        # named by what it says: of runs that use the same there is one
        lines = [f"{key} {known[key]}\n" for key in sorted(known)]
        name = hashlib.sha256("".join(lines).encode()).hexdigest()[:32]
        path = f"{self._area}/{name}"
        if known and self._written.get(path, 0.0) < time.time() - FRESH:
            self._folder.write(path, pack(lines))
            self.lines |= known


def _line(mark: str, ref: Ref) -> str:
    facts = ref.meta.text if isinstance(ref.meta, Facts) else json.dumps(dict(ref.meta), separators=(",", ":"))
    return f"{json.dumps([mark, ref.digest, ref.nbytes, ref.stored], separators=(',', ':'))[:-1]},{facts}]"


def pack(lines: Iterable[str]) -> bytes:
    """Compress line by line."""
    packer = zlib.compressobj(5, wbits=zlib.MAX_WBITS | 16)
    return b"".join([*(packer.compress(line.encode()) for line in lines), packer.flush()])


def _read(folder: Folder, item: Item, lines: dict[str, str], room: int) -> int:
    """Take lines in that are not known yet; gives the bytes of all. Raises ValueError where it is none of ours."""
    size = 0
    found: dict[str, str] = {}
    with gzip.GzipFile(fileobj=io.BytesIO(folder.read(item.path) or b"")) as file:
        try:
            while line := file.readline(min(LONGEST, room - size + 1)):
                size += len(line)
                # A small damaged or hostile file can unpack to any size, or to any number of lines.
                if size > room:
                    raise ValueError(f"it unpacks to more than {room / 1e6:.0f} MB")
                if len(line) <= 2 * KEY or not line.endswith(b"\n"):
                    raise ValueError("it has a line that is none of an index")
                found[line[:KEY].decode("ascii")] = line[KEY + 1 : -1].decode()
        except (zlib.error, OSError, EOFError) as error:
            raise ValueError(f"it is damaged ({error})") from None
    if not found:
        raise ValueError("it is empty")
    lines |= found | lines
    return size


def used_since(folder: Folder, limit: float) -> set[str]:
    """Keys that indices name which were written after a time."""
    keys: dict[str, str] = {}
    for item in folder.list(AREA):
        if item.modified > limit:
            try:
                _read(folder, item, keys, MOST)
            except (ValueError, RilleError):
                continue
    return set(keys)
