"""The adjustment itself: noise and its correlation as measured, priors that hold what they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rig_scenes import knocked, matches, street_depth, street_rig

from rille.stages.calibration.relative_orientation import (
    PRINCIPAL,
    RIG,
    SIZE,
    TERMS,
    PointPairs,
    Priors,
    _smooth_terms,
    adjust,
    consider_covariance,
    precision,
    settle,
    solution,
)
from rille.stages.geometry.epipolar import distances

PRIORS = Priors(rotation=np.radians(0.05), baseline=np.radians(0.2), principal=(3.5, 3.5), systematic=0.1)
ANGLES = [True, True, True, False, False]


def test_noise_is_measured_past_outliers():
    m = matches(street_rig(), street_depth, noise=0.3, outliers=0.1)
    fit = adjust(street_rig(), [m], ANGLES, PRIORS, rival=True)
    # the median of all is the 0.5 / 0.9 quantile of the good ones: 0.765 instead of 0.674 deviations
    assert fit.noise[0] == pytest.approx(0.3 * 0.765 / 0.674, rel=0.1)
    assert 0.07 < np.mean(fit.weights[0] == 0) < 0.13


def test_matches_that_err_together_do_not_count_again():
    """Each match four times over: the information is that of one."""
    rig = street_rig()
    once = matches(rig, street_depth)
    often = PointPairs(0, np.repeat(once.left, 4, axis=0), np.repeat(once.right, 4, axis=0))
    one, four = (adjust(rig, [m], ANGLES, PRIORS, rival=True).normal for m in (once, often))
    ratio = np.diag(four)[:5] / np.diag(one)[:5]
    assert np.all((ratio > 0.7) & (ratio < 1.5))


def test_smooth_error_is_told_from_the_rig():
    def field(u, v):
        return u**2 * v

    m = matches(knocked(street_rig(), pitch_deg=0.3), street_depth, field=field)
    fit = adjust(street_rig(), [m], ANGLES, PRIORS, rival=True)
    assert np.degrees(fit.x[0]) == pytest.approx(0.3, abs=0.01)
    assert np.abs(fit.x[RIG + PRINCIPAL : SIZE]).max() > PRIORS.term / 2


def test_images_without_smooth_error_are_as_certain_as_is_believed_of_rows():
    pairs = [matches(knocked(street_rig(), pitch_deg=0.3), street_depth, pair=k) for k in range(2)]
    fit = adjust(street_rig(), pairs, [True, False, True, False, False], PRIORS, rival=False)
    sigma = np.sqrt(np.diag(solution(fit, ANGLES, PRIORS, rival=False)[1]))
    # no sigma is smaller than what is believed of rows: 0.03 px of 707 px
    assert sigma[0] > 0.5 * PRIORS.term / 707.0


def test_held_parameters_take_their_share_only():
    m = matches(knocked(street_rig(), roll_deg=0.5), street_depth)
    fit = adjust(street_rig(), [m], [True, False, True, False, False], PRIORS, rival=False)
    assert np.degrees(fit.x[2]) == pytest.approx(0.5, abs=0.01)
    assert abs(np.degrees(fit.x[1])) < 0.05


def test_settled_rig_has_the_least_residuals_beside_what_is_held():
    """The baseline is off and held, and rows are bent: pitch and roll must not be traded for either."""
    rig = street_rig()
    free = [True, False, True, False, False]
    m = matches(
        knocked(rig, pitch_deg=0.3, roll_deg=0.3, across_deg=-0.3), street_depth, field=lambda u, v: 0.3 * u * u
    )
    x = settle(rig, [m], free, PRIORS).x[:5]
    assert x[[1, 3, 4]] == pytest.approx(0.0, abs=1e-6)

    def spread(c):
        return np.mean(np.clip(np.abs(distances(rig, c, m.left, m.right)[0]), 0, 2.0) ** 2)

    for i in (0, 2):
        for step in (-np.radians(0.02), np.radians(0.02)):
            assert spread(x) < spread(x + step * np.eye(5)[i])


def test_what_took_no_share_is_an_error_of_the_result():
    rig = street_rig()
    free = [True, False, False, False, False]
    m = matches(knocked(rig, pitch_deg=0.3), street_depth)
    fit = settle(rig, [m], free, PRIORS)
    sure = np.full(5, 1e-7)
    covariance = consider_covariance(fit, free, PRIORS, sure)
    # the constant term alone, 0.032 px of rows; pitch moves them by 707 px a radian and more
    assert covariance[0, 0] > (0.5 * PRIORS.term / 707.0) ** 2
    assert not covariance[1:].any()
    assert (
        consider_covariance(fit, free, replace(PRIORS, systematic=10 * PRIORS.systematic), sure)[0, 0]
        > 20 * covariance[0, 0]
    )
    assert consider_covariance(fit, free, PRIORS, PRIORS.held())[0, 0] > 1.1 * covariance[0, 0]


def test_the_pair_order_does_not_matter_to_rounding():
    pairs = [matches(knocked(street_rig(), pitch_deg=0.3), street_depth, pair=k) for k in range(3)]
    here, there = (adjust(street_rig(), p, ANGLES, PRIORS, rival=True).x for p in (pairs, pairs[::-1]))
    np.testing.assert_allclose(here, there, rtol=0, atol=1e-6)


def test_the_gain_is_half_the_drop_of_the_weighed_squares():
    m = matches(knocked(street_rig(), pitch_deg=0.3), street_depth)
    fit = adjust(street_rig(), [m], ANGLES, PRIORS, rival=True)
    x, _, gain = solution(fit, ANGLES, PRIORS, rival=True)
    total = fit.normal + precision(ANGLES, PRIORS, rival=True)

    def squares(at):
        return at @ total @ at - 2.0 * fit.pull @ at

    assert gain == pytest.approx(0.5 * (squares(np.zeros(SIZE)) - squares(x)))


def test_smooth_terms_are_legendre_polynomials_from_border_to_border():
    rig = street_rig()
    w, h = rig.left.width - 1.0, rig.left.height - 1.0
    ends = np.array([[w, h], [0.0, h], [w, 0.0], [0.5 * w, 0.5 * h]])
    found = _smooth_terms(rig, PointPairs(0, ends, ends))
    for column, (i, j) in zip(found.T, TERMS, strict=True):
        size = np.sqrt((2 * i + 1) * (2 * j + 1))  # of a term that is 1 in the corner: then its RMS is 1
        middle = {0: 1.0, 1: 0.0, 2: -0.5, 3: 0.0}
        np.testing.assert_allclose(column / size, [1.0, (-1) ** i, (-1) ** j, middle[i] * middle[j]], atol=1e-12)


def test_a_large_correction_is_found_though_derivatives_are_shared():
    """Half a degree is far beyond what one linearisation serves: the distances of the corrected rig vanish."""
    given, m = street_rig(), matches(knocked(street_rig(), pitch_deg=0.5, roll_deg=-0.5), street_depth, noise=0.0)
    fit = settle(given, [m], [True, False, True, False, False], PRIORS)
    off, _ = distances(given, fit.x[:5], m.left, m.right)
    assert np.abs(off).max() < 0.01
