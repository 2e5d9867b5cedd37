"""Look-up table that makes sub-pixel offsets uniform on (-0.5, 0.5) (paper, 4.3.2).

Displacements of a textured scene are spread evenly between whole pixels; offsets found by linear interpolation are not.
The cumulative distribution of found offsets maps them to even ones. It is learnt once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

BINS = 16

_HALF = (0.0, 0.0587, 0.1219, 0.1889, 0.2573, 0.3222, 0.3799, 0.4265, 0.5)
DEFAULT_TABLE: tuple[float, ...] = (*(-v for v in _HALF[:0:-1]), *_HALF)
"""Even offset at each sixteenth of the found one; learnt on noise of spectrum 1 / f^1.3, displaced by all fractions."""


def learn(offsets: ArrayLike) -> tuple[float, ...]:
    """Table of ``BINS + 1`` even offsets at found offsets -0.5 ... 0.5, out of a sample of found offsets.

    The histogram is made symmetric: the sign of an offset is a matter of which image is the left one.
    """
    found = np.clip(np.asarray(offsets, dtype=np.float64).ravel(), -0.5, 0.5)
    counts, _ = np.histogram(found, bins=BINS, range=(-0.5, 0.5))
    counts = counts + counts[::-1]
    if counts.sum() == 0:
        return tuple(i / BINS - 0.5 for i in range(BINS + 1))
    share = np.cumsum(counts) / counts.sum()
    return (-0.5, *(round(float(s) - 0.5, 4) for s in share))


def even(offsets: ArrayLike, table: tuple[float, ...] = DEFAULT_TABLE) -> NDArray[np.float32]:
    """Offsets mapped by a table of :func:`learn`, linear between its knots."""
    knots = np.linspace(-0.5, 0.5, len(table))
    return np.asarray(np.interp(np.asarray(offsets), knots, np.asarray(table)), dtype=np.float32)
