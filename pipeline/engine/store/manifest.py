"""The file of one artifact: its manifest, then a zip archive that is a zarr 3 group.

``{"crc32c": "........", "bytes": .........., "manifest": {...}}`` on a line of its own, then the archive, whose
members are stored as they are (zarr has compressed them) with a fixed time, so that equal arrays make equal archives.
Any reader of zip files finds its directory at the end; we go by the manifest, which lists each member with offset (from
the end of the line), size and crc32c: a part of an array is a few readings of a range.

In memory a manifest's offsets count from the beginning of the file.
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import google_crc32c

Manifest = dict[str, Any]

LONG = 500
"""Characters of facts that are worth compressing."""

FIRST = 32_768
"""Bytes read of a file at first: most manifests have less."""

MEMBER = re.compile(r"(?!.*(^|/)\.\.?(/|$))[\w.-]+(/[\w.-]+)*")
"""A member of the archive."""

STAGE = r"\w+(?:\.\w+)*"
"""Name of a stage, as it stands in paths (``locus``, ``mockup.scene``)."""

NUMERIC = re.compile(r"[<>|](b1|[iu][1248]|f[248]|c8|c16)")
"""NumPy's name of a type of numbers."""

MOST_RATIO = 1000
"""Bytes of arrays for one of the archive: lz4 makes 255 of one."""

_HEAD = b'{"crc32c": "%08x", "bytes": %10d, "manifest": '
_HEAD_SIZE = len(_HEAD % (0, 0))
_END = b"}\n"


class Facts(Mapping[str, Any]):
    """Facts of an artifact as JSON, read when somebody asks: of most artifacts of a long sequence nobody does.

    As text they take a fifth of the memory, compressed (``bytes``) half of that, and what holds a reference holds them
    as long. ``start`` and ``stop``: the part of the text that they are.
    """

    __slots__ = ("_start", "_stop", "_text")

    def __init__(self, text: str | bytes, start: int = 0, stop: int | None = None) -> None:
        self._text, self._start, self._stop = text, start, stop

    @property
    def text(self) -> str:
        """JSON without spaces."""
        text = self._text if isinstance(self._text, str) else zlib.decompress(self._text).decode()
        return text[self._start : self._stop]

    def __getitem__(self, name: str) -> Any:
        return _read(self._text, self._start, self._stop)[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_read(self._text, self._start, self._stop))

    def __len__(self) -> int:
        return len(_read(self._text, self._start, self._stop))


@lru_cache(maxsize=64)  # who looks at facts mostly looks at several of one artifact
def _read(text: str | bytes, start: int, stop: int | None) -> Mapping[str, Any]:
    found: Mapping[str, Any] = parsed(Facts(text, start, stop).text)
    return found


@dataclass(frozen=True, slots=True)
class Ref:
    """A committed artifact: all that travels between tasks.

    ``nbytes`` are bytes of the decoded arrays, ``stored`` those of the file.
    """

    key: str
    stage: str
    digest: str
    meta: Mapping[str, Any]
    nbytes: int = 0
    stored: int = 0

    @property
    def path(self) -> str:
        """File, relative to the cache."""
        return artifact_path(self.stage, self.key)


def artifact_path(stage: str, key: str) -> str:
    """File of an artifact."""
    return f"artifacts/{stage}/{key[:2]}/{key}.zarr.zip"


def checksum(data: bytes) -> str:
    """CRC32C, 8 hexadecimal digits."""
    return f"{google_crc32c.value(data):08x}"


