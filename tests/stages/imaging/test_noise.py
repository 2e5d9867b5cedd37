"""Noise of an image: found beside texture, and not found where there is only texture."""

import numpy as np
import pytest
from matching_scenes import Texture

from rille.stages.imaging import noise
from rille.stages.imaging.pyramid import PyramidParams, build


def found(image, valid=None):
    return build(image, PyramidParams(), valid).noise


def textured(shape=(200, 260)):
    y, x = np.indices(shape, dtype=np.float64)
    return Texture(0)(x, y)


@pytest.mark.parametrize("deviation", [1.5, 3.0, 8.0])
@pytest.mark.parametrize("scene", ["flat", "ramp", "partly textured"])
def test_white_noise_is_measured_beside_texture(scene, deviation):
    y, x = np.indices((200, 260), dtype=np.float64)
    image = {"flat": 0 * x + 90, "ramp": x / 2 + y / 3, "partly textured": np.where(x < 60, textured(), 90.0)}[scene]
    noisy = image + np.random.default_rng(0).normal(0, deviation, image.shape)
    assert found(noisy) == pytest.approx(deviation, rel=0.05 if scene != "partly textured" else 0.15)


def test_texture_hides_noise_and_never_adds_to_it():
    noisy = textured() + np.random.default_rng(0).normal(0, 2.0, (200, 260))
    assert found(noisy) < 2.1


def test_texture_alone_is_no_noise():
    assert found(textured()) < 0.2
    assert found(np.rint(textured()).astype(np.uint8)) < 0.5


def test_masked_blocks_take_no_part():
    image = np.full((200, 260), 90.0) + np.random.default_rng(1).normal(0, 2.0, (200, 260))
    valid = np.ones(image.shape, np.uint8)
    image[:, 130:], valid[:, 130:] = 0.0, 0
    assert found(image, valid) == pytest.approx(2.0, rel=0.1)
    assert found(image, np.zeros_like(valid)) == 0.0


def test_little_images_have_none():
    rng = np.random.default_rng(2)
    assert found(rng.normal(90, 5, (30, 40))) == 0.0
    assert noise.standard_deviation([rng.normal(90, 5, (90, 90))], [np.ones((90, 90))]) == 0.0


def test_noise_of_a_large_image():
    image = np.random.default_rng(3).normal(90, 4.0, (2048, 2048))
    assert found(image) == pytest.approx(4.0, rel=0.05)


def test_noise_halves_from_level_to_level():
    pyramid = build(np.random.default_rng(4).normal(90, 4.0, (256, 256)), PyramidParams())
    above = pyramid.above(1)
    assert above.images[0] is pyramid.images[1]
    assert above.noise == pytest.approx(noise.standard_deviation(above.images, above.valid), rel=0.15)
