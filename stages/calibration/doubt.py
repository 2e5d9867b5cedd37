"""Whether the matches of a pair, as a whole, are doubtful.

Two shares of a sample of the matches show this without calibration: of matches far from their epipolar lines, which a
rigid scene does not have; and of matches that correlate as well elsewhere on their lines, as on a repeating pattern,
where each match may be off by a period.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import warning
from rille.stages.core.validity import Validity, has, matched, matched_back
from rille.stages.geometry.epipolar import MAX_LINE_DISTANCE_PX
from rille.stages.geometry.projection import product
from rille.stages.geometry.scale import common_similarity
from rille.stages.hfvm.image import thinned

MIN_MATCHES = 100
"""Fewest matches that are judged."""

PATCH_RADIUS_PX = 8
"""Pixels: half side of a patch."""

SEARCH_REACH_PX = 64
"""Pixels: largest distance from a match at which a similar patch is searched for."""

MIN_RIGID_SHARE = 0.75
"""Share of matches on their lines below which a pair is doubtful. Right pairs reach .98; one through unrectified lenses
.82; photographs of a chess board, matched in part, .71 to .97."""

MAX_REPEATED_SHARE = 0.5
"""Share of matches that look as well elsewhere above which a pair is doubtful. Right pairs reach .1, a board .95."""

MIN_MATCHED_SHARE = 0.05
"""Share of matched pixels below which two images seem unrelated; unrelated ones have less."""

WHY_NOT = (
    (Validity.NO_TEXTURE, "have no texture (black, saturated or blank)"),
    (Validity.OUT_OF_IMAGE, "have their match outside the right image"),
    (Validity.BACKMATCH_FAILED, "do not match back"),
    (Validity.OVER_THRESHOLD, "look like nothing in the right image"),
    (Validity.SPECKLE, "lie in isolated patches"),
)


Places = tuple[NDArray[np.float64], NDArray[np.float64]]


def judge(left: AnyArray, right: AnyArray, disparity: Any, matched: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Shares of the matches that lie on their lines, and that look as well elsewhere; None: too few matches.

    Parameters
    ----------
    left, right : (row, col) grey images.
    disparity : their :class:`~rille.stages.hfvm.stage.StereoMatches`; ``matched`` (row, col): which of it to judge.
    """
    places = sample(disparity.column_disparity, disparity.row_disparity, matched)
    if places is None:
        return None
    f = lines(places)
    return on_their_lines(places, f), repeated(left, right, places, f)


def sample(column: AnyArray, row: AnyArray, matched: NDArray[np.bool_]) -> Places | None:
    """Evenly spread matches: left and right pixels (n, 2), column and row; None where there are too few."""
    # 2000: matches that the lines are fitted to.
    y, x = thinned(matched, 2000)
    if len(y) < MIN_MATCHES:
        return None
    left = np.stack([x, y], 1).astype(np.float64)
    return left, left + np.stack([column[y, x], row[y, x]], 1)


def lines(places: Places) -> NDArray[np.float64] | None:
    """Fundamental matrix that fits most matches; None if there is none."""
    f, _ = cv2.findFundamentalMat(*places, cv2.USAC_MAGSAC, 0.5 * MAX_LINE_DISTANCE_PX, 0.999, 5000)
    return None if f is None or f.shape != (3, 3) else np.asarray(f, np.float64)


def on_their_lines(places: Places, f: NDArray[np.float64] | None) -> float:
    """Share of the matches that lie near their epipolar line; 0 where there are no lines."""
    if f is None:
        return 0.0
    (x, y), (p, q) = (side.T for side in places)
    a, b, c = product(f, x, y)
    return float(np.mean(np.abs(a * p + b * q + c) <= MAX_LINE_DISTANCE_PX * np.hypot(a, b)))


