"""Every bad file is one clear line; good ones come out grey and as they were stored."""

from __future__ import annotations

import os
from io import BytesIO

import cv2
import numpy as np
import pytest
from PIL import Image
from raising import raises

from rille.datasets.images import files
from rille.datasets.images.files import Digests
from rille.datasets.images.headers import Header
from rille.stages.core.declare import NoParams, check_outputs
from rille.stages.core.errors import InputError


@pytest.fixture
def grey():
    return np.random.default_rng(0).integers(0, 256, (40, 50), dtype=np.uint8)


def encoded(image, kind=".png") -> bytes:
    return cv2.imencode(kind, image)[1].tobytes()


def test_bands_of_sixteen_bits_in_planes_are_refused_and_others_read(tmp_path, grey):
    import rasterio

    shape = {"driver": "GTiff", "count": 3, "width": 50, "height": 40, "photometric": "RGB"}
    for dtype, kind in (("uint16", "band"), ("uint16", "pixel"), ("uint8", "band")):
        with rasterio.open(tmp_path / "x.tif", "w", dtype=dtype, interleave=kind, **shape) as file:
            file.write(np.stack([grey] * 3).astype(dtype))
        if (dtype, kind) == ("uint16", "band"):
            with raises("RIL-171", "interleaved"):
                files.read_grey(tmp_path / "x.tif")
        else:
            np.testing.assert_array_equal(files.read_grey(tmp_path / "x.tif"), grey)


@pytest.mark.parametrize("kind", [".png", ".tif", ".pgm"])
def test_lossless_kinds_round_trip(tmp_path, grey, kind):
    for image in (grey, grey.astype(np.uint16) * 257):
        path = tmp_path / f"a{kind}"
        path.write_bytes(encoded(image, kind))
        back = files.read_grey(path)
        assert back.dtype == image.dtype
        np.testing.assert_array_equal(back, image)


@pytest.mark.parametrize("tag", range(1, 9))
def test_no_orientation_turns_an_image(grey, tag):
    exif = Image.Exif()
    exif[0x0112] = tag
    for kind in ("TIFF", "PNG", "JPEG"):
        for image in (grey, np.dstack([grey] * 3)):
            file = BytesIO()
            smooth = cv2.GaussianBlur(image, (0, 0), 4)
            Image.fromarray(smooth).save(file, kind, exif=exif, quality=100)
            back = files.decode(file.getvalue(), "x", Header(50, 40, 8))
            assert np.abs(back.astype(int) - (smooth if smooth.ndim == 2 else smooth[..., 0])).max() <= 3


@pytest.mark.parametrize("end", ["\n", "", " \r\n"])
def test_netpbm_as_text_may_end_with_its_last_number(grey, end):
    for kind, image in (("P2", grey), ("P3", np.dstack([grey] * 3))):
        text = f"{kind}\n# a comment\n50 40\n255\n{' '.join(map(str, image.ravel()))}{end}"
        np.testing.assert_array_equal(files.decode(text.encode(), "x"), grey)


