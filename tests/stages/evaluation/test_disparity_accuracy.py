"""Disparities against truth: counts worked by hand, and the filling of what was not matched."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.core.validity import Validity
from rille.stages.evaluation.disparity_accuracy import disparity_accuracy, disparity_accuracy_stage, filled

NAN = np.nan


def test_a_gap_takes_the_background_of_its_row():
    column = np.array([[-9, NAN, NAN, -4], [NAN, -7, NAN, NAN], [NAN, NAN, NAN, NAN]], np.float32)
    out = filled(column, np.isfinite(column))
    np.testing.assert_array_equal(out, [[-9, -4, -4, -4], [-7, -7, -7, -7], [NAN, NAN, NAN, NAN]])


def test_shares_of_all_pixels_and_of_the_matched_ones():
    truth = np.array([[-10, -10, -10, -10, NAN]], np.float32)
    column = np.array([[-10.5, -8.5, NAN, -7.0, -50.0]], np.float32)  # off by .5, 1.5, filled by -7: 3, 3
    sigma = np.full_like(truth, 1.0)
    figures = {k: m["value"] for k, m in disparity_accuracy(column, np.isfinite(column), sigma, truth).items()}
    assert figures["completeness"] == pytest.approx(0.75)
    assert figures["median"] == pytest.approx(1.5)
    assert [figures[f"bad_{k}"] for k in (1, 2, 4)] == pytest.approx([0.75, 0.5, 0.0])
    assert [figures[f"bad_{k}_matched"] for k in (1, 2, 4)] == pytest.approx([2 / 3, 1 / 3, 0.0])
    assert [figures[f"within_{k}_sigma"] for k in (1, 2)] == pytest.approx([1 / 3, 2 / 3])


def test_a_map_without_a_match_is_wholly_bad_and_has_no_median():
    truth = np.full((2, 3), -5.0, np.float32)
    nothing = np.full_like(truth, NAN)
    disparity = Bundle(
        {"column_disparity": nothing, "disparity_std": nothing, "validity": np.full((2, 3), Validity.NO_TEXTURE)}, {}
    )
    out = disparity_accuracy_stage.run(
        NoParams(), {}, {"disparity": disparity, "truth": Bundle({"column_disparity": truth}, {})}
    )
    assert out.meta["metrics"]["bad_4"]["value"] == 1.0
    assert out.meta["metrics"]["completeness"]["value"] == 0.0
    assert out.meta["metrics"]["median"]["value"] is None
    assert np.isnan(np.asarray(out["error"])).all()


@pytest.mark.parametrize(
    ("read", "misread"),
    [
        (lambda true: true, False),
        (lambda true: -true, True),
        (lambda true: 16 * true, True),
        (lambda true: true[::-1], True),
        (lambda true: true - 31, True),
        (lambda true: np.where(np.arange(true.size).reshape(true.shape) % 40 == 0, -true, NAN), False),  # too few
    ],
)
def test_truth_that_contradicts_the_matches_is_named(read, misread):
    true = -np.linspace(5, 60, 40 * 50, dtype=np.float32).reshape(40, 50)
    bits = np.where(np.random.default_rng(1).random(true.shape) < 0.8, Validity.MATCHED, 0).astype(np.uint8)
    found = {"column_disparity": true + np.float32(0.1), "disparity_std": np.full_like(true, 0.1), "validity": bits}
    bundles = {"disparity": Bundle(found, {}), "truth": Bundle({"column_disparity": read(true)}, {})}
    assert ("warnings" in disparity_accuracy_stage.run(NoParams(), {}, bundles).meta) == misread


def test_a_damaged_map_of_truth_judges_nothing_and_is_named():
    column = np.full((4, 5), -8, np.float32)
    bits = np.full(column.shape, Validity.MATCHED, np.uint8)
    disparity = Bundle({"column_disparity": column, "disparity_std": column * 0 + 1, "validity": bits}, {})
    truth = Bundle({"column_disparity": column * NAN}, {"damage": "1.npy cannot be read"})
    out = disparity_accuracy_stage.run(NoParams(), {}, {"disparity": disparity, "truth": truth})
    assert out.meta["metrics"]["bad_2"]["value"] is None
    assert out.meta["warnings"] == ["1.npy cannot be read: its pair is not judged"]