def pack(manifest: Manifest, files: Mapping[str, bytes]) -> tuple[bytes, bytes]:
    """The file in two pieces; enters the members and the archive into the manifest."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as written:
        for name, data in files.items():
            # ZipInfo has the fixed date 1980-01-01: with the time of writing equal results would make unequal files.
            written.writestr(zipfile.ZipInfo(name), data)
    starts = {m.filename: m.header_offset + len(m.FileHeader()) for m in written.infolist()}
    content = archive.getvalue()
    manifest["files"] = {name: [starts[name], len(data), checksum(data)] for name, data in files.items()}
    manifest["archive"] = [len(content), checksum(content)]
    head = frame(manifest)
    _move(manifest, len(head))
    return head, content


def frame(manifest: Manifest) -> bytes:
    """The line of a manifest whose offsets count from its end."""
    body = json.dumps(manifest, allow_nan=False).encode()
    head: bytes = _HEAD % (google_crc32c.value(body), len(body))
    return head + body + _END


def length(data: bytes) -> int:
    """Return the length of the manifest line, bytes, by the first bytes of a file; ValueError if it is damaged."""
    found = re.match(rb'\{"crc32c": "[0-9a-f]{8}", "bytes": ([ \d]{9}\d), "manifest": ', data)
    if found is None:
        raise ValueError("the manifest is damaged")
    return _HEAD_SIZE + int(found[1]) + len(_END)


def unframe(line: bytes) -> Manifest:
    """Parse the manifest line of an artifact; ValueError if it is not as it was written."""
    body = line[_HEAD_SIZE : -len(_END)]
    # The whole line is made anew and compared, so that there is no byte of it that nothing checks.
    if line != _HEAD % (google_crc32c.value(body), len(body)) + body + _END:
        raise ValueError("the manifest is damaged")
    manifest = _sound(parsed(body))
    _move(manifest, len(line))
    return manifest


def _move(manifest: Manifest, by: int) -> None:
    for found in manifest["files"].values():
        found[0] += by
    manifest["size"] = by + manifest["archive"][0]


def parsed(data: bytes | str) -> Any:
    """JSON. Raises ValueError where it is none, or nested beyond what any writer makes."""
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _sound(found: Any) -> Manifest:
    """A manifest whose checksum may be right by intent: it has every entry, and no member lies outside of the archive.

    Raises ValueError where it is none.
    """
    try:
        manifest: Manifest = dict(found)
        size, crc = manifest["archive"]
        if not _counts(size) or not isinstance(crc, str):
            raise ValueError("archive")
        for name, (start, length, crc) in manifest["files"].items():
            if not MEMBER.fullmatch(name) or not _counts(start, length) or not isinstance(crc, str):
                raise ValueError(name)
            if start + length > size:
                raise ValueError(name)
        for name, about in manifest["arrays"].items():
            if not MEMBER.fullmatch(name) or not NUMERIC.fullmatch(about["dtype"]) or not _counts(*about["shape"]):
                raise ValueError(name)
            if _nbytes(about) > MOST_RATIO * size:
                raise ValueError(name)
        words = *(manifest[name] for name in ("stage", "key", "label", "digest", "attempt")), *manifest["meta"]
        if not all(isinstance(word, str) for word in words):
            raise ValueError("text")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the manifest is damaged: {error}") from None
    return manifest


def _counts(*values: Any) -> bool:
    return all(type(n) is int and n >= 0 for n in values)


def _nbytes(about: Mapping[str, Any]) -> int:
    size: int = int(about["dtype"][2:]) * math.prod(about["shape"])
    return size


def reference(manifest: Manifest) -> Ref:
    """Return the reference to the artifact of a manifest."""
    m = manifest
    nbytes = sum(map(_nbytes, m["arrays"].values()))
    text = json.dumps(m["meta"], separators=(",", ":"))
    facts = Facts(zlib.compress(text.encode()) if len(text) > LONG else text)
    return Ref(m["key"], m["stage"], m["digest"], facts, nbytes, m["size"])


def damage(manifest: Manifest, data: bytes) -> str:
    """Describe the damage of a whole file whose manifest is sound; empty if there is none."""
    if len(data) != manifest["size"]:
        return f"it has {len(data)} bytes instead of {manifest['size']}"
    for name, (start, size, crc) in manifest["files"].items():
        if checksum(data[start : start + size]) != crc:
            return f"{name} has another checksum"
    size, crc = manifest["archive"]
    return "" if checksum(data[-size:]) == crc else "the archive has another checksum"


def difference(label: str, new: Manifest, old: Manifest) -> str:
    """Describe the difference of two results of one key."""
    names = sorted({*new["arrays"], *old["arrays"]})
    other = [n for n in names if new["arrays"].get(n, {}).get("sha256") != old["arrays"].get(n, {}).get("sha256")]
    what = ", ".join(other + (["meta"] if new["meta"] != old["meta"] else []))
    return f"stage {new['stage']} is not deterministic: {label} gave another {what or 'digest'} than before"
