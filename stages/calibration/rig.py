"""The rig that a run reconstructs with: the given calibration, repaired only where the images contradict it.

The relative orientation enters every later stage through this one artifact (paper, section 5.2.2: relative orientation
with the baseline's length held fixed). The correspondences of all pairs are pooled; parameters that they do not
observe, do not contradict, or would hardly change stay as given, to the last bit
(:mod:`rille.stages.calibration.parameter_selection`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import scipy

from rille.stages.calibration.doubt import MAX_REPEATED_SHARE
from rille.stages.calibration.lens_reading import better_reading
from rille.stages.calibration.parameter_selection import (
    BEYOND_SHARE,
    Decision,
    Parameter,
    RelativeParams,
    decide,
    impossible_share,
)
from rille.stages.calibration.relative_orientation import (
    BLOCKS,
    MIN_MATCHES,
    MIN_MATCHES_OF_BLOCK,
    Linear,
    PointPairs,
    estimate,
    linearised,
    rms,
)
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.calibration import OrientationFacts, RigFacts
from rille.stages.geometry.epipolar import (
    MAX_IMAGE_TURN_DEG,
    NAMES,
    angle_along,
    corrected,
    image_turn,
    line_distances,
    standing,
    turn_axes,
)
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.lens import Lens
from rille.stages.geometry.scale import right_pixels
from rille.stages.geometry.sides import (
    BeyondInfinityError,
    exchanged,
    refuse_exchanged,
    refuse_impossible,
    refuse_mirrored,
)
from rille.stages.numeric.robust import mad_sigma


class RigParams(RelativeParams):
    """Parameters of the stage ``rig``.

    Attributes
    ----------
    mode : pooled: one rig from all pairs; per_pair: a rig for each pair (a rig that bends); fixed: keep the given rig,
        report contradictions only.
    """

    mode: Literal["pooled", "per_pair", "fixed"] = "pooled"


def orient_rig(
    given: Rig, pairs: Sequence[PointPairs], params: RigParams, first: Rig | None = None, repeated: float = 0.0
) -> RigFacts:
    """Facts of the rig to be used; without a usable pair only the first six and ``warnings``.

    ``first``: the rig as it was given, if the tracks have corrected its cameras or its yaw since; ``repeated``: share
    of the matches that look as well elsewhere.

    Raises
    ------
    InputError
        The cameras share one projection centre.
    DegenerateError
        Left and right images are swapped, or of two scenes.
    """
    given.check()
    facts: RigFacts = {
        "rig": given.to_dict(),
        "given": (first or given).to_dict(),
        "source": "given calibration",
        "changed": False,
        "warnings": [],
    }
    usable = [m for m in pairs if len(m.left) >= MIN_MATCHES]
    if usable:
        turned = first is not None and first.T_right_left.to_list() != given.T_right_left.to_list()
        shown = angle_along(given) if turned else ""
        repeats = repeated > MAX_REPEATED_SHARE
        facts |= cast(RigFacts, _judged(given, _share(usable), params, shown, repeats=repeats))
        if repeats:
            # Matches that are off by a period may contradict a right calibration, or lie beyond infinity.
            facts["repeats"] = (
                f"{repeated:.0%} of the matches look as well elsewhere on their epipolar lines: on a pattern that "
                "repeats (rows of plants, bricks, tiles) they may be off by a period, and with them depths and poses, "
                "which no standard deviation contains"
            )
            facts["warnings"].insert(0, facts["repeats"])
        if len(usable) < len(pairs):
            few = len(pairs) - len(usable)
            facts["warnings"].insert(0, f"{few} of {len(pairs)} pairs have too few matches for the rig")
    elif pairs:
        facts["warnings"] = ["no pair has enough matches to check the calibration; it is used as given"]
    if first is not None:
        facts |= {"source": f"{facts['source']}, corrected by the tracks", "changed": True}
    return facts


def _judged(given: Rig, pairs: list[PointPairs], params: RigParams, shown: str, *, repeats: bool) -> dict[str, Any]:
    """Facts of the rig and of its fit to the pairs; ``shown``: angle that the tracks determine; ``repeats``: the pairs
    show a repeating pattern, and repair nothing."""
    decision = decide(given, pairs, params)
    turn = float(np.median([image_turn(given, m.left, m.right) for m in pairs]))
    turned = abs(turn) > MAX_IMAGE_TURN_DEG
    # 5.0: largest correction [degrees] of a parameter; a knocked mount, or its baseline, turns by less.
    beyond = {p.name for p in decision.parameters if abs(math.degrees(p.value)) > 5.0}
    far = turned or bool(beyond)
    applied = params.mode != "fixed" and decision.changed and not far and not repeats
    rig = corrected(given, decision.correction) if applied else given
    per_pair = [_alone(given, m, decision, params) for m in pairs]
    share = impossible_share(rig, pairs, decision.fit)
    left, right = np.concatenate([m.left for m in pairs]), np.concatenate([m.right for m in pairs])
    if turned:
        # Of a rig whose right camera lies on its side, exchanged images are turned as well.
        refuse_exchanged(given, left, right)
    elif share > BEYOND_SHARE or far:
        refuse_impossible(rig, left, right, share)
    elif applied:
        # The correction that mirrored images ask for may look like a knock.
        refuse_mirrored(given, left, right, max(exchanged(given, left, right)[1:]))
    weights, of_given, off = np.concatenate(decision.fit.weights), _distances(given, pairs), _distances(rig, pairs)
    # The same points before and after: residuals of two sets of inliers say nothing about a repair.
    before, after = (rms(np.concatenate(one), weights) for one in (of_given, off))
    kept = "not repaired, for what they show repeats" if repeats else "kept because rig.mode = fixed"
    if far:
        kept = "not repaired, for no mount moves that far"
        if beyond <= {"baseline_across", "baseline_forward"} and not turned:
            kept += ": are left and right exposed at one moment? What the camera moves in between adds to the baseline"
    median = float(np.median(np.concatenate(of_given)[weights > 0]))
    hidden = [p for p in decision.parameters if not (p.observed or p.name == shown)]
    warnings = _contradiction(given, median, decision, "repaired" if applied else kept, hidden)
    if turned:
        words = f"the right images are turned by {abs(turn):.0f} degrees {'anti' if turn < 0 else ''}clockwise"
        warnings = [f"{words} against the left ones, which the calibration does not say: turn them back"]
    marks: dict[str, Any] = {"contradiction": warnings[0]} if far else {}
    # A pixel of the coarser image. A larger RMS of all pairs after the repair: lens distortion or a wrong calibration;
    # a larger spread of one pair: its images may be of two moments.
    bad_rows = right_pixels(given)
    suspects = [m.pair for m, d in zip(pairs, off, strict=True) if far or mad_sigma(d) > bad_rows]
    marks |= {"suspects": suspects} if suspects else {}
    warnings += [] if turned or repeats else _doubts(share, after, bad_rows)
    # With a calibration of other cameras differences between pairs mean nothing.
    moves = [] if far else _drift(linearised(given, pairs), per_pair, params)
    warnings += [move.warning for move in moves]
    largest = max(moves, key=lambda move: move.rows, default=None)
    marks |= {"knocked": largest.what} if largest is not None and largest.rows > bad_rows else {}
    return {
        "rig": rig.to_dict(),
        "source": _source(decision, applied, len(pairs)),
        "changed": applied,
        "parameters": [p.to_dict() for p in decision.parameters],
        "per_pair": per_pair,
        "matches": sum(len(m.left) for m in pairs),
        "residual_before_px": before,
        "residual_after_px": after,
        "warnings": warnings,
        **marks,
    }


def _share(pairs: list[PointPairs]) -> list[PointPairs]:
    """Every n-th match of each pair, so that many pairs together stay affordable."""
    # Beyond 10 000 matches systematic errors dominate; at least 200 of a pair are used.
    most = max(200, 10_000 // len(pairs))
    steps = [max(1, math.ceil(len(m.left) / most)) for m in pairs]
    return [PointPairs(m.pair, m.left[::s], m.right[::s]) for m, s in zip(pairs, steps, strict=True)]


def _alone(given: Rig, matches: PointPairs, decision: Decision, params: RigParams) -> dict[str, Any]:
    """One pair's own values and sigmas, degrees, of all parameters that the sequence observes."""
    names = [p.name for p in decision.parameters if p.observed]
    free = [p.observed for p in decision.parameters]
    values, sigma = estimate(given, [matches], free, params.priors(given))
    return {
        "pair": matches.pair,
        "values": {n: math.degrees(values[NAMES.index(n)]) for n in names},
        "sigma": {n: math.degrees(sigma[NAMES.index(n)]) for n in names},
    }


