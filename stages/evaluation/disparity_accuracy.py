"""Disparities against truth, as stereo benchmarks judge them: errors and completeness, of matches and of all pixels.

Column disparities alone are compared, since truth of rectified images has no others. A matcher that leaves out hard
pixels errs less: so all pixels with truth are judged too, those without a match filled as by Middlebury and KITTI, with
the nearest match in their row, of two with the background's.
"""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.core.validity import matched
from rille.stages.evaluation.claims import claims_held
from rille.stages.facts.evaluation import Metric, MetricsFacts, metric
from rille.stages.facts.matching import DisparityFacts


def filled(column: Floats32, match: Bools) -> Floats32:
    """Disparities (row, col), pixels right minus left, with every pixel that lacks a match filled along its row.

    The cameras are parallel: of two matches the one with the greater value, the lesser disparity, is the background's.
    A row without a match stays NaN.
    """
    cols = np.arange(column.shape[1])
    before = np.maximum.accumulate(np.where(match, cols, -1), axis=1)
    after = np.minimum.accumulate(np.where(match, cols, len(cols))[:, ::-1], axis=1)[:, ::-1]
    sides = [
        np.where(there, np.take_along_axis(column, np.where(there, at, 0), axis=1), -np.inf)
        for at, there in ((before, before >= 0), (after, after < len(cols)))
    ]
    nearest = np.maximum(*sides)
    return np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32)


def disparity_accuracy(column: Floats32, match: Bools, sigma: Floats32, truth: Floats32) -> dict[str, Metric]:
    """Metrics by name.

    Parameters
    ----------
    column, truth : (row, col) pixels, right minus left; NaN unknown.
    match : (row, col) pixels with a measured disparity.
    sigma : (row, col) pixels, its claimed standard deviation.
    """
    known = np.isfinite(truth)
    both = known & match & np.isfinite(column)
    error = np.abs(column - truth)[both]
    every = np.abs(filled(column, both | (match & ~known)) - truth)[known]
    counts = f"{error.size} of {every.size} pixels with truth"
    of_matched = f"of the matched pixels; {counts}"
    of_all = f"of all pixels, filled along rows where not matched; {every.size} pixels with truth"
    figures = {
        "median": metric(float(np.median(error)) if error.size else None, "px", f"median error {of_matched}"),
        "completeness": metric(
            error.size / every.size if every.size else None, "1", f"share that is matched; {counts}"
        ),
    }
    # (1, 2, 4): an error beyond these counts as bad: bad-1, bad-2, bad-4.
    for limit in (1, 2, 4):
        words = f"share off by more than {limit} px, "
        # Not "greater": unknown pixels have the error NaN, and are bad.
        worse = float(np.mean(~(every <= limit))) if every.size else None
        figures[f"bad_{limit}"] = metric(worse, "1", words + of_all)
        worse = float(np.mean(error > limit)) if error.size else None
        figures[f"bad_{limit}_matched"] = metric(worse, "1", words + of_matched)
    return figures | claims_held(error, sigma[both], f"of the disparity, {of_matched}")


@stage(
    "disparity_accuracy",
    outputs=[Array("error", ("row", "col"), "float32", "px", "column disparity minus truth", "nan", "left image")],
)
def disparity_accuracy_stage(
    params: NoParams, disparity: Bundle[DisparityFacts], truth: Bundle
) -> Bundle[MetricsFacts]:
    """Disparities against truth: bad-1, bad-2 and bad-4 of all pixels and of the matched ones, and completeness."""
    column, sigma = (np.asarray(disparity[name]) for name in ("column_disparity", "disparity_std"))
    true, match = np.asarray(truth["column_disparity"]), matched(np.asarray(disparity["validity"]))
    error = np.where(match, column - true, np.float32(np.nan))
    facts: MetricsFacts = {"metrics": disparity_accuracy(column, match, sigma, true)}
    wrong = facts["metrics"]["bad_2_matched"]["value"]
    if "damage" in truth.meta:
        facts["warnings"] = [f"{truth.meta['damage']}: its pair is not judged"]
    # Most right matches fit right truth. Fewer than 100 pixels do not raise the doubt.
    if np.count_nonzero(np.isfinite(error)) >= 100 and isinstance(wrong, float) and wrong > 0.75:
        facts["warnings"] = [
            f"the true disparities contradict the matches, of which {1.0 - wrong:.0%} fit them: check truth_disparity: "
            "sign, scale (of SGBM 16), an offset of the principal points, the order of rows (PFM has the "
            "lowest first), and that each is of its left image"
        ]
    return Bundle({"error": error}, facts)
