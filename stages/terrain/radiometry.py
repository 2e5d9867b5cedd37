"""Levelling of exposures between elevation models, so that the merged ortho image has no seams of brightness.

Each pair of overlapping models says by what factor one is brighter than the other (stage ``overlap_qa``). The factors
g of all models follow by least squares on their logarithms,

    sum over seams of (log g_b - log g_a + log(grey_b / grey_a) - v . (c_b - c_a))^2
    + FADING_WEIGHT * sum over models (log g)^2

with the models' centres c. The gradient v takes up what is the same at every step: ground looks darker or brighter from
near than from afar (fall-off of the lens, light), which is no exposure and would pile up along the way. The second term
lets a lasting change fade within some models. Factors are rounded to steps that nobody sees: a model that moves a
little then leaves those of the others as they are, to the bit, and with them every tile that it does not touch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.terrain import OverlapFacts, RadiometryFacts

LOG_GAIN_STEP = 0.01
"""Step of log g: half a step is 0.6 of 128 grey values."""
FADING_WEIGHT = 0.05
"""Weight of the second term: a lasting change fades by 1/e over sqrt(1 / FADING_WEIGHT) = 4.5 models of a chain."""


def level(centres: Mapping[int, Sequence[float]], ratios: Sequence[tuple[int, int, float]]) -> dict[int, int]:
    """Steps of log g of each model that is not left as it is.

    Parameters
    ----------
    centres : x, y of each model, metres.
    ratios : (a, b, log(grey_b / grey_a)) of models that overlap.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    if not ratios:
        return {}
    at = {pair: i for i, pair in enumerate(sorted(centres))}
    ordered, n = sorted(ratios), len(at)
    moved = np.array([np.subtract(centres[b], centres[a]) for a, b, _ in ordered])
    rows = np.repeat(np.arange(len(ordered)), 4)
    cols = np.array([k for a, b, _ in ordered for k in (at[a], at[b], n, n + 1)])
    # One row a seam: log g_b - log g_a - v . (c_b - c_a).
    values = np.column_stack([np.tile([-1.0, 1.0], (len(ordered), 1)), -moved]).ravel()
    design = coo_array((values, (rows, cols)), shape=(len(ordered), n + 2)).tocsc()
    wanted = -np.array([ratio for _, _, ratio in ordered])
    # A direction in which the cameras hardly move, such as sway, shows no gradient: the ridge holds it at 0. With
    # a hundredth, ten models of one exposure got a slope of a fifth from end to end, and random exposures stayed half.
    small = 1e-3 * max(float((moved**2).sum()), 1e-9)
    ridge = diags_array(np.array([FADING_WEIGHT] * n + [small] * 2))
    solved = spsolve((design.T @ design + ridge).tocsc(), design.T @ wanted)[:n]
    # Beyond a factor of 2 it is not exposure.
    steps = np.rint(np.clip(solved, -0.7, 0.7) / LOG_GAIN_STEP).astype(int)
    return {pair: int(steps[i]) for pair, i in at.items() if steps[i]}


@stage("radiometry")
def radiometry_stage(
    params: NoParams, seams: Sequence[Bundle[OverlapFacts]], *, centres: Mapping[str, Sequence[float]]
) -> Bundle[RadiometryFacts]:
    """Factors that level the exposures of overlapping elevation models' grey values."""
    ratios = [
        (int(seam["other"]), int(seam["pair"]), float(seam["log_ratio"]))
        for bundle in seams
        for seam in bundle.meta["seams"]
        if seam["log_ratio"] is not None
    ]
    steps = level({int(pair): centre for pair, centre in centres.items()}, ratios)
    return Bundle({}, {"steps": {str(pair): n for pair, n in sorted(steps.items())}})
