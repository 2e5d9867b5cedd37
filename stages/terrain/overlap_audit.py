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

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.facts.terrain import AuditFacts, OverlapFacts

Facts = Mapping[str, Any]

MEDIAN, STANDS_OUT = 2.366, 21.11
"""Of chi-square with three degrees of freedom: median, and what chance exceeds once in ten thousand."""
LEAST_OTHERS = 3
"""Seams without a model that tell what is usual; with fewer, all seams have to."""
NAMED = 3
"""Models that a warning names."""
LISTED = 500
"""Largest number of seams in the result, the worst first: a long sequence has tens of thousands."""


class OverlapAuditParams(Params):
    """Parameters of the stage ``overlap_audit``."""

    allowed_sigmas: float = Field(
        2.0,
        gt=0,
        description="standard deviations of one cell's difference that a model's bias and tilt may amount to before "
        "it is reported to contradict its neighbours; 95 % of the differences by noise are smaller than 2",
    )


@dataclass(frozen=True)
class _Model:
    """A model as the audit sees it: its seams, and how its plane (bias at its centre, tilts) shows in each.

    ``seams`` (n,) numbers; ``design`` (n, 3, 3) its plane to that of the seam, at the seam's centre; ``pull`` (n, 3, 3)
    design transposed times weight; ``covariance`` (3, 3) of the plane that explains the seams best.
    """

    seams: NDArray[np.intp]
    design: Floats
    pull: Floats
    covariance: Floats

    @staticmethod
    def of(
        pair: int, numbers: Sequence[int], every: Sequence[Facts], weight: Floats, centre: Sequence[float]
    ) -> _Model:
        seams = np.array(numbers)
        design = np.zeros((len(seams), 3, 3))
        for k, number in enumerate(numbers):
            dx, dy = (a - b for a, b in zip(every[number]["centre"], centre, strict=True))
            sign = 1.0 if pair == every[number]["pair"] else -1.0
            design[k] = sign * np.array([[1.0, dx, dy], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        pull = np.swapaxes(design, 1, 2) @ weight[seams]
        return _Model(seams, design, pull, np.linalg.pinv((pull @ design).sum(0), hermitian=True))

    def explain(self, left: Floats) -> tuple[Floats, float]:
        """Plane that explains best what is ``left`` of all seams (n, 3), and by how much chi-square falls."""
        right = (self.pull @ left[self.seams, :, None]).sum(0)[:, 0]
        plane = np.asarray(self.covariance @ right)
        return plane, float(plane @ right)


def audit(seams: Sequence[Facts], centres: Mapping[int, Sequence[float]]) -> tuple[float, list[dict[str, Any]]]:
    """Variance factor of the seams, and what each model has of its own, the worst first.

    Parameters
    ----------
    seams : facts as stage ``overlap_qa`` gives them.
    centres : x, y of each model, metres: where its bias is stated.

    Returns
    -------
    Each model's ``pair``, ``bias`` (m), ``tilt`` (rad, along x and y), ``sigma`` (of the three), ``systematic`` (RMS of
    both over its seams, m), ``expected`` (what its and its neighbours' sigma let a cell differ, m), ``score``
    (``chi2`` over the variance factor), ``found``, ``neighbours`` and ``either``: nothing tells it from its only one.
    """
    every = sorted(seams, key=lambda s: (s["pair"], s["other"]))
    ends = np.array([(s["pair"], s["other"]) for s in every]).reshape(-1, 2)
    left = np.array([[s["bias"], *s["tilt"]] for s in every]).reshape(-1, 3)
    # A covariance may be singular; what it knows no error of gets no weight.
    weight = np.linalg.pinv(np.array([s["covariance"] for s in every]).reshape(-1, 3, 3), hermitian=True)
    sizes = np.einsum("ni,nij,nj->n", left, weight, left)
    of: dict[int, list[int]] = defaultdict(list)
    for number, s in enumerate(every):
        of[s["pair"]].append(number)
        of[s["other"]].append(number)
    models = {pair: _Model.of(pair, mine, every, weight, centres[pair]) for pair, mine in sorted(of.items())}
    solved = {pair: model.explain(left) for pair, model in models.items()}
    listed: list[dict[str, Any]] = []
    blamed = np.zeros(len(every), bool)  # seams that a model which was found has part in
    while solved:
        worst = max(solved, key=lambda pair: solved[pair][1])
        model, (plane, chi2) = models[worst], solved.pop(worst)
        near = np.isin(np.arange(len(every)), model.seams)
        factor = _factor(sizes, blamed if blamed.any() else near)
        others = sorted({int(end) for end in ends[model.seams].ravel()} - {worst})
        listed.append(
            {"pair": worst}
            | _entry(model, plane, [every[number] for number in of[worst]])
            | {
                "chi2": chi2,
                "score": chi2 / factor,
                "found": chi2 / factor > STANDS_OUT,
                "neighbours": others,
                "either": len(others) == 1 and len(of[others[0]]) == len(model.seams),
            }
        )
        blamed |= near & listed[-1]["found"]
        # What this model explains is gone from its seams, so that its neighbours are judged by the rest.
        left[model.seams] -= model.design @ plane
        for pair in set(others) & set(solved):
            solved[pair] = models[pair].explain(left)
    return _factor(sizes, np.zeros(len(every), bool)), listed


def _factor(sizes: Floats, without: Bools) -> float:
    """How much more than noise seams differ: the median of those that some models have no part in, if there are any."""
    others = sizes[~without]
    chosen = others if len(others) >= LEAST_OTHERS else sizes
    return max(1.0, float(np.median(chosen)) / MEDIAN) if len(chosen) else 1.0


def _entry(model: _Model, plane: Floats, mine: Sequence[Facts]) -> dict[str, Any]:
    """A model's own error."""
    cells = np.array([s["cells"] for s in mine], dtype=np.float64)
    # over a seam the plane is its value at the centre, and what the tilt adds over half its width
    at = (model.design @ plane)[:, 0]
    half = np.array([math.sqrt(s["area"]) for s in mine]) / math.sqrt(12.0)
    square = at**2 + half**2 * float(plane[1:] @ plane[1:])
    return {
        "bias": float(plane[0]),
        "tilt": plane[1:].tolist(),
        "sigma": np.sqrt(np.maximum(np.diag(model.covariance), 0.0)).tolist(),
        "systematic": math.sqrt(float(np.average(square, weights=cells))),
        "expected": float(np.median([s["expected"] for s in mine])),
    }


def contradictions(models: Sequence[Facts], params: OverlapAuditParams) -> list[Facts]:
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


@stage("overlap_audit", version=2)
def overlap_audit_stage(
    params: OverlapAuditParams, seams: Sequence[Bundle[OverlapFacts]], *, centres: Mapping[str, Sequence[float]]
) -> Bundle[AuditFacts]:
    """Which elevation models contradict their neighbours, in bias and tilt, the worst first."""
    every = [s for bundle in seams for s in bundle.meta["seams"]]
    factor, models = audit(every, {int(pair): centre for pair, centre in centres.items()})
    bad = contradictions(models, params)
    for model in models:
        model["contradicts"] = model in bad
    warnings = []
    if bad:
        told = "; ".join(describe(m) for m in bad[:NAMED])
        more = f"; and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
        count = f"{len(bad)} of {len(centres)} elevation models"
        warnings.append(f"{count} contradict their neighbours by more than their sigma allows: {told}{more}")
    ranked = sorted(every, key=lambda s: (-s["systematic"] / max(s["expected"], 1e-12), s["pair"], s["other"]))
    kept = ("pair", "other", "cells", "bias", "tilt", "covariance", "noise", "structure", "systematic", "expected")
    return Bundle(
        {},
        {
            "variance_factor": factor,
            "models": models,
            "seam_count": len(ranked),
            "seams": [{k: s[k] for k in kept} for s in ranked[:LISTED]],
            "warnings": warnings,
        },
    )
