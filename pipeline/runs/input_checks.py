"""Judge the figures of a sequence: one finding each, with a code and a remedy where something is wrong.

Plain numbers in, findings out; :mod:`rille.pipeline.commands.check` measures them. FAIL: a reconstruction is useless or
impossible. WARN: it gets worse, or the input is probably a mistake.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.datasets.protocol import Positions, Rows
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.scale import alike
from rille.stages.imaging.image_quality import Look

Floats = NDArray[np.float64]
Level = Literal["OK", "WARN", "FAIL"]

SMALL_BASELINE, LARGE_BASELINE = 0.01, 5.0
"""Usual baselines [m]. Outside of them, lengths in another unit are likelier than such a rig."""

BLURRED = 0.6
"""Share of a camera's median sharpness; a Gaussian blur of one more pixel reduces it to this."""

UNLIKE_SHARP = 0.7
UNLIKE_GREY = 1.5
"""Ratio of mean greys of two cameras or successive frames. The matcher removes the mean, but not the noise."""

CLIPPED = 0.2
"""Share of black or of white pixels. A white sky takes less than this; more means clipped ground."""

UNIFORM = 1.0
"""Standard deviation of an image [grey levels], below which it is blank."""

GAP = 2.5
"""A step of time above this many median steps is a gap."""

ROWS_OK, ROOM = 0.5, 1.0
"""Greatest harmless row offset [px], and greatest residual [px] of a rig whose lens distortion is removed."""

HOPELESS = 5.0
"""Residual [px] after adjustment above which the calibration is of other cameras, or the images are no pair."""

SWAPPED, DOUBTFUL = 0.5, 0.1
"""Share of matches beyond infinity. It is near 1 where left and right are swapped."""

POOR_MATCH, NO_MATCH = 0.3, 0.02
"""Share of usable pixels that are matched: poor below the first, useless below the second."""

LITTLE_OVERLAP, NO_OVERLAP = 0.4, 0.1
"""Share of a left image that the next left image still shows; tracking needs most of it."""

ATTITUDE_DEG = 2.0
"""Greatest permitted difference [degrees] of the rotations between successive frames, attitude against truth."""


@dataclass(frozen=True)
class Finding:
    """One line of ``rille check``: a figure of ``subject`` in words, and what to do; ``code`` where it is not OK."""

    code: str
    text: str
    subject: str
    level: Level = "OK"
    remedy: str = ""

    def __str__(self) -> str:
        code = f"{self.code}: " if self.code else ""
        return f"{self.level:4s}  {self.subject:12s}  {code}{self.text}" + (f": {self.remedy}" if self.remedy else "")


def fine(subject: str, text: str) -> Finding:
    """A figure that is as it should be."""
    return Finding("", text, subject)


def doubt(code: str, text: str, subject: str, *, remedy: str) -> Finding:
    """A figure that makes the results worse, or is probably a mistake."""
    return Finding(code, text, subject, "WARN", remedy)


def fault(code: str, text: str, subject: str, *, remedy: str = "") -> Finding:
    """A figure with which a reconstruction is useless or impossible."""
    return Finding(code, text, subject, "FAIL", remedy)


def judge_rig(rig: Rig) -> Finding:
    """Baseline and sides, as the calibration has them."""
    b, x = rig.baseline, float(rig.T_right_left.translation[0])
    f = rig.left.fx
    if x > 0.5 * b:
        return fault("RIL-640", f"the right camera stands {x:g} m to the left", "rig", remedy="swap left and right")
    words = f"baseline {b:g} m, focal length {f:g} px, {rig.left.width} x {rig.left.height}"
    if (rig.right.width, rig.right.height) != (rig.left.width, rig.left.height):
        words += f", right {rig.right.fx:g} px, {rig.right.width} x {rig.right.height}"
    if not SMALL_BASELINE <= b <= LARGE_BASELINE:
        return doubt("RIL-641", words, "rig", remedy="is the baseline in metres?")
    # In pixels and in image widths: one lens before sensors of unlike pixels, or of unlike width, is no mistake.
    ratios = rig.right.fx / f, rig.right.fx / f * rig.left.width / rig.right.width
    if not any(map(alike, ratios)):
        return doubt(
            "RIL-642", f"{words}; the right camera's is {rig.right.fx:g} px", "rig", remedy="two different lenses?"
        )
    return fine("rig", words)


