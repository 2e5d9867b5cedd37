"""Warnings about the input: one line each, beginning with the code of the message."""

from __future__ import annotations


def warning(code: str, text: str) -> str:
    """Format a warning as one line: the code of the message, then ``text``.

    ``text`` states the problem, with its value and where it is (file, camera or frame).

    >>> warning("RIL-680", "cam0: 2 images are not there")
    'RIL-680: cam0: 2 images are not there'
    """
    return f"{code}: {text}"
