"""Errors of the calibration by all segments: common to them, each with a prior; corrected where these contradict it.

The parts of all segments (:mod:`rille.stages.odometry.resection.calibration_errors`) and the priors of a usual
calibration give the errors and their covariance; the trajectory adds it up like other errors that all segments share.
All segments count for the rig's toe-in, for which the trajectory's poses are corrected to first order: with a usual
calibration it may move disparities at the sides of the images by pixels, so that near and far landmarks give different
lengths of one way. With that toe-in all segments count for the rig's yaw, too, each by its own common error.

A number that the tracks contradict is corrected, and images, rig, segments and maps are computed anew with the
corrected calibration. An error that does not contradict its prior is part of the covariance alone. Rows that are read
one after the other look like a wrong rig, which is then left as it is, and named. So is a rig that bends, whose yaw
changes along the way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import IntrinsicsFacts, ResectFacts
from rille.stages.geometry import epipolar
from rille.stages.geometry.geometry import Rig
from rille.stages.numeric.robust import huber_weight, mad_sigma
from rille.stages.odometry.resection.calibration_errors import (
    CORRECTED,
    NUMBERS,
    STEP,
    composed,
    corrected_rig,
)

MIN_SEGMENTS, MIN_YAW_SEGMENTS = 3, 2
"""Segments that turn, below which the prior of the cameras' numbers decides; and segments that have to agree on a yaw
before it is corrected, which each says far better."""

MIN_ERROR = 0.0175
"""Error over the focal length up to which a calibration counts as good: remaining lens distortion looks like it."""

MIN_CHANGE = 0.004
"""The same of a corrected camera, whose prior is no longer believed."""

MIN_YAW_PX, MIN_YAW_CHANGE_PX = 0.4, 0.1
"""The same two limits of the yaw, as pixels of disparity; rows pass up to as many
(:class:`rille.stages.calibration.parameter_selection.RelativeParams`). A rig that was repaired has no prior either."""


class IntrinsicsParams(Params):
    """Parameters of the stage ``intrinsics``.

    Attributes
    ----------
    prior : standard deviation, as calibrated, of the focal length and of the principal point over the focal length, of
        the radial distortion (k1), and of the toe-in [rad]; 0.005 is usual for a calibration with a target.
    """

    prior: float = Field(0.005, gt=0)

    @property
    def sigma(self) -> Floats:
        """Standard deviations (k,) of :data:`NUMBERS`."""
        return np.full(len(NUMBERS), self.prior)


class CommonErrors(NamedTuple):
    """Errors (k,) that all segments share, their covariance (k, k), and which of them contradict their priors (k,)."""

    errors: Floats
    covariance: Floats
    wrong: Floats


class Shown(NamedTuple):
    """What segments show of the calibration, a row each, as information and pull on numbers that may be wrong.

    Attributes
    ----------
    information, pull : (s, k, k) and (s, k), on :data:`NUMBERS`.
    yaw : (s, 3), on the rig's yaw, and by how much its pull changes with an error of the toe-in.
    read_out : (s, 2), on the time from the first to the last row.
    """

    information: Floats
    pull: Floats
    yaw: Floats
    read_out: Floats


def shown_by(segments: Sequence[Bundle[ResectFacts]], sigma: Floats) -> Shown:
    """The parts of all segments; those that hardly turn count for the toe-in alone, whatever the others are by
    ``sigma`` (k,)."""
    parts, k = [s.meta["intrinsics"] for s in segments if s.meta["intrinsics"]], len(NUMBERS)
    information = np.array([part["information"] for part in parts]).reshape(-1, k, k)
    pull = np.array([part["pull"] for part in parts]).reshape(-1, k)
    # 4.0: turn of a segment from which on it counts: errors that all tracks share hide what smaller ones show.
    turning = np.array([part["turn_deg"] >= 4.0 for part in parts], bool)
    straight = ~turning | (turning.sum() < MIN_SEGMENTS)
    information[straight], pull[straight] = of_toe_in(information[straight], pull[straight], sigma)
    yaw, read_out = (np.array([part[name] for part in parts]) for name in ("yaw", "read_out"))
    return Shown(information, pull, yaw.reshape(-1, 3), read_out.reshape(-1, 2))


def common_errors(information: Floats, pull: Floats, sigma: Floats, least: float = MIN_ERROR) -> CommonErrors:
    """Errors that all segments share, by their parts and the priors; a prior that they contradict is left out.

    The segments' own values scatter by more than their errors, for their landmarks are few and near each other; the
    scatter decides. The prior that is contradicted most is dropped first: where the camera turns about one axis, one
    wrong number looks like another one.

    Parameters
    ----------
    information, pull : (segment, k, k) and (segment, k) of each.
    sigma : (k,) of the priors.
    least : error up to which a prior is believed.
    """
    held, wrong = np.diag(sigma**-2.0), np.zeros(len(sigma), bool)
    shown = (np.diagonal(information, axis1=1, axis2=2) > 0).sum(1).clip(1)
    while True:
        prior, weight, spread = held * ~wrong, np.ones(len(pull)), 1.0
        for _ in range(5):  # of a segment that is far off, no more than of one at two deviations
            matrix = np.einsum("s,sij->ij", weight, information) / spread**2
            right = (weight @ pull) / spread**2
            errors = np.linalg.solve(matrix + prior, right)
            rest = pull - information @ errors
            square = np.einsum("si,si->s", rest, np.linalg.solve(information + held, rest[..., None])[..., 0])
            off = np.sqrt(square / shown)
            # At least what the segments claim: few of them may agree by chance.
            spread = max(1.0, float(np.median(off))) if len(off) else 1.0
            weight = huber_weight(off, 2.0 * spread)
        departure = np.zeros(CORRECTED)
        for i in np.flatnonzero(~wrong[:CORRECTED]):
            free = matrix + prior * (np.arange(len(sigma)) != i)
            if matrix[i, i] > 0:
                value, variance = np.linalg.solve(free, right)[i], np.linalg.inv(free)[i, i]
                departure[i] = abs(value) / math.sqrt(variance) if abs(value) > least else 0.0
        # 5.0: standard deviations of the estimate from which on a prior is not believed.
        if departure.max() <= 5.0:
            return CommonErrors(errors, np.linalg.inv(matrix + prior), wrong)
        wrong[departure.argmax()] = True


def of_toe_in(information: Floats, pull: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """What segments (s, k, k), (s, k) show of the toe-in, the last number, while their priors hold the others."""
    free = information[:, :-1, :-1] + np.diag(sigma[:-1] ** -2.0)
    answer = np.linalg.solve(free, information[:, :-1, -1:])[..., 0]
    alone, its_pull = np.zeros_like(information), np.zeros_like(pull)
    alone[:, -1, -1] = information[:, -1, -1] - (answer * information[:, :-1, -1]).sum(1)
    its_pull[:, -1] = pull[:, -1] - (answer * pull[:, :-1]).sum(1)
    return alone, its_pull


def alone(shown: Floats, least: float, *, change: bool = False) -> tuple[CommonErrors, float]:
    """Estimate of one number alone from what segments show, (segment, 2) information and pull, and its value if enough
    of them agree that it is not 0; or the estimate of this number and of its ``change`` from the first segment to the
    last, and that change."""
    by = np.vander(np.linspace(-0.5, 0.5, len(shown)), 1 + change, increasing=True)
    # Any is as likely: drawn to 0 by a prior, few segments that agree would seem to contradict each other.
    free = np.full(1 + change, math.pi)
    found = common_errors(shown[:, :1, None] * by[:, :, None] * by[:, None], shown[:, 1:] * by, free, least)
    enough = found.wrong[-1] and len(shown) >= MIN_YAW_SEGMENTS * len(free)
    return found, float(found.errors[-1]) if enough else 0.0


def px_per_yaw(rig: Rig) -> float:
    """Error of all disparities, px, that a yaw of the rig makes, per radian, as far landmarks in the middle show it; 0
    where the baseline leads along the view."""
    shift = epipolar.far_shift(rig, corrected_rig(rig, np.zeros(CORRECTED), STEP))
    # What a changed rig adds towards what is farther the same pixels lack.
    return -float(shift @ epipolar.farther(rig)) / STEP


def hidden_yaw(segments: Sequence[Bundle[ResectFacts]], rig: Rig) -> float:
    """Yaw of a rig, rad, that most segments agree on whose first frame has no pose because of it; 0: there is none.

    Where the camera drives straight on, a zoom of one frame looks the same: so no pose is given with the yaw, before it
    is corrected.
    """
    biases = [one["bias_px"] for s in segments for one in s.meta["per_frame"][1:2] if "bias_px" in one]
    if len(biases) < max(MIN_YAW_SEGMENTS, len(segments) / 2):
        return 0.0
    usual = float(np.median(biases))
    # 0.2: scatter over the size up to which segments agree.
    agreed = abs(usual) > MIN_YAW_PX and mad_sigma(np.array(biases)) < 0.2 * abs(usual)
    px = px_per_yaw(rig)
    return usual / px if agreed and px else 0.0


def contradiction(errors: Sequence[float], sigma: Floats, focal: float) -> str:
    """One line on the numbers of the cameras that were corrected; empty if none was.

    Parameters
    ----------
    errors, sigma : (k,) by which they were changed, and their standard deviations.
    focal : focal length, px.
    """
    wrong = [
        f"the {name} by some {scale * error:+.2g} +- {scale * one:.1g} {unit}"
        for name, error, one, (scale, unit) in zip(
            NUMBERS, errors, sigma, ((100.0, "%"), (focal, "px"), (focal, "px")), strict=False
        )
        if abs(error) > MIN_ERROR
    ]
    if not wrong:
        return ""
    return (
        "the tracks contradict the calibration of both cameras: where the camera turns they ask for another one, "
        f"{' and '.join(wrong)}; all is computed with that: calibrate anew"
    )


def yaw_contradiction(angle: float, sigma: float, name: str, *, fixed: bool) -> str:
    """One line on a yaw (``name``) that was changed by an angle, rad, or would be, were it not ``fixed``."""
    outcome = "kept because rig.mode = fixed: depths and lengths are off by that" if fixed else "corrected"
    return (
        "the tracks contradict the rig: near and far landmarks ask for different motions, unless the right camera is "
        f"turned by {math.degrees(angle):+.3f} +- {math.degrees(sigma):.3f} degrees ({name}), or the focus of both "
        f"creeps; {outcome}"
    )


def creeping_focus(segments: Sequence[Bundle[ResectFacts]], turn: float, rig: Rig) -> str:
    """One line on a focus that changes in both cameras; empty if the rig's yaw, rad, was rightly corrected by ``turn``.

    From image to image both look alike. But what is turned aside keeps its disparities as it comes nearer, while a
    corrected yaw that is none puts landmarks at wrong distances, and the pair at a segment's end shows these.
    """
    shown = np.array([s.meta["distance_px"] for s in segments if "distance_px" in s.meta])
    expected = turn * px_per_yaw(rig)
    if not expected or len(shown) < MIN_SEGMENTS:
        return ""
    usual, error = float(np.median(shown)), 5.0 * mad_sigma(shown) / math.sqrt(len(shown))
    # 0.5 px: from there on a corrected yaw was none. 0.3: of the correction. A street whose focus is fixed shows -0.4
    # to -0.3 px, 0.4 to 2 times the correction others.
    if abs(usual) < max(0.5, error) or -usual / expected < 0.3:
        return ""
    return (
        "the focus of both cameras creeps, or what is near moves alike (water), and the yaw of the rig was not wrong: "
        "with that corrected, landmarks are at other distances than later pairs show, "
        f"by {usual:+.1f} px of disparity; path and elevations are wrong: keep zoom and "
        "focus as they were calibrated, mask what moves"
    )


def read_out_contradiction(time: float, sigma: float) -> str:
    """One line on a time from the first to the last row, in intervals between frames."""
    return (
        "rows of an image are not of one time (rolling shutter), or lights move along with the cameras: the tracks ask "
        f"for {time:+.2f} +- {sigma:.2f} intervals between frames from the first row to the last; path and elevations "
        "are distorted, and the rig's yaw is not corrected: use global shutters, or stand while images are taken"
    )


def bend_contradiction(angle: float, sigma: float, name: str) -> str:
    """One line on the change of the rig's yaw (``name``), rad, from the first segment to the last."""
    return (
        "the rig bends along the way: near and far landmarks ask for a right camera that turns by "
        f"{math.degrees(angle):+.3f} +- {math.degrees(sigma):.3f} degrees ({name}) from the first segment to the last; "
        "elevations are off by that: mount both cameras on one stiff bar, and let them warm up before"
    )


