"""Camera poses by another program, for comparison: structure from motion by COLMAP over a window of stereo frames.

No other stage of the run enters. Verification of matches, registration, triangulation and bundle adjustment are
pycolmap's (Schönberger & Frahm 2016, doi:10.1109/CVPR.2016.445), features OpenCV's
(:mod:`rille.stages.imaging.features`). Both trajectories share the given calibration: the two cameras are one rig whose
relative pose and intrinsics are held, so that the scale is metric. A model begins with the two images of one frame,
whose baseline is known. By default COLMAP begins with any two images, at an arbitrary scale, by which the rig's
baseline may be negligible, and the model grows to thousands of times its size. Everything runs in memory, on one thread
and with fixed seeds, so that the same images give the same bytes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, Memory, Params, stage
from rille.stages.facts.evaluation import WindowFacts
from rille.stages.geometry.epipolar import line_distances
from rille.stages.geometry.geometry import Rig
from rille.stages.imaging.features import PIXEL_CENTRE, match

OVERLAP = 3
"""Frames that successive windows share, by which they are joined."""

SEED = 0
"""Seed of COLMAP's random sampling."""

MIN_MATCHES = 15
"""COLMAP's own limit for a pair of images to count."""


Verified = dict[tuple[int, int], NDArray[np.uint32]]
"""Indices (m, 2) of the matching features of pairs of images, by their numbers (:func:`image_pairs`)."""


class CrosscheckParams(Params):
    """Parameters of the second opinion on the trajectory.

    Attributes
    ----------
    enabled : compute the trajectory with COLMAP as well, and compare.
    window : frames per bundle adjustment; larger: fewer and longer tasks.
    """

    enabled: bool = True
    window: int = Field(20, gt=OVERLAP)


