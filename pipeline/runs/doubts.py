"""Two images without calibration: spread their grey values, and warn if they seem not to belong together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import warning
from rille.stages.core.validity import Validity, has, matched, matched_back
from rille.stages.geometry.epipolar import MAX_LINE_DISTANCE_PX
from rille.stages.imaging import levels

MIN_MATCHED_SHARE = 0.05
"""Share of matched pixels below which two images seem unrelated; unrelated ones have less."""

WHY_NOT = (
    (Validity.NO_TEXTURE, "have no texture (black, saturated or blank)"),
    (Validity.OUT_OF_IMAGE, "have their match outside the right image"),
    (Validity.BACKMATCH_FAILED, "do not match back"),
    (Validity.OVER_THRESHOLD, "look like nothing in the right image"),
    (Validity.SPECKLE, "lie in isolated patches"),
)


def levelled(images: Sequence[AnyArray]) -> tuple[list[AnyArray], list[str]]:
    """Left and right image, with 16-bit samples spread if they use a small part of their range; and warnings."""
    used = levels.levels_of_sides(images[:1], images[1:])
    lines = [warning("RIL-705", line) for line in levels.words(used)]
    return [levels.spread(i, of) for i, of in zip(images, used, strict=True)], lines


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
    from rille.stages.calibration import doubt

    judged = doubt.judge(left, right, result, matched_back(result.validity, result.backmatch_error))
    if judged is None:
        return
    on_lines, repeated = judged
    if on_lines < doubt.MIN_RIGID_SHARE:
        share = f"only {100 * on_lines:.0f} % of the matches lie within {MAX_LINE_DISTANCE_PX:.0f} px of one epipolar"
        text = "geometry: wrong matches, things that move, or a lens that distorts: look at them first"
        yield warning("RIL-703", f"{share} {text}")
    if repeated > doubt.MAX_REPEATED_SHARE:
        share = f"{100 * repeated:.0f} % of the matches look as well elsewhere on their epipolar line"
        text = "on a repeating pattern they may be off by a period: look at them first"
        yield warning("RIL-704", f"{share}: {text}")
