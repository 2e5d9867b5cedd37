"""Which elevation model is to blame for the seams: models are taken out of the differences one after the other.

A seam says that one of two models is off, not which. A model that is off itself has the same error in all its seams,
its neighbours each in one of theirs. So for every model the bias and tilt that explain its seams best, its neighbours
held, are found by least squares; the one that explains most (Baarda's data snooping, one model at a time) is noted and
taken out of its seams, and so on. Seams differ by more than matching noise wherever poses have errors: a variance
factor, the median over the seams that the worst model has no part in, says by how much, and a model is *found* only if
it stands out beyond that.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.declare import Bundle, Inputs, Params, Stage

Floats = NDArray[np.float64]
Facts = Mapping[str, Any]

MEDIAN, STANDS_OUT = 2.366, 21.11
"""Of chi-square with three degrees of freedom: median, and what chance exceeds once in ten thousand."""
LEAST_OTHERS = 3
"""Seams without a model that tell what is usual; with fewer, all seams have to."""
NAMED = 3
"""Models that a warning names."""


class SeamAuditParams(Params):
    """Parameters of the stage ``seam_audit``."""

    allowed_sigmas: float = Field(
        2.0,
        gt=0,
        description="standard deviations of one cell's difference; a model whose bias and tilt amount to more "
        "contradicts its neighbours: of the differences by noise, 95 % are smaller",
    )


@dataclass
class _Seam:
    """One seam as the audit sees it: what is left of its plane, and the weight of that."""

    facts: Facts
    left: Floats
    weight: Floats

    @staticmethod
    def of(facts: Facts) -> _Seam:
        plane = np.array([facts["bias"], *facts["tilt"]])
        return _Seam(facts, plane, np.linalg.pinv(np.array(facts["covariance"]), hermitian=True))

    def design(self, pair: int, centre: Sequence[float]) -> Floats:
        """How the plane (bias at ``centre``, tilts) of a model shows at the centre of this seam."""
        dx, dy = (a - b for a, b in zip(self.facts["centre"], centre, strict=True))
        sign = 1.0 if pair == self.facts["pair"] else -1.0
        return sign * np.array([[1.0, dx, dy], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def audit(seams: Sequence[Facts], centres: Mapping[int, Sequence[float]]) -> tuple[float, list[dict[str, Any]]]:
    """Variance factor of the seams, and what each model has of its own, the worst first.

    Parameters
    ----------
    seams : facts as stage ``seam`` gives them.
    centres : x, y of each model, metres: where its bias is stated.

    Returns
    -------
    Each model's ``pair``, ``bias`` (m), ``tilt`` (rad, along x and y), ``sigma`` (of the three), ``systematic`` (RMS of
    both over its seams, m), ``expected`` (what its and its neighbours' sigma let a cell differ, m), ``score``
    (``chi2`` over the variance factor), ``found``, ``neighbours`` and ``either``: nothing tells it from its only one.
    """
    every = [_Seam.of(s) for s in sorted(seams, key=lambda s: (s["pair"], s["other"]))]
    sizes = [(float(s.left @ s.weight @ s.left), {s.facts["pair"], s.facts["other"]}) for s in every]
    of: dict[int, list[_Seam]] = defaultdict(list)
    for s in every:
        of[s.facts["pair"]].append(s)
        of[s.facts["other"]].append(s)
    solved = {pair: _explain(pair, mine, centres[pair]) for pair, mine in sorted(of.items())}
    listed: list[dict[str, Any]] = []
    while solved:
        worst = max(solved, key=lambda pair: solved[pair][2])
        plane, covariance, chi2 = solved.pop(worst)
        factor = _factor(sizes, {m["pair"] for m in listed if m["found"]} or {worst})
        listed.append(_entry(worst, (plane, covariance, chi2), factor, of, centres[worst]))
        for s in of[worst]:
            s.left = s.left - s.design(worst, centres[worst]) @ plane
        for pair in {s.facts[end] for s in of[worst] for end in ("pair", "other")} & set(solved):
            solved[pair] = _explain(pair, of[pair], centres[pair])
    return _factor(sizes, set()), listed


def _factor(sizes: Sequence[tuple[float, set[int]]], without: set[int]) -> float:
    """How much more than noise seams differ: the median of those that some models have no part in, if there are any."""
    others = [size for size, pairs in sizes if not pairs & without]
    chosen = others if len(others) >= LEAST_OTHERS else [size for size, _ in sizes]
    return max(1.0, float(np.median(chosen)) / MEDIAN) if chosen else 1.0


def _explain(pair: int, seams: Sequence[_Seam], centre: Sequence[float]) -> tuple[Floats, Floats, float]:
    """Plane of one model that explains its seams best, its covariance, and by how much chi-square falls."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for s in seams:
        a = s.design(pair, centre)
        normal += a.T @ s.weight @ a
        right += a.T @ s.weight @ s.left
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True), dtype=np.float64)
    plane = covariance @ right
    return plane, covariance, float(plane @ right)


