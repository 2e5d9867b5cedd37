"""Tracking of interest points through the left frames of a segment (section 5.2.1).

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.1. Two iterations as there: coarse displacements of all pixels
between successive frames (stage ``motion``) predict where an interest point went; feature vectors find it at full
resolution. Two steps of ours follow: the affinity by which the surroundings of a point changed is fitted to the
displacements of its neighbours, and the template of the frame in which the point was *born* is aligned under it
(:mod:`rille.stages.odometry.affine_lk`). Errors do not accumulate along the chain, since each frame is measured against
the first.

A point that is lost keeps its predicted position and may be found again. Buckets of the image that have run empty get
new points at intermediate frames; such a point is looked up backwards in the key frame, where its coordinates are
known, and dropped if it is not found there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.declare import Array, Bundle, Inputs, Params, Stage
from rille.stages.core.errors import InputError
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.odometry.affine_lk import HALF, align
from rille.stages.odometry.moravec import clear_of_mask, interest_points
from rille.stages.odometry.point_search import match_points

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

BORDER = 8
"""Pixels between an interest point and the image's edge: template, cubic interpolation and a search step."""
NEIGHBOURS = 12
"""Tracks that an affinity of six numbers is fitted to: twice as many as needed, still local."""
PULL = 5.0
"""Pixels: neighbours that spread less than this do not tell of a change of shape."""


class TrackParams(Params):
    """Parameters of the stage ``track``."""

    points: int = Field(
        400, ge=6, description="interest points of the key frame; the paper: about 200, the error falls with the root"
    )
    noise: float = Field(1.5, gt=0, description="grey levels; noise of one image, no texture below thrice its effect")
    radius: int = Field(4, ge=1, description="pixels; search around the prediction: one pixel of the coarse level")
    affinity_sigma: float = Field(
        0.1, gt=0, description="expected departure of a template's affinity from its neighbours', per element"
    )
    max_scale: float = Field(
        2.0, gt=1, description="change of scale since birth up to which its template is used; then the last frame's"
    )
    reseed: bool = Field(True, description="new points in empty buckets of intermediate frames")


@dataclass(frozen=True)
class Motion:
    """Coarse displacements (rows, cols) of a pyramid level, in level 0 pixels, NaN undefined."""

    column: NDArray[np.float32]
    row: NDArray[np.float32]
    level: int


@dataclass(frozen=True)
class Tracks:
    """``points`` (n, frames, 2) column, row, NaN lost; ``birth`` (n,) frame index; ``distance`` (n, frames), NaN."""

    points: NDArray[np.float32]
    birth: NDArray[np.int16]
    distance: NDArray[np.float32]


def track(frames: Sequence[Pyramid], motions: Sequence[Motion], params: TrackParams) -> Tracks:
    """Follow interest points of the first frame, and later ones, through all frames.

    Parameters
    ----------
    frames : pyramids of the left images of a segment, key frame first.
    motions : displacements from each frame to the next, one fewer than frames.

    Raises
    ------
    InputError
        Not one motion between each two frames.
    """
    if len(motions) != len(frames) - 1:
        raise InputError("RIL-447", f"{len(frames)} frames need {len(frames) - 1} motions, not {len(motions)}")
    first = frames[0]
    seeds = interest_points(first.images[0], first.valid[0], params.points, noise=params.noise, border=BORDER)
    state = _State.born(seeds.astype(np.float64), 0, len(frames))
    for j in range(1, len(frames)):
        _advance(state, frames, motions[j - 1], j, params)
        if params.reseed and j < len(frames) - 1:
            state = _reseed(state, frames, j, params)
    return Tracks(state.points.astype(np.float32), state.birth, state.distance.astype(np.float32))


@dataclass
class _State:
    """Tracks in the making; ``expected`` (n, 2) is where each point is thought to be in the present frame."""

    points: Floats
    birth: NDArray[np.int16]
    distance: Floats
    expected: Floats

    @staticmethod
    def born(points: Floats, frame: int, frames: int) -> _State:
        n = len(points)
        state = _State(
            np.full((n, frames, 2), np.nan), np.full(n, frame, np.int16), np.full((n, frames), np.nan), points.copy()
        )
        state.points[:, frame], state.distance[:, frame] = points, 0.0
        return state

    def and_also(self, other: _State, keep: Bools) -> _State:
        return _State(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)[keep]])
                for name in ("points", "birth", "distance", "expected")
            )
        )


def _advance(state: _State, frames: Sequence[Pyramid], motion: Motion, j: int, params: TrackParams) -> None:
    """Find all points of frame j - 1 in frame j."""
    predicted = state.expected + displacement_at(motion, state.expected)
    smooth, _ = fit_affinity(state.expected, predicted, _known(predicted), state.expected)
    matched = match_points(frames[j - 1], frames[j], state.expected, predicted, smooth, params.radius)
    found = _known(matched)
    state.expected = np.where(found[:, None], matched, predicted)
    for birth in np.unique(state.birth):
        group = np.flatnonzero((state.birth == birth) & found)
        then = state.points[:, birth]
        affinity, _ = fit_affinity(then, matched, found & _known(then), then[group])
        scale = np.linalg.svd(affinity, compute_uv=False)
        near = (scale[:, 0] < params.max_scale) & (scale[:, 1] > 1.0 / params.max_scale)
        for source, chosen in ((int(birth), near), (j - 1, ~near & _known(state.points[group, j - 1]))):
            who = group[chosen]
            if who.size == 0:
                continue
            template = affinity[chosen] if source == birth else smooth[who]
            place, error = _align(frames[source], frames[j], state.points[who, source], matched[who], template, params)
            state.points[who, j], state.distance[who, j] = place, error
            state.expected[who] = np.where(np.isfinite(place), place, state.expected[who])


