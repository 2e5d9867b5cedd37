"""Interface between a store and the place of its files: a folder, or a prefix of a bucket.

Paths are relative, with ``/``. Nothing here knows what an artifact is.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

MARK, FORMAT = "rille.json", 2
"""File that says in which format the artifacts are."""


class Item(NamedTuple):
    """A file or object; ``mark`` changes whenever its content does (empty: it might change and have the same one).

    ``modified`` is in seconds since 1970.
    """

    path: str
    size: int
    mark: str
    modified: float


class Place(Protocol):
    """Files below a root. Each method raises a RilleError in one line where the disk or the server refuses."""

    slow: bool
    """Whether a reading takes so long that several should be under way at once."""

    def begin(self) -> None:
        """Raise if nothing can be written here; note the format."""

    def earlier(self) -> bool:
        """Whether artifacts of an earlier format were here when this one came; said once."""

    def survey(self) -> None:
        """Before many questions for the status of artifacts: ask all of them at once, if that is faster."""

    def status(self, path: str, *, fresh: bool = False) -> Item | None:
        """Return the status of a path, None if nothing is there; ``fresh`` does not rely on a survey."""

    def use(self, item: Item) -> Item | None:
        """Note that a file is in use, if the place can: from then on :meth:`clear` spares it. None if it has gone."""

    def read(self, path: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """Return bytes ``start`` to ``stop`` (exclusive) of a file; None if there is no such file.

        If the file ends before ``stop``, fewer bytes are returned. Without ``stop`` the whole file is returned.
        """

    def write(self, path: str, data: bytes) -> None:
        """Replace a file, whole or not at all."""

    def create(self, path: str, pieces: Iterable[bytes]) -> bool:
        """Write a file unless there is one, durably before it can be seen. False: there is one, perhaps this one."""

    def list(self, area: str) -> Iterable[Item]:
        """All files below a folder."""

    def move(self, path: str, to: str) -> None:
        """Rename a file; nothing where it has gone."""

    def delete(self, paths: Iterable[str]) -> None:
        """Remove files; one that is not there is no error."""

    def clear(self, items: Iterable[Item]) -> None:
        """Remove files, but those that were changed or used since they were listed, if the place can tell."""

    def url(self, path: str) -> str:
        """Return the address by which ``xarray.open_zarr`` opens an artifact."""
