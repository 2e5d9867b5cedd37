"""A run as a COLMAP model: written, read again, and compared with what went in."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from raising import raises
from toys.artifacts import recorded

from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs import colmap
from rille.pipeline.export.programs.colmap import MatchedSegment, build
from rille.pipeline.export.programs.run_artifacts import export_run
from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp

CAMERA = Camera(400.0, 410.0, 319.5, 239.5, 640, 480)
RIG = Rig(CAMERA, CAMERA, RigidTransform(rotation_exp([0.0, 0.1, 0.0]), np.array([-0.2, 0.0, 0.01])))
FRAMES = [3, 4, 5]


def parts():
    """Three frames of one segment, the second lost, and points that all see but one."""
    rng = np.random.default_rng(7)
    poses = [RigidTransform(rotation_exp(rng.normal(0, 0.1, 3)), np.array([0.1 * k, 0.0, 0.3 * k])) for k in range(3)]
    T_local_key = RigidTransform(rotation_exp([-1.6, 0.0, 0.0]), np.zeros(3))
    world = CAMERA.rays(rng.uniform(100, 380, (40, 2))) * rng.uniform(4, 9, (40, 1))
    T_local_world = T_local_key @ poses[0].inverse()
    pixels = np.stack([CAMERA.project(T.inverse().apply(world)) for T in poses], axis=1)
    inlier = np.ones((40, 3), np.uint8)
    inlier[0, 2] = 0
    given = np.array([T.matrix34 for T in poses])
    given[1] = np.nan
    track = Bundle({"points": pixels.astype(np.float32)}, {"frames": FRAMES})
    resection = Bundle(
        {
            "poses": np.array([(T_local_world @ T).matrix34 for T in poses]),
            "landmarks": T_local_world.apply(world),
            "inlier": inlier,
        },
        {},
    )
    matches = disparities(pixels[:, 0], RIG.right.project((RIG.T_right_left @ poses[0].inverse()).apply(world)))
    return (
        Bundle({"poses": given, "piece": np.zeros(3, np.int16)}, {"frames": FRAMES, "main": 0}),
        [MatchedSegment(track, resection, {FRAMES[0]: matches})],
        poses,
        world,
    )


def disparities(left, right):
    """Matches of the four pixels around each point, but around the last one."""
    column, row = (np.full((480, 640), np.nan, np.float32) for _ in range(2))
    validity = np.zeros((480, 640), np.uint8)
    for (x, y), (dx, dy) in zip(left[:-1].astype(int), (right - left)[:-1], strict=True):
        here = slice(y, y + 2), slice(x, x + 2)
        column[here], row[here], validity[here] = dx, dy, Validity.MATCHED
    return Bundle({"column_disparity": column, "row_disparity": row, "validity": validity}, {})


SHADE = Bundle({"image": np.full((480, 640), 77, np.uint8)}, {})


def test_the_model_read_again_has_our_cameras_poses_and_points(tmp_path):
    trajectory, segments, poses, world = parts()
    build(RIG, trajectory, {3: "a.png"}, segments, {3: SHADE}).write_text(str(tmp_path))
    again = pycolmap.Reconstruction(str(tmp_path))
    assert again.num_reg_frames() == 2  # the lost frame is left out
    assert again.num_points3D() == 40
    left = {image.name: image for image in again.images.values()}
    assert sorted(left) == ["left/000005.png", "left/a.png", "right/000005.png", "right/a.png"]
    for name, T in (("a.png", poses[0]), ("000005.png", poses[2])):
        np.testing.assert_allclose(left[f"left/{name}"].cam_from_world().matrix(), T.inverse().matrix34, atol=1e-9)
        right = RIG.T_right_left @ T.inverse()
        np.testing.assert_allclose(left[f"right/{name}"].cam_from_world().matrix(), right.matrix34, atol=1e-9)
    found = np.array([p.xyz for p in again.points3D.values()])
    np.testing.assert_allclose(found[np.lexsort(found.T)], world[np.lexsort(world.T)], atol=1e-6)
    assert sum(p.track.length() for p in again.points3D.values()) == 79 + 39, (
        "left images, and the key frame's right one"
    )
    assert {tuple(p.color) for p in again.points3D.values()} == {(77, 77, 77)}
    assert max(p.error for p in again.points3D.values()) < 1e-2
    for point in again.points3D.values():
        for element in point.track.elements:
            image = again.images[element.image_id]
            seen = image.points2D[element.point2D_idx].xy
            np.testing.assert_allclose(
                image.project_point(point.xyz), seen, atol=1e-3
            )  # float32 pixels, digits of text


def test_an_adjustment_of_the_model_keeps_its_scale():
    trajectory, segments, poses, _ = parts()
    noise = np.random.default_rng(1).normal(0, 0.3, segments[0].track["points"].shape)
    track = Bundle({"points": segments[0].track["points"] + noise.astype(np.float32)}, segments[0].track.meta)
    model = build(RIG, trajectory, {}, [segments[0]._replace(track=track)], {3: SHADE})
    for point in model.points3D.values():
        point.xyz *= 1.05
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    pycolmap.bundle_adjustment(model, options)
    first, last = (model.frames[k].rig_from_world.inverse().translation for k in (1, 2))
    true = poses[2].translation - poses[0].translation
    assert abs(np.linalg.norm(last - first) / np.linalg.norm(true) - 1.0) < 0.02


def driven(folder):
    """The folder and the artifacts of a drive of one leg, which was stopped; lenses were undone."""
    trajectory, segments, _, _ = parts()
    track, resection, matches = segments[0].track, segments[0].resection, segments[0].matches
    start = Bundle({n: a[:1] for n, a in trajectory.arrays.items()}, {"frames": FRAMES[:1], "main": 0})
    made = {
        "calibration": Bundle({}, {"rig": RIG.to_dict()}),
        f"hfvm/{FRAMES[0]}": matches[FRAMES[0]],
        f"image/left/{FRAMES[0]}": Bundle({"image": np.full((480, 640), 200, np.uint8)}, {}),
        f"undistort/left/{FRAMES[0]}": Bundle({"image": np.full((480, 640), 76.6, np.float32)}, {}),
        "trajectory/0": start,
        "track/3": track,
        "resect/3": resection,
        "track/3/stopped": track,
        "resect/3/stopped": resection,
        "trajectory/1": trajectory,
    }
    (folder / "frames.json").write_text("{}")
    return recorded(folder, made)


def test_a_drive_gives_its_whole_trajectory_and_each_point_once(tmp_path):
    export_run("colmap", tmp_path, tmp_path / "model", driven(tmp_path))
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert model.num_reg_frames() == 2
    assert model.num_points3D() == 40
    assert {tuple(p.color) for p in model.points3D.values()} == {(77, 77, 77)}, "of the image without distortion"


def test_a_model_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    class Full:
        def write_text(self, folder):
            (Path(folder) / "cameras.txt").write_text("half")
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(colmap, "build", lambda *_: Full())
    with pytest.raises(OSError, match="No space"):
        export_run("colmap", tmp_path, tmp_path / "model", driven(tmp_path))
    assert {p.name for p in tmp_path.iterdir()} == {"ledger.jsonl", "frames.json"}


def test_a_folder_with_content_is_said(tmp_path):
    (tmp_path / "x").touch()
    with raises("RIL-607"):
        export_run("colmap", tmp_path, tmp_path, Store(tmp_path / "cache"))
