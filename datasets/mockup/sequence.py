"""The simulated experiment as a sequence: where the cameras stand, what is given and what is known.

Frames: the bed frame (truth) has z up, y ahead, x right and its origin in the middle of the bed's near edge at mean
height. The body frame moves with the rig: y ahead, x along the baseline to the right, z up, origin between the
cameras. Each camera is turned inward about the body's z axis by the toe-in and then downward by the pitch about its
own horizontal axis, so that with a level body both cameras have exactly that pitch and no roll.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.datasets.mockup.params import MockupParams
from rille.datasets.protocol import CAMERAS, Rows, Sequence, Source, rows_of
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import ConfigError
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.hazard.vehicle import Vehicle

START = -0.1
"""m, y of the first position in the bed frame: the near edge of the bed lies below the first images."""

WINDOW = (-0.3, 0.4, 0.3, 0.7)
"""m, evaluation window of a basic pair: 600 x 300 mm about where the optical axes cross (0.55 m ahead)."""


def mount(p: MockupParams, camera: str) -> RigidTransform:
    """T_body_camera of the true rig."""
    side = -1.0 if camera == "left" else 1.0
    toe, pitch = math.radians(p.toe_in_deg), math.radians(p.pitch_deg)
    # optical axes of a level camera that looks along y: x right, y down, z ahead
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    inward = rotation_exp([0.0, 0.0, side * toe])
    down = rotation_exp([-pitch, 0.0, 0.0])
    return RigidTransform(inward @ down @ level, np.array([side * 0.5 * p.baseline, 0.0, 0.0]))


def body_poses(p: MockupParams) -> list[RigidTransform]:
    """T_bed_body of every frame: steps along the body's own heading on the mean plane, then roll and jitter."""
    rng = np.random.default_rng([p.seed, 60])
    headings = -np.deg2rad(p.turn_deg) * np.arange(p.frames)
    offsets = np.zeros((p.frames, 2))
    for k in range(1, p.frames):
        c, s = math.cos(headings[k - 1]), math.sin(headings[k - 1])
        offsets[k] = offsets[k - 1] + [p.sideways * c - p.forward * s, p.sideways * s + p.forward * c]
    # The drive is centred across the bed, whichever way it drifts.
    offsets[:, 0] -= 0.5 * (offsets[:, 0].min() + offsets[:, 0].max())
    offsets[:, 1] += START - min(offsets[:, 1].min(), 0.0)
    shakes = np.deg2rad(p.jitter_deg) * rng.standard_normal((p.frames, 3))
    poses = []
    swings = np.deg2rad(p.roll_swing_deg) * (np.arange(p.frames) % 2 - 0.5)
    for heading, offset, shake, swing in zip(headings, offsets, shakes, swings, strict=True):
        roll = math.radians(p.roll_deg) + shake[1] + swing
        rotation = (
            rotation_exp([0.0, 0.0, heading + shake[2]])
            @ rotation_exp([shake[0], 0.0, 0.0])
            @ rotation_exp([0.0, roll, 0.0])
        )
        poses.append(RigidTransform(rotation, np.array([offset[0], offset[1], p.camera_height])))
    if p.slope_deg:
        T_bed_plane = RigidTransform(rotation_exp([np.deg2rad(p.slope_deg), 0.0, 0.0]), np.zeros(3))
        poses = [T_bed_plane @ pose for pose in poses]
    return poses


def true_rig(p: MockupParams) -> Rig:
    """The rig that takes the images."""
    camera = Camera(
        p.focal_length,
        p.focal_length,
        0.5 * (p.image_width - 1),
        0.5 * (p.image_height - 1),
        p.image_width,
        p.image_height,
    )
    return Rig(camera, camera, mount(p, "right").inverse() @ mount(p, "left"))


def given_rig(p: MockupParams) -> Rig:
    """The rig as it is handed to the reconstruction: the true one with the stated errors."""
    rig = true_rig(p)
    f = p.focal_length * (1.0 + p.focal_error)
    camera = Camera(f, f, rig.left.cx, rig.left.cy, rig.left.width, rig.left.height)
    error = RigidTransform(rotation_exp(np.deg2rad(p.rig_error_deg)), np.zeros(3))
    return Rig(camera, camera, error @ rig.T_right_left)


