"""Which elevation models contradict their neighbours, in bias and tilt, by more than their sigma allows.

A seam says that one of two models is off, not which. A model that is off itself has an error in all its seams, each of
its neighbours in one of theirs. So a model contradicts its neighbours where more than half of its seams stand out: the
RMS of their bias and tilt is beyond what the sigma of a cell, and the noise about the plane, allow.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.core.errors import told
from rille.stages.core.quantities import metres
from rille.stages.facts.terrain import AuditFacts, OverlapFacts

Facts = Mapping[str, Any]


def stands_out(seam: Facts) -> bool:
    """Whether bias and tilt of a seam are beyond the sigma of a cell, and beyond its noise."""
    # Bias and tilt amount to more than two standard deviations of a cell's difference.
    return bool(seam["systematic"] > 2.0 * max(seam["expected"], seam["noise"]))


def audit(seams: Sequence[Facts]) -> list[dict[str, Any]]:
    """Comparison of each model with its neighbours, the worst first.

    Parameters
    ----------
    seams : facts as stage ``overlap_qa`` gives them.

    Returns
    -------
    Each model's ``pair``; ``bias`` (m) and ``tilt`` (rad, along x and y) against the others, means over the cells of
    its seams; medians over its seams of ``systematic`` (RMS of both, m) and ``expected`` (what sigma lets a cell
    differ, m); its ``neighbours``; whether it ``contradicts`` them, and ``either``: nothing tells it from its only
    one.
    """
    of: dict[int, list[Facts]] = defaultdict(list)
    for seam in sorted(seams, key=lambda s: (s["pair"], s["other"])):
        of[seam["pair"]].append(seam)
        of[seam["other"]].append(seam)
    models = []
    for pair, mine in of.items():
        others = sorted({s["other"] if s["pair"] == pair else s["pair"] for s in mine})
        planes = [np.array([s["bias"], *s["tilt"]]) * (1.0 if s["pair"] == pair else -1.0) for s in mine]
        bias, *tilt = np.average(planes, axis=0, weights=[s["cells"] for s in mine]).tolist()
        models.append(
            {
                "pair": pair,
                "bias": bias,
                "tilt": tilt,
                "systematic": float(np.median([s["systematic"] for s in mine])),
                "expected": float(np.median([s["expected"] for s in mine])),
                "neighbours": others,
                "contradicts": 2 * sum(stands_out(s) for s in mine) > len(mine),
                "either": len(others) == 1 and len(of[others[0]]) == 1,
            }
        )
    return sorted(models, key=lambda m: (-m["systematic"] / max(m["expected"], 1e-12), m["pair"]))


def describe(model: Facts) -> str:
    """One model's own error in words."""
    tilts = [math.degrees(t) for t in model["tilt"]]
    against = "pairs" if len(model["neighbours"]) > 1 else "pair"
    names = ", ".join(str(n) for n in model["neighbours"][:4]) + (", ..." if len(model["neighbours"]) > 4 else "")
    off, expected, bias = (metres(model[n], signed=n == "bias") for n in ("systematic", "expected", "bias"))
    words = (
        f"pair {model['pair']} against {against} {names}: {off} where sigma allows {expected} "
        f"(offset {bias}, tilt {tilts[0]:+.2g} deg along x, {tilts[1]:+.2g} deg along y)"
    )
    return words + (", either may be wrong" if model["either"] else "")


@stage("overlap_audit")
def overlap_audit_stage(params: NoParams, seams: Sequence[Bundle[OverlapFacts]]) -> Bundle[AuditFacts]:
    """Which elevation models contradict their neighbours, in bias and tilt, the worst first."""
    every = [s for bundle in seams for s in bundle.meta["seams"]]
    models = audit(every)
    bad = [m for m in models if m["contradicts"]]
    ranked = sorted(every, key=lambda s: (-s["systematic"] / max(s["expected"], 1e-12), s["pair"], s["other"]))
    kept = ("pair", "other", "cells", "bias", "tilt", "noise", "systematic", "expected")
    facts: AuditFacts = {
        "models": models,
        "seam_count": len(ranked),
        "seams": [{k: s[k] for k in kept} for s in ranked[:500]],  # of tens of thousands
        "warnings": [],
    }
    if bad:
        words = f"{len(bad)} of {len(models)} elevation models contradict their neighbours by more than their sigma"
        facts["warnings"] = [line := f"{words} allows: {told(bad, describe)}"]
        # Of one or a few their own images are the cause, of most the rig, the trajectory or a part of all images.
        if 2 * len(bad) > len(models):
            facts["contradiction"] = line
    return Bundle({}, facts)
