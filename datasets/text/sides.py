"""The camera in names of files and folders: tokens of left and right, and words that tell two cameras apart."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

from rille.datasets.text.names import shell_word
from rille.datasets.text.order import STAMP, natural
from rille.datasets.text.times import undated

SIDES: tuple[tuple[str, str], ...] = (
    ("left", "right"),
    *(("links", "rechts"), ("gauche", "droite"), ("izquierda", "derecha"), ("sinistra", "destra")),
    ("左", "右"),
    *((f"{name}{mark}0", f"{name}{mark}1") for name in ("cam", "camera") for mark in ("", "_", "-")),
    *((f"{name}0", f"{name}1") for name in ("image_", "image_0", "im", "view")),
    *((f"{name}2", f"{name}3") for name in ("image_", "image_0")),
    *((f"{name}1", f"{name}2") for kind in ("infra", "infrared", "ir") for name in (kind, f"{kind}_", f"{kind}-")),
    ("i1", "i2"),
    ("lcam", "rcam"),
    ("l", "r"),
)
"""Tokens that name the left and the right camera in file and folder names, the surest first."""

CAMERA_NUMBER = re.compile(r"(?<![a-z])cam(era)?[_-]?\d+$", re.I)
"""End of a name that numbers a camera, any two numbers of which are two cameras."""


def _token(word: str) -> re.Pattern[str]:
    """Pattern of a side's token, not within a longer word; capitals begin a word: ``imgL``, ``leftImg``."""
    digits = r"(?!\d)" if word[-1].isdigit() else ""
    small, capitals = rf"(?<![A-Za-z]){word}(?![a-z])", rf"(?<![A-Z]){word.upper()}(?![A-Za-z])"
    return re.compile(rf"({small}|(?<![A-Z]){word.capitalize()}(?![a-z])|{capitals}){digits}")


TOKENS = tuple(tuple(_token(word) for word in sides) for sides in SIDES)


def side_of(name: str) -> tuple[int, int, str] | None:
    """The token of a name: (row of ``SIDES``, 0 left or 1 right, name without the token), or None."""
    for row, patterns in enumerate(TOKENS):
        for side, pattern in enumerate(patterns):
            neutral, count = pattern.subn("*", name)
            if count:
                return row, side, neutral
    return None


def two_sides(names: Iterable[str]) -> list[tuple[str, str]]:
    """Left and right names that differ in the side's token alone."""
    sides: dict[tuple[int, str], dict[int, str]] = defaultdict(dict)
    for name in names:
        row, side, neutral = side_of(name) or (0, 0, "")
        while (more := side_of(neutral)) is not None and more[1] == side:  # left/L_07
            neutral = more[2]
        if neutral:
            sides[row, neutral][side] = name
    return [(of[0], of[1]) for of in sides.values() if len(of) == 2]


def by_one_word(names: Sequence[str], *, timed: bool = False) -> dict[str, list[int]]:
    """Indices of names by the two words that distinguish names of pairs, as A/07 and B/07, or A/X_07 and B/Y_07.

    In natural order of the words; empty unless exactly one position of words does so, those that repeat it aside. Of
    several one that numbers cameras is taken, or one whose words differ by more than a number: A/0, A/1, B/0 and B/1
    are two frames of A and of B.
    ``timed``: time stamps in the names aside, which may differ between the cameras.
    """
    words = [re.split(r"([^\W_]+)", STAMP.sub("", undated(name)) if timed else name) for name in names]
    longest = max(map(len, words), default=0)
    # Of names with unlike numbers of words the last ones are compared, if the first tell nothing: a_b/cam_3, c/cam_3.
    behind = [[""] * (longest - len(split)) + split for split in words]
    finer = [re.split(r"(\d+)", "".join(split)) for split in words]  # img0000c1
    return next(filter(None, (_by_one_word(of, timed) for of in (words, behind, finer))), {})


def _by_one_word(words: Sequence[list[str]], timed: bool) -> dict[str, list[int]]:
    """Indices of names, parted into ``words`` and what is between them."""
    found, numbered = list[dict[str, list[int]]](), list[dict[str, list[int]]]()
    places = range(1, min(map(len, words), default=0), 2)
    halves = {k: [w[k] == words[0][k] for w in words] for k in places if len({w[k] for w in words}) == 2}
    for k, half in halves.items():
        # Of several words that tell the two apart, as a serial number in a folder of its own, the first.
        repeated = [j for j, other in halves.items() if other == half]
        if repeated[0] != k:
            continue
        kinds = sorted({split[k] for split in words}, key=natural)
        parts = {kind: [i for i, split in enumerate(words) if split[k] == kind] for kind in kinds}
        rest = [{tuple(w for j, w in enumerate(words[i]) if j not in repeated) for i in of} for of in parts.values()]
        cameras = all(CAMERA_NUMBER.search("".join(split[: k + 1])) for split in words)
        if rest[0] == rest[1] and (len(rest[0]) > 1 or cameras or (timed and min(map(len, parts.values())) > 1)):
            found.append(parts)
            numbered += [parts] if cameras else []
    named = [parts for parts in found if len({re.sub(r"\d+", "", word) for word in parts}) == 2]
    found = numbered or named if found[1:] else found
    return found[0] if len(found) == 1 else {}


def without_side(stem: str, side: int) -> str:
    """A file's stem without its side's token: ``cam_left_07`` and ``cam_right_07`` are both ``cam_*_07``."""
    found = side_of(stem)
    return found[2] if found is not None and found[1] == side else stem


def of_one_camera(folder: Path) -> str:
    """Remedy for a folder that is named as the images of one camera; empty for any other."""
    both = shell_word(folder.parent if folder.name else folder.resolve().parent)
    one = f"if {folder} holds the images of one camera, give the folder of both: `rille init {both}`; else "
    return one if side_of(folder.resolve().name) is not None else ""