def _reseed(state: _State, frames: Sequence[Pyramid], j: int, params: TrackParams) -> _State:
    """Add points of frame j in empty buckets, as far as they are found in the key frame."""
    alive = _known(state.points[:, j]) & _known(state.points[:, 0])
    here, there = state.points[alive, j], state.points[alive, 0]
    seeds = interest_points(
        frames[j].images[0], frames[j].valid[0], params.points, noise=params.noise, border=BORDER, occupied=here
    ).astype(np.float64)
    if len(seeds) == 0 or len(here) < NEIGHBOURS:
        return state
    affinity, shift = fit_affinity(here, there, np.ones(len(here), bool), seeds)
    matched = match_points(frames[j], frames[0], seeds, seeds + shift, affinity, params.radius)
    place, error = _align(frames[j], frames[0], seeds, matched, affinity, params)
    new = _State.born(seeds, j, len(frames))
    new.points[:, 0], new.distance[:, 0] = place, error
    return state.and_also(new, _known(place))


def _known(points: Floats) -> Bools:
    """Which rows (n, 2) are not NaN."""
    return np.asarray(np.isfinite(points).all(axis=1))


def _align(
    a: Pyramid, b: Pyramid, points: Floats, start: Floats, affinity: Floats, params: TrackParams
) -> tuple[Floats, Floats]:
    place, error = align(
        a.images[0],
        b.images[0],
        points,
        start,
        affinity,
        noise=params.noise * 2.0**0.5,
        spread=params.affinity_sigma,
        reach=2.0,
    )
    good = clear_of_mask(b.valid[0], place, HALF)
    return np.where(good[:, None], place, np.nan), np.where(good, error, np.nan)


def displacement_at(motion: Motion, points: Floats) -> Floats:
    """Coarse displacement (n, 2) at points (n, 2), pixels: median of the defined ones among 3 x 3; NaN none."""
    k = 0.5**motion.level
    rows, cols = motion.column.shape
    centre = np.floor((np.nan_to_num(points) + 0.5) * k).astype(np.intp)
    dy, dx = (o.ravel() for o in np.mgrid[-1:2, -1:2])
    y, x = np.clip(centre[:, 1:] + dy, 0, rows - 1), np.clip(centre[:, :1] + dx, 0, cols - 1)
    both = np.stack([motion.column[y, x], motion.row[y, x]], -1).astype(np.float64)
    known: Bools = np.asarray(np.isfinite(both).all(axis=-1))
    count = known.sum(axis=1)
    both = np.where(known[..., None], both, np.nan)
    value = np.stack([known_median(both[..., k], count) for k in range(2)], axis=-1)
    return np.where(_known(points)[:, None], value, np.nan)


