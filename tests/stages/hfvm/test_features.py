import numpy as np
from numba import njit
from scipy import ndimage

from rille.stages.hfvm import image as images
from rille.stages.hfvm.image import BAND_PASS, GAUSSIAN, HIGH_PASS, WIDE_BAND_PASS

WEIGHTS = (4.0, 4.0, 2.0, 2.0, 0.5, 0.5, 2.0, 1.0)


def image(shape=(30, 41), seed=0):
    return np.random.default_rng(seed).uniform(0, 255, shape).astype(np.float32)


def table_1(a):
    """Table 1 with scipy's convolution."""
    a = a.astype(np.float64)
    row = [ndimage.convolve1d(a, k, axis=1, mode="nearest") for k in (HIGH_PASS, BAND_PASS, WIDE_BAND_PASS)]
    col = [ndimage.convolve1d(a, k, axis=0, mode="nearest") for k in (HIGH_PASS, BAND_PASS, WIDE_BAND_PASS)]
    mean = ndimage.uniform_filter(a, 5, mode="nearest")
    deviation = np.sqrt(np.maximum(ndimage.uniform_filter(a * a, 5, mode="nearest") - mean * mean, 0))
    smooth = ndimage.convolve(a, np.array(GAUSSIAN, float), mode="nearest")
    both = [row[0] / 4, col[0] / 4, row[1] / 2, col[1] / 2, row[2] / 8, col[2] / 8, deviation, smooth / 56]
    return np.stack(both)


def unpack(words):
    return np.moveaxis(words.view(np.uint8).reshape(*words.shape, 8), -1, 0)


def test_kernels_are_those_of_the_table():
    assert sum(map(sum, GAUSSIAN)) == 56
    for kernel in (HIGH_PASS, BAND_PASS, WIDE_BAND_PASS):
        assert sum(kernel) == 0
        assert kernel == tuple(-k for k in kernel[::-1])


def test_planes_against_scipy():
    # float32 sums of at most 25 values below 255: 1e-3 is ten times their rounding.
    np.testing.assert_allclose(images.planes(image()), table_1(image()), atol=1e-3)


def test_high_pass_of_a_ramp_by_hand():
    ramp = np.tile(np.arange(20, dtype=np.float32), (20, 1))
    found = images.planes(ramp)[:, 10, 10]
    # convolution turns (2 1 0 -1 -2) over: 2*2 + 1 + 1 + 2*2 = 10 grey levels for slope one, over 4
    assert found[0] == 2.5
    assert found[1] == 0


def test_packed_bytes_are_the_rounded_signed_square_roots():
    words, deviation = images.pack(image(), WEIGHTS)
    planes = table_1(image())
    scale = 2 * np.array(WEIGHTS)[:, None, None]
    exact = np.clip(128 + np.sign(planes) * np.sqrt(np.abs(planes)) * scale, 0, 255)
    # Half a step of rounding, and the float32 error of a small feature under the root.
    assert np.abs(unpack(words) - exact).max() <= 0.5 + 0.1
    np.testing.assert_allclose(deviation, planes[6], atol=2e-3)


def test_flat_image_has_the_middle_byte_and_no_deviation():
    words, deviation = images.pack(np.full((9, 9), 200, np.float32), WEIGHTS)
    assert (unpack(words)[:6] == 128).all()
    assert (deviation == 0).all()


def test_mirrored_image_mirrors_the_row_features():
    a = image()
    mirrored = images.planes(a[:, ::-1])[:, :, ::-1]
    np.testing.assert_allclose(mirrored[[0, 2, 4]], -images.planes(a)[[0, 2, 4]], atol=1e-4)
    np.testing.assert_allclose(mirrored[[1, 3, 5, 6, 7]], images.planes(a)[[1, 3, 5, 6, 7]], atol=1e-3)


def test_distance_of_words_is_the_sum_of_absolute_byte_differences():
    @njit
    def each(a, b, out):
        for i in range(len(a)):
            out[i] = images.distance(a[i], b[i])

    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 500, 8)).astype(np.uint8)
    a[0], b[0] = 255, 0
    out = np.zeros(500, np.int64)
    each(a.view(np.uint64).ravel(), b.view(np.uint64).ravel(), out)
    np.testing.assert_array_equal(out, np.abs(a.astype(int) - b.astype(int)).sum(1))
    assert out[0] == 8 * 255
