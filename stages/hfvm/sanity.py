"""Whether matches deserve doubt as a whole, or images were exchanged: what two images show without calibration.

Two signs, each a share of a sample of the matches: those far from every epipolar line, as no rigid scene has them; and
those that look as well elsewhere along their line, as on a repeating pattern, where each match may be off by a period.

With the right camera on the right, nothing has a column displacement greater than infinitely far things have (right
minus left). Without calibration that of far things is not known: cameras that converge by an angle t move them by
D = f t. But they also make a keystone, a row displacement (t / f) x y about the image's middle, which matches show.
The focal length f is between half and three times the image width, so D is k f^2 with k = t / f within bounds. Images
are swapped for certain where nearly all displacements lie beyond the upper one.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy

LEAST, SAMPLES, PATCHES = 100, 2000, 150
"""Matches that a judgement needs at least, those that the lines are fitted to, and those whose likeness is sought."""

NEAR = 2.0
"""Pixels: a match this near its epipolar line lies on it."""

PATCH, REACH, APART = 8, 64, 8
"""Pixels: half side of a patch, how far from its match a likeness is sought, and how far from it one counts."""

ALIKE, WORSE = 0.7, 0.05
"""Least correlation of a match whose patch says anything, and by how much less a likeness may correlate."""

RIGID = 0.75
"""Share of matches on their lines below which a pair is doubtful. Right pairs reach .98; one through unrectified lenses
.82; photographs of a chess board, matched in part, .71 to .97."""

REPEATED = 0.5
"""Share of matches that look as well elsewhere above which a pair is doubtful. Right pairs reach .34, a board .86."""

Places = tuple[NDArray[np.float64], NDArray[np.float64]]


def judge(left: AnyArray, right: AnyArray, found: Any, matched: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Shares of the matches that lie on their lines, and that look as well elsewhere; None: too few to tell.

    Parameters
    ----------
    left, right : (row, col) grey images.
    found : their :class:`~rille.stages.hfvm.stage.Disparity`; ``matched`` (row, col): which of it to judge.
    """
    places = sample(found.column_disparity, found.row_disparity, matched)
    if places is None:
        return None
    f = lines(places)
    return on_their_lines(places, f), repeated(left, right, places, f)


def sample(column: AnyArray, row: AnyArray, matched: NDArray[np.bool_]) -> Places | None:
    """Evenly strided matches: left and right pixels (n, 2), column and row; None where there are too few."""
    found = np.flatnonzero(matched)
    if len(found) < LEAST:
        return None
    y, x = np.unravel_index(_strided(found, SAMPLES), matched.shape)
    left = np.stack([x, y], 1).astype(np.float64)
    return left, left + np.stack([column[y, x], row[y, x]], 1)


def lines(places: Places) -> NDArray[np.float64] | None:
    """Fundamental matrix that most matches agree on; None where there is none."""
    f, _ = cv2.findFundamentalMat(*places, cv2.USAC_MAGSAC, 0.5 * NEAR, 0.999, 5000)
    return None if f is None or f.shape != (3, 3) else np.asarray(f, np.float64)


def on_their_lines(places: Places, f: NDArray[np.float64] | None) -> float:
    """Share of the matches that lie near their epipolar line; 0 where there are no lines."""
    if f is None:
        return 0.0
    one = np.ones((len(places[0]), 1))
    line = np.hstack([places[0], one]) @ f.T
    distance = np.abs(np.sum(line * np.hstack([places[1], one]), axis=1)) / np.hypot(line[:, 0], line[:, 1])
    return float(np.mean(distance <= NEAR))


