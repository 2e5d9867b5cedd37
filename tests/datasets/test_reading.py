from __future__ import annotations

import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from fuzzing import LONGEST, within

from rille.datasets.cameras import read_cameras
from rille.datasets.images import files
from rille.datasets.images.headers import Header, read_header
from rille.datasets.registry import open_sequence
from rille.datasets.text import reading
from rille.datasets.text.reading import Search, nearest_hint, read_bytes, read_lines, read_toml
from rille.stages.core.errors import InputError


def refused(code, call, *args):
    with pytest.raises(InputError) as caught, within(LONGEST):
        call(*args)
    assert caught.value.code == code
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    return str(caught.value)


@pytest.mark.parametrize("end", ["\n", "\r", "\v", "\u2028", "1.5\n"])
def test_a_table_of_more_lines_than_any_sensor_writes(tmp_path, end):
    (tmp_path / "times.txt").write_text(end * (reading.MOST_LINES + 1), encoding="utf-8")
    assert "1000001 lines" in refused("RIL-722", read_lines, tmp_path / "times.txt", "times")
    (tmp_path / "times.txt").write_text(end * 1000, encoding="utf-8", newline="")
    assert len(read_lines(tmp_path / "times.txt", "times")) == 1000


# -- what is no small file ---------------------------------------------------------------------------------------------


def test_pipes_devices_and_folders_are_never_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero", "."):
        refused("RIL-138", read_bytes, tmp_path / name, "table", 10)
    assert "name a file in it" in refused("RIL-138", read_bytes, tmp_path, "table", 10)
    assert "did you mean" not in refused("RIL-138", read_bytes, tmp_path / "none", "table", 10)
    refused("RIL-138", read_bytes, tmp_path / "zero\0byte", "table", 10)


@pytest.mark.parametrize(
    ("path", "hint"),
    [
        ("Calib/stereo.yml", "did you mean calib"),
        ("calib/stero.yml", "did you mean stereo.yml"),
        ("calib\\stereo.yml", "write / between folders"),
        ("calib/%06d.yml", "not %06d"),
        ("calib/*/stereo.yml", "correct"),
    ],
)
def test_the_nearest_name_is_asked_for(tmp_path, path, hint):
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib" / "stereo.yml").touch()
    (tmp_path / "calib" / "stereo\n.yml").touch()
    assert hint in f"{nearest_hint(tmp_path / path)}correct"


def test_sizes_lines_and_content_are_bounded(tmp_path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(10**12)
    refused("RIL-139", read_lines, tmp_path / "sparse", "table")
    (tmp_path / "endless").symlink_to("/proc/self/maps")  # a regular file that says it has no bytes
    refused("RIL-754", read_bytes, tmp_path / "endless", "table", 10)
    for name, data in (("binary", b"1 2\0 3"), ("latin", b"\xe9t\xe9"), ("odd", b"\xff\xfe1")):
        (tmp_path / name).write_bytes(data)
        refused("RIL-140", read_lines, tmp_path / name, "table")
    (tmp_path / "long").write_text("1\n" + "(" * (reading.LONGEST_LINE + 1))
    assert "line 2" in refused("RIL-757", read_lines, tmp_path / "long", "table")


@pytest.mark.parametrize(
    "text",
    [
        "0,000000\n0,100000\n0,200000\n",
        "0,5\n1,5\n2,5\n",
        "1600000000,25 0,0 -0,0 1,5e-3\n",
        "Zeit;X;Y\n0;0;0\n0,1;2,5;3,5\n",
        '"0,1","2,5"\n"0,2","2,5"\n',
        "a.png\t0,1\t5\n",
    ],
)
def test_decimal_commas_are_called_so(tmp_path, text):
    (tmp_path / "table").write_text(text)
    assert "decimal commas" in refused("RIL-813", read_lines, tmp_path / "table", "table")


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3\n4,5,6\n",
        "0, 1, 2\n",
        "0,1403636579763555584\n1,1403636579813555456\n",
        "1403636579763555584,10000\n1403636579813555456,10000\n",
        "# 1,5 m off\n0.1 0.2\n",
        "0,100\n",
    ],
)
def test_commas_between_numbers_are_no_decimal_commas(tmp_path, text):
    (tmp_path / "table").write_text(text)
    assert read_lines(tmp_path / "table", "table") == text.splitlines()


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("x = " + "9" * 5000, "RIL-026"),
        ("x = " + "[" * 4000 + "]" * 4000, "RIL-026"),
        ("x = " + "[" * 30 + "]" * 30, "RIL-760"),
        ("a." * 5001 + "a = 1", "RIL-757"),
        (("a." * 1000 + "a = 1\n"), "RIL-760"),
    ],
)
def test_toml_is_refused_in_one_line(tmp_path, text, code):
    (tmp_path / "m.toml").write_text(text)
    refused(code, read_toml, tmp_path / "m.toml", "manifest")