def _entry(
    pair: int,
    solved: tuple[Floats, Floats, float],
    factor: float,
    of: Mapping[int, list[_Seam]],
    centre: Sequence[float],
) -> dict[str, Any]:
    (plane, covariance, chi2), mine = solved, of[pair]
    others = sorted({s.facts[end] for s in mine for end in ("pair", "other")} - {pair})
    cells = np.array([s.facts["cells"] for s in mine], dtype=np.float64)
    # over a seam the plane is its value at the centre, and what the tilt adds over half its width
    at = np.array([(s.design(pair, centre) @ plane)[0] for s in mine])
    half = np.array([math.sqrt(s.facts["area"]) for s in mine]) / math.sqrt(12.0)
    square = at**2 + half**2 * float(plane[1:] @ plane[1:])
    return {
        "pair": pair,
        "bias": float(plane[0]),
        "tilt": plane[1:].tolist(),
        "sigma": np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(),
        "systematic": math.sqrt(float(np.average(square, weights=cells))),
        "expected": float(np.median([s.facts["expected"] for s in mine])),
        "chi2": chi2,
        "score": chi2 / factor,
        "found": chi2 / factor > STANDS_OUT,
        "neighbours": others,
        "either": len(others) == 1 and len(of[others[0]]) == len(mine),
    }


def contradictions(models: Sequence[Facts], params: SeamAuditParams) -> list[Facts]:
    """Models that are off by more than their sigma allows, beyond what chance does."""
    return [m for m in models if m["systematic"] > params.allowed_sigmas * m["expected"] and m["chi2"] > STANDS_OUT]


def describe(model: Facts) -> str:
    """One model's own error in words."""
    tilts = [math.degrees(t) for t in model["tilt"]]
    against = "pairs" if len(model["neighbours"]) > 1 else "pair"
    names = ", ".join(str(n) for n in model["neighbours"][:4]) + (", ..." if len(model["neighbours"]) > 4 else "")
    words = (
        f"pair {model['pair']} against {against} {names}: {1000 * model['systematic']:.2g} mm where sigma allows "
        f"{1000 * model['expected']:.2g} mm (offset {1000 * model['bias']:+.2g} mm, tilt {tilts[0]:+.2g} deg along x, "
        f"{tilts[1]:+.2g} deg along y)"
    )
    return words + (", either may be wrong" if model["either"] else "")


def _run(params: SeamAuditParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    seams = [s for bundle in inputs["seams"] for s in bundle.meta["seams"]]
    centres = {int(pair): centre for pair, centre in args["centres"].items()}
    factor, models = audit(seams, centres)
    bad = contradictions(models, params)
    for model in models:
        model["contradicts"] = model in bad
    warnings = []
    if bad:
        told = "; ".join(describe(m) for m in bad[:NAMED])
        more = f"; and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
        count = f"{len(bad)} of {len(centres)} elevation models"
        warnings.append(f"{count} contradict their neighbours by more than their sigma allows: {told}{more}")
    ranked = sorted(seams, key=lambda s: (-s["systematic"] / max(s["expected"], 1e-12), s["pair"], s["other"]))
    kept = ("pair", "other", "cells", "bias", "tilt", "covariance", "noise", "structure", "systematic", "expected")
    return Bundle(
        {},
        {
            "variance_factor": factor,
            "models": models,
            "seams": [{k: s[k] for k in kept} for s in ranked],
            "warnings": warnings,
        },
    )


STAGE = Stage(
    name="seam_audit",
    version=1,
    summary="which elevation models contradict their neighbours, in bias and tilt, the worst first",
    params=SeamAuditParams,
    inputs=("seams*",),
    outputs=(),
    run=_run,
)
