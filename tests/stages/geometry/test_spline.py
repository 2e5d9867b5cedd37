"""Cubic splines through pixels: against SciPy's, and windows against the whole image."""

import numpy as np
import pytest
from scipy import interpolate, ndimage

from rille.stages.geometry.spline import TAPS_RADIUS_PX, coefficients, slopes, value_and_gradient, weights


@pytest.mark.parametrize("shape", [(40, 50), (3, 60), (1, 7)])
def test_coefficients_are_those_of_scipy(shape):
    image = np.random.default_rng(0).uniform(0, 255, shape).astype(np.float32)
    # SciPy's recursion has no end; what is cut off here is |pole|^(radius + 1) of 255 grey levels in either direction.
    expected = ndimage.spline_filter(image.astype(np.float64), 3, mode="mirror")
    np.testing.assert_allclose(coefficients(image), expected, atol=2e-3)


def test_a_window_has_the_coefficients_of_the_image():
    image = np.random.default_rng(1).uniform(0, 255, (70, 83)).astype(np.float32)
    inner = slice(TAPS_RADIUS_PX, -TAPS_RADIUS_PX)
    window = coefficients(image[11:62, 9:80])[inner, inner]
    np.testing.assert_array_equal(window, coefficients(image)[11:62, 9:80][inner, inner])
    # Where the image ends, a window that ends there is the image's, too.
    np.testing.assert_array_equal(
        coefficients(image[:40])[:-TAPS_RADIUS_PX], coefficients(image)[: 40 - TAPS_RADIUS_PX]
    )


@pytest.mark.parametrize("t", [0.0, 0.25, 0.7, 1.0])
def test_weights_and_slopes_are_those_of_the_basis(t):
    basis = interpolate.BSpline.basis_element([-2, -1, 0, 1, 2], extrapolate=False)
    at = t - np.arange(-1, 3)
    np.testing.assert_allclose(weights(np.float32(t)), np.nan_to_num(basis(at)), atol=1e-6)
    np.testing.assert_allclose(slopes(np.float32(t)), np.nan_to_num(basis.derivative()(at)), atol=1e-6)


def test_value_and_gradient_are_those_of_scipy():
    rng = np.random.default_rng(2)
    image = rng.uniform(0, 255, (40, 50)).astype(np.float32)
    spline, exact = coefficients(image), interpolate.RectBivariateSpline(np.arange(40), np.arange(50), image, s=0)
    for x, y in rng.uniform(12, 27, (20, 2)).astype(np.float32):
        found = value_and_gradient(spline, x, y)
        wanted = [exact(y, x, dx=dy, dy=dx)[0, 0] for dx, dy in ((0, 0), (1, 0), (0, 1))]
        # SciPy's ends are others, which shows by the pole, .268, to the power of the distance.
        np.testing.assert_allclose(found, wanted, atol=0.02)
