"""The file of an artifact, a zip archive that any reader of zip files opens, and the reference that stands for it.

Its members are the manifest, as the first one, and a zarr 3 group. They are stored as they are (zarr has compressed the
arrays), so that no member unpacks to more than it has, and have a CRC-32 each, which is compared at every reading.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import stat
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Generic

from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt

from rille.stages.core.declare import F

MANIFEST = "manifest.json"

MAX_READ_BYTES = 4_000_000
"""Bound of one reading, and so of the archive's directory, which is read at once: some 40 000 members."""

MALFORMED = (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, OverflowError, struct.error)
"""Errors of zipfile (NotImplementedError: a method that it does not know), json and the codec about what they read."""


class BrokenError(ValueError):
    """The file of an artifact is not as it was written; the text says in which way."""


class _RegularFile(io.FileIO):
    """A file that is read in bounded pieces. A pipe or a device is broken, and is not waited for.

    zipfile takes what is missing of a member with the next reading, and a directory that was cut for damaged.
    """

    def __init__(self, path: str) -> None:
        super().__init__(path, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
        if not stat.S_ISREG(os.fstat(self.fileno()).st_mode):
            self.close()
            raise BrokenError("it is not a file")

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(MAX_READ_BYTES if size is None or size < 0 else min(size, MAX_READ_BYTES)) or b""


class Archive(zipfile.ZipFile):
    """An artifact's file, open for reading; ``size`` is that of the file, bytes."""

    def __init__(self, file: _RegularFile) -> None:
        super().__init__(file)
        self.size = os.fstat(file.fileno()).st_size

    def member(self, name: str, most: int) -> bytes:
        """Content of a member of at most ``most`` bytes.

        Raises
        ------
        BrokenError
            There is none, it is greater, or is compressed and might unpack to any size.
        """
        try:
            about = self.getinfo(name)
        except KeyError:
            raise BrokenError(f"{name} is missing") from None
        if about.compress_type != zipfile.ZIP_STORED or about.file_size > most:
            raise BrokenError(f"{name} claims {about.file_size} bytes")
        return self.read(about)


def pack(members: Mapping[str, bytes]) -> memoryview:
    """Content of the file of an artifact."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            # ZipInfo has the fixed date 1980-01-01: with the time of writing equal results would make unequal files.
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getbuffer()


@contextmanager
def opened(path: str) -> Iterator[Archive]:
    """The file of an artifact.

    Raises
    ------
    BrokenError
        It is not as it was written, or what the block reads of it is not.
    FileNotFoundError
        There is none.
    """
    try:
        with _RegularFile(path) as file, Archive(file) as archive:
            yield archive
    except MALFORMED as error:
        raise BrokenError(str(error)) from None
    except OSError as error:
        # zipfile seeks to places that a damaged directory names.
        if error.errno not in (errno.EINVAL, errno.EISDIR):
            raise
        raise BrokenError(os.strerror(error.errno)) from None


Manifest = dict[str, Any]

STAGE = r"\w+(?:\.\w+)*"
"""Name of a stage, as it stands in paths (``locus``, ``mockup.scene``)."""


class _StoredArray(BaseModel, strict=True):
    """Array of an artifact: NumPy's name of its type, and the edges of the chunks in which it is stored."""

    dtype: Annotated[str, Field(pattern=r"^([<|][iuf][1248]|\|b1)$")]
    shape: list[NonNegativeInt]
    chunks: list[PositiveInt]
    sha256: str


class _Provenance(BaseModel, strict=True):
    """Entries that a run reads of how an artifact came to be."""

    seconds: float = 0.0
    inputs: dict[str, Any] = {}
    code: dict[str, str] = {}
    env: dict[str, str] = {}


class _Manifest(BaseModel, strict=True):
    """Entries of a manifest."""

    stage: str
    key: str
    label: str
    digest: str
    arrays: dict[Annotated[str, Field(pattern=r"^\w+$")], _StoredArray]
    meta: dict[str, Any]
    provenance: _Provenance


@dataclass(frozen=True, slots=True)
class Ref(Generic[F]):
    """A committed artifact: all that travels between tasks.

    ``nbytes`` are bytes of the decoded arrays; ``seconds`` are those that its stage took.
    """

    key: str
    stage: str
    digest: str
    meta: F
    nbytes: int
    seconds: float

    @property
    def path(self) -> str:
        """File, relative to the cache."""
        return artifact_path(self.stage, self.key)


def artifact_path(stage: str, key: str) -> str:
    """File of an artifact."""
    return f"artifacts/{stage}/{key[:2]}/{key}.zarr.zip"


def read_manifest(path: str, stage: str, key: str) -> Manifest:
    """Manifest of the artifact of a key, in the file at ``path``.

    Its checksum may be right by intent: it has every entry, and its arrays claim no more than such a file can hold.

    Raises
    ------
    BrokenError, FileNotFoundError
        The file holds no such manifest; there is none.
    """
    with opened(path) as file:
        manifest: Manifest = json.loads(file.member(MANIFEST, 256_000_000))
        _Manifest.model_validate(manifest)
        if (manifest["stage"], manifest["key"]) != (stage, key):
            raise BrokenError("the manifest is that of another artifact")
        for name, about in manifest["arrays"].items():
            edges = zip(about["chunks"], about["shape"], strict=True)
            # Bytes of a decoded array for one of the file: lz4 makes 255 of one
            if _nbytes(about) > 1000 * file.size or any(edge > max(n, 1) for edge, n in edges):
                raise BrokenError(f"{name} claims more than the file holds")
        return manifest


def reference(manifest: Manifest) -> Ref:
    """Reference to the artifact of a manifest."""
    nbytes = sum(map(_nbytes, manifest["arrays"].values()))
    seconds = manifest["provenance"].get("seconds", 0.0)
    return Ref(manifest["key"], manifest["stage"], manifest["digest"], manifest["meta"], nbytes, seconds)


def _nbytes(about: Mapping[str, Any]) -> int:
    return int(about["dtype"][2:]) * int(math.prod(about["shape"]))


def difference(new: Manifest, old: Manifest) -> str:
    """Names of what differs in two results of one key."""
    digests = [{name: about["sha256"] for name, about in each["arrays"].items()} for each in (new, old)]
    parts = sorted({name for name, _ in digests[0].items() ^ digests[1].items()})
    parts += ["meta"] if new["meta"] != old["meta"] else []
    return ", ".join(parts) or "digest"
