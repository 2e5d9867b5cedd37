"""Error and completeness of an elevation model, and both of two methods at equal completeness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rille.stages.numeric.robust import mad_sigma

from .methods import MAX_BACKMATCH_PX, Method, Model
from .scenes import Scene

FILTERS = ((0.35, True), (MAX_BACKMATCH_PX, True), (MAX_BACKMATCH_PX, False), (np.inf, False))
"""Limits of back-matching that the sweep goes through, pixels, and whether the geometry's error is bounded."""
TRUE_FILTERS = ((np.inf, True), (np.inf, False))
"""The same for true disparities."""
SHARES = np.concatenate([np.linspace(0.1, 0.9, 9), [0.95, 0.98, 1.0]])
"""Shares of its cells, the least doubtful first, that the sweep keeps of a model."""
FIGURES = ("rmse", "nmad", "p95")


@dataclass(frozen=True)
class Judged:
    """Completeness (share of the judged cells) and errors, metres."""

    completeness: float
    rmse: float
    nmad: float
    p95: float
    bias: float


def judge(scene: Scene, model: Model, most: float = np.inf) -> Judged:
    """Errors of the cells whose doubt is at most ``most``."""
    with np.errstate(invalid="ignore"):
        given = scene.judged & np.isfinite(model.elevation) & (model.doubt <= most)
    error = model.elevation[given].astype(np.float64) - scene.truth[given]
    share = error.size / scene.judged.sum()
    if not error.size:
        return Judged(share, np.nan, np.nan, np.nan, np.nan)
    spread = mad_sigma(error)
    rmse, p95 = float(np.sqrt(np.mean(error**2))), float(np.percentile(np.abs(error), 95))
    return Judged(share, rmse, spread, p95, float(np.mean(error)))


def sweep(scene: Scene, method: Method) -> list[Judged]:
    """One point of the curve for every setting of the filters: back-matching, limit of geometry, share kept."""
    found = []
    for limit, bounded in FILTERS if scene.disparities.backmatch is not None else TRUE_FILTERS:
        model = method.run(scene, limit, bounded)
        doubts = model.doubt[scene.judged & np.isfinite(model.elevation)]
        if doubts.size:
            found += [judge(scene, model, q) for q in np.unique(np.quantile(doubts, SHARES))]
    return found


def on_the_same_cells(scene: Scene, ours: Model, theirs: Model) -> float:
    """RMSE of one model over another's, on the judged cells that both give."""
    both = scene.judged & np.isfinite(ours.elevation) & np.isfinite(theirs.elevation)
    errors = [(m.elevation[both].astype(np.float64) - scene.truth[both]) for m in (ours, theirs)]
    a, b = (float(np.sqrt(np.mean(e**2))) for e in errors)
    return a / b


def least(curve: list[Judged], figure: str, completeness: float) -> float | None:
    """Least error of a curve at this completeness or more; None where it never gets there."""
    reached = [getattr(j, figure) for j in curve if j.completeness >= completeness - 1e-12]
    return min(reached) if reached else None
