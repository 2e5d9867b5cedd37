"""A run as its ledger and artifacts alone, for what exports runs."""

from __future__ import annotations

import json
from pathlib import Path

from rille.stages.core.declare import Bundle


class Artifacts:
    """A store whose references are labels."""

    def __init__(self, made: dict[str, Bundle]) -> None:
        self.made = made

    def lookup(self, stage: str, key: str) -> str:
        return key

    def open(self, ref: str) -> Bundle:
        return self.made[ref]


def recorded(folder: Path, made: dict[str, Bundle]) -> Artifacts:
    """Write the ledger of a run that made these artifacts; gives its store."""
    rows = [{"label": name, "stage": name.split("/")[0], "status": "computed", "key": name} for name in made]
    (folder / "ledger.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return Artifacts(made)
