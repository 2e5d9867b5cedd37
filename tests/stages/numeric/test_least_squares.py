from __future__ import annotations

import numpy as np

from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import bisquare


def line(outliers: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Design, target and weights of a line, whose first points lie off it, and its unknowns."""
    rng = np.random.default_rng(3)
    design, truth = np.column_stack([np.ones(200), rng.normal(size=200)]), np.array([1.0, -2.0])
    target = design @ truth
    target[:outliers] += 5.0
    return design, target, rng.uniform(0.5, 2.0, 200), truth


def test_irls_forgets_outliers_and_weighs_the_rest() -> None:
    design, target, weight, truth = line(20)
    np.testing.assert_allclose(irls(design, target, lambda r: weight * bisquare(r / 4.0)), truth, atol=1e-9)
    expected = np.linalg.lstsq(design * np.sqrt(weight)[:, None], target * np.sqrt(weight), rcond=None)[0]
    np.testing.assert_allclose(irls(design, target, lambda _: weight), expected)


def test_irls_of_several_problems_is_that_of_each() -> None:
    design, target = line(10)[:2]
    given = {"weigh": lambda r: bisquare(r / 4.0), "prior": 0.1 * np.eye(2)}
    both = irls(np.stack([design, 2.0 * design]), np.stack([target, target])[..., None], **given)
    for one, scale in zip(both, (1.0, 2.0), strict=True):
        np.testing.assert_allclose(one[:, 0], irls(scale * design, target, **given), rtol=1e-6)


def test_what_the_rows_leave_open_is_held_at_the_start() -> None:
    design, start = np.array([[1.0, 1.0]]), np.array([3.0, 0.0])
    held = irls(design, np.array([1.0]), np.ones_like, 1e-6 * np.eye(2), start)
    # The nearest point of the line x + y = 1.
    np.testing.assert_allclose(held, [2.0, -1.0], atol=1e-5)
