"""Requests to one prefix of a bucket of an S3-compatible server, and what to say when they fail.

Credentials, region and endpoint come from the environment alone (``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY``,
``AWS_SESSION_TOKEN``, ``AWS_REGION``, ``AWS_ENDPOINT_URL`` ...) and are never written anywhere; of what a server
answers only its error code is told. Server errors and lost connections are tried again for half a minute, at the first
contact for a few seconds.

A commit relies on ``If-None-Match: *``: of two that write a manifest one must be refused. A server that ignores it
would let the second overwrite what was published, so the first contact with a prefix tries it, and refuses the server
if both writes succeed. That it passed is noted in the object ``rille.json`` with the endpoint it was tried at.
"""

from __future__ import annotations

import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from typing import Any, TypeVar

from stages.core.errors import ConfigError, RilleError

PARALLEL = 16
"""Requests under way at once."""

FORMAT = 1
MARK = "rille.json"

PATIENT = {"max_retries": 8, "retry_timeout": timedelta(seconds=30)}
HASTY = {"max_retries": 2, "retry_timeout": timedelta(seconds=5)}
"""For the first contact, where a wrong address is likelier than a server in trouble."""

BROKEN = 3
"""Answers broken off, of one reading, before the last try."""

BACK_OFF = {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=4), "base": 2}


T = TypeVar("T")


class BucketError(RilleError):
    """The object store does not do what is asked of it."""


class OddNameError(BucketError):
    """An object has a name that no listing gives: with ``..``, an empty part or a control character."""


@dataclass(frozen=True)
class Entry:
    """One object of a listing; ``modified`` in seconds since 1970, by the server's clock."""

    path: str
    size: int
    etag: str
    modified: float


class Bucket:
    """Objects below a prefix."""

    def __init__(self, url: str, retry: dict[str, Any] = PATIENT) -> None:
        self.url = url
        self._store = _store(url, retry)

    def get(self, path: str) -> tuple[bytes, str] | None:
        """Content and ETag of an object; None if there is none."""
        import obstore

        def fetch() -> tuple[bytes, str] | None:
            try:
                found = obstore.get(self._store, path)
                return bytes(found.bytes()), str(found.meta["e_tag"])
            except FileNotFoundError as error:
                if _code(error) == "NoSuchBucket":
                    raise
                return None

        return self._again(fetch)

    def _again(self, read: Callable[[], T]) -> T:
        """Read once more where the connection broke within an answer: that is not tried again below."""
        import obstore

        with self._clear_errors():
            for _ in range(BROKEN):
                with suppress(obstore.exceptions.GenericError):
                    return read()
            return read()

    def get_all(self, paths: Iterable[str]) -> dict[str, tuple[bytes, str] | None]:
        """Several at once."""
        chosen = list(paths)
        if len(chosen) < 2:
            return {path: self.get(path) for path in chosen}
        with ThreadPoolExecutor(PARALLEL) as pool:
            return dict(zip(chosen, pool.map(self.get, chosen), strict=True))

    def put(self, path: str, data: bytes) -> None:
        """Write an object, whatever was there."""
        import obstore

        with self._clear_errors():
            obstore.put(self._store, path, data)

    def put_all(self, objects: dict[str, bytes]) -> None:
        """Several at once; all of them are there when it returns."""
        with ThreadPoolExecutor(PARALLEL) as pool:
            list(pool.map(self.put, objects, objects.values()))

    def create(self, path: str, data: bytes) -> bool:
        """Write an object unless there is one; whether it was written.

        False may also mean that an earlier try of this very call was carried out, and its answer lost.
        """
        import obstore

        with self._clear_errors():
            try:
                obstore.put(self._store, path, data, mode="create", use_multipart=False)
            except obstore.exceptions.AlreadyExistsError:
                return False
        return True

    def delete(self, paths: Iterable[str]) -> None:
        """Remove objects; one that is not there is no error."""
        import obstore

        chosen = list(paths)
        with self._clear_errors(), suppress(FileNotFoundError):
            if chosen:
                obstore.delete(self._store, chosen)

    def list(self, prefix: str) -> list[Entry]:
        """All objects below a prefix."""
        import obstore

        def pages() -> list[Entry]:
            return [
                Entry(found["path"], found["size"], str(found["e_tag"]), found["last_modified"].timestamp())
                for page in obstore.list(self._store, prefix, chunk_size=1000)
                for found in page
            ]

        return self._again(pages)

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        import obstore

        try:
            yield
        except (obstore.exceptions.BaseError, FileNotFoundError, PermissionError) as error:
            raise self._told(error) from None  # the original has the request at length

    def _told(self, error: BaseException) -> BucketError:
        import obstore

        text, code, bucket = str(error), _code(error), self.url.split("/")[2]
        endpoint = _endpoint()
        if isinstance(error, obstore.exceptions.InvalidPathError):
            name = re.search(r'path: (".*?")', text)
            return OddNameError(
                "RIL-766",
                f"objects of {self.url} cannot be listed: one is named {name[1] if name else 'oddly'}",
                remedy="remove it by another program; it is none of Rille's",
            )
        if code == "NoSuchBucket":
            return BucketError(
                "RIL-508", f"bucket {bucket} does not exist at {endpoint}", remedy="make it, or correct --cache"
            )
        if "169.254.169.254" in text or "169.254.170.2" in text:
            remedy = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE"
            return BucketError("RIL-509", f"no credentials for {self.url} in the environment", remedy=remedy)
        if re.search(r"\b40[13] ", text) or isinstance(error, PermissionError):
            remedy = "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN and the bucket's policy"
            return BucketError(
                "RIL-510", f"{endpoint} refuses the credentials for {self.url} ({code or 'forbidden'})", remedy=remedy
            )
        if status := re.search(r"status code: (\d{3}[^:\n]{0,40})", text):
            what = f"answers {status[1].strip()}" + (f" ({code})" if code else "")
            return BucketError(
                "RIL-511", f"{endpoint} {what} for {self.url}", remedy="try later: what is committed stays"
            )
        return BucketError(
            "RIL-512", f"no object store answers at {endpoint} for {self.url}", remedy="check AWS_ENDPOINT_URL"
        )


