"""A finished run as a COLMAP model: cameras, their rig, poses, and the tracked points with their coordinates.

COLMAP puts the centre of the first pixel at (0.5, 0.5) and stores world-to-camera poses. The rig is the one that was
computed with; images are those of an ideal camera, so where a lens was undone the files on disk are not the model's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rille.pipeline.engine import events
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import InputError
from rille.stages.evaluation.crosscheck import PIXEL_CENTRE
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.odometry.resection.trajectory import world_poses

LEFT, RIGHT = 1, 2
"""Numbers of the two cameras; the rig has number 1, too, and the left camera is its origin."""


def export_run(run: Path, target: Path, store: Store) -> str:
    """Write the model of a run folder as COLMAP's text files; the line to print.

    Raises
    ------
    InputError
        The folder holds no finished run, its artifacts are gone from the cache, or the target is not empty.
    """
    if target.exists() and any(target.iterdir()):
        raise InputError("RIL-607", f"{target} is not empty", remedy="give a new folder with --output")
    bundles = _Artifacts(run, store)
    rig = Rig.from_dict(bundles.one("calibration").meta["rig"])
    trajectory = bundles.one("trajectory")
    model, points = build(rig, trajectory, _names(run), bundles.pairs("track", "resect"))
    target.mkdir(parents=True, exist_ok=True)
    model.write_text(str(target))
    return (
        f"{target}: {model.num_reg_frames()} frames of 2 images, {points} points; open it with colmap gui --import_path"
    )


def build(
    rig: Rig, trajectory: Bundle, names: Mapping[int, str], segments: list[tuple[Bundle, Bundle]]
) -> tuple[Any, int]:
    """A ``pycolmap.Reconstruction``, and how many points it has.

    Parameters
    ----------
    trajectory : result of that stage; frames without a pose in the world are left out.
    names : image name of each frame, written as ``left/NAME`` and ``right/NAME``.
    segments : results of ``track`` and ``resect`` of each segment.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    poses = {
        int(f): RigidTransform.from_matrix(pose)
        for f, pose in zip(trajectory.meta["frames"], world_poses(trajectory), strict=True)
        if np.isfinite(pose).all()
    }
    cameras = [_camera(pycolmap, number, camera) for number, camera in ((LEFT, rig.left), (RIGHT, rig.right))]
    for camera in cameras:
        model.add_camera(camera)
    body = pycolmap.Rig(rig_id=1)
    body.add_ref_sensor(cameras[0].sensor_id)
    body.add_sensor(cameras[1].sensor_id, _rigid(pycolmap, rig.T_right_left))
    model.add_rig(body)
    seen, points = _points(segments, poses)
    for number, (frame, T_world_left) in enumerate(poses.items()):
        ours = pycolmap.Frame(frame_id=number + 1, rig_id=1)
        for side, camera in enumerate(cameras):
            ours.add_data_id(pycolmap.data_t(camera.sensor_id, 2 * number + side + 1))
        ours.rig_from_world = _rigid(pycolmap, T_world_left.inverse())
        model.add_frame(ours)
        for side, camera in enumerate(cameras):
            pixels = np.array(seen.get(frame, []) if side == 0 else []).reshape(-1, 2) + PIXEL_CENTRE
            name = f"{('left', 'right')[side]}/{names.get(frame, f'{frame:06d}')}"
            image = pycolmap.Image(
                name=name, keypoints=pixels, camera_id=camera.camera_id, image_id=2 * number + side + 1
            )
            image.frame_id = number + 1
            model.add_image(image)
    order = {frame: 2 * number + 1 for number, frame in enumerate(poses)}
    for position, where in points:
        track = pycolmap.Track([pycolmap.TrackElement(order[frame], index) for frame, index in where])
        model.add_point3D(position, track)
    for number in range(len(poses)):
        model.register_frame(number + 1)
    return model, len(points)


Seen = dict[int, list[list[float]]]
Point = tuple[Any, list[tuple[int, int]]]


def _points(segments: list[tuple[Bundle, Bundle]], poses: Mapping[int, RigidTransform]) -> tuple[Seen, list[Point]]:
    """Pixels by frame, and points in the world with (frame, number of the pixel) of each view that agreed."""
    seen: Seen = {}
    points: list[Point] = []
    for track, resection in segments:
        frames = [int(f) for f in track.meta["frames"]]
        key = frames[0]
        if key not in poses:
            continue
        T_local_key = RigidTransform.from_matrix(np.asarray(resection["poses"])[0])
        world = (poses[key] @ T_local_key.inverse()).apply(np.asarray(resection["landmarks"]))
        agrees, pixels = np.asarray(resection["inlier"]) != 0, np.asarray(track["points"], dtype=np.float64)
        for k in np.flatnonzero(np.isfinite(world).all(1) & (agrees.sum(1) > 1)):
            where = []
            for j in np.flatnonzero(agrees[k]):
                if frames[j] in poses:
                    mine = seen.setdefault(frames[j], [])
                    where.append((frames[j], len(mine)))
                    mine.append([float(v) for v in pixels[k, j]])
            points.append((world[k], where))
    return seen, points


def _camera(pycolmap: Any, number: int, camera: Camera) -> Any:
    values = [camera.fx, camera.fy, camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE]
    return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=values, camera_id=number)


def _rigid(pycolmap: Any, T: RigidTransform) -> Any:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(T.rotation)), np.array(T.translation))


def _names(run: Path) -> dict[int, str]:
    """Image names by frame number, as the run wrote them down."""
    facts = json.loads((run / "frames.json").read_text(encoding="utf-8"))
    rows = facts.get("frames", [])
    return {int(r["frame"]): str(r["name"]) for r in rows if isinstance(r, dict) and "name" in r}


class _Artifacts:
    """What a run's ledger refers to."""

    def __init__(self, run: Path, store: Store) -> None:
        path = run / "ledger.jsonl"
        if not path.is_file():
            raise InputError(
                "RIL-608", f"{run} holds no ledger.jsonl", remedy="give the folder of a run, e.g. runs/mockup/latest"
            )
        self.store = store
        self.rows = [row for row in events.read(path) if row["status"] in ("computed", "cached") and "key" in row]

    def one(self, label: str) -> Bundle:
        """The artifact of this label."""
        row = next((r for r in self.rows if r["label"].split("/")[0] == label), None)
        if row is None:
            raise InputError("RIL-609", f"the run has no {label}", remedy="finish it with rille reconstruct")
        return self._open(row)

    def pairs(self, first: str, second: str) -> list[tuple[Bundle, Bundle]]:
        """Artifacts of two stages with the same rest of the label."""
        mine = {
            name: {r["label"].partition("/")[2]: r for r in self.rows if r["stage"] == name} for name in (first, second)
        }
        return [(self._open(r), self._open(mine[second][k])) for k, r in mine[first].items() if k in mine[second]]

    def _open(self, row: Mapping[str, Any]) -> Bundle:
        ref = self.store.lookup(str(row["stage"]), str(row["key"]))
        if ref is None:
            raise InputError(
                "RIL-610", f"{row['label']} is not in the cache", remedy="name the run's cache with --cache"
            )
        return self.store.open(ref)
