"""Numbers of things in words."""

from __future__ import annotations


def count(n: int, what: str) -> str:
    """``1 task``, ``3 tasks``."""
    return f"{n} {what}{'' if n == 1 else 's'}"
