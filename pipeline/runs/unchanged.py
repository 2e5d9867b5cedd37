"""Whether the latest run holds already what a run that computed nothing would write: then it stands as it is.

Each complete run leaves ``stamp.json``: a digest of all that its files are rendered from (the keys and digests of its
artifacts, configuration and command, facts of the sequence, source code with templates and styles, versions of
packages), and size and checksum of each file. A later run with the same digest, over files that nobody touched, would
write the same but for its own time; so the earlier folder, with its true times, is what it delivers.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from datasets.protocol import Sequence
from pipeline.engine.store.artifact import crc32c
from pipeline.engine.code_digest import module_digests
from pipeline.engine.graph import Graph
from pipeline.engine.keys import digest

FILE = "stamp.json"


def stamp(graph: Graph, sequence: Sequence, versions: Mapping[str, str], **facts: Any) -> str:
    """Digest of all that the files of a run are rendered from; ``facts`` are what only the run knows."""
    here = Path(__file__).parent
    beside = [p for p in sorted(here.rglob("*")) if p.is_file() and p.suffix not in (".py", ".pyc")]
    return digest(
        {
            # the order in which tasks were laid out depends on the order of results
            "tasks": sorted([h.label, h.key, "" if h.ref is None else h.ref.digest] for h in graph.nodes),
            "sequence": {f.name: _plain(getattr(sequence, f.name)) for f in fields(sequence)},
            "code": module_digests("pipeline.runs.session"),
            "data": {p.relative_to(here).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in beside},
            "versions": dict(versions),
            "facts": _plain(facts),
        }
    )


def _plain(value: Any) -> Any:
    """Canonical form of what a sequence consists of; of a function, only that it is there (its tasks have keys)."""
    for method in ("to_dict", "to_list"):
        if hasattr(value, method):
            return getattr(value, method)()
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if callable(value) and not isinstance(value, BaseModel):
        return "function"
    return value


def seal(folder: Path, stamped: str) -> None:
    """Write the stamp of a finished run over the files that are there."""
    written = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    files = {p.relative_to(folder).as_posix(): [p.stat().st_size, crc32c(p)] for p in written}
    temporary = folder / f".{FILE}.tmp"
    temporary.write_text(json.dumps({"stamp": stamped, "files": files}, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, folder / FILE)


def stands(folder: Path, stamped: str) -> bool:
    """Whether a folder has this stamp, and its files are as they were written."""
    try:
        found = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return bool(found["stamp"] == stamped) and all(
            (folder / name).stat().st_size == size and crc32c(folder / name) == crc
            for name, (size, crc) in found["files"].items()
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False
