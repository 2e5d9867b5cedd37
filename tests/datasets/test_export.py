"""A sequence written as plain files is the same sequence when read back."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from raising import raises
from scipy.ndimage import map_coordinates

from rille.datasets.export import export
from rille.datasets.mockup import sequence as seq
from rille.datasets.registry import open_sequence
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens


@pytest.fixture(scope="module")
def exported(tmp_path_factory, tiny, materialise):
    folder = tmp_path_factory.mktemp("export") / "bed"
    sequence = seq.mockup(tiny.model_copy(update={"rig_error_deg": (0.0, 0.2, 0.0)}))
    strided = replace(sequence, defaults={**sequence.defaults, "keyframes.stride": 2})
    export(strided, folder, materialise)
    return sequence, folder


def test_round_trip(exported, materialise):
    sequence, folder = exported
    back = open_sequence(str(folder))
    assert back.frame_names == sequence.frame_names
    assert back.times == sequence.times
    for a, b in ((back.rig.left, sequence.rig.left), (back.rig.right, sequence.rig.right)):
        np.testing.assert_allclose(a.matrix, b.matrix, rtol=1e-12)
        assert (a.width, a.height) == (b.width, b.height)
    assert back.vehicle == sequence.vehicle
    np.testing.assert_allclose(back.rig.T_right_left.matrix34, sequence.rig.T_right_left.matrix34, atol=1e-12)
    for a, b in zip(back.truth, sequence.truth, strict=True):
        np.testing.assert_allclose(a.matrix34, b.matrix34, atol=1e-12)
    for frame in range(sequence.frames):
        for camera in ("left", "right"):
            np.testing.assert_array_equal(
                materialise(back.image(frame, camera))["image"], materialise(sequence.image(frame, camera))["image"]
            )


def test_plain_files_say_the_same(exported, materialise):
    sequence, folder = exported
    assert Rig.from_dict(json.loads((folder / "rig.json").read_text())).to_dict() == sequence.rig.to_dict()
    mask = cv2.imread(str(folder / "valid" / "left" / "000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask // 255, materialise(sequence.image(0, "left"))["valid"])
    truth = np.load(folder / "disparity" / "000002.npz")
    np.testing.assert_array_equal(truth["column"], materialise(sequence.truth_disparity(2))["column_disparity"])
    assert sorted(p.stem for p in (folder / "dem").iterdir()) == ["000000", "000002"]
    text = (folder / "README.txt").read_text()
    assert "right minus left" in text
    assert "T_truth_left" in text
    left = sequence.rig.left
    assert f"{left.width} x {left.height}" in text


def test_both_sizes_are_stated_where_they_differ(exported, materialise, tmp_path):
    sequence, _ = exported
    rig = replace(sequence.rig, right=replace(sequence.rig.right, width=99, height=77))
    export(replace(sequence, rig=rig), tmp_path, materialise)
    left, text = sequence.rig.left, (tmp_path / "README.txt").read_text()
    assert f"stereo pairs, left {left.width} x {left.height}, right 99 x 77 pixels." in text


def test_dem_cells_project_onto_the_true_disparity(exported, tiny):
    """The exported figures agree with one another: DEM, poses, rig of the pictures, disparity."""
    _, folder = exported
    dem, disparity = np.load(folder / "dem" / "000000.npz"), np.load(folder / "disparity" / "000000.npz")
    rig = seq.true_rig(tiny)
    rows, cols = np.nonzero(dem["seen"])
    assert len(rows) > 1000
    points = np.stack(
        [dem["x0"] + cols * dem["cell"], dem["y0"] - rows * dem["cell"], dem["elevation"][rows, cols]], axis=1
    )
    T_truth_left = RigidTransform.from_matrix(np.loadtxt(folder / "poses.txt")[0])
    in_left = T_truth_left.inverse().apply(RigidTransform.from_matrix(dem["T_truth_local"]).apply(points))
    left, right = rig.left.project(in_left), rig.right.project(rig.T_right_left.apply(in_left))
    found = np.stack([map_coordinates(disparity[k], left.T[::-1], order=1) for k in ("column", "row")], axis=1)
    # between pixels of 5 mm the bed is not linear: millimetres of relief, f B / Z^2 = 40 px a metre, make 0.04 px
    error = np.abs(found - (right - left)).max(axis=1)
    assert np.median(error) < 0.04


def test_gaps_of_truth_are_kept_and_lost_frames_are_left_out(tiny, tmp_path, materialise):
    sequence = seq.mockup(tiny)
    truth = (None, *sequence.truth[1:])
    export(replace(sequence, lost={1: "gone"}, truth=truth), tmp_path / "out", materialise)
    back = open_sequence(str(tmp_path / "out"))
    assert back.frame_names == ("000000", "000002")
    assert back.times == (sequence.times[0], sequence.times[2])
    assert back.truth[0] is None
    np.testing.assert_array_equal(back.truth[1].translation, truth[2].translation)


def test_lens_distortion_is_refused(tiny, tmp_path, materialise):
    """Raw images beside an ideal camera's calibration would be taken for undistorted ones."""
    sequence = seq.mockup(tiny)
    lens = Lens(sequence.rig.left, "radtan", (0.1, 0.0, 0.0, 0.0))
    with raises("RIL-184"):
        export(replace(sequence, lenses={"left": lens}), tmp_path / "out", materialise)
    assert not (tmp_path / "out").exists()