def judge_times(times: Sequence[float] | None) -> Finding:
    """Order, rate and gaps of the frames' times, s."""
    if times is None:
        return fine("times", "none: frames count as equally spaced")
    steps = np.diff(np.asarray(times, dtype=np.float64))
    if not steps.size:
        return fine("times", "one frame")
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        return fault(
            "RIL-643", f"time goes back or rests from frame {k} to {k + 1}", "times", remedy="correct the times"
        )
    usual = float(np.median(steps))
    words = f"{1 / usual:.3g} frames a second over {float(steps.sum()):.4g} s"
    gaps = np.nonzero(steps > GAP * usual)[0]
    if gaps.size:
        worst = int(gaps[np.argmax(steps[gaps])])
        text = f"{words}; {gaps.size} gaps, the longest {steps[worst]:.3g} s from frame {worst} to {worst + 1}"
        return doubt("RIL-644", text, "times", remedy="frames may be missing; is the overlap kept there?")
    return fine("times", words)


def judge_truth(
    truth: Sequence[RigidTransform | None] | None, frames: Sequence[int], positions: Positions | None = None
) -> Finding:
    """How many frames have truth, and how long the way is."""
    if truth is None and positions is not None:
        places, times = np.array(positions.positions), positions.times
        length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        when = "one a frame" if times is None else f"{times[0]:.2f} to {times[-1]:.2f} s, a constant offset is found"
        axes = "x, y, z" if places.shape[1] == 3 else "x, y"
        words = (
            f"positions only ({axes}), {len(places)} rows, {length:.4g} m, {when}; compared after a fit in the plane"
        )
        return fine("truth", words)
    if truth is None:
        return fine("truth", "none: accuracy is only known against the cross-check")
    known = [T for T in (truth[k] for k in frames) if T is not None]
    length = sum(float(np.linalg.norm(b.translation - a.translation)) for a, b in pairwise(known))
    words = f"{len(known)} of {len(frames)} frames, {length:.4g} m"
    if len(known) < len(frames):
        return doubt("RIL-645", words, "truth", remedy="frames without truth are left out of the accuracy")
    return fine("truth", words)


def judge_attitude(
    attitude: Sequence[Rows | None] | None,
    truth: Sequence[RigidTransform | None] | None,
    frames: Sequence[int],
) -> Finding | None:
    """Coverage of the attitude, and whether it turns as truth does."""
    if attitude is None:
        return None
    known = [k for k in frames if attitude[k] is not None]
    words = f"{len(known)} of {len(frames)} frames"
    apart = []
    for a, b in pairwise(known):
        before, after = (None, None) if truth is None else (truth[a], truth[b])
        if before is None or after is None:
            continue
        sensed = np.array(attitude[b]).T @ np.array(attitude[a])
        true = after.rotation.T @ before.rotation
        # Turns are compared, not attitudes: the sensor's reference is another one than that of the truth.
        apart.append(math.degrees(float(np.linalg.norm(cv2.Rodrigues(sensed @ true.T)[0]))))
    if apart and float(np.median(apart)) > ATTITUDE_DEG:
        text = f"{words}; between frames it turns {np.median(apart):.1f} degrees otherwise than truth"
        return fault("RIL-646", text, "attitude", remedy="check T_body_left, the axes and degrees or radians")
    if apart:
        words += f"; turns as truth does, to {np.median(apart):.2g} degrees a frame"
    if len(known) < len(frames):
        return doubt("RIL-647", words, "attitude", remedy="the other frames are matched without it")
    return fine("attitude", words)


def judge_up(up: Sequence[tuple[float, float, float] | None] | None, frames: Sequence[int]) -> Finding | None:
    """Whether the stated vertical can be one."""
    if up is None:
        return None
    known = [up[k] for k in frames if up[k] is not None]
    if not known:
        return doubt(
            "RIL-648", f"known of 0 of {len(frames)} frames", "up", remedy="the ground is levelled by its own plane"
        )
    # Camera frames have y downwards: up has a negative y where a camera is held upright.
    down = float(np.mean([v[1] for v in known if v is not None]))
    text = f"known of {len(known)} of {len(frames)} frames"
    if down > 0:
        return doubt(
            "RIL-649", f"{text}; it points down in the images", "up", remedy="held upside down, or a wrong sign?"
        )
    return fine("up", text)


