"""Time stamps of images and sensors: their unit, their order, their gaps.

Stamps since 1970 tell their unit by magnitude: 1.4e9 are seconds, 1.4e12 milliseconds, 1.4e15 microseconds and 1.4e18
nanoseconds. Smaller ones count from some other start; they are taken for seconds unless the unit is stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation

import numpy as np

from rille.datasets.text.warning import warning
from rille.stages.core.errors import InputError

UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""How many of each make a second."""

UPPER = {"s": 1e11, "ms": 1e14, "us": 1e17}
"""Above it a value can no longer be in that unit: 1e11 s after 1970 is the year 5138."""

GAP = 2.5
"""Gap, in median spacings, from which a warning is given: one missing frame (2) is common, more is not."""

SLOW = 3600.0
"""s; pairs an hour apart are possible, but a wrong unit is likelier."""


LARGEST = 10**20
"""Above it a value is no time in any unit: nanoseconds reach it in the year 5138."""


SMALLEST = Decimal("1e-20")
"""Below it a value other than 0 is no time either, and quotients of such leave what a Decimal can hold."""


def seconds(
    values: Sequence[str | int | float],
    what: str,
    *,
    unit: str = "auto",
    lines: Sequence[int] | None = None,
) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Time stamps in seconds.

    Parameters
    ----------
    values : stamps as written (text and integers are divided exactly), in order.
    what : what to call them in messages, usually the file.
    unit : ``s``, ``ms``, ``us``, ``ns``, or ``auto``: by magnitude.
    lines : line number of each stamp, for messages; counted from 1 where it is not given.

    Returns
    -------
    times : seconds from the same start as the stamps; of stamps since 1970 a float64 keeps 0.24 microseconds.
    warnings : a line on gaps, and one on stamps that are strangely far apart.

    Raises
    ------
    InputError
        A stamp is no number, two are equal or go back, units are mixed, or the unit is unknown.
    """
    if unit != "auto" and unit not in UNITS:
        raise InputError(
            "RIL-290", f"{what}: unit {unit!r} of time is unknown", remedy=f"one of auto, {', '.join(UNITS)}"
        )
    at = list(lines) if lines is not None else list(range(1, len(values) + 1))
    # Nanoseconds since 1970 have 19 digits; a float64 keeps 16, and would make stamps of successive samples equal.
    exact = [_decimal(v, what, k) for v, k in zip(values, at, strict=True)]
    if not exact:
        return (), ()
    unit = unit if unit != "auto" else _unit(exact, what, at)
    _in_order(exact, what, at)
    if len(exact) > 2:
        _one_unit(exact, what, at)
    times = tuple(float(v / UNITS[unit]) for v in exact)
    return times, (*_unusual(times, unit, what), *gaps(times, what, at))


def gaps(times: Sequence[float], what: str, lines: Sequence[int] | None = None) -> tuple[str, ...]:
    """A line on spacings of more than 2.5 times the usual one; none where there are none.

    Parameters
    ----------
    times : seconds, increasing.
    """
    if len(times) < 3:
        return ()
    steps = np.diff(np.asarray(times))
    usual = float(np.median(steps))
    wide = np.flatnonzero(steps > GAP * usual)
    if not wide.size:
        return ()
    longest = int(wide[np.argmax(steps[wide])])
    where = f" after line {lines[longest]}" if lines is not None else ""
    count = "1 gap" if wide.size == 1 else f"{wide.size} gaps, the longest"
    text = f"times of {what}: {count} of {steps[longest]:.4g} s{where} where {usual:.4g} s is usual"
    return (warning("RIL-686", text),)


def _decimal(value: str | int | float, what: str, line: int) -> Decimal:
    try:
        text = value.strip() if isinstance(value, str) else str(value)  # repr names NumPy's types
        exact = Decimal(text)
    except (InvalidOperation, ValueError):
        exact = Decimal("nan")
    if not exact.is_finite() or exact.copy_abs() > LARGEST or 0 < exact.copy_abs() < SMALLEST:
        raise InputError("RIL-291", f"{what}, line {line}: {value!r} is not a time", remedy="give numbers, one a frame")
    return exact


def _magnitude(value: Decimal) -> str:
    return next((unit for unit, upper in UPPER.items() if abs(value) < upper), "ns")


def _unit(exact: Sequence[Decimal], what: str, lines: Sequence[int]) -> str:
    """The unit that all stamps have by their magnitude."""
    units = [_magnitude(v) for v in exact]
    for k, unit in enumerate(units):
        if unit != units[0]:
            raise _mixed(what, lines, exact, k, f"by magnitude {units[0]} and {unit}")
    return units[0]


def _mixed(what: str, lines: Sequence[int], exact: Sequence[Decimal], k: int, how: str) -> InputError:
    return InputError(
        "RIL-292",
        f"{what}, line {lines[k]}: time {exact[k]} after {exact[k - 1]}: mixed units ({how})",
        remedy="write all times in one unit, or state it where small stamps are not seconds",
    )


def _in_order(exact: Sequence[Decimal], what: str, lines: Sequence[int]) -> None:
    for k in range(1, len(exact)):
        if exact[k] <= exact[k - 1]:
            words = "is there twice" if exact[k] == exact[k - 1] else f"goes back from {exact[k - 1]}"
            raise InputError(
                "RIL-293",
                f"{what}, line {lines[k]}: time {exact[k]} {words}",
                remedy="put the rows in order of time, each once, in one unit",
            )


def _one_unit(exact: Sequence[Decimal], what: str, lines: Sequence[int]) -> None:
    """Refuse stamps that go on a thousand times larger and a thousand times wider apart: too small for magnitudes."""
    for k in range(1, len(exact) - 1):
        # The spacing before needs two stamps, and a ratio a positive one.
        if k == 1 or exact[k - 1] <= 0:
            continue
        before, after = exact[k - 1] - exact[k - 2], exact[k + 1] - exact[k]
        jump = exact[k] / exact[k - 1]
        if any(Decimal("0.9") <= jump / f <= 3 and Decimal("0.5") <= after / before / f <= 2 for f in (1000, 10**6)):
            raise _mixed(what, lines, exact, k, f"spacing {before}, then {after}")


def _unusual(times: Sequence[float], unit: str, what: str) -> tuple[str, ...]:
    if len(times) < 2:
        return ()
    usual = float(np.median(np.diff(np.asarray(times))))
    if usual <= SLOW:
        return ()
    text = f"times of {what} are {usual:.4g} s apart, taken for {unit}: state the unit if they are not"
    return (warning("RIL-687", text),)