def inverse_depth_std(yaw: Sequence[float], baseline: float) -> float:
    """Standard deviation, 1/m, of the error that all inverse depths share, by a yaw that is left and its own, rad.

    In steps of the square root of two: maps stay in the cache while it changes by little.
    """
    return float(2.0 ** (round(2.0 * math.log2(math.hypot(*yaw) / baseline)) / 2.0))


@stage("intrinsics")
def intrinsics_stage(
    params: IntrinsicsParams,
    segments: Sequence[Bundle[ResectFacts]],
    rig: Bundle[CalibrationFacts],
    *,
    given: Mapping[str, Any],
    before: Sequence[float] | None = None,
    fixed: bool = False,
) -> Bundle[IntrinsicsFacts]:
    """Errors of the calibration that the tracks of all segments show.

    ``given`` is the rig that the images of the pairs repaired to ``rig``, ``before`` the correction that led to it;
    with ``fixed`` the rig keeps its yaw. The yaw is corrected first: while it is wrong, the tracks mislead about the
    cameras.
    """
    shown = shown_by(segments, params.sigma)
    used = Rig.from_dict(rig.meta["rig"])
    focal = used.left.fx
    made = np.zeros(CORRECTED + 1) if before is None else np.array(before)
    believed = MIN_CHANGE if made[:CORRECTED].any() else MIN_ERROR
    common = common_errors(shown.information, shown.pull, params.sigma, believed)
    left = np.append(common.errors[:-1], 0.0)  # poses are corrected for the toe-in
    # The common error of disparities is that of a rig whose toe-in is right.
    yaws = np.column_stack([shown.yaw[:, 0], shown.yaw[:, 1] + common.errors[-1] * shown.yaw[:, 2]])
    least = MIN_YAW_CHANGE_PX if made[-1] or rig.meta["changed"] else MIN_YAW_PX
    yaw, turn = alone(yaws, least / focal)
    bend, bent = alone(yaws, MIN_YAW_PX / focal, change=True)
    # 0.3: time from the first to the last row, in intervals between frames, from which on a rolling shutter is named:
    # of global shutters the tracks ask for 0.05 at most, and for 0.25 where the focal length is off by 8 %.
    read_out, late = alone(shown.read_out, 0.3)
    # Wrong cameras look a little like other times, too; other times look like a wrong yaw. An image is read before the
    # next one is: beyond an interval (1.2) the tracks show something else, as of a plane straight ahead.
    late = 0.0 if common.wrong.any() or abs(late) > 1.2 else late
    turn, bent = (0.0 if late else angle for angle in (turn, bent))
    sigma = np.sqrt(np.diag(common.covariance))
    correction = np.append(np.where(common.wrong, common.errors, 0.0)[:CORRECTED], 0.0)
    if not fixed and (turn := turn or hidden_yaw(segments, used)):
        # The tracks follow the repaired rig: with the given one corrected, the images have nothing left to repair.
        repaired = epipolar.turned_along(Rig.from_dict(given), used)
        correction = np.array([*np.zeros(CORRECTED), repaired + turn])
    facts: IntrinsicsFacts = {
        "errors": dict(zip(NUMBERS, np.column_stack([common.errors, sigma]).tolist(), strict=True)),
        # What is not corrected stays in the poses: their covariance has its square.
        "covariance": (common.covariance + np.outer(left, left)).tolist(),
        # These rest on the calibration as given.
        "held": [name for name, share in zip(NUMBERS, sigma / params.sigma, strict=True) if share > 0.7],
        "yaw": [float(yaw.errors[0]), math.sqrt(yaw.covariance[0, 0])],
        "correction": correction.tolist(),
        "corrected": composed(made, correction).tolist(),
    }
    if len(yaws) and (made[-1] or rig.meta["changed"]):
        facts["inverse_depth_std"] = inverse_depth_std(facts["yaw"], used.baseline)
    cameras = contradiction(facts["corrected"][:CORRECTED], sigma, focal)
    off = turn if fixed else made[-1] + turn
    name = epipolar.angle_along(used)
    angle = yaw_contradiction(off, facts["yaw"][1], name, fixed=fixed) if off else ""
    bends = bend_contradiction(bent, math.sqrt(bend.covariance[-1, -1]), name) if bent else ""
    rows = read_out_contradiction(late, math.sqrt(read_out.covariance[0, 0])) if late else ""
    creeps = "" if correction.any() else creeping_focus(segments, made[-1], used)
    if doubt := "; ".join(filter(None, [rows, creeps, bends, cameras, angle if fixed else ""])):
        facts["contradiction"] = doubt
    # Said once, by the last of the corrections.
    facts["warnings"] = [] if correction.any() else [line for line in (rows, creeps, bends, angle, cameras) if line]
    return Bundle({}, facts)
