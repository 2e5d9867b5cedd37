"""The calibration command: real boards against other programs' results, what it writes, and what it complains about."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.cameras import read_cameras, rig_of
from rille.datasets.images.boards import images_of
from rille.pipeline.commands.sequences.calibrate import calibrate
from rille.stages.calibration.target import MODELS, BoardView, RigCalibration, ViewResidual, cover, doubts
from rille.stages.geometry.geometry import Camera, RigidTransform
from rille.stages.geometry.lens import Lens

BOARDS = {"chessboard_opencv": ("9x6", 0.025), "chessboard_bumblebee2": ("6x4", 0.03)}


@pytest.fixture(scope="module")
def results(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Both sets, calibrated once."""
    out = {}
    for name, (corners, square) in BOARDS.items():
        out[name] = tmp_path_factory.mktemp("boards") / "rig.yaml"
        sides = [data_dir / name / f"{side}*.jpg" for side in ("left", "right")]
        calibrate(*sides, square=square, corners=corners, output=out[name])
    return out


@pytest.mark.data
def test_focal_lengths_are_those_of_opencv(results, data_dir):
    left, right = read_cameras(results["chessboard_opencv"])
    reference = cv2.FileStorage(str(data_dir / "chessboard_opencv" / "left_intrinsics.yml"), cv2.FILE_STORAGE_READ)
    k = reference.getNode("camera_matrix").mat()
    assert left.lens.camera.fx == pytest.approx(k[0, 0], rel=0.01)
    assert left.lens.camera.fy == pytest.approx(k[1, 1], rel=0.01)
    rig, lenses = rig_of(left, right)
    assert lenses is not None
    # the right camera stands some 3.3 squares to the right, as the samples' own stereo calibration finds
    assert rig.baseline == pytest.approx(0.0833, rel=0.01)
    assert rig.T_right_left.translation[0] < 0


@pytest.mark.data
def test_rig_is_boofcvs(results, data_dir):
    ours, _ = rig_of(*read_cameras(results["chessboard_bumblebee2"]))
    other = rig_of(*read_cameras(data_dir / "chessboard_bumblebee2" / "stereo.yaml"))[0]
    for a, b in ((ours.left, other.left), (ours.right, other.right)):
        assert a.fx == pytest.approx(b.fx, rel=0.01)
        assert a.fy == pytest.approx(b.fy, rel=0.01)
    # BoofCV's lengths are millimetres
    assert ours.baseline == pytest.approx(other.baseline / (1000 if other.baseline > 1 else 1), rel=0.005)
    turn = cv2.Rodrigues(ours.T_right_left.rotation @ other.T_right_left.rotation.T)[0]
    assert np.degrees(np.linalg.norm(turn)) < 0.3


@pytest.mark.data
def test_file_says_how_it_was_found(results):
    text = results["chessboard_opencv"].read_text()
    file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert file.getNode("views").size() == 13
    assert 0 < file.getNode("standard_deviations").getNode("left_fx").real() < 1
    assert file.getNode("avg_reprojection_error").real() < 0.25
    assert file.getNode("square_size").real() == 0.025


def drawn(lens: Lens, T: RigidTransform, square: float) -> np.ndarray:
    """Picture of a board of 9 x 6 inner corners by an equidistant lens: each pixel the mean of four of its rays."""
    camera = lens.camera
    rows, columns = (np.indices((2 * camera.height, 2 * camera.width)) - 0.5) / 2
    off = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], axis=-1)
    angle = np.hypot(off[..., 0], off[..., 1])
    rays = np.concatenate([off * np.sinc(angle / np.pi)[..., None], np.cos(angle)[..., None]], axis=-1) @ T.rotation
    origin = -T.rotation.T @ T.translation
    far = -origin[2] / rays[..., 2]
    place = (origin[:2] + far[..., None] * rays[..., :2]) / square + 1
    paper = (far > 0) & ((place > -0.7) & (place < (10.7, 7.7))).all(axis=-1)
    dark = ((place >= 0) & (place < (10, 7))).all(axis=-1) & (np.floor(place).sum(axis=-1) % 2 == 0)
    fine = np.where(paper, np.where(dark, 20.0, 235.0), 110.0).reshape(camera.height, 2, camera.width, 2)
    return cv2.GaussianBlur(fine.mean(axis=(1, 3)), (0, 0), 0.6).round().astype(np.uint8)


