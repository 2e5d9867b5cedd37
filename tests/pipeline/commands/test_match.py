"""``rille match``: files in, two-band disparity out; confidence, progress, warnings; one line where it fails."""

import io
import os

import cv2
import numpy as np
import pytest
import rasterio
from raising import raises

from rille.pipeline.cli import main
from rille.pipeline.commands.sequences import match as command
from rille.stages.core.validity import Validity

SHIFT = -9.0


def texture(shape=(96, 140), seed=0):
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.uniform(0, 255, shape), (0, 0), 1.6)
    return np.clip(128 + 45 * (image - image.mean()) / image.std(), 0, 255).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    """A left and a right image, the right one's content 9 columns to the left."""
    wide = texture((96, 160))
    cv2.imwrite(str(tmp_path / "left.png"), wide[:, :140])
    cv2.imwrite(str(tmp_path / "right.png"), wide[:, 9:149])
    return tmp_path


def run(folder, left="left.png", right="right.png", **options):
    options.setdefault("output", folder / "out.tif")
    return command.match(folder / left, folder / right, **options)


def columns(path):
    with rasterio.open(path) as file:
        return file.read(1)


def test_a_parameter_that_is_set_overrides_the_preset(folder):
    made = [{"preset": "fast"}, {"preset": "accurate", "assignments": ("hfvm.preset=fast",)}, {}]
    files = []
    for options in made:
        run(folder, **options)
        files.append((folder / "out.tif").read_bytes())
    assert files[0] == files[1] != files[2]


def test_writes_two_named_bands_and_says_what_it_found(folder, capsys):
    assert run(folder) == 0
    with rasterio.open(folder / "out.tif") as file:
        assert file.descriptions == ("column_disparity", "row_disparity")
        assert file.units == ("pixel", "pixel")
        assert file.tags()["LEFT"] == "left.png"
        column, row = file.read()
    ok = np.isfinite(column)
    assert ok.mean() > 0.8
    assert np.median(column[ok]) == pytest.approx(SHIFT, abs=0.05)
    assert np.median(np.abs(row[ok])) < 0.05
    out = capsys.readouterr()
    assert "matched" in out.out
    assert "standard deviation 0.1" in out.out
    assert out.err == ""


def test_confidence_has_three_bands_that_fit_the_disparity(folder):
    run(folder, confidence=folder / "sure.tif")
    column = columns(folder / "out.tif")
    with rasterio.open(folder / "sure.tif") as file:
        assert file.descriptions == ("disparity_std", "validity", "backmatch_error")
        assert "1 matched" in file.tags()["VALIDITY"]
        std, validity, error = file.read()
    bits = validity.astype(np.uint8)
    np.testing.assert_array_equal(bits, validity)
    ok = (bits & Validity.MATCHED) != 0
    np.testing.assert_array_equal(ok, np.isfinite(column))
    np.testing.assert_array_equal(ok, np.isfinite(std))
    assert (error[ok] <= 1).all()


@pytest.mark.parametrize("name", ["--output", "--confidence"])
def test_an_output_that_cannot_be_written_is_named(folder, name, monkeypatch):
    (folder / "file").write_text("")
    out = {"--output": "out.tif", "--confidence": "sure.tif"} | {name: "file/here.tif"}
    before = sorted(folder.iterdir())
    with raises("RIL-746", f"{folder / 'file'} is no folder", name):
        run(folder, output=folder / out["--output"], confidence=folder / out["--confidence"])
    assert sorted(folder.iterdir()) == before
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with raises("RIL-746", f"{folder} may not be written"):
        run(folder, output=folder / "new" / "out.tif")


def test_outputs_that_cannot_be_are_refused_before_matching(folder):
    (folder / "results.tif").mkdir()
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}

    def refused(code, *words, output="out.tif", **options):
        with raises(code, *words):
            run(folder, output=folder / output, **options)

    refused("RIL-043", "--confidence and --output", confidence=folder / "out.tif")
    refused("RIL-047", "results.tif is a folder", output="results.tif")
    refused("RIL-047", "is a folder", output=".")
    refused("RIL-047", "is a folder", confidence=folder)
    refused("RIL-871", ".tif or .tiff", output="out.npy")
    (folder / "left.png").rename(folder / "left.tif")
    with raises("RIL-043", "an image"):
        run(folder, "left.tif", output=folder / "left.tif")
    (folder / "left.tif").rename(folder / "left.png")
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


