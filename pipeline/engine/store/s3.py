"""A prefix of a bucket of an S3-compatible server as a place for a store, and what to say when it fails.

Credentials, region and endpoint come from the environment alone (``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY``,
``AWS_SESSION_TOKEN``, ``AWS_REGION``, ``AWS_ENDPOINT_URL`` ...) and are never written anywhere; of a server's
answers only the error code is shown. Server errors and lost connections are tried again for half a minute, at the first
contact for a few seconds.

A commit relies on ``If-None-Match: *``: of two that write an artifact one must be refused. A server that ignores it
would let the second overwrite what was published, so the first contact with a prefix tries it, and refuses the server
if both writes succeed. That it passed is noted in the object ``rille.json`` with the endpoint it was tried at.
An artifact is one object, and an object is there whole or not at all: nothing is left over, whenever a run is killed.
"""

from __future__ import annotations

import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import lru_cache
from typing import Any, TypeVar

import obstore
from obstore.store import S3Store

from rille.pipeline.engine.store.place import FORMAT, MARK, Item
from rille.stages.core.errors import ConfigError, RilleError

AT_ONCE = 200
"""Objects deleted in one go."""

PATIENT = {"max_retries": 8, "retry_timeout": timedelta(seconds=30)}
HASTY = {"max_retries": 2, "retry_timeout": timedelta(seconds=5)}
"""For the first contact, where a wrong address is likelier than a server in trouble."""

BROKEN = 3
"""Times that a listing is begun anew because its answer was broken off."""

BACK_OFF = {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=4), "base": 2}


T = TypeVar("T")


class BucketError(RilleError):
    """The object store does not do what is asked of it."""


class OddNameError(BucketError):
    """An object has a name that no listing gives: with ``..``, an empty part or a control character."""


