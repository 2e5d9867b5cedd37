"""Disparity maps of other programs: every kind reads the same, hostile files are refused, each image gets its map."""

from __future__ import annotations

import pickle
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import SIZE, write_sequence
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from raising import raises

from rille.datasets.images.disparities import decode, find, scales
from rille.datasets.images.files import Digests
from rille.datasets.images.misalign import MisalignParams, misalign
from rille.datasets.manifest.opening import open_manifest
from rille.stages.core.errors import InputError

MAP = np.array([[1.5, 2.25, 0.0], [-3.0, 60.0, 7.75]], np.float32)
"""No two rows or columns alike; 0 is unknown. Exact in all kinds but for the negative one, which PNG does not have."""

WANTED = np.where(MAP == 0, np.float32(np.nan), MAP)
COLUMNS_ROWS = (3, 2)


def pfm(values, scale=-1.0):
    """Rows from the bottom, little-endian where the scale is negative."""
    rows, cols = values.shape
    return f"Pf\n{cols} {rows}\n{scale}\n".encode() + values[::-1].astype("<f4" if scale < 0 else ">f4").tobytes()


def npy(values, **kind):
    file = BytesIO()
    np.save(file, values, **kind)
    return file.getvalue()


def encoded(suffix, values):
    done, data = cv2.imencode(suffix, values)
    assert done
    return data.tobytes()


def tiff(values, nodata):
    file = BytesIO()
    Image.fromarray(values).save(file, "TIFF", tiffinfo={42113: nodata})
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        pfm(MAP),
        pfm(MAP, 1.0),
        pfm(MAP, -0.0039),  # a scale other than 1 is no factor
        encoded(".pfm", MAP),
        encoded(".tif", MAP),
        tiff(np.where(MAP == 0, np.float32(-9999), MAP), "-9999"),
        npy(MAP),
        npy(MAP[None]),
        npy(MAP[:, :, None]),
        npy(np.asfortranarray(MAP.astype(">f8"))),
        npy(np.where(MAP == 0, np.inf, MAP)),
    ],
)
def test_all_kinds_read_alike(data):
    np.testing.assert_array_equal(decode(data, COLUMNS_ROWS, "a map"), WANTED)


def test_png_has_256_values_a_pixel(tmp_path):
    path = tmp_path / "map.png"
    path.write_bytes(encoded(".png", np.rint(256 * np.abs(MAP)).astype(np.uint16)))
    [scale] = scales({path: path}, COLUMNS_ROWS, None).values()
    np.testing.assert_array_equal(decode(path.read_bytes(), COLUMNS_ROWS, "a map", scale), np.abs(WANTED))


@pytest.mark.parametrize(
    ("data", "scale"),
    [
        (encoded(".png", np.rint(4 * np.abs(MAP)).astype(np.uint8)), 4),  # Middlebury's quarter
        (encoded(".tif", np.rint(64 * np.abs(MAP)).astype(np.uint16)), 64),
        (npy(np.rint(-16 * np.abs(MAP)).astype(np.int16)), -16),  # SGBM's, of the other sign
    ],
)
def test_integers_have_the_scale_that_is_stated(data, scale):
    np.testing.assert_array_equal(decode(data, COLUMNS_ROWS, "a map", scale), np.abs(WANTED))


def test_values_wider_than_the_image_are_no_disparities():
    with raises("RIL-900", "a map", "scale"):
        decode(npy(100 * MAP), COLUMNS_ROWS, "a map")


class Trap:
    """A pickle of it makes a file."""

    def __reduce__(self):
        return Path.touch, (Path("trap"),)


