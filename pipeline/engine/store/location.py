"""Location of a cache: a folder, or ``s3://bucket/prefix``; and the local folder of its hints.

Hints speed up or explain a run and never change a result: the keys of earlier tasks, digests of image files, costs of
tasks. They belong to one machine. If the cache is in a bucket, they are kept in a local folder (``RILLE_LOCAL``, else
``.rille/local``).
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import quote, urlsplit

from rille.stages.core.errors import ConfigError

Location = Path | str
"""A folder, or the URL of a bucket with a prefix."""

_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_PREFIX = re.compile(r"[A-Za-z0-9._=/-]*")


def locate(given: Path | str) -> Location:
    """A folder as a path, a URL in its one form ``s3://bucket/prefix``.

    Raises
    ------
    ConfigError
        It is a URL, but none of a bucket; the message does not repeat what may be a password.
    """
    text = str(given)
    if isinstance(given, Path) and re.match(r"[a-z0-9]+:/[^/]", text):
        text = text.replace(":/", "://", 1)  # a path has lost the second slash
    if "://" not in text:
        return Path(given)
    remedy = "give --cache s3://bucket/prefix, and credentials in the environment (AWS_ACCESS_KEY_ID ...)"
    parts = urlsplit(text)
    if parts.scheme != "s3":
        raise ConfigError("RIL-546", f"a cache at {parts.scheme}:// is not supported", remedy=remedy)
    # A password in the address would end up in ledgers, logs and process lists.
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise ConfigError("RIL-547", "the URL of the cache has more than bucket and prefix", remedy=remedy)
    prefix = "/".join(p for p in parts.path.split("/") if p)
    if not _BUCKET.fullmatch(parts.netloc):
        raise ConfigError("RIL-548", f"{parts.netloc!r} is no name of a bucket", remedy=remedy)
    if not _PREFIX.fullmatch(prefix) or {".", ".."} & set(prefix.split("/")):
        raise ConfigError(
            "RIL-549", f"{prefix!r} is no prefix for a cache: letters, digits and ._=- only", remedy=remedy
        )
    return f"s3://{parts.netloc}/{prefix}".rstrip("/")


def folder_of(sequence: str) -> str:
    """Name of the folder of what is kept by sequence; no name leads out of where it lies."""
    return quote(sequence, safe="").replace(".", "%2E") or "-"


def hints_folder(cache: Location) -> Path:
    """Return the local folder for the hints of a cache.

    It is the cache's own folder, or for ``s3://bucket/prefix`` the folder ``bucket+prefix`` below ``RILLE_LOCAL``
    (default ``.rille/local``).
    """
    if isinstance(cache, Path):
        return cache
    base = Path(os.environ.get("RILLE_LOCAL") or ".rille/local")
    return base / cache.removeprefix("s3://").replace("/", "+")
