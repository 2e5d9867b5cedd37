"""Findings on exposure and sharpness of images, and on images that repeat others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Series
from itertools import pairwise
from typing import Any

import numpy as np

from rille.pipeline.runs.checks.limits import Finding, judge
from rille.stages.core.arrays import Floats
from rille.stages.imaging.image_faults import blurs, faint, grey_rows
from rille.stages.odometry.frame_screening import FrameScreeningParams

Look = Mapping[str, Any]


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
    of = blurs(list(looks.values()))
    blurred, k = sum(blur.share < limits.blurred for blur in of), int(np.argmin([blur.share for blur in of]))
    worst = f"the worst frame {at[k]} ({of[k].words})"
    yield judge("sharpness", f"{blurred} {camera} images are blurred, {worst}", {"blurred": blurred})


def _figure(looks: Mapping[int, Look], name: str) -> Floats:
    return np.array([look[name] for look in looks.values()], dtype=np.float64)  # None is NaN


def _usual(values: Floats) -> float:
    """Median of the finite values; NaN if there is none."""
    return float(np.median(values[np.isfinite(values)])) if np.isfinite(values).any() else math.nan


def judge_repeated(digests: Mapping[str, Mapping[int, str]], names: Series[str]) -> Iterator[Finding]:
    """Images that are one in both cameras, or repeat the one before; ``digests``: of pixels, by camera and frame."""
    same = [k for k, digest in digests["left"].items() if digests["right"].get(k) == digest]
    if same:
        text = f"left and right are one image in {len(same)} pairs, first frame {names[same[0]]}"
        yield judge("images", text, {"left and right are one": len(same)})
    for camera, of in digests.items():
        stuck = [b for a, b in pairwise(of) if of[a] == of[b]]
        if stuck:
            text = f"{len(stuck)} {camera} images repeat the one before, first frame {names[stuck[0]]}"
            yield judge("images", text, {"repeated": len(stuck)})
