"""Test whether left and right images are simultaneous: of some right images, find the one that fits each left one.

While the vehicle moves, matches of a right image of another time lie pixels off their epipolar lines; those of the
simultaneous image do not. At rest all fit equally, and no finding results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import SynchronyFacts
from rille.stages.geometry.epipolar import distances
from rille.stages.geometry.geometry import Rig
from rille.stages.imaging.features import matched_points
from rille.stages.numeric.robust import mad_sigma

MIN_SPREAD_PX = 1.0
"""Pixels of spread as named, below which no other image is looked for; matches within are on their lines."""


def row_offsets(rig: Rig, left: Bundle, right: Bundle) -> Floats | None:
    """Distances [px] of the matches from their epipolar lines, about their median; None of too few matches.

    The median is that of a camera that is turned a little, which no shift in time explains.
    """
    apart, _ = distances(rig, np.zeros(5), *matched_points(left, right))
    # Before the spread is taken: far mismatches (a tenth of the image) would hide what a shift does to the others.
    apart = apart[np.abs(apart) < 0.1 * rig.right.height]
    return np.asarray(apart - np.median(apart)) if len(apart) >= 40 else None


def best_partners(offsets: Mapping[int, Mapping[int, Floats | None]]) -> SynchronyFacts:
    """Facts of the pairs, by whose frame, and of the right image's, ``offsets`` are those of :func:`row_offsets`.

    ``rows``: spread [px] of each pair as named; ``partners``: pair and frame of its right image, where that is another;
    ``contradiction``: one line where there is any.
    """
    rows, partners = list[float](), dict[int, int]()
    for pair, by in offsets.items():
        known = {frame: apart for frame, apart in by.items() if apart is not None}
        if pair not in known:
            continue
        # Many on their lines, not a small spread: far away in time only things match that hardly move in the image.
        other = max(known, key=lambda frame: int((np.abs(known[frame]) < MIN_SPREAD_PX).sum()))
        rows.append(mad_sigma(known[pair]))
        # Another right image explains the rows where their spread is half of that as named.
        if rows[-1] > MIN_SPREAD_PX and mad_sigma(known[other]) < 0.5 * rows[-1]:
            partners[pair] = other
    facts: SynchronyFacts = {"rows": rows, "partners": [list(item) for item in partners.items()]}
    if partners:
        which, anew = _shifts(partners)
        line = f"left and right are not of one time: by its rows, {which} is simultaneous"
        if anew:
            line += f"; if a camera lost an image there and counted on, add {anew}"
        facts["contradiction"], facts["warnings"] = line, [line]
    return facts


def _shifts(partners: Mapping[int, int]) -> tuple[str, str]:
    """Which right image is that of which left one, in words, together of three pairs or more that are off by as many
    frames; and of these what to add to the numbers of which images."""
    which, anew = [], []
    for shift, pairs in groupby(partners, lambda pair: partners[pair] - pair):
        run = list(pairs)
        if len(run) < 3:
            which += [f"left {pair} with right {pair + shift}" for pair in run]
            continue
        which.append(f"left i with right i{shift:+d} (i = {run[0]} to {run[-1]})")
        side, first = ("left", run[0]) if shift > 0 else ("right", run[0] + shift)
        anew.append(f"{abs(shift)} to the numbers of the {side} images from {first} on")
    return ", ".join(which), ", ".join(anew)


@stage("synchrony")
def synchrony_stage(
    params: NoParams,
    left: Sequence[Bundle],
    right: Sequence[Bundle],
    *,
    rig: Rig,
    frames: Sequence[int],
    pairs: Sequence[int],
) -> Bundle[SynchronyFacts]:
    """Which right image is of the time of a left one by their features, where the rows contradict their names."""
    offsets = {
        pair: {f: row_offsets(rig, ours, theirs) for f, theirs in zip(frames, right, strict=True)}
        for pair, ours in zip(pairs, left, strict=True)
    }
    return Bundle({}, best_partners(offsets))
