"""Folders in the manner of KITTI: both layouts, and each thing that can be wrong with one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.kitti import image_folders
from rille.datasets.registry import open_sequence
from rille.stages.geometry.geometry import rotation_exp

K = np.array([[100.0, 0.0, 31.5], [0.0, 100.0, 23.5], [0.0, 0.0, 1.0]])
P_LEFT = np.hstack([K, np.zeros((3, 1))])
P_RIGHT = np.hstack([K, K @ [[-0.5], [0.0], [0.0]]])


def line(matrix) -> str:
    return " ".join(f"{v:.12e}" for v in np.asarray(matrix).reshape(-1))


def picture(path, shape=(48, 64), dtype=np.uint8):
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(len(str(path.name)))
    cv2.imwrite(str(path), rng.integers(0, 255, shape).astype(dtype))


@pytest.fixture
def folder(tmp_path):
    """Self-contained, bare rows, no newline at the end, as some are."""
    root = tmp_path / "street"
    for side in ("image_l", "image_r"):
        for k in range(3):
            picture(root / side / f"{k:06d}.png")
    (root / "calib.txt").write_text(line(P_LEFT) + "\n" + line(P_RIGHT))
    poses = [np.hstack([np.eye(3), [[0.0], [0.0], [1.2 * k]]]) for k in range(3)]
    (root / "poses.txt").write_text("\n".join(line(p) for p in poses) + "\n")
    return root


@pytest.fixture
def root(tmp_path):
    """The standard layout with grey and colour cameras."""
    seq = tmp_path / "kitti" / "sequences" / "06"
    for side in range(4):
        for k in range(2):
            picture(seq / f"image_{side}" / f"{k:06d}.png")
    matrices = [np.hstack([K, K @ [[x], [0.0], [0.0]]]) for x in (0.0, -0.5, 0.06, -0.44)]
    (seq / "calib.txt").write_text("".join(f"P{k}: {line(p)}\n" for k, p in enumerate(matrices)))
    (seq / "times.txt").write_text("0.0\n0.1\n")
    poses = tmp_path / "kitti" / "poses" / "06.txt"
    poses.parent.mkdir()
    poses.write_text("".join(line(np.hstack([np.eye(3), [[0.0], [0.0], [k]]])) + "\n" for k in (0.0, 1.0)))
    return tmp_path / "kitti"


def test_self_contained_folder(folder):
    s = open_sequence(str(folder))
    assert (s.name, s.frames, s.frame_names) == ("street", 3, ("000000", "000001", "000002"))
    assert s.rig.baseline == pytest.approx(0.5)
    np.testing.assert_allclose(s.rig.T_right_left.translation, [-0.5, 0.0, 0.0])
    np.testing.assert_allclose(s.truth[2].translation, [0.0, 0.0, 2.4])
    assert s.times is None
    assert s.defaults["locus.cell_size"] == 0.1
    assert s.image(1, "right").hints["path"].endswith("image_r/000001.png")


def test_cells_of_a_small_rig_follow_from_the_rig(folder):
    right = np.hstack([K, K @ [[-0.1], [0.0], [0.0]]])
    (folder / "calib.txt").write_text(line(P_LEFT) + "\n" + line(right))
    s = open_sequence(str(folder))
    assert s.rig.baseline == pytest.approx(0.1)
    assert "locus.cell_size" not in s.defaults


def test_standard_layout_by_folder_and_by_number(root):
    by_folder = open_sequence(str(root / "sequences" / "06"))
    by_number = open_sequence(f"{root}:06")
    only_one = open_sequence(str(root))
    for s in (by_folder, by_number, only_one):
        assert s.name == "kitti-06"
        assert s.times == (0.0, 0.1)
        assert s.truth[1].translation[2] == 1.0
        assert s.rig.baseline == pytest.approx(0.5)
        assert s.image(0, "left").hints["path"].endswith("image_0/000000.png")
    with raises("RIL-198", "'07'"):
        open_sequence(f"{root}:07")


def test_poses_are_those_of_camera_0_also_for_the_colour_pair(root):
    seq = root / "sequences" / "06"
    for side in ("image_0", "image_1"):
        (seq / side).rename(seq / f"unused_{side}")
    s = open_sequence(str(seq))
    assert s.image(0, "left").hints["path"].endswith("image_2/000000.png")
    assert s.rig.baseline == pytest.approx(0.5)
    # P2 = K [I | 0.06]: camera 2 stands 0.06 m to the left of camera 0
    np.testing.assert_allclose(s.truth[1].translation, [-0.06, 0.0, 1.0], atol=1e-12)


def test_general_projection_matrices_are_taken_apart(folder):
    R = rotation_exp([0.02, 0.15, -0.01])
    t = np.array([-0.4, 0.02, 0.05])
    P = K @ np.hstack([R, t[:, None]])
    for factor in (1.0, -2.5):  # a projection matrix has no scale
        (folder / "calib.txt").write_text(line(P_LEFT) + "\n" + line(factor * P))
        rig = open_sequence(str(folder)).rig
        np.testing.assert_allclose(rig.T_right_left.rotation, R, atol=1e-9)
        np.testing.assert_allclose(rig.T_right_left.translation, t, atol=1e-9)
        np.testing.assert_allclose(rig.right.matrix, K, rtol=1e-9)


def test_folders_are_left_and_right_whatever_the_case_of_numbers(folder):
    for side in ("image_l", "image_r"):
        (folder / side / "000002.png").rename(folder / side / "10.png")
        (folder / side / "000001.png").rename(folder / side / "9.png")
        (folder / side / "000000.png").rename(folder / side / "8.png")
    assert open_sequence(str(folder)).frame_names == ("8", "9", "10")


def breaks(name):
    """Register a way to spoil a folder, with the message it must give."""
    return pytest.param(*name[1:], id=name[0])


def _drop_right(f):
    for k in (1, 2):
        (f / "image_r" / f"{k:06d}.png").unlink()


def _drop_left(f):
    for k in (1, 2):
        (f / "image_l" / f"{k:06d}.png").unlink()


def _fewer_poses(f):
    text = (f / "poses.txt").read_text().splitlines()
    (f / "poses.txt").write_text("\n".join(text[:2]))


def _times(f):
    (f / "times.txt").write_text("0\n1\n2\n3\n")


def _no_calib(f):
    (f / "calib.txt").unlink()


def _one_row(f):
    (f / "calib.txt").write_text(line(P_LEFT))


def _short_row(f):
    (f / "calib.txt").write_text(line(P_LEFT) + "\n1 2 3\n")


def _millimetres(f):
    right = P_RIGHT.copy()
    right[:, 3] *= 1000
    (f / "calib.txt").write_text(line(P_LEFT) + "\n" + line(right))


def _singular(f):
    (f / "calib.txt").write_text(line(P_LEFT) + "\n" + line(np.diag([100.0, 0.0, 0.0])[:, [0, 1, 2, 2]]))


def _no_rotation(f):
    (f / "poses.txt").write_text("\n".join([line(P_LEFT)] * 3))


def _empty(f):
    for side in ("image_l", "image_r"):
        for path in (f / side).iterdir():
            path.unlink()


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        breaks(("right missing", _drop_right, ("RIL-259", "000001.png"))),
        breaks(("left missing", _drop_left, ("RIL-259", "image_r/000001.png"))),
        breaks(("pose count", _fewer_poses, ("RIL-230", "poses.txt"))),
        breaks(("time count", _times, ("RIL-229", "times.txt"))),
        breaks(("no calibration", _no_calib, ("RIL-278", "calib.txt"))),
        breaks(("one camera", _one_row, ("RIL-100", "calib.txt"))),
        breaks(("short row", _short_row, ("RIL-100", "calib.txt"))),
        breaks(("millimetres", _millimetres, ("RIL-244", "500", "0.5"))),
        breaks(("singular", _singular, ("RIL-203", "calib.txt", "P1"))),
        breaks(("no rotation", _no_rotation, ("RIL-333", "poses.txt", "line 1"))),
        breaks(("no images", _empty, ("RIL-217", "image_l"))),
    ],
)
def test_what_is_wrong_is_one_line_with_a_remedy(folder, spoil, expected):
    spoil(folder)
    with raises(*expected) as caught:
        open_sequence(str(folder))
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


def test_a_frame_that_lacks_an_image_is_lost_and_named(folder):
    (folder / "image_r" / "000001.png").unlink()
    s = open_sequence(str(folder))
    assert s.frames == 3
    assert s.lost == {1: "image_r/000001.png is missing"}
    assert s.truth[2].translation[2] == pytest.approx(2.4)
    assert s.image(2, "left").hints["path"].endswith("000002.png")


@pytest.mark.parametrize("rows", [5, 4])
def test_a_number_left_out_of_the_count_is_a_lost_frame(folder, rows):
    """Poses and times may have a line for each frame, or for those alone that have images."""
    numbers = [0, 1, 2, 3, 4]
    for side in ("image_l", "image_r"):
        for k in (3, 4):
            picture(folder / side / f"{k:06d}.png")
        (folder / side / "000001.png").unlink()
    if rows == 4:
        numbers.remove(1)
    (folder / "poses.txt").write_text("\n".join(line(np.hstack([np.eye(3), [[0], [0], [k]]])) for k in numbers))
    (folder / "times.txt").write_text("\n".join(f"{0.1 * k:.1f}" for k in numbers))
    s = open_sequence(str(folder))
    assert s.frame_names == tuple(f"{k:06d}" for k in range(5))
    assert s.lost == {1: "image_l/000001.png and image_r/000001.png are missing"}
    assert s.truth[2].translation[2] == pytest.approx(2.0)
    assert s.times == pytest.approx((0.0, 0.1, 0.2, 0.3, 0.4))
    assert (s.truth[1] is None) == (rows == 4)


def test_image_folders_are_those_with_images(tmp_path):
    for name in ("image_0", "image_1", "image_2", "image_3"):
        (tmp_path / name).mkdir()
    assert image_folders(tmp_path) == ("image_0", "image_1")  # still to come
    for name in ("image_2", "image_3"):
        (tmp_path / name / "000000.png").touch()
    assert image_folders(tmp_path) == ("image_2", "image_3")
    (tmp_path / "days" / "left" / "day1").mkdir(parents=True)
    (tmp_path / "days" / "right" / "day1").mkdir(parents=True)
    assert image_folders(tmp_path / "days") is None  # `rille init` finds them


def test_numbers_in_names_count_as_numbers(folder):
    for side in ("image_l", "image_r"):
        for k in range(3):
            (folder / side / f"{k:06d}.png").rename(folder / side / f"img{4 * k + 2}.png")
    assert open_sequence(str(folder)).frame_names == ("img2", "img6", "img10")


def test_numbers_that_do_not_count_on_by_one_are_names(folder):
    for side in ("image_l", "image_r"):
        (folder / side / "000002.png").rename(folder / side / "000007.png")
        (folder / side / "000001.png").rename(folder / side / "000003.png")
    s = open_sequence(str(folder))
    assert s.frame_names == ("000000", "000003", "000007")
    assert not s.lost


def test_truth_may_have_gaps(folder):
    rows = (folder / "poses.txt").read_text().splitlines()
    rows[1] = " ".join(["nan"] * 12)
    (folder / "poses.txt").write_text("\n".join(rows))
    s = open_sequence(str(folder))
    assert s.truth[1] is None
    assert s.truth[2].translation[2] == pytest.approx(2.4)


@pytest.mark.data
def test_real_street(data_dir, materialise):
    s = open_sequence(str(data_dir / "kitti06_51"))
    assert s.frames == 51
    assert s.rig.baseline == pytest.approx(0.5372, abs=1e-4)
    length = sum(
        float(np.linalg.norm(b.translation - a.translation)) for a, b in zip(s.truth, s.truth[1:], strict=False)
    )
    assert length == pytest.approx(59.9, abs=0.1)
    image = materialise(s.image(50, "left"))["image"]
    assert image.shape == (370, 1226)
    assert image.dtype == np.uint8


@pytest.mark.parametrize(("name", "code"), [("poses.txt", "RIL-230"), ("times.txt", "RIL-229")])
def test_a_folder_opens_without_a_table_of_another_rate(folder, name, code):
    rows = {"poses.txt": (folder / "poses.txt").read_text().splitlines()[:2], "times.txt": ["0", "0.1"]}
    (folder / name).write_text("\n".join(rows[name]))
    with raises(code, f"rename {folder / name}: the folder opens without it"):
        open_sequence(str(folder))
    (folder / name).unlink()
    assert open_sequence(str(folder)).frames == 3


def test_complaints_name_the_line_of_the_file(folder):
    """Also where a blank line, or a frame without images, makes lines and frames differ."""
    for side in ("image_l", "image_r"):
        picture(folder / side / "000003.png")
    (folder / "image_r" / "000001.png").unlink()
    good, bad = line(np.hstack([np.eye(3), np.zeros((3, 1))])), line(np.hstack([2 * np.eye(3), np.zeros((3, 1))]))
    for text, at in (("\n".join([good, bad, good]), 2), ("\n".join([good, "", good, bad]), 4)):
        (folder / "poses.txt").write_text(text)
        with raises("RIL-333", f"poses.txt, line {at}:"):
            open_sequence(str(folder))
    (folder / "poses.txt").unlink()
    (folder / "times.txt").write_text("0\n\n2\n1\n")
    with raises("RIL-293", "times.txt, line 4:"):
        open_sequence(str(folder))
