"""Judge the figures of a sequence by a table of limits: one finding for each subject, with a code and a remedy.

Inputs are a sequence or plain numbers, which :mod:`rille.pipeline.commands.sequences.check` measures. FAIL: a
reconstruction is useless or impossible. WARN: it gets worse, or the input is probably a mistake.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np

from rille.datasets.protocol import Sequence
from rille.stages.calibration.doubt import MAX_REPEATED_SHARE
from rille.stages.core.arrays import Floats
from rille.stages.core.quantities import count
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.epipolar import MAX_IMAGE_TURN_DEG
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.rigid import angles_between, lengths_along
from rille.stages.geometry.scale import MAX_ALIKE_SCALE
from rille.stages.imaging.image_quality import faint, grey_rows
from rille.stages.odometry.frame_screening import FrameScreeningParams
from rille.stages.terrain.reference import camera_height

Level = Literal["OK", "WARN", "FAIL"]
Look = Mapping[str, Any]
Frames = Series[int]
Poses = Series[RigidTransform | None]

MAX_SPEED = 60.0
"""m/s: largest speed between most records of a sensor; no vehicle with stereo cameras is faster."""


@dataclass(frozen=True)
class Limit:
    """Code and remedy of a finding if a figure of a subject is below ``least`` or above ``most``."""

    code: str
    figure: str
    subject: str
    remedy: str = ""
    least: float = -math.inf
    most: float = math.inf
    level: ClassVar[Level] = "WARN"


class Fault(Limit):
    """A limit beyond which a reconstruction is useless or impossible."""

    level = "FAIL"


LIMITS = (
    # Outside of these limits another unit of length is likelier than such a rig.
    Limit("RIL-641", "baseline, m", "rig", least=0.01, most=5.0, remedy="is the baseline in metres?"),
    Fault("RIL-643", "steps back", "times", most=0, remedy="correct the times"),
    Limit("RIL-644", "gaps", "times", most=0, remedy="are frames missing there, or was the clock set forward?"),
    Limit("RIL-645", "without", "truth", most=0, remedy="frames without truth are left out of the accuracy"),
    Fault("RIL-646", "degrees off", "attitude", most=2.0, remedy="check T_body_left, the axes and degrees or radians"),
    Limit("RIL-647", "without", "attitude", most=0, remedy="the other frames are matched without it"),
    Fault("RIL-977", "m/s", "odometry", most=MAX_SPEED, remedy="check its unit, and the unit of the times"),
    Limit(
        "RIL-978", "length over the truth's", "odometry", least=0.8, most=1.25, remedy="check its unit and T_body_left"
    ),
    Limit("RIL-988", "without", "odometry", most=0, remedy="the other frames are predicted without it"),
    Fault("RIL-989", "m/s", "positions", most=MAX_SPEED, remedy="check their unit, and the unit of the times"),
    # Fewer do not determine a rotation.
    Limit("RIL-990", "rows", "positions", least=3, remedy="is time_offset right, and the clock the images'?"),
    Limit("RIL-991", "lengths over sigma", "positions", least=1.0, remedy="they say nothing of so short a way"),
    Limit("RIL-648", "known", "up", least=1, remedy="the ground is levelled by its own plane"),
    Limit("RIL-650", "blank", "images", most=0, remedy="left ones get no pose, right ones no depth: take them anew"),
    Limit("RIL-668", "lost", "images", most=0, remedy="it gets no pose; its neighbours are joined across it"),
    Fault("RIL-670", "unusable", "images", most=0, remedy="mend, convert or remove what is wrong"),
    Fault("RIL-671", "left and right are one", "images", most=0, remedy="give the right camera's images"),
    Limit("RIL-677", "grey", "images", most=0),
    Limit("RIL-672", "repeated", "images", most=0, remedy="was a frame copied, or did the camera hang?"),
    # A white sky is less than this; more means clipped ground.
    Limit("RIL-651", "clipped", "exposure", most=0.2, remedy="such areas cannot be matched; mask them or expose anew"),
    # The matcher removes the mean, but not the noise.
    Limit(
        "RIL-652", "change", "exposure", most=1.5, remedy="it is levelled, but black and white is lost: fix exposure"
    ),
    Limit("RIL-755", "faint", "exposure", most=0),
    Limit("RIL-653", "right over left", "exposure", least=1 / 1.5, most=1.5, remedy="give both one exposure and depth"),
    Limit("RIL-654", "blurred", "sharpness", most=0, remedy="leave them out, or expect a weak pose there"),
    Limit("RIL-655", "right over left", "sharpness", least=0.7, most=1 / 0.7, remedy="out of focus, or a dirty lens?"),
    Fault("RIL-669", "whole pairs", "matching", least=1),
    Fault(
        "RIL-907",
        "borne out",
        "matching",
        least=0.1,
        remedy="are the maps of these left images, in pixels (SGBM counts in sixteenths), of this sign, and their "
        "rows in order (PFM has the lowest first)?",
    ),
    Fault(
        "RIL-656",
        "matched",
        "matching",
        least=0.02,
        remedy="do both images show one scene, taken at one time, sharp, and neither mirrored?",
    ),
    Limit("RIL-657", "matched", "matching", least=0.3, remedy="little texture, little overlap, or strong compression"),
    Limit("RIL-658", "baselines away", "matching", most=200, remedy="depth is a guess there; is the baseline right?"),
    Fault(
        "RIL-659",
        "beyond",
        "sides",
        most=0.5,
        remedy="left and right, or their calibrations, are swapped, the images are mirrored or upside down, the "
        "baseline has the wrong sign, its transformation leads from right to left, or the scene repeats (bricks, "
        "tiles); or all of it is far (sky), and an angle between the cameras is off",
    ),
    Limit("RIL-660", "beyond", "sides", most=0.1, remedy="the calibration's toe-in or principal points are wrong"),
    Limit("RIL-773", "unlike", "sides", most=0, remedy="look at both images: torn, exchanged, or of another frame?"),
    Limit("RIL-681", "misread", "distortion", most=0),
    Limit("RIL-679", "above", "ground", most=0),
    Limit("RIL-661", "known", "epipolar", least=1, remedy="see the matching"),
    Fault("RIL-673", "turned, degrees", "epipolar", most=MAX_IMAGE_TURN_DEG, remedy="turn one camera's images back"),
    Fault(
        "RIL-662",
        "adjusted, px",
        "epipolar",
        most=5.0,
        remedy="wrong calibration file, transforms inverted (T_BS), or lens distortion left in",
    ),
    Limit(
        "RIL-663", "adjusted, px", "epipolar", most=1.0, remedy="is lens distortion left in, or the wrong file given?"
    ),
    Limit(
        "RIL-664",
        "residual or row offset",  # px, half px
        "epipolar",
        most=1.0,
        remedy="are the images rectified already (images.rectified)? Else the calibration is off: reconstruct "
        "repairs what the images tell, `rille calibrate` the rest",
    ),
    Limit(
        "RIL-712",
        "repeated",
        "repetition",
        most=MAX_REPEATED_SHARE,
        remedy="matches may be off by a period: view along the rows, or from nearer",
    ),
    Fault("RIL-665", "contradictions", "simultaneous", most=0, remedy="pair the images anew"),
    # tracking needs most of a left image to be in the next one
    Fault(
        "RIL-666", "overlap", "motion", least=0.1, remedy="the trajectory breaks there; add frames between, or split it"
    ),
    Limit("RIL-667", "overlap", "motion", least=0.4, remedy="take every frame, or expect weak poses there"),
    Limit(
        "RIL-715",
        "largest motion, px",
        "motion",
        least=0.5,
        remedy="if the camera moved, take frames farther apart; what moves along with it hides its motion: switch "
        "off a projector of dots, mask its own body",
    ),
)
"""Limits of the figures of each subject, the most severe first."""


@dataclass(frozen=True)
class Finding:
    """One line of ``rille check``: figures of ``subject`` in words, a remedy, and a ``code`` if it is not OK."""

    code: str
    text: str
    subject: str
    level: Level = "OK"
    remedy: str = ""

    def __str__(self) -> str:
        code = f"{self.code}: " if self.code else ""
        return f"{self.level:4s}  {self.subject:12s}  {code}{self.text}" + (f": {self.remedy}" if self.remedy else "")


def judge(subject: str, text: str, figures: Mapping[str, float] | None = None) -> Finding:
    """Finding of the first limit that a figure of the subject, by name, exceeds; else an OK one."""
    for limit in LIMITS:
        figure = (figures or {}).get(limit.figure) if limit.subject == subject else None
        if figure is not None and not limit.least <= figure <= limit.most:
            return Finding(limit.code, text, subject, limit.level, limit.remedy)
    return Finding("", text, subject)


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


# -- records of the chosen frames of a sequence ----------------------------------------------------------------------


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


# -- images, matches and motions -------------------------------------------------------------------------------------


def judge_looks(
    looks: Mapping[str, Mapping[int, Look]], names: Series[str], limits: FrameScreeningParams
) -> list[Finding]:
    """Exposure and sharpness of all images; ``looks``: figures of stage ``image_quality`` by camera and frame.

    The ``limits`` of a run decide which images are blank or blurred.
    """
    opened = {camera: of for camera, of in looks.items() if of}
    out = [bad for camera, of in opened.items() for bad in _camera(camera, of, names, limits) if bad.level != "OK"]
    judged = {bad.subject for bad in out}
    both = [k for k in opened.get("left", {}) if k in opened.get("right", {})]
    if both:
        whole = {camera: [of[k] for k in both] for camera, of in opened.items()}
        out += [judge("images", line, {"grey": 1}) for line in grey_rows(whole)]
        out += [judge("exposure", line, {"faint": 1}) for line in faint(whole)]
    if both and "exposure" not in judged:
        left, right = (_figure({k: opened[camera][k] for k in both}, "mean") for camera in ("left", "right"))
        # At least one grey level, because the ratio of two black images means nothing.
        ratio = float(np.median(np.maximum(right, 1.0) / np.maximum(left, 1.0)))
        text = f"right is {ratio:.2f} as bright as left, mean grey {np.median([left, right]):.0f}"
        out.append(judge("exposure", text, {"right over left": ratio}))
    sharp = [_usual(_figure(of, "sharpness")) for of in opened.values()]
    if len(sharp) == 2 and all(map(math.isfinite, sharp)):
        ratio = sharp[1] / sharp[0]
        sides = judge("sharpness", f"right is {ratio:.2f} as sharp as left", {"right over left": ratio})
        out += [sides] if sides.code or "sharpness" not in judged else []
    return out


def _camera(
    camera: str, looks: Mapping[int, Look], names: Series[str], limits: FrameScreeningParams
) -> Iterator[Finding]:
    """Findings on the images of one camera."""
    at = [names[k] for k in looks]
    uniform = _figure(looks, "deviation") < limits.uniform
    if (blank := np.flatnonzero(uniform)).size:
        text = f"{blank.size} {camera} images show nothing, first frame {at[blank[0]]}"
        yield judge("images", text, {"blank": blank.size})
    for shade, name in (("black", "dark"), ("white", "bright")):
        share = float(np.median(_figure(looks, name)))
        yield judge("exposure", f"{100 * share:.0f} % of the {camera} images is {shade}", {"clipped": share})
    shown = np.where(uniform, np.nan, np.maximum(_figure(looks, "mean"), 1.0))
    change = np.nan_to_num(np.exp(np.abs(np.diff(np.log(shown)))))
    if change.size:
        k = int(np.argmax(change))
        text = f"{camera} brightness changes by a factor of {change[k]:.3g} from frame {at[k]} to {at[k + 1]}"
        yield judge("exposure", text, {"change": change[k]})
    sharpness = _figure(looks, "sharpness")
    share_of_usual = np.nan_to_num(sharpness / _usual(sharpness), nan=1.0)
    blurred, k = int((share_of_usual < limits.blurred).sum()), int(np.argmin(share_of_usual))
    worst = f"the worst frame {at[k]} ({100 * share_of_usual[k]:.0f} % of usual)"
    yield judge("sharpness", f"{blurred} {camera} images are blurred, {worst}", {"blurred": blurred})


def _figure(looks: Mapping[int, Look], name: str) -> Floats:
    return np.array([look[name] for look in looks.values()], dtype=np.float64)  # None is NaN


def _usual(values: Floats) -> float:
    """Median of the finite values; NaN if there is none."""
    return float(np.median(values[np.isfinite(values)])) if np.isfinite(values).any() else math.nan


def judge_matching(rate: float | None, depths: Floats, baseline: float, *, given: bool = False) -> Finding:
    """Share of matched pixels among the usable ones, and their depths (m); ``given``: of another program's map."""
    share = rate or 0.0
    text, figures = f"{100 * share:.0f} % of the first pair is matched", {"matched": share}
    if given:
        figures["borne out"] = share
    if depths.size:
        near, middle, far = (float(v) for v in np.percentile(depths, [5, 50, 95]))
        text += f", depth {near:.3g} to {far:.3g} m, median {middle:.3g} m"
        figures["baselines away"] = middle / baseline
    return judge("matching", text, figures)


