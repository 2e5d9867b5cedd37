"""Findings on what a sequence states: its rig, times, truth, odometry, positions, attitude and vertical."""

from __future__ import annotations

import math
from collections.abc import Iterable
from collections.abc import Sequence as Series
from itertools import pairwise

import numpy as np

from rille.datasets.protocol import Sequence
from rille.pipeline.runs.checks.limits import Finding, judge
from rille.stages.core.quantities import count
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.rigid import angles_between, lengths_along
from rille.stages.geometry.scale import MAX_ALIKE_SCALE

Frames = Series[int]

Poses = Series[RigidTransform | None]


def judge_rig(rig: Rig) -> Finding:
    """Baseline, sides and focal lengths of the calibration; whether sides and lenses are those of the images, matches
    show."""
    left, right, b, x = rig.left, rig.right, rig.baseline, -float(rig.centre[0])
    # In pixels and in image widths: equal lenses with sensors of unlike pixels, or of unlike width, are no mistake.
    ratios = right.fx / left.fx, right.fx / left.fx * left.width / right.width
    unlike = min(max(ratio, 1 / ratio) for ratio in ratios)
    words = f"baseline {b:g} m, focal length {left.fx:g} px, {left.width} x {left.height}"
    if (right.width, right.height) != (left.width, left.height) or unlike > MAX_ALIKE_SCALE:
        words += f", right {right.fx:g} px, {right.width} x {right.height}"
    words += f"; the right camera stands {x:g} m to the left" if x > 0 else ""
    return judge("rig", words, {"baseline, m": b})


def judge_times(of: Sequence, frames: Frames) -> Finding:
    """Order, rate and gaps of the frames' times, s."""
    steps = np.diff([] if of.times is None else [of.times[k] for k in frames])
    if not steps.size:
        return judge("times", "none: frames count as equally spaced" if of.times is None else "one frame")
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        return judge("times", f"time goes back or rests from frame {frames[k]} to {frames[k + 1]}", {"steps back": 1})
    usual = float(np.median(steps))
    gaps, longest = int((steps > 2.5 * usual).sum()), int(np.argmax(steps))
    words = f"{1 / usual:.3g} frames a second over {float(steps.sum()):.4g} s"
    if gaps:
        where = f"from frame {frames[longest]} to {frames[longest + 1]}"
        words += f"; {count(gaps, 'gap')}, the longest {steps[longest]:.3g} s {where}"
    return judge("times", words, {"gaps": gaps})


def judge_truth(of: Sequence, frames: Frames) -> Finding:
    """Number of frames with truth, and length of the path."""
    if of.truth is not None:
        known = [k for k in frames if of.truth[k] is not None]
        words = f"{len(known)} of {len(frames)} frames, {_length(of.truth, known):.4g} m"
        return judge("truth", words, {"without": len(frames) - len(known)})
    if of.truth_positions is None:
        return judge("truth", "none: accuracy is only known against the cross-check")
    places, times = np.array(of.truth_positions.positions), of.truth_positions.times
    when = "one a frame" if times is None else f"{times[0]:.2f} to {times[-1]:.2f} s, a constant offset is found"
    axes = "x, y, z" if places.shape[1] == 3 else "x, y"
    rows = f"positions only ({axes}), {len(places)} rows, {float(lengths_along(places)[-1]):.4g} m, {when}"
    return judge("truth", f"{rows}; compared after a fit in the plane")


def judge_odometry(of: Sequence, frames: Frames) -> Finding | None:
    """Coverage, length and speed of the dead reckoning, and its length over the truth's."""
    if of.odometry is None:
        return None
    known = [k for k in frames if of.odometry[k] is not None]
    length, figures = _length(of.odometry, known), {"without": float(len(frames) - len(known))}
    words = f"{len(known)} of {len(frames)} frames, {length:.4g} m"
    if of.times is not None and known and of.times[known[-1]] > of.times[known[0]]:
        figures["m/s"] = length / (of.times[known[-1]] - of.times[known[0]])
        words += f", {figures['m/s']:.3g} m/s"
    both = [k for k in known if of.truth is not None and of.truth[k] is not None]
    if of.truth is not None and (true := _length(of.truth, both)) > 0:
        share = figures["length over the truth's"] = _length(of.odometry, both) / true
        words += f", {share:.3g} of the truth's length"
    return judge("odometry", words, figures)


def judge_positions(of: Sequence, frames: Frames) -> Finding | None:
    """Number of measured positions at the time of the images, their length and speed."""
    if (measured := of.priors.get("positions")) is None:
        return None
    at, places = np.array(measured["times"]), np.array(measured["positions"])
    first, last = (float(k if of.times is None else of.times[k]) for k in (frames[0], frames[-1]))
    inside = (at >= first) & (at <= last)
    steps, sigma = np.linalg.norm(np.diff(places[inside], axis=0), axis=1), np.array(measured["sigma"])
    words = f"{len(at)} rows, {int(inside.sum())} of them while the images were taken, {steps.sum():.4g} m"
    figures = {"rows": int(inside.sum()), "lengths over sigma": float(steps.sum() / sigma[:2].max())}
    if of.times is not None and len(steps):
        figures["m/s"] = float(np.median(steps / np.diff(at[inside])))
        words += f", {figures['m/s']:.3g} m/s"
    each = " x ".join(f"{v:g}" for v in dict.fromkeys(sigma.tolist()))
    return judge("positions", f"{words}; standard deviation {each} m", figures)


def judge_attitude(of: Sequence, frames: Frames) -> Finding | None:
    """Coverage of the attitude, possibly of an IMU, and whether its turns are those of the truth."""
    if of.attitude is None:
        return None
    known = [k for k in frames if of.attitude[k] is not None]
    true = {k: T.rotation for k in known if of.truth is not None and (T := of.truth[k]) is not None}
    words, off = f"{len(known)} of {len(frames)} frames", 0.0
    if len(true) > 1:
        both = np.array([of.attitude[k] for k in true]), np.array(list(true.values()))
        # Turns are compared, not attitudes, whose frames of reference differ.
        turns = (np.swapaxes(R[:-1], 1, 2) @ R[1:] for R in both)
        off = math.degrees(float(np.median(angles_between(*turns))))
        words += f"; between frames it turns {off:.3g} degrees otherwise than truth"
    words = f"by the IMU, {words}" if of.imu_axes is not None else words
    return judge("attitude", words, {"degrees off": off, "without": len(frames) - len(known)})


def judge_up(of: Sequence, frames: Frames) -> Finding | None:
    """Whether the vertical is stated; ground above the cameras shows that it has the wrong sign."""
    if of.up is None:
        return None
    known = [v for v in (of.up[k] for k in frames) if v is not None]
    y = float(np.mean([v[1] for v in known])) if known else 0.0
    words = f"known of {len(known)} of {len(frames)} frames" + ("; it points down in the images" if y > 0 else "")
    return judge("up", words, {"known": len(known)})


RECORDS = (judge_times, judge_truth, judge_odometry, judge_positions, judge_attitude, judge_up)


def _length(poses: Poses, known: Iterable[int]) -> float:
    """Length, m, of the path through the poses of the ``known`` frames."""
    places = [T.translation for T in (poses[k] for k in known) if T is not None]
    return sum(float(np.linalg.norm(b - a)) for a, b in pairwise(places))
