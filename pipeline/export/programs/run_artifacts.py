"""The artifacts that a run refers to, by their labels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rille.pipeline.engine import events
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import InputError


def check_new(target: Path) -> None:
    """Refuse a folder with something in it."""
    if target.exists() and any(target.iterdir()):
        raise InputError("RIL-607", f"{target} is not empty", remedy="give a new folder with --output")


STOP = re.compile(r"risk/(\d{1,9})")
"""Label of the hazards that a drive knew at a stop."""


class RunArtifacts:
    """What a run's ledger refers to."""

    def __init__(self, run: Path, store: Store) -> None:
        path = run / "ledger.jsonl"
        if not path.is_file():
            raise InputError(
                "RIL-608", f"{run} holds no ledger.jsonl", remedy="give the folder of a run, e.g. runs/mockup/latest"
            )
        self.store = store
        self.rows = [row for row in events.read(path) if row["status"] in ("computed", "cached") and "key" in row]

    def find(self, label: str) -> Bundle | None:
        """The artifact of exactly this label, if the run has it."""
        row = next((r for r in self.rows if r["label"] == label), None)
        return None if row is None else self._open(row)

    def one(self, label: str, *, last: bool = False) -> Bundle:
        """The artifact of this label, else the first (or last) whose label begins with it."""
        # With the slash, "merge" does not find a stage whose name merely begins so.
        begun = [r for r in self.rows if f"{r['label']}/".startswith(f"{label}/")]
        rows = [r for r in begun if r["label"] == label] or begun
        if not rows:
            raise InputError(
                "RIL-609",
                f"the run has no {label}",
                remedy="run the same command again if it was stopped; else its report says what failed",
            )
        return self._open(rows[-1 if last else 0])

    def world(self) -> tuple[Bundle, list[Bundle], Bundle | None]:
        """Risk map of the world, tiles of its terrain, and the path over it, if there is one.

        Of a drive they are what it knew at its last stop, and there is no path.
        """
        stops = [int(found[1]) for row in self.rows if (found := STOP.fullmatch(row["label"]))]
        if stops and self.find("risk/world") is None:
            return self.one(f"risk/{max(stops)}"), [self.one(f"merge/{max(stops)}")], None
        return self.one("risk/world"), self.all("merge"), self.find("path/world")

    def all(self, stage: str) -> list[Bundle]:
        """All artifacts of a stage."""
        return [self._open(row) for row in self.rows if row["stage"] == stage]

    def pairs(self, first: str, second: str) -> list[tuple[Bundle, Bundle]]:
        """Artifacts of two stages with the same rest of the label."""
        mine = {
            name: {r["label"].partition("/")[2]: r for r in self.rows if r["stage"] == name} for name in (first, second)
        }
        return [(self._open(r), self._open(mine[second][k])) for k, r in mine[first].items() if k in mine[second]]

    def _open(self, row: Mapping[str, Any]) -> Bundle:
        ref = self.store.lookup(str(row["stage"]), str(row["key"]))
        if ref is None:
            raise InputError(
                "RIL-610", f"{row['label']} is not in the cache", remedy="name the run's cache with --cache"
            )
        return self.store.open(ref)