@pytest.mark.parametrize("deep", [("left.png", "right.png"), ("left.png",)])
def test_images_of_16_bits_that_use_a_small_part_of_them_are_spread(folder, capsys, deep):
    for name in deep:
        image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / name), image.astype(np.uint16) * 4 + (len(deep) - 1) * 29_000)
    run(folder)
    shown = capsys.readouterr()
    assert "RIL-705" in shown.err
    assert float(shown.out.split("matched ")[1].split(" %")[0]) > 50


def test_images_in_either_order_are_matched_without_a_word(folder, capsys):
    for images, shift in ((("left.png", "right.png"), SHIFT), (("right.png", "left.png"), -SHIFT)):
        run(folder, *images)
        assert capsys.readouterr().err == ""
        assert np.nanmedian(columns(folder / "out.tif")) == pytest.approx(shift, abs=0.05)


def test_a_mostly_blank_pair_says_why_little_matches(folder, capsys):
    for side in ("left", "right"):
        image = cv2.imread(str(folder / f"{side}.png"), cv2.IMREAD_GRAYSCALE)
        image[40:] = 255
        cv2.imwrite(str(folder / f"{side}.png"), image)
    assert run(folder) == 0
    out, err = capsys.readouterr()
    assert err.startswith("rille: warning")
    assert "% of the pixels have no texture" in err
    assert float(out.split("matched ")[1].split(" ")[0]) > 20


@pytest.mark.parametrize("what", ["other", "black", "white", "noise"])
def test_unrelated_images_give_an_almost_empty_file_and_one_warning(folder, capsys, what):
    image = {
        "other": texture(seed=5),
        "black": np.zeros((96, 140), np.uint8),
        "white": np.full((96, 140), 255, np.uint8),
        "noise": np.random.default_rng(2).integers(0, 256, (96, 140)).astype(np.uint8),
    }[what]
    cv2.imwrite(str(folder / "right.png"), image)
    if what in ("black", "white"):
        cv2.imwrite(str(folder / "left.png"), image)
    assert run(folder) == 3
    column = columns(folder / "out.tif")
    assert np.isfinite(column).mean() <= 0.05
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "of the pixels match" in err
    assert ("texture" in err) == (what in ("black", "white"))


def test_colour_sixteen_bits_sizes_and_one_pixel(folder):
    left = cv2.imread(str(folder / "left.png"), 0)
    right = cv2.imread(str(folder / "right.png"), 0)
    cv2.imwrite(str(folder / "colour.png"), cv2.merge([left] * 3))
    cv2.imwrite(str(folder / "deep.png"), right[:, :120].astype(np.uint16) * 257)
    assert run(folder, "colour.png", "deep.png") == 0
    column = columns(folder / "out.tif")
    assert column.shape == (96, 140)
    assert np.nanmedian(column) == pytest.approx(SHIFT, abs=0.05)
    cv2.imwrite(str(folder / "pixel.png"), left[:1, :1])
    assert run(folder, "pixel.png", "pixel.png") == 3
    assert columns(folder / "out.tif").shape == (1, 1)


def test_command_line_has_it_all(folder, capsys):
    files = [str(folder / name) for name in ("left.png", "right.png", "out.tif", "sure.tif")]
    line = ["match", *files[:2], "-o", files[2], "--confidence", files[3], "--preset", "paper", "--dense"]
    for arguments, code in (
        (line, 0),
        (["match", *files[:2], "-o", files[2], "--preset", "quick"], 2),
        (["match", files[0], str(folder / "gone.png"), "-o", files[2]], 2),
    ):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == code
    assert "gone.png" in capsys.readouterr().err


def test_progress_is_a_bar_on_a_terminal_for_large_pairs(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(command.sys, "stderr", stream)
    with command._progress(1_000_000) as tell:
        tell(0.5, "level 0")
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    with command._progress(999_999) as tell:
        tell(0.5, "level 0")
    assert not stream.getvalue()
    with command._progress(1_000_000) as tell:
        tell(0.5, "level 0")
    assert "level 0" in stream.getvalue()
