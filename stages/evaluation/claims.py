"""Whether claimed standard deviations and covariances hold: shares of the errors within, and NEES of poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.facts.evaluation import Metric, metric
from rille.stages.geometry.geometry import cross_matrix, rotation_log
from rille.stages.geometry.rigid import posed

CLAIMS = (
    ("nees", slice(0, 6), ""),
    ("nees_position", slice(0, 3), ", of positions alone"),
    ("nees_rotation", slice(3, 6), ", of rotations alone"),
)
"""Figures of the covariances: name, rows of the covariance that are judged, description."""


def claims_held(error: AnyArray, std: AnyArray, what: str) -> dict[str, Metric]:
    """Shares of the errors (n,) up to one and two ``std`` (n,), in the same unit; ``what`` was measured, in words.

    Of normally distributed errors 68 and 95 %.
    """
    return {
        f"within_{count}_sigma": metric(
            float(np.mean(error <= count * std)) if error.size else None, "1", f"share within {deviations} {what}"
        )
        for count, deviations in ((1, "1 standard deviation"), (2, "2 standard deviations"))
    }


def truth_covariance(away: Floats, sigma_m: float, sigma_rad: float) -> Floats:
    """Covariances (n, 6, 6) of (position m, rotation rad) of true poses that lie ``away`` (n, 3), m, from the first.

    The first was made equal to the estimate. Each has its own errors; those of the first also shift all others, and
    turn them about it.
    """
    own, moved = np.diag(np.repeat(np.square([sigma_m, sigma_rad]), 3)), np.tile(np.eye(6), (len(away), 1, 1))
    moved[:, :3, 3:] = -cross_matrix(away)
    return own + moved @ own @ np.swapaxes(moved, 1, 2)


def nees(P: Floats, aligned: Floats, covariance: Floats) -> Mapping[str, float | str]:
    """Mean squared errors over the claimed ones, per degree of freedom, by the names of :data:`CLAIMS`; or the reason
    why there are none.

    ``covariance`` (n, 6, 6) of (position m, rotation rad) in the world whose origin is the first posed frame, which is
    exact: ``aligned`` is the truth with the first poses made equal.
    """
    names = [name for name, *_ in CLAIMS]
    claimed = posed(P) & posed(covariance)
    known = claimed & posed(aligned)
    # The first frame is exact by definition and has no covariance to judge.
    rows = np.flatnonzero(known)[1:]
    if len(rows) == 0 or not known[np.argmax(claimed)]:
        why = "no truth of the first posed frame, where the covariances begin, and of later ones"
        return dict.fromkeys(names, f"{why}: --frames may begin with one that has truth")
    if not (np.linalg.eigvalsh(covariance[rows])[:, 0] > 0).all():
        return dict.fromkeys(names, "a covariance is singular")
    turn = rotation_log(aligned[rows, :, :3] @ np.swapaxes(P[rows, :, :3], 1, 2))
    error, claim = np.concatenate([aligned[rows, :, 3] - P[rows, :, 3], turn], axis=1)[..., None], covariance[rows]
    parts = {name: (error[:, part], claim[:, part, part]) for name, part, _ in CLAIMS}
    return {name: float(np.mean(e * np.linalg.solve(c, e))) for name, (e, c) in parts.items()}