def _distances(rig: Rig, pairs: Sequence[PointPairs]) -> list[Floats]:
    """Distances (n,) of each pair's matches from their epipolar lines, pixels."""
    return [line_distances(rig, m.left, m.right) for m in pairs]


def _word(p: Parameter) -> str:
    return p.name.replace("_", " ")


def _off(p: Parameter) -> str:
    """By how much a parameter is off, in words; for turned images the linear estimate is not an angle."""
    if abs(p.value) < math.radians(MAX_IMAGE_TURN_DEG):
        return f"{_word(p)} is off by {math.degrees(p.value):+.2f} +- {math.degrees(p.sigma):.2f} degrees"
    turned = "" if p.name == "baseline_forward" else " (are the images of both cameras turned?)"
    return f"{_word(p)} is off by more than {MAX_IMAGE_TURN_DEG:g} degrees{turned}"


def _source(decision: Decision, applied: bool, pairs: int) -> str:
    if not applied:
        return "given calibration"
    names = " and ".join(_word(p) for p in decision.parameters if p.freed)
    return f"given calibration, {names} repaired from {pairs} pair{'s' if pairs > 1 else ''}"


def _misalignment(rig: Rig, offset: float, decision: Decision) -> str:
    """How the right image departs from the given rig, in words: offset across lines (pixels) and freed parameters."""
    # The offset stands for the angle that causes it, which is not repeated.
    if standing(rig):
        lines, where, told = "columns", "far right" if offset > 0 else "far left", "yaw"
    else:
        lines, where, told = "rows", "low" if offset > 0 else "high", "pitch"
    parts = [f"{lines} of the right image lie {abs(offset):.2f} px too {where}"]
    if turn_axes(rig)[0, 1]:  # rows and columns are crossed alike
        parts, told = [f"the right image lies {abs(offset):.2f} px off the epipolar lines"], ""
    for p in decision.parameters:
        degrees = math.degrees(p.value)
        # Positive roll turns x (right) to y (down): clockwise in the image.
        if p.freed and p.name == "roll":
            parts.append(f"it is turned by {abs(degrees):.2f} degrees {'' if degrees > 0 else 'anti'}clockwise")
        elif p.freed and p.name != told:
            parts.append(_off(p))
    return ", ".join(parts)