def _check_on_bed(p: MockupParams, poses: list[RigidTransform]) -> None:
    """Refuse a drive that leaves the bed."""
    for k, pose in enumerate(poses):
        x, y, _ = pose.translation
        # Not y < 0: a drive begins before the near edge (START).
        if abs(x) > 0.5 * p.bed_width or y > p.bed_length:
            raise ConfigError(
                "RIL-253",
                f"mockup: frame {k} stands at x = {x:.2f} m, y = {y:.2f} m, outside the bed of "
                f"{p.bed_width:g} x {p.bed_length:g} m",
                remedy="take fewer frames, smaller steps or turns, or a larger bed",
            )


def _attitude(p: MockupParams, truth: list[RigidTransform]) -> tuple[Rows, ...] | None:
    """R_bed_left of each frame, as a sensor with the stated error gives it."""
    if p.attitude_noise_deg is None:
        return None
    rng = np.random.default_rng([p.seed, 61])
    out = []
    for pose in truth:
        error = rotation_exp(np.deg2rad(p.attitude_noise_deg) * rng.standard_normal(3))
        # The sensor errs about the camera's axes: the error stands before R_left_bed, the transposed rotation.
        out.append(rows_of((error @ pose.rotation.T).T))
    return tuple(out)


def _up(p: MockupParams, truth: list[RigidTransform]) -> tuple[tuple[float, float, float], ...] | None:
    """Direction of up in each left camera, as an inclinometer with the stated error gives it."""
    if p.up_noise_deg is None:
        return None
    out = []
    for frame, pose in enumerate(truth):
        # A stream for each frame: its error stays the same however many frames there are.
        error = np.random.default_rng([p.seed, 62, frame]).standard_normal(3)
        x, y, z = rotation_exp(np.deg2rad(p.up_noise_deg) * error) @ pose.rotation[2]
        out.append((float(x), float(y), float(z)))
    return tuple(out)


def mockup(p: MockupParams, name: str = "mockup") -> Sequence:
    """The simulated sequence."""
    bodies = body_poses(p)
    _check_on_bed(p, bodies)
    rig = true_rig(p)
    cameras = {"left": rig.left, "right": rig.right}
    poses = {c: [body @ mount(p, c) for body in bodies] for c in CAMERAS}
    scene = Source("rille.datasets.mockup.scene", p.scene())

    def image(frame: int, camera: str) -> Source:
        args = {
            "frame": frame,
            "camera": camera,
            "geometry": cameras[camera].to_dict(),
            "T_bed_camera": poses[camera][frame].to_list(),
        }
        return Source("rille.datasets.mockup.render", p.render(), args, inputs={"scene": scene})

    def disparity(frame: int) -> Source:
        args = {"frame": frame, "rig": rig.to_dict(), "T_bed_left": poses["left"][frame].to_list()}
        return Source("rille.datasets.mockup.truth", NoParams(), args, inputs={"scene": scene})

    def dem(lattice: Mapping[str, Any], T_truth_world: RigidTransform, pairs: tuple[int, ...] = ()) -> Source:
        args = {
            "lattice": dict(lattice),
            "T_bed_world": T_truth_world.to_list(),
            "rig": rig.to_dict(),
            "pairs": [poses["left"][k].to_list() for k in pairs],
        }
        return Source("rille.datasets.mockup.truth_dem", NoParams(), args, inputs={"scene": scene})

    attitude = _attitude(p, poses["left"])
    up = _up(p, poses["left"]) if attitude is None else tuple(rows[2] for rows in attitude)
    return Sequence(
        name=name,
        rig=given_rig(p),
        frames=p.frames,
        image=image,
        frame_names=tuple(f"{k:06d}" for k in range(p.frames)),
        times=tuple(float(k) for k in range(p.frames)),
        truth=tuple(poses["left"]),
        truth_source="the simulator's own poses: exact",
        up=up,
        attitude=attitude,
        vehicle=vehicle_at_scale(),
        truth_dem=dem,
        truth_disparity=disparity,
        evaluation_window=WINDOW,
        defaults={"keyframes.rule": "stride", "keyframes.stride": 4, "locus.cell_size": 0.001},
        notes=(
            f"simulated at 1:10 with seed {p.seed}; lengths are those of the model",
            "truth frame: z up, y along the bed, x right, origin in the middle of the near edge at mean height",
        ),
        parameters={"mockup": p},
    )


def vehicle_at_scale() -> Vehicle:
    """The rover at 1:10: a 0.8 m wide, 1 m long one with 0.3 m wheels at full scale."""
    return Vehicle(
        name="rover at 1:10",
        wheel_diameter=0.03,
        track=0.08,
        wheel_base=0.10,
        clearance=0.025,
        max_slope_deg=20.0,
        max_step=0.012,
        max_roughness=0.004,
        margin=0.01,
    )
