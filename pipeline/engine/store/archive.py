"""The file of one artifact: a zip archive that any reader of zip files opens.

Its members are the manifest, as the first one, and a zarr 3 group. They are stored as they are (zarr has compressed the
arrays), so that no member unpacks to more than it has, and have a CRC-32 each, which is compared at every reading.
"""

from __future__ import annotations

import errno
import io
import os
import stat
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

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
    with _broken(), _RegularFile(path) as file, Archive(file) as archive:
        yield archive


@contextmanager
def _broken() -> Iterator[None]:
    """Turn what readers say of a damaged file into :class:`BrokenError`."""
    try:
        yield
    except MALFORMED as error:
        raise BrokenError(str(error)) from None
    except OSError as error:
        # zipfile seeks to places that a damaged directory names.
        if error.errno not in (errno.EINVAL, errno.EISDIR):
            raise
        raise BrokenError(os.strerror(error.errno)) from None
