"""Names of files in order of time: the time stamps, numbers and counters in them."""

from __future__ import annotations

import re
import string
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path

import numpy as np

from rille.datasets.text.times import seconds, undated
from rille.stages.core.errors import InputError

STAMP = re.compile(r"(?<!\d)[1-9]\d{9}(?:[_-]\d{9}|\d*(?:\.\d+)?)(?!\d)")
"""Seconds since 1970 have ten digits, with fractions more; frame numbers have fewer, or leading zeros."""

NANOSECONDS = re.compile(r"(?<!\d)[1-9]\d{9}[._-]([1-9]\d{0,8}|0)(?!\d)")
"""Seconds since 1970 and nanoseconds, perhaps without the zeros in front of them."""

DECIMAL = re.compile(r"(\D*?)((?<!\w)\.\d+|\d+(?:\.\d+)?)(\D*)")
"""A name with one number, which may have a fraction."""

COUNTER = re.compile(r"(\d{3,})\D*$")
"""The last number of a name, of three digits or more."""

TIME_OF_DAY = re.compile(r"(?<!\d)([01]\d|2[0-3])([-_.:]?)([0-5]\d)\2[0-5]\d(\d{3})?(?!\d)")
"""Hours, minutes and seconds in a name, perhaps with milliseconds."""


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


def fine_times(paths: Sequence[Path]) -> tuple[float, ...]:
    """Times in the names of sorted files that tell pairs; empty if they are too coarse, or there are none."""
    times = times_in_names(paths)
    # Whole seconds tell no pairs. 0.002 s: what increases by a millisecond or less after a date is a counter.
    coarse = all(map(float.is_integer, times)) or (len(times) > 1 and np.median(np.diff(times)) < 0.002)
    return () if coarse and not stamp_of(paths[0].stem) else times


def natural(text: str) -> tuple[tuple[int, int | str], ...]:
    """Sorting key in which numbers count as numbers: ``a2`` before ``a10``."""
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", text) if part)


def in_order(stems: Sequence[str]) -> list[str]:
    """Names without their side in order of time: see :func:`_ascending`, :func:`_first_taken`."""
    ordered = _ascending(stems)
    first = _first_taken(ordered)
    return ordered[first:] + ordered[:first]


def began_anew(stems: Sequence[str]) -> bool:
    """Whether a counter, or the time of day, in names without their side has begun anew."""
    return _first_taken(_ascending(stems)) > 0


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


def _first_taken(ordered: Sequence[str]) -> int:
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


def counted(names: list[str]) -> list[str]:
    """Names with the missing numbers of a running count; unchanged unless most numbers increase by one."""
    if len(names) < 3 or not all(name.isdecimal() for name in names):
        return names
    numbers = [int(name) for name in names]
    if np.median(np.diff(numbers)) != 1 or not 0 < numbers[-1] - numbers[0] < 2 * len(names):
        return names
    by_number = dict(zip(numbers, names, strict=True))
    return [by_number.get(k, f"{k:0{len(names[0])}d}") for k in range(numbers[0], numbers[-1] + 1)]
