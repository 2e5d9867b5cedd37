"""Sets of left and right images of a folder: by tokens in their names, or by the one word in which they differ.

A set has one place: a folder without the words of cameras, and a kind of names in it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from rille.datasets.inspection.patterns import relative
from rille.datasets.text.order import natural
from rille.datasets.text.sides import CAMERA_NUMBER, SIDES, by_one_word, side_of

Named = dict[tuple[int, str], list[tuple[str, int, Path]]]
"""Names without the side's token, side and path of images by the number of the token and their folder without it."""

Sets = dict[tuple[int, str], tuple[list[Path], list[Path]]]
"""Left and right images by the number of the tokens in their names (``SIDES``), and their place."""


def _by_token(images: list[Path], names: list[str]) -> Sets:
    """Images whose names have a side's token, in sets of one place; a set may have one side alone."""
    named: Named = defaultdict(list)
    groups: Sets = defaultdict(lambda: ([], []))
    for path, name in zip(images, names, strict=True):
        if (at := side_of(name)) is not None:
            row, side, neutral = at
            named[row, neutral.rpartition("/")[0]].append((neutral, side, path))
    for (row, place), found in _of_one_kind(named):
        of_side = [{neutral: None for neutral, side, _ in found if side == wanted} for wanted in (0, 1)]
        neutrals = [neutral for neutral in of_side[0] if neutral in of_side[1]]
        # Two sets in one folder: day1_left_07 and day2_left_07; loc_cam0_17 and pan_cam0_18.
        words = {neutrals[i]: word for word, of in by_one_word(neutrals).items() for i in of}
        kinds = [] if words else [_beginning(neutral) for neutral in neutrals]
        apart = len(set(kinds)) in (2, 3) and all(
            kinds.count(k) > 1 and re.search(r"[^\W\d_]{2}", k) for k in set(kinds)
        )
        for neutral, side, path in found:
            word = _beginning(neutral) if apart else words.get(neutral, "")
            groups[row, f"{place} {word}"][side].append(path)
    return groups


def _beginning(name: str) -> str:
    """A name of a file, of which nothing is known but that it counts, up to its first number."""
    return re.split(r"\d", name.rpartition("/")[2])[0]


def _of_both_sides(groups: Sets) -> Sets:
    """The sets with both sides: one of each place; one of all numbered places, if each holds a frame; else one of the
    only left and the only right images."""
    both = {key: sides for key, sides in groups.items() if all(sides)}
    frames = {(row, re.sub(r"\d+", "", place)) for row, place in both}
    if len(frames) == 1 and all(len(left) == len(right) == 1 for left, right in both.values()):
        alike = [sides for (row, place), sides in groups.items() if (row, re.sub(r"\d+", "", place)) in frames]
        return {min(both): ([p for left, _ in alike for p in left], [p for _, right in alike for p in right])}
    left, right = ([key for key, sides in groups.items() if sides[side]] for side in (0, 1))
    if not both and len(left) == len(right) == 1 and left[0][0] == right[0][0]:  # colour_left, mono_right
        return {left[0]: (groups[left[0]][0], groups[right[0]][1])}
    return both


def _by_word(images: list[Path], names: list[str], both: Sets) -> dict[str, list[Path]]:
    """Images by the one word in which the names of two cameras differ; empty if tokens tell more, or no word does."""
    # Tokens that make single pairs, and numbers that leave images over or stand in folders of numbered cameras, may be
    # numbers of frames: A/image_0 to A/image_2, B/image_0 to B/image_2.
    numbers = sum(len(of) for sides in both.values() for of in sides) < len(images)
    numbers |= all(CAMERA_NUMBER.search(name.rpartition("/")[0]) for name in names)
    if any(min(map(len, of)) > 1 and not (numbers and SIDES[k][0][-1] == "0") for (k, _), of in both.items()):
        return {}
    words = by_one_word(names) or by_one_word(names, timed=True)
    parts = {word: [images[i] for i in of] for word, of in words.items()}
    lefts = {path for left, _ in both.values() for path in left}
    return {} if both and any(lefts <= set(of) for of in parts.values()) else parts


def sets_of(folder: Path, images: list[Path]) -> tuple[Sets, dict[str, list[Path]], list[int]]:
    """Sets of both sides by tokens, images by the one word that differs, and the numbers of left and right images."""
    names = [relative(path.with_suffix(""), folder) for path in images]
    groups = _by_token(images, names)
    both = _of_both_sides(groups)
    return both, _by_word(images, names, both), [sum(len(sides[s]) for sides in groups.values()) for s in (0, 1)]


def by_place(folder: Path, parts: dict[str, list[Path]]) -> Sets:
    """Images by camera, a set for each folder without the words of cameras, and for each beginning of names in it,
    unless each has one frame, or one side."""
    for whole in (True, False):
        places: Sets = defaultdict(lambda: ([], []))
        for side, images in enumerate(parts.values()):
            for path in images:
                words = re.split(r"([^\W_]+)", relative(path.parent, folder))
                kind = _beginning(path.stem) if whole else ""  # loc_0_17 and pan_0_18
                places[0, "".join("*" if word in parts else word for word in words) + kind][side].append(path)
        if all(map(all, places.values())) and any(min(map(len, of)) > 1 for of in places.values()):
            return places
    left, right = parts.values()
    return {(0, ""): (left, right)}


def _of_one_kind(named: Named) -> Iterator[tuple[tuple[int, str], list[tuple[str, int, Path]]]]:
    """Images of one place and kind, or of several kinds in turns (1.png, 2.jpg, 3.png), with the place's name."""
    for (row, place), found in named.items():
        kinds = defaultdict(list)
        for neutral, side, path in found:
            kinds[path.suffix.lower()].append((neutral, side, path))
        row_of_kinds = [path.suffix.lower() for _, _, path in sorted(found, key=lambda of: (of[1], natural(of[0])))]
        changes = sum(a != b for a, b in pairwise(row_of_kinds))
        shapes = {re.sub(r"\d+", "", neutral) for neutral, _, _ in found}
        # Of two kinds with the same names one is made of the other; of a few of another kind nothing is known.
        in_turns = len({of[:2] for of in found}) == len(found) and len(shapes) == 1 and changes > 2 * len(kinds)
        for kind, of_kind in [("", found)] if in_turns else kinds.items():
            yield (row, f"{place} {kind}"), of_kind