def known_median(values: NDArray[Any], known: NDArray[Any]) -> NDArray[Any]:
    """Median (n,) of the values (n, k) that are not NaN, of which there are ``known`` (n,); NaN where there are none.

    NumPy's own takes twenty times as long on many short rows.
    """
    ordered, row = np.sort(values, axis=-1), np.arange(len(values))
    low, high = ordered[row, np.maximum(known - 1, 0) // 2], ordered[row, known // 2]
    return np.asarray(np.where(known > 0, (low + high) * values.dtype.type(0.5), values.dtype.type(np.nan)))


def fit_affinity(origin: Floats, moved: Floats, use: Bools, at: Floats) -> tuple[Floats, Floats]:
    """Affinity (n, 2, 2) and displacement (n, 2) at points ``at`` (n, 2) from the nearest pairs ``origin -> moved``.

    Least squares, reweighted by Cauchy's weights of one pixel, so that a neighbour on another surface counts little. A
    weak pull towards the rotation and scale that all pairs share keeps neighbours on a line from inventing a change of
    shape. Too few pairs: no change.
    """
    n = len(at)
    identity, nothing = np.tile(np.eye(2), (n, 1, 1)), np.zeros((n, 2))
    p, q = origin[use], moved[use]
    if len(p) < 6 or n == 0:
        return identity, nothing
    common = common_similarity(p, q)
    affinity, shift = identity, nothing
    _fit_all(
        np.ascontiguousarray(p, dtype=np.float64),
        np.ascontiguousarray(q - p, dtype=np.float64),
        common,
        np.nan_to_num(at),
        affinity,
        shift,
    )
    return affinity, shift


@njit(cache=True, nogil=True)
def _fit_all(origin, moved_by, common, at, affinity, displacement):  # type: ignore[no-untyped-def]
    """:func:`fit_affinity` of every point ``at``; the nearest are taken in the order of distance, then of number."""
    count = min(NEIGHBOURS, len(origin))
    who, far = np.empty(count, np.int64), np.empty(count)
    offset, shift, weight = np.empty((count, 3)), np.empty((count, 2)), np.empty(count)
    normal, right = np.empty((3, 3)), np.empty((3, 2))
    offset[:, 2] = 1.0
    for n in range(len(at)):
        _nearest(origin, at[n, 0], at[n, 1], who, far)
        for k in range(count):
            x, y = origin[who[k], 0] - at[n, 0], origin[who[k], 1] - at[n, 1]
            offset[k, 0], offset[k, 1] = x, y
            shift[k, 0] = moved_by[who[k], 0] - (common[0, 0] - 1.0) * x - common[0, 1] * y
            shift[k, 1] = moved_by[who[k], 1] - common[1, 0] * x - (common[1, 1] - 1.0) * y
            weight[k] = 1.0
        for _ in range(4):
            normal[:], right[:] = 0.0, 0.0
            total = 0.0
            for k in range(count):
                total += weight[k]
                for i in range(3):
                    a = weight[k] * offset[k, i]
                    for j in range(3):
                        normal[i, j] += a * offset[k, j]
                    right[i, 0] += a * shift[k, 0]
                    right[i, 1] += a * shift[k, 1]
            normal[0, 0] += PULL**2 * total
            normal[1, 1] += PULL**2 * total
            normal[2, 2] += 1e-6
            _solve_3(normal, right)
            for k in range(count):
                square = 0.0
                for i in range(2):
                    fitted = right[0, i] * offset[k, 0] + right[1, i] * offset[k, 1] + right[2, i]
                    square += (shift[k, i] - fitted) ** 2
                weight[k] = 1.0 / (1.0 + square)
        for i in range(2):
            affinity[n, i, 0], affinity[n, i, 1] = common[i, 0] + right[0, i], common[i, 1] + right[1, i]
            displacement[n, i] = right[2, i]


@njit(cache=True, nogil=True)
def _nearest(points, x, y, who, far):  # type: ignore[no-untyped-def]
    """Numbers and squared distances of the points nearest to (x, y), nearest first, by insertion."""
    count = len(who)
    far[:] = np.inf
    who[:] = 0
    for m in range(len(points)):
        d = (points[m, 0] - x) ** 2 + (points[m, 1] - y) ** 2
        if d >= far[count - 1]:
            continue
        k = count - 1
        while k > 0 and far[k - 1] > d:
            far[k], who[k] = far[k - 1], who[k - 1]
            k -= 1
        far[k], who[k] = d, m


@njit(cache=True, nogil=True)
def _solve_3(a, b):  # type: ignore[no-untyped-def]
    """Solve a x = b (3, 2) in place for a symmetric positive matrix."""
    for i in range(3):
        for j in range(i + 1, 3):
            f = a[j, i] / a[i, i]
            for k in range(i, 3):
                a[j, k] -= f * a[i, k]
            b[j, 0] -= f * b[i, 0]
            b[j, 1] -= f * b[i, 1]
    for i in range(2, -1, -1):
        for c in range(2):
            for k in range(i + 1, 3):
                b[i, c] -= a[i, k] * b[k, c]
            b[i, c] /= a[i, i]


def common_similarity(origin: Floats, moved: Floats) -> Floats:
    """Rotation and scale (2, 2) in the image that pairs (n, 2) share.

    The mean turn and the median stretch of the lines between pairs, all lines counting alike.
    """
    p, q = ((a - np.roll(a, len(a) // 2, axis=0)) @ np.array([1.0, 1.0j]) for a in (origin, moved))
    long = (np.abs(p) > 0) & (np.abs(q) > 0)
    ratio = q[long] / p[long]
    mean = (ratio / np.abs(ratio)).sum()
    if np.abs(mean) == 0:
        return np.eye(2)
    turn = np.median(np.abs(ratio)) * mean / np.abs(mean)
    return np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])


def _run(params: TrackParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    frames = [Pyramid.from_bundle(b) for b in inputs["frames"]]
    motions = [
        Motion(np.asarray(b["column_disparity"]), np.asarray(b["row_disparity"]), int(b.meta["level"]))
        for b in inputs["motions"]
    ]
    found = track(frames, motions, params)
    return Bundle(
        {"points": found.points, "birth": found.birth, "distance": found.distance},
        {"frames": list(args["frames"]), "tracked": [int(v) for v in np.isfinite(found.distance).sum(0)]},
    )


STAGE = Stage(
    name="track",
    version=1,
    summary="interest points followed through the left frames of a segment",
    params=TrackParams,
    inputs=("frames*", "motions*"),
    outputs=(
        Array("points", ("point", "frame", "uv"), "float32", "px", "column and row of the point", nodata="nan"),
        Array("birth", ("point",), "int16", "1", "index of the frame that the template is from"),
        Array("distance", ("point", "frame"), "float32", "grey", "rms difference to the template", nodata="nan"),
    ),
    run=_run,
)
