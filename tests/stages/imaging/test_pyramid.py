import cv2
import numpy as np
import pytest
from raising import raises
from scipy import ndimage

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.errors import InputError
from rille.stages.hfvm.image import as_given
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid, PyramidParams


def params(levels=6, min_side=1):
    return PyramidParams(levels=levels, min_side=min_side)


def test_means_by_hand_with_odd_sides_completed_by_their_edge():
    image = np.array([[0, 2, 10], [4, 6, 30], [8, 0, 50]], np.float32)
    first = pyramid.build(image, params(levels=2)).images[1]
    # (0+2+4+6)/4, (10+10+30+30)/4; last row twice: (8+0+8+0)/4, 50
    np.testing.assert_array_equal(first, [[3, 20], [4, 50]])


def test_levels_against_reduction_of_the_whole_image():
    image = np.random.default_rng(0).uniform(0, 255, (64, 96)).astype(np.float32)
    found = pyramid.build(image, params(levels=4))
    for n in range(4):
        k = 2**n
        expected = image.reshape(64 // k, k, 96 // k, k).mean((1, 3))
        np.testing.assert_allclose(found.images[n], expected, rtol=1e-6)


def test_coarse_pixel_lies_where_the_docstring_says():
    x = np.arange(64, dtype=np.float32)
    found = pyramid.build(np.tile(x + 10, (64, 1)), params(levels=4))
    for n, level in enumerate(found.images):
        at = (x + 0.5) / 2**n - 0.5
        inner = (at >= 0) & (at <= level.shape[1] - 1)
        values = ndimage.map_coordinates(level, [np.zeros(inner.sum()), at[inner]], order=1)
        np.testing.assert_allclose(values, x[inner] + 10, atol=1e-4)


def test_mask_needs_three_of_four_and_masked_grey_does_not_leak():
    image = np.full((4, 4), 10, np.float32)
    valid = np.ones((4, 4), np.uint8)
    valid[0, 0] = valid[0, 2] = valid[1, 3] = 0
    image[valid == 0] = 250
    found = pyramid.build(image, params(levels=3), valid)
    np.testing.assert_array_equal(found.valid[1], [[1, 0], [1, 1]])
    np.testing.assert_array_equal(found.images[1], [[10, 0], [10, 10]])
    assert found.valid[2][0, 0] == 1
    assert found.images[2][0, 0] == 10


def test_a_black_frame_stays_as_narrow_as_it_is():
    image = np.full((64, 64), 9, np.float32)
    image[:3] = image[:, :1] = 0
    narrow = []
    for mask in pyramid.build(image, params(levels=5)).valid:
        narrow.append((mask.shape[0] - int(mask[:, -1].sum()), mask.shape[1] - int(mask[-1].sum())))
    assert narrow == [(3, 1), (1, 0), (0, 0), (0, 0), (0, 0)]


def warped(image, degrees, method):
    middle = (0.5 * (image.shape[1] - 1), 0.5 * (image.shape[0] - 1))
    turn = cv2.getRotationMatrix2D(middle, degrees, 1.0)
    size = image.shape[::-1]
    return cv2.warpAffine(image, turn, size, flags=method), cv2.warpAffine(np.ones_like(image), turn, size)


def textured(shape=(120, 160), seed=0):
    rough = np.random.default_rng(seed).uniform(0, 1, shape)
    return (60 + 150 * ndimage.gaussian_filter(rough, 2) / 0.6).astype(np.float32)


@pytest.mark.parametrize("degrees", [1.5, 2.0, -3.0])
@pytest.mark.parametrize("method", [cv2.INTER_LINEAR, cv2.INTER_NEAREST])
def test_a_black_frame_and_what_is_mixed_with_it_are_masked(degrees, method):
    image, share = warped(textured(), degrees, method)
    found = pyramid.build(image, params(levels=1)).valid[0] != 0
    if method == cv2.INTER_NEAREST:
        np.testing.assert_array_equal(found, image > 0)
    else:
        assert share[found].min() > 0.99
        assert found.sum() > 0.95 * (share > 0.99).sum()


def test_what_is_dark_but_no_frame_is_kept():
    noisy = np.random.default_rng(1).integers(0, 4, (80, 90)).astype(np.float32)
    shadow, speck, sky = textured(), textured(), textured()
    shadow[:60, 20:70], speck[:2, 5:12], sky[:50] = 0, 0, 0
    for image in (noisy, shadow, speck, sky, np.zeros((40, 40), np.float32)):
        assert pyramid.frame(image, np.ones(image.shape, bool)) is None


def test_what_a_mask_leaves_out_is_no_frame():
    image, share = warped(textured(), 2.0, cv2.INTER_LINEAR)
    valid = share > 0.99
    found = pyramid.build(np.where(valid, image, 0), params(levels=1), valid)
    np.testing.assert_array_equal(found.valid[0] != 0, valid)


def test_filled_images_carry_no_edge_of_the_mask():
    image = np.full((32, 32), 100, np.float32)
    valid = np.ones((32, 32), np.uint8)
    valid[:, 20:] = 0
    for layer in as_given(pyramid.build(image, params(levels=4), valid), HfvmParams().weights).layers:
        np.testing.assert_array_equal(layer.grey, 100)


def test_sixteen_bits_scale_to_eight():
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    wide = image.astype(np.uint16) * 257
    for order in (wide, wide.astype(">u2")):
        np.testing.assert_allclose(
            pyramid.build(order, params()).images[0], pyramid.build(image, params()).images[0], rtol=1e-6
        )


def test_not_finite_pixels_are_masked():
    image = np.ones((4, 4), np.float32)
    image[1, 1] = np.nan
    found = pyramid.build(image, params())
    assert found.valid[0].sum() == 15
    assert np.isfinite(found.images[1]).all()


def test_number_of_levels_is_bounded_by_the_smaller_side():
    assert [a.shape for a in pyramid.build(np.zeros((35, 70), np.uint8), PyramidParams(min_side=8)).images] == [
        (35, 70),
        (18, 35),
        (9, 18),
    ]
    assert pyramid.build(np.zeros((1, 1), np.uint8), PyramidParams()).levels == 1


@pytest.mark.parametrize("image", [np.zeros((2, 2, 3), np.uint8), np.zeros((0, 4), np.uint8), np.zeros((2, 2), int)])
def test_refuses_what_is_no_grey_image(image):
    with pytest.raises(InputError):
        pyramid.build(image, PyramidParams())


def test_refuses_a_mask_of_another_size():
    with raises("RIL-413"):
        pyramid.build(np.zeros((4, 4), np.uint8), PyramidParams(), np.ones((4, 5), np.uint8))


def test_stage_gives_what_it_declares_and_reads_it_back():
    image = np.random.default_rng(0).integers(0, 255, (40, 50)).astype(np.uint8)
    bundle = pyramid.pyramid_stage.run(
        PyramidParams(), {}, {"image": Bundle({"image": image, "valid": np.ones((40, 50), np.uint8)}, {})}
    )
    check_outputs(pyramid.pyramid_stage, bundle)
    found = Pyramid.from_bundle(bundle)
    assert found.levels == 3
    np.testing.assert_array_equal(found.images[0], image)
