"""What a disparity map is worth: filled alike, then compared with the truth.

Disparities are displacements of the left image's pixels, right minus left: column ``u``, row ``v``, float64 (row, col),
NaN where there is none. On a parallel rig ``u`` is negative and nearer things have the lesser one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.numeric.robust import mad_sigma

Map = NDArray[np.float64]

THRESHOLDS = (1, 2, 3)
BINS = 10

LEAST, ITERATIONS, SCATTER = 100, 10, 0.5
"""Matches that lines can be fitted to, and how; the scatter of rows in pixels."""


@dataclass(frozen=True)
class Truth:
    """True displacements, NaN unknown."""

    u: Map
    v: Map

    @property
    def known(self) -> NDArray[np.bool_]:
        """Pixels with truth."""
        return np.isfinite(self.u) & np.isfinite(self.v)


@dataclass(frozen=True)
class Found:
    """A matcher's claim: displacements, and where they were measured. ``rows``: whether it searches rows, too.

    ``std``: standard deviation of the columns that it claims, pixels, if it does. ``dense``: displacements (u, v) with
    the pixels that it fills itself, if it does.
    """

    u: Map
    v: Map
    matched: NDArray[np.bool_]
    rows: bool
    std: Map | None = None
    dense: tuple[Map, Map] | None = None


def fill(found: Found) -> Found:
    """Every pixel without a match takes the column of the nearest match in its row, of the two the background's.

    The row displacement of a matcher that searches rows is then that of its own epipolar lines there (:func:`lines`):
    between turned cameras rows change along a row, and a neighbour's is a pixel off after 30 columns at 2 degrees.
    Rows of pixels without any match stay NaN.
    """
    rows, cols = found.matched.shape
    here = np.arange(cols)
    before = np.maximum.accumulate(np.where(found.matched, here, -1), axis=1)
    after = np.minimum.accumulate(np.where(found.matched, here, cols)[:, ::-1], axis=1)[:, ::-1]
    row = np.arange(rows)[:, None]
    u_before = np.where(before >= 0, found.u[row, np.maximum(before, 0)], -np.inf)
    u_after = np.where(after < cols, found.u[row, np.minimum(after, cols - 1)], -np.inf)
    source = np.where(u_before >= u_after, before, after)
    there = (source >= 0) & (source < cols)
    source = np.clip(source, 0, cols - 1)
    u, v = (np.where(there, m[row, source], np.nan) for m in (found.u, found.v))
    if found.rows and np.count_nonzero(found.matched) >= LEAST:
        # What the lines change between the match and here: where they err, they err alike.
        g = lines(found)
        change = model(u, row, here) @ g - model(u, row, source) @ g
        v = np.where(found.matched, v, v + change)
    return Found(u, v, found.matched, found.rows)


def lines(found: Found) -> NDArray[np.float64]:
    """Factors of :func:`model` that explain the row displacements of all matches, by Cauchy weights."""
    y, x = np.nonzero(found.matched)
    terms = model(found.u, np.arange(found.u.shape[0])[:, None], np.arange(found.u.shape[1]))[y, x]
    target, weight = found.v[y, x], np.ones(x.size)
    g: NDArray[np.floating[Any]] = np.zeros(terms.shape[1])
    for _ in range(ITERATIONS):
        # Weakly held at nothing: where all depths are alike, columns say as much as displacements.
        normal = (terms * weight[:, None]).T @ terms + 1e-6 * x.size * np.eye(g.size)
        g = np.linalg.solve(normal, (terms * weight[:, None]).T @ target)
        weight = 1.0 / (1.0 + ((target - terms @ g) / SCATTER) ** 2)
    return np.asarray(g)


def model(u: Map, y: NDArray[Any], x: NDArray[Any]) -> NDArray[np.float64]:
    """Terms (row, col, 7) that a row displacement on epipolar lines is nearly linear in; rows ``y``, columns ``x``."""
    n = max(u.shape)
    p, q, d = np.broadcast_arrays(x / n - 0.5, y / n - 0.5, u / n)
    return np.stack([np.ones_like(d), p, q, d, p * q, p * d, q * d], axis=-1)


def error(found: Found, truth: Truth) -> Map:
    """Pixels: length of the difference of the vectors; of a matcher that knows no rows, of the columns."""
    du = found.u - truth.u
    return np.hypot(du, found.v - truth.v) if found.rows else np.abs(du)


def judge(found: Found, truth: Truth) -> dict[str, Any]:
    """Figures of one map.

    ``bad1..3``: share of all pixels with truth that are off by more than 1, 2, 3 px after :func:`fill`, missing ones
    counted; ``bad1..3_column``: the same of the columns alone; ``bad2_own``: ``bad2`` with the matcher's own filling,
    if it has one; ``bad2_inside``: of the pixels whose true counterpart lies in an image of this size;
    ``bad1..3_matched``, ``median``: of what was matched; ``completeness``: share of the pixels with truth that were
    matched; ``nmad``: 1.4826 times the median departure of the matched columns' errors from their median, pixels;
    ``within_1``, ``within_2``: share of the matched pixels whose column errs by at most one and two of the standard
    deviations claimed for it; ``locking``: see :func:`locking`.
    """
    known = truth.known
    if not known.any():
        raise ValueError("the truth has no valid pixel")
    filled = fill(found)
    off = error(filled, truth)[known]
    off_column = np.abs(filled.u - truth.u)[known]
    both = known & found.matched
    off_matched = error(found, truth)[both]
    rows, cols = known.shape
    y, x = np.nonzero(known)
    xr, yr = x + truth.u[known], y + truth.v[known]
    inside = (xr >= 0) & (xr <= cols - 1) & (yr >= 0) & (yr <= rows - 1)
    figures: dict[str, Any] = {f"bad{t}": _bad(off, t) for t in THRESHOLDS}
    figures |= {f"bad{t}_column": _bad(off_column, t) for t in THRESHOLDS}
    figures |= {f"bad{t}_matched": _bad(off_matched, t) for t in THRESHOLDS}
    own = None if found.dense is None else Found(*found.dense, found.matched, found.rows)
    figures["bad2_own"] = None if own is None else _bad(error(own, truth)[known], 2)
    figures["bad2_inside"] = _bad(off[inside], 2)
    figures["median"] = float(np.median(off_matched)) if off_matched.size else None
    figures["completeness"] = off_matched.size / off.size
    figures |= _spread((found.u - truth.u)[both], None if found.std is None else found.std[both])
    figures["locking"], figures["histogram"] = locking(found.u[both])
    return figures


def _spread(off: Map, std: Map | None) -> dict[str, float | None]:
    """Figures of matched columns: NMAD, and shares within one and two standard deviations."""
    if not off.size:
        return {"nmad": None, "within_1": None, "within_2": None}
    nmad = mad_sigma(off)
    within = {f"within_{k}": None if std is None else float(np.mean(np.abs(off) <= k * std)) for k in (1, 2)}
    return {"nmad": nmad, **within}


def _bad(off: Map, threshold: float) -> float | None:
    """Share beyond the threshold; NaN is beyond it."""
    return float(np.mean(~(off <= threshold))) if off.size else None


def locking(u: Map) -> tuple[float | None, list[float]]:
    """Fullest of ten bins of the fractional part relative to a uniform histogram, and all bins.

    The bins are 0.1 px wide and the first one is centred on whole pixels, where matchers lock. Matchers that give
    sixteenths of a pixel cannot come below 1.25: some bins hold two of the sixteen values, others one.
    """
    if not u.size:
        return None, []
    tenth = np.floor(np.mod(u, 1.0) * BINS + 0.5).astype(np.int64) % BINS
    histogram = np.bincount(tenth, minlength=BINS) * (BINS / u.size)
    return float(histogram.max()), [float(h) for h in histogram]
