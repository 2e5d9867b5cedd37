"""Files that are no images, calibrations or tables that are read: by their endings, what they are and what to do."""

from __future__ import annotations

import tomllib
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path, PurePath

from rille.datasets.text.count import count

KINDS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
"""Endings and next step by the name of a kind; the kind ``file`` is any other."""


def kind_of(name: str) -> str:
    """The kind of a file by its ending."""
    ending = PurePath(name).suffix.lower()
    return next((kind for kind, of in KINDS.items() if ending in of["endings"]), "file")


def unread(names: Iterable[str]) -> list[str]:
    """A line for each kind of file that is not read: their number, the first one, what to do."""
    groups: dict[str, list[str]] = defaultdict(list)
    for name in names:
        groups[kind_of(name)].append(name)
    more = {kind: f" and {len(of) - 1} more" if of[1:] else "" for kind, of in groups.items()}
    return [f"{count(len(of), kind)} ({of[0]}{more[kind]}): {KINDS[kind]['step']}" for kind, of in groups.items()]
