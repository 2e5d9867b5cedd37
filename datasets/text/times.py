"""Time stamps of images and sensors: their unit and their order.

The magnitude of stamps since 1970 shows their unit: 1.4e9 are seconds, 1.4e12 milliseconds, 1.4e15 microseconds and
1.4e18 nanoseconds. Smaller ones count from another start; they are seconds unless the unit is stated.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from decimal import Decimal, InvalidOperation

import numpy as np

from rille.stages.core.errors import InputError

UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Number of each in a second."""

UPPER = {"s": 1e11, "ms": 1e14, "us": 1e17}
"""Largest value in each unit: 1e11 s after 1970 is the year 5138."""

GPS_EPOCH = 315964782
"""s from 1970 to 1980, where GPS time begins, less its 18 leap seconds since."""

SECONDS_OF_WEEK = 604_800

DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d([-_/:]?)\d\d\2\d\d)[-_T ]?(\d\d([-_:]?)\d\d\4\d\d)"
    r"(?:\.(\d+)|[-_]?(\d{3}|\d{6}))?(Z|\+\d\d:?\d\d|-\d\d:\d\d| [-+]\d\d:?\d\d)?(?!\d)"
)
"""Date and time of day, with a fraction or milliseconds and a zone, as in logs and names of files."""


def undated(text: str) -> str:
    """The text with seconds since 1970 in place of a date and time of day, which is UTC without a zone."""

    def since(match: re.Match[str]) -> str:
        with suppress(ValueError):  # no day of a calendar
            local = re.sub("[-_:/]", "", f"{match[1]}T{match[3]}")
            moment = datetime.fromisoformat(local + (match[7] or "Z").strip())
            return f"{moment.timestamp():.0f}.{match[5] or match[6] or 0}"
        return match[0]

    return DATE.sub(since, text)


def of_two(whole: str, nanoseconds: str) -> str:
    """Seconds of a stamp in two cells, as of ROS; no number if these are none."""
    return f"{whole}.{nanoseconds:0>9}" if (whole + nanoseconds).isdecimal() else f"{whole} {nanoseconds}"


def of_week(week: str, time: str, per_second: int) -> str:
    """Seconds since 1970, UTC, of a GPS week and the time in it, ``per_second`` of a unit; no number if these are none.

    >>> of_week("2123", "44818.5", 1)
    '1600000000.5'
    """
    with suppress(ArithmeticError):
        return str(GPS_EPOCH + SECONDS_OF_WEEK * Decimal(week) + Decimal(time) / per_second)
    return f"{week} {time}"


def seconds(
    values: Sequence[str | int | float], what: str, *, unit: str = "auto", lines: Sequence[int] | None = None
) -> tuple[float, ...]:
    """Time stamps in seconds.

    Parameters
    ----------
    values : stamps as written (text and integers are divided exactly), in order.
    what : name for messages, usually the file.
    unit : ``s``, ``ms``, ``us``, ``ns``, or ``auto``: by magnitude.
    lines : line number of each stamp, for messages; by default from 1 on.

    Returns
    -------
    Seconds from the same start as the stamps; of stamps since 1970 a float64 keeps 0.24 microseconds.

    Raises
    ------
    InputError
        A stamp is no number, two are equal or go back, units are mixed or unknown, small stamps without a unit are more
        than an hour apart, or any less than .1 microseconds.
    """
    at = list(lines) if lines is not None else list(range(1, len(values) + 1))
    # Nanoseconds since 1970 have 19 digits; a float64 keeps 16, and would make stamps of successive samples equal.
    exact = [_decimal(v, what, k) for v, k in zip(values, at, strict=True)]
    if not exact:
        return ()
    stated = unit if unit != "auto" else _unit(exact, what, at)
    times = tuple(float(v / UNITS[stated]) for v in exact)
    for k in range(1, len(times)):
        if times[k] <= times[k - 1]:
            words = "is there twice" if times[k] == times[k - 1] else f"goes back from {exact[k - 1]}"
            text = f"{what}, line {at[k]}: time {exact[k]} {words}"
            remedy = "put the rows in order of time, each once, in one unit and with all digits"
            raise InputError("RIL-293", text, remedy=remedy)
    usual = float(np.median(np.diff(np.asarray(times)))) if len(times) > 1 else 1.0
    # Stamps of 1973 to 2106 have a known unit. 3600 s: a wrong unit is likelier than pairs an hour apart.
    # 1e-7 s: no camera takes ten million images a second.
    if (unit == "auto" and not 1e8 <= times[0] < 2**32 and usual > 3600.0) or usual < 1e-7:
        text = f"times of {what} are {usual:.4g} s apart, if their unit is {stated}"
        likely = next((u for u, per in UNITS.items() if 1e-3 <= usual * UNITS[stated] / per <= 10.0), "ns")
        remedy = f'name the column time_{likely}; those of the pairs have times.unit = "{likely}" in the manifest'
        raise InputError("RIL-687", text, remedy=remedy)
    return times


def _decimal(value: str | int | float, what: str, line: int) -> Decimal:
    try:
        text = value.strip() if isinstance(value, str) else str(value)  # repr names NumPy's types
        exact = Decimal(text)
    except (InvalidOperation, ValueError):
        exact = Decimal("nan")
    # Nanoseconds reach the greatest in the year 5138; quotients of smaller ones leave what a Decimal can hold.
    if not exact.is_finite() or exact.copy_abs() > 10**20 or 0 < exact.copy_abs() < Decimal("1e-20"):
        remedy = "give numbers, or dates with the time of day in one column, as 2026-05-31 12:00:00"
        raise InputError("RIL-291", f"{what}, line {line}: {value!r} is not a time", remedy=remedy)
    return exact


def _unit(exact: Sequence[Decimal], what: str, lines: Sequence[int]) -> str:
    """The common unit of all stamps by their magnitude."""
    units = [next((unit for unit, upper in UPPER.items() if abs(v) < upper), "ns") for v in exact]
    for k, unit in enumerate(units):
        if unit != units[0]:
            text = f"{what}, line {lines[k]}: time {exact[k]} after {exact[k - 1]}: mixed units ({units[0]} and {unit})"
            remedy = "write all times in one unit, or state it where small stamps are not seconds"
            raise InputError("RIL-292", text, remedy=remedy)
    return units[0]
