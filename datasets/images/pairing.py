"""Pairs of left and right images: by name, folder, number, time stamp or order."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rille.datasets.images import files
from rille.datasets.images.headers import Headers
from rille.datasets.images.simultaneous import MOST_APART, TimedPairs, join
from rille.datasets.text.names import ends
from rille.datasets.text.order import began_anew, counted, fine_times, in_order, natural
from rille.datasets.text.sides import by_one_word, without_side
from rille.stages.core.errors import IncompleteError, InputError, warning


@dataclass(frozen=True)
class ImagePair:
    """One stereo pair: its name and both files; ``absent`` says which of them is missing, empty: none."""

    name: str
    left: Path
    right: Path
    absent: str = ""


def _told_apart(left: Sequence[Path], right: Sequence[Path], part: Callable[[Path], str]) -> dict[Path, str]:
    """A part of each path without its side's token; whole if images of both sides have one: it tells no side then."""
    shared = set(map(part, left)) & set(map(part, right))
    sides = [(path, side) for side, paths in enumerate((left, right)) for path in paths]
    return {path: part(path) if shared else without_side(part(path), side) for path, side in sides}


def pair_up(
    left: Sequence[Path],
    right: Sequence[Path],
    rule: str = "auto",
    *,
    growing: bool = False,
    tolerance: float | None = None,
    warnings: list[str] | None = None,
) -> tuple[ImagePair, ...]:
    """Pairs in the natural order of the left names.

    Parameters
    ----------
    left, right : image files of each camera.
    rule : ``name`` (equal stems, sides' tokens aside), ``folder`` (those of their folders), ``number`` (the last number
        in the stem by which all differ), ``nearest`` (time stamps in the stems, see :func:`join`), ``order`` (sorted
        names), or ``auto``: folder where all files of a camera have one name, else name; nearest where time stamps
        differ, number where the names of the two cameras have nothing in common. Images that are paired by name or
        folder and have no partner make a pair with an absent file, as long as they are fewer than the whole pairs.
    growing : images after the last pair, by name or number, are left out, since their partners are still to come.
    tolerance : s; largest difference of the stamps of a pair; None: see :func:`join`.
    warnings : takes lines on images that are left out or not simultaneous.

    Raises
    ------
    InputError
        An image has no partner, two images make the same pair, the counts differ, or stamps of a pair are apart.
    """
    lines = [] if warnings is None else warnings
    names = _told_apart(left, right, lambda path: path.stem)
    left, right = (_sorted(paths, names) for paths in (left, right))
    if began_anew([names[path] for path in left]):
        text = f"the counter of the images began anew: they are taken from {left[0].name} on to {left[-1].name}"
        lines.append(warning("RIL-707", f"{text}; if that is wrong, rename them"))
    if two := " and ".join(map(repr, by_one_word([names[path] for path in left]))):
        text = f"images of {two} are taken one after the other, as one sequence"
        lines.append(warning("RIL-835", f"{text}; if they are two, give each a manifest (images.left, images.right)"))
    joined = join(*times, tolerance) if all(times := (fine_times(left), fine_times(right))) else None
    both = " and ".join(f"{len(of)} {side} images ({ends(of)})" for side, of in (("left", left), ("right", right)))
    stated, rule = rule, rule if rule != "auto" else _fitting(left, right, names, joined)
    if rule == "order":
        if len(left) != len(right):
            remedy = "remove what is too many, or pair by name or number"
            raise IncompleteError("RIL-256", f"{both} cannot be paired by order", remedy=remedy)
        pairs = _named(list(zip(left, right, strict=True)))
        lines += _two_clocks(pairs, *times, tolerance) if joined is not None and len(pairs) > 1 else []
        return pairs
    if rule == "nearest":
        if joined is None or not joined.places:
            why = f"the nearest are {joined.apart:.4g} s apart" if joined else "not each has its own"
            remedy = 'state images.tolerance (s), or, of two clocks, images.pair = "order"'
            text = f"{both} make no pairs by the time stamps in their names: {why}"
            raise IncompleteError("RIL-822", text, remedy=remedy)
        lines += joined.lines("RIL-821")
        return _named([(left[i], right[j]) for i, j in joined.places])
    root = Path(os.path.commonpath([path.parent.absolute() for path in (*left, *right)]))
    if rule == "folder":
        names = _told_apart(left, right, lambda path: _compared(path, rule, root))
    by_key = _by_key(left, rule, names), _by_key(right, rule, names)
    if growing:
        by_key = _up_to_last_pair(*by_key)
    shared, present = set(by_key[0]) & set(by_key[1]), set(by_key[0]) | set(by_key[1])
    if stated == "auto" and rule == "folder" and not shared and len(left) == len(right):
        return _named(list(zip(left, right, strict=True)))  # a/camera_00/0.png and a/camera_02/0.png
    if rule != "number" and 2 * len(shared) > len(present):
        return _with_gaps(by_key, rule, root)
    alone = [path for ours in by_key for key, path in ours.items() if key not in shared]
    if alone:
        raise _without_partner(alone, rule, both, evenly=len(left) == len(right))
    return _named([(path, by_key[1][key]) for key, path in by_key[0].items()])


