"""Figures of the surest cells, by hand."""

import math

import numpy as np
import pytest

from benchmarks.surest import surest

ERROR, SIGMA = np.array([3.0, -1.0, 9.0, 2.0]), np.array([0.3, 0.1, 0.9, 0.2])


@pytest.mark.parametrize(
    ("completeness", "rms", "limit"), [(0.125, 1.0, 0.1), (0.25, 2.5**0.5, 0.2), (0.375, (14 / 3) ** 0.5, 0.3)]
)
def test_the_surest_of_eight_cells(completeness, rms, limit):
    assert surest(ERROR, SIGMA, 8, completeness) == pytest.approx((rms, limit))


def test_what_is_not_given_has_no_error():
    assert all(map(math.isnan, surest(ERROR, SIGMA, 8, 0.75)))