def judge_looks(looks: Mapping[str, Mapping[int, Look]], names: Sequence[str]) -> list[Finding]:
    """Exposure and sharpness of all images, by camera and frame."""
    opened = {camera: of for camera, of in looks.items() if of}
    return [*_uniform(opened, names), *_exposure(opened, names), *_sharpness(opened, names)]


def _uniform(looks: Mapping[str, Mapping[int, Look]], names: Sequence[str]) -> list[Finding]:
    out = []
    for camera, of in looks.items():
        empty = [k for k, v in of.items() if v.deviation < UNIFORM]
        if empty:
            text = f"{len(empty)} {camera} images show nothing, first frame {names[empty[0]]}"
            out.append(fault("RIL-650", text, "images", remedy="leave these frames out with --frames"))
    return out


def _exposure(looks: Mapping[str, Mapping[int, Look]], names: Sequence[str]) -> list[Finding]:
    out = []
    for camera, of in looks.items():
        for what, share in (
            ("black", float(np.median([v.dark for v in of.values()]))),
            ("white", float(np.median([v.bright for v in of.values()]))),
        ):
            if share > CLIPPED:
                text = f"{100 * share:.0f} % of the {camera} images is {what}"
                out.append(
                    doubt("RIL-651", text, "exposure", remedy="such areas cannot be matched; mask them or expose anew")
                )
        # At least one grey level: the ratio of two black images means nothing.
        frames, means = list(of), np.maximum([v.mean for v in of.values()], 1.0)
        ratio = np.exp(np.abs(np.diff(np.log(means))))
        if ratio.size and ratio.max() > UNLIKE_GREY:
            k = int(np.argmax(ratio))
            text = (
                f"{camera} brightness changes by a factor of {ratio[k]:.3g} "
                f"from frame {names[frames[k]]} to {names[frames[k + 1]]}"
            )
            remedy = "it is levelled, but what turns black or white is lost: fix the exposure if you can"
            out.append(doubt("RIL-652", text, "exposure", remedy=remedy))
    both = [k for k in looks.get("left", {}) if k in looks.get("right", {})]
    if both and not out:
        pairs = [(looks["left"][k].mean, looks["right"][k].mean) for k in both]
        ratio_of_sides = float(np.median([max(b, 1.0) / max(a, 1.0) for a, b in pairs]))
        text = f"right is {ratio_of_sides:.2f} as bright as left, mean grey {np.median(pairs):.0f}"
        if 1 / UNLIKE_GREY < ratio_of_sides < UNLIKE_GREY:
            out.append(fine("exposure", text))
        else:
            out.append(doubt("RIL-653", text, "exposure", remedy="couple the exposure of both cameras"))
    return out


def _sharpness(looks: Mapping[str, Mapping[int, Look]], names: Sequence[str]) -> list[Finding]:
    out, usual = [], {}
    for camera, of in looks.items():
        values = {k: v.sharpness for k, v in of.items() if math.isfinite(v.sharpness)}
        if not values:
            continue
        usual[camera] = float(np.median(list(values.values())))
        blurred = [k for k, v in values.items() if v < BLURRED * usual[camera]]
        if blurred:
            worst = min(blurred, key=values.__getitem__)
            share = 100 * values[worst] / usual[camera]
            text = (
                f"{len(blurred)} {camera} images are blurred, the worst frame {names[worst]} ({share:.0f} % of usual)"
            )
            out.append(doubt("RIL-654", text, "sharpness", remedy="leave them out, or expect a weak pose there"))
    if len(usual) == 2:
        ratio = usual["right"] / usual["left"]
        text = f"right is {ratio:.2f} as sharp as left"
        if not UNLIKE_SHARP < ratio < 1 / UNLIKE_SHARP:
            side = "right" if ratio < 1 else "left"
            out.append(
                doubt("RIL-655", text, "sharpness", remedy=f"is the {side} camera out of focus, or its lens dirty?")
            )
        elif not out:
            out.append(fine("sharpness", f"{text}, no image far below the others"))
    return out