def _without_partner(alone: Sequence[Path], rule: str, both: str, *, evenly: bool) -> IncompleteError:
    """Refusal of images without a partner; ``both``: all images in words, ``evenly``: as many left as right ones."""
    more = f" (and {len(alone) - 1} more)" if len(alone) > 1 else ""
    text = f"{alone[0]} has no partner by {rule}{more}; {both}"
    order = 'state images.pair = "order" if they belong together in order of their names; else '
    return IncompleteError(
        "RIL-259", text, remedy=f"{order if evenly else ''}add the missing image, or narrow the patterns"
    )


def _fitting(left: Sequence[Path], right: Sequence[Path], names: Mapping[Path, str], joined: TimedPairs | None) -> str:
    """The rule by which images are paired if none is stated."""
    # One image each is a pair, whatever their names.
    if len(left) == len(right) == 1:
        return "order"
    if len({path.name for path in left}) == len({path.name for path in right}) == 1:
        return "folder"
    ours, theirs = ({names[path] for path in of} for of in (left, right))
    shared = ours & theirs
    if joined is not None and (joined.apart or not shared):
        return "order" if joined.two_clocks else "nearest"
    # Where as many images share few names (of seconds that tick between), numbers tell more.
    return "name" if shared and (2 * len(shared) > len(ours | theirs) or len(ours) != len(theirs)) else "number"


def _sorted(paths: Sequence[Path], names: Mapping[Path, str]) -> list[Path]:
    place = {name: k for k, name in enumerate(in_order([names[path] for path in paths]))}
    return sorted(paths, key=lambda path: (place[names[path]], natural(str(path))))


def _compared(path: Path, rule: str, root: Path) -> str:
    """The part of a path that a rule compares: its folder below ``root``, which all images share, or its name."""
    return os.path.relpath(path.parent, root) if rule == "folder" else path.stem


def _by_key(paths: Sequence[Path], rule: str, names: Mapping[Path, str]) -> dict[str, Path]:
    """Images by the key of a pair: the number in the file's name, or what ``names`` says."""
    by_key: dict[str, Path] = {}
    found = [re.findall(r"\d+", path.stem)[::-1] for path in paths]
    # The last number that no two names share; a later one may be that of the camera, or of a file's version.
    last = next((k for k, of in enumerate(zip(*found, strict=False)) if len(set(of)) == len(paths)), 0)
    for path, numbers in zip(paths, found, strict=True):
        if rule == "number" and not numbers:
            text = f"{path} has no number in its name and no partner of its name"
            remedy = 'rename the images, or narrow the patterns; a manifest may take them by images.pair = "order"'
            raise InputError("RIL-257", text, remedy=remedy)
        key = str(int(numbers[last])) if rule == "number" else names[path]
        if key in by_key:
            text = f"{by_key[key]} and {path} are the same frame by {rule}"
            raise InputError("RIL-258", text, remedy="narrow the patterns, or choose another images.pair")
        by_key[key] = path
    return by_key


def _up_to_last_pair(left: dict[str, Path], right: dict[str, Path]) -> tuple[dict[str, Path], dict[str, Path]]:
    """The images whose key is not after that of the last pair; all images if there is no pair."""
    last = max((natural(key) for key in left if key in right), default=None)
    if last is None:
        return left, right
    cut = [{key: path for key, path in ours.items() if natural(key) <= last} for ours in (left, right)]
    return cut[0], cut[1]