def windows(frames: Sequence[int], params: CrosscheckParams) -> list[list[int]]:
    """Frames of each window, in order: as few as possible of at most ``window`` frames, all of nearly equal length."""
    count = max(1, math.ceil((len(frames) - OVERLAP) / (params.window - OVERLAP)))
    edges = [k * (len(frames) - OVERLAP) // count for k in range(count + 1)]
    return [list(frames[a : b + OVERLAP]) for a, b in itertools.pairwise(edges)]


def image_pairs(frames: int) -> list[tuple[int, int]]:
    """Pairs of image numbers to match: left and right of a frame, and images of one camera up to two frames apart;
    three change no error by a tenth.

    Image ``2 k + 1`` is the left one of frame k, ``2 k + 2`` the right one. Left and right of *other* frames are not
    matched: that takes time and adds no accuracy.
    """
    pairs = []
    for k in range(frames):
        pairs.append((2 * k + 1, 2 * k + 2))
        # Later frames only: a pair is matched once.
        for j in range(k + 1, min(k + 2, frames - 1) + 1):
            pairs += [(2 * k + 1, 2 * j + 1), (2 * k + 2, 2 * j + 2)]
    return pairs


def colmap_rig(rig: Rig) -> tuple[list[Any], Any]:
    """Left and right camera, without lens distortion, and their rig in COLMAP's form."""
    from rille.stages.geometry.colmap import pycolmap

    cameras = []
    for number, camera in ((1, rig.left), (2, rig.right)):
        values = [camera.fx, camera.fy, camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE]
        size = {"width": camera.width, "height": camera.height}
        cameras.append(pycolmap.Camera(model="PINHOLE", params=values, camera_id=number, **size))
        cameras[-1].has_prior_focal_length = True
    body = pycolmap.Rig(rig_id=1)
    body.add_ref_sensor(cameras[0].sensor_id)
    # COLMAP's sensor_from_rig is the pose of the right camera in the frame of the left, as ours.
    body.add_sensor(cameras[1].sensor_id, pycolmap.Rigid3d(np.array(rig.T_right_left.matrix34)))
    return cameras, body


def _widened(camera: Any) -> Floats:
    """Columns and rows, px, by which a camera is extended at the left and at the top to hold its principal point.

    COLMAP registers no image with its principal point outside, as cropped images may have it.
    """
    shift: Floats = np.maximum(-np.asarray(camera.params[2:], np.float64), 0.0)
    camera.params = np.array([*camera.params[:2], *(camera.params[2:] + shift)])
    camera.width, camera.height = (
        math.ceil(max(size + by, c))
        for size, by, c in zip((camera.width, camera.height), shift, camera.params[2:], strict=True)
    )
    return shift


def _write_frames(database: Any, rig: Rig, features: Sequence[Bundle]) -> Verified:
    """Write rig, features and verified matches to the database; return the matches of each image pair that has enough.

    ``features`` of stage ``features``, left and right in turn.
    """
    from rille.stages.geometry.colmap import pycolmap

    cameras, body = colmap_rig(rig)
    shifts = [_widened(camera) for camera in cameras]
    for camera in cameras:
        database.write_camera(camera, use_camera_id=True)
    database.write_rig(body, use_rig_id=True)
    points = [(np.asarray(b["points"]) + shifts[k % 2]).astype(np.float32) for k, b in enumerate(features)]
    descriptors = [np.asarray(b["descriptors"], np.float32) for b in features]
    for k in range(len(features) // 2):
        frame = pycolmap.Frame(frame_id=k + 1, rig_id=1)
        for side, camera in enumerate(cameras):
            number = 2 * k + side + 1
            image = pycolmap.Image(name=f"{k:06d}/{side}", camera_id=side + 1, image_id=number)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(number, points[number - 1])
            frame.add_data_id(pycolmap.data_t(camera.sensor_id, number))
        database.write_frame(frame, use_frame_id=True)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.num_threads = SEED, 1
    # COLMAP's 100 are more than needed: nearly all matches are right; else it draws more.
    options.ransac.min_num_trials = 30
    options.detect_watermark = False
    verified = {}
    for i, j in image_pairs(len(features) // 2):
        matches = match(descriptors[i - 1], descriptors[j - 1])
        if len(matches) < MIN_MATCHES:
            continue
        geometry = pycolmap.estimate_two_view_geometry(
            cameras[(i - 1) % 2], points[i - 1], cameras[(j - 1) % 2], points[j - 1], matches, options
        )
        database.write_matches(i, j, matches)
        database.write_two_view_geometry(i, j, geometry)
        if len(geometry.inlier_matches) >= MIN_MATCHES:
            verified[i, j] = geometry.inlier_matches
    return verified


def _stereo_points(features: Sequence[Bundle], verified: Verified) -> dict[int, tuple[Floats, Floats]]:
    """Points (m, 2), (m, 2), px, at which left and right match, by the number of the left image."""
    # Pairs of one camera lie an even number of images apart.
    return {
        left: tuple(
            np.asarray(features[k - 1]["points"], np.float64)[rows] - PIXEL_CENTRE
            for k, rows in zip((left, right), matches.T, strict=True)
        )
        for (left, right), matches in verified.items()
        if right == left + 1
    }


def _line_distances(rig: Rig, frames: int, stereo: Mapping[int, tuple[Floats, Floats]]) -> Floats:
    """Median distance (frame,), px, of the matches of left and right from their epipolar lines under the given rig.

    NaN where the two do not match. Matches are verified by any motion between two cameras: a right image shifted in its
    rows passes, and registration works without it.
    """
    out = np.full(frames, np.nan)
    for left, points in stereo.items():
        out[left // 2] = np.median(np.abs(line_distances(rig, *points)))
    return out


def _near(rig: Rig, left: Floats, right: Floats) -> int:
    """Number of the matches whose rays meet at an angle at which COLMAP keeps the point."""
    rays = rig.left.rays(left), rig.right.rays(right) @ rig.T_right_left.rotation
    cosine = (rays[0] * rays[1]).sum(axis=1) / np.prod([np.linalg.norm(r, axis=1) for r in rays], axis=0)
    # COLMAP drops points seen under less than 1.5 degrees, and registers the next images by the nearer ones alone.
    return int((cosine <= math.cos(math.radians(1.5))).sum())


def _models(database: Any, starts: Mapping[int, int]) -> list[Any]:
    """Models, each begun with the stereo pair of most near points (``starts``, by the number of the left image) that
    is in no model yet, as long as it might become the largest.

    No frame may be posed from one start and all from another: a model of one frame says nothing of the next.
    """
    models, left, most = [], set(starts), 0
    while len(left) > most or (left and most < 2):
        start = max(left, key=lambda number: (starts[number], -number))
        left.discard(start)
        for model in _map(database, (start, start + 1)):
            models.append(model)
            left -= {2 * frame - 1 for frame in model.reg_frame_ids()}
            most = max(most, model.num_reg_frames())
    return models


def _map(database: Any, start: tuple[int, int]) -> list[Any]:
    """Incremental mapping from two images on, with the rig and all intrinsics held."""
    from rille.stages.geometry.colmap import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    # With more threads the order of sums, and so the result, differs from run to run.
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    # Rille uses the same calibration: if COLMAP refined it, an error of it would look like an error of our trajectory.
    options.ba_refine_focal_length = options.ba_refine_principal_point = False
    options.ba_refine_extra_params = options.ba_refine_sensor_from_rig = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    # COLMAP registers no image of another focal length, in image widths; the calibration's are right.
    options.min_focal_length_ratio, options.max_focal_length_ratio = 1e-3, 1e4
    options.init_image_id1, options.init_image_id2 = start
    options.multiple_models, options.init_num_trials = False, 1
    # A pixel of disparity at a focal length of 600 pixels.
    options.mapper.init_min_tri_angle = 0.1
    options.min_model_size, options.extract_colors = 2, False
    # Fewer adjustments on the way: when a model has grown threefold, with two images beside a new one, and until the
    # cost changes by less than a thousandth. COLMAP's 1.1, 6, 0 and 0 take twice the time, and change no error by a
    # tenth.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 3.0
    options.mapper.ba_local_num_images = 2
    options.ba_local_max_refinements, options.ba_global_max_refinements = 1, 2
    options.ba_local_function_tolerance, options.ba_global_function_tolerance = 1e-3, 1e-4
    pycolmap.set_random_seed(SEED)
    manager = pycolmap.ReconstructionManager()
    pycolmap.IncrementalPipeline(options, database, manager).run()
    return [manager.get(k) for k in range(manager.size())]


def _read(model: Any, frames: int) -> Floats:
    """Poses (frame, 3, 4) in the left camera frame of the first registered frame, NaN for frames without one."""
    poses, numbers = np.full((frames, 3, 4), np.nan), sorted(model.reg_frame_ids())
    first = model.frame(numbers[0]).rig_from_world
    for number in numbers:
        poses[number - 1] = (first * model.frame(number).rig_from_world.inverse()).matrix()
    return poses


@stage(
    "crosscheck",
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", "nan", "window"),
        Array("line_distance", ("frame",), "float64", "px", "median of the matches from their epipolar lines", "nan"),
    ],
    memory=Memory(fixed=150e6, factor=20.0, result=0.0, lower=("crosscheck.window",)),
)
def crosscheck_stage(
    params: CrosscheckParams, left: Sequence[Bundle], right: Sequence[Bundle], *, frames: Sequence[int], rig: Rig
) -> Bundle[WindowFacts]:
    """Poses of a window of frames by COLMAP, for comparison."""
    from rille.stages.geometry.colmap import pycolmap

    pycolmap.logging.minloglevel = 3  # fatal alone: the result says what went wrong
    features = list(itertools.chain.from_iterable(zip(left, right, strict=True)))
    with pycolmap.Database.open(":memory:") as database:
        verified = _write_frames(database, rig, features)
        stereo = _stereo_points(features, verified)
        models = _models(database, {left: _near(rig, *points) for left, points in stereo.items()})
    poses, reprojection, reason = np.full((len(frames), 3, 4), np.nan), None, ""
    if models:
        # Models of one window do not share a frame of reference: the largest is used. Frames of the others may have
        # poses by neighbouring windows.
        best = max(models, key=lambda m: m.num_reg_frames())
        poses, reprojection = _read(best, len(frames)), float(best.compute_mean_reprojection_error())
    elif verified:
        reason = f"{len(verified)} image pairs match, but left and right start no model"
    else:
        count = np.median([len(f["points"]) for f in features])
        reason = f"no two images match (median {count:.0f} features an image)"
    meta: WindowFacts = {"frames": list(frames), "reprojection_px": reprojection, "reason": reason}
    return Bundle({"poses": poses, "line_distance": _line_distances(rig, len(frames), stereo)}, meta)