def test_a_wide_fisheye_is_calibrated_from_its_pictures(tmp_path):
    """An image of 240 degrees along its diagonal, and boards up to 60 degrees off the axis."""
    lens = Lens(Camera(114.0, 114.0, 242.0, 147.0, 480, 300), "fisheye", (0.0, 0.0, 0.0, 0.0))
    T_right_left = RigidTransform(cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0], np.array([-0.1, 0.002, 0.003]))
    centre = RigidTransform(np.eye(3), np.array([-0.12, -0.075, 0.0]))
    # Direction and distance of the board, and its turn about its own axes.
    for k, (across, down, away, *turn) in enumerate(
        [
            (0.0, 0.0, 0.25, 0.3, -0.4, 0.1),
            (-0.9, 0.1, 0.3, -0.4, 0.2, 0.3),
            (0.9, -0.1, 0.3, 0.4, -0.3, -0.2),
            (0.2, 0.6, 0.3, -0.2, 0.5, 0.2),
            (-0.2, -0.6, 0.3, 0.5, 0.4, -0.3),
            (0.5, 0.4, 0.4, -0.5, -0.4, 0.0),
            (-0.6, -0.3, 0.35, 0.2, 0.6, 0.4),
        ]
    ):
        facing = cv2.Rodrigues(np.array([-down, across, 0.0]))[0]
        pose = RigidTransform(facing @ cv2.Rodrigues(np.array(turn))[0], facing @ [0.0, 0.0, away])
        for side, T in (("left", pose @ centre), ("right", T_right_left @ pose @ centre)):
            cv2.imwrite(str(tmp_path / f"{side}{k}.png"), drawn(lens, T, 0.03))
    out = tmp_path / "rig.yaml"
    calibrate(tmp_path, tmp_path, square=0.03, corners="9x6", model="fisheye", output=out)
    left, right = read_cameras(out)
    assert left.lens.model == "fisheye"
    assert left.lens.camera.fx == pytest.approx(114, rel=0.01)
    # Six views leave rotation and principal point to each other by some milliradians.
    np.testing.assert_allclose(rig_of(left, right)[0].T_right_left.translation, T_right_left.translation, atol=1e-3)
    file = cv2.FileStorage(str(out), cv2.FILE_STORAGE_READ)
    assert file.getNode("avg_reprojection_error").real() < 0.3


@pytest.mark.data
def test_mispaired_view_and_stray_image_are_named(data_dir, tmp_path, capsys):
    for k in (1, 2, 3, 4, 5, 6, 7):
        shutil.copy(data_dir / "chessboard_bumblebee2" / f"left{k:02d}.jpg", tmp_path)
        other = 5 if k == 4 else k  # the right image of another moment
        source = data_dir / "chessboard_bumblebee2" / f"right{other:02d}.jpg"
        shutil.copy(source, tmp_path / f"right{k:02d}.jpg")
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{side}99.jpg"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(tmp_path / "left98.jpg"), np.full((480, 640), 90, np.uint8))
    calibrate(tmp_path, tmp_path, square=0.03, corners="6x4", model="radtan4", output=tmp_path / "r.yaml")
    shown = capsys.readouterr()
    assert re.search(r"^04 .*left out: far above", shown.out, re.MULTILINE)
    assert re.search(r"^99 +left out: no whole board in the left nor in the right image", shown.out, re.MULTILINE)
    assert re.search(r"^98 +left out: .*right98.jpg is missing", shown.out, re.MULTILINE)
    assert "6 used" in shown.out
    left, _ = read_cameras(tmp_path / "r.yaml")
    assert left.lens.camera.fx == pytest.approx(524.6, rel=0.01)
    assert 'file = "r.yaml"' in shown.out


def images(folder: Path, count: int = 2) -> Path:
    folder.mkdir()
    for k in range(count):
        for side in ("left", "right"):
            cv2.imwrite(str(folder / f"{side}{k}.png"), np.full((48, 64), 128, np.uint8))
    return folder


def test_complaints_say_what_to_change(tmp_path):
    folder = images(tmp_path / "flat")
    given = {"square": 0.03, "output": tmp_path / "rig.yaml"}
    with raises("RIL-152", "0.025"):
        calibrate(folder, folder, **(given | {"square": 25}))
    with raises("RIL-153"):
        calibrate(folder, folder, **given)
    with raises("RIL-961", "9 x 6", "0 of 2", "no whole board in the left nor in the right image"):
        calibrate(folder, folder, **(given | {"corners": "9x6"}))
    with raises("RIL-011"):
        calibrate(folder / "left*.bmp", folder, **given)
    (tmp_path / "plain").mkdir()
    (folder / "left0.png").rename(tmp_path / "plain" / "0.png")
    with raises("RIL-010"):
        calibrate(tmp_path / "plain", tmp_path / "plain", **given)
    assert not (tmp_path / "rig.yaml").exists()
    (tmp_path / "rig.yaml").write_text("camera_matrix: of another program\n")
    for side, name in (("left", "a"), ("left", "b"), ("right", "c"), ("right", "d")):
        (tmp_path / side).mkdir(exist_ok=True)
        (tmp_path / side / f"{name}.png").write_bytes(b"")
    with raises("RIL-257", "one name or number") as caught:
        calibrate(tmp_path / "left", tmp_path / "right", square=0.02)
    assert "images.pair" not in str(caught.value), "there is no manifest"
    with raises("RIL-038", "--output"):
        calibrate(folder, folder, **given)