def _contradiction(given: Rig, offset: float, decision: Decision, done: str, hidden: Sequence[Parameter]) -> list[str]:
    """Warnings about a calibration that the images contradict; empty if they do not.

    Parameters
    ----------
    offset : median distance of the matches from their epipolar lines, pixels.
    done : consequence, in words: repaired, or why not.
    hidden : parameters that nothing determines.
    """
    if not decision.changed:
        return []
    words = _misalignment(given, offset, decision)
    lines = [f"the calibration contradicts the images: {words}; {done}"]
    if hidden:
        names = ", ".join(f"{_word(p)} (taken alone they ask for {math.degrees(p.asked):+.2f} degrees)" for p in hidden)
        lines.append(
            f"what these images cannot tell is held: {names}; if the camera was turned there, too, depth is wrong: "
            "calibrate anew, or compare a known length"
        )
    return lines


def _doubts(share: float, residual: float, bad_rows: float) -> list[str]:
    """Warnings that something other than the rig's orientation is wrong: a ``residual`` above ``bad_rows``, pixels, or
    a ``share`` of matches beyond infinity."""
    lines = []
    if residual > bad_rows:
        lines.append(
            f"matches lie {residual:.1f} px RMS off their epipolar lines: is lens distortion left in the images, or "
            "the wrong calibration given, or are its transforms inverted (T_BS leads from the camera to the body)?"
        )
    if share > BEYOND_SHARE:
        lines.append(f"{100 * share:.0f} % of the matches lie beyond infinity: the toe-in is wrong")
    return lines


class _Move(NamedTuple):
    """A parameter that changes from pair to pair: in words, as a warning, and its largest row shift, pixels."""

    what: str
    warning: str
    rows: float


