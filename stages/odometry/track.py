"""Tracking of interest points through the left frames of a segment (section 5.2.1).

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.1. The first iteration is the paper's: coarse displacements of
all pixels between successive frames (stage ``motion``) predict the place of an interest point. In place of the second
one, a search by feature vectors, the affinity by which the surroundings of a point changed is fitted to the
displacements of its neighbours, and the template of the frame in which the point was *born* is aligned under it, there
and back (:mod:`rille.stages.odometry.affine_lk`). Errors do not accumulate along the chain, since each frame is
measured against the first.

A point that is lost keeps its predicted position and may be found again. Buckets of the image that have run empty get
new points at intermediate frames; such a point is looked up backwards in the key frame, where its coordinates are
known, and dropped if it is not found there. Where a frame is blurred, lost points are searched in images blurred alike
(:mod:`rille.stages.odometry.sharpness`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, Params, stage
from rille.stages.core.validity import Mask
from rille.stages.facts.imaging import PyramidFacts
from rille.stages.facts.odometry import MotionFacts, TrackFacts
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.odometry.affine_lk import HALF, Templates, align
from rille.stages.odometry.displacements import NEIGHBOURS, Motion, fit_affinity, known
from rille.stages.odometry.moravec import clear_of_mask, interest_points
from rille.stages.odometry.sharpness import equally_sharp

MAX_RETURN_PX = 0.5
"""Largest distance between a point and where its alignment there and back ends (4.3.3)."""


class TrackParams(Params):
    """Parameters of the stage ``track``.

    Attributes
    ----------
    points : interest points of the key frame (paper: about 200); the pose error falls with the square root of their
        number.
    noise : grey value noise [grey levels] of one image; patches whose contrast is below three times its effect get no
        point; where hardly one gets any, the noise that the image has, if it is less.
    """

    points: int = Field(400, ge=6)
    noise: float = Field(1.5, gt=0)


@dataclass
class Tracks:
    """``points`` (n, frames, 2) column, row, NaN lost; ``birth`` (n,) index of the frame that the template is from;
    ``expected`` (n, 2) predicted place of each point in the last frame that was searched."""

    points: Floats
    birth: NDArray[np.int16]
    expected: Floats

    @staticmethod
    def born(points: Floats, frame: int, frames: int) -> Tracks:
        """Tracks of points (n, 2) that one of so many frames shows first."""
        state = Tracks(np.full((len(points), frames, 2), np.nan), np.full(len(points), frame, np.int16), points.copy())
        state.points[:, frame] = points
        return state

    def and_also(self, other: Tracks, keep: Bools) -> Tracks:
        """These tracks, and those of the others (n,) that are kept."""
        return Tracks(*(np.concatenate([mine, vars(other)[name][keep]]) for name, mine in vars(self).items()))


def track(frames: Sequence[Pyramid], motions: Sequence[Motion], params: TrackParams) -> Tracks:
    """Follow interest points of the first frame, and later ones, through all frames.

    Parameters
    ----------
    frames : pyramids of the left images of a segment, key frame first.
    motions : displacements from each frame to the next, one fewer than frames.
    """
    first = frames[0]
    seeds = interest_points(first.images[0], first.valid[0], params.points, noise=params.noise)
    if 4 * len(seeds) < params.points:
        # Of little contrast (snow, night), with less noise than is usual; at least 0.5 grey levels, as rounding alone
        # makes 0.3.
        params = params.model_copy(update={"noise": min(params.noise, max(first.noise, 0.5))})
        seeds = interest_points(first.images[0], first.valid[0], params.points, noise=params.noise)
    state = Tracks.born(seeds.astype(np.float64), 0, len(frames))
    for j, motion in enumerate(motions, start=1):
        _advance(state, frames, motion, j, params)
        if j < len(frames) - 1:
            state = _reseed(state, frames, j, params)
    return state


def _advance(state: Tracks, frames: Sequence[Pyramid], motion: Motion, j: int, params: TrackParams) -> None:
    """Find all points of frame j - 1 in frame j; a lost one goes on with its prediction, and may be found again."""
    state.expected = state.expected + motion.at(state.expected)
    inside = known(state.expected)
    # Points of one birth share their first frame, so that an affinity is fitted to pairs of the same two frames.
    for birth in np.unique(state.birth):
        who = np.flatnonzero((state.birth == birth) & inside)
        then = state.points[:, birth]
        # From the coarse displacements, which outliers do not pull.
        affinity, _ = fit_affinity(then, state.expected, inside & known(then), then[who])
        templates = Templates(then[who], state.expected[who], affinity)
        state.points[who, j] = place = _aligned(frames[int(birth)], frames[j], templates, params)
        state.expected[who] = np.where(np.isfinite(place), place, state.expected[who])


def _reseed(state: Tracks, frames: Sequence[Pyramid], j: int, params: TrackParams) -> Tracks:
    """Add points of frame j in empty buckets, as far as they are found in the key frame."""
    alive = known(state.points[:, j]) & known(state.points[:, 0])
    here, there = state.points[alive, j], state.points[alive, 0]
    seeds = interest_points(
        frames[j].images[0], frames[j].valid[0], params.points, noise=params.noise, occupied=here
    ).astype(np.float64)
    # Fewer tracks do not determine the affinity back to the key frame.
    if len(seeds) == 0 or len(here) < NEIGHBOURS:
        return state
    affinity, shift = fit_affinity(here, there, np.ones(len(here), bool), seeds)
    new = Tracks.born(seeds, j, len(frames))
    new.points[:, 0] = _aligned(frames[j], frames[0], Templates(seeds, seeds + shift, affinity), params)
    return state.and_also(new, known(new.points[:, 0]))


def _aligned(a: Pyramid, b: Pyramid, templates: Templates, params: TrackParams) -> Floats:
    """Positions (n, 2) in ``b`` of points of ``a``; NaN of those that are not found."""
    images = a.images[0], b.images[0]
    place = _there_and_back(*images, b.valid[0], templates, params)
    alike = equally_sharp(*images, templates.points, templates.start)
    if alike is not None:
        lost = np.flatnonzero(np.isnan(place[:, 0]))
        place[lost] = _there_and_back(*alike, b.valid[0], templates.take(lost), params)
    return place


def _there_and_back(a: Floats32, b: Floats32, valid: Mask, templates: Templates, params: TrackParams) -> Floats:
    """Positions (n, 2) in ``b`` of points of ``a`` whose alignment back ends where they are; NaN of the others."""
    # A difference of two images has the noise of both.
    # 4.0: largest distance of a point from its prediction: one pixel of the coarse displacement map.
    # 0.1: standard deviation of each element of a template's affinity about the one fitted to its neighbours.
    how = {"noise": params.noise * 2.0**0.5, "spread": 0.1, "reach": 4.0}
    place = align(a, b, templates, **how)
    good = np.flatnonzero(clear_of_mask(valid, place, HALF))
    inverse = np.asarray(np.linalg.inv(templates.affinity[good]), np.float64)
    back = Templates(place[good], templates.points[good], inverse)
    miss = align(b, a, back, **how, settled=0.03) - templates.points[good]
    kept = np.isin(np.arange(len(place)), good[np.hypot(*miss.T) <= MAX_RETURN_PX])
    return np.where(kept[:, None], place, np.nan)


@stage(
    "track",
    outputs=[Array("points", ("point", "frame", "uv"), "float32", "px", "column and row of the point", nodata="nan")],
)
def track_stage(
    params: TrackParams,
    pyramids: Sequence[Bundle[PyramidFacts]],
    motions: Sequence[Bundle[MotionFacts]],
    *,
    frames: Sequence[int],
) -> Bundle[TrackFacts]:
    """Interest points followed through the left frames of a segment."""
    found = track([Pyramid.from_bundle(b) for b in pyramids], [Motion.of(b) for b in motions], params)
    return Bundle({"points": found.points.astype(np.float32)}, {"frames": list(frames)})