def repeated(left: AnyArray, right: AnyArray, places: Places, f: NDArray[np.float64] | None) -> float:
    """Share of the matches that look as well elsewhere on their epipolar lines; 0 if too few patches can be judged.

    Parameters
    ----------
    left, right : (row, col) grey images.
    """
    a, b = (np.ascontiguousarray(image, np.float32) for image in (left, right))
    b, places, f = _as_left(b, places, f)
    keep = _holds_patch(a.shape, places[0]) & _holds_patch(b.shape, places[1])
    chosen = np.flatnonzero(keep)
    chosen = chosen[:: -(-len(chosen) // 150) or 1]
    looks_alike = []
    for (x, y), (p, q) in zip(*(np.rint(side[chosen]).astype(int) for side in places), strict=True):
        patch = a[y - PATCH_RADIUS_PX : y + PATCH_RADIUS_PX + 1, x - PATCH_RADIUS_PX : x + PATCH_RADIUS_PX + 1]
        (y0, y1), (x0, x1) = (
            (max(at - SEARCH_REACH_PX, PATCH_RADIUS_PX), min(at + SEARCH_REACH_PX, size - 1 - PATCH_RADIUS_PX))
            for at, size in zip((q, p), b.shape, strict=True)
        )
        j, i = np.ogrid[y0 : y1 + 1, x0 : x1 + 1]
        # Without lines: the row through the match.
        line = np.array((0.0, 1.0, -float(q)) if f is None else f @ (x, y, 1.0))
        line /= np.hypot(line[0], line[1])
        here = np.abs(line[0] * i + line[1] * j + line[2]) <= MAX_LINE_DISTANCE_PX
        # The match is rounded: its peak may lie beside it.
        beside = (j - q) ** 2 + (i - p) ** 2 <= 2**2
        # To save time only the strip that holds these pixels is correlated.
        strip = tuple(slice(k.min(), k.max() + 1) for k in np.nonzero(here | beside))
        around = b[y0 - PATCH_RADIUS_PX : y1 + PATCH_RADIUS_PX + 1, x0 - PATCH_RADIUS_PX : x1 + PATCH_RADIUS_PX + 1]
        around = around[tuple(slice(s.start, s.stop + 2 * PATCH_RADIUS_PX) for s in strip)]
        score = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
        own = float(score[beside[strip]].max())
        # 0.7: least correlation of a match that can be judged.
        if np.isfinite(own) and own >= 0.7:
            along = np.rint(line[0] * (j - q) - line[1] * (i - p)).astype(int)
            looks_alike.append(_recurs(score[here[strip]], along[here], own))
    return float(np.mean(looks_alike)) if len(looks_alike) >= MIN_MATCHES // 4 else 0.0


def _recurs(score: Floats32, along: AnyArray, own: float) -> bool:
    """Whether a correlation of ``own`` recurs beyond a place of lesser correlation; ``score`` (n,) of pixels that lie
    ``along`` a line, pixels from the match. An edge that follows the line correlates all along: it does not repeat."""
    profile = np.full(2 * int(np.abs(along).max(initial=0)) + 1, -1.0)
    middle = len(profile) // 2
    np.maximum.at(profile, middle + along, score)
    for side in (profile[middle:], profile[middle::-1]):
        # 0.05 and 0.2: differences of correlation that count as none, and as that of another thing.
        # 8 pixels: least distance of a similar patch.
        lesser = np.minimum.accumulate(side) < own - 0.2
        if (lesser & (side >= own - 0.05))[8:].any():
            return True
    return False


def _as_left(
    right: Floats32, places: Places, f: NDArray[np.float64] | None
) -> tuple[Floats32, Places, NDArray[np.float64] | None]:
    """Right image, matches and lines, less the turn and the scale against the left image that all matches share.

    A patch is hardly more like its match than like other places if that is turned or of another size.
    """
    common = common_similarity(*places)
    scale, turn = float(np.hypot(*common[:, 0])), math.atan2(common[1, 0], common[0, 0])
    # 1.15 and 7 degrees: below, resampling costs more than it repairs.
    if abs(math.log(scale)) < math.log(1.15) and abs(turn) < math.radians(7.0):
        return right, places, f
    back, (rows, cols) = np.linalg.inv(common), right.shape
    corners = np.array([[0, 0], [cols - 1, 0], [0, rows - 1], [cols - 1, rows - 1]]) @ back.T
    shift, size = -corners.min(axis=0), np.ceil(np.ptp(corners, axis=0)).astype(int) + 1
    if scale > 1.0:
        # Its pixels become larger.
        right = np.asarray(cv2.GaussianBlur(right, (0, 0), 0.5 * math.sqrt(scale**2 - 1.0)), np.float32)
    right = np.asarray(cv2.warpAffine(right, np.column_stack([back, shift]), size.tolist()), np.float32)
    whole = np.block([[back, shift[:, None]], [0.0, 0.0, 1.0]])
    return right, (places[0], places[1] @ back.T + shift), None if f is None else np.linalg.inv(whole).T @ f


def _holds_patch(shape: tuple[int, ...], places: AnyArray) -> NDArray[np.bool_]:
    """Whether an image holds the whole patch around each place (n, 2), column and row."""
    last = np.array(shape[1::-1]) - 1 - PATCH_RADIUS_PX
    return np.asarray(((np.rint(places) >= PATCH_RADIUS_PX) & (np.rint(places) <= last)).all(axis=1))


def doubts(result: Any, left: NDArray[Any], right: NDArray[Any], *, closely: bool = True) -> Iterator[str]:
    """Signs that two matched images do not fit, one line each with its figure; ``result``: their ``StereoMatches``.

    A sign that explains all others is the only one. ``closely``: compare samples of the images too, which takes half a
    second.
    """
    one = warning("RIL-708", "left and right are one image") if np.array_equal(left, right) else ""
    explains_all = _unmatched(result) or _without_texture(result) or one
    if explains_all:
        yield explains_all
        return
    if result.unlike.blur:
        which, other = result.unlike.blurred
        text = f"the {which} image is blurred by {abs(result.unlike.blur):.1f} px beside the {other} one: out of focus?"
        yield warning("RIL-710", text)
    if closely:
        yield from _wrong_matches(result, left, right)


def _unmatched(result: Any) -> str:
    """Warning that hardly a pixel matches, with the two most frequent reasons, which hint at light, order or scene."""
    share = float(matched(result.validity).mean())
    if share >= MIN_MATCHED_SHARE:
        return ""
    shares = sorted(((float(has(result.validity, bit).mean()), words) for bit, words in WHY_NOT), reverse=True)
    frequent = ", ".join(f"{100 * s:.0f} % {words}" for s, words in shares[:2] if s >= 0.005)
    text = f"only {100 * share:.1f} % of the pixels match ({frequent}): do both images show one scene in one light?"
    return warning("RIL-700", text)


def _without_texture(result: Any) -> str:
    share = float(has(result.validity, Validity.NO_TEXTURE).mean())
    text = f"{100 * share:.0f} % of the pixels have no texture (black, saturated or blank) and cannot match"
    # Half of the image deserves a warning, however well the rest matches.
    return warning("RIL-701", text) if share > 0.5 else ""


def _wrong_matches(result: Any, left: NDArray[Any], right: NDArray[Any]) -> Iterator[str]:
    """Warnings that matches contradict each other, or look as well elsewhere."""
    judged = judge(left, right, result, matched_back(result.validity, result.backmatch_error))
    if judged is None:
        return
    on_lines, repeated = judged
    if on_lines < MIN_RIGID_SHARE:
        share = f"only {100 * on_lines:.0f} % of the matches lie within {MAX_LINE_DISTANCE_PX:.0f} px of one epipolar"
        text = "geometry: wrong matches, things that move, or a lens that distorts: look at them first"
        yield warning("RIL-703", f"{share} {text}")
    if repeated > MAX_REPEATED_SHARE:
        share = f"{100 * repeated:.0f} % of the matches look as well elsewhere on their epipolar line"
        text = "on a repeating pattern they may be off by a period: look at them first"
        yield warning("RIL-704", f"{share}: {text}")