# -- calibrations ------------------------------------------------------------------------------------------------------

ALIASES = "a0: &a0 [1, 1]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40)) + "K: *a39\n"
MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{k}: &a{k} {{<<: [*a{k - 1}]}}\n" for k in range(1, 40)) + "cam0: *a39\n"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (ALIASES, "RIL-758"),
        (MERGES, "RIL-758"),
        ("K: " + "[" * 100_000, "RIL-759"),
        ("K: [" + "1," * 150_000 + "1]", "RIL-759"),
        ("K: [" + "9" * 5000 + "]", "RIL-116"),
        ("K: 1" + ":1" * 400_000, "RIL-115"),
        ("K: 2001-99-99", "RIL-115"),
        ("K: !!python/object/apply:os.system [true]", "RIL-116"),
        ("<opencv_storage>" + "<a>" * 10_000 + "</a>" * 10_000 + "</opencv_storage>", "RIL-756"),
        ("fu = 1\nk = a" + " " * 900_000 + "b", "RIL-113"),
        ("\n" * 900_000 + "x", "RIL-100"),
    ],
)
def test_calibrations_are_refused_in_one_line_and_at_once(tmp_path, text, code):
    (tmp_path / "cal.yaml").write_text(text)
    refused(code, read_cameras, tmp_path / "cal.yaml")


# -- images ------------------------------------------------------------------------------------------------------------