def judge_sides(beyond: float) -> Finding:
    """Share of the matches that lie beyond infinity under the given rig."""
    return judge("sides", f"{100 * beyond:.1f} % of the matches lie beyond infinity", {"beyond": beyond})


def judge_pairs(unlike: Mapping[int, str], tested: int, swapped: int, names: Series[str]) -> Finding:
    """Pairs, of those ``tested``, that do not fit the rig as the others do, some of them ``swapped``; ``unlike``: cause
    by frame."""
    if not unlike:
        text = f"left and right fit each other alike in all of {count(tested, 'pair')} over the sequence"
        return judge("sides", text)
    first, why = next(iter(unlike.items()))
    figure = "beyond" if 2 * swapped > tested else "unlike"
    text = f"{len(unlike)} of {tested} pairs over the sequence do not fit the rig, first frame {names[first]}: {why}"
    return judge("sides", text, {figure: len(unlike)})


def judge_epipolar(facts: Mapping[str, Any]) -> Finding:
    """Epipolar residuals under the given rig, and after adjusting it (facts of stage ``orientation``)."""
    if "residual_before_px" not in facts:
        return judge("epipolar", str(facts.get("words", "not checked")), {"known": 0})
    before, after, offset = (float(facts[name]) for name in ("residual_before_px", "residual_after_px", "row_offset"))
    words = f"off the epipolar lines {offset:+.2f} px, roll {float(facts['roll_deg']):+.3f} degrees"
    words = f"{words}, residual {before:.2f} px RMS, adjusted {after:.2f}"
    turn = float(facts["turn_deg"])
    if abs(turn) > MAX_IMAGE_TURN_DEG:
        words = f"the right image is turned by {abs(turn):.0f} degrees against the left one; {words}"
    figures = {"adjusted, px": after, "residual or row offset": max(before, 2 * abs(offset))}
    return judge("epipolar", words, {"turned, degrees": abs(turn), **figures})


