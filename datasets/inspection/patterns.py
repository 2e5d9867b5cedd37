"""Patterns of files, relative to a folder, as a manifest states them."""

from __future__ import annotations

import glob
from itertools import takewhile
from pathlib import Path


def pattern(paths: list[Path], folder: Path) -> str:
    """The narrowest simple pattern of a set of files in one folder, or in folders of one depth."""
    names = [path.name for path in paths]
    if len({path.suffix for path in paths}) > 1:  # searches ignore the case of suffixes
        names = [path.stem + path.suffix.lower() for path in paths]
    below = {path.parent.relative_to(folder).parts for path in paths}
    alike = [glob.escape(min(part)) if len(set(part)) == 1 else "*" for part in zip(*below, strict=False)]
    place = "".join(f"{part}/" for part in (alike if len(set(map(len, below))) == 1 else ["**"]))
    if len(set(names)) == 1:
        return place + glob.escape(names[0])
    head = _common_start(names).rstrip("0123456789")
    tail = _common_start([name[len(head) :][::-1] for name in names])[::-1].lstrip("0123456789")
    if len({path.suffix.lower() for path in paths}) > 1:  # *g of .png and .jpg
        tail = ""
    return f"{place}{glob.escape(head)}*{glob.escape(tail)}"


def _common_start(words: list[str]) -> str:
    """Common beginning of all words."""
    return "".join(of[0] for of in takewhile(lambda letters: len(set(letters)) == 1, zip(*words, strict=False)))


def relative(path: Path, folder: Path) -> str:
    """Path relative to the folder, as in a manifest."""
    return path.relative_to(folder).as_posix()
