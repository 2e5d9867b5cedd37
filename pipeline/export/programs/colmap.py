"""A finished run as a COLMAP model: cameras, their rig, poses, and the tracked points with their coordinates.

COLMAP puts the centre of the first pixel at (0.5, 0.5) and stores world-to-camera poses. The rig is that of the
computation; it has number 1, its cameras 1 (left, its origin) and 2. Images are those of an ideal camera: if distortion
was removed, the image files on disk do not fit the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.datasets.protocol import CAMERAS
from rille.pipeline.export.programs.placed_pairs import placed_frames
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.read_dem import frames_of
from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import Bundle
from rille.stages.evaluation.crosscheck import colmap_rig
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.imaging.features import PIXEL_CENTRE
from rille.stages.odometry.resection.landmarks import matches_at
from rille.stages.terrain.points import colours

MAX_REPROJECTION_PX = 0.5
"""Pixels: largest distance of an observation from its point's projection. COLMAP weights all observations equally, so
that those of little weight in our resection would distort an adjustment: on a street of 60 m by 0.45 m, with the limit
by 0.10 m."""

Seen = dict[tuple[int, str], list[Floats]]
"""Observations (column, row) in COLMAP's pixel coordinates by image, i.e. frame and side."""


class MatchedSegment(NamedTuple):
    """Tracks from one key frame to the next, their resection, and the disparities of its pairs by frame number."""

    track: Bundle
    resection: Bundle
    matches: Mapping[int, Bundle]


def write_run(folder: Path, run: RunArtifacts) -> str:
    """Write the model of a run as COLMAP's text files into a new folder; return its content, in words."""
    rig = Rig.from_dict(run.one("calibration").meta["rig"])
    segments = _segments(run)
    keys = [_ends(segment.track)[0] for segment in segments]
    images = {key: run.left_image(key) for key in keys}
    names = {int(row["frame"]): str(row["name"]) for row in frames_of(run.run / "frames.json").get("frames", [])}
    # A drive has a trajectory at each stop: the last one is complete.
    model = build(rig, run.one("trajectory", last=True), names, segments, images)
    folder.mkdir()
    model.write_text(str(folder))
    points = f"{model.num_points3D()} points, {model.compute_mean_reprojection_error():.2f} px"
    return f"{model.num_reg_frames()} frames of 2 images, {points}; open it with colmap gui --import_path"


def _segments(bundles: RunArtifacts) -> list[MatchedSegment]:
    """Segments of a run, in order."""
    # A leg that was stopped is tracked once more, up to the stop: the later one counts.
    tracks, resections = bundles.all("track"), bundles.all("resect")
    of_key = {_ends(track)[0]: (track, resections[part]) for part, track in tracks.items() if part in resections}
    segments = []
    for _, (track, resection) in sorted(of_key.items(), key=itemgetter(0)):
        matches = {f: pair for f in _ends(track) if (pair := bundles.find(f"hfvm/{f}")) is not None}
        segments.append(MatchedSegment(track, resection, matches))
    return segments