def _two_clocks(
    pairs: Sequence[ImagePair], left: Sequence[float], right: Sequence[float], most: float | None
) -> list[str]:
    """A warning if the stamps of all pairs by order differ by a constant, as those of two clocks.

    Raises
    ------
    InputError
        The stamps put the images of a pair farther apart: by ``most`` s, or by half the usual interval.
    """
    apart, most = np.subtract(right, left), most or float(np.median(np.diff(left))) / 2
    # If images have simultaneous partners, there is one clock, and a constant is due to lost images.
    offset = float(np.median(apart)) if len(join(left, right).places) < 2 else 0.0
    k = int(np.argmax(np.abs(apart - offset)))
    if abs(apart[k] - offset) > most:
        off = f"{apart[k]:+.4g} s off by their time stamps ({most:.3g} s are allowed): was an image lost?"
        text = f"by order {pairs[k].left.name} is paired with {pairs[k].right.name}, {off}"
        remedy = 'images.pair = "nearest" pairs by time stamp; or state images.tolerance (s)'
        raise InputError("RIL-823", text, remedy=remedy)
    text = f"time stamps are of two clocks, or not of one time: in all pairs the right one is {offset:.6g} s later"
    return [warning("RIL-824", text)] if abs(offset) > MOST_APART else []


def _with_gaps(by_key: tuple[dict[str, Path], dict[str, Path]], rule: str, root: Path) -> tuple[ImagePair, ...]:
    """Pairs of all keys and of missing numbers of a running count; an absent file has its expected name."""
    whole = next(key for key in by_key[0] if key in by_key[1])
    keys = counted(in_order(list({**by_key[0], **by_key[1]})))
    together = by_key[0][whole].parent == by_key[1][whole].parent  # a folder of both for each frame, say
    paths = []
    for key in keys:
        called = [ours.get(key) or _called(ours[whole], whole, key, rule, root) for ours in by_key]
        place = next((ours[key].parent for ours in by_key if key in ours), None) if together else None
        paths.append([path if place is None else place / path.name for path in called])
    pairs = []
    for key, pair in zip(keys, _named([(left, right) for left, right in paths]), strict=True):
        gone = [path for path, ours in zip((pair.left, pair.right), by_key, strict=True) if key not in ours]
        words = " and ".join(os.path.relpath(path, root) for path in gone)
        pairs.append(replace(pair, absent=f"{words} {'are' if gone[1:] else 'is'} missing" if gone else ""))
    return tuple(pairs)


def _called(example: Path, key: str, wanted: str, rule: str, root: Path) -> Path:
    """File of another key, named as ``example``, whose key is ``key``: its side's token for the asterisk."""
    found = re.fullmatch(re.escape(key).replace(r"\*", "(.*?)"), _compared(example, rule, root))
    name = wanted.replace("*", found[1] if found and found.groups() else "")
    return root / name / example.name if rule == "folder" else example.with_name(name + example.suffix)


def _named(pairs: list[tuple[Path, Path]]) -> tuple[ImagePair, ...]:
    """Name each pair by the common part of its files' names; by the left file if that is not unique."""
    names = [without_side(path.stem, 0).replace("*", "").strip("_-. ") for path, _ in pairs]
    if len(set(names)) < len(names) or not all(names):
        names = [path.stem for path, _ in pairs]
    if len(set(names)) < len(names):
        names = [str(k) for k in range(len(pairs))]
    return tuple(ImagePair(name, *pair) for name, pair in zip(names, pairs, strict=True))


def common_headers(pairs: Sequence[ImagePair]) -> tuple[Headers, tuple[ImagePair, ...]]:
    """Width, height and bits of most images of each side (see :func:`rille.datasets.images.files.common_header`).

    And the pairs, with ``absent`` for those with an image that has others, or cannot be read.
    """
    whole = [pair for pair in pairs if not pair.absent]
    left = files.common_header([pair.left for pair in whole])
    right = files.common_header([pair.right for pair in whole])
    causes = [pair.absent or left.refused.get(pair.left) or right.refused.get(pair.right, "") for pair in pairs]
    checked = tuple(replace(pair, absent=why) for pair, why in zip(pairs, causes, strict=True))
    return (left.header, right.header), checked
