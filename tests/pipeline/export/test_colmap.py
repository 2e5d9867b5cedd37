"""A run as a COLMAP model: written, read again, and compared with what went in."""

import numpy as np
import pycolmap
from raising import raises

from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.colmap import build, export_run
from rille.stages.core.declare import Bundle
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
    return Bundle({"poses": given}, {"frames": FRAMES}), [(track, resection)], poses, world


def test_the_model_read_again_has_our_cameras_poses_and_points(tmp_path):
    trajectory, segments, poses, world = parts()
    model, count = build(RIG, trajectory, {3: "a.png"}, segments)
    model.write_text(str(tmp_path))
    again = pycolmap.Reconstruction(str(tmp_path))
    assert again.num_reg_frames() == 2  # the lost frame is left out
    assert count == again.num_points3D() == 40
    left = {image.name: image for image in again.images.values()}
    assert sorted(left) == ["left/000005", "left/a.png", "right/000005", "right/a.png"]
    for name, T in (("a.png", poses[0]), ("000005", poses[2])):
        np.testing.assert_allclose(left[f"left/{name}"].cam_from_world().matrix(), T.inverse().matrix34, atol=1e-9)
        right = RIG.T_right_left @ T.inverse()
        np.testing.assert_allclose(left[f"right/{name}"].cam_from_world().matrix(), right.matrix34, atol=1e-9)
    found = np.array([p.xyz for p in again.points3D.values()])
    np.testing.assert_allclose(found[np.lexsort(found.T)], world[np.lexsort(world.T)], atol=1e-6)
    assert sum(p.track.length() for p in again.points3D.values()) == 79
    for point in again.points3D.values():
        for element in point.track.elements:
            image = again.images[element.image_id]
            seen = image.points2D[element.point2D_idx].xy
            np.testing.assert_allclose(
                image.project_point(point.xyz), seen, atol=1e-3
            )  # float32 pixels, digits of text


def test_what_is_no_run_or_has_content_is_said(tmp_path):
    with raises("RIL-608"):
        export_run(tmp_path, tmp_path / "model", Store(tmp_path / "cache"))
    (tmp_path / "x").touch()
    with raises("RIL-607"):
        export_run(tmp_path, tmp_path, Store(tmp_path / "cache"))
