import numpy as np

from rille.stages.geometry.cubic import cubic


def weights(t):
    """Catmull-Rom: cubics through their samples, with the slope of the chord between the neighbours."""
    return 0.5 * np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]]) @ t ** np.arange(4)


def test_the_value_is_that_of_the_definition():
    rng = np.random.default_rng(5)
    image = (255 * rng.random((12, 15))).astype(np.float32)
    for x, y in np.stack([rng.uniform(3, 12.99, 200), rng.uniform(3, 9.99, 200)], 1).astype(np.float32):
        i, j = int(x), int(y)
        expected = weights(y - j) @ image[j - 1 : j + 3, i - 1 : i + 3] @ weights(x - i)
        np.testing.assert_allclose(cubic(image, x, y), expected, atol=1e-3)
    assert cubic(image, 4.0, 7.0) == image[7, 4]
