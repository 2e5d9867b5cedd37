"""``rille cache ls``: what the cache holds, by sequence and stage, and which run used it last."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from rille.pipeline.engine.memory.limits import words
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.location import Location
from rille.pipeline.engine.store.maintenance import artifacts
from rille.pipeline.engine.store.manifest import reference
from rille.pipeline.runs import lookup, pins, roots

NOBODY = "-"
"""Stands for the sequence of artifacts that no kept run refers to: clearing up would remove them."""


@dataclass
class Holding:
    """Artifacts of one stage that runs of one sequence used last; times are seconds since 1970."""

    sequence: str
    stage: str
    artifacts: int = 0
    bytes: int = 0
    stored: int = 0
    oldest: float = float("inf")
    newest: float = 0.0
    last_run: str = NOBODY
    pinned: int = 0


def holdings(store: Store, folder: Path) -> list[Holding]:
    """List the artifacts by sequence and stage: the largest sequence first, its stages in order of size."""
    used = lookup.keys(roots.folders(store, folder))
    pinned_by = {key: found["run"] for found in pins.pins(store) for key in found["keys"]}
    found: dict[tuple[str, str], Holding] = {}
    for stage, key in artifacts(store):
        manifest = store.manifest(stage, key)
        if manifest is None:
            continue
        ref = reference(manifest)
        # A pin outlives the folder of its run.
        run = used.get(key) or pinned_by.get(key, NOBODY)
        sequence = run.partition("/")[0]
        row = found.setdefault((sequence, stage), Holding(sequence, stage))
        made = float(manifest["provenance"].get("started", 0.0))
        row.artifacts, row.bytes, row.stored = row.artifacts + 1, row.bytes + ref.nbytes, row.stored + ref.stored
        row.oldest, row.newest = min(row.oldest, made), max(row.newest, made)
        row.last_run = max(row.last_run, run, key=lambda r: r.rpartition("/")[2])
        row.pinned += key in pinned_by
    whole: dict[str, int] = {}
    for row in found.values():
        whole[row.sequence] = whole.get(row.sequence, 0) + row.stored
    return sorted(found.values(), key=lambda r: (-whole[r.sequence], r.sequence, -r.stored, r.stage))


def describe(rows: list[Holding], pinned: Iterable[str]) -> Iterable[str]:
    """Lines of the table."""
    yield f"{'sequence':20s} {'stage':18s} {'count':>6s} {'on disk':>8s} {'decoded':>8s} {'age':>11s}  last used by"
    for r in rows:
        age = _age(r.newest) if _age(r.newest) == _age(r.oldest) else f"{_age(r.newest)}..{_age(r.oldest)}"
        run = "no kept run" if r.last_run == NOBODY else r.last_run.rpartition("/")[2]
        run += f", {r.pinned} pinned" if r.pinned else ""
        amounts = f"{r.artifacts:6d} {words(r.stored):>8s} {words(r.bytes):>8s}"
        yield f"{r.sequence:20s} {r.stage:18s} {amounts} {age:>11s}  {run}"
    yield f"{sum(r.artifacts for r in rows)} artifacts, {words(sum(r.stored for r in rows))} on disk"
    yield from (f"pinned: {name}" for name in pinned)


def ls(cache: Location, folder: Path, *, as_json: bool) -> int:
    """Print what the cache holds."""
    store = Store(cache)
    rows = holdings(store, folder)
    if as_json:
        print(json.dumps([asdict(r) for r in rows], indent=1))
        return 0
    for line in describe(rows, [found["run"] for found in pins.pins(store)]):
        print(line)
    return 0


def _age(made: float) -> str:
    seconds = max(0.0, time.time() - made)
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"
