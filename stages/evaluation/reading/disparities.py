"""Whether true disparities would fit the matches if they were read with another sign, unit, offset or order of rows."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Bools, Floats32


def misread(column: Floats32, match: Bools, truth: Floats32) -> str:
    """How truth that contradicts most matches would fit them, in one line; empty where it fits, or nothing would.

    It may have another sign or unit (SGBM counts in sixteenths), an offset (principal points that differ), or its
    lowest row first, as PFM has.
    """
    readings: dict[str, Floats32] = {}
    for turned, rows in (("", truth), (" with its rows upside down", truth[::-1])):
        both = match & np.isfinite(column) & np.isfinite(rows) & (rows != 0)
        # Of fewer matches true disparities are not doubted.
        if np.count_nonzero(both) < 100:
            return ""
        factor, offset = np.median(column[both] / rows[both]), np.round(np.median((column - rows)[both]))
        readings |= {
            f"as it is{turned}": rows,
            f"times {factor:.2g}{turned}": rows * factor,
            f"{offset:+.0f} px{turned}": rows + offset,
        }
    # 2.0 pixels: a match that is off by less fits the truth.
    fits = {
        words: float(np.mean(np.abs(column - map_)[match & np.isfinite(map_)] < 2.0))
        for words, map_ in readings.items()
    }
    # Of readings that fit alike, as of a plane upside down, the plainest.
    as_given, best = fits["as it is"], next(words for words in fits if fits[words] > max(fits.values()) - 0.02)
    # Of right matches most fit; of wrong ones half do not by any reading.
    if as_given > 0.25 or fits[best] < 0.5:
        return ""
    return (
        f"the true disparities contradict the matches: {as_given:.0%} of these fit them, and {fits[best]:.0%} if they "
        f"are read {best}; check truth_disparity: sign, unit, order of rows, and that each is of its left image"
    )