class Bucket:
    """Objects below a prefix, and the credentials to reach it; see
    :class:`~rille.pipeline.engine.store.place.Place`."""

    slow = True

    def __init__(self, url: str, retry: dict[str, Any] = PATIENT) -> None:
        self.location = url
        self._store = _store(url, retry)
        self._listed: dict[str, Item] | None = None
        self._earlier = False

    def begin(self) -> None:
        """The server says so at the first commit."""

    def earlier(self) -> bool:
        """Whether artifacts of an earlier format were in the bucket, by its format mark."""
        return self._earlier

    def survey(self) -> None:
        """List the artifacts: a request a thousand. Where an object of another has an odd name, each is asked for."""
        with suppress(OddNameError):
            self._listed = {item.path: item for item in self.list("artifacts")}

    def status(self, path: str, *, fresh: bool = False) -> Item | None:
        """Return the status of an object: from the survey if there is one, else by a request."""
        # A bucket takes milliseconds for each question, so tens of thousands of look-ups use the listing.
        if not fresh and self._listed is not None:
            return self._listed.get(path)

        found = self._unless_absent(lambda: _item(obstore.head(self._store, path)))
        if self._listed is not None and found is not None:
            self._listed[path] = found
        elif self._listed is not None:
            self._listed.pop(path, None)
        return found

    def read(self, path: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """Read an object, or a range of it."""
        # A range of HTTP cannot be empty.
        if start == stop:
            return b""

        options: Any = {} if stop is None else {"options": {"range": (start, stop)}}
        return self._unless_absent(lambda: bytes(obstore.get(self._store, path, **options).bytes()))

    def _unless_absent(self, read: Callable[[], T]) -> T | None:
        """Read an object, None where there is none."""

        with self._clear_errors():
            try:
                return read()
            except FileNotFoundError as error:
                if _code(error) == "NoSuchBucket":
                    raise
                return None

    def write(self, path: str, data: bytes) -> None:
        """Write an object, whatever was there."""
        with self._clear_errors():
            obstore.put(self._store, path, data, use_multipart=False)

    def create(self, path: str, pieces: Iterable[bytes]) -> bool:
        """Write an object unless there is one.

        False may also mean that an earlier try of this very call was carried out, and its answer lost.
        """
        with self._clear_errors():
            try:
                # One request: the server tests the condition once, and a multipart upload cannot create-if-absent.
                obstore.put(self._store, path, b"".join(pieces), mode="create", use_multipart=False)
            except obstore.exceptions.AlreadyExistsError:
                return False
        return True

    def delete(self, paths: Iterable[str]) -> None:
        """Remove objects."""
        chosen = list(paths)
        for start in range(0, len(chosen), AT_ONCE):
            with self._clear_errors(), suppress(FileNotFoundError):
                obstore.delete(self._store, chosen[start : start + AT_ONCE])

    def use(self, item: Item) -> Item | None:
        """Nothing: the index of a run tells what it used."""
        return item

    def clear(self, items: Iterable[Item]) -> None:
        """Remove objects: a server compares no times, the grace must do."""
        self.delete(item.path for item in items)

    def move(self, path: str, to: str) -> None:
        """Copy an object within the server, and remove it."""
        with self._clear_errors(), suppress(FileNotFoundError):
            obstore.copy(self._store, path, to)
        self.delete([path])
        if self._listed is not None:
            self._listed.pop(path, None)

    def list(self, area: str) -> list[Item]:
        """All objects."""
        with self._clear_errors():
            for trial in range(BROKEN + 1):
                try:
                    pages = obstore.list(self._store, area or None, chunk_size=1000)
                    return [_item(found) for page in pages for found in page]
                except obstore.exceptions.GenericError as error:
                    # obstore tries requests again, and readings that break off within the answer, but not a listing.
                    if trial == BROKEN or "RetryError" in str(error):
                        raise
        raise AssertionError("unreachable")

    def url(self, path: str) -> str:
        """Return the URL of an archive in fsspec's notation (fsspec needs s3fs to open it)."""
        return f"zip::{self.location}/{path}"

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        try:
            yield
        except (obstore.exceptions.BaseError, FileNotFoundError, PermissionError) as error:
            raise self._told(error) from None  # the original has the request at length

    def _told(self, error: BaseException) -> BucketError:
        text, code, bucket = str(error), _code(error), self.location.split("/")[2]
        endpoint = _endpoint()
        if isinstance(error, obstore.exceptions.InvalidPathError):
            name = re.search(r'path: (".*?")', text)
            return OddNameError(
                "RIL-766",
                f"objects of {self.location} cannot be listed: one is named {name[1] if name else 'oddly'}",
                remedy="remove it by another program; it is none of Rille's",
            )
        if code == "NoSuchBucket":
            return BucketError(
                "RIL-508", f"bucket {bucket} does not exist at {endpoint}", remedy="make it, or correct --cache"
            )
        if "169.254.169.254" in text or "169.254.170.2" in text:
            remedy = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE"
            return BucketError("RIL-509", f"no credentials for {self.location} in the environment", remedy=remedy)
        if re.search(r"\b40[13] ", text) or isinstance(error, PermissionError):
            remedy = "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN and the bucket's policy"
            return BucketError(
                "RIL-510",
                f"{endpoint} refuses the credentials for {self.location} ({code or 'forbidden'})",
                remedy=remedy,
            )
        if status := re.search(r"status code: (\d{3}[^:\n]{0,40})", text):
            what = f"answers {status[1].strip()}" + (f" ({code})" if code else "")
            return BucketError(
                "RIL-511", f"{endpoint} {what} for {self.location}", remedy="try later: what is committed stays"
            )
        return BucketError(
            "RIL-512", f"no object store answers at {endpoint} for {self.location}", remedy="check AWS_ENDPOINT_URL"
        )


def _item(found: Any) -> Item:
    # A server that gives no tag says nothing of changes: "None" as a mark would be that of every content.
    mark = (found["e_tag"] or "").strip('"')
    return Item(found["path"], found["size"], mark, found["last_modified"].timestamp())


def _code(error: BaseException) -> str:
    found = re.search(r"<Code>(\w{1,60})</Code>", str(error))
    return found[1] if found else ""


def _endpoint() -> str:
    """Host and port alone: a URL may hold a password."""
    url = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT")
    return re.sub(r"^\w+://(.*@)?", "", url).split("/")[0] if url else "AWS"


def _store(url: str, retry: dict[str, Any]) -> Any:
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
    earlier = _try(Bucket(url, HASTY), endpoint)
    bucket = Bucket(url)
    bucket._earlier = earlier
    return bucket


def _try(bucket: Bucket, endpoint: str) -> bool:
    """Whether artifacts of an earlier format were there; the mark is written where it says anything else than now."""
    mark, now = bucket.read(MARK), {"format": FORMAT, "create_if_absent": endpoint}
    found: dict[str, Any] = {}
    with suppress(ValueError, TypeError):
        found = dict(json.loads(mark or b"{}"))
    earlier = bool(found.get("format", FORMAT) != FORMAT)
    if found.get("create_if_absent") == endpoint:
        if earlier:
            with suppress(BucketError):  # the credentials may permit reading alone
                bucket.write(MARK, json.dumps(now).encode())
        return earlier
    path, first = f"probe/{uuid.uuid4().hex}", os.urandom(16)
    refused = False
    try:
        bucket.create(path, [first])
        refused = not bucket.create(path, [first[::-1]])
        kept = bucket.read(path)
    finally:
        with suppress(BucketError):
            bucket.delete([path])
    if not refused or kept != first:
        raise BucketError(
            "RIL-516",
            f"{endpoint} ignores If-None-Match: of two runs on {bucket.location} one could overwrite what the other has"
            " published, so this store is not used",
            remedy="use a server that honours it (AWS S3, MinIO, Ceph, R2 in recent versions), or a folder as cache",
        )
    bucket.write(MARK, json.dumps(now).encode())
    return earlier