def _drift(start: Sequence[Linear], per_pair: list[dict[str, Any]], params: RigParams) -> list[_Move]:
    """Parameters that change from pair to pair by more than their errors, in pairs whose rows move enough to matter.

    In one scene the effects of parameters are alike (of a pitch and of a baseline across, over flat ground), so the row
    shift of all changes together decides. And a rig that moves shifts rows all over the image, mismatches on one object
    do not, so the shift is measured by blocks of the image (:func:`_row_shifts`).
    """
    names = list(per_pair[0]["values"]) if len(per_pair) > 2 else []
    values = np.array([[p["values"][name] for name in names] for p in per_pair])
    sigma = np.array([[p["sigma"][name] for name in names] for p in per_pair])
    columns = [NAMES.index(name) for name in names]
    # One of two states of the rig, not their mean; and a pair's own, for parameters stand in for each other.
    usual = values[_most_alike(values, np.concatenate([one.design for one in start])[:, columns])]
    departure = values - usual
    moved = _row_shifts(start, columns, np.radians(usual), np.radians(departure))
    moves = []
    for k, name in enumerate(names):
        away = np.abs(departure[:, k])
        odd = (away > params.significance * sigma[:, k]) & (moved > params.least_rows)
        if odd.any():
            # The first pair whose state differs from that of pair 0, whichever of the two is the usual one.
            change, degrees = per_pair[int(np.argmax(odd != odd[0]))]["pair"], away[odd].max()
            what = f"the rig moved at pair {change}: {name.replace('_', ' ')} by {degrees:.2f} degrees"
            warning = (
                f"the rig moves: {name.replace('_', ' ')} of {int(odd.sum())} of {len(values)} pairs departs from the "
                f"others', by {degrees:.2f} degrees, first at pair {change}; by rig.mode = per_pair each has its own"
            )
            moves.append(_Move(what, warning, float(moved[odd].max())))
    return moves


def _most_alike(values: Floats, design: Floats) -> int:
    """Which of some states (n, k) of a rig differs least from all others, by the rows (m, k) that they move."""
    apart = values[:, None] - values
    squares = np.einsum("ijk,kl,ijl->ij", apart, design.T @ design, apart, optimize=True)
    return int(np.argmin(np.sqrt(np.maximum(squares, 0.0)).sum(1)))


def _row_shifts(start: Sequence[Linear], columns: list[int], usual: Floats, departure: Floats) -> Floats:
    """Row shifts (pairs,) of each pair against the others, pixels: medians over blocks of the image.

    The shift of a block is its median row error, less the median over pairs of the error that their own parameters
    leave there; it counts in the direction, and up to the size, of the shift by the pair's own parameters. With medians
    of matches and of blocks, neither less than half of a block's matches nor less than half of the blocks move a rig.

    Parameters
    ----------
    columns : of the design, those of the parameters.
    usual, departure : parameters (parameters,) of all pairs, and differences (pairs, parameters) from them, radians.
    """
    blocks, medians = np.arange(BLOCKS**2), list[list[Floats]]()
    for one, by in zip(start, departure, strict=True):
        design = one.design[:, columns]
        off, shift = one.constant + design @ usual, -(design @ by)
        enough = np.bincount(one.block, minlength=BLOCKS**2) >= MIN_MATCHES_OF_BLOCK
        each = (scipy.ndimage.median(values, one.block, blocks) for values in (off, shift, off - shift))
        medians.append([np.where(enough, values, np.nan) for values in each])
    left = np.array([rest for _, _, rest in medians])
    moved = np.zeros(len(start))
    for k, (found, wanted, _) in enumerate(medians):
        seen = np.isfinite(found)
        if seen.any():
            # Shift in the direction of that by the parameters, at most as large.
            apart = (found[seen] - np.nanmedian(left[:, seen], axis=0)) * np.sign(wanted[seen])
            moved[k] = np.median(np.clip(apart, 0.0, np.abs(wanted[seen])))
    return moved


@stage("rig")
def rig_stage(
    params: RigParams,
    orientations: Sequence[Bundle[OrientationFacts]] = (),
    *,
    rig: Rig,
    first: Rig | None = None,
    lenses: Mapping[str, Any] | None = None,
) -> Bundle[RigFacts]:
    """The rig: the given calibration, repaired where the images contradict it."""
    pairs = [PointPairs.of(found) for found in orientations]
    shares = [found.meta["repeated"] for found in orientations]
    opened = {side: Lens.from_dict(lens) for side, lens in (lenses or {}).items()}
    both = {"left": Lens(rig.left), "right": Lens(rig.right)} | opened
    try:
        facts = orient_rig(rig, pairs, params, first, float(np.mean(shares)) if shares else 0.0)
    except BeyondInfinityError as refusal:
        if not (misread := better_reading(rig, rig, both, pairs)):
            raise
        text = f"the calibration contradicts the images: {misread}"
        raise DegenerateError("RIL-752", text, remedy="correct the calibration") from refusal
    if "matches" in facts and (misread := better_reading(rig, Rig.from_dict(facts["rig"]), both, pairs)):
        facts["misread"] = misread
        # A turn that no mount makes, or from pair to pair, is the misreading's.
        facts.pop("knocked", None)
        if (turned := facts.get("contradiction")) is not None:
            facts["contradiction"] = misread
            facts["warnings"].remove(turned)
        facts["warnings"].insert(0, misread)
    return Bundle({}, facts)
