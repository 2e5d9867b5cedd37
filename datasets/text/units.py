"""Units of measurement in the names of columns, in metres, radians and seconds."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

METRIC: Mapping[str, float] = {"m": 1.0, "um": 1e-6, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3}
LENGTHS: Mapping[str, float] = {**METRIC, "in": 0.0254, "ft": 0.3048, "usft": 1200 / 3937, "yd": 0.9144}
ANGLES: Mapping[str, float] = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "gon": np.pi / 200}
RATES: Mapping[str, float] = {
    **ANGLES,
    **{f"{unit} s": factor for unit, factor in ANGLES.items()},
    "dps": ANGLES["deg"],
    "mdps": 1e-3 * ANGLES["deg"],
}
FORCES: Mapping[str, float] = {"m s": 1.0, "m s s": 1.0, "g": 9.80665, "mg": 9.80665e-3}
"""Units of a column, as :func:`unit_of` gives them, in metres, radians and seconds."""

UNITS = frozenset(("", *LENGTHS, *ANGLES, "dps", "mdps", "g", "mg", "s", "ms", "us", "ns", "sec", "px", "%"))
OPERATOR = re.compile(r"[-_/^*.\d \[\]()]+")
"""Separators of words in a row of units: ``[m s^-2]``."""

SPELT = (
    ("deg", "deg(rees?|s)|\N{DEGREE SIGN}"),
    ("gon", "grads?|grades?"),
    ("rad", "rad(ians?|s)"),
    ("mm", "millimet(er|re)s?"),
    ("cm", "centimet(er|re)s?"),
    ("m", "met(er|re)s?"),
    ("usft", "us[- ]?(survey[- ]?)?(f(ee|oo)?t)|ft[-_ ]?us"),
    ("ft", "feet|foot"),
    ("in", "inch(es)?"),
    ("yd", "yards?"),
    ("ms", "m(illi)?s(ec(ond)?s?)?"),
    ("us", "(u|micro)s(ec(ond)?s?)?"),
    ("ns", "n(ano)?s(ec(ond)?s?)?"),
    ("s", "sec(ond)?s?"),
)
"""Symbols of units, and their other spellings."""

STATED = re.compile(
    r"[\[(](.*?)[\])]"
    r"|[_ ]((?:[mun]?s(?:ec)?|[muckd]?m|ft|in|inch|yd)(?:[_/]s2?)?$|(?:m?rad|deg|gon|m?dps)s?(?:[_/]s)?(?=_[xyz]$|$))"
    r"|(?<=time|tamp)([mun]s)$"
)
"""Unit in the name of a column: in brackets, or at its end; of turns also before the axis; timeus."""


def unit_of(name: str) -> str:
    """Unit in the name of a column, its parts separated by blanks, without powers; empty: no known unit.

    >>> unit_of("gyro_x [rad s^-1]")
    'rad s'
    """
    stated = STATED.search(name.lower())
    words = (stated[1] or stated[2] or stated[3] or "") if stated else ""
    for symbol, spelt in SPELT:
        words = re.sub(rf"(?<![a-z])({spelt})(?![a-z])", symbol, words)
    parts = [part for part in OPERATOR.split(words) if part]
    return " ".join(parts) if UNITS.issuperset(parts) else ""


def unitless(name: str) -> str:
    """The name of a column without its unit."""
    return STATED.sub("", name).strip()