def judge_repetition(share: float) -> Finding:
    """Share of the matches that look as well elsewhere, as on rows of plants."""
    text = f"{100 * share:.0f} % of the matches look as well elsewhere on their epipolar lines"
    return judge("repetition", text, {"repeated": share})


def judge_ground(facts: GroundFacts) -> Finding:
    """Height of the camera above the ground of a pair, or why no ground is seen (facts of stage ``ground_frame``)."""
    if "warnings" in facts:
        return judge("ground", facts["warnings"][0], {"above": 1})
    if facts["plane"] is None or "no_ground" in facts:
        return judge("ground", facts["no_ground"])
    stands = f"the left camera stands {camera_height(facts):.3g} m above it, if the baseline is right"
    return judge("ground", f"{stands}; {facts['ground_share']:.0%} of the matches lie on it")


def judge_synchrony(facts: Mapping[str, Any]) -> Finding | None:
    """Whether left and right images are simultaneous (facts of :mod:`rille.stages.calibration.synchrony`)."""
    if "contradiction" in facts:
        return judge("simultaneous", facts["contradiction"], {"contradictions": 1})
    if not facts["rows"]:
        return None
    words = f"rows of {len(facts['rows'])} pairs over the sequence spread by {float(np.median(facts['rows'])):.2f} px"
    return judge("simultaneous", f"{words}; no right image of another time fits better")


def judge_motion(motions: Mapping[tuple[int, int], Mapping[str, Any]], names: Series[str]) -> Finding:
    """Overlap of successive left images (facts of stage ``motion``)."""
    if not motions:
        return judge("motion", "one frame: no trajectory")
    overlap = {k: float(m["overlap"] or 0.0) for k, m in motions.items()}
    length = [float(m["median_length"]) for m in motions.values() if m["median_length"] is not None]
    (a, b), least = min(overlap.items(), key=lambda kv: kv[1])
    text = f"successive images overlap by {100 * np.median(list(overlap.values())):.0f} %, least {100 * least:.0f} %"
    text += f" from frame {names[a]} to {names[b]}{f'; motion {np.median(length):.1f} px' if length else ''}"
    return judge("motion", text, {"overlap": least, **({"largest motion, px": max(length)} if length else {})})