def build(
    rig: Rig,
    trajectory: Bundle,
    names: Mapping[int, str],
    segments: Sequence[MatchedSegment],
    images: Mapping[int, Bundle],
) -> Any:
    """A ``pycolmap.Reconstruction``.

    A point is observed in the left images where it agreed with the pose, and in the right image of each matched pair,
    without which an adjustment of the model could change its scale.

    Parameters
    ----------
    trajectory : result of that stage; frames without a pose in the world are left out.
    names : image name of each frame, written as ``left/NAME`` and ``right/NAME``.
    images : left images of key frames, for the colours of the points.
    """
    from rille.stages.geometry.colmap import pycolmap

    poses = placed_frames(trajectory)
    # Before images are made, since each point adds observations to them.
    seen: Seen = {(frame, side): [] for frame in poses for side in CAMERAS}
    points = [point for segment in segments for point in _points(segment, rig, poses, seen, images)]
    number = {image: k for k, image in enumerate(seen, start=1)}

    model = pycolmap.Reconstruction()
    both, body = colmap_rig(rig)
    cameras = dict(zip(CAMERAS, both, strict=True))
    for camera in cameras.values():
        model.add_camera(camera)
    model.add_rig(body)
    for k, (frame, T_world_left) in enumerate(poses.items(), start=1):
        ours = pycolmap.Frame(frame_id=k, rig_id=1)
        for side, camera in cameras.items():
            ours.add_data_id(pycolmap.data_t(camera.sensor_id, number[frame, side]))
        ours.rig_from_world = pycolmap.Rigid3d(np.array(T_world_left.inverse().matrix34))
        model.add_frame(ours)
        for side, camera in cameras.items():
            # COLMAP's text files end a name at a blank.
            name = f"{side}/{names.get(frame, f'{frame:06d}.png')}".replace(" ", "_")
            pixels, at = np.array(seen[frame, side]).reshape(-1, 2), number[frame, side]
            image = pycolmap.Image(name=name, keypoints=pixels, camera_id=camera.camera_id, image_id=at)
            image.frame_id = k
            model.add_image(image)
    for position, elements, colour in points:
        track = pycolmap.Track([pycolmap.TrackElement(number[image], at) for image, at in elements])
        model.add_point3D(position, track, colour)
    for k in range(1, len(poses) + 1):
        model.register_frame(k)
    model.update_point_3d_errors()
    return model


def _ends(track: Bundle) -> list[int]:
    """First and last frame of a segment: its key frames."""
    frames = track.meta["frames"]
    return [int(frames[0]), int(frames[-1])]


def _points(
    segment: MatchedSegment, rig: Rig, poses: Mapping[int, RigidTransform], seen: Seen, images: Mapping[int, Bundle]
) -> Iterator[tuple[Floats, list[tuple[tuple[int, str], int]], Bytes]]:
    """Points of a segment in the world, each with its observations (image, index of its pixel) and colour.

    The pixels are added to ``seen``.
    """
    frames = [int(f) for f in segment.track.meta["frames"]]
    key = frames[0]
    if key not in poses:
        return
    T_local_key = RigidTransform.from_matrix(np.asarray(segment.resection["poses"])[0])
    world = (poses[key] @ T_local_key.inverse()).apply(np.asarray(segment.resection["landmarks"]))
    # Pixels (point, frame, camera, 2) of left and right cameras, and which of them are observations.
    pixels = np.repeat(np.asarray(segment.track["points"], dtype=np.float64)[:, :, None], 2, axis=2)
    shown = np.zeros(pixels.shape[:3], bool)
    for j, frame in enumerate(frames):
        if frame not in poses:
            continue
        in_left, left = poses[frame].inverse().apply(world), pixels[:, j, 0]
        agrees = np.asarray(segment.resection["inlier"])[:, j] != 0
        shown[:, j, 0] = agrees & _near(rig.left, in_left, left)
        if (pair := segment.matches.get(frame)) is not None:
            vectors, matched, _ = matches_at(left, pair)
            pixels[:, j, 1] += vectors
            shown[:, j, 1] = agrees & matched & _near(rig.right, rig.T_right_left.apply(in_left), pixels[:, j, 1])
    last = rig.left.width - 1, rig.left.height - 1
    first = np.clip(np.nan_to_num(pixels[:, 0, 0]).astype(int), 0, last)
    rgb = colours(first, images[key])
    # Points with one observation are not determined.
    for k in np.flatnonzero(np.isfinite(world).all(1) & (shown.sum(axis=(1, 2)) > 1)):
        elements = []
        for j, side in np.argwhere(shown[k]):
            image = frames[j], CAMERAS[side]
            elements.append((image, len(seen[image])))
            seen[image].append(pixels[k, j, side] + PIXEL_CENTRE)
        yield world[k], elements, rgb[k]


def _near(camera: Camera, points: Floats, pixels: Floats) -> NDArray[np.bool_]:
    """Which points (n, 3) of the camera frame, metres, project to within the limit of pixels (n, 2)."""
    return np.asarray(np.hypot(*(camera.project(points) - pixels).T) <= MAX_REPROJECTION_PX)
