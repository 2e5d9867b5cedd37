"""Features: positions as COLMAP counts them, at every size; masks hold; descriptors are COLMAP's bytes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.imaging import features
from rille.stages.imaging.features import extract, features_stage, grey_bytes, match


def texture(rows: int, cols: int) -> np.ndarray:
    """Smoothed noise (row, col), 0..255."""
    field = sum(
        scale * cv2.GaussianBlur(np.random.default_rng(k).normal(size=(rows, cols)), (0, 0), scale)
        for k, scale in enumerate((1.5, 3.0, 6.0))
    )
    return np.clip(128 + 45 * field / field.std(), 0, 255).astype(np.uint8)


SMALL = texture(240, 320)


def everywhere(image: np.ndarray) -> Bundle:
    return extract(image, np.ones(image.shape, np.uint8))


def matched(a: Bundle, b: Bundle) -> tuple[np.ndarray, np.ndarray]:
    """Points of both that match."""
    rows, cols = match(*(np.asarray(x["descriptors"], np.float32) for x in (a, b))).T
    return a["points"][rows], b["points"][cols]


def test_the_stage_keeps_to_its_declaration_and_repeats_bit_by_bit() -> None:
    image = Bundle({"image": SMALL, "valid": np.ones_like(SMALL)}, {})
    out, again = (features_stage.run(features_stage.params(), {}, {"image": image}) for _ in range(2))
    check_outputs(features_stage, out)
    for name, array in out.arrays.items():
        np.testing.assert_array_equal(array, again[name])
    lengths = np.linalg.norm(out["descriptors"].astype(float), axis=1)
    assert np.abs(lengths - 512).max() < 20
    blank = everywhere(np.full((240, 320), 80, np.uint8))
    check_outputs(features_stage, blank)
    assert len(blank["points"]) == 0


def test_features_keep_away_from_what_is_masked() -> None:
    valid = np.ones(SMALL.shape, np.uint8)
    valid[:, 100:] = 0
    dark = np.where(valid, SMALL, 0).astype(np.uint8)
    whole, masked = everywhere(dark)["points"], extract(dark, valid)["points"]
    assert 20 < len(masked) < len(whole)
    assert whole[:, 0].max() > 100  # the edge itself has features, were it not for the mask
    assert masked[:, 0].max() < 100 - 3 * 0.8  # SIFT's smallest scale in a doubled image
    assert len(extract(dark, np.zeros_like(valid))["points"]) == 0


def test_the_first_pixel_of_matched_points_is_at_zero() -> None:
    a = everywhere(SMALL)
    left, right = features.matched_points(a, everywhere(np.roll(SMALL, 7, axis=1)))
    assert np.median(right - left, axis=0) == pytest.approx([7.0, 0.0], abs=0.01)
    places = {tuple(point) for point in np.round(np.asarray(a["points"], np.float64) - 0.5, 3)}
    assert {tuple(point) for point in np.round(left, 3)} <= places


@pytest.mark.parametrize("size", [1, 2, 8])
def test_the_first_pixel_s_centre_is_at_one_half(size: int) -> None:
    """A blob about pixel (row 60, column 100), in images that are doubled, halved, and reduced and halved."""
    rows, cols = np.mgrid[: 240 * size, : 320 * size]
    row, col, sigma = 60 * size, 100 * size, 4.0 * size
    image = 40 + 150 * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / (2 * sigma**2))
    points = everywhere(image.astype(np.float32))["points"]
    assert np.abs(points - (col + 0.5, row + 0.5)).max() < 0.05 * size


def test_a_reduced_image_gives_positions_of_the_full_one(monkeypatch: pytest.MonkeyPatch) -> None:
    twice = cv2.resize(SMALL, (640, 480), interpolation=cv2.INTER_CUBIC)
    small = everywhere(SMALL)
    monkeypatch.setattr(features, "MAX_IMAGE_SIDE", 320)
    a, b = matched(small, everywhere(twice))
    assert len(a) > 50
    # COLMAP's (0, 0) is the corner of the image, so that a doubled image doubles positions
    assert np.abs(np.median(b - 2 * a, axis=0)).max() < 0.1


def test_a_shifted_image_shifts_its_features() -> None:
    """By three eighths of a pixel, which halving must not lose."""
    large = texture(480, 640)
    shift = np.array([[1.0, 0.0, 0.375], [0.0, 1.0, 0.0]])
    a, b = matched(everywhere(large), everywhere(cv2.warpAffine(large, shift, (640, 480), flags=cv2.INTER_CUBIC)))
    assert len(a) > 200
    assert np.abs(np.median(b - a, axis=0) - (0.375, 0)).max() < 0.05


def test_only_a_small_image_is_doubled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "MAX_FEATURES", 10_000)
    large, counts = cv2.resize(SMALL, (640, 480)), []
    for limit in (SMALL.size, SMALL.size - 1, large.size):
        monkeypatch.setattr(features, "MAX_DOUBLED_PIXELS", limit)
        counts.append([len(everywhere(image)["points"]) for image in (SMALL, large)])
    assert counts[0][0] > counts[1][0]
    assert counts[0][1] == counts[1][1] != counts[2][1]


def test_the_features_of_most_contrast_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    faint = SMALL.copy()
    faint[:, 160:] = 128 + (faint[:, 160:] - 128.0) / 4
    monkeypatch.setattr(features, "MAX_FEATURES", 40)
    few = everywhere(faint)["points"]
    assert len(few) == 40
    assert few[:, 0].max() < 170


def test_grey_of_each_kind() -> None:
    assert grey_bytes(np.array([[0, 257, 65535]], np.uint16)).tolist() == [[0, 1, 255]]
    assert grey_bytes(np.array([[-3.0, 1.6, 300.0, np.nan]], np.float32)).tolist() == [[0, 2, 255, 0]]
    assert grey_bytes(np.array([[7]], np.uint8)).tolist() == [[7]]


def test_of_two_features_that_look_alike_to_the_last_bit_neither_matches() -> None:
    values = np.random.default_rng(0).integers(0, 90, (6, 128)).astype(np.float32)
    values = np.rint(values * (512 / np.linalg.norm(values, axis=1, keepdims=True)))
    twice = np.concatenate([values, values[:1]])
    others = [[k, k] for k in range(1, 6)]
    assert match(values, values).tolist() == [[0, 0], *others]
    assert match(twice, values).tolist() == match(values, twice).tolist() == others