def judge_matching(rate: float | None, depths: Floats, baseline: float) -> Finding:
    """Share of usable pixels that are matched, and how far away they lie (m)."""
    share = rate or 0.0
    if share < NO_MATCH:
        text = f"{100 * share:.1f} % of the first pair is matched"
        return fault("RIL-656", text, "matching", remedy="do both images show one scene, taken at one time, and sharp?")
    near, middle, far = (float(v) for v in np.percentile(depths, [5, 50, 95])) if depths.size else (math.nan,) * 3
    text = f"{100 * share:.0f} % of the first pair is matched, depth {near:.3g} to {far:.3g} m, median {middle:.3g} m"
    if share < POOR_MATCH:
        return doubt("RIL-657", text, "matching", remedy="little texture, or little overlap of left and right")
    if depths.size and middle > 200 * baseline:
        remedy = f"at {middle / baseline:.0f} baselines depth is a guess; is the baseline right?"
        return doubt("RIL-658", text, "matching", remedy=remedy)
    return fine("matching", text)


def judge_sides(beyond: float) -> Finding:
    """Share of the matches that lie beyond infinity under the given rig."""
    text = f"{100 * beyond:.1f} % of the matches lie beyond infinity"
    if beyond > SWAPPED:
        return fault("RIL-659", text, "sides", remedy="left and right are swapped, or the baseline has the wrong sign")
    if beyond > DOUBTFUL:
        return doubt(
            "RIL-660", text, "sides", remedy="the toe-in of the calibration, or its principal points, are wrong"
        )
    return fine("sides", f"left is left: {text}")


def judge_epipolar(facts: Mapping[str, Any]) -> Finding:
    """Epipolar residuals under the given rig, and after adjusting it (facts of stage ``orientation``)."""
    if "residual_before_px" not in facts:
        return doubt("RIL-661", str(facts.get("words", "not checked")), "epipolar", remedy="see the matching")
    before, after = float(facts["residual_before_px"]), float(facts["residual_after_px"])
    offset, roll = float(facts["row_offset"]), float(facts["roll_deg"])
    words = (
        f"off the epipolar lines {offset:+.2f} px, roll {roll:+.3f} degrees, residual {before:.2f} px RMS, "
        f"adjusted {after:.2f}"
    )
    if after > HOPELESS:
        remedy = "no rig explains these images; wrong calibration file, or lens distortion left in"
        return fault("RIL-662", words, "epipolar", remedy=remedy)
    if after > ROOM:
        return doubt(
            "RIL-663", words, "epipolar", remedy="is lens distortion left in the images, or the wrong file given?"
        )
    if before > ROOM or abs(offset) > ROWS_OK:
        remedy = "the calibration is off; reconstruct repairs what the images tell, `rille calibrate` the rest"
        return doubt("RIL-664", words, "epipolar", remedy=remedy)
    return fine("epipolar", words)


def judge_synchrony(facts: Mapping[str, Any]) -> Finding | None:
    """Whether the right images are of the same moments: facts of :mod:`rille.stages.calibration.synchrony`."""
    if "contradiction" in facts:
        return fault("RIL-665", facts["contradiction"], "simultaneous", remedy="pair the images anew")
    if not facts["rows"]:
        return None
    words = f"rows of {len(facts['rows'])} pairs over the sequence spread by {float(np.median(facts['rows'])):.2f} px"
    return fine("simultaneous", f"{words}; no right image of another time fits better")


def judge_motion(motions: Mapping[tuple[int, int], Mapping[str, Any]], names: Sequence[str]) -> Finding:
    """Overlap of successive left images, of stage ``motion``'s facts."""
    if not motions:
        return fine("motion", "one frame: no trajectory")
    overlap = {k: float(m["overlap"] or 0.0) for k, m in motions.items()}
    length = [float(m["median_length"]) for m in motions.values() if m["median_length"] is not None]
    (a, b), least = min(overlap.items(), key=lambda kv: kv[1])
    text = (
        f"successive images overlap by {100 * np.median(list(overlap.values())):.0f} %, least {100 * least:.0f} % "
        f"from frame {names[a]} to {names[b]}; motion {np.median(length) if length else math.nan:.1f} px"
    )
    if least < NO_OVERLAP:
        return fault(
            "RIL-666", text, "motion", remedy="the trajectory breaks there; add the frames between, or split it"
        )
    if least < LITTLE_OVERLAP:
        return doubt("RIL-667", text, "motion", remedy="take every frame, or expect weak poses there")
    return fine("motion", text)
