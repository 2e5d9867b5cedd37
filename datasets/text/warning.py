"""Warnings about the input: one line each, which begins with the code of its message."""

from __future__ import annotations


def warning(code: str, text: str) -> str:
    """Line of a warning; ``text`` says what is suspicious, with the figure and the place.

    >>> warning("RIL-680", "cam0: 2 images are not there")
    'RIL-680: cam0: 2 images are not there'
    """
    return f"{code}: {text}"