def repeated(left: AnyArray, right: AnyArray, places: Places, f: NDArray[np.float64] | None) -> float:
    """Share of the matches that look as well elsewhere on their epipolar line; 0 where too few patches say anything.

    Parameters
    ----------
    left, right : (row, col) grey images.
    """
    a, b = (np.ascontiguousarray(image, np.float32) for image in (left, right))
    keep = _inside(places[0], a.shape, PATCH) & _inside(places[1], b.shape, PATCH)
    chosen = _strided(np.flatnonzero(keep), PATCHES)
    told = []
    for (x, y), (p, q) in zip(*(np.rint(side[chosen]).astype(int) for side in places), strict=True):
        patch = a[y - PATCH : y + PATCH + 1, x - PATCH : x + PATCH + 1]
        y0, x0 = max(q - REACH - PATCH, 0), max(p - REACH - PATCH, 0)
        around = b[y0 : q + REACH + PATCH + 1, x0 : p + REACH + PATCH + 1]
        score = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
        j, i = np.indices(score.shape)
        j, i = j + y0 + PATCH, i + x0 + PATCH
        # The match has been rounded, so that its peak may lie beside it.
        own = float(score[np.hypot(j - q, i - p) <= 2].max())
        if not np.isfinite(own) or own < ALIKE:
            continue
        # Without lines the row through the match stands in.
        line = (0.0, 1.0, -float(q)) if f is None else f @ (x, y, 1.0)
        here = np.abs(line[0] * i + line[1] * j + line[2]) <= NEAR * np.hypot(line[0], line[1])
        elsewhere = score[here & (np.hypot(j - q, i - p) >= APART)]
        told.append(elsewhere.size > 0 and float(elsewhere.max()) >= own - WORSE)
    return float(np.mean(told)) if len(told) >= LEAST // 4 else 0.0


def _strided(found: AnyArray, most: int) -> AnyArray:
    """At most so many of the given ones, evenly strided from the first to the last."""
    return found[np.linspace(0, len(found) - 1, min(most, len(found))).astype(np.intp)]


def _inside(places: AnyArray, shape: tuple[int, ...], margin: int) -> NDArray[np.bool_]:
    last = np.array([shape[1] - 1 - margin, shape[0] - 1 - margin])
    return np.asarray(((np.rint(places) >= margin) & (np.rint(places) <= last)).all(axis=1))


FOCAL = 0.5, 3.0
"""Bounds of the focal length in image widths: fields of view of 90 and 19 degrees."""

SWAP_ITERATIONS = 8
MARGIN = 1.0
"""Pixels: displacements that are no more than this beyond the bound prove nothing."""

NEARLY_ALL = 10.0
"""Percentile of displacements that has to lie beyond the bound."""


def swapped(column: AnyArray, row: AnyArray, matched: NDArray[np.bool_]) -> bool:
    """Whether left and right image of a stereo rig must have been swapped; False also where nobody can know.

    Parameters
    ----------
    column, row : (row, col) disparities, pixels, right minus left.
    matched : (row, col) bool, which to trust.
    """
    found = np.flatnonzero(matched)
    if len(found) < LEAST:
        return False
    found = found[:: 1 + len(found) // SAMPLES]
    y, x = np.unravel_index(found, matched.shape)
    u, v = (np.asarray(a).reshape(-1)[found].astype(np.float64) for a in (column, row))
    width = matched.shape[1]
    k, sigma = _keystone((x - 0.5 * (width - 1)) / width, (y - 0.5 * (matched.shape[0] - 1)) / width, u, v)
    # In units of the image width k is D in pixels for a focal length of one width.
    most = k + 3.0 * sigma
    # A keystone may be negative: then the short focal length gives the upper bound.
    bound = max(most * FOCAL[0] ** 2, most * FOCAL[1] ** 2)
    return bool(np.percentile(u, NEARLY_ALL) > bound + MARGIN)


def _keystone(x: AnyArray, y: AnyArray, u: AnyArray, v: AnyArray) -> tuple[float, float]:
    """Factor of x y in the row displacements, pixels, and its standard deviation, robustly (Cauchy weights).

    Other terms: row offset, roll, scale, relative pitch, baseline across the rows, one camera before the other.
    """
    depth = (u - u.mean()) / max(float(u.std()), 1e-6)
    terms = np.stack([x * y, np.ones_like(x), x, y, y * y, depth, depth * y], -1)
    spread = 1e-3

    def weigh(residual: AnyArray) -> AnyArray:
        # Rows that agree exactly leave residuals of zero to divide by.
        nonlocal spread
        spread = max(1.5 * float(np.median(np.abs(residual))), 1e-3)
        return cauchy(residual, spread)

    # A flat scene has no depth, whose terms are zero: without a hold the matrix would be singular.
    hold = 1e-9 * len(x) * np.eye(terms.shape[1])
    solution = irls(terms, v, weigh, hold, np.zeros(terms.shape[1]), SWAP_ITERATIONS)
    weight = weigh(terms @ solution - v)
    normal = (terms * weight[:, None]).T @ terms + hold
    return float(solution[0]), spread * float(np.sqrt(np.linalg.inv(normal)[0, 0]))
