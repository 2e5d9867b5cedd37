"""Alignment of templates: known affine motions of a smooth texture; what is refused."""

import numpy as np
import pytest

from rille.stages.odometry.affine_lk import Templates, align


def texture(x, y, seed=0, wavelengths=(6.0, 40.0)):
    """Grey values at any position: waves no shorter than 6 pixels, so that cubic interpolation is good to 1 %."""
    rng = np.random.default_rng(seed)
    out = np.full(np.shape(x), 100.0)
    for _ in range(40):
        k = 2 * np.pi / rng.uniform(*wavelengths)
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        out = out + 6.0 * np.sin(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return out


def views(affinity, shift, gain=1.0, offset=0.0):
    """Images a and b of 160 x 120 with b(A p + shift) = gain a(p) + offset."""
    x, y = np.meshgrid(np.arange(160.0), np.arange(120.0))
    inverse = np.linalg.inv(affinity)
    px = inverse[0, 0] * (x - shift[0]) + inverse[0, 1] * (y - shift[1])
    py = inverse[1, 0] * (x - shift[0]) + inverse[1, 1] * (y - shift[1])
    return texture(x, y).astype(np.float32), (gain * texture(px, py) + offset).astype(np.float32)


POINTS = np.stack(np.meshgrid(np.arange(30.0, 110.0, 10.0), np.arange(30.0, 80.0, 10.0)), -1).reshape(-1, 2)


def run(a, b, start, affinity, **changes):
    shape = np.tile(affinity, (len(start), 1, 1))
    return align(a, b, Templates(POINTS, start, shape), **({"noise": 2.0, "spread": 0.1, "reach": 2.0} | changes))


@pytest.mark.parametrize(
    ("affinity", "gain", "offset"),
    [(np.eye(2), 1.0, 0.0), (np.eye(2) * 1.2, 1.0, 0.0), (np.array([[1.1, 0.15], [-0.05, 0.95]]), 1.2, -20.0)],
)
def test_known_motion_is_found(affinity, gain, offset):
    shift = np.array([1.3, 2.6])
    a, b = views(affinity, shift, gain, offset)
    truth = POINTS @ affinity.T + shift
    start = truth + np.random.default_rng(1).uniform(-0.7, 0.7, truth.shape)
    found = run(a, b, start, affinity + 0.03)  # the expected affinity is a little wrong
    assert np.isfinite(found).all(1).mean() > 0.95
    good = np.isfinite(found).all(1)
    # Interpolation error of 1 % of the contrast over its gradient, averaged over the template: well below 0.02 px.
    assert np.abs(found - truth)[good].max() < 0.02


def test_noise_gives_the_error_that_theory_says():
    shift = np.array([1.0, -2.0])  # whole pixels: interpolation does not smooth the noise
    a, b = views(np.eye(2), shift)
    sigma = 4.0
    noisy = (b + sigma * np.random.default_rng(2).standard_normal(b.shape)).astype(np.float32)
    truth = POINTS + shift
    found = run(a, noisy, truth, np.eye(2), noise=sigma, spread=1e-3)
    gy, gx = np.gradient(a)
    bound = sigma / np.sqrt(121 * np.array([np.mean(gx**2), np.mean(gy**2)]))  # Cramer-Rao of a shift alone
    rms = np.sqrt(np.nanmean((found - truth) ** 2, axis=0))
    assert (rms > 0.6 * bound).all()
    assert (rms < 1.6 * bound).all()  # correlation of the two gradients, gain and offset cost some


def test_refused_are_points_too_far_off_outside_lost_or_without_texture():
    a, b = views(np.eye(2), np.zeros(2))
    start = POINTS.copy()
    start[0] += 0.8
    found = run(a, b, start, np.eye(2), reach=0.5)
    assert np.isnan(found[0]).all()
    start[1], start[2] = np.nan, [2.0, 2.0]
    found = run(a, b, start, np.eye(2))
    assert np.isnan(found[1:3]).all()
    assert np.isfinite(found[3:]).all()
    flat = np.full_like(a, 90.0)
    assert np.isnan(run(flat, flat, POINTS, np.eye(2))).all()
