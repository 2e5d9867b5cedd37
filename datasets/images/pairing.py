"""Pair left and right images: by name, number, time stamp or order; and the tokens of sides."""

from __future__ import annotations

import os
import re
import string
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rille.datasets.images import files
from rille.datasets.images.headers import Headers
from rille.datasets.text.names import shell_word
from rille.datasets.text.times import seconds, undated
from rille.stages.core.errors import IncompleteError, InputError, warning
from rille.stages.core.quantities import count

STAMP = re.compile(r"(?<!\d)[1-9]\d{9}(?:[_-]\d{9}|\d*(?:\.\d+)?)(?!\d)")
"""Seconds since 1970 have ten digits, with fractions more; frame numbers have fewer, or leading zeros."""

NANOSECONDS = re.compile(r"(?<!\d)[1-9]\d{9}[._-]([1-9]\d{0,8}|0)(?!\d)")
"""Seconds since 1970 and nanoseconds, perhaps without the zeros in front of them."""

SHARE, MOST_APART = 0.25, 0.01
"""Largest time between the images of a pair: share of the usual interval, and seconds (0.1 m at 10 m/s)."""

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


@dataclass(frozen=True)
class ImagePair:
    """One stereo pair: its name and both files; ``absent`` says which of them is missing, empty: none."""

    name: str
    left: Path
    right: Path
    absent: str = ""


class TimedPairs(NamedTuple):
    """Simultaneous images of two cameras.

    Attributes
    ----------
    places : indices of the left and of the right image of each pair, in order of time.
    alone : number of images without a partner.
    apart : s; longest time between the images of a pair; between the nearest ones if there is no pair.
    allowed : s; its limit.
    two_clocks : whether no images are simultaneous, and all are apart alike, by the share of the interval at most.
    """

    places: list[tuple[int, int]]
    alone: int
    apart: float
    allowed: float
    two_clocks: bool = False

    def lines(self, code: str) -> list[str]:
        """A warning if images have no partner, or those of a pair are not simultaneous."""
        text = f"images of a pair are up to {1e3 * self.apart:.3g} ms apart ({1e3 * self.allowed:.3g} ms are allowed)"
        alone = f"; {count(self.alone, 'image')} without a partner of the same time are left out" if self.alone else ""
        return [warning(code, text + alone)] if self.apart or alone else []


def join(left: Sequence[float], right: Sequence[float], tolerance: float | None = None) -> TimedPairs:
    """Pair images of two cameras that are nearest to each other in time.

    Parameters
    ----------
    left, right : seconds, increasing.
    tolerance : s; by default a quarter of the usual interval of the faster camera, at most ``MOST_APART``.
    """
    a, b = np.asarray(left), np.asarray(right)
    intervals = [float(np.median(np.diff(times))) for times in (a, b) if len(times) > 1]
    allowed = tolerance or min([MOST_APART, *(SHARE * interval for interval in intervals)])
    ours, theirs = (np.searchsorted((t[1:] + t[:-1]) / 2, s) for t, s in ((b, a), (a, b)))
    apart = np.abs(a - b[ours])
    # Each must be the other's nearest, else one image would be in two pairs.
    there = np.flatnonzero((theirs[ours] == np.arange(len(a))) & (apart <= allowed))
    longest = float(max(apart[there], default=apart.min()))
    later = b - a if len(a) == len(b) > 2 and not len(there) else np.array([0.0, np.inf])
    alike = float(np.ptp(later)) <= allowed and abs(float(np.median(later))) <= SHARE * min(intervals)
    places = [(int(i), int(ours[i])) for i in there]
    return TimedPairs(places, len(a) + len(b) - 2 * len(there), longest, allowed, alike)


def stamp_of(name: str) -> str:
    """The time since 1970 in a file's name, in any unit; empty if there is none."""
    found = STAMP.search(name)
    return re.sub("[_-]", ".", found[0]) if found else ""


