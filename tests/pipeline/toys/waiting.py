"""What worker processes do beside tasks."""

from __future__ import annotations

import os
from pathlib import Path


def note(name: str) -> None:
    """Leave a file of that name; refuse what is called bad, and die of what is called deadly."""
    path = Path(name)
    path.touch()
    if path.name == "bad":
        raise ValueError(name)
    if path.name == "deadly":
        os._exit(9)


def answer(word: str) -> str:
    """The one task."""
    return word.upper()
