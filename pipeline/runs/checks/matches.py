"""Findings on matches: of the two sides, of the first pair under the rig, and of successive images."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Series
from typing import Any

import numpy as np

from rille.pipeline.runs.checks.limits import Finding, judge
from rille.stages.core.arrays import Floats
from rille.stages.core.quantities import count
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.epipolar import MAX_IMAGE_TURN_DEG
from rille.stages.terrain.reference import camera_height


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