def test_jpeg_is_read(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(encoded(np.full((40, 50), 90, np.uint8), ".jpg"))
    assert np.abs(files.read_grey(path).astype(int) - 90).max() <= 2


def test_colour_becomes_grey_by_the_stated_rule():
    bgr = np.zeros((1, 4, 3), np.uint8)
    bgr[0, 0], bgr[0, 1], bgr[0, 2], bgr[0, 3] = (200, 0, 0), (0, 200, 0), (0, 0, 200), (9, 9, 9)
    expected = np.rint([0.114 * 200, 0.587 * 200, 0.299 * 200, 9])
    for image in (bgr, np.dstack([bgr, np.full((1, 4), 7, np.uint8)])):  # with and without alpha
        np.testing.assert_array_equal(files.decode(encoded(image), "x")[0], expected)


@pytest.mark.parametrize("kept", [0, 4, 20, 60, 0.5, -13, -12, -4, -1])
def test_truncated_png_is_named(tmp_path, grey, kept):
    data = encoded(grey)
    path = tmp_path / "000007.png"
    path.write_bytes(data[: int(kept * len(data)) if isinstance(kept, float) else kept])
    with pytest.raises(InputError) as caught:
        files.read_grey(path)
    assert "000007.png" in str(caught.value)
    assert caught.value.code in {"RIL-170", "RIL-171", "RIL-763"}
    assert caught.value.remedy
    assert "\n" not in str(caught.value)


def test_damaged_and_foreign_files_are_named(tmp_path, grey):
    data = bytearray(encoded(grey))
    data[len(data) // 2] ^= 0xFF
    with raises("RIL-170"):
        files.decode(bytes(data), "x")
    jpeg = encoded(grey, ".jpg")
    with raises("RIL-763"):
        files.decode(jpeg[: len(jpeg) // 2], "x")
    with raises("RIL-171"):
        files.decode(b"not an image at all", "x")
    with raises("RIL-761", "32 bits"):
        files.decode(encoded(grey.astype(np.float32), ".tif"), "x")
    with raises("RIL-138"):
        files.read_grey(tmp_path / "absent.png")


def photograph():
    """A JPEG whose entropy-coded data are long."""
    return bytearray(encoded(np.random.default_rng(3).integers(0, 255, (96, 128)).astype(np.uint8), ".jpg"))


def test_a_jpeg_that_libjpeg_complains_about_is_refused(capfd):
    data = photograph()
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    with raises("RIL-192", "Corrupt JPEG data"):
        files.decode(bytes(data), "x")
    short = bytes(photograph()[: len(data) // 2]) + b"\xff\xd9"
    with raises("RIL-192", "premature end"):
        files.decode(short, "x")
    # What libjpeg says is in the error, and nowhere else.
    assert capfd.readouterr().err == ""


def test_what_other_threads_say_meanwhile_is_no_damage_and_is_not_lost(capfd, monkeypatch):
    real = files._decoded

    def meanwhile(data):
        os.write(2, b"no line feed, ")
        image = real(data)
        os.write(2, b"a warning\n")
        return image

    monkeypatch.setattr(files, "_decoded", meanwhile)
    data = photograph()
    files.decode(bytes(data), "x")
    assert capfd.readouterr().err == "no line feed, a warning\n"
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    with raises("RIL-192", "Corrupt JPEG data"):
        files.decode(bytes(data), "x")
    assert capfd.readouterr().err == "no line feed, a warning\n"


def test_a_few_bytes_of_padding_before_the_end_are_no_damage(capfd):
    data = photograph()
    padded = bytes(data[:-2]) + bytes([7, 7, 7]) + b"\xff\xd9"
    np.testing.assert_array_equal(files.decode(padded, "x"), files.decode(bytes(data), "x"))
    assert capfd.readouterr().err == ""


def test_what_a_camera_writes_behind_a_jpeg_does_not_matter(tmp_path):
    data = bytes(photograph())
    known = files.decode(data, "x")
    np.testing.assert_array_equal(files.decode(data + bytes(range(200)) * 100, "x"), known)  # a video
    path = tmp_path / "DJI_0001.JPG"
    image = Image.fromarray(known)
    image.save(path, "MPO", save_all=True, append_images=[image.resize((32, 24))], quality=95)
    assert files.common_header([path]).header == Header(128, 96, 8)
    assert np.abs(files.read_grey(path).astype(int) - known).mean() < 10


def run(source):
    stage = files.image_stage
    bundle = stage.run(NoParams(), source.args | source.hints, {})
    check_outputs(stage, bundle)
    return bundle


def test_stage_gives_the_image_whole_and_declared(tmp_path, grey):
    for image, depth in ((grey, 8), (grey.astype(np.uint16) * 100, 16)):
        path = tmp_path / f"{depth}.png"
        path.write_bytes(encoded(image))
        bundle = run(files.image_source(path, 3, "right", Header(50, 40, depth), Digests()))
        np.testing.assert_array_equal(bundle["image"], image)
        assert bundle["valid"].all()
        assert bundle.meta == {"frame": 3, "camera": "right"}


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_file_that_is_damaged_inside_gives_an_empty_image(tmp_path, suffix):
    data = bytearray(encoded(np.random.default_rng(3).integers(0, 255, (96, 128)).astype(np.uint8), suffix))
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    bundle = run(files.image_source(path, 3, "left", Header(128, 96, 8), Digests()))
    assert bundle["image"].shape == (96, 128)
    assert not bundle["valid"].any()
    assert bundle.meta["damage"].startswith("left image is damaged")
    with raises("RIL-170", "frame 3, left image is damaged", str(path)):
        files.sound(bundle, str(path))


def test_stage_takes_no_other_size_and_refuses_changed_files(tmp_path, grey):
    path = tmp_path / "a.png"
    path.write_bytes(encoded(grey))
    other = run(files.image_source(path, 3, "left", Header(51, 40, 8), Digests()))
    assert "50 x 40, 8 bits; others of its camera are 51 x 40" in other.meta["damage"]
    assert other["image"].shape == (40, 51)
    source = files.image_source(path, 3, "left", Header(50, 40, 8), Digests())
    path.write_bytes(encoded(grey[::-1]))
    with raises("RIL-177"):
        run(source)


def test_paths_are_hints_and_content_is_the_identity(tmp_path, grey):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(encoded(grey))
    a, b = (files.image_source(tmp_path / n, 0, "left", Header(50, 40, 8), Digests()) for n in ("a.png", "b.png"))
    assert a.args == b.args
    assert a.hints != b.hints


def test_digests_are_remembered_until_the_file_changes(tmp_path, grey, monkeypatch):
    path, memory = tmp_path / "a.png", tmp_path / "cache" / "digests"
    path.write_bytes(encoded(grey))
    first = Digests(memory).sha256(path)
    with monkeypatch.context() as patch:
        patch.setattr(files, "open_regular", lambda *_: pytest.fail("read again"))
        assert Digests(memory).sha256(path) == first
    path.write_bytes(encoded(grey[:20]))
    assert Digests(memory).sha256(path) != first
    memory.write_text("rubbish\n" + memory.read_text())
    assert Digests(memory).sha256(path) != first


def test_a_file_that_is_written_anew_with_its_old_times_has_another_digest(tmp_path, grey):
    path, digests = tmp_path / "a.pgm", Digests(tmp_path / "digests")
    path.write_bytes(encoded(grey, ".pgm"))
    before, status = digests.sha256(path), path.stat()
    path.write_bytes(encoded(255 - grey, ".pgm"))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert digests.sha256(path) != before


def test_a_memo_that_cannot_be_written_is_left_out(tmp_path, grey):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    path = folder / "a.png"
    path.write_bytes(encoded(grey))
    (tmp_path / "file").touch()
    first = Digests(tmp_path / "file" / "digests").sha256(path)
    for _ in range(2):
        assert Digests(tmp_path / "digests").sha256(path) == first


def test_a_memo_that_cannot_be_read_is_left_out(tmp_path, grey):
    path = tmp_path / "a.png"
    path.write_bytes(encoded(grey))
    (tmp_path / "digests").symlink_to("/proc/self/mem")  # a regular file whose first byte cannot be read
    assert Digests(tmp_path / "digests").sha256(path) == Digests().sha256(path)
