"""Units of measurement in the names of columns, and what they are in metres, radians and seconds."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

LENGTHS: Mapping[str, float] = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048}
ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": np.pi / 180}
RATES: Mapping[str, float] = {"rad s": 1.0, "deg s": ANGLES["deg"], "dps": ANGLES["deg"], **ANGLES}
FORCES: Mapping[str, float] = {"m s": 1.0, "m s s": 1.0, "g": 9.80665}
"""Units of a column, as :func:`unit_of` gives them, in metres, radians and seconds."""

UNITS = frozenset(
    ("", *LENGTHS, "rad", "deg", "dps", "g", "s", "ms", "us", "ns", "sec", "mg", "mdps", "mrad", "px", "%")
)
OPERATOR = re.compile(r"[-_/^*.\d \[\]()]+")
"""Words of a row of units, and what stands between and about them: ``[m s^-2]``."""

SPELT = (("deg", "deg(rees?|s)|\N{DEGREE SIGN}"), ("rad", "rad(ians?|s)"), ("m", "met(er|re)s?"), ("ft", "feet|foot"))
"""Symbols of units, and how else they are written."""

STATED = re.compile(
    r"[\[(](.*?)[\])]|[_ ]((?:[mun]?s|[mck]?m|ft)(?:[_/]s2?)?$|(?:m?rad|deg|m?dps)s?(?:[_/]s)?(?=_[xyz]$|$))"
)
"""Unit in the name of a column: in brackets, or at its end; of turns also before the axis."""


def unit_of(name: str) -> str:
    """Unit in the name of a column, its parts apart by blanks, without powers; empty: none that is known.

    >>> unit_of("gyro_x [rad s^-1]")
    'rad s'
    """
    stated = STATED.search(name.lower())
    words = (stated[1] or stated[2] or "") if stated else ""
    for symbol, spelt in SPELT:
        words = re.sub(rf"(?<![a-z])({spelt})(?![a-z])", symbol, words)
    parts = [part for part in OPERATOR.split(words) if part]
    return " ".join(parts) if UNITS.issuperset(parts) else ""


def unitless(name: str) -> str:
    """The name of a column without its unit."""
    return STATED.sub("", name).strip()