def with_nine_digits(names: Sequence[str]) -> list[str]:
    """Names in which nanoseconds after seconds since 1970 have nine digits.

    Programs that join the two numbers of a stamp of ROS write 50 ms as ``1700000000.50000000``. Where decimals have up
    to nine digits some begin with 0, and the names stay as they are.
    """
    found = [match for name in names if (match := NANOSECONDS.search(name))]
    if len(found) < len(names) or max((len(match[1]) for match in found), default=0) < 9:
        return list(names)
    return [f"{m.string[: m.start(1)]}{m[1]:0>9}{m.string[m.end(1) :]}" for m in found]


def stamps_of(names: Sequence[str]) -> list[str]:
    """The time in each name, as :func:`stamp_of`; that of a date and time of day, unless all names share one."""
    whole = with_nine_digits(names)
    dated = [stamp_of(undated(name)) for name in whole]
    return dated if len(set(dated)) == len(names) else [stamp_of(name) for name in whole]


def times_in_names(paths: Sequence[Path]) -> tuple[float, ...]:
    """Times in the names of sorted files, s, since 1970 or as date and time of day; empty unless each has its own."""
    stamps = list(filter(None, stamps_of([path.stem for path in paths])))
    with suppress(InputError):
        return seconds(stamps, "the image names") if len(stamps) == len(paths) else ()
    return ()


def _fine_times(paths: Sequence[Path]) -> tuple[float, ...]:
    """Times in the names of sorted files that tell pairs; empty if they are too coarse, or there are none."""
    times = times_in_names(paths)
    # Whole seconds tell no pairs. 0.002 s: what increases by a millisecond or less after a date is a counter.
    coarse = all(map(float.is_integer, times)) or (len(times) > 1 and np.median(np.diff(times)) < 0.002)
    return () if coarse and not stamp_of(paths[0].stem) else times


DECIMAL = re.compile(r"(\D*?)((?<!\w)\.\d+|\d+(?:\.\d+)?)(\D*)")
"""A name with one number, which may have a fraction."""

UNWRITABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""In a name: control characters and line separators, which would end a comment, and bytes that are not UTF-8."""


def writable(name: str) -> None:
    """Refuse the name of a file that does not fit into a line of text.

    Raises
    ------
    InputError
        It has a control character or a line break, or is not in UTF-8.
    """
    if UNWRITABLE.search(name):
        text = f"the name {name!r} has a line break, or is not in UTF-8: no manifest holds it"
        raise InputError("RIL-185", text, remedy="rename it")


CAMERA_NUMBER = re.compile(r"(?<![a-z])cam(era)?[_-]?\d+$", re.I)
"""End of a name that numbers a camera, any two numbers of which are two cameras."""

COUNTER = re.compile(r"(\d{3,})\D*$")
"""The last number of a name, of three digits or more."""


TIME_OF_DAY = re.compile(r"(?<!\d)([01]\d|2[0-3])([-_.:]?)([0-5]\d)\2[0-5]\d(\d{3})?(?!\d)")
"""Hours, minutes and seconds in a name, perhaps with milliseconds."""


def natural(text: str) -> tuple[tuple[int, int | str], ...]:
    """Sorting key in which numbers count as numbers: ``a2`` before ``a10``."""
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", text) if part)


def in_order(stems: Sequence[str]) -> list[str]:
    """Names without their side in order of time: see :func:`_ascending`, :func:`_begun_anew`."""
    ordered = _ascending(stems)
    first = _begun_anew(ordered)
    return ordered[first:] + ordered[:first]


def _ascending(stems: Sequence[str]) -> list[str]:
    """Names without their side, ordered by time stamps or decimal numbers in them, else in natural order."""
    whole = with_nine_digits(stems)
    found = [DECIMAL.fullmatch(stem) for stem in whole]
    numbers = [match[2] for match in found if match]
    fractions = [number.partition(".")[2] for number in numbers]
    # Fractions of unlike length with a final 0 are numbers of their own: 1.9 before 1.10.
    counts = len(set(map(len, fractions))) > 1 and any(len(f) > 1 and f.endswith("0") for f in fractions)
    alike = len(numbers) == len(stems) and len({(match[1], match[3]) for match in found if match}) == 1
    values = numbers if alike and not counts else [stamp_of(stem) or "0" for stem in whole]
    by_stem = dict(zip(stems, map(Decimal, values), strict=True))
    # Of hexadecimal numbers of one length 00a follows 009.
    changing = {c for letters in zip(*stems, strict=False) if len(set(letters)) > 1 for c in letters}
    alike = len(set(map(len, stems))) == 1 and changing <= set(string.hexdigits)
    return sorted(stems, key=lambda stem: (by_stem[stem], natural("" if alike else stem), stem.lower()))


def _begun_anew(ordered: Sequence[str]) -> int:
    """Index, in ordered names, of the image taken first, if a counter has reached its last number (999) and gone on
    from 0, or from 1 as in cameras (DCF), so that more numbers are missing than present; or if times of day without a
    date have passed midnight; else 0."""
    days = [found for name in ordered if (found := TIME_OF_DAY.search(undated(name)))]
    if len(days) == len(ordered) and len({found.string[: found.start()] for found in days}) == 1:
        minutes = [60 * int(found[1]) + int(found[3]) for found in days]
        gaps = np.diff(minutes)
        # Ten minutes before and after midnight; half a day without images.
        midnight = minutes[0] < 10 and minutes[-1] >= 24 * 60 - 10 and max(gaps) > 12 * 60
        return int(np.argmax(gaps)) + 1 if midnight else 0
    digits = [found[1] for name in ordered if (found := COUNTER.search(name))]
    if len(digits) < len(ordered) or len(set(map(len, digits))) != 1:
        return 0
    numbers = [int(text) for text in digits]
    steps = np.diff(numbers)
    if numbers[0] > 1 or numbers[-1] != 10 ** len(digits[0]) - 1 or steps.max(initial=0) <= len(numbers):
        return 0
    return int(np.argmax(steps)) + 1


def ends(paths: Sequence[Path]) -> str:
    """The names of the first and the last of some files: ``000000.png to 000050.png``."""
    return " to ".join(dict.fromkeys((paths[0].name, paths[-1].name))) if paths else "none"


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
    return _by_one_word(words, timed) or (_by_one_word(behind, timed) if behind != words else {})


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


def of_one_camera(folder: Path) -> str:
    """Remedy for a folder that is named as the images of one camera; empty for any other."""
    both = shell_word(folder.parent if folder.name else folder.resolve().parent)
    one = f"if {folder} holds the images of one camera, give the folder of both: `rille init {both}`; else "
    return one if side_of(folder.resolve().name) is not None else ""


def without_side(stem: str, side: int) -> str:
    """A file's stem without its side's token: ``cam_left_07`` and ``cam_right_07`` are both ``cam_*_07``."""
    found = side_of(stem)
    return found[2] if found is not None and found[1] == side else stem


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
    if _begun_anew(_ascending([names[path] for path in left])):
        text = f"the counter of the images began anew: they are taken from {left[0].name} on to {left[-1].name}"
        lines.append(warning("RIL-707", f"{text}; if that is wrong, rename them"))
    if two := " and ".join(map(repr, by_one_word([names[path] for path in left]))):
        text = f"images of {two} are taken one after the other, as one sequence"
        lines.append(warning("RIL-835", f"{text}; if they are two, give each a manifest (images.left, images.right)"))
    joined = join(*times, tolerance) if all(times := (_fine_times(left), _fine_times(right))) else None
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


def counted(names: list[str]) -> list[str]:
    """Names with the missing numbers of a running count; unchanged unless most numbers increase by one."""
    if len(names) < 3 or not all(name.isdecimal() for name in names):
        return names
    numbers = [int(name) for name in names]
    if np.median(np.diff(numbers)) != 1 or not 0 < numbers[-1] - numbers[0] < 2 * len(names):
        return names
    by_number = dict(zip(numbers, names, strict=True))
    return [by_number.get(k, f"{k:0{len(names[0])}d}") for k in range(numbers[0], numbers[-1] + 1)]


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
