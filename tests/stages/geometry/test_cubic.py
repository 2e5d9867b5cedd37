import numpy as np

from rille.stages.geometry.cubic import cubic
from rille.stages.hfvm.images.resample import sample_cubic


def test_the_value_is_that_with_derivatives_to_the_bit():
    rng = np.random.default_rng(5)
    image = (255 * rng.random((12, 15))).astype(np.float32)
    for x, y in np.stack([rng.uniform(1, 12.99, 200), rng.uniform(1, 9.99, 200)], 1):
        assert cubic(image, x, y) == sample_cubic(image, np.float32(x), np.float32(y))[0]
    assert cubic(image, 4.0, 7.0) == image[7, 4]