def png(width, height):
    """A whole PNG of one bit a pixel, all black."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes((width + 7) // 8 + 1)) for _ in range(height)) + packer.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_an_image_is_never_unpacked_beyond_its_bounds(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(png(14_000, 12_000))
    assert (tmp_path / "a.png").stat().st_size < 100_000
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("unpacked"))
    refused("RIL-762", files.read_grey, tmp_path / "a.png")
    refused("RIL-762", files.common_header, [tmp_path / "a.png"])
    (tmp_path / "b.png").write_bytes(png(640, 480))
    data = (tmp_path / "b.png").read_bytes()
    refused("RIL-176", files.decode, data, "b.png", Header(64, 48, 8))
    refused("RIL-176", files.common_header, [tmp_path / "b.png", tmp_path / "a.png"])


PIXELS = [
    (kind, dtype, channels)
    for kind in (".png", ".jpg", ".tif", ".bmp", ".pgm", ".ppm")
    for dtype in ((np.uint8,) if kind in (".jpg", ".bmp") else (np.uint8, np.uint16))
    for channels in {".pgm": (1,), ".ppm": (3,)}.get(kind, (1, 3))
]
"""What each format of images can hold."""


@pytest.mark.parametrize(("kind", "dtype", "channels"), PIXELS)
def test_headers_say_what_the_decoder_gives(tmp_path, kind, dtype, channels):
    path = tmp_path / f"a{kind}"
    cv2.imwrite(str(path), np.random.default_rng(3).integers(0, 255, (7, 13, channels)).astype(dtype))
    with path.open("rb") as file:
        assert read_header(file) == (13, 7, np.dtype(dtype).itemsize * 8)
    assert files.read_grey(path).shape == (7, 13)


@pytest.mark.parametrize("name", ["x.webp", "x.jp2", "x.hdr"])
def test_other_formats_reach_no_decoder(tmp_path, name, monkeypatch):
    if not cv2.haveImageWriter(name):
        pytest.skip("cannot be written here")
    cv2.imwrite(str(tmp_path / name), np.ones((9, 9, 3), np.float32 if name.endswith("hdr") else np.uint8))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    refused("RIL-171", files.read_grey, tmp_path / name)


POINTERS = (
    b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n",
    b"/annex/objects/MD5E-s9--a.png\n",
)


@pytest.mark.parametrize("pointer", POINTERS)
@pytest.mark.parametrize("name", ["a.png", "calib.yaml", "poses.txt", "drive.bag", "drive.mcap", "drive/d.mcap"])
def test_pointers_are_named(tmp_path, name, pointer):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(pointer)
    read = {"png": files.read_grey, "yaml": read_cameras, "txt": lambda p: read_lines(p, "table")}.get(
        name.split(".")[1]
    )
    if read is not None:
        refused("RIL-820", read, path)
        return
    (path.parent / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    refused("RIL-820", open_sequence, str(path.parent if "/" in name else path))


def test_links_that_cannot_be_read_are_no_missing_files(tmp_path, monkeypatch):
    closed = tmp_path / "cwd"
    closed.symlink_to(tmp_path / "gone")

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "readlink", refuse)  # as of another user's process below /proc
    assert reading.missing_target(closed) == ""
    assert not reading.is_file(closed)


def test_links_that_lead_nowhere_are_said(tmp_path):
    (tmp_path / "calib.yaml").symlink_to(tmp_path / "absent")
    assert "a link to" in refused("RIL-138", read_cameras, tmp_path / "calib.yaml")
    assert Search().matching(tmp_path, "*.yaml") == [tmp_path / "calib.yaml"]


@pytest.mark.parametrize("row", ["[353,5, 353,5, 300,9, 91,5]", "[ 353,5, 353, 300,9, 91 ]"])
def test_decimal_commas_in_lists_of_a_calibration(tmp_path, row):
    head = "cam0:\n  camera_model: pinhole\n  distortion_model: none\n  rates: [1.0, 0.5, 0.5, 0.5]\n"
    (tmp_path / "chain.yaml").write_text(f"{head}  resolution: [640,480]\n  intrinsics: {row}\n")
    refused("RIL-813", read_cameras, tmp_path / "chain.yaml")
    (tmp_path / "chain.yaml").write_text(f"{head}  resolution: [640,480]\n  intrinsics: [353, 353, 300]\n")
    refused("RIL-116", read_cameras, tmp_path / "chain.yaml")


# -- searches ----------------------------------------------------------------------------------------------------------


def test_patterns_find_what_they_name(tmp_path):
    for name in ("left/1.png", "left/2.png", "a/b/left/3.png", "left/x.txt", ".left/4.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "left" / "5.png").mkdir()
    (tmp_path / "a" / "up").symlink_to(tmp_path)  # a circle
    patterns = (
        "left/*.png",
        "**/*.png",
        "*/*.png",
        "a/**/left/[0-9].png",
        "./left/?.png",
        "a/../left/1.png",
        "**/none",
    )
    for pattern in patterns:
        shown = (p for p in tmp_path.glob(pattern) if not any(part.startswith(".") for part in p.parts if part != ".."))
        expected = {p.resolve() for p in shown if p.is_file()}
        assert {p.resolve() for p in Search().matching(tmp_path, pattern)} == expected, pattern
    too_long = "a" * 5000  # no system allows such a name
    assert Search().matching(tmp_path, f"{too_long}/*.png") == Search().matching(tmp_path, too_long) == []
    assert Search().matching(tmp_path, ".left/*.png") == [tmp_path / ".left" / "4.png"]
    assert Search().matching(tmp_path / "elsewhere", f"{tmp_path}/.left/*.png") == [tmp_path / ".left" / "4.png"]
    for pattern in ("", "/", "left/"):
        refused("RIL-216", Search().matching, tmp_path, pattern)


@pytest.mark.parametrize("pattern", ["**/*.png", "*/*/*/*", "**/**/**/x"])
def test_a_search_that_would_walk_the_disk_ends(tmp_path, monkeypatch, pattern):
    for k in range(60):
        (tmp_path / f"{k % 3}" / f"{k}").mkdir(parents=True)
    monkeypatch.setattr(reading, "MOST_ENTRIES", 50)
    refused("RIL-750", Search().matching, tmp_path, pattern)
