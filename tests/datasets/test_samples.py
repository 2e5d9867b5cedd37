"""What some images of a sequence show when it is opened: mosaics of colours, unlike orientations, few bits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from folders import write_sequence
from PIL import Image
from raising import raises

from rille.datasets.images.patterns import fixed_pattern, mixed
from rille.datasets.images.samples import interlaced, mosaic
from rille.datasets.registry import open_sequence


def coloured(seed=3, shape=(160, 192)):
    """Colours (row, col, 3) that vary slowly, with texture."""
    random = np.random.default_rng(seed)
    slow = cv2.resize(random.random((5, 6, 3)).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(200 * slow + 40 * random.random(shape)[..., None], 0, 255).astype(np.uint8)


def filtered(image, pattern):
    """What a sensor under colour filters takes of an image."""
    out = np.empty(image.shape[:2], image.dtype)
    for k, letter in enumerate(pattern):
        out[k // 2 :: 2, k % 2 :: 2] = image[k // 2 :: 2, k % 2 :: 2, "rgb".index(letter)]
    return out


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("scale", [1, 16])
def test_a_mosaic_of_colours_is_told_from_grey_images(pattern, scale):
    image = coloured()
    assert mosaic(filtered(image, pattern).astype(np.uint16 if scale > 1 else np.uint8) * scale)
    assert not mosaic(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


@pytest.mark.parametrize(
    "image",
    [
        np.random.default_rng(1).integers(0, 255, (200, 200)),
        np.indices((200, 200)).sum(0) // 8 % 2 * 255,  # a board
        np.repeat(np.repeat(np.random.default_rng(2).integers(0, 255, (100, 100)), 2, 0), 2, 1),  # enlarged
        100 + np.indices((200, 200))[0] % 2 * 20,  # rows of two fields
        100 + np.indices((200, 200))[1] % 2 * 20,  # columns of two amplifiers
        np.zeros((200, 200), int),
        np.random.default_rng(1).integers(0, 255, (40, 40)),  # too few blocks to tell
    ],
)
def test_noise_and_patterns_of_other_kinds_are_no_mosaic(image):
    assert not mosaic(image.astype(np.uint8))


def test_a_mosaic_is_said_when_it_is_opened(tmp_path):
    path = write_sequence(tmp_path, frames=2)
    for k, image in enumerate(sorted(tmp_path.glob("*/*.png"))):
        cv2.imwrite(str(image), filtered(coloured(k), "rggb"))
    assert sum("RIL-826" in line for line in open_sequence(str(path)).warnings) == 2


def of_two_moments(image, motion):
    """Every other row of an image is of a moment at which everything has moved by (column, row)."""
    later = np.roll(image, motion[::-1], (0, 1))
    return np.where(np.indices(image.shape)[0] % 2, later, image)


@pytest.mark.parametrize("motion", [(4, 0), (0, 4), (9, 3)])
def test_rows_of_two_moments_are_told_from_scenes(motion):
    image = cv2.GaussianBlur(np.random.default_rng(4).random((160, 192)).astype(np.float32) * 255, (0, 0), 1.5)
    assert interlaced(of_two_moments(image, motion))
    noise = np.random.default_rng(1).integers(0, 255, (200, 200))
    for other in (image, of_two_moments(image.T, motion).T, noise, filtered(coloured(), "rggb"), np.zeros((200, 200))):
        assert not interlaced(other)


def test_rows_of_two_moments_are_said_when_they_are_opened(tmp_path):
    path = write_sequence(tmp_path, frames=2)
    for image in sorted(tmp_path.glob("*/*.png")):
        grey = cv2.cvtColor(cv2.GaussianBlur(coloured(), (0, 0), 1.5), cv2.COLOR_RGB2GRAY)
        cv2.imwrite(str(image), of_two_moments(grey, (5, 0)))
    assert sum("RIL-832" in line for line in open_sequence(str(path)).warnings) == 2


@pytest.mark.parametrize("across", [(1, 192), (160, 1), (160, 192)], ids=["columns", "rows", "pixels"])
def test_noise_that_keeps_its_place_is_told_from_scenes_that_move_or_rest(tmp_path, across):
    random = np.random.default_rng(5)
    scene = cv2.GaussianBlur(random.random((160, 300)).astype(np.float32), (0, 0), 1.5) * 600 - 180
    pattern = random.normal(0, 15, across)
    moving = [scene[:, 20 * k : 20 * k + 192] + random.normal(0, 2, (160, 192)) for k in range(3)]
    assert fixed_pattern([image + pattern for image in moving]) > 0.4
    assert max(map(fixed_pattern, (moving, [moving[0]] * 3, [0 * moving[0]] * 3, moving[:2]))) < 0.05
    path = write_sequence(tmp_path, frames=3)
    for side in ("left", "right"):
        for image, name in zip(moving, sorted((tmp_path / side).glob("*.png")), strict=True):
            cv2.imwrite(str(name), np.clip(image + (side == "left") * pattern, 0, 255).astype(np.uint8))
    (line,) = [line for line in open_sequence(str(path)).warnings if "RIL-833" in line]
    assert "left images" in line


def test_hot_pixels_in_the_dark_are_told_from_a_camera_that_stands():
    random = np.random.default_rng(5)
    scene = cv2.GaussianBlur(random.random((160, 300)).astype(np.float32), (0, 0), 1.5) * 60
    moving = [scene[:, 20 * k : 20 * k + 192] + random.normal(0, 2, (160, 192)) for k in range(3)]
    hot = random.random((160, 192)) < 0.004
    assert fixed_pattern([np.where(hot, 255, image) for image in moving]) > 0.4
    assert fixed_pattern([np.where(hot, 255, moving[0] + random.normal(0, 1, hot.shape)) for _ in range(3)]) < 0.05


@pytest.mark.parametrize(("share", "noise", "step", "told"), [(1, 2, 20, True), (0, 2, 20, False), (1, 25, 0, False)])
def test_a_reflection_over_all_of_the_view_is_told_from_scenes_that_move_or_rest(tmp_path, share, noise, step, told):
    random = np.random.default_rng(5)
    scene, window = (cv2.GaussianBlur(random.random((160, 300)), (0, 0), 1.5) * 300 for _ in range(2))
    views = [scene[:, step * k : step * k + 192] + share * window[:, :192] for k in range(3)]
    path = write_sequence(tmp_path, frames=3)
    for side in ("left", "right"):
        for image, name in zip(views, sorted((tmp_path / side).glob("*.png")), strict=True):
            cv2.imwrite(str(name), np.clip(image - 100 + random.normal(0, noise, image.shape), 0, 255).astype(np.uint8))
    assert sum("RIL-834" in line for line in open_sequence(str(path)).warnings) == (2 if told else 0)


@pytest.mark.parametrize("period", [0, 2, 4])
@pytest.mark.parametrize("step", [0, 2, 20])
def test_sums_of_neighbours_are_told_from_views_of_their_own(tmp_path, period, step):
    random = np.random.default_rng(5)
    scene = cv2.GaussianBlur(random.random((160, 400)), (0, 0), 1.5) * 600 - 180
    views = [scene[:, step * k : step * k + 192] + random.normal(0, 2, (160, 192)) for k in range(9)]
    sums = range(2, 8, period) if period else ()
    shown = [(views[k - 1] + views[k + 1]) / 2 if k in sums else view for k, view in enumerate(views)]
    assert mixed([cv2.resize(view, (4000, 64)) for view in shown]) == []  # a strip has no blocks
    told = mixed(shown)
    assert told == (list(sums) if step else [])
    path = write_sequence(tmp_path, frames=9)
    for side in ("left", "right"):
        for image, name in zip(shown, sorted((tmp_path / side).glob("*.png")), strict=True):
            cv2.imwrite(str(name), np.clip(image, 0, 255).astype(np.uint8))
    assert any("RIL-836" in line for line in open_sequence(str(path)).warnings) == bool(told)


def turned(folder, tags, ending="jpg"):
    path = write_sequence(folder, frames=2)
    path.write_text(path.read_text().replace(".png", f".{ending}"))
    for side, tag in tags.items():
        for k in range(2):
            exif = Image.Exif()
            if tag:
                exif[0x0112] = tag
            Image.new("L", (64, 48), 90 + k).save(folder / side / f"{k:02d}.{ending}", exif=exif)
    return path


@pytest.mark.parametrize("ending", ["jpg", "png", "tif"])
@pytest.mark.parametrize("tags", [(1, 3), (None, 3), (6, 8), (1, 2)])
def test_unlike_orientations_are_refused(tmp_path, tags, ending):
    with raises("RIL-828", "auto-orient"):
        open_sequence(str(turned(tmp_path, dict(zip(("left", "right"), tags, strict=True)), ending)))


def test_a_damaged_tag_is_none(tmp_path):
    path = turned(tmp_path, {"left": 3, "right": 3})
    for image in tmp_path.glob("*/*.jpg"):
        data = bytearray(image.read_bytes())
        at = data.index(b"Exif")
        data[at + 10 : at + 24] = b"\xff" * 14
        image.write_bytes(data)
    assert open_sequence(str(path)).frames == 2


@pytest.mark.parametrize(("tag", "said"), [(None, 0), (0, 0), (1, 0), (3, 1), (6, 1), (99, 0)])
def test_like_orientations_are_ignored_and_said(tmp_path, tag, said):
    sequence = open_sequence(str(turned(tmp_path, {"left": tag, "right": tag})))
    assert sum("RIL-829" in line for line in sequence.warnings) == said


def test_images_of_few_bits_open_with_one_scale_for_both_cameras(tmp_path):
    path = write_sequence(tmp_path, frames=4)
    given = {}
    for k, image in enumerate(sorted(tmp_path.glob("*/*.png"))):
        given[image.parent.name, int(image.stem)] = (
            cv2.GaussianBlur(coloured(k)[..., 0], (0, 0), 2).astype(np.uint16) + 29_000
        )
        cv2.imwrite(str(image), given[image.parent.name, int(image.stem)])
    sequence = open_sequence(str(path))
    assert sum("RIL-827" in line for line in sequence.warnings) == 1
    sources = [sequence.image(k, camera) for k in range(4) for camera in ("left", "right")]
    assert len({source.args["levels"] for source in sources}) == 1
    black, gain = sources[0].args["levels"]
    from rille.datasets.images.files import image_stage

    out = image_stage.run(sources[3].params, {**sources[3].args, **sources[3].hints}, {})["image"]
    np.testing.assert_array_equal(out, (given["right", 1].astype(int) - black) * gain)


@pytest.mark.parametrize("ending", ["png", "tif", "pgm"])
@pytest.mark.parametrize("gain", [1, 16, 200])
def test_samples_with_their_bytes_exchanged_are_refused(tmp_path, ending, gain):
    path = write_sequence(tmp_path, frames=2)
    path.write_text(path.read_text().replace(".png", f".{ending}"))
    for swap, code in ((False, ""), (True, "RIL-830")):
        for k, image in enumerate(sorted(tmp_path.glob("*/*.png"))):
            samples = cv2.GaussianBlur(coloured(k)[..., 0], (0, 0), 2).astype(np.uint16) * gain + 3
            cv2.imwrite(str(image.with_suffix(f".{ending}")), samples.byteswap() if swap else samples)
        # Of fewer bits than eight no byte is exchanged with another.
        if code and gain > 1:
            with raises(code, "byteswap"):
                open_sequence(str(path))
        else:
            assert open_sequence(str(path)).frames == 2


def test_files_that_hold_several_images_are_refused(tmp_path):
    path = write_sequence(tmp_path, frames=1)
    path.write_text(path.read_text().replace("left/*.png", "left/*.tif"))
    images = [Image.new("L", (64, 48), shade) for shade in (90, 120)]
    images[0].save(tmp_path / "left" / "00.tif", save_all=True, append_images=images[1:])
    with raises("RIL-831", "several images"):
        open_sequence(str(path))
    cv2.imwritemulti(str(tmp_path / "left" / "00.tif"), [np.full((48, 64), k, np.uint8) for k in (90, 120)])
    with raises("RIL-831", "several images"):  # whose directories call them pages
        open_sequence(str(path))
    images[0].save(tmp_path / "left" / "00.tif", save_all=True, append_images=[Image.new("L", (32, 24))])
    assert open_sequence(str(path)).frames == 1  # a preview
