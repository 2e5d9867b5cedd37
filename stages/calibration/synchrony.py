"""Test whether left and right images are simultaneous: find the right image that fits each left one.

While the vehicle moves, matches in a right image of another time lie pixels off their epipolar lines; those in the
simultaneous image do not. At rest all fit equally, and nothing is reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import SynchronyFacts
from rille.stages.geometry.epipolar import line_distances, standing, turn_axes
from rille.stages.geometry.geometry import Rig
from rille.stages.imaging.features import matched_points
from rille.stages.numeric.robust import mad_sigma

MIN_SPREAD_PX = 1.0
"""Pixels: spread of a pair as named below which it is simultaneous; matches within are on their lines."""


def row_offsets(rig: Rig, left: Bundle, right: Bundle) -> Floats | None:
    """Distances [px] of the matches from their epipolar lines, less their median and trend; None for too few matches.

    The median is due to a small turn of a camera, the trend across the lines to focal lengths that do not fit each
    other. Neither is due to a shift in time.
    """
    at, other = matched_points(left, right)
    apart = line_distances(rig, at, other)
    # Far mismatches (a tenth of the image) would hide the effect of a shift on the others.
    near = np.abs(apart) < 0.1 * rig.right.height
    if near.sum() < 40:
        return None
    apart, across = apart[near], (other @ turn_axes(rig)[:2, 0 if standing(rig) else 1])[near]
    apart, across = apart - np.median(apart), across - np.median(across)
    far = np.abs(across) >= max(1.0, float(np.median(np.abs(across))))
    trend = np.median(apart[far] / across[far]) if far.any() else 0.0
    return np.asarray(apart - trend * across)


def best_partners(offsets: Mapping[int, Mapping[int, Floats | None]]) -> SynchronyFacts:
    """Facts of the pairs; ``offsets``: result of :func:`row_offsets` by frame of the left and of the right image.

    ``rows``: spread [px] of each pair as named; ``partners``: pair and frame of its right image, if that is another;
    ``contradiction``: one line if there are such.
    """
    rows, partners = list[float](), dict[int, int]()
    for pair, by in offsets.items():
        known = {frame: apart for frame, apart in by.items() if apart is not None}
        if pair not in known:
            continue
        # By most matches on their lines, not by least spread: of far times only things match that hardly move.
        other = max(known, key=lambda frame: int((np.abs(known[frame]) < MIN_SPREAD_PX).sum()))
        rows.append(mad_sigma(known[pair]))
        # 0.5: spread with another right image, over that as named, below which the other one is simultaneous.
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
    """Which right image fits which left one, in words, with runs of three or more pairs of the same shift together; and
    by how much to renumber which images of these runs."""
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