def _code(error: BaseException) -> str:
    found = re.search(r"<Code>(\w{1,60})</Code>", str(error))
    return found[1] if found else ""


def _endpoint() -> str:
    """Host and port alone: a URL may hold a password."""
    url = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT")
    return re.sub(r"^\w+://(.*@)?", "", url).split("/")[0] if url else "AWS"


def _store(url: str, retry: dict[str, Any]) -> Any:
    from obstore.store import S3Store

    bucket, _, prefix = url.removeprefix("s3://").partition("/")
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    options: Any = {"timeout": "30s", "connect_timeout": "4s"}
    if endpoint.startswith("http://"):
        options["allow_http"] = True
    config: Any = {"endpoint": endpoint} if endpoint else {}
    if "AWS_REGION" not in os.environ:
        config["region"] = os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
    patience: Any = {**retry, "backoff": BACK_OFF}
    extra: dict[str, Any] = {}
    if os.environ.get("AWS_PROFILE") and not os.environ.get("AWS_ACCESS_KEY_ID"):
        extra["credential_provider"] = _profile()
    try:
        return S3Store(
            bucket,
            prefix=prefix or None,
            config=config,
            client_options=options,
            retry_config=patience,
            **extra,
        )
    except Exception as error:
        reason = str(error).splitlines()[0][:120]
        raise ConfigError(
            "RIL-513", f"the environment does not describe an object store: {reason}", remedy="check AWS_*"
        ) from None


def _profile() -> Any:
    try:
        from obstore.auth.boto3 import Boto3CredentialProvider
    except ImportError:
        raise ConfigError(
            "RIL-514",
            "AWS_PROFILE is read with boto3, which is not installed",
            remedy="pip install boto3, or set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
        ) from None
    try:
        return Boto3CredentialProvider()
    except Exception as error:
        raise ConfigError(
            "RIL-515", f"AWS_PROFILE: {str(error).splitlines()[0][:120]}", remedy="check ~/.aws/config"
        ) from None


def connect(url: str) -> Bucket:
    """The bucket of a cache, its server tried; once a process.

    Raises
    ------
    BucketError
        The server does not answer, refuses, has no such bucket, or ignores ``If-None-Match``.
    """
    return _connect(url, os.getpid(), _endpoint())


@lru_cache(maxsize=8)
def _connect(url: str, process: int, endpoint: str) -> Bucket:
    _try(Bucket(url, HASTY), endpoint)
    return Bucket(url)


def _try(bucket: Bucket, endpoint: str) -> None:
    mark = bucket.get(MARK)
    with suppress(ValueError, AttributeError):
        if mark is not None and json.loads(mark[0]).get("create_if_absent") == endpoint:
            return
    path, first = f"probe/{uuid.uuid4().hex}", os.urandom(16)
    refused = False
    try:
        bucket.create(path, first)
        refused = not bucket.create(path, first[::-1])
        kept = bucket.get(path)
    finally:
        with suppress(BucketError):
            bucket.delete([path])
    if not refused or kept is None or kept[0] != first:
        raise BucketError(
            "RIL-516",
            f"{endpoint} ignores If-None-Match: of two runs on {bucket.url} one could overwrite what the other has"
            " published, so this store is not used",
            remedy="use a server that honours it (AWS S3, MinIO, Ceph, R2 in recent versions), or a folder as cache",
        )
    bucket.put(MARK, json.dumps({"format": FORMAT, "create_if_absent": endpoint}).encode())
