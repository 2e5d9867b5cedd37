"""Masks of cameras: which pixels they leave, whatever their scale, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from folders import SIZE, write_sequence
from raising import raises

from rille.datasets.images.masks import usable
from rille.datasets.registry import open_sequence
from rille.pipeline.commands.sequences.mask import mask

DARK = np.s_[30:, :]
"""Rows of a mask that leave out a body at the bottom."""


def sequence(folder, mask, sides=("left", "right"), **more):
    """Three frames, with one mask for the cameras ``sides``."""
    lines = "\n".join(f'{side} = "mask.png"' for side in sides)
    path = write_sequence(folder, f"[masks]\n{lines}\n", **more)
    assert cv2.imwrite(str(folder / "mask.png"), mask)
    return open_sequence(str(path))


def body(value=255, shape=SIZE[::-1]):
    mask = np.full(shape, value, np.uint8)
    mask[DARK] = 0
    return mask


@pytest.mark.parametrize("sides", [("left", "right"), ("right",)])
def test_a_mask_leaves_out_what_is_dark(tmp_path, materialise, sides):
    s = sequence(tmp_path, body(), sides)
    for side in ("left", "right"):
        seen = materialise(s.image(1, side))
        wanted = body(1) if side in sides else np.ones(SIZE[::-1])
        np.testing.assert_array_equal(seen["valid"], wanted)
        np.testing.assert_array_equal(seen["image"], int(side == "right") + 2)
    assert sum("37.5 % of the" in note for note in s.notes) == len(sides)


def test_a_mask_that_leaves_less_than_half_may_be_the_wrong_way_round(tmp_path):
    (line,) = sequence(tmp_path, 255 - body(), ("left",)).warnings
    assert line.startswith("RIL-909")
    assert "62.5 % of the left" in line


def test_a_mask_that_leaves_out_nothing_may_be_drawn_in_its_transparency(tmp_path):
    (line,) = sequence(tmp_path, np.dstack([np.full_like(body(), 255)] * 3 + [body()]), ("left",)).warnings
    assert line.startswith("RIL-799")


@pytest.mark.parametrize("scale", [1, 255, 65535])
def test_any_scale_means_the_same(scale):
    drawn = body(1).astype(np.uint16) * scale
    np.testing.assert_array_equal(usable(drawn), body() > 0)


def test_traces_of_compression_are_dark():
    drawn = body()
    drawn[40, :] = 9
    np.testing.assert_array_equal(usable(drawn), body() > 0)


def test_a_mask_that_somebody_drew_is_not_overwritten(tmp_path):
    (tmp_path / "mask_right.png").write_bytes(b"drawn")
    with raises("RIL-038", "mask_right.png"):
        mask("mockup-short", output=tmp_path)


def test_a_folder_without_a_manifest_is_told_how_to_get_one(tmp_path, capsys):
    rng, folder = np.random.default_rng(1), tmp_path / "my drive"
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        bonnet = cv2.GaussianBlur(rng.integers(0, 255, (48, 192)).astype(np.uint8), (0, 0), 2)
        for k in range(6):
            scene = cv2.GaussianBlur(rng.integers(0, 255, (96, 192)).astype(np.uint8), (0, 0), 2)
            assert cv2.imwrite(str(folder / side / f"{k}.png"), np.vstack([scene, bonnet]))
    (folder / "calib.txt").write_text("90 0 95.5 0 0 90 71.5 0 0 0 1 0\n90 0 95.5 -9 0 90 71.5 0 0 0 1 0\n")
    mask(str(folder), output=tmp_path)
    assert f"rille init '{folder}' --force writes one" in capsys.readouterr().out
    for k in range(1, 6):  # the left camera stands, and nothing is written
        cv2.imwrite(str(folder / "left" / f"{k}.png"), cv2.imread(str(folder / "left" / "0.png"), 0))
    with raises("RIL-910", "100 % of the left images", "stood"):
        mask(str(folder), output=tmp_path / "standing")
    assert not (tmp_path / "standing").exists()


def test_a_mask_that_changed_since_is_refused(tmp_path, materialise):
    s = sequence(tmp_path, body())
    source = s.image(0, "left")
    assert cv2.imwrite(str(tmp_path / "mask.png"), body(200))
    with raises("RIL-177", "mask.png"):
        materialise(source)


@pytest.mark.parametrize(
    ("mask", "code"),
    [(body(shape=(24, 64)), "RIL-904"), (body(0), "RIL-905"), (np.pad([[255]], ((0, 47), (0, 63))), "RIL-905")],
)
def test_masks_that_do_not_fit_are_refused(tmp_path, mask, code):
    with raises(code, "masks.left"):
        sequence(tmp_path, mask.astype(np.uint8))


def test_masks_of_a_lens_are_of_the_images_as_taken(tmp_path, materialise):
    cameras = "[cameras]\nfx = 60.0\ncx = 31.5\ncy = 23.5\ndistortion = [0.1, 0, 0, 0]\n"
    s = sequence(tmp_path, body(), cameras=cameras)
    np.testing.assert_array_equal(materialise(s.image(0, "left"))["valid"], body(1))
