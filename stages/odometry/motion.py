"""Coarse displacement of all points from one left frame to the next (paper, 5.2.1, first iteration).

The hierarchical matcher of stage ``hfvm``, stopped at a coarse level. There is no epipolar band: a camera that moves
forward has radial flow, whose epipolar lines meet inside the image, where a band does not bound the motion along it.

Where the matches are too few, or show a rotation of the image, the homography that keypoints show is undone before
matching again (:mod:`rille.stages.hfvm.plane`): beyond ten degrees of roll upright windows match less and less, at 25
degrees a third of the tracks is wrong. The displacements still refer to the frames as they were taken.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from rille.stages.core.declare import Bundle, Params, raster, stage
from rille.stages.core.validity import Validity, defined, mark, matched, matched_share
from rille.stages.facts.imaging import PyramidFacts
from rille.stages.facts.odometry import MotionFacts
from rille.stages.geometry.scale import common_similarity
from rille.stages.hfvm import plane
from rille.stages.hfvm.image import as_matched
from rille.stages.hfvm.level import PyramidPair, Recipe, descend, fill_rows, median, propagate, search
from rille.stages.hfvm.matcher import DEFAULT
from rille.stages.hfvm.native.problem import LevelPair
from rille.stages.hfvm.native.solver import solver
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.odometry.displacements import Motion


class MotionParams(Params):
    """Parameters of the coarse displacements between successive frames.

    Attributes
    ----------
    level : pyramid level of the displacement map; 2: a quarter of the resolution.
    top_columns : share of the image width searched to either side at the top pyramid level.
    top_rows : share of the image height searched up and down at the top pyramid level.
    turn_below : if fewer than this share of the textured pixels match, undo a homography fitted to features and match
        again; an upright window matches 3/4 of a street scene and 1/3 when turned by 30 degrees; 0: never.
    """

    level: int = Field(2, ge=0, le=6)
    top_columns: float = Field(0.25, gt=0, le=1)
    top_rows: float = Field(0.25, gt=0, le=1)
    turn_below: float = Field(0.5, ge=0, le=1)


SMOOTHNESS, ROUNDS = 5, 6
"""Cost [feature byte steps] of a displacement difference of one pixel to each neighbour; and propagation rounds at each
pyramid level, of which more change little."""
MIN_TEXTURED = 100
"""Pixels with texture, at the coarse level, from which on a rotation can show."""


def coarse_motion(a: Pyramid, b: Pyramid, params: MotionParams, turn: plane.Matrix | None = None) -> Motion:
    """Displacements from frame ``a`` to frame ``b``; of a shallower pyramid its top level.

    Parameters
    ----------
    turn : homography (3, 3) from level-0 pixels of a to those of b, undone before matching; None: not needed.
    """
    level = min(params.level, a.levels - 1, b.levels - 1)
    a, b = a.above(level), b.above(level)
    hp = HfvmParams(
        band=0.0,
        top_columns=params.top_columns,
        top_rows=params.top_rows,
        # Both directions alike: displacements between frames have no epipolar line to prefer.
        search_columns=1,
        smoothness=SMOOTHNESS,
        rounds=ROUNDS,
    )
    # At a coarse level no level is finest: all have the same rounds. At level 0 the matcher's own figures hold.
    rounds = (ROUNDS, ROUNDS) if level else DEFAULT.rounds
    left, right = as_matched(a, hp), as_matched(b, hp)
    if turn is not None:
        turn = np.linalg.inv(plane.finer(level)) @ turn @ plane.finer(level)
        right = plane.aligned(right, turn, left)
    images = PyramidPair(left, right, hp, Recipe((search, propagate, median), (), rounds))
    state, layers = descend(images, 0), (images.left.layers[0], images.right.layers[0])
    validity = np.zeros(state.left.u.shape, np.uint8)
    pair = LevelPair(layers[0].words, layers[1].words)
    u, v, distance = solver.sums(pair, state.left.u, state.left.v, np.ones_like(validity))
    scale = np.float32(2.0**level)
    mark(validity, a.valid[0] == 0, Validity.OUT_OF_IMAGE)
    mark(validity, layers[0].deviation < hp.texture, Validity.NO_TEXTURE)
    mark(validity, ~state.left_ok, Validity.BACKMATCH_FAILED)
    mark(validity, distance > hp.threshold, Validity.OVER_THRESHOLD)
    good = validity == 0
    interpolated = np.zeros(good.shape, np.uint8)
    # Small gaps are filled, so that tracks across them have a prediction; they are marked as no measurements.
    fill_rows(u, v, good, hp.fill_reach, state.near_sign or -1.0, interpolated)
    mark(validity, good, Validity.MATCHED)
    mark(validity, interpolated != 0, Validity.INTERPOLATED)
    u[~defined(validity)] = v[~defined(validity)] = np.nan
    if turn is not None:
        u, v = plane.carried(plane.to_original(turn, a.shape), u, v)
        # Seen in the upright frame, but its place in b lies behind the camera.
        validity[np.isnan(u)] &= ~np.uint8(Validity.MATCHED | Validity.INTERPOLATED)
    return Motion(level, u * scale, v * scale, validity)


def _turned(a: Pyramid, b: Pyramid, plain: Motion, params: MotionParams) -> Motion | None:
    """Displacements after undoing the homography of keypoints; None: that is not needed, or no better."""
    textured = int(np.count_nonzero((plain.validity & np.uint8(Validity.NO_TEXTURE)) == 0))
    if params.turn_below == 0 or textured < MIN_TEXTURED:
        return None
    # A homography is believed if it raises the share by a fifth: chance matches do not.
    share, needed = matched_share(plain.validity), 1.2
    if share >= params.turn_below:
        # Small rotations are the matcher's, which stands them: resampling the image costs more than they do.
        # 10.0: rotation of the image below which nothing is undone: up to there, one to three per cent of the tracks
        # are wrong.
        if abs(_roll_deg(plain)) < 10.0:
            return None
        needed = 1.0
    turn = plane.find_turn(as_matched(a, HfvmParams()), as_matched(b, HfvmParams()))
    if turn is None:
        return None
    motion = coarse_motion(a, b, params, turn)
    return motion if matched_share(motion.validity) > needed * share else None


def _roll_deg(motion: Motion) -> float:
    """Rotation of the image, degrees, that the displacements share."""
    row, col = np.nonzero(matched(motion.validity))
    if len(row) < MIN_TEXTURED:
        return 0.0
    origin = np.asarray((np.stack([col, row], -1) + 0.5) * 2.0**motion.level - 0.5, dtype=np.float64)
    shift = np.stack([motion.column_disparity[row, col], motion.row_disparity[row, col]], -1).astype(np.float64)
    similarity = common_similarity(origin, origin + shift)
    return math.degrees(math.atan2(similarity[1, 0], similarity[0, 0]))


_GRID = "coarse level of a"


@stage(
    "motion",
    outputs=[
        raster("column_disparity", "px", "level-0 columns, frame b minus a", frame=_GRID),
        raster("row_disparity", "px", "level-0 rows, frame b minus a", frame=_GRID),
        raster("validity", "1", "bit mask, see stages.core.validity", "uint8", "", _GRID),
    ],
)
def motion_stage(params: MotionParams, a: Bundle[PyramidFacts], b: Bundle[PyramidFacts]) -> Bundle[MotionFacts]:
    """Coarse displacements of all points from one left frame to the next."""
    before, after = Pyramid.from_bundle(a), Pyramid.from_bundle(b)
    plain = coarse_motion(before, after, params)
    turned = _turned(before, after, plain, params)
    found = plain if turned is None else turned
    ok = matched(found.validity)
    rows, cols = ok.shape
    scale = np.float32(2.0**found.level)
    xb = np.arange(cols, dtype=np.float32) + found.column_disparity / scale
    yb = np.arange(rows, dtype=np.float32)[:, None] + found.row_disparity / scale
    seen = ok & (xb >= 0) & (xb <= cols - 1) & (yb >= 0) & (yb <= rows - 1)
    u, v = found.column_disparity[ok], found.row_disparity[ok]
    usable = int(np.count_nonzero(found.validity & np.uint8(Validity.OUT_OF_IMAGE) == 0))
    meta: MotionFacts = {
        "level": found.level,
        "median_length": float(np.median(np.hypot(u, v))) if u.size else None,
        "match_rate": int(np.count_nonzero(ok)) / usable if usable else None,
        "overlap": int(np.count_nonzero(seen)) / usable if usable else None,
        "turn_found_deg": 0.0 if turned is None else _roll_deg(turned),
    }
    return Bundle({name: values for name, values in vars(found).items() if name != "level"}, meta)
