"""Manifest of an artifact, a member of its file, and the reference to it that travels between tasks."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Generic

from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt

from rille.pipeline.engine.store import archive
from rille.pipeline.engine.store.archive import BrokenError
from rille.stages.core.declare import F

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
    with archive.opened(path) as file:
        manifest: Manifest = json.loads(file.member(archive.MANIFEST, 256_000_000))
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
