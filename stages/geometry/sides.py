"""Whether the matches of a pair fit its rig, fit it with the sides exchanged, or fit no rig at all.

With parallel cameras, matches of exchanged images lie beyond infinity. With convergent cameras they need not, but their
rows then differ from the epipolar lines towards the corners. A match therefore fits the rig if it lies near its
epipolar line *and* in front of the cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.epipolar import MAX_LINE_DISTANCE_PX, beyond_infinity, line_distances
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.scale import right_pixels


class BeyondInfinityError(DegenerateError):
    """Most matches lie beyond infinity, though the sides are not exchanged."""


def fits(rig: Rig, left: Floats, right: Floats) -> float:
    """Share of the matches (n, 2), (n, 2) in front of the cameras and on their epipolar lines."""
    return _near(rig, left, right, line_distances(rig, left, right))


def fits_turned(rig: Rig, left: Floats, right: Floats) -> float:
    """The same share once the right camera is turned back about its optical and its horizontal axis, which moves rows
    alike, and in proportion to the column."""
    off = line_distances(rig, left, right)
    column, line = right[:, 0] - right[:, 0].mean(), np.array([0.0, np.median(off)])
    for _ in range(6):
        rest = np.abs(off - np.polyval(line, column))
        near = rest <= max(_tolerance(rig), 2.0 * float(np.median(rest)))
        line = np.polyfit(column[near], off[near], 1)
    return _near(rig, left, right, off - np.polyval(line, column))


def _near(rig: Rig, left: Floats, right: Floats, off: Floats) -> float:
    """Share of the matches that are in front of the cameras, and less than the tolerance ``off`` (n,) their lines."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = beyond_infinity(rig, left, right) < 0.5 * _tolerance(rig)
    return float(np.mean((np.abs(off) < _tolerance(rig)) & ahead))


def _tolerance(rig: Rig) -> float:
    return MAX_LINE_DISTANCE_PX * right_pixels(rig)


def exchanged(rig: Rig, left: Floats, right: Floats) -> tuple[bool, float, float]:
    """Whether left and right are exchanged; shares of the matches that fit the rig as given, and the other way."""
    as_given, other_way = fits(rig, left, right), fits(rig, right, left)
    return likelier(other_way, as_given), as_given, other_way


def likelier(other: float, given: float) -> bool:
    """Whether most of the matches fit another rig, and more than twice as many as fit the given one (shares)."""
    return other > 0.5 and other > 2.0 * given


def refuse_mirrored(rig: Rig, left: Floats, right: Floats, fitting: float) -> None:
    """Refuse matches that fit the rig only once the images of both cameras are mirrored top to bottom.

    ``fitting`` is the share that fits it as given, or exchanged. If baseline and axes lie in one plane, nothing shows
    it.
    """
    back = [points * [1.0, -1.0] + [0.0, of.height - 1.0] for of, points in ((rig.left, left), (rig.right, right))]
    if fitting < 0.4 and fits(rig, back[0], back[1]) > 0.8:
        text = "the matches fit the rig only once the images of both cameras are mirrored top to bottom"
        raise DegenerateError("RIL-684", text, remedy="mirror them back")


def refuse_exchanged(rig: Rig, left: Floats, right: Floats) -> None:
    """Refuse matches that fit the rig with its sides exchanged, or with its transformation inverted."""
    as_given = fits(rig, left, right)
    if as_given >= 0.5:
        return  # no other rig can fit twice as many
    inverted = replace(rig, T_right_left=rig.T_right_left.inverse())
    others = (
        (fits(rig, right, left), "its sides exchanged"),
        (fits(inverted, left, right), "its transformation inverted"),
    )
    share, how = max(others)
    if likelier(share, as_given):
        raise DegenerateError(
            "RIL-781",
            f"{share:.0%} of the matches fit the rig with {how}, {as_given:.0%} as given",
            remedy="check left/right order, they seem swapped, the sign of the baseline, whether its transformation "
            "leads from right to left, whether the images are mirrored or upside down, and whether the scene repeats "
            "along the rows (bricks, tiles)",
        )


def refuse_impossible(rig: Rig, left: Floats, right: Floats, beyond: float) -> None:
    """Refuse matches of which most lie beyond infinity (share ``beyond``), or fit the rig mirrored or sides swapped.

    With sides swapped, matches of parallel cameras lie beyond infinity, those of others on wrong lines. Where all of
    them lie there alike, they may as well show a sky through a camera that is turned.
    """
    swapped, as_given, other_way = exchanged(rig, left, right)
    refuse_mirrored(rig, left, right, max(as_given, other_way))
    low, middle, high = np.quantile(beyond_infinity(rig, left, right), (0.25, 0.5, 0.75))
    if (swapped or beyond > 0.5) and middle > 0 and high - low < MAX_LINE_DISTANCE_PX * right_pixels(rig):
        raise DegenerateError(
            "RIL-772",
            f"the matches lie {middle:.1f} px beyond infinity, near and far alike (half of them within "
            f"{high - low:.1f} px)",
            remedy="if all that is seen is far away (sky, horizon), the angle between the cameras, or a principal "
            "point, is off by that: calibrate anew, and let the images show near ground; if not, left and right are "
            "exchanged, or the sign of the baseline is wrong",
        )
    refuse_exchanged(rig, left, right)
    if beyond > 0.5:
        raise BeyondInfinityError(
            "RIL-375",
            f"{beyond:.0%} of the matches lie beyond infinity",
            remedy="check that left and right are of one scene and one time, the angles between the cameras (is R "
            "transposed?), that each has its own principal point, and whether the scene repeats along the rows (rows "
            "of plants, bricks, tiles)",
        )