def header(shape):
    """The beginning of a .npy file of that shape, and nothing behind."""
    file = BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize(
    ("data", "fact"),
    [
        (b"", ""),
        (b"no map at all", ""),
        (pfm(MAP)[:-1], ""),
        (b"PF\n3 2\n-1\n" + bytes(72), ""),  # colours
        (b"Pf\n3 2\nnan\n" + bytes(24), ""),
        (b"Pf\n1000000 1000000\n-1\n" + bytes(24), "1000000 x 1000000"),
        (pfm(MAP.T.copy()), "2 x 3"),
        (npy(MAP)[:-1], ""),
        (header((2, 3)), ""),
        (header((10**9, 10**9)), "1000000000 x 1000000000"),
        (header((-2, -3)), ""),
        (header((6,)), ""),
        (npy(np.array([[Trap()] * 3] * 2, object), allow_pickle=True), "type"),
        (pickle.dumps(Trap()), ""),
        (encoded(".png", np.zeros((2, 3, 3), np.uint16)), "type"),
    ],
)
def test_other_files_are_refused_in_one_line(data, fact, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with raises("RIL-900", "a map", fact) as caught:
        decode(data, COLUMNS_ROWS, "a map")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


SEEDS = [pfm(MAP), encoded(".tif", MAP), encoded(".png", np.zeros((2, 3), np.uint16)), npy(MAP)]


@given(st.sampled_from(SEEDS), st.integers(0, 400), st.binary(max_size=8))
def test_damaged_files_are_read_or_refused(data, at, change):
    damaged = data[: at % len(data)] + change + data[at % len(data) + len(change) :]
    with suppress(InputError):
        assert decode(damaged, COLUMNS_ROWS, "a map").shape == (2, 3)


# -- which map is whose ------------------------------------------------------------------------------------------------


def paths(folder, names):
    found = [folder / name for name in names.split()]
    for path in found:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return found


@pytest.mark.parametrize(
    ("lefts", "maps", "wanted"),
    [
        ("07.png 08.png 09.png", "09.pfm 08.pfm 07.pfm 06.pfm", "07 08 09"),
        ("left_7.png left_10.png", "left_10.npy left_7.npy", "left_7 left_10"),
        ("cam0_7.png cam0_10.png", "disp_0010.npy disp_0007.npy", "disp_0007 disp_0010"),
        ("00_10.png 01_10.png", "d_00_10.npy d_01_10.npy", "d_00_10 d_01_10"),  # the last number tells nothing apart
        ("a.png b.png", "2.npy 10.npy", "2 10"),
        ("im0.png", "disp.pfm", "disp"),
    ],
)
def test_maps_are_paired_by_name_number_or_order(tmp_path, lefts, maps, wanted):
    paths(tmp_path, " ".join(f"disp/{name}" for name in maps.split()))
    found = find("disp/*", tmp_path, [Path(name) for name in lefts.split()], "disparity.left")
    assert [path.stem for path in found.values()] == wanted.split()


@pytest.mark.parametrize(
    ("lefts", "maps", "lacking"),
    [
        ("a.png b.png", "1.npy 2.npy 3.npy", ""),
        ("00.png 01.png 02.png", "d1.npy d2.npy d3.npy", "d1.npy"),  # counted from 1
        ("a.png b.png", "map.npy", ""),
        ("a.png", "", "none in /"),
    ],
)
def test_maps_that_do_not_fit_are_refused(tmp_path, lefts, maps, lacking):
    paths(tmp_path, " ".join(f"disp/{name}" for name in maps.split()))
    counts = f"{len(maps.split())} map", f"{len(lefts.split())} left image"
    with raises("RIL-901", "disparity.left", lacking, *counts):
        find("disp/*", tmp_path, [Path(name) for name in lefts.split()], "disparity.left")


# -- in a manifest -----------------------------------------------------------------------------------------------------


def sequence(tmp_path, table='left = "disp/*.npy"', **more):
    """Three frames whose maps hold 10, 20 and 30 px."""
    path = write_sequence(tmp_path, f"[disparity]\n{table}\n", **more)
    for name in ("disp", "sigma"):
        (tmp_path / name).mkdir()
        for k in range(3):
            np.save(tmp_path / name / f"{k:02d}.npy", np.full(SIZE[::-1], 10.0 * (k + 1), np.float32))
    return open_manifest(path, Digests())


@pytest.mark.parametrize(
    ("more", "column", "sigma"),
    [
        ("", -20, None),
        ('sign = "right-left"', 20, None),
        ("sigma = 0.25", -20, 0.25),
        ("sigma = 1", -20, 1.0),
        ('sigma = "sigma/*.npy"', -20, 20.0),
    ],
)
def test_a_manifest_names_maps(tmp_path, materialise, more, column, sigma):
    s = sequence(tmp_path, f'left = "disp/*.npy"\n{more}')
    bundle = materialise(s.disparity(1))
    assert (bundle["column_disparity"] == column).all()
    assert ("disparity_std" in bundle.arrays) == (sigma is not None)
    assert sigma is None or (bundle["disparity_std"] == sigma).all()
    assert any("disp/*.npy" in note for note in s.notes)


def test_integers_need_a_scale(tmp_path, materialise):
    sequence(tmp_path)
    for k in range(3):
        (tmp_path / "disp" / f"{k:02d}.npy").unlink()
        cv2.imwrite(str(tmp_path / "disp" / f"{k:02d}.png"), np.full(SIZE[::-1], 40 * (k + 1), np.uint8))
    table = '[disparity]\nleft = "disp/*.png"\n'
    with raises("RIL-900", "00.png", "scale"):
        open_manifest(write_sequence(tmp_path, table), Digests())
    s = open_manifest(write_sequence(tmp_path, table + 'scale = 4\nsigma = "sigma/*.npy"\n'), Digests())
    bundle = materialise(s.disparity(1))
    assert (bundle["column_disparity"] == -20).all()
    assert (bundle["disparity_std"] == 20).all()
    assert any("4 values a pixel" in note for note in s.notes)


def test_true_maps_are_no_disparities_of_another_program(tmp_path, materialise):
    sequence(tmp_path)
    path = write_sequence(tmp_path, '[truth_disparity]\nleft = "disp/*.npy"\n')
    s = open_manifest(path, Digests())
    assert s.disparity is None
    assert (materialise(s.truth_disparity(1))["column_disparity"] == -20).all()
    with raises("RIL-223", "sigma"):
        open_manifest(write_sequence(tmp_path, '[truth_disparity]\nleft = "disp/*.npy"\nsigma = 1\n'), Digests())


def test_lost_frames_need_no_map(tmp_path, materialise):
    sequence(tmp_path)
    (tmp_path / "left" / "01.png").unlink()
    (tmp_path / "disp" / "01.npy").unlink()
    s = open_manifest(tmp_path / "rover.rille.toml", Digests())
    assert (materialise(s.disparity(2))["column_disparity"] == -30).all()


def test_a_frame_without_a_map_is_lost_or_not_judged(tmp_path):
    sequence(tmp_path, 'left = "disp/*.npy"\nsigma = "sigma/*.npy"')
    (tmp_path / "disp" / "02.npy").rename(tmp_path / "disp" / "03.npy")  # as many, but not of these images
    (tmp_path / "sigma" / "00.npy").unlink()
    s = open_manifest(tmp_path / "rover.rille.toml", Digests())
    assert s.lost == {k: f"the map of 0{k}.png (disparity) is missing" for k in (0, 2)}
    s = open_manifest(write_sequence(tmp_path, '[truth_disparity]\nleft = "disp/*.npy"\n'), Digests())
    assert not s.lost
    assert [s.truth_disparity(k) is None for k in range(3)] == [False, False, True]
    assert any("2 of 3 pairs" in note for note in s.notes)


def test_a_map_that_changed_since_is_refused(tmp_path, materialise):
    s = sequence(tmp_path)
    np.save(tmp_path / "disp" / "01.npy", np.full(SIZE[::-1], 77.0, np.float32))
    source = s.disparity(1)
    np.save(tmp_path / "disp" / "01.npy", np.zeros(SIZE[::-1], np.float32))
    with raises("RIL-177", "01.npy"):
        materialise(source)


def test_maps_are_of_undistorted_and_unmoved_images(tmp_path):
    cameras = "[cameras]\nfx = 60.0\ncx = 31.5\ncy = 23.5\ndistortion = [0.1, 0, 0, 0]\n"
    with raises("RIL-902", "distortion"):
        sequence(tmp_path, cameras=cameras)
    plain = write_sequence(tmp_path, '[disparity]\nleft = "disp/*.npy"\n')
    with raises("RIL-903", "[disparity]", "misalign"):
        misalign(open_manifest(plain, Digests()), MisalignParams(rows=2))


@pytest.mark.parametrize("line", ["sigma = 0", "sigma = -1.5", "scale = 0", 'sign = "up"', "right = 1"])
def test_bad_tables(tmp_path, line):
    with raises("RIL-223", line.split()[0]):
        sequence(tmp_path, f'left = "disp/*.npy"\n{line}')


def test_a_bad_map_costs_its_own_pair_alone(tmp_path, materialise):
    sequence(tmp_path)
    np.save(tmp_path / "disp" / "01.npy", np.ones((4, 5), np.float32))
    s = open_manifest(tmp_path / "rover.rille.toml", Digests())
    assert list(s.lost) == [1]
    assert "01.npy" in s.lost[1]
    assert "5 x 4 values" in s.lost[1]
    assert (materialise(s.disparity(2))["column_disparity"] == -30).all()
    for k in (0, 2):
        np.save(tmp_path / "disp" / f"{k:02d}.npy", np.ones((4, 5), np.float32))
    with raises("RIL-900", "00.npy"):
        open_manifest(tmp_path / "rover.rille.toml", Digests())


@pytest.mark.parametrize(("folder", "sigma"), [("disp", "0.5"), ("sigma", '"sigma/*.npy"')])
def test_a_map_that_is_damaged_behind_its_header_is_empty(tmp_path, materialise, folder, sigma):
    sequence(tmp_path, f'left = "disp/*.npy"\nsigma = {sigma}')
    file = tmp_path / folder / "01.npy"
    file.write_bytes(file.read_bytes()[:-8])
    s = open_manifest(tmp_path / "rover.rille.toml", Digests())
    assert not s.lost
    bundle = materialise(s.disparity(1))
    assert np.isnan(bundle["column_disparity"]).all()
    assert "01.npy" in bundle.meta["damage"]
