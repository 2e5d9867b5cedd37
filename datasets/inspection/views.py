"""Left and right images of a folder: by the tokens of a side in their names, else by the word in which they differ."""

from __future__ import annotations

import glob
import os
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise, takewhile
from pathlib import Path

from rille.datasets.images import pairing
from rille.datasets.images.files import common_header
from rille.datasets.images.headers import sizes_of
from rille.datasets.images.kinds import split
from rille.datasets.images.pairing import ImagePair
from rille.datasets.text.names import ends, shell_word
from rille.datasets.text.order import natural, times_in_names
from rille.datasets.text.sides import CAMERA_NUMBER, SIDES, by_one_word, of_one_camera, side_of
from rille.stages.core.errors import InputError
from rille.stages.core.quantities import count
from rille.stages.geometry.geometry import Sizes

DEPTH = 4
"""Levels of folders that are searched; deeper ones are other data sets."""

COMPUTED = re.compile(
    r"(?<![a-z])(depth|disp|seg|mask|valid|flow|label|conf|normal|occl|semantic|instance|dem(?![a-z]))", re.I
)
"""In the names of images and arrays that are no photographs, as beside those of simulators."""


@dataclass(frozen=True)
class FoundImages:
    """The left and right images that were found.

    Attributes
    ----------
    left, right : patterns relative to the folder.
    pairs : number of pairs.
    sizes : of the left and of the right images, if all of a side have the same.
    why : how left and right were recognised.
    trouble : why the images cannot be paired; empty: they can.
    stamped : whether the left images' names are times, since 1970 or as date and time of day.
    sides : the words or letters in the names that mark left and right.
    absent : missing files of pairs, which are counted in ``pairs``.
    lines : on the pairing by time stamps in the names, if these differ.
    others : lines on images that are of another set of pairs, or of none.
    """

    left: str
    right: str
    pairs: int
    sizes: Sizes | None
    why: str
    trouble: str = ""
    stamped: bool = False
    sides: tuple[str, str] = ("left", "right")
    absent: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


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


def _sets(folder: Path, images: list[Path]) -> tuple[Sets, dict[str, list[Path]], list[int]]:
    """Sets of both sides by tokens, images by the one word that differs, and the numbers of left and right images."""
    names = [relative(path.with_suffix(""), folder) for path in images]
    groups = _by_token(images, names)
    both = _of_both_sides(groups)
    return both, _by_word(images, names, both), [sum(len(sides[s]) for sides in groups.values()) for s in (0, 1)]


def find_views(folder: Path, images: list[Path]) -> FoundImages:
    """The two sets of images, by the tokens in their names that make most pairs; else by the word in which they differ.

    Raises
    ------
    InputError
        Names do not distinguish the images of two cameras.
    """
    lines, tokens = list[str](), SIDES
    photographs = [path for path in images if not COMPUTED.search(relative(path, folder))]
    both, parts, counts = _sets(folder, photographs)
    if not photographs:
        photographs = images
        both, parts, counts = _sets(folder, images)
    if parts:
        first, second = parts
        both, tokens = _by_place(folder, parts), ((first, second),)
        taken = f"{first!r} and {second!r} are taken for the left and the right camera"
        lines.append(f"{taken}, in order of their names: `rille check` shows if they are not")
    if not both:
        raise _no_pairs(folder, images, counts)
    # Most pairs; of equally many the surest token (SIDES), and the shortest name.
    key = max(both, key=lambda k: (min(len(s) for s in both[k]), -k[0], -len(k[1])))
    left, right = both[key]
    sizes, trouble, matched = None, "", tuple[ImagePair, ...]()
    try:
        matched = pairing.pair_up(left, right, warnings=lines)  # as the manifest opens
        headers, matched = pairing.common_headers(matched)
        sizes = sizes_of(headers)
    except InputError as error:
        trouble = str(error)
    sides = tokens[key[0]]
    others = [_of_another_set(of, left[0], folder) for at, of in both.items() if at != key]
    paired = {path for of in both.values() for path in (*of[0], *of[1])}
    alone = [relative(path, folder) for path in photographs if path not in paired]
    if computed := [relative(path, folder) for path in images if path not in set(photographs)]:
        others.append(f"{count(len(computed), 'image')} ({computed[0]} ...): computed, by the names")
    if len(matched) == 1 and sides[0][-1].isdigit() and (alone or any(at != key and at[1] == key[1] for at in both)):
        taken = f"{sides[0]!r} and {sides[1]!r} are taken for two cameras"
        lines.append(f"{taken}; if they are frames of one, name its folder left or right")
    places = dict.fromkeys(os.path.commonpath([pair.left.parent, pair.right.parent]) for pair in matched)
    if len(places) == len(matched) > 1 and not all(re.search(r"\d$", place) for place in places):
        one = f"`rille init {shell_word(next(iter(places)))}`"
        lines.append(
            f"each pair has a folder of its own: if they are scenes, not frames of one camera, {one} takes one"
        )
    return FoundImages(
        pattern(left, folder),
        pattern(right, folder),
        len(matched),
        sizes,
        f"{len(left)} left and {len(right)} right images, told apart by {sides[0]!r} and {sides[1]!r}",
        trouble,
        bool(times_in_names([pair.left for pair in matched])),
        sides,
        tuple(pair.absent for pair in matched if pair.absent),
        tuple(lines),
        (*others, *([f"{count(len(alone), 'image')} ({alone[0]} ...): of neither camera by name"] if alone else ())),
    )


def _by_place(folder: Path, parts: dict[str, list[Path]]) -> Sets:
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


def _of_another_set(sides: tuple[list[Path], list[Path]], taken: Path, folder: Path) -> str:
    """A line on pairs beside those of the left image ``taken``, and how they are opened."""
    place = Path(os.path.commonpath([path.parent for of in sides for path in of]))
    # A folder of a camera is none of pairs.
    own = taken.is_relative_to(place) or not place.is_relative_to(folder)
    how = "images.left and images.right of a manifest" if own else f"`rille init {shell_word(place)}`"
    return f"{pattern(sides[0], folder)} and its right images: of another set, which {how} would take"


def _no_pairs(folder: Path, images: list[Path], counts: list[int]) -> InputError:
    """Refusal of a folder without pairs; ``counts``: images that are named as left, and as right."""
    seen = f"{len(images)} images ({ends(images)})"
    text = f"{folder} holds {seen}, {counts[0]} named as left and {counts[1]} as right: no pairs"
    called = "its files or folders named left and right (or _l and _r, cam0 and cam1)"
    by_name = f"give the folder of both cameras, {called}, or write a manifest by hand"
    remedy = by_name if images else "name the folder that holds the images, or a folder nearer to them"
    text += "" if images else f" ({DEPTH} folders deep)"
    if images and sum(counts) in (0, len(images)) and not all(counts):
        with suppress(InputError):
            header = common_header(images[:1]).header
            if not header.height <= header.width < 2 * header.height:
                remedy = f"{split('each shows', 'FILE')}; else {by_name}"
        alternate = 'images.left = "*[02468].png", images.right = "*[13579].png", images.pair = "order"'
        remedy += (
            f" (of images that show left and right in turn by {alternate})"
            if not (sum(counts) or of_one_camera(folder))
            else ""
        )
    return InputError("RIL-194", text, remedy=of_one_camera(folder) + remedy)


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