def test_hidden_files_beside_the_pictures_are_passed_over(tmp_path):
    folder = images(tmp_path / "a[1]")
    (folder / "._left0.png").touch()
    assert [path.name for path in images_of(folder)] == ["left0.png", "left1.png", "right0.png", "right1.png"]


@pytest.mark.data
def test_pictures_of_a_board_at_rest_are_one_view(data_dir, tmp_path):
    """Five copies of a view gave a baseline of 0.40 +- 0.03 m, truly 0.083 m."""
    for k in range(5):
        for side in ("left", "right"):
            shutil.copy(data_dir / "chessboard_opencv" / f"{side}01.jpg", tmp_path / f"{side}{k}.jpg")
    with raises("RIL-961", "1 of 5", "1: the board stands as in view 0"):
        calibrate(tmp_path, tmp_path, square=0.025, corners="9x6", output=tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.data
def test_a_right_camera_of_half_the_size_gives_the_same_rig(data_dir, tmp_path, results):
    """Its images are those of the full size, reduced: all of its pixels are halved, nothing else."""
    for k in range(1, 15):
        for side in ("left", "right"):
            path = data_dir / "chessboard_opencv" / f"{side}{k:02d}.jpg"
            if path.exists():
                image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
                half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(tmp_path / f"{side}{k:02d}.png"), half if side == "right" else image)
    calibrate(tmp_path, tmp_path, square=0.025, corners="9x6", output=tmp_path / "rig.yaml")
    whole, mixed = (read_cameras(path) for path in (results["chessboard_opencv"], tmp_path / "rig.yaml"))
    sizes = [(c.lens.camera.width, c.lens.camera.height) for c in mixed]
    assert sizes == [(640, 480), (320, 240)]
    assert mixed[1].lens.camera.fx == pytest.approx(0.5 * whole[1].lens.camera.fx, rel=0.005)
    # The centre of a pixel of the half size lies between four pixels' centres.
    assert mixed[1].lens.camera.cx == pytest.approx(0.5 * (whole[1].lens.camera.cx + 0.5) - 0.5, abs=1.5)
    assert rig_of(*mixed)[0].baseline == pytest.approx(rig_of(*whole)[0].baseline, rel=0.005)


def test_cover_is_the_share_of_the_hull():
    square = np.array([[0, 0], [50, 0], [50, 40], [0, 40], [20, 20]], dtype=float)
    assert cover([square], (100, 80)) == pytest.approx(0.25)


@pytest.mark.data
def test_pictures_of_a_street_show_no_board(data_dir, tmp_path):
    sides = [tmp_path / "left", tmp_path / "right"]
    for side, folder in zip(sides, ("image_l", "image_r"), strict=True):
        side.mkdir()
        for path in sorted((data_dir / "kitti06_51" / folder).iterdir())[::10]:
            shutil.copy(path, side)
    with raises("RIL-153"):
        calibrate(*sides, square=0.1, output=tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.data
def test_views_of_no_flat_board_write_nothing(data_dir, tmp_path, monkeypatch):
    """Left and right of different moments throughout: no single rig explains them."""
    lefts, rights = (
        [data_dir / "chessboard_bumblebee2" / f"{side}{k:02d}.jpg" for k in range(1, 8)] for side in ("left", "right")
    )
    for k, (left, right) in enumerate(zip(lefts, rights[3:] + rights[:3], strict=True)):
        shutil.copy(left, tmp_path / f"left{k}.jpg")
        shutil.copy(right, tmp_path / f"right{k}.jpg")
    with raises("RIL-800", "6 x 4"):
        calibrate(tmp_path, tmp_path, square=0.03, corners="6x4", keep_bad=True, output=tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()


def test_views_that_are_left_out_cover_nothing():
    small, whole = ([[5.0, 5.0], [15.0, 5.0], [15.0, 15.0], [5.0, 15.0]], [[0.0, 0], [100, 0], [100, 80], [0, 80]])
    views = [BoardView(name, np.array(p), np.array(p)) for name, p in (("used", small), ("bad", whole))]
    lens = Lens(Camera(100, 100, 50, 40, 100, 80), "radtan", (0.0, 0.0, 0.0, 0.0))
    sigma = {f"{side} {name}": 0.0 for side in ("left", "right") for name in ("fx", *MODELS["radtan4"])}
    seen = tuple(ViewResidual(v.name, 0.1, 0.1, 0.1, used=v.name == "used") for v in views)
    found = RigCalibration(lens, lens, RigidTransform.identity(), dict.fromkeys(sigma, 1.0), sigma, 0.1, seen)
    told = doubts(found, views, ((100, 80), (100, 80)), "radtan4")
    assert [line[:7] for line in told] == ["RIL-698", "RIL-698"]
